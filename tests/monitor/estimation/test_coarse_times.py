"""Tests of recordings whose time stamps are coarser than the sample period."""

import numpy as np
import pytest

from monitor.estimation.coarse_times import refine_coarse_times
from monitor.estimation.regular_grid import place_samples_on_grid
from tests.support.recordings import recorded_blocks, white

SAMPLES = 20_000


@pytest.mark.parametrize("seed", range(60))
def test_pauses_keep_their_length_and_position(seed):
    """The stamps are floors of exact times with three pauses, of the length of some to many stamps."""
    rng = np.random.default_rng(seed)
    rate_hz = float(np.exp(rng.uniform(np.log(4.0), np.log(1000.0))))
    possible = np.array([10.0, 1.0, 0.5, 0.1, 0.05])
    resolution_s = float(rng.choice(possible[(possible * rate_hz > 3.0) & (possible * rate_hz < SAMPLES / 20)]))
    at_stamp = resolution_s * rate_hz
    index, begins = np.arange(SAMPLES), np.sort(rng.choice(np.arange(1, 40), 3, replace=False)) * SAMPLES // 40
    for begin in begins:
        index[begin:] += round(at_stamp * rng.uniform(1.2, 300.0))
    t_s = index / rate_hz + rng.uniform(0.0, 100.0)
    blocks = recorded_blocks(np.floor(t_s / resolution_s + 1e-9) * resolution_s, white(SAMPLES), 1000)
    grid = place_samples_on_grid(blocks, None)
    assert grid.rate_hz == pytest.approx(rate_hz, rel=0.002)
    assert not grid.pauses.size
    assert f"times have a resolution of {resolution_s:.3g} s; equal time steps are assumed between pauses" in grid.notes
    rows = np.flatnonzero(~np.isnan(grid.values[:, 0]))
    assert len(grid.values) == pytest.approx(index[-1] + 1, abs=6 + 4 * index[-1] / SAMPLES)
    assert np.abs(rows - index).max() <= 6 + 4 * index[-1] / SAMPLES


def test_stamp_with_too_few_samples_has_lost_them():
    index = np.delete(np.arange(SAMPLES), np.arange(7_032, 7_061))
    grid = place_samples_on_grid(recorded_blocks(np.floor(index / 100.0)), None)
    assert grid.rate_hz == 100.0
    assert len(grid.values) == SAMPLES
    assert np.flatnonzero(np.isnan(grid.values[:, 0])).tolist() == list(range(7_071, 7_100))


@pytest.mark.parametrize("loss", [0.01, 0.2])
def test_random_loss_is_no_pause(loss):
    rng = np.random.default_rng(5)
    index = np.flatnonzero(rng.random(SAMPLES) > loss)
    grid = place_samples_on_grid(recorded_blocks(np.floor(index / 100.0)), None)
    assert grid.rate_hz == pytest.approx(100.0 * (1.0 - loss), rel=0.02)
    assert len(grid.values) == pytest.approx(index.size, rel=1e-3)


def test_late_stamps_are_no_pause():
    """The sender reads its clock up to 30 ms late."""
    rng = np.random.default_rng(6)
    t_s = np.maximum.accumulate(np.floor(np.arange(SAMPLES) / 100.0 + 0.03 * rng.random(SAMPLES)))
    grid = place_samples_on_grid(recorded_blocks(t_s), None)
    assert grid.rate_hz == pytest.approx(100.0, rel=1e-3)
    assert len(grid.values) == SAMPLES


@pytest.mark.parametrize("kind", ["exact", "jitter", "repeated", "backwards", "constant", "short"])
def test_other_times_are_unchanged(kind):
    rng = np.random.default_rng(7)
    t_s, values = np.arange(SAMPLES) / 100.0, white(SAMPLES)
    if kind == "jitter":
        t_s = np.sort(t_s + rng.normal(0.0, 0.002, SAMPLES))
    elif kind == "repeated":  # a bag contains each message twice
        t_s, values = t_s.repeat(2), values.repeat(2, axis=0)
    elif kind == "backwards":
        t_s = np.floor(t_s)
        t_s[9_000:] -= 50.0
    elif kind == "constant":
        t_s[:] = 5.0
    elif kind == "short":
        t_s, values = np.floor(t_s[:90]), values[:90]
    blocks = recorded_blocks(t_s, values, 1000)
    refined, resolution_s = refine_coarse_times(blocks)
    assert resolution_s == 0.0
    for new, old in zip(refined, blocks, strict=True):
        assert np.array_equal(new.t_ns, old.t_ns)
