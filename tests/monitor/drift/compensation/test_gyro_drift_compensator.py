"""Tests of the drift compensator: block sizes, rest, motion, and when the bias is learned."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor.drift.compensation.arma import ArmaModel
from monitor.drift.compensation.gyro_drift_compensator import HISTORY_INTERVALS, MAX_PENDING_BLOCKS, Compensator
from monitor.drift.compensation.sage_husa import NOT_AT_REST, REJECTED, STEPPED, USED

RATE_HZ = 100.0
SIGMA = 1e-3
DEGREE = np.pi / 180.0


def simulate_rest(seconds: float, seed: int = 0, bias: float = 0.02) -> np.ndarray:
    return bias + SIGMA * np.random.default_rng(seed).standard_normal((round(seconds * RATE_HZ), 6))


def compensate_in_blocks(compensator: Compensator, values: np.ndarray, rows: int = 100) -> np.ndarray:
    out = []
    for start in range(0, len(values), rows):
        out.append(compensator.compensate(values[start : start + rows]))
        compensator.identify_due_models()
    return np.concatenate(out)


@settings(max_examples=6, deadline=None)
@given(st.lists(st.integers(1, 400), min_size=1, max_size=30), st.integers(0, 5))
def test_block_sizes_do_not_change_the_result(cuts, seed):
    values = simulate_rest(30.0, seed)
    values[1500:1700, 2] += 0.5
    values[[100, 2222], 1] = np.nan
    whole = Compensator(RATE_HZ)
    expected = whole.compensate(values)
    compensator, parts, at = Compensator(RATE_HZ), [], 0
    for cut in [*cuts, len(values)]:
        if at < len(values):
            parts.append(compensator.compensate(values[at : at + cut]))
            at += cut
    np.testing.assert_array_equal(np.concatenate(parts), expected)
    np.testing.assert_array_equal(
        [i.mean for i in compensator.take_finished_intervals()], [i.mean for i in whole.take_finished_intervals()]
    )


def test_gyroscopes_at_rest_are_smoothed_and_other_axes_are_unchanged():
    values = simulate_rest(120.0)
    out = compensate_in_blocks(Compensator(RATE_HZ), values)
    np.testing.assert_array_equal(out[:, 3:], values[:, 3:])
    np.testing.assert_array_equal(out[:500], values[:500])  # no bias is known yet
    assert np.sqrt(np.mean(out[3000:, :3] ** 2)) < 0.2 * SIGMA


def test_motion_is_preserved_and_not_learned():
    values = simulate_rest(300.0)
    t = np.arange(6000) / RATE_HZ
    truth = 30.0 * DEGREE * np.sin(2.0 * np.pi * t / 3.0)
    values[24_000:, 2] += truth
    compensator = Compensator(RATE_HZ)
    out = compensate_in_blocks(compensator, values)
    assert np.sqrt(np.mean((out[24_000:, 2] - truth) ** 2)) < 1.02 * SIGMA
    np.testing.assert_allclose(compensator.bias, 0.02, atol=2e-4)
    assert [i.outcome[2] for i in compensator.take_finished_intervals()[245:297]] == [NOT_AT_REST] * 52


@pytest.mark.long
@pytest.mark.parametrize("rate", [0.3, 1.0, 5.0])
def test_slow_turn_is_not_learned_as_drift(rate):
    values = simulate_rest(400.0)
    values[20_000:26_000, 2] += rate * DEGREE
    compensator = Compensator(RATE_HZ)
    out = compensate_in_blocks(compensator, values)
    assert out[20_100:26_000, 2].mean() == pytest.approx(rate * DEGREE, rel=0.01)
    assert abs(out[26_100:, 2].mean()) < 1e-4
    assert {int(i.outcome[2]) for i in compensator.take_finished_intervals()[203:258]} <= {REJECTED, NOT_AT_REST}


@pytest.mark.long
def test_bias_step_is_accepted_late_and_discards_the_history():
    values = simulate_rest(700.0)
    values[20_000:, 0] += 1.0 * DEGREE
    compensator = Compensator(RATE_HZ)
    out = compensate_in_blocks(compensator, values)
    assert out[39_000:40_000, 0].mean() == pytest.approx(1.0 * DEGREE, rel=0.02)
    np.testing.assert_allclose(compensator.bias, [0.02 + DEGREE, 0.02, 0.02], atol=2e-4)
    outcomes = [int(i.outcome[0]) for i in compensator.take_finished_intervals()]
    assert outcomes.count(STEPPED) == 1
    assert (
        np.isfinite(compensator.means_and_noise_variance_for_identification(0)[0]).sum()
        < 400
        < np.isfinite(compensator.means_and_noise_variance_for_identification(1)[0]).sum()
    )


def test_turn_from_the_start_is_never_learned_as_bias():
    values = simulate_rest(60.0)
    values[:, 2] += 29.0 * DEGREE
    compensator = Compensator(RATE_HZ)
    np.testing.assert_array_equal(compensate_in_blocks(compensator, values), values)
    assert np.isnan(compensator.bias).all()


def test_moving_vehicle_learns_no_bias():
    values = simulate_rest(120.0)
    values[:, 5] += np.random.default_rng(1).standard_normal(len(values))
    np.testing.assert_array_equal(compensate_in_blocks(Compensator(RATE_HZ), values), values)


@pytest.mark.parametrize("value", [0.0, 0.01])
def test_constant_input_gives_finite_output(value):
    values = np.full((20_000, 6), value)
    out = compensate_in_blocks(Compensator(RATE_HZ), values)
    assert np.isfinite(out).all()
    np.testing.assert_allclose(out[2000:, :3], 0.0, atol=1e-9)


@pytest.mark.long
def test_gaps_outliers_and_missing_values_do_not_disturb_the_bias():
    rng = np.random.default_rng(2)
    compensator = Compensator(RATE_HZ)
    for k in range(200):
        values = simulate_rest(3.0, k)
        values[rng.integers(300, size=5)] *= 1e4
        values[rng.integers(300, size=20), rng.integers(6, size=20)] = np.nan
        out = compensator.compensate(values, lost=int(rng.choice([0, 0, 1, 30, 5000, 10**8])))
        compensator.identify_due_models()
        np.testing.assert_array_equal(np.isfinite(out), np.isfinite(values))
    np.testing.assert_allclose(compensator.bias, 0.02, atol=1e-3)


def test_lost_samples_equal_samples_that_are_nan():
    values, missing = simulate_rest(60.0), 10
    counted, marked = Compensator(RATE_HZ), Compensator(RATE_HZ)
    for start in range(0, len(values), 100):
        piece = values[start : start + 100].copy()
        piece[:missing] = np.nan
        expected = counted.compensate(piece[missing:], lost=missing)
        np.testing.assert_array_equal(marked.compensate(piece[:4]), piece[:4])
        np.testing.assert_array_equal(marked.compensate(piece[4:])[missing - 4 :], expected)


def test_intervals_ended_by_a_gap_fit_into_their_buffer():
    """Compiled code does not check bounds, so an interval without space would overwrite other memory."""
    rng = np.random.default_rng(0)
    max_extra = 0
    for rate_hz in (10.0, 333.0, 1000.0):
        compensator = Compensator(rate_hz)
        for lost in rng.integers(0, 20_000, 200):
            n = int(rng.integers(1, 600))
            compensator.compensate(1e-3 * rng.standard_normal((n, 6)), int(lost))
            max_extra = max(max_extra, len(compensator.take_finished_intervals()) - n // compensator.interval_samples)
    assert 2 < max_extra <= 2 + MAX_PENDING_BLOCKS


def test_models_are_identified_repeatedly_with_bounded_memory():
    compensator = Compensator(RATE_HZ)
    due = []
    for k in range(30):
        compensator.compensate(simulate_rest(10.0, k))
        due.append(bool(compensator.axes_due_for_identification))
        compensator.identify_due_models()
        assert not compensator.axes_due_for_identification
    assert due.count(True) == 4  # after 60, 90, 135 and 203 intervals
    assert all(isinstance(model, ArmaModel) for model in compensator.models)
    assert compensator.means_and_noise_variance_for_identification(0)[0].size <= HISTORY_INTERVALS
    assert compensator.take_finished_intervals()[-1].known == pytest.approx(SIGMA / np.sqrt(100.0 * 60.0), rel=0.9)


@pytest.mark.long
def test_predicted_drift_has_the_stated_accuracy():
    compensator = Compensator(RATE_HZ)
    rng = np.random.default_rng(3)
    values = simulate_rest(900.0)
    drift = np.cumsum(rng.standard_normal((len(values), 3)), axis=0) * 2e-6
    values[:, :3] += drift
    compensate_in_blocks(compensator, values)
    intervals = compensator.take_finished_intervals()
    innovations = np.array([i.innovation for i in intervals])[120:]
    assert np.nanmean(innovations**2) == pytest.approx(1.0, abs=0.15)
    errors = np.array([(i.expected - 0.02 - drift[i.end - 50]) / i.known for i in intervals[540:]])
    assert np.mean(np.abs(errors) < 1.96) > 0.85
    assert {int(x) for i in intervals[10:] for x in i.outcome} <= {USED, REJECTED}


def test_low_and_high_rates_are_compensated():
    for rate_hz in (4.0, 25.0, 1000.0):
        values = SIGMA * np.random.default_rng(4).standard_normal((round(60.0 * max(rate_hz, 25.0)), 6)) + 0.02
        compensator = Compensator(rate_hz)
        out = compensator.compensate(values)
        assert np.sqrt(np.mean(out[-len(out) // 4 :, :3] ** 2)) < 0.6 * SIGMA
