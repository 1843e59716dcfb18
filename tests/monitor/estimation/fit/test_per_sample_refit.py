"""A fit at every sample: frozen gains give what a fresh fit would, whatever comes and however it is cut."""

import numpy as np
import pytest

from drivers.data_types import AXES, make_block
from monitor.estimation.allan.batch import cluster_sizes
from monitor.estimation.allan.uncertainty import CovarianceTablesByAxis
from monitor.estimation.allan.window import AllanWindow
from monitor.estimation.estimator import Estimator
from monitor.estimation.fit.coefficient_fit import MeasuredVariancesAndSlopes, fit_coefficients, make_design_matrix
from monitor.estimation.fit.per_sample_refit import ContinuousRefit
from monitor.noise.effects import AngleRandomWalk, BiasInstability, QuantizationNoise, RateRamp, RateRandomWalk
from monitor.noise.model import NoiseModel

RATE_HZ = 100.0
LENGTH = 20_000
FACTORS = cluster_sizes(LENGTH, RATE_HZ)
DESIGN = make_design_matrix(FACTORS, RATE_HZ)
MIX = (QuantizationNoise(Q=5e-6), AngleRandomWalk(N=1.5e-4), BiasInstability(B=1e-4), RateRandomWalk(K=3e-5))


def simulated(n, *more, seed=0):
    return NoiseModel(dict.fromkeys(AXES, (*MIX, *more))).simulate(n, RATE_HZ, seed)


def follow(values, blocks=(1000,)):
    """The course of the coefficients of values [n, 6], and the window they end with."""
    window = AllanWindow(LENGTH, FACTORS)
    refit = ContinuousRefit(window, FACTORS.size, CovarianceTablesByAxis(FACTORS, LENGTH))
    courses, at, k, lengths = [], 0, 0, np.zeros(6, np.int64)
    while at < len(values):
        courses.append(
            refit.append_and_refit_after_each_sample(DESIGN, values[at : at + blocks[k % len(blocks)]], lengths)
        )
        at += blocks[k % len(blocks)]
        k += 1
    return np.concatenate(courses), window, refit


def fresh(window, before):
    """A fit from nothing to the curve of a window; diagonal weights, as at every sample."""
    n = window.samples_in_window
    table = CovarianceTablesByAxis(FACTORS, LENGTH).table_of_axis(0, n, n)
    slope, slopes = window.drift_slopes_by_axis_and_tau()
    avar, terms = window.avar(), window.term_counts()
    return fit_coefficients(
        DESIGN,
        table,
        MeasuredVariancesAndSlopes(avar, terms, slope * RATE_HZ, slopes * RATE_HZ, before),
        full_covariance=False,
    )


@pytest.mark.long
def test_it_is_a_fresh_fit_to_a_small_part_of_the_scatter():
    off = []
    for seconds in (40, 70, 150, 210, 390, 600):
        course, window, refit = follow(simulated(round(seconds * RATE_HZ)))
        value, coefficients = course[-1], fresh(window, refit.terms_in_fit).coefficients
        both = np.isfinite(value) & np.isfinite(coefficients.value)
        assert both.sum() >= 12
        scatter = (coefficients.hi - coefficients.lo)[both] / 4.0
        off += (np.abs(value - coefficients.value)[both] / scatter).tolist()
    # weights a little off cost a fraction of a standard deviation: 2 % of the rms error
    assert max(off) < 1.0
    assert np.sqrt(np.mean(np.square(off))) < 0.2


@pytest.mark.parametrize("blocks", [(1,), (7, 100, 3), (513, 2)])
def test_the_cut_of_the_blocks_does_not_matter(blocks):
    values = simulated(3000)
    values[800:850] = np.nan
    whole, _, _ = follow(values, (3000,))
    cut, _, _ = follow(values, blocks)
    assert np.array_equal(whole, cut, equal_nan=True)


def test_a_louder_sensor_is_followed_within_the_window():
    values = simulated(60_000)
    values[30_000:] *= 3.0
    course, _, _ = follow(values)
    n = course[:, 1]
    assert n[29_999] == pytest.approx(1.5e-4, rel=0.05)
    assert n[-1] == pytest.approx(4.5e-4, rel=0.05)
    halfway = np.sqrt((n[29_999] ** 2 + n[-1] ** 2) / 2.0)  # the variance is an average over the window
    assert n[40_000] == pytest.approx(halfway, rel=0.05)


def test_a_transient_leaves_nothing_behind():
    values = simulated(60_000)
    shaken = values.copy()
    shaken[10_000:10_050] += 100.0
    course, window, refit = follow(values)
    other, other_window, other_refit = follow(shaken)
    assert other_window.avar() == pytest.approx(window.avar(), rel=1e-9)
    at_end, expected = fresh(other_window, other_refit.terms_in_fit), fresh(window, refit.terms_in_fit)
    assert at_end.coefficients.value[1] == pytest.approx(expected.coefficients.value[1], rel=1e-6)
    assert other[-1, 1] == pytest.approx(course[-1, 1], rel=2e-3)


def test_an_axis_that_is_not_there_says_nothing_and_costs_the_others_nothing():
    values = simulated(5000)
    missing = values.copy()
    missing[:, [1, 5]] = np.nan
    course, _, _ = follow(missing)
    whole, _, _ = follow(values)
    assert np.isnan(course[:, :, [1, 5]]).all()
    rest = [0, 2, 3, 4]
    assert np.array_equal(course[:, :, rest], whole[:, :, rest], equal_nan=True)


def test_a_constant_axis_is_never_estimated():
    values = simulated(3000)
    values[:, 3] = 9.81
    course, _, _ = follow(values)
    assert np.isnan(course[:, :, 3]).all()


def test_a_ramp_comes_and_goes_as_a_slope():
    n = 60_000
    values = simulated(n, RateRamp(R=1e-4))
    course, window, _ = follow(values)
    assert course[-1, 4] == pytest.approx(np.full(6, 1e-4), rel=0.2)
    np.testing.assert_allclose(course[-1, 4], np.abs(window.drift_slopes_by_axis_and_tau()[0]) * RATE_HZ, rtol=1e-6)


def test_samples_that_are_missing_keep_their_place():
    values = simulated(30_000)
    values[12_000:14_000, 2] = np.nan
    course, window, refit = follow(values)
    expected = fresh(window, refit.terms_in_fit).coefficients.value[1]
    assert course[-1, 1] == pytest.approx(expected, rel=5e-3)


def test_a_term_on_the_verge_costs_no_fit_at_every_sample():
    # K is seen at 3 σ and more of none, and its interval still reaches to zero: it stays out
    rng, length = np.random.default_rng(1), 10_000
    sizes = np.unique(np.rint(np.geomspace(1, length // 4, 22)).astype(np.int64))
    estimator = Estimator(1.0, float(length), tuple(sizes.astype(float).tolist()), every_sample=True)
    walk = np.cumsum(1e-4 * np.sqrt(3.0) * 30.0 / length * rng.standard_normal((2 * length + 1000, 6)), axis=0)
    values = walk + 1e-4 * rng.standard_normal(walk.shape)
    estimator.add_samples(make_block(np.arange(2 * length), values[: 2 * length]))
    refit, anew = estimator._refit, np.zeros(6, int)
    verge = 0
    for i in range(2 * length, len(values)):
        estimator.add_samples(make_block(np.array([i]), values[i : i + 1]))
        anew += refit._ages == 0
        verge += int((refit._state.output.status[:, 3] == 1).sum())
    assert verge > 1000
    assert anew.max() < 20
