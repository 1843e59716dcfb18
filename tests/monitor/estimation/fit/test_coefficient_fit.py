"""Tests of the coefficient fit: exact curves, coverage of intervals, absent terms and filtered noise."""

from dataclasses import replace
from functools import cache
from weakref import ref

import numpy as np
import pytest
from scipy.signal import butter, sosfilt
from scipy.stats import binom

from drivers.data_types import AXES
from monitor.estimation.allan.batch import (
    cluster_sizes,
    overlapping_allan_variances,
    overlapping_avar,
    rate_slope_from_thirds,
)
from monitor.estimation.allan.uncertainty import covariance_table, deviation_intervals
from monitor.estimation.fit.coefficient_fit import (
    Fit,
    MeasuredVariancesAndSlopes,
    fit_coefficients,
    make_design_matrix,
    make_shared_inputs,
)
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.estimation.fit.fit_kernel import MIN_ROWS
from monitor.noise.effect import Source
from monitor.noise.effects import AngleRandomWalk, BiasInstability, QuantizationNoise, RateRamp, RateRandomWalk
from monitor.noise.model import NoiseModel
from monitor.noise.standard_terms import UNIT_SOURCES

RATE_HZ = 100.0
MIX: tuple[Source, ...] = (
    QuantizationNoise(Q=2e-6),
    AngleRandomWalk(N=1.5e-4),
    BiasInstability(B=1e-4),
    RateRandomWalk(K=3e-5),
)
TRUE_COEFFICIENTS = np.array([2e-6, 1.5e-4, 1e-4, 3e-5, 0.0])
SAMPLES = 60_000
RECORDINGS = 144


def fit_values(values: np.ndarray, with_slope: bool = True, **more) -> Fit:
    factors = cluster_sizes(len(values), RATE_HZ)
    avar, terms, excess = overlapping_allan_variances(values, factors)
    slope = rate_slope_from_thirds(values) * RATE_HZ if with_slope else None
    measured = MeasuredVariancesAndSlopes(avar, terms, slope, excess=excess)
    return fit_coefficients(
        make_design_matrix(factors, RATE_HZ), covariance_table(len(values), factors), measured, **more
    )


