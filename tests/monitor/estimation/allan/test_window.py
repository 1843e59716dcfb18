"""Tests that the sliding Allan window equals the batch curve of its last samples at every position."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test

from drivers.errors import ConfigError
from monitor.estimation.allan.batch import (
    cluster_sizes,
    overlapping_allan_variances,
    rate_slope_from_thirds,
    rate_slope_per_tau,
)
from monitor.estimation.allan.missing_samples import AllanVariances
from monitor.estimation.allan.window import (
    FULL_SCALE,
    MAX_LENGTH,
    MIN_LENGTH,
    AllanWindow,
    newest_samples_per_displayed_tau,
)
from monitor.estimation.allan.window_kernel import STAGE_SAMPLES, append_staged_samples
from tests.experiments.benchmarks import long_run
from tests.support.allan_references import mean_squares_with_gaps

FACTORS = np.array([1, 2, 3, 7, 16, 25, 50])
LENGTH = 100
GRAVITY = np.array([0.0, 0.0, 0.01, 0.0, 0.0, 9.81])


def simulate_values(n, seed=0, noise=1e-4):
    return noise * np.random.default_rng(seed).standard_normal((n, 6)) + GRAVITY


def compute_batch_of_spans(spans):
    """Return a function that computes each row over its own span, without correction for missing samples."""

    def compute(values, factors):
        rows = [
            overlapping_allan_variances(values[-span:], np.array([m])) for m, span in zip(factors, spans, strict=True)
        ]
        avar, terms, excess = (np.concatenate(parts) for parts in zip(*rows, strict=True))
        return AllanVariances(avar + excess, terms, np.zeros_like(avar))

    return compute


def check_against_batch(window, values, rel=1e-9, largest=0.0, kept=None):
    """Compare the window with the batch of the last samples of ``values``, or of the last kept[axis] samples.

    With few and small terms, the unit of the integer phase limits the accuracy of each second difference.
    ``largest`` is the largest deviation so far; the sums are accurate to 2^-53 of it.
    """
    found = window.variances()
    batch = overlapping_allan_variances
    if (window.spans != window.length).any():
        batch = compute_batch_of_spans(window.spans)
        found = AllanVariances(found.avar + found.excess, found.terms, np.zeros_like(found.avar))
    if kept is None:
        avar, terms, excess = batch(values[-window.length :], window.factors)
    else:
        axes = [batch(values[max(len(values) - n, 0) :, [axis]], window.factors) for axis, n in enumerate(kept)]
        avar, terms, excess = (np.concatenate(parts, axis=1) for parts in zip(*axes, strict=True))
    assert np.array_equal(found.terms, terms)
    assert np.array_equal(np.isnan(found.avar), terms == 0)
    unit = 4.0 / window._scale[:6] / window.factors[:, None]
    size = np.maximum(avar + 2.0 * excess, 0.0)  # the correction depends on the Allan variances of shorter clusters
    within = rel * size + 2.0 * np.sqrt(size / np.maximum(terms, 1)) * unit + 2.0 * unit.max(axis=0) * unit
    within += (2.0**-50 * largest) ** 2
    for one, wanted in ((found.avar, avar), (found.excess, excess)):
        assert ((terms == 0) | (np.abs(one - wanted) <= within)).all(), np.nanmax(np.abs(one - wanted) / within)


def assert_same_state(first, second):
    """Compare bit for bit because block sizes must not matter."""
    assert np.array_equal(first.avar(), second.avar(), equal_nan=True)
    assert np.array_equal(first.variances().terms, second.variances().terms)
    assert first.samples_in_window == second.samples_in_window
    assert first.samples_since_reset == second.samples_since_reset


# --- block sizes


def test_every_position_equals_the_batch():
    values = simulate_values(700)
    values[choose_rows(700, 12)] = np.nan
    values[300:330, 2] = np.nan
    window = AllanWindow(LENGTH, FACTORS)
    for i in range(len(values)):
        window.append_samples(values[i : i + 1])
        check_against_batch(window, values[: i + 1])


def choose_rows(n, k):
    return np.random.default_rng(5).choice(n, k, replace=False)


@settings(max_examples=40, deadline=None)
@given(
    cuts=st.lists(st.integers(0, 700), max_size=12),
    values=hnp.arrays(
        np.float64,
        (700, 6),
        elements=st.floats(-70.0, 70.0, allow_nan=False, allow_subnormal=False),
        fill=st.sampled_from([0.0, 9.81, float("nan")]),
    ),
    length=st.sampled_from([100, 101, 163, 164, 165, 300]),
)
def test_any_block_sizes_give_the_same_result(cuts, values, length):
    factors = cluster_sizes(length, 1.0, "decade10")
    whole, cut, single = (AllanWindow(length, factors) for _ in range(3))
    whole.append_samples(values)
    edges = [0, *sorted(cuts), len(values)]
    for a, b in pairwise(edges):
        cut.append_samples(values[a:b])
    for row in values:
        single.append_samples(row[None])
    assert np.array_equal(whole.variances().terms, single.variances().terms)
    assert np.array_equal(cut.variances().terms, single.variances().terms)
    for window in (whole, cut, single):
        check_against_batch(window, values, largest=70.0)
    atol = (2.0**-50 * 70.0) ** 2
    np.testing.assert_allclose(whole.avar(), single.avar(), rtol=1e-13, atol=atol)
    np.testing.assert_allclose(cut.avar(), single.avar(), rtol=1e-13, atol=atol)


@settings(max_examples=40, deadline=None)
@given(
    holes=st.lists(st.tuples(st.integers(0, 800), st.integers(1, 160), st.integers(0, 6)), max_size=6),
    length=st.integers(100, 260),
)
def test_missing_samples_on_one_or_all_axes_equal_the_batch(holes, length):
    values = simulate_values(800, seed=length)
    for at, n, axis in holes:
        values[at : at + n, slice(None) if axis == 6 else axis] = np.nan
    factors = cluster_sizes(length, 1.0)
    window = AllanWindow(length, factors)
    for start in range(0, len(values), 37):
        window.append_samples(values[start : start + 37])
        check_against_batch(window, values[: start + 37])


# --- filling and resetting


def test_window_grows_fills_and_resets():
    values = simulate_values(260)
    window = AllanWindow(LENGTH, FACTORS)
    assert np.isnan(window.avar()).all()
    assert not window.variances().terms.any()
    window.append_samples(values[:60])
    assert (window.samples_in_window, window.samples_since_reset) == (60, 60)
    check_against_batch(window, values[:60])
    assert np.isnan(window.avar()[-2:]).sum() == 6  # m = 50 needs 100 samples
    window.append_samples(values[60:])
    assert (window.samples_in_window, window.samples_since_reset) == (100, 260)
    window.discard_samples()
    assert (window.samples_in_window, window.samples_since_reset) == (0, 0)
    assert np.isnan(window.avar()).all()
    window.append_samples(values)
    fresh = AllanWindow(LENGTH, FACTORS)
    fresh.append_samples(values)
    assert_same_state(window, fresh)


def test_empty_block_changes_nothing():
    window = AllanWindow(LENGTH, FACTORS)
    window.append_samples(np.empty((0, 6)))
    assert window.samples_since_reset == 0


@pytest.mark.parametrize("n", [0, 1, 37, 64, 99, 100])
def test_skipping_equals_missing_rows(n):
    values = simulate_values(500)
    skipped, missing = AllanWindow(LENGTH, FACTORS), AllanWindow(LENGTH, FACTORS)
    for window in (skipped, missing):
        window.append_samples(values[:250])
    skipped.append_missing_samples(n)
    missing.append_samples(np.full((n, 6), np.nan))
    assert_same_state(skipped, missing)
    for window in (skipped, missing):
        window.append_samples(values[250:])
    assert_same_state(skipped, missing)
    check_against_batch(skipped, values)


def test_skip_longer_than_the_window_empties_it():
    window, fresh = AllanWindow(LENGTH, FACTORS), AllanWindow(LENGTH, FACTORS)
    window.append_samples(simulate_values(500))
    window.append_missing_samples(10**12)
    for sliding in (window, fresh):
        sliding.append_samples(simulate_values(70, seed=3))
    assert_same_state(window, fresh)


def test_long_skip_is_processed_in_parts():
    length = 9000
    factors = np.array([1, 100, 4500])
    values = simulate_values(20_000)
    window = AllanWindow(length, factors)
    window.append_samples(values)
    window.append_missing_samples(8999)
    window.append_samples(values[:1])
    check_against_batch(window, np.concatenate([values, np.full((8999, 6), np.nan), values[:1]]))


@pytest.mark.parametrize(
    ("length", "factors"),
    [
        (MIN_LENGTH - 1, [1]),
        (MAX_LENGTH + 1, [1]),
        (100, []),
        (100, [0, 1]),
        (100, [1, 51]),
        (100, [2, 2]),
        (100, [4, 2]),
    ],
)
def test_impossible_windows_are_refused(length, factors):
    with pytest.raises(ConfigError):
        AllanWindow(length, np.array(factors, np.int64))


# --- missing samples


def simulate_values_with_gaps(n, seed=0):
    """Return noise in which single samples, part of one axis and a stretch of all axes are missing."""
    values = simulate_values(n, seed)
    values[np.random.default_rng(seed + 1).choice(n, n // 60, replace=False)] = np.nan
    values[n // 2 : n // 2 + 9, 3] = np.nan
    values[n // 3 : n // 3 + 5] = np.nan
    return values


# --- one span per row


FACTORS_WITH_SPANS = np.array([1, 1, 2, 7, 7, 3, 50, 16])
SPANS = np.array([2, 300, 5, 14, 100, 163, 300, 299])


def test_each_row_equals_the_batch_of_its_own_span():
    values = simulate_values_with_gaps(900)
    window = AllanWindow(300, FACTORS_WITH_SPANS, SPANS)
    for i in range(len(values)):
        window.append_samples(values[i : i + 1])
        check_against_batch(window, values[: i + 1])


@settings(max_examples=40, deadline=None)
@given(
    cuts=st.lists(st.integers(0, 700), max_size=12),
    shares=st.lists(st.floats(0.0, 1.0), min_size=8, max_size=8),
    holes=st.lists(st.tuples(st.integers(0, 690), st.integers(1, 80), st.integers(0, 6)), max_size=4),
)
def test_any_spans_and_block_sizes_give_the_same_result(cuts, shares, holes):
    values = simulate_values(700, seed=len(cuts))
    for at, n, axis in holes:
        values[at : at + n, slice(None) if axis == 6 else axis] = np.nan
    spans = 2 * FACTORS_WITH_SPANS + np.floor(np.array(shares) * (200 - 2 * FACTORS_WITH_SPANS)).astype(np.int64)
    cut, single = (AllanWindow(200, FACTORS_WITH_SPANS, spans) for _ in range(2))
    for a, b in pairwise([0, *sorted(cuts), len(values)]):
        cut.append_samples(values[a:b])
    for row in values:
        single.append_samples(row[None])
    assert np.array_equal(cut.variances().terms, single.variances().terms)
    np.testing.assert_allclose(cut.avar(), single.avar(), rtol=1e-13)
    check_against_batch(cut, values)


def test_full_length_spans_equal_a_window_without_spans():
    values = simulate_values_with_gaps(900)
    plain, spanned = AllanWindow(LENGTH, FACTORS), AllanWindow(LENGTH, FACTORS, np.full(FACTORS.size, LENGTH))
    for window in (plain, spanned):
        window.append_samples(values)
    assert_same_state(plain, spanned)


def test_slope_and_length_are_those_of_the_whole_window():
    values = simulate_values(900)
    plain, spanned = AllanWindow(300, np.array([1, 2])), AllanWindow(300, np.array([1, 2]), np.array([10, 20]))
    for window in (plain, spanned):
        window.append_samples(values)
    assert spanned.samples_in_window == 300
    assert np.array_equal(plain.drift_slopes_by_axis_and_tau()[0], spanned.drift_slopes_by_axis_and_tau()[0])


def test_transient_leaves_each_row_after_its_span():
    values = simulate_values(900)
    values[600:603] += 1e6 * 1e-4
    window = AllanWindow(300, np.array([1, 1]), np.array([20, 300]))
    window.append_samples(values[:623])
    check_against_batch(window, values[:623])
    short, long = window.avar()[:, 0]
    assert short < 1e-7 < 1.0 < long


@pytest.mark.parametrize(
    ("factors", "spans"),
    [([1, 2], [10]), ([4], [7]), ([1], [101]), ([1], [0]), ([0], [10]), ([51], [102]), ([1, 2], [[10, 10]])],
)
def test_impossible_spans_are_refused(factors, spans):
    with pytest.raises(ConfigError):
        AllanWindow(100, np.array(factors), np.array(spans))


@pytest.mark.parametrize(("length", "rate_hz"), [(100, 1.0), (100, 100.0), (360_000, 100.0), (3_600_000, 1000.0)])
def test_display_spans_fit_any_window(length, rate_hz):
    factors = np.unique([*cluster_sizes(length, rate_hz), length // 2])
    window = AllanWindow(length, factors, newest_samples_per_displayed_tau(factors, rate_hz, length))
    assert ((window.spans >= 16 * factors) | (window.spans == length)).all()
    assert (window.spans >= min(10 * rate_hz, length)).all()


# --- the kernel called from other compiled code


def test_staged_samples_can_be_appended_singly():
    values = simulate_values_with_gaps(STAGE_SAMPLES)
    window, plain = AllanWindow(LENGTH, FACTORS), AllanWindow(LENGTH, FACTORS)
    for row in values:
        plain.append_samples(row[None])
    window._stage[:] = values
    for row in range(STAGE_SAMPLES):
        append_staged_samples(window._memory, window._taus, row, 1)
    assert_same_state(window, plain)
    window._stage[:] = values[::-1]
    append_staged_samples(window._memory, window._taus, 100, 300)
    plain.append_samples(values[::-1][100:400])
    assert_same_state(window, plain)


# --- long runs, large values


def test_phase_and_ring_overflow_leave_the_curve_exact():
    """Gravity overflows the 64-bit phase every 3300 samples at the finest scale; the ring wraps every 165 samples."""
    values = simulate_values(50_000, seed=8)
    window = AllanWindow(LENGTH, FACTORS)
    for turn in range(40):
        window.append_samples(values)
        check_against_batch(window, values[-(1000 + turn) :])
    assert window.samples_since_reset == 2_000_000


def test_full_scale_square_wave_does_not_overflow():
    length = 4096
    factors = cluster_sizes(length, 1.0)
    m = int(factors[-1])
    sign = np.where(np.arange(3 * length) // m % 2, 1.0, -1.0)[:, None]
    values = sign * np.array(FULL_SCALE[:6])
    window = AllanWindow(length, factors)
    window.append_samples(values)
    check_against_batch(window, values, rel=1e-12)


@pytest.mark.parametrize("height", [1e-4 * 1e6, 400.0, 2000.0])
@pytest.mark.parametrize("duration", [1, 5, 400, 3000])
def test_transient_is_removed_from_the_sums_completely(height, duration):
    """A transient beyond full scale and longer than the longest τ makes σ² wrong only while the window contains it."""
    length = 1000
    values = simulate_values(9000, seed=11)
    values[2000 : 2000 + duration] += height
    factors = cluster_sizes(length, 1.0)
    window = AllanWindow(length, factors)
    window.append_samples(values[:2500])
    assert window.avar()[0, 0] > 1e-5 or duration > 1000
    window.append_samples(values[2500:])
    check_against_batch(window, values)


@pytest.mark.parametrize("wrong", [1e6, 1e12, 1e300, np.inf, -np.inf])
def test_impossible_values_do_not_remain(wrong):
    values = simulate_values(1000)
    values[200:203] = wrong
    window = AllanWindow(LENGTH, FACTORS)
    window.append_samples(values[:250])
    assert np.isfinite(window.avar()[0]).all()
    window.append_samples(values[250:])
    check_against_batch(window, values)


@pytest.mark.parametrize("wrong", [1e300, np.inf, -np.inf])
def test_values_beyond_the_phase_range_count_as_missing(wrong):
    values, missing = simulate_values(150), simulate_values(150)
    values[120, 4], missing[120, 4] = wrong, np.nan
    window = AllanWindow(LENGTH, FACTORS)
    window.append_samples(values)
    check_against_batch(window, missing)


def test_swing_beyond_twice_full_scale_recovers():
    """±2000 m/s² for longer than the longest τ wraps the second difference; later values are exact again."""
    length = 4096
    factors = cluster_sizes(length, 1.0)
    values = simulate_values(40_000, seed=2)
    values[8000:10_000] = 2000.0
    values[10_000:12_000] = -2000.0
    window = AllanWindow(length, factors)
    window.append_samples(values[:12_000])
    assert np.isfinite(window.avar()).all()
    window.append_samples(values[12_000:])
    check_against_batch(window, values)


# --- invariance


def test_offset_has_no_effect_and_scale_is_quadratic():
    values = simulate_values(3000)
    plain, shifted, scaled = (AllanWindow(LENGTH, FACTORS) for _ in range(3))
    plain.append_samples(values)
    shifted.append_samples(values + np.array([1.0, -2.0, 3.0, -20.0, 30.0, 100.0]))
    scaled.append_samples(2.0 * values)
    np.testing.assert_allclose(shifted.avar(), plain.avar(), rtol=1e-9)
    np.testing.assert_allclose(scaled.avar(), 4.0 * plain.avar(), rtol=1e-9)


def test_ramp_has_its_known_variance():
    """A pure ramp gives σ² = R² τ²/2 (IEEE Std 952) at every position."""
    slope = np.array([1e-3, -2e-3, 1e-5, 1e-2, 3e-3, -1e-3])
    window = AllanWindow(LENGTH, FACTORS)
    window.append_samples(np.arange(5000)[:, None] * slope)
    np.testing.assert_allclose(window.avar(), 0.5 * (FACTORS[:, None] * slope) ** 2, rtol=1e-9)


def test_unmeasured_axis_has_no_terms():
    values = simulate_values(500)
    values[:, 4] = np.nan
    window = AllanWindow(LENGTH, FACTORS)
    window.append_samples(values)
    assert np.isnan(window.avar()[:, 4]).all()
    assert not window.variances().terms[:, 4].any()
    check_against_batch(window, values)


# --- array types


@pytest.mark.parametrize("array_type", ["read-only", "fortran", "strided", "float32", "integers", "list"])
def test_any_array_type_is_accepted_without_recompilation(array_type):
    values = np.rint(simulate_values(300) * 1e4)
    converted = {
        "read-only": values.copy(),
        "fortran": np.asfortranarray(values),
        "strided": np.repeat(values, 2, axis=0)[::2],
        "float32": values.astype(np.float32),
        "integers": values.astype(np.int32),
        "list": values.tolist(),
    }[array_type]
    if array_type == "read-only":
        converted.flags.writeable = False
    window, plain = AllanWindow(LENGTH, FACTORS), AllanWindow(LENGTH, FACTORS)
    plain.append_samples(values)
    versions = append_staged_samples.signatures
    window.append_samples(converted)
    assert_same_state(window, plain)
    assert append_staged_samples.signatures == versions
    assert array_type == "list" or converted is not values


def test_input_array_stays_writable():
    values = simulate_values(10)
    AllanWindow(LENGTH, FACTORS).append_samples(values)
    assert values.flags.writeable


@pytest.mark.parametrize("shape", [(10, 5), (10, 7), (6,), (10, 6, 1)])
def test_wrong_shape_is_refused(shape):
    with pytest.raises(ValueError, match=r"\[n, 6\]"):
        AllanWindow(LENGTH, FACTORS).append_samples(np.zeros(shape))


# --- random sequences of calls


class WindowCalls(RuleBasedStateMachine):
    """Calls a window of several spans and keeps the expected samples of each axis, with missing samples as NaN."""

    def __init__(self):
        super().__init__()
        length = LENGTH + 30
        self.window = AllanWindow(
            length, np.array([1, 3, 1, 20, 65, 20]), np.array([length, 99, 40, length, length, 77])
        )
        self.expected_samples = np.empty((0, 6))
        self.kept = np.zeros(6, int)  # number of newest samples of each axis that have not been discarded
        self.given = 0

    @rule(n=st.integers(0, 200), holes=st.lists(st.tuples(st.integers(0, 199), st.integers(0, 5)), max_size=4))
    def update(self, n, holes):
        rows = simulate_values(n, self.given)
        self.given += 1
        for row, axis in holes:
            if row < n:
                rows[row, axis] = np.nan
        self.window.append_samples(rows)
        self.expected_samples = np.concatenate([self.expected_samples, rows])[-self.window.length :]
        self.kept = np.minimum(self.kept + n, len(self.expected_samples))

    @rule(n=st.integers(1, 3))
    def update_one_by_one(self, n):
        for _ in range(n):
            self.update(1, [])

    @rule(n=st.integers(0, LENGTH + 33))
    def skip(self, n):
        self.window.append_missing_samples(n)
        empty = n > self.window.length
        self.expected_samples = np.concatenate(
            [self.expected_samples[:0] if empty else self.expected_samples, np.full((0 if empty else n, 6), np.nan)]
        )
        self.expected_samples = self.expected_samples[-self.window.length :]
        self.kept = np.minimum(self.kept + n, len(self.expected_samples))

    @rule(axis=st.integers(0, 5), n=st.integers(0, LENGTH + 33))
    def forget(self, axis, n):
        self.window.keep_newest(axis, n)
        self.expected_samples[: max(len(self.expected_samples) - n, 0), axis] = np.nan
        self.kept[axis] = min(self.kept[axis], n)

    @rule()
    def reset(self):
        self.window.discard_samples()
        self.expected_samples = self.expected_samples[:0]
        self.kept[:] = 0

    @invariant()
    def window_equals_the_batch(self):
        assert self.window.samples_in_window == len(self.expected_samples)
        check_against_batch(self.window, self.expected_samples, kept=self.kept)
        for axis in range(6):
            n = int(self.kept[axis])
            if n < 3:
                continue
            slope, slopes = self.window.drift_slopes_by_axis_and_tau(np.full(6, n))
            own = self.expected_samples[-n:, [axis]]
            np.testing.assert_allclose(slope[axis], rate_slope_from_thirds(own)[0], rtol=1e-6, atol=1e-12)
            expected = rate_slope_per_tau(own, self.window.factors)[:, 0]
            np.testing.assert_allclose(slopes[:, axis], expected, rtol=1e-5, atol=1e-12)


@pytest.mark.long
def test_random_sequences_of_calls_equal_the_batch():
    run_state_machine_as_test(WindowCalls, settings=settings(max_examples=60, stateful_step_count=20, deadline=None))


# --- restart of one axis


@pytest.mark.parametrize("kept", [0, 1, 5, 90, LENGTH - 1])
def test_restarted_axis_equals_the_batch_of_its_newest_samples(kept):
    values = simulate_values(3 * LENGTH)
    values[LENGTH : LENGTH + 7, 2] = np.nan
    values[choose_rows(3 * LENGTH, 20)] = np.nan
    window, samples = AllanWindow(LENGTH, FACTORS), values[: 2 * LENGTH]
    window.append_samples(samples)
    window.keep_newest(1, kept)
    for n in (0, 3, 40, LENGTH):
        window.append_samples(values[len(samples) : len(samples) + n])
        samples = values[: len(samples) + n]
        own = np.full(6, LENGTH)
        own[1] = min(kept + len(samples) - 2 * LENGTH, LENGTH)
        check_against_batch(window, samples, kept=own)


def test_axis_that_is_restarted_twice_has_no_cluster_across_both_restarts():
    """The second restart keeps samples that the first restart has discarded."""
    values = simulate_values(130)
    window = AllanWindow(130, np.array([1, 20, 65]))
    window.append_samples(values)
    window.keep_newest(3, 65)
    window.keep_newest(3, 90)
    window.append_samples(values[:40])
    check_against_batch(window, np.concatenate([values, values[:40]]), kept=np.array([130, 130, 130, 105, 130, 130]))


def test_slope_of_a_restarted_axis_uses_its_own_samples():
    values = simulate_values(LENGTH) + 1e-3 * np.arange(LENGTH)[:, None]
    window = AllanWindow(LENGTH, FACTORS)
    window.append_samples(values)
    window.keep_newest(4, 60)
    lengths = np.full(6, LENGTH)
    lengths[4] = 60
    assert np.isnan(window.drift_slopes_by_axis_and_tau()[0][4])
    assert window.drift_slopes_by_axis_and_tau(lengths)[0][4] == pytest.approx(
        rate_slope_from_thirds(values[-60:])[4], rel=1e-6
    )
    assert window.drift_slopes_by_axis_and_tau(lengths)[0][[0, 5]] == pytest.approx(
        rate_slope_from_thirds(values)[[0, 5]], rel=1e-6
    )
    expected = rate_slope_per_tau(values[-60:], FACTORS)[:, 4]
    known = np.isfinite(expected)
    assert window.drift_slopes_by_axis_and_tau(lengths)[1][known, 4] == pytest.approx(expected[known], rel=1e-6)


# --- very long runs


def test_counts_and_phase_that_wrap_around_leave_no_error():
    """The count of missing samples passes 2³¹, as after 4·10¹⁰ samples with 5 % loss, and the phase passes 2⁶³."""
    window, values = AllanWindow(LENGTH, FACTORS), simulate_values(2000)
    values[np.random.default_rng(6).random(2000) < 0.05] = np.nan
    values[1200:1350] = np.nan  # longer than the window
    window._missing[:], window._phase[:] = 2**31 - 40, 2**63 - 2**20
    for i in range(0, len(values), 25):
        window.append_samples(values[i : i + 25])
        check_against_batch(window, values[: i + 25])
    assert window._missing.min() < 0


@pytest.mark.long
def test_ten_million_samples_with_gaps_and_a_transient_leave_no_error():
    """The benchmark runs 10⁹ samples; see docs/measurements/benchmarks.md."""
    window = AllanWindow(20_000, cluster_sizes(20_000, 100.0)[:8])
    assert long_run.run(window, 10, 0.05, lambda line: None) < 1e-10


@pytest.mark.parametrize("gap", [(20, 3), (480, 5), (900, 6), (100, 25)])
@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_missing_samples_hardly_change_the_slopes(gap, loss):
    n, (at, missing) = 1000, gap
    factors = np.array([1, 4, 16, 64, 250])
    rng = np.random.default_rng(7)
    values = 9.81 + 1e-2 * rng.standard_normal((n, 6)) + 1e-3 * np.arange(n)[:, None]
    whole, window = AllanWindow(n, factors), AllanWindow(n, factors)
    whole.append_samples(values)
    values[at : at + missing] = np.nan
    values[rng.random((n, 6)) < loss] = np.nan
    window.append_samples(values)
    slope, slopes = window.drift_slopes_by_axis_and_tau()
    np.testing.assert_allclose(slope, rate_slope_from_thirds(values), rtol=1e-9)
    np.testing.assert_allclose(slope, whole.drift_slopes_by_axis_and_tau()[0], rtol=0.05)
    np.testing.assert_allclose(slopes[:4], rate_slope_per_tau(values, factors)[:4], rtol=1e-9)
    np.testing.assert_allclose(slopes, rate_slope_per_tau(values, factors), rtol=1e-3)  # few points stand for a cluster
    np.testing.assert_allclose(slopes[3:], whole.drift_slopes_by_axis_and_tau()[1][3:], rtol=0.05)


def test_slopes_need_seventy_percent_of_the_samples():
    n, factors = 1000, np.array([1, 4])
    values = np.random.default_rng(8).standard_normal((n, 6))
    values[:110] = np.nan
    window = AllanWindow(n, factors)
    window.append_samples(values)
    assert np.isnan(window.drift_slopes_by_axis_and_tau()[0]).all()
    assert np.isnan(rate_slope_from_thirds(values)).all()
    values[110:310] = np.nan
    window.append_samples(values)
    assert np.isnan(window.drift_slopes_by_axis_and_tau()[1]).all()
    assert np.isnan(rate_slope_per_tau(values, factors)).all()


# --- random loss


@pytest.mark.parametrize("loss", [0.01, 0.2, 0.6])
def test_random_loss_that_enters_and_leaves_leaves_nothing(loss):
    """A window of several grids equals the batch at every position, and a complete window afterwards."""
    length, factors = 400, np.array([1, 2, 4, 8, 16, 32, 64])
    values, rng = simulate_values(1500, seed=4), np.random.default_rng(5)
    values[200:800][rng.random(600) < loss] = np.nan
    values[300:700, 3][rng.random(400) < loss] = np.nan
    values[500:940, 4] = np.nan  # longer than the window
    window = AllanWindow(length, factors)
    for begin in range(0, len(values), 7):
        window.append_samples(values[begin : begin + 7])
        check_against_batch(window, values[: begin + 7])
    assert not window._excess.any()
    assert not window.variances().excess.any()


def test_correction_of_each_grid_uses_the_same_grid():
    """The displayed grid uses shorter spans. A size that needs smaller clusters gets them in rows of its own."""
    factors, spans = np.array([1, 2, 4, 8, 1, 2, 4, 8, 12]), np.array([300] * 4 + [40, 60, 80, 160, 200])
    values = simulate_values(700, seed=6)
    values[np.random.default_rng(7).random(700) < 0.1] = np.nan
    window = AllanWindow(300, factors, spans)
    window.append_samples(values)
    found = window.variances()
    for grid in (slice(0, 4), slice(4, 8)):
        sigma2 = found.avar[grid]
        for octave in range(4):
            m, span = int(factors[grid][octave]), int(spans[grid][octave])
            raw, _, share = mean_squares_with_gaps(values[-span:, 0], m)
            size = 2.0**octave
            within = size / (size - 1.0) * sigma2[:octave, 0].sum() / 2.0 if octave else 0.0
            assert found.excess[grid][octave, 0] == pytest.approx(share * within, rel=1e-6, abs=1e-20)
            assert sigma2[octave, 0] == pytest.approx(raw - share * within, rel=1e-6)
    sparse = AllanWindow(300, np.array([5, 60]))
    sparse.append_samples(values)
    assert sparse.variances().avar.shape == (2, 6)
    check_against_batch(sparse, values)


@pytest.mark.parametrize("longest_burst", [1, 80])
def test_constant_axis_with_missing_samples_has_no_variance(longest_burst):
    values = np.tile(np.array([0.3, -60.0, 1e-3, 9.81, -399.0, 0.0]), (1000, 1))
    rng = np.random.default_rng(8)
    for at in rng.choice(1000, 200 // longest_burst, replace=False):
        values[at : at + longest_burst] = np.nan
    window = AllanWindow(500, np.array([1, 4, 16, 100, 250]))
    window.append_samples(values)
    assert window.variances().terms[-1].all()
    assert not window.avar().any()
