"""The fading window equals its definition, written with NumPy over the whole record, whatever the cut and the gaps."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import ConfigError
from monitor.estimation.allan import fading as fading_module
from monitor.estimation.allan.batch import overlapping_avar
from monitor.estimation.allan.fading import FadingWindow
from monitor.estimation.allan.window import FULL_SCALE
from monitor.noise.effects.bias_instability import BiasInstability
from monitor.noise.effects.rate_random_walk import RateRandomWalk
from monitor.noise.model import NoiseModel

FACTORS = np.array([1, 2, 3, 7, 8, 15, 16, 26, 40, 64])
MEMORY = 300.0
GRAVITY = np.array([0.0, 0.0, 0.01, 0.0, 0.0, 9.81])


def made(n, seed=0, noise=1e-4):
    return noise * np.random.default_rng(seed).standard_normal((n, 6)) + GRAVITY


def broken(n, seed=0):
    """Noise with single samples, an axis and a stretch of all axes missing."""
    values = made(n, seed)
    values[np.random.default_rng(seed + 1).choice(n, n // 90, replace=False)] = np.nan
    values[n // 2 : n // 2 + 9, 3] = np.nan
    values[n // 3 : n // 3 + 5] = np.nan
    return values


def stride_of(m):
    return 1 if m < 16 else 2 ** int(np.floor(np.log2(m / 8)))


def defined(values, m, memory, poles):
    """Σ w d² / (2 m² Σ w) and (Σ w)²/Σ w² over the terms that end at multiples of the stride; ages in strides."""
    absent = np.isnan(values)
    rates = np.where(absent, 0.0, values - np.nanmean(values, axis=0))
    phase = np.concatenate([np.zeros((1, 6)), np.cumsum(rates, axis=0)])
    gaps = np.concatenate([np.zeros((1, 6)), np.cumsum(absent, axis=0)])
    stride = stride_of(m)
    ends = np.arange(-(-2 * m // stride) * stride, len(phase), stride)
    if ends.size == 0:
        return np.full(6, np.nan), np.zeros(6)
    d = phase[ends] - 2 * phase[ends - m] + phase[ends - 2 * m]
    age = (ends[-1] - ends) / stride
    weights = ((1.0 + age) ** (poles - 1) * np.exp(-2.0 * poles * stride * age / memory))[:, None]
    weights = np.where(gaps[ends] == gaps[ends - 2 * m], weights, 0.0)
    total = weights.sum(axis=0)
    with np.errstate(invalid="ignore"):
        return (weights * d**2).sum(axis=0) / (2.0 * m * m * total), total**2 / (weights**2).sum(axis=0)


def check(window, values, rel=1e-9):
    avar, terms = zip(*(defined(values, m, window.memory, window.poles) for m in window.factors), strict=True)
    avar, terms = np.array(avar), np.nan_to_num(np.array(terms))
    found = window.avar()
    assert np.array_equal(np.isnan(found), np.isnan(avar))
    np.testing.assert_allclose(window.terms(), terms, rtol=1e-9)
    # the unit of the integer phase, seen where one or two small terms are all there is
    unit = 2.0 / window._scale / window.factors[:, None]
    within = rel * avar + 2.0 * np.sqrt(avar / np.maximum(terms, 1.0)) * unit + unit**2
    assert (np.isnan(avar) | (np.abs(found - avar) <= within)).all(), np.nanmax(np.abs(found - avar) / within)


def assert_same(one, other):
    assert np.array_equal(one.avar(), other.avar(), equal_nan=True)
    assert np.array_equal(one.terms(), other.terms())
    assert one.total == other.total


# --- one truth, whatever the cut


@pytest.mark.parametrize("poles", [1, 2])
@pytest.mark.parametrize("make", [made, broken])
def test_every_position_equals_the_definition(poles, make):
    values = make(500)
    window = FadingWindow(FACTORS, MEMORY, poles)
    for i in range(len(values)):
        window.update(values[i : i + 1])
        if i < 40 or i % 7 == 0:
            check(window, values[: i + 1])


@pytest.mark.parametrize("poles", [1, 2])
def test_a_long_run_equals_the_definition(poles):
    values = broken(60_000, seed=4)
    factors = 2 ** np.arange(12)
    window = FadingWindow(factors, 8192.0, poles)
    window.update(values)
    check(window, values)


@settings(max_examples=30, deadline=None)
@given(
    cuts=st.lists(st.integers(0, 1500), max_size=12),
    holes=st.lists(st.tuples(st.integers(0, 1490), st.integers(1, 160), st.integers(0, 6)), max_size=5),
    poles=st.sampled_from([1, 2]),
)
def test_blocks_of_any_cut_are_one_by_one_bit_for_bit(cuts, holes, poles):
    values = made(1500, seed=len(cuts))
    for at, n, axis in holes:
        values[at : at + n, slice(None) if axis == 6 else axis] = np.nan
    cut, single = FadingWindow(FACTORS, MEMORY, poles), FadingWindow(FACTORS, MEMORY, poles)
    for a, b in pairwise([0, *sorted(cuts), len(values)]):
        cut.update(values[a:b])
    for row in values:
        single.update(row[None])
    assert_same(cut, single)
    check(cut, values)


# --- missing samples


@pytest.mark.parametrize("poles", [1, 2])
@pytest.mark.parametrize("n", [0, 1, 15, 64, 333, 2000])
@pytest.mark.parametrize("before", [3, 640])
def test_skipping_is_that_many_missing_rows(n, poles, before):
    values = made(before + 400)
    skipped, missing = FadingWindow(FACTORS, MEMORY, poles), FadingWindow(FACTORS, MEMORY, poles)
    for window in (skipped, missing):
        window.update(values[:before])
    skipped.skip(n)
    missing.update(np.full((n, 6), np.nan))
    for start, end in ((0, 0), (0, 1), (1, 60), (60, 400)):
        for window in (skipped, missing):
            window.update(values[before + start : before + end])
        assert skipped.total == missing.total
        np.testing.assert_allclose(skipped.avar(), missing.avar(), rtol=1e-10)
        np.testing.assert_allclose(skipped.terms(), missing.terms(), rtol=1e-10)


def test_a_gap_makes_the_past_weigh_less():
    """Two levels with a gap between: the mean leans to the newer one by the age that the gap adds."""
    window, gapped = FadingWindow(np.array([1]), 1000.0), FadingWindow(np.array([1]), 1000.0)
    for one in (window, gapped):
        one.update(made(3000))
    gapped.skip(1000)
    for one in (window, gapped):
        one.update(made(500, seed=1, noise=3e-4))
    share = (window.avar()[0] / gapped.avar()[0]).mean()
    # weights of the past e^-1 and e^-3 at variances 1 and 9
    expected = (9 - 8 * np.exp(-1.0)) / (9 - 8 * np.exp(-3.0))
    assert share == pytest.approx(expected, rel=0.04)


@pytest.mark.parametrize("n", [10**7, 10**15])
def test_an_outage_beyond_all_weights_leaves_nothing(n):
    window = FadingWindow(FACTORS, MEMORY, 2)
    window.update(made(2000))
    window.skip(n)
    assert np.isnan(window.avar()).all()
    assert not window.terms().any()
    fresh = made(640, seed=3)
    window.update(fresh)
    plain = FadingWindow(FACTORS, MEMORY, 2)
    plain.skip(int((n + 2000) % 64))  # the same places of the strides
    plain.update(fresh)
    np.testing.assert_allclose(window.avar(), plain.avar(), rtol=1e-8)


def test_an_axis_that_is_never_measured():
    values = made(500)
    values[:, 4] = np.nan
    window = FadingWindow(FACTORS, MEMORY)
    window.update(values)
    assert np.isnan(window.avar()[:, 4]).all()
    assert not window.terms()[:, 4].any()
    assert np.isnan(window.edf("white")[:, 4]).all()
    assert np.isfinite(window.avar()[:, :4]).all()


# --- what comes fades


@pytest.mark.parametrize(("poles", "memories"), [(1, 28), (2, 16)])
@pytest.mark.parametrize("height", [1e-4 * 1e6, 4000.0])
def test_a_transient_fades_and_leaves_nothing_else(poles, memories, height):
    """10⁶ times the noise, its square 10¹²: e^-50 of one pole takes 25 memories; the sums keep no rounding of it."""
    n = int(memories * MEMORY) + 2 * int(FACTORS[-1])
    values, calm = made(2000 + n, seed=2), made(2000 + n, seed=2)
    values[2000] += height
    window, plain = FadingWindow(FACTORS, MEMORY, poles), FadingWindow(FACTORS, MEMORY, poles)
    window.update(values[:2001])
    assert window.avar()[0, 0] > 1e-6
    window.update(values[2001:])
    plain.update(calm)
    np.testing.assert_allclose(window.avar(), plain.avar(), rtol=2e-9)


@pytest.mark.parametrize("wrong", [1e300, np.inf, -np.inf, np.nan])
def test_what_phase_cannot_hold_counts_as_missing(wrong):
    values, missing = made(400), made(400)
    values[220, 4], missing[220, 4] = wrong, np.nan
    window, other = FadingWindow(FACTORS, MEMORY), FadingWindow(FACTORS, MEMORY)
    window.update(values)
    other.update(missing)
    assert_same(window, other)


def test_full_scale_square_wave_at_the_longest_tau_does_not_overflow():
    m = 4096
    sign = np.where(np.arange(8 * m) // m % 2, 1.0, -1.0)[:, None]
    window = FadingWindow(np.array([1, m]), 3.0 * m)
    window.update(sign * np.array(FULL_SCALE[:6]))
    assert (window.avar()[1] > 0.5 * np.array(FULL_SCALE[:6]) ** 2).all()
    assert (window.avar()[1] < 2.01 * np.array(FULL_SCALE[:6]) ** 2).all()


# --- the mean, and how sure it is


def test_a_slope_gives_its_own_variance_from_the_first_term_on():
    """A ramp has one d² for all terms, R² m⁴: any bias of the start would show. σ² = R² τ²/2 (IEEE Std 952)."""
    slope = np.array([1e-3, -2e-3, 1e-5, 1e-2, 3e-3, -1e-3])
    for poles in (1, 2):
        window = FadingWindow(FACTORS, MEMORY, poles)
        values = np.arange(1000)[:, None] * slope
        for i in range(0, 1000, 8):
            window.update(values[i : i + 8])
            truth = 0.5 * (FACTORS[:, None] * slope) ** 2
            there = np.where(i + 8 >= 2 * FACTORS, 1.0, np.nan)[:, None]
            np.testing.assert_allclose(window.avar(), truth * there, rtol=1e-9)


def test_a_constant_axis_has_no_noise():
    window = FadingWindow(FACTORS, MEMORY)
    window.update(np.tile([0.1, 0.0, 0.3, 9.81, 1.0 / 3.0, 0.7], (3000, 1)))
    assert (window.avar() == 0.0).all()


@pytest.mark.parametrize("poles", [1, 2])
def test_effective_terms_are_the_memory(poles):
    window = FadingWindow(np.array([1, 64]), 4096.0, poles)
    window.update(made(40_000))
    np.testing.assert_allclose(window.terms()[0], 4096.0, rtol=2e-3)
    np.testing.assert_allclose(window.terms()[1], 4096.0 / 8, rtol=2e-3)


def scatter(kind, n, records, seed):
    """Records of one power law, six axes each."""
    rng = np.random.default_rng(seed)
    for k in range(records // 6):
        if kind == "white":
            yield rng.standard_normal((n, 6))
        else:
            source = BiasInstability(B=1.0) if kind == "flicker" else RateRandomWalk(K=1.0)
            yield NoiseModel(dict.fromkeys(("gx", "gy", "gz", "ax", "ay", "az"), (source,))).simulate(n, 1.0, seed + k)


@pytest.mark.long
@pytest.mark.parametrize("poles", [1, 2])
@pytest.mark.parametrize("kind", ["white", "flicker", "walk"])
def test_degrees_of_freedom_are_those_of_simulated_records(kind, poles):
    """edf = 2 E² / Var of the estimates. Its own scatter over 2400 is 3 %, more where they are few."""
    factors = np.array([1, 4, 16, 48])
    found = []
    for values in scatter(kind, 2600, 2400, seed=17):
        window = FadingWindow(factors, 512.0, poles)
        window.update(values * 1e-3)
        found.append(window.avar())
    every = np.concatenate(found, axis=1)
    measured = 2.0 * every.mean(axis=1) ** 2 / every.var(axis=1)
    np.testing.assert_allclose(measured, window.edf(kind)[:, 0], rtol=0.15)


def test_the_stride_costs_less_than_two_percent():
    """Degrees of freedom at the stride over those of every sample, which the exact covariance tells."""
    for reach in range(8, 16):
        for noise in ("white", "flicker", "walk"):
            m, memory = 32.0 * reach, 32_000.0 * reach
            per_sample = [
                1.0 / stride / fading_module._shared(m, stride, np.exp(-2.0 * stride / memory), 1, noise)
                for stride in (32.0, 1.0)
            ]
            assert 0.98 < per_sample[0] / per_sample[1] <= 1.001


def test_white_noise_of_a_long_memory_is_the_batch_s():
    values = made(40_000, seed=9)
    factors = 2 ** np.arange(9)
    window = FadingWindow(factors, 1e9)
    window.update(values)
    np.testing.assert_allclose(window.avar(), overlapping_avar(values, factors)[0], rtol=0.03)


# --- life


def test_growing_and_reset():
    window, fresh = FadingWindow(FACTORS, MEMORY), FadingWindow(FACTORS, MEMORY)
    assert np.isnan(window.avar()).all()
    window.update(made(777))
    window.reset()
    assert window.total == 0
    assert np.isnan(window.avar()).all()
    for one in (window, fresh):
        one.update(made(500, seed=3))
    assert_same(window, fresh)


@pytest.mark.parametrize(
    ("factors", "memory", "poles"),
    [
        ([1], 99.0, 1),
        ([1], 2.0**41, 1),
        ([1], np.nan, 1),
        ([1], 100.0, 3),
        ([1], 100.0, 0),
        ([], 100.0, 1),
        ([0, 1], 100.0, 1),
        ([1, 51], 100.0, 1),
        ([2, 2], 100.0, 1),
        ([4, 2], 100.0, 1),
        ([17], 100.0, 1),
        ([33], 100.0, 1),
    ],
)
def test_impossible_windows_are_refused(factors, memory, poles):
    with pytest.raises(ConfigError):
        FadingWindow(np.array(factors, np.int64), memory, poles)


def test_the_nearest_possible_cluster_is_named():
    with pytest.raises(ConfigError, match="101 is no multiple of 8; the nearest is 104"):
        FadingWindow(np.array([1, 101]), 1000.0)


@pytest.mark.parametrize("shape", [(10, 5), (6,), (10, 6, 1)])
def test_a_wrong_shape_is_refused(shape):
    with pytest.raises(ValueError, match=r"\[n, 6\]"):
        FadingWindow(FACTORS, MEMORY).update(np.zeros(shape))


def test_a_month_at_a_kilohertz_takes_kilobytes():
    window = FadingWindow(2 ** np.arange(30), 30 * 86_400 * 1000.0)
    held = sum(array.nbytes for array in vars(window).values() if isinstance(array, np.ndarray))
    assert held < 150_000
    window.update(made(2000))
    np.testing.assert_allclose(window.avar()[0], overlapping_avar(made(2000), np.array([1]))[0][0], rtol=1e-3)
