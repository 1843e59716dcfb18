"""Tests of the share of repeated samples, which must not include equal values due to coarse quantization."""

import numpy as np
import pytest

from monitor.estimation.detection.repeated_share import ROWS, estimate_stale_sample_share


def simulate_values(n, seed=0):
    return 1e-3 * np.random.default_rng(seed).standard_normal((n, 6)) + 9.81


def repeat_rows(values, share, seed=1):
    """Make this share of the rows repeat the previous row."""
    values = values.copy()
    for row in np.flatnonzero(np.random.default_rng(seed).random(len(values)) < share):
        values[row] = values[max(row - 1, 0)]
    return values


@pytest.mark.parametrize("share", [0.02, 0.12, 0.5, 0.9])
@pytest.mark.parametrize("step", [1e-9, 1e-3, 2e-3])
def test_share_of_repeated_rows_is_estimated(share, step):
    """This also holds if neighboring values are often equal because of coarse quantization."""
    values = repeat_rows(np.round(simulate_values(20_000) / step) * step, share)
    assert estimate_stale_sample_share(values) == pytest.approx(share, rel=0.1, abs=0.005)


@pytest.mark.parametrize("step", [1e-3, 3e-3, 1e-2])
@pytest.mark.parametrize("share", [0.0, 0.3])
def test_coarse_quantization_is_not_repetition(step, share):
    """The repetition of a single axis does not count either."""
    values = np.round(simulate_values(30_000) / step) * step
    values[:, :1] = repeat_rows(values[:, :1], share)
    assert estimate_stale_sample_share(values) < 0.01


def test_rows_sent_twice_give_a_share_of_one_half():
    assert estimate_stale_sample_share(simulate_values(5000).repeat(2, axis=0)) == pytest.approx(0.5, abs=0.01)


def test_rows_with_missing_values_are_ignored():
    values = repeat_rows(simulate_values(20_000), 0.3)
    values[np.random.default_rng(2).random(20_000) < 0.2, 4] = np.nan
    assert estimate_stale_sample_share(values) == pytest.approx(0.3, rel=0.1)
    values[:, 4] = np.nan  # an axis that is always missing is ignored
    assert estimate_stale_sample_share(values) == pytest.approx(0.3, rel=0.1)


def test_axis_that_starts_late_counts_from_its_start():
    values = repeat_rows(simulate_values(20 * ROWS), 0.3)
    values[: 5 * ROWS, 5] = np.nan
    assert estimate_stale_sample_share(values) == pytest.approx(0.3, rel=0.1)


def test_constant_axis_is_ignored():
    values = repeat_rows(simulate_values(20_000), 0.3)
    values[:, 2] = 0.0
    assert estimate_stale_sample_share(values) == pytest.approx(0.3, rel=0.1)
    values[:, 1:] = 0.0
    assert estimate_stale_sample_share(values) == 0.0


def test_insufficient_data_gives_zero():
    assert estimate_stale_sample_share(np.ones((1000, 6))) == 0.0
    single_axis = np.full((1000, 6), np.nan)
    single_axis[:, 0] = np.repeat(np.arange(500.0), 2)
    assert estimate_stale_sample_share(single_axis) == 0.0
    assert estimate_stale_sample_share(np.full((10, 6), np.nan)) == 0.0
    for n in (0, 1):
        assert estimate_stale_sample_share(np.empty((n, 6))) == 0.0


@pytest.mark.parametrize("scale", [1e-300, 1e300])
def test_any_scale_is_accepted(scale):
    assert estimate_stale_sample_share(scale * repeat_rows(simulate_values(20_000), 0.3)) == pytest.approx(0.3, rel=0.1)


def test_two_rows_give_zero():
    assert estimate_stale_sample_share(simulate_values(2)) == 0.0
