"""The fit: exact curves, intervals counted over simulations, terms that are not there, sensors' own filters."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import butter, sosfilt
from scipy.stats import binom

from drivers.data_types import AXES
from monitor.estimation.allan.batch import cluster_sizes, overlapping_avar, rate_slope_from_thirds
from monitor.estimation.allan.uncertainty import covariance_table, deviation_intervals
from monitor.estimation.fit.coefficient_fit import Fit, MeasuredVariancesAndSlopes, fit_coefficients, make_design_matrix
from monitor.estimation.fit.coefficient_values import SYMBOLS, Status
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
TRUTH = np.array([2e-6, 1.5e-4, 1e-4, 3e-5, 0.0])
N = 60_000
RECORDS = 144


def fit_values(values: np.ndarray, with_slope: bool = True, **more) -> Fit:
    factors = cluster_sizes(len(values), RATE_HZ)
    avar, terms = overlapping_avar(values, factors)
    slope = rate_slope_from_thirds(values) * RATE_HZ if with_slope else None
    measured = MeasuredVariancesAndSlopes(avar, terms, slope)
    return fit_coefficients(
        make_design_matrix(factors, RATE_HZ), covariance_table(len(values), factors), measured, **more
    )


@cache
def fits(sources: tuple[Source, ...], with_slope: bool = True) -> tuple[list[Fit], np.ndarray]:
    """Fits and deviations [runs, m, 6] of RECORDS records."""
    model = NoiseModel(dict.fromkeys(AXES, sources))
    looked, deviations = [], []
    for seed in range(RECORDS // 6):
        values = model.simulate(N, RATE_HZ, seed)
        looked.append(fit_values(values, with_slope))
        deviations.append(overlapping_avar(values, cluster_sizes(N, RATE_HZ))[0])
    return looked, np.array(deviations)


def gather(looked: list[Fit], field: str) -> np.ndarray:
    return np.concatenate([getattr(one.coefficients, field) for one in looked], axis=1)


def exact_curve(theta: np.ndarray, n: int = N) -> Fit:
    """The fit of the curve of a model itself, the same on six axes."""
    factors = cluster_sizes(n, RATE_HZ)
    avar = sum(t * s.avar(factors / RATE_HZ, 1.0 / RATE_HZ) for t, s in zip(theta, UNIT_SOURCES, strict=True))
    t = covariance_table(n, factors)
    columns = np.repeat(avar[:, None], 6, axis=1)
    return fit_coefficients(
        make_design_matrix(factors, RATE_HZ),
        t,
        MeasuredVariancesAndSlopes(columns, np.repeat(t.terms[:, None], 6, axis=1)),
    )


def test_an_exact_curve_gives_its_coefficients_back():
    result = exact_curve(TRUTH**2)
    np.testing.assert_allclose(result.theta[:4, 0], TRUTH[:4] ** 2, rtol=1e-9)
    assert (result.coefficients.status[:4] == Status.ESTIMATED).all()
    np.testing.assert_allclose(result.coefficients.value[:4, 3], TRUTH[:4], rtol=1e-9)
    assert (result.coefficients.lo[:4] < TRUTH[:4, None]).all()
    assert (result.coefficients.hi[:4] > TRUTH[:4, None]).all()


def test_coefficients_scale_with_the_unit_and_with_the_rate():
    one, tenfold = exact_curve(TRUTH**2), exact_curve(100.0 * TRUTH**2)
    for field in ("value", "lo", "hi"):
        np.testing.assert_allclose(getattr(tenfold.coefficients, field), 10.0 * getattr(one.coefficients, field))
    np.testing.assert_array_equal(one.coefficients.status, tenfold.coefficients.status)


def test_every_number_has_a_status():
    looked, _ = fits(MIX)
    status, value, lo, hi = (gather(looked, f) for f in ("status", "value", "lo", "hi"))
    assert (np.isfinite(value) == (status == Status.ESTIMATED)).all()
    assert (np.isfinite(hi) == (status != Status.UNESTIMATED)).all()
    assert (lo[status == Status.UPPER_BOUND] == 0.0).all()
    inside = status == Status.ESTIMATED
    assert ((lo <= value) & (value <= hi))[inside].all()
    assert (hi[status != Status.UNESTIMATED] > 0.0).all()


@pytest.mark.parametrize("row", range(4))
def test_intervals_hold_the_truth_as_often_as_they_say(row):
    looked, _ = fits(MIX)
    held = (gather(looked, "lo")[row] <= TRUTH[row]) & (TRUTH[row] <= gather(looked, "hi")[row])
    # 95 % two-sided, up to 98 or down to 92 for one τ or letter; one in 1000 counts falls outside
    assert held.sum() >= binom.ppf(0.0005, RECORDS, 0.92), SYMBOLS[row]


def test_intervals_of_deviations_hold_the_truth():
    looked, measured = fits(MIX)
    factors = cluster_sizes(N, RATE_HZ)
    truth = sum(source.avar(factors / RATE_HZ, 1.0 / RATE_HZ) for source in MIX)[:, None]
    held = []
    for one, avar in zip(looked, measured, strict=True):
        lo, hi = deviation_intervals(avar, one.edf)
        held.append((lo**2 <= truth) & (truth <= hi**2))
    short = np.array(held)[:, factors <= N // 8]
    for share in short.mean(axis=(0, 2)):
        assert binom.ppf(0.0005, RECORDS, 0.94) <= share * RECORDS <= binom.ppf(0.9995, RECORDS, 0.97)
    assert short.mean() == pytest.approx(0.95, abs=0.02)


def test_errors_are_near_the_cramer_rao_limit():
    looked, _ = fits(MIX)
    f = np.arange(1, N // 2) * (RATE_HZ / N)
    spectra = np.stack([source.two_sided_psd(f, 1.0 / RATE_HZ) for source in MIX])
    shares = spectra / spectra.sum(0)
    limit = 0.5 * np.sqrt(np.diag(np.linalg.inv(shares @ shares.T)))
    theta = np.concatenate([one.theta for one in looked], axis=1)[:4]
    error = np.sqrt(np.mean((np.sqrt(np.maximum(theta, 0.0)) / TRUTH[:4, None] - 1.0) ** 2, axis=1))
    assert (error < 1.35 * limit).all(), error / limit


@pytest.mark.long
@pytest.mark.parametrize("absent", ["Q", "B", "K"])
def test_a_term_that_is_not_there_seldom_enters(absent):
    looked, _ = fits(tuple(source for source in MIX if not hasattr(source, absent)))
    entered = (gather(looked, "status")[SYMBOLS.index(absent)] == Status.ESTIMATED).sum()
    assert entered <= binom.ppf(0.999, RECORDS, 0.04)


def test_random_walk_is_not_called_a_ramp():
    looked, _ = fits(MIX)
    assert (gather(looked, "status")[4] == Status.ESTIMATED).sum() <= binom.ppf(0.999, RECORDS, 0.02)


@pytest.mark.long
def test_a_ramp_is_found_and_does_not_pass_as_random_walk():
    sources = (*MIX[:3], RateRamp(R=5e-6))
    with_slope, _ = fits(sources)
    without, _ = fits(sources, with_slope=False)
    status = gather(with_slope, "status")
    assert (status[4] == Status.ESTIMATED).mean() > 0.9
    held = (gather(with_slope, "lo")[4] <= 5e-6) & (gather(with_slope, "hi")[4] >= 5e-6)
    assert held.sum() >= binom.ppf(0.0005, RECORDS, 0.95)
    false_walk = [(gather(x, "status")[3] == Status.ESTIMATED).mean() for x in (with_slope, without)]
    assert false_walk[0] < 0.2 < 0.5 < false_walk[1]


@pytest.mark.parametrize("cutoff_hz", [10.0, 20.0, 30.0, 40.0])
def test_the_sensors_own_filter_does_not_pull_the_coefficients(cutoff_hz):
    model = NoiseModel(dict.fromkeys(AXES, (AngleRandomWalk(N=1.5e-4), BiasInstability(B=2e-4))))
    wide = model.simulate(120_000, RATE_HZ, 5)
    narrow = sosfilt(butter(2, cutoff_hz / (RATE_HZ / 2.0), output="sos"), wide, axis=0)
    result = fit_values(narrow)
    # the more τ the filter takes, the less is left to tell N: 0.5 % standard deviation at 40 Hz, 2 % at 10 Hz
    np.testing.assert_allclose(result.coefficients.value[1], 1.5e-4, rtol=0.04 if cutoff_hz > 10.0 else 0.08)
    np.testing.assert_allclose(result.coefficients.value[2], 2e-4, rtol=0.25)
    assert (result.coefficients.status[0] == Status.UPPER_BOUND).all()
    assert (result.left_out >= 1).all()
    drawn = np.arange(len(result.fitted))[:, None] >= result.left_out
    np.testing.assert_array_equal(np.isfinite(result.fitted), drawn)
    assert np.isfinite(result.edf).all()
    assert (fit_values(wide).left_out == 0).all()


def test_hysteresis_enters_late_and_leaves_late():
    theta = np.array([0.0, 1.5e-4, 4e-5, 0.0, 0.0]) ** 2
    never, always = np.zeros((5, 6), bool), np.ones((5, 6), bool)
    factors = cluster_sizes(N, RATE_HZ)
    t = covariance_table(N, factors)
    # between 1.5 and 3 σ a term stays as it was: find such a size of B
    entered = []
    for b in np.linspace(1e-5, 1e-4, 60):
        theta[2] = b**2
        avar = sum(x * s.avar(factors / RATE_HZ, 1.0 / RATE_HZ) for x, s in zip(theta, UNIT_SOURCES, strict=True))
        measured = MeasuredVariancesAndSlopes(np.repeat(avar[:, None], 6, 1), np.repeat(t.terms[:, None], 6, 1))
        both = [replace(measured, entered_before=before) for before in (never, always)]
        entered.append([fit_coefficients(make_design_matrix(factors, RATE_HZ), t, one).entered[2, 0] for one in both])
    entered = np.array(entered)
    assert (entered[:, 1] >= entered[:, 0]).all()
    assert not entered[0].any()
    assert entered[-1].all()
    assert (entered[:, 1] & ~entered[:, 0]).sum() >= 3
    assert not never.any()  # what is handed in is not written to
    assert always.all()


def test_too_few_tau_is_unestimated_but_has_degrees_of_freedom():
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


@pytest.mark.parametrize("dead", [np.nan, 0.0])
def test_a_dead_axis_spoils_no_other(dead):
    values = NoiseModel(dict.fromkeys(AXES, MIX)).simulate(20_000, RATE_HZ, 1)
    alive = fit_values(values, with_slope=False)
    values[:, 2] = dead
    result = fit_values(values, with_slope=False)
    assert (result.coefficients.status[:, 2] == Status.UNESTIMATED).all()
    assert np.isnan(result.edf[:, 2]).all()
    for axis in (0, 1, 3, 4, 5):
        np.testing.assert_array_equal(result.coefficients.value[:, axis], alive.coefficients.value[:, axis])


def test_gaps_cost_degrees_of_freedom():
    values = NoiseModel(dict.fromkeys(AXES, MIX)).simulate(20_000, RATE_HZ, 1)
    whole = fit_values(values, with_slope=False)
    values[9_000:9_500] = np.nan
    factors = cluster_sizes(20_000, RATE_HZ)
    holed = fit_values(values, with_slope=False)
    assert (holed.edf[factors <= 1024] < whole.edf[factors <= 1024]).all()
    np.testing.assert_allclose(holed.theta[1], whole.theta[1], rtol=0.05)


def test_the_fitted_curve_is_drawn_through_the_measured_one():
    looked, measured = fits(MIX)
    factors = cluster_sizes(N, RATE_HZ)
    ratio = measured / np.array([one.fitted for one in looked])
    # the longest has 15 degrees of freedom: the mean of RECORDS scatters by 3 %
    np.testing.assert_allclose(np.mean(ratio, axis=(0, 2))[factors <= N // 8], 1.0, atol=0.1)
    np.testing.assert_allclose(np.mean(ratio, axis=(0, 2))[factors <= N // 128], 1.0, atol=0.02)


def test_a_line_is_no_filter_and_nothing_is_left_out_for_it():
    values = NoiseModel(dict.fromkeys(AXES, MIX)).simulate(N, RATE_HZ, 3)
    line = 5e-4 * np.sin(2.0 * np.pi * 0.565 * np.arange(N) / RATE_HZ)
    result = fit_values(values + line[:, None])
    assert (result.left_out == 0).all()
    # the shortest τ, which the line does not reach, still tell N
    np.testing.assert_allclose(result.coefficients.value[1], 1.5e-4, rtol=0.12)


def test_where_the_terms_are_no_description_none_is_more_than_the_curve():
    # a strong line at 0.5 Hz over white noise: nothing may be claimed above the curve's own limits
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
            shape = columns.columns[:, letter] * 100.0 ** (-power)  # of σ², for a coefficient of one in SI
            most = np.sqrt((2.5 * avar[:, axis] / shape)[:12].min())  # τ with many degrees of freedom
            assert c.hi[letter, axis] <= most * 1.01
            if c.status[letter, axis] == Status.ESTIMATED:
                assert 0.0 < c.lo[letter, axis] < c.value[letter, axis] < c.hi[letter, axis]