@cache
def fit_simulations(sources: tuple[Source, ...], with_slope: bool = True) -> tuple[list[Fit], np.ndarray]:
    """Return the fits and the Allan variances [runs, m, 6] of RECORDINGS axes."""
    model = NoiseModel(dict.fromkeys(AXES, sources))
    fits, deviations = [], []
    for seed in range(RECORDINGS // 6):
        values = model.simulate(SAMPLES, RATE_HZ, seed)
        fits.append(fit_values(values, with_slope))
        deviations.append(overlapping_avar(values, cluster_sizes(SAMPLES, RATE_HZ))[0])
    return fits, np.array(deviations)


def collect_field(fits: list[Fit], field: str) -> np.ndarray:
    return np.concatenate([getattr(fit.coefficients, field) for fit in fits], axis=1)


def fit_exact_curve(theta: np.ndarray, n: int = SAMPLES) -> Fit:
    """Fit the exact curve of a model, which is the same on six axes."""
    factors = cluster_sizes(n, RATE_HZ)
    avar = sum(t * s.avar(factors / RATE_HZ, 1.0 / RATE_HZ) for t, s in zip(theta, UNIT_SOURCES, strict=True))
    t = covariance_table(n, factors)
    columns = np.repeat(avar[:, None], 6, axis=1)
    return fit_coefficients(
        make_design_matrix(factors, RATE_HZ),
        t,
        MeasuredVariancesAndSlopes(columns, np.repeat(t.terms[:, None], 6, axis=1)),
    )


def test_exact_curve_gives_its_coefficients():
    result = fit_exact_curve(TRUE_COEFFICIENTS**2)
    np.testing.assert_allclose(result.theta[:4, 0], TRUE_COEFFICIENTS[:4] ** 2, rtol=1e-9)
    assert (result.coefficients.status[:4] == Status.ESTIMATED).all()
    np.testing.assert_allclose(result.coefficients.value[:4, 3], TRUE_COEFFICIENTS[:4], rtol=1e-9)
    assert (result.coefficients.lo[:4] < TRUE_COEFFICIENTS[:4, None]).all()
    assert (result.coefficients.hi[:4] > TRUE_COEFFICIENTS[:4, None]).all()


def test_coefficients_scale_with_the_unit():
    fit, tenfold = fit_exact_curve(TRUE_COEFFICIENTS**2), fit_exact_curve(100.0 * TRUE_COEFFICIENTS**2)
    for field in ("value", "lo", "hi"):
        np.testing.assert_allclose(getattr(tenfold.coefficients, field), 10.0 * getattr(fit.coefficients, field))
    np.testing.assert_array_equal(fit.coefficients.status, tenfold.coefficients.status)


def test_values_and_bounds_agree_with_the_status():
    fits, _ = fit_simulations(MIX)
    status, value, lo, hi = (collect_field(fits, f) for f in ("status", "value", "lo", "hi"))
    assert (np.isfinite(value) == (status == Status.ESTIMATED)).all()
    assert (np.isfinite(hi) == (status != Status.UNESTIMATED)).all()
    assert (lo[status == Status.UPPER_BOUND] == 0.0).all()
    inside = status == Status.ESTIMATED
    assert ((lo <= value) & (value <= hi))[inside].all()
    assert (hi[status != Status.UNESTIMATED] > 0.0).all()


@pytest.mark.parametrize("row", range(4))
def test_intervals_of_coefficients_have_the_stated_coverage(row):
    fits, _ = fit_simulations(MIX)
    covered = (collect_field(fits, "lo")[row] <= TRUE_COEFFICIENTS[row]) & (
        TRUE_COEFFICIENTS[row] <= collect_field(fits, "hi")[row]
    )
    # The coverage is 92 to 98 % for a single τ or letter. One count in 1000 falls outside these limits.
    assert covered.sum() >= binom.ppf(0.0005, RECORDINGS, 0.92), SYMBOLS[row]


def remove_samples(values: np.ndarray, share: float, burst: int = 1, seed: int = 0) -> np.ndarray:
    """Replace bursts of samples by NaN, on all axes together."""
    rng, present = np.random.default_rng(seed), np.ones(len(values), bool)
    for begin in np.flatnonzero(rng.random(len(values)) < share / burst):
        present[begin : begin + burst] = False
    return np.where(present[:, None], values, np.nan)


@pytest.mark.parametrize(
    ("share", "burst", "wider"), [(0.001, 1, 1.05), (0.01, 1, 1.10), (0.05, 1, 1.25), (0.01, 10, 1.25)]
)
def test_random_loss_hardly_widens_the_intervals(share, burst, wider):
    """When each difference with a missing sample was left out, the interval of K was 4 to 60 times as wide."""
    widths = []
    for lost in (0.0, share):
        fits = [
            fit_values(
                remove_samples(NoiseModel(dict.fromkeys(AXES, MIX)).simulate(SAMPLES, RATE_HZ, seed), lost, burst)
            )
            for seed in range(4)
        ]
        widths.append(np.median(collect_field(fits, "hi") - collect_field(fits, "lo"), axis=1)[1:4])
    assert (widths[1] < wider * widths[0]).all()


@pytest.mark.long
def test_intervals_keep_their_coverage_if_samples_are_missing():
    cases = [(*loss, slope) for loss in ((0.02, 1), (0.1, 1), (0.2, 1), (0.02, 10)) for slope in (0.0, 1e-5)]
    model, ramp = NoiseModel(dict.fromkeys(AXES, MIX)), np.arange(SAMPLES)[:, None] / RATE_HZ
    fits = {case: [] for case in cases}
    for seed in range(RECORDINGS // 6):
        values = model.simulate(SAMPLES, RATE_HZ, seed)
        for share, burst, slope in cases:
            fits[share, burst, slope].append(fit_values(remove_samples(values + slope * ramp, share, burst, seed)))
    for case, found in fits.items():
        lo, hi = collect_field(found, "lo"), collect_field(found, "hi")
        for row in range(1, 4):
            covered = (lo[row] <= TRUE_COEFFICIENTS[row]) & (TRUE_COEFFICIENTS[row] <= hi[row])
            assert covered.sum() >= binom.ppf(0.0005, RECORDINGS, 0.92), (SYMBOLS[row], case)
        assert np.isfinite(hi[4]).all(), case


def test_intervals_of_deviations_have_the_stated_coverage():
    fits, measured = fit_simulations(MIX)
    factors = cluster_sizes(SAMPLES, RATE_HZ)
    truth = sum(source.avar(factors / RATE_HZ, 1.0 / RATE_HZ) for source in MIX)[:, None]
    covered = []
    for fit, avar in zip(fits, measured, strict=True):
        lo, hi = deviation_intervals(avar, fit.edf)
        covered.append((lo**2 <= truth) & (truth <= hi**2))
    short = np.array(covered)[:, factors <= SAMPLES // 8]
    for share in short.mean(axis=(0, 2)):
        assert binom.ppf(0.0005, RECORDINGS, 0.94) <= share * RECORDINGS <= binom.ppf(0.9995, RECORDINGS, 0.97)
    assert short.mean() == pytest.approx(0.95, abs=0.02)


def test_errors_are_close_to_the_cramer_rao_bound():
    fits, _ = fit_simulations(MIX)
    f = np.arange(1, SAMPLES // 2) * (RATE_HZ / SAMPLES)
    spectra = np.stack([source.two_sided_psd(f, 1.0 / RATE_HZ) for source in MIX])
    shares = spectra / spectra.sum(0)
    limit = 0.5 * np.sqrt(np.diag(np.linalg.inv(shares @ shares.T)))
    theta = np.concatenate([fit.theta for fit in fits], axis=1)[:4]
    error = np.sqrt(np.mean((np.sqrt(np.maximum(theta, 0.0)) / TRUE_COEFFICIENTS[:4, None] - 1.0) ** 2, axis=1))
    assert (error < 1.35 * limit).all(), error / limit


@pytest.mark.long
@pytest.mark.parametrize("absent", ["Q", "B", "K"])
def test_absent_term_seldom_enters_the_fit(absent):
    fits, _ = fit_simulations(tuple(source for source in MIX if not hasattr(source, absent)))
    entered = (collect_field(fits, "status")[SYMBOLS.index(absent)] == Status.ESTIMATED).sum()
    assert entered <= binom.ppf(0.999, RECORDINGS, 0.04)


def test_random_walk_is_not_taken_for_a_ramp():
    fits, _ = fit_simulations(MIX)
    assert (collect_field(fits, "status")[4] == Status.ESTIMATED).sum() <= binom.ppf(0.999, RECORDINGS, 0.02)


@pytest.mark.long
def test_ramp_is_found_and_not_taken_for_random_walk():
    sources = (*MIX[:3], RateRamp(R=5e-6))
    with_slope, _ = fit_simulations(sources)
    without, _ = fit_simulations(sources, with_slope=False)
    status = collect_field(with_slope, "status")
    assert (status[4] == Status.ESTIMATED).mean() > 0.9
    covered = (collect_field(with_slope, "lo")[4] <= 5e-6) & (collect_field(with_slope, "hi")[4] >= 5e-6)
    assert covered.sum() >= binom.ppf(0.0005, RECORDINGS, 0.95)
    false_walk = [(collect_field(x, "status")[3] == Status.ESTIMATED).mean() for x in (with_slope, without)]
    assert false_walk[0] < 0.2 < 0.5 < false_walk[1]


@pytest.mark.parametrize("cutoff_hz", [10.0, 20.0, 30.0, 40.0])
def test_low_pass_of_the_sensor_does_not_bias_the_coefficients(cutoff_hz):
    model = NoiseModel(dict.fromkeys(AXES, (AngleRandomWalk(N=1.5e-4), BiasInstability(B=2e-4))))
    wide = model.simulate(120_000, RATE_HZ, 5)
    narrow = sosfilt(butter(2, cutoff_hz / (RATE_HZ / 2.0), output="sos"), wide, axis=0)
    result = fit_values(narrow)
    # A narrower filter leaves fewer τ for N, so its standard deviation rises from 0.5 % at 40 Hz to 2 % at 10 Hz.
    np.testing.assert_allclose(result.coefficients.value[1], 1.5e-4, rtol=0.04 if cutoff_hz > 10.0 else 0.08)
    np.testing.assert_allclose(result.coefficients.value[2], 2e-4, rtol=0.25)
    assert (result.coefficients.status[0] == Status.UPPER_BOUND).all()
    assert (result.left_out >= 1).all()
    drawn = np.arange(len(result.fitted))[:, None] >= result.left_out
    np.testing.assert_array_equal(np.isfinite(result.fitted), drawn)
    assert np.isfinite(result.edf).all()
    assert (fit_values(wide).left_out == 0).all()


def test_hysteresis_delays_adding_and_removing_terms():
    theta = np.array([0.0, 1.5e-4, 4e-5, 0.0, 0.0]) ** 2
    never, always = np.zeros((5, 6), bool), np.ones((5, 6), bool)
    factors = cluster_sizes(SAMPLES, RATE_HZ)
    t = covariance_table(SAMPLES, factors)
    # Between 1.5 and 3 σ, a term keeps its state. The loop searches for such a value of B.
    entered = []
    for b in np.linspace(1e-5, 1e-4, 60):
        theta[2] = b**2
        avar = sum(x * s.avar(factors / RATE_HZ, 1.0 / RATE_HZ) for x, s in zip(theta, UNIT_SOURCES, strict=True))
        measured = MeasuredVariancesAndSlopes(np.repeat(avar[:, None], 6, 1), np.repeat(t.terms[:, None], 6, 1))
        both = [replace(measured, entered_before=before) for before in (never, always)]
        entered.append([fit_coefficients(make_design_matrix(factors, RATE_HZ), t, m).entered[2, 0] for m in both])
    entered = np.array(entered)
    assert (entered[:, 1] >= entered[:, 0]).all()
    assert not entered[0].any()
    assert entered[-1].all()
    assert (entered[:, 1] & ~entered[:, 0]).sum() >= 3
    assert not never.any()  # the input is not modified
    assert always.all()


def test_too_few_tau_give_no_coefficients_but_degrees_of_freedom():
    factors = 2 ** np.arange(MIN_ROWS - 1)
    values = np.random.default_rng(0).standard_normal((64, 6))
    avar, terms = overlapping_avar(values, factors)
    result = fit_coefficients(
        make_design_matrix(factors, RATE_HZ), covariance_table(64, factors), MeasuredVariancesAndSlopes(avar, terms)
    )
    assert (result.coefficients.status == Status.UNESTIMATED).all()
    assert np.isnan(result.coefficients.hi).all()
    assert np.isnan(result.fitted).all()
    assert result.edf[0, 0] == pytest.approx(2.0 / 3.0 * 63, rel=0.03)


@pytest.mark.parametrize("constant", [np.nan, 0.0])
def test_dead_axis_does_not_affect_other_axes(constant):
    values = NoiseModel(dict.fromkeys(AXES, MIX)).simulate(20_000, RATE_HZ, 1)
    expected = fit_values(values, with_slope=False)
    values[:, 2] = constant
    result = fit_values(values, with_slope=False)
    assert (result.coefficients.status[:, 2] == Status.UNESTIMATED).all()
    assert np.isnan(result.edf[:, 2]).all()
    for axis in (0, 1, 3, 4, 5):
        np.testing.assert_array_equal(result.coefficients.value[:, axis], expected.coefficients.value[:, axis])


def test_gaps_reduce_degrees_of_freedom():
    values = NoiseModel(dict.fromkeys(AXES, MIX)).simulate(20_000, RATE_HZ, 1)
    whole = fit_values(values, with_slope=False)
    values[9_000:9_500] = np.nan
    factors = cluster_sizes(20_000, RATE_HZ)
    gapped = fit_values(values, with_slope=False)
    assert (gapped.edf[factors <= 1024] < whole.edf[factors <= 1024]).all()
    np.testing.assert_allclose(gapped.theta[1], whole.theta[1], rtol=0.05)


def test_fitted_curve_follows_the_measured_curve():
    fits, measured = fit_simulations(MIX)
    factors = cluster_sizes(SAMPLES, RATE_HZ)
    ratio = measured / np.array([fit.fitted for fit in fits])
    # The longest τ has 15 degrees of freedom, so the mean over RECORDINGS scatters by 3 %.
    np.testing.assert_allclose(np.mean(ratio, axis=(0, 2))[factors <= SAMPLES // 8], 1.0, atol=0.1)
    np.testing.assert_allclose(np.mean(ratio, axis=(0, 2))[factors <= SAMPLES // 128], 1.0, atol=0.02)


def test_line_is_not_taken_for_a_filter():
    values = NoiseModel(dict.fromkeys(AXES, MIX)).simulate(SAMPLES, RATE_HZ, 3)
    line = 5e-4 * np.sin(2.0 * np.pi * 0.565 * np.arange(SAMPLES) / RATE_HZ)
    result = fit_values(values + line[:, None])
    assert (result.left_out == 0).all()
    # the line does not affect the shortest τ, which still determine N
    np.testing.assert_allclose(result.coefficients.value[1], 1.5e-4, rtol=0.12)


def test_coefficients_stay_below_the_curve_for_an_unsuitable_model():
    # A strong line at 0.5 Hz over white noise does not fit the terms. No term may exceed the limits of the curve.
    t = np.arange(400_000) / 100.0
    values = 1e-3 * np.random.default_rng(5).standard_normal((t.size, 6)) + 0.05 * np.sin(np.pi * t)[:, None]
    factors = cluster_sizes(t.size, 100.0)
    avar, terms = overlapping_avar(values, factors)
    columns = make_design_matrix(factors, 100.0)
    found = fit_coefficients(columns, covariance_table(t.size, factors), MeasuredVariancesAndSlopes(avar, terms))
    assert (found.misfit > 1.0).all()
    c = found.coefficients
    for axis in range(6):
        for letter, power in zip(range(5), (-2, -1, 0, 1, 2), strict=True):
            if c.status[letter, axis] == Status.UNESTIMATED:
                continue
            shape = columns.columns[:, letter] * 100.0 ** (-power)  # σ² for a coefficient of 1 in SI units
            upper_limit = np.sqrt((2.5 * avar[:, axis] / shape)[:12].min())  # only τ with many degrees of freedom
            assert c.hi[letter, axis] <= upper_limit * 1.01
            if c.status[letter, axis] == Status.ESTIMATED:
                assert 0.0 < c.lo[letter, axis] < c.value[letter, axis] < c.hi[letter, axis]


def test_inputs_of_a_repeated_fit_are_kept_as_long_as_their_table():
    factors = cluster_sizes(1000, RATE_HZ)
    design, other = make_design_matrix(factors, RATE_HZ), make_design_matrix(factors, 2.0 * RATE_HZ)
    table = covariance_table(1000, factors)
    assert make_shared_inputs(design, table).flat is make_shared_inputs(design, table).flat
    assert make_shared_inputs(other, table).columns is other.columns
    covariance = ref(table.covariance)
    del table
    assert covariance() is None
