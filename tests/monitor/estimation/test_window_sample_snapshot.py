"""Tests of samples restored from a copy of the window."""

import numpy as np
import pytest

from drivers.data_types import make_block
from monitor.estimation.estimator import Estimator
from monitor.estimation.window_sample_snapshot import TemperatureRing

STEP = 1.2e-4


def make_estimator(values: np.ndarray, length: int, pieces: int = 1) -> Estimator:
    estimator = Estimator(100.0, length / 100.0)
    t_ns = np.arange(len(values)) * 10_000_000
    for part in np.array_split(np.arange(len(values)), pieces):
        estimator.add_samples(make_block(t_ns[part], values[part]))
    return estimator


@pytest.mark.parametrize("n", [700, 3000, 3001, 10_000])
def test_newest_samples_are_restored_in_order(n: int) -> None:
    values = np.random.default_rng(n).standard_normal((n, 6)) * 1e-2 + [0.0, 1e-3, 0.1, 0.0, -3.0, 9.81]
    values[n - 600 : n - 590, 3] = np.nan
    values[n - 1] = np.nan
    snapshot = make_estimator(values, 3000, pieces=7).copy_window()
    found = snapshot.restore_samples()
    assert (len(snapshot), snapshot.rate_hz) == (min(n, 3000), 100.0)
    np.testing.assert_allclose(found, values[-3000:], rtol=0.0, atol=1e-10)


def test_missing_samples_keep_their_positions() -> None:
    values = np.random.default_rng(1).standard_normal((500, 6))
    estimator = Estimator(100.0, 20.0)
    estimator.add_samples(make_block(np.arange(300) * 10_000_000, values[:300].copy()))
    estimator.add_samples(make_block(np.arange(350, 550) * 10_000_000, values[300:].copy(), lost=50))
    estimator.restart_axis(2, 100)
    found = estimator.copy_window().restore_samples()
    assert found.shape == (550, 6)
    assert np.isnan(found[300:350]).all()
    assert np.isnan(found[:450, 2]).all()
    assert not np.isnan(found[450:, 2]).any()
    np.testing.assert_allclose(found[350:, 0], values[300:, 0], rtol=0.0, atol=1e-10)


def test_steps_of_the_sensor_are_restored() -> None:
    """The phase rounds from sample to sample, so equal samples may differ by one unit and are made equal."""
    counts = np.round(np.random.default_rng(3).standard_normal((20_000, 6)) * 20.0)
    found = make_estimator(counts * STEP, 20_000).copy_window().restore_samples()
    for axis in range(6):
        levels = np.unique(found[:, axis])
        assert levels.size == np.unique(counts[:, axis]).size
        assert np.array_equal(found[1:, axis] == found[:-1, axis], counts[1:, axis] == counts[:-1, axis])
    steps = (found - found[0]) / STEP  # all values are on one grid within float64 accuracy
    np.testing.assert_allclose(steps, counts - counts[0], rtol=0.0, atol=1e-9)


def test_single_precision_values_are_restored_exactly() -> None:
    """The steps of a 32-bit float are only restored where they are exact."""
    values = np.random.default_rng(4).standard_normal((20_000, 6)) * 1e-3 + [0.0, 0.0, 1e-2, 0.0, 0.0, 9.81]
    values = values.astype(np.float32).astype(np.float64)
    values[7] = np.nan
    snapshot = make_estimator(values, 20_000).copy_window()
    found = snapshot.restore_samples()
    assert np.array_equal(found, found.astype(np.float32).astype(np.float64), equal_nan=True)
    coarse = (
        np.spacing(np.abs(values).astype(np.float32)) > 4.0 * snapshot.unit
    )  # the smallest steps are finer than the phase
    assert coarse.mean(axis=0).min() > 0.8
    assert np.array_equal(found[coarse], values[coarse])
    np.testing.assert_allclose(found, values, rtol=0.0, atol=2.0 * snapshot.unit.max())


def test_values_on_an_irregular_scale_are_restored() -> None:
    scale = np.array([-3e-3, -1e-3, 0.0, 0.4e-3, 1.7e-3])
    values = scale[np.random.default_rng(2).integers(0, 5, (3000, 6))]
    found = make_estimator(values, 3000).copy_window().restore_samples()
    assert all(np.unique(found[:, axis]).size == 5 for axis in range(6))
    np.testing.assert_allclose(found, values, rtol=0.0, atol=1e-11)


def test_copy_does_not_change_with_the_window() -> None:
    values = np.random.default_rng(1).standard_normal((2000, 6))
    estimator = make_estimator(values[:1000], 1000)
    snapshot = estimator.copy_window()
    estimator.add_samples(make_block(np.arange(1000) * 10_000_000, values[1000:]))
    np.testing.assert_allclose(snapshot.restore_samples(), values[:1000], rtol=0.0, atol=1e-10)


def test_temperatures_stay_with_their_samples() -> None:
    ring = TemperatureRing(100)
    pushed = []
    rng = np.random.default_rng(1)
    for n in (1, 30, 7, 250, 3, 99, 100):
        lost, t = int(rng.integers(0, 5)), rng.normal(25.0, 1.0, n)
        ring.push_temperatures(lost, t)
        pushed += [np.nan] * lost + t.tolist()
        count = min(len(pushed), 100)
        np.testing.assert_allclose(ring.newest_temperatures(count), pushed[-count:], rtol=1e-6)
    ring.push_temperatures(10_000, np.array([20.0]))
    assert np.isnan(ring.newest_temperatures(100)[:-1]).all()
    assert ring.newest_temperatures(1).tolist() == [20.0]


def test_values_without_steps_get_no_steps() -> None:
    """All values differ and lie on no grid; restoring must keep this and add nothing but rounding."""
    values = np.random.default_rng(1).standard_normal((100_000, 6)) * 1e-3
    snapshot = make_estimator(values, 100_000).copy_window()
    found = snapshot.restore_samples()
    assert all(np.unique(found[:, axis]).size == 100_000 for axis in range(6))
    assert np.array_equal(found, snapshot.restore_samples())
    fraction = found / snapshot.unit - np.round(found / snapshot.unit)
    assert np.abs(fraction).mean() == pytest.approx(0.25, abs=0.01)
    np.testing.assert_allclose(found, values, rtol=0.0, atol=2.0 * snapshot.unit.max())
