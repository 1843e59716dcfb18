"""The share of held rows is told; rows that repeat by coarse resolution, or lack something, are not taken for held."""

import numpy as np
import pytest

from monitor.estimation.detection.repeated_share import ROWS, estimate_stale_sample_share


def white(n, seed=0):
    return 1e-3 * np.random.default_rng(seed).standard_normal((n, 6)) + 9.81


def held(values, share, seed=1):
    """So that this share of the rows repeat the row before."""
    values = values.copy()
    for row in np.flatnonzero(np.random.default_rng(seed).random(len(values)) < share):
        values[row] = values[max(row - 1, 0)]
    return values


@pytest.mark.parametrize("share", [0.02, 0.12, 0.5, 0.9])
@pytest.mark.parametrize("step", [1e-9, 1e-3, 2e-3])
def test_the_share_of_held_rows(share, step):
    """Also where neighbours are often equal by coarse resolution alone."""
    values = held(np.round(white(20_000) / step) * step, share)
    assert estimate_stale_sample_share(values) == pytest.approx(share, rel=0.1, abs=0.005)


@pytest.mark.parametrize("step", [1e-3, 3e-3, 1e-2])
@pytest.mark.parametrize("share", [0.0, 0.3])
def test_coarse_resolution_is_not_stale(step, share):
    """Nor of a single axis that holds while others go on."""
    values = np.round(white(30_000) / step) * step
    values[:, :1] = held(values[:, :1], share)
    assert estimate_stale_sample_share(values) < 0.01


def test_every_row_sent_twice():
    assert estimate_stale_sample_share(white(5000).repeat(2, axis=0)) == pytest.approx(0.5, abs=0.01)


def test_rows_that_lack_something_are_not_asked():
    values = held(white(20_000), 0.3)
    values[np.random.default_rng(2).random(20_000) < 0.2, 4] = np.nan
    assert estimate_stale_sample_share(values) == pytest.approx(0.3, rel=0.1)
    values[:, 4] = np.nan  # an axis that is never there is not asked for
    assert estimate_stale_sample_share(values) == pytest.approx(0.3, rel=0.1)


def test_an_axis_that_begins_late_counts_from_there():
    values = held(white(20 * ROWS), 0.3)
    values[: 5 * ROWS, 5] = np.nan
    assert estimate_stale_sample_share(values) == pytest.approx(0.3, rel=0.1)


def test_an_axis_that_never_moves_tells_nothing():
    values = held(white(20_000), 0.3)
    values[:, 2] = 0.0
    assert estimate_stale_sample_share(values) == pytest.approx(0.3, rel=0.1)
    values[:, 1:] = 0.0
    assert estimate_stale_sample_share(values) == 0.0


def test_what_cannot_be_told_is_not_said():
    assert estimate_stale_sample_share(np.ones((1000, 6))) == 0.0
    one = np.full((1000, 6), np.nan)
    one[:, 0] = np.repeat(np.arange(500.0), 2)
    assert estimate_stale_sample_share(one) == 0.0
    assert estimate_stale_sample_share(np.full((10, 6), np.nan)) == 0.0
    for n in (0, 1):
        assert estimate_stale_sample_share(np.empty((n, 6))) == 0.0


@pytest.mark.parametrize("scale", [1e-300, 1e300])
def test_any_scale_is_borne(scale):
    assert estimate_stale_sample_share(scale * held(white(20_000), 0.3)) == pytest.approx(0.3, rel=0.1)


def test_two_rows_are_too_few_to_be_sure():
    assert estimate_stale_sample_share(white(2)) == 0.0
