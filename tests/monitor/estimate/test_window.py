"""The sliding window equals the whole-recording curve of its last samples, at every position, whatever came before."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from drivers.errors import ConfigError
from monitor.estimate import window as window_module
from monitor.estimate.batch import cluster_sizes, overlapping
from monitor.estimate.window import FULL_SCALE, MAX_LENGTH, MIN_LENGTH, AllanWindow

FACTORS = np.array([1, 2, 3, 7, 16, 25, 50])
LENGTH = 100
GRAVITY = np.array([0.0, 0.0, 0.01, 0.0, 0.0, 9.81])


def made(n, seed=0, noise=1e-4):
    return noise * np.random.default_rng(seed).standard_normal((n, 6)) + GRAVITY


def expected(values, length=LENGTH, factors=FACTORS):
    return overlapping(values[-length:], factors)


def check(window, values, rel=1e-9, largest=0.0):
    """The window against the batch of the last samples of ``values``.

    Where few terms remain, and those small, the unit of the integer phase shows: one each side of a second difference.
    ``largest``: deviation ever held, of which the sums keep 2^-53.
    """
    avar, terms = expected(values, window.length, window.factors)
    assert np.array_equal(window.terms(), terms)
    found = window.avar()
    assert np.array_equal(np.isnan(found), np.isnan(avar))
    unit = 2.0 / window._scale[:6] / window.factors[:, None]
    within = rel * avar + 2.0 * np.sqrt(avar / np.maximum(terms, 1)) * unit + unit**2 + (2.0**-50 * largest) ** 2
    assert (np.isnan(avar) | (np.abs(found - avar) <= within)).all(), np.nanmax(np.abs(found - avar) / within)


def assert_same(one, other):
    """Bit for bit: how the samples were cut must not be seen."""
    assert np.array_equal(one.avar(), other.avar(), equal_nan=True)
    assert np.array_equal(one.terms(), other.terms())
    assert (one.n, one.total) == (other.n, other.total)


# --- one truth, whatever the cut


def test_every_position_equals_the_batch():
    values = made(700)
    values[rng_rows(700, 12)] = np.nan
    values[300:330, 2] = np.nan
    window = AllanWindow(LENGTH, FACTORS)
    for i in range(len(values)):
        window.update(values[i : i + 1])
        check(window, values[: i + 1])


def rng_rows(n, k):
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
def test_blocks_of_any_cut_equal_one_by_one(cuts, values, length):
    factors = cluster_sizes(length, 1.0, "decade10")
    whole, cut, single = (AllanWindow(length, factors) for _ in range(3))
    whole.update(values)
    edges = [0, *sorted(cuts), len(values)]
    for a, b in pairwise(edges):
        cut.update(values[a:b])
    for row in values:
        single.update(row[None])
    assert np.array_equal(whole.terms(), single.terms())
    assert np.array_equal(cut.terms(), single.terms())
    for window in (whole, cut, single):
        check(window, values, largest=70.0)
    atol = (2.0**-50 * 70.0) ** 2
    np.testing.assert_allclose(whole.avar(), single.avar(), rtol=1e-13, atol=atol)
    np.testing.assert_allclose(cut.avar(), single.avar(), rtol=1e-13, atol=atol)


@settings(max_examples=40, deadline=None)
@given(
    holes=st.lists(st.tuples(st.integers(0, 800), st.integers(1, 160), st.integers(0, 6)), max_size=6),
    length=st.integers(100, 260),
)
def test_missing_anywhere_on_one_axis_or_all(holes, length):
    values = made(800, seed=length)
    for at, n, axis in holes:
        values[at : at + n, slice(None) if axis == 6 else axis] = np.nan
    factors = cluster_sizes(length, 1.0)
    window = AllanWindow(length, factors)
    for start in range(0, len(values), 37):
        window.update(values[start : start + 37])
        check(window, values[: start + 37])


# --- life


def test_growing_full_and_reset():
    values = made(260)
    window = AllanWindow(LENGTH, FACTORS)
    assert np.isnan(window.avar()).all()
    assert not window.terms().any()
    window.update(values[:60])
    assert (window.n, window.total) == (60, 60)
    check(window, values[:60])
    assert np.isnan(window.avar()[-2:]).sum() == 6  # m = 50 needs a hundred
    window.update(values[60:])
    assert (window.n, window.total) == (100, 260)
    window.reset()
    assert (window.n, window.total) == (0, 0)
    assert np.isnan(window.avar()).all()
    window.update(values)
    fresh = AllanWindow(LENGTH, FACTORS)
    fresh.update(values)
    assert_same(window, fresh)


def test_an_empty_block_changes_nothing():
    window = AllanWindow(LENGTH, FACTORS)
    window.update(np.empty((0, 6)))
    assert window.total == 0


@pytest.mark.parametrize("n", [0, 1, 37, 64, 99, 100])
def test_skipping_is_that_many_missing_rows(n):
    values = made(500)
    skipped, missing = AllanWindow(LENGTH, FACTORS), AllanWindow(LENGTH, FACTORS)
    for window in (skipped, missing):
        window.update(values[:250])
    skipped.skip(n)
    missing.update(np.full((n, 6), np.nan))
    assert_same(skipped, missing)
    for window in (skipped, missing):
        window.update(values[250:])
    assert_same(skipped, missing)
    check(skipped, values)


def test_a_skip_longer_than_the_window_empties_it():
    window, fresh = AllanWindow(LENGTH, FACTORS), AllanWindow(LENGTH, FACTORS)
    window.update(made(500))
    window.skip(10**12)
    for one in (window, fresh):
        one.update(made(70, seed=3))
    assert_same(window, fresh)


def test_skips_in_pieces_cross_the_piece_length():
    length = 9000
    factors = np.array([1, 100, 4500])
    values = made(20_000)
    window = AllanWindow(length, factors)
    window.update(values)
    window.skip(8999)
    window.update(values[:1])
    check(window, np.concatenate([values, np.full((8999, 6), np.nan), values[:1]]))


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


# --- long runs, large values


def test_ten_thousand_turns_of_phase_and_ring():
    """Gravity alone turns the 64-bit phase every 3300 samples at the finest scale; the ring turns every 165."""
    values = made(50_000, seed=8)
    window = AllanWindow(LENGTH, FACTORS)
    for turn in range(40):
        window.update(values)
        check(window, values[-(1000 + turn) :])
    assert window.total == 2_000_000


def test_full_scale_square_wave_at_the_longest_tau_does_not_overflow():
    length = 4096
    factors = cluster_sizes(length, 1.0)
    m = int(factors[-1])
    sign = np.where(np.arange(3 * length) // m % 2, 1.0, -1.0)[:, None]
    values = sign * np.array(FULL_SCALE[:6])
    window = AllanWindow(length, factors)
    window.update(values)
    check(window, values, rel=1e-12)


@pytest.mark.parametrize("height", [1e-4 * 1e6, 400.0, 2000.0])
@pytest.mark.parametrize("held", [1, 5, 400, 3000])
def test_what_a_transient_added_is_taken_out_again(height, held):
    """Held longer than the longest τ, and beyond full scale: then σ² at long τ is wrong while it is in there."""
    length = 1000
    values = made(9000, seed=11)
    values[2000 : 2000 + held] += height
    factors = cluster_sizes(length, 1.0)
    window = AllanWindow(length, factors)
    window.update(values[:2500])
    assert window.avar()[0, 0] > 1e-5 or held > 1000
    window.update(values[2500:])
    check(window, values)


@pytest.mark.parametrize("wrong", [1e6, 1e12, 1e300, np.inf, -np.inf])
def test_impossible_values_do_not_stay(wrong):
    values = made(1000)
    values[200:203] = wrong
    window = AllanWindow(LENGTH, FACTORS)
    window.update(values[:250])
    assert np.isfinite(window.avar()[0]).all()
    window.update(values[250:])
    check(window, values)


@pytest.mark.parametrize("wrong", [1e300, np.inf, -np.inf])
def test_what_phase_cannot_hold_counts_as_missing(wrong):
    values, missing = made(150), made(150)
    values[120, 4], missing[120, 4] = wrong, np.nan
    window = AllanWindow(LENGTH, FACTORS)
    window.update(values)
    check(window, missing)


def test_a_swing_beyond_twice_full_scale_recovers():
    """±2000 m/s² for longer than the longest τ wraps the second difference: finite nonsense, then exact again."""
    length = 4096
    factors = cluster_sizes(length, 1.0)
    values = made(40_000, seed=2)
    values[8000:10_000] = 2000.0
    values[10_000:12_000] = -2000.0
    window = AllanWindow(length, factors)
    window.update(values[:12_000])
    assert np.isfinite(window.avar()).all()
    window.update(values[12_000:])
    check(window, values)


# --- symmetries


def test_an_offset_or_a_scale_changes_nothing_else():
    values = made(3000)
    plain, moved, larger = (AllanWindow(LENGTH, FACTORS) for _ in range(3))
    plain.update(values)
    moved.update(values + np.array([1.0, -2.0, 3.0, -20.0, 30.0, 100.0]))
    larger.update(2.0 * values)
    np.testing.assert_allclose(moved.avar(), plain.avar(), rtol=1e-9)
    np.testing.assert_allclose(larger.avar(), 4.0 * plain.avar(), rtol=1e-9)


def test_a_slope_adds_its_own_variance():
    """A ramp alone gives σ² = R² τ²/2 (IEEE Std 952), at every position."""
    slope = np.array([1e-3, -2e-3, 1e-5, 1e-2, 3e-3, -1e-3])
    window = AllanWindow(LENGTH, FACTORS)
    window.update(np.arange(5000)[:, None] * slope)
    np.testing.assert_allclose(window.avar(), 0.5 * (FACTORS[:, None] * slope) ** 2, rtol=1e-9)


def test_an_axis_that_is_never_measured():
    values = made(500)
    values[:, 4] = np.nan
    window = AllanWindow(LENGTH, FACTORS)
    window.update(values)
    assert np.isnan(window.avar()[:, 4]).all()
    assert not window.terms()[:, 4].any()
    check(window, values)


# --- arrays as they come


@pytest.mark.parametrize("how", ["read-only", "fortran", "strided", "float32", "integers", "list"])
def test_any_array_is_taken_by_the_one_compiled_version(how):
    values = np.rint(made(300) * 1e4)
    same = {
        "read-only": values.copy(),
        "fortran": np.asfortranarray(values),
        "strided": np.repeat(values, 2, axis=0)[::2],
        "float32": values.astype(np.float32),
        "integers": values.astype(np.int32),
        "list": values.tolist(),
    }[how]
    if how == "read-only":
        same.flags.writeable = False
    window, plain = AllanWindow(LENGTH, FACTORS), AllanWindow(LENGTH, FACTORS)
    plain.update(values)
    window.update(same)
    assert_same(window, plain)
    assert len(window_module._advance.signatures) == 1
    assert how == "list" or same is not values


def test_updating_leaves_the_caller_s_array_writable():
    values = made(10)
    AllanWindow(LENGTH, FACTORS).update(values)
    assert values.flags.writeable


@pytest.mark.parametrize("shape", [(10, 5), (10, 7), (6,), (10, 6, 1)])
def test_a_wrong_shape_is_refused(shape):
    with pytest.raises(ValueError, match=r"\[n, 6\]"):
        AllanWindow(LENGTH, FACTORS).update(np.zeros(shape))
