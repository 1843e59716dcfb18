"""Tests that live total and Hadamard curves equal those of the batch functions on the window."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor.estimation.allan.batch import cluster_sizes
from monitor.estimation.allan.hadamard import compute_hadamard_curve
from monitor.estimation.allan.live_total_and_hadamard import MIN_SAMPLES, LiveTotalAndHadamard
from monitor.estimation.allan.total import compute_total_curve
from monitor.estimation.allan.window import AllanWindow

THETA = np.repeat(np.array([[1e-12], [1e-10], [1e-12], [1e-14], [0.0]]), 6, axis=1)


def simulate_values(n, seed=0):
    values = 1e-4 * np.random.default_rng(seed).standard_normal((n, 6))
    values[:, 5] += 9.81
    return values


def run_one_round(live):
    for _ in range(100):
        live.compute_next_tau()
        result = live.curves_of_last_round(100.0, THETA)
        if result is not None:
            return result
    raise AssertionError("the round did not finish")


def check_against_batch(live, window, values):
    found = run_one_round(live)
    last = values[-window.length :]
    for curve, expected in (
        (found[0], compute_total_curve(last, 100.0, THETA, found[0].factors)),
        (found[1], compute_hadamard_curve(last, 100.0, THETA, found[1].factors)),
    ):
        assert np.array_equal(curve.terms, expected.terms)
        # the only difference at a long τ may be nearly zero by chance, so that the rounding of 9.81 matters
        deviation = np.sqrt(expected.variance)
        largest = np.nanmax(deviation, initial=0.0)
        clear = ~(deviation < 1e-3 * largest)
        np.testing.assert_allclose(np.sqrt(curve.variance), deviation, rtol=1e-9, atol=1e-9 * largest)
        np.testing.assert_allclose(curve.tau_s, expected.tau_s, rtol=1e-9)
        np.testing.assert_allclose(curve.edf, expected.edf, rtol=1e-9)
        for end in ("lo", "hi"):
            found_end, expected_end = getattr(curve, end)[clear], getattr(expected, end)[clear]
            np.testing.assert_allclose(found_end, expected_end, rtol=1e-9, atol=1e-9 * largest)


@pytest.mark.long
@pytest.mark.parametrize("factors", [cluster_sizes(300, 1.0), np.array([3, 150])])
@pytest.mark.parametrize("samples", [180, 300, 301, 1000])
def test_curves_equal_the_batch_on_the_window(samples, factors):
    values = simulate_values(samples)
    window = AllanWindow(300, factors)
    window.append_samples(values)
    check_against_batch(LiveTotalAndHadamard(window), window, values)


@pytest.mark.long
@settings(max_examples=12, deadline=None)
@given(
    samples=st.integers(MIN_SAMPLES, 400),
    holes=st.lists(st.tuples(st.integers(0, 399), st.integers(0, 5)), max_size=6),
    loss=st.sampled_from([0.0, 0.02, 0.2]),
    skipped=st.integers(0, 30),
    seed=st.integers(0, 99),
)
def test_curves_equal_the_batch_with_gaps(samples, holes, loss, skipped, seed):
    values = simulate_values(samples, seed)
    values[np.random.default_rng(seed).random(samples) < loss] = np.nan
    for row, axis in holes:
        values[row % samples, axis] = np.nan
    window = AllanWindow(200, cluster_sizes(200, 1.0))
    window.append_samples(values)
    window.append_missing_samples(skipped)
    check_against_batch(LiveTotalAndHadamard(window), window, np.concatenate([values, np.full((skipped, 6), np.nan)]))


@pytest.mark.long
def test_window_with_a_span_per_tau_gives_the_same_curves():
    values = simulate_values(900)
    window = AllanWindow(500, np.array([1, 4, 4, 16]), np.array([64, 100, 500, 200]))
    window.append_samples(values)
    check_against_batch(LiveTotalAndHadamard(window), window, values)


def test_curves_with_random_loss_equal_the_batch():
    values = simulate_values(700, 3)
    values[np.random.default_rng(1).random(700) < 0.05] = np.nan
    window = AllanWindow(500, cluster_sizes(500, 1.0))
    window.append_samples(values)
    check_against_batch(LiveTotalAndHadamard(window), window, values)


def test_long_clusters_wait_until_the_window_is_long_enough():
    window = AllanWindow(500, cluster_sizes(500, 1.0))
    live = LiveTotalAndHadamard(window)
    live._factors = [[100, 300, 499], [150]]
    window.append_samples(simulate_values(300))
    for _ in range(50):
        live.compute_next_tau()
    assert live.curves_of_last_round(100.0, THETA) is None
    window.append_samples(simulate_values(200))
    totals, hadamards = run_one_round(live)
    assert totals.factors.tolist() == [100, 300, 499]
    assert hadamards.factors.tolist() == [150]


def test_each_step_uses_the_current_window_and_rounds_are_returned_completely():
    values = simulate_values(1200)
    window = AllanWindow(400, cluster_sizes(400, 1.0))
    window.append_samples(values[:600])
    live = LiveTotalAndHadamard(window)
    live._factors = [[2, 300], [4]]
    live.compute_next_tau()
    window.append_samples(values[600:900])
    live.compute_next_tau()
    assert live.curves_of_last_round(100.0, THETA) is None
    live.compute_next_tau()
    totals, hadamards = live.curves_of_last_round(100.0, THETA)
    early = compute_total_curve(values[200:600], 100.0, THETA, np.array([2, 300]))
    late = compute_total_curve(values[500:900], 100.0, THETA, np.array([2, 300]))
    np.testing.assert_allclose(totals.variance, [early.variance[0], late.variance[1]], rtol=1e-9)
    window.append_samples(values[900:])
    live.compute_next_tau()
    assert np.array_equal(live.curves_of_last_round(100.0, THETA)[0].variance, totals.variance)
    assert np.array_equal(live.curves_of_last_round(100.0, THETA)[1].variance, hadamards.variance)


def test_emptied_window_discards_the_curves():
    window = AllanWindow(400, cluster_sizes(400, 1.0))
    live = LiveTotalAndHadamard(window)
    live.compute_next_tau()
    window.append_samples(simulate_values(400))
    run_one_round(live)
    window.discard_samples()
    window.append_samples(simulate_values(MIN_SAMPLES - 1))
    live.compute_next_tau()
    assert live.curves_of_last_round(100.0, THETA) is None
    window.append_samples(simulate_values(100))
    check_against_batch(live, window, np.concatenate([simulate_values(MIN_SAMPLES - 1), simulate_values(100)]))


@pytest.mark.long
def test_longest_tau_grows_with_the_window():
    values = simulate_values(400)
    window = AllanWindow(400, cluster_sizes(400, 1.0))
    live = LiveTotalAndHadamard(window)
    longest = []
    for start in range(0, 400, 4):
        window.append_samples(values[start : start + 4])
        live.compute_next_tau()
        result = live.curves_of_last_round(100.0, THETA)
        longest.append(0 if result is None else int(result[0].factors[-1]))
    assert longest == sorted(longest)
    assert longest[-1] >= 128


def test_constant_axis_has_zero_variance():
    values = np.zeros((300, 6))
    values[:, 5], values[:, 4] = 9.80665, 1.0 / 3.0
    window = AllanWindow(300, cluster_sizes(300, 1.0))
    window.append_samples(values)
    live = LiveTotalAndHadamard(window)
    totals, hadamards = run_one_round(live)
    assert (hadamards.variance == 0.0).all()
    assert (totals.variance == 0.0).all()


@pytest.mark.long
def test_clusters_that_overflow_the_phase_are_left_out():
    length = 200_000
    short = AllanWindow(length, np.array([1]))
    live = LiveTotalAndHadamard(short)
    swing = np.where(np.arange(length) < length // 2, 30.0, -30.0)[:, None] * np.ones(6)
    short.append_samples(swing)
    totals, _ = run_one_round(live)
    expected = compute_total_curve(swing, 100.0, THETA, totals.factors)
    assert totals.factors[-1] < length // 100
    np.testing.assert_allclose(totals.variance, expected.variance, rtol=1e-9)
    assert LiveTotalAndHadamard(AllanWindow(length, cluster_sizes(length, 1.0)))._factors[0][-1] == 131_072


def test_window_is_not_modified():
    window = AllanWindow(200, cluster_sizes(200, 1.0))
    window.append_samples(simulate_values(300))
    before = window.avar()
    phase, missing, _, unit = window.view_phase_ring()
    assert not phase.flags.writeable
    assert not missing.flags.writeable
    assert unit.shape == (6,)
    run_one_round(LiveTotalAndHadamard(window))
    assert np.array_equal(window.avar(), before)
    window.append_samples(simulate_values(5))  # the window still advances
    assert window.samples_since_reset == 305
