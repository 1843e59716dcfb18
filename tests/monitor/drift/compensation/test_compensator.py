"""The whole compensation of a sensor: cuts, rest and motion, what is learned and what is not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor.drift.compensation.arma import ArmaModel
from monitor.drift.compensation.compensator import HISTORY_INTERVALS, MAX_PENDING_BLOCKS, Compensator
from monitor.drift.compensation.sage_husa import NOT_AT_REST, REJECTED, STEPPED, USED

RATE_HZ = 100.0
SIGMA = 1e-3
DEGREE = np.pi / 180.0


def still(seconds: float, seed: int = 0, bias: float = 0.02) -> np.ndarray:
    return bias + SIGMA * np.random.default_rng(seed).standard_normal((round(seconds * RATE_HZ), 6))


def fed(one: Compensator, values: np.ndarray, rows: int = 100) -> np.ndarray:
    out = []
    for start in range(0, len(values), rows):
        out.append(one.compensate(values[start : start + rows]))
        one.identify_due_models()
    return np.concatenate(out)


@settings(max_examples=6, deadline=None)
@given(st.lists(st.integers(1, 400), min_size=1, max_size=30), st.integers(0, 5))
def test_any_cut_gives_the_same(cuts, seed):
    values = still(30.0, seed)
    values[1500:1700, 2] += 0.5
    values[[100, 2222], 1] = np.nan
    whole = Compensator(RATE_HZ)
    expected = whole.compensate(values)
    one, parts, at = Compensator(RATE_HZ), [], 0
    for cut in [*cuts, len(values)]:
        if at < len(values):
            parts.append(one.compensate(values[at : at + cut]))
            at += cut
    np.testing.assert_array_equal(np.concatenate(parts), expected)
    np.testing.assert_array_equal(
        [i.mean for i in one.take_finished_intervals()], [i.mean for i in whole.take_finished_intervals()]
    )


def test_rest_is_stilled_and_the_rest_left_alone():
    values = still(120.0)
    out = fed(Compensator(RATE_HZ), values)
    np.testing.assert_array_equal(out[:, 3:], values[:, 3:])
    np.testing.assert_array_equal(out[:500], values[:500])  # nothing is known yet
    assert np.sqrt(np.mean(out[3000:, :3] ** 2)) < 0.2 * SIGMA


def test_a_known_rate_is_passed_on_and_not_learned():
    values = still(300.0)
    t = np.arange(6000) / RATE_HZ
    truth = 30.0 * DEGREE * np.sin(2.0 * np.pi * t / 3.0)
    values[24_000:, 2] += truth
    one = Compensator(RATE_HZ)
    out = fed(one, values)
    assert np.sqrt(np.mean((out[24_000:, 2] - truth) ** 2)) < 1.02 * SIGMA
    np.testing.assert_allclose(one.bias, 0.02, atol=2e-4)
    assert [i.outcome[2] for i in one.take_finished_intervals()[245:297]] == [NOT_AT_REST] * 52


@pytest.mark.long
@pytest.mark.parametrize("rate", [0.3, 1.0, 5.0])
def test_a_slow_turn_is_no_drift(rate):
    values = still(400.0)
    values[20_000:26_000, 2] += rate * DEGREE
    one = Compensator(RATE_HZ)
    out = fed(one, values)
    assert out[20_100:26_000, 2].mean() == pytest.approx(rate * DEGREE, rel=0.01)
    assert abs(out[26_100:, 2].mean()) < 1e-4
    assert {int(i.outcome[2]) for i in one.take_finished_intervals()[203:258]} <= {REJECTED, NOT_AT_REST}


@pytest.mark.long
def test_a_step_of_the_bias_is_taken_in_the_end_and_forgets_what_was_before():
    values = still(700.0)
    values[20_000:, 0] += 1.0 * DEGREE
    one = Compensator(RATE_HZ)
    out = fed(one, values)
    assert out[39_000:40_000, 0].mean() == pytest.approx(1.0 * DEGREE, rel=0.02)
    np.testing.assert_allclose(one.bias, [0.02 + DEGREE, 0.02, 0.02], atol=2e-4)
    became = [int(i.outcome[0]) for i in one.take_finished_intervals()]
    assert became.count(STEPPED) == 1
    assert (
        np.isfinite(one.means_and_noise_variance_for_identification(0)[0]).sum()
        < 400
        < np.isfinite(one.means_and_noise_variance_for_identification(1)[0]).sum()
    )


def test_what_turns_from_the_start_is_never_a_bias():
    values = still(60.0)
    values[:, 2] += 29.0 * DEGREE
    one = Compensator(RATE_HZ)
    np.testing.assert_array_equal(fed(one, values), values)
    assert np.isnan(one.bias).all()


def test_a_vehicle_that_always_shakes_teaches_nothing():
    values = still(120.0)
    values[:, 5] += np.random.default_rng(1).standard_normal(len(values))
    np.testing.assert_array_equal(fed(Compensator(RATE_HZ), values), values)


@pytest.mark.parametrize("value", [0.0, 0.01])
def test_a_stuck_sensor_stays_finite(value):
    values = np.full((20_000, 6), value)
    out = fed(Compensator(RATE_HZ), values)
    assert np.isfinite(out).all()
    np.testing.assert_allclose(out[2000:, :3], 0.0, atol=1e-9)


@pytest.mark.long
def test_gaps_outliers_and_missing_values():
    rng = np.random.default_rng(2)
    one = Compensator(RATE_HZ)
    for k in range(200):
        values = still(3.0, k)
        values[rng.integers(300, size=5)] *= 1e4
        values[rng.integers(300, size=20), rng.integers(6, size=20)] = np.nan
        out = one.compensate(values, lost=int(rng.choice([0, 0, 1, 30, 5000, 10**8])))
        one.identify_due_models()
        np.testing.assert_array_equal(np.isfinite(out), np.isfinite(values))
    np.testing.assert_allclose(one.bias, 0.02, atol=1e-3)


def test_all_intervals_that_a_hole_ends_at_once_find_room():
    """Compiled code writes where it is told to: what has no room would be written beside it."""
    rng = np.random.default_rng(0)
    most = 0
    for rate_hz in (10.0, 333.0, 1000.0):
        one = Compensator(rate_hz)
        for lost in rng.integers(0, 20_000, 200):
            n = int(rng.integers(1, 600))
            one.compensate(1e-3 * rng.standard_normal((n, 6)), int(lost))
            most = max(most, len(one.take_finished_intervals()) - n // one.interval_samples)
    assert 2 < most <= 2 + MAX_PENDING_BLOCKS


def test_models_are_identified_as_rest_goes_on_and_memory_stays():
    one = Compensator(RATE_HZ)
    asked = []
    for k in range(30):
        one.compensate(still(10.0, k))
        asked.append(bool(one.axes_due_for_identification))
        one.identify_due_models()
        assert not one.axes_due_for_identification
    assert asked.count(True) == 4  # 60, 90, 135, 203 intervals, as far as they end
    assert all(isinstance(model, ArmaModel) for model in one.models)
    assert one.means_and_noise_variance_for_identification(0)[0].size <= HISTORY_INTERVALS
    assert one.bias_standard_error == pytest.approx(SIGMA / np.sqrt(100.0 * 60.0), rel=0.9)


@pytest.mark.long
def test_the_drift_that_it_expects_is_as_near_as_it_says():
    one = Compensator(RATE_HZ)
    rng = np.random.default_rng(3)
    values = still(900.0)
    drift = np.cumsum(rng.standard_normal((len(values), 3)), axis=0) * 2e-6
    values[:, :3] += drift
    fed(one, values)
    taught = one.take_finished_intervals()
    innovations = np.array([i.innovation for i in taught])[120:]
    assert np.nanmean(innovations**2) == pytest.approx(1.0, abs=0.15)
    off = np.array([(i.expected - 0.02 - drift[i.end - 50]) / i.known for i in taught[540:]])
    assert np.mean(np.abs(off) < 1.96) > 0.85
    assert {int(x) for i in taught[10:] for x in i.outcome} <= {USED, REJECTED}


def test_slow_and_fast_sensors():
    for rate_hz in (4.0, 25.0, 1000.0):
        values = SIGMA * np.random.default_rng(4).standard_normal((round(60.0 * max(rate_hz, 25.0)), 6)) + 0.02
        one = Compensator(rate_hz)
        out = one.compensate(values)
        assert np.sqrt(np.mean(out[-len(out) // 4 :, :3] ** 2)) < 0.6 * SIGMA
