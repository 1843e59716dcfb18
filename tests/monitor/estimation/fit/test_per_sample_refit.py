"""Tests of the refit after every sample against a new fit, for any input and block sizes."""

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


def simulate_values(n, *more, seed=0):
    return NoiseModel(dict.fromkeys(AXES, (*MIX, *more))).simulate(n, RATE_HZ, seed)


def refit_each_sample(values, blocks=(1000,)):
    """Return the history of the coefficients of values [n, 6], the final window and the refit."""
    window = AllanWindow(LENGTH, FACTORS)
    refit = ContinuousRefit(window, FACTORS.size, CovarianceTablesByAxis(FACTORS, LENGTH))
    histories, at, k, lengths = [], 0, 0, np.zeros(6, np.int64)
    while at < len(values):
        histories.append(
            refit.append_and_refit_after_each_sample(DESIGN, values[at : at + blocks[k % len(blocks)]], lengths)
        )
        at += blocks[k % len(blocks)]
        k += 1
    return np.concatenate(histories), window, refit


def fit_window_anew(window, before):
    """Fit the curve of a window from the start, with diagonal weights as in the refit."""
    n = window.samples_in_window
    table = CovarianceTablesByAxis(FACTORS, LENGTH).table_of_axis(0, n, n)
    slope, slopes = window.drift_slopes_by_axis_and_tau()
    avar, terms, excess = window.variances()
    return fit_coefficients(
        DESIGN,
        table,
        MeasuredVariancesAndSlopes(avar, terms, slope * RATE_HZ, slopes * RATE_HZ, before, excess),
        full_covariance=False,
    )


@pytest.mark.long
def test_refit_agrees_with_a_new_fit():
    deviations = []
    for seconds in (40, 70, 150, 210, 390, 600):
        history, window, refit = refit_each_sample(simulate_values(round(seconds * RATE_HZ)))
        value, coefficients = history[-1], fit_window_anew(window, refit.terms_in_fit).coefficients
        both = np.isfinite(value) & np.isfinite(coefficients.value)
        assert both.sum() >= 12
        scatter = (coefficients.hi - coefficients.lo)[both] / 4.0
        deviations += (np.abs(value - coefficients.value)[both] / scatter).tolist()
    # Slightly different weights cost a fraction of a standard deviation, which is 2 % of the rms error.
    assert max(deviations) < 1.0
    assert np.sqrt(np.mean(np.square(deviations))) < 0.2


@pytest.mark.parametrize("lost_axes", [slice(None), slice(0, 2)])
def test_refit_agrees_with_a_new_fit_if_samples_are_missing(lost_axes):
    """Without the correction for missing samples, N² would be 5 % too large, which is 4 standard deviations."""
    values, rng = simulate_values(22_000, seed=3), np.random.default_rng(4)
    values[rng.random(len(values)) < 0.05, lost_axes] = np.nan
    history, window, refit = refit_each_sample(values)
    coefficients = fit_window_anew(window, refit.terms_in_fit).coefficients
    both = np.isfinite(history[-1]) & np.isfinite(coefficients.value)
    assert both[1].all()
    assert both.sum() >= 12
    scatter = (coefficients.hi - coefficients.lo)[both] / 4.0
    assert (np.abs(history[-1] - coefficients.value)[both] < scatter).all()


@pytest.mark.parametrize("blocks", [(1,), (7, 100, 3), (513, 2)])
def test_block_sizes_do_not_change_the_result(blocks):
    values = simulate_values(3000)
    values[800:850] = np.nan
    whole, _, _ = refit_each_sample(values, (3000,))
    cut, _, _ = refit_each_sample(values, blocks)
    assert np.array_equal(whole, cut, equal_nan=True)


def test_increased_noise_is_followed_within_the_window():
    values = simulate_values(60_000)
    values[30_000:] *= 3.0
    history, _, _ = refit_each_sample(values)
    n = history[:, 1]
    assert n[29_999] == pytest.approx(1.5e-4, rel=0.05)
    assert n[-1] == pytest.approx(4.5e-4, rel=0.05)
    halfway = np.sqrt((n[29_999] ** 2 + n[-1] ** 2) / 2.0)  # the variance is averaged over the window
    assert n[40_000] == pytest.approx(halfway, rel=0.05)


def test_transient_has_no_lasting_effect():
    values = simulate_values(60_000)
    shaken = values.copy()
    shaken[10_000:10_050] += 100.0
    history, window, refit = refit_each_sample(values)
    other, other_window, other_refit = refit_each_sample(shaken)
    assert other_window.avar() == pytest.approx(window.avar(), rel=1e-9)
    at_end, expected = (
        fit_window_anew(other_window, other_refit.terms_in_fit),
        fit_window_anew(window, refit.terms_in_fit),
    )
    assert at_end.coefficients.value[1] == pytest.approx(expected.coefficients.value[1], rel=1e-6)
    assert other[-1, 1] == pytest.approx(history[-1, 1], rel=2e-3)


def test_missing_axes_do_not_affect_other_axes():
    values = simulate_values(5000)
    missing = values.copy()
    missing[:, [1, 5]] = np.nan
    history, _, _ = refit_each_sample(missing)
    whole, _, _ = refit_each_sample(values)
    assert np.isnan(history[:, :, [1, 5]]).all()
    others = [0, 2, 3, 4]
    assert np.array_equal(history[:, :, others], whole[:, :, others], equal_nan=True)


def test_constant_axis_is_never_estimated():
    values = simulate_values(3000)
    values[:, 3] = 9.81
    history, _, _ = refit_each_sample(values)
    assert np.isnan(history[:, :, 3]).all()


def test_ramp_coefficient_is_the_slope_of_the_window():
    n = 60_000
    values = simulate_values(n, RateRamp(R=1e-4))
    history, window, _ = refit_each_sample(values)
    assert history[-1, 4] == pytest.approx(np.full(6, 1e-4), rel=0.2)
    np.testing.assert_allclose(history[-1, 4], np.abs(window.drift_slopes_by_axis_and_tau()[0]) * RATE_HZ, rtol=1e-6)


def test_missing_samples_keep_their_positions():
    values = simulate_values(30_000)
    values[12_000:14_000, 2] = np.nan
    history, window, refit = refit_each_sample(values)
    expected = fit_window_anew(window, refit.terms_in_fit).coefficients.value[1]
    assert history[-1, 1] == pytest.approx(expected, rel=5e-3)


def test_term_near_its_threshold_causes_few_new_fits():
    # K exceeds its entry threshold, but its interval still includes zero. The term therefore stays out.
    rng, length = np.random.default_rng(1), 10_000
    sizes = np.unique(np.rint(np.geomspace(1, length // 4, 22)).astype(np.int64))
    estimator = Estimator(1.0, float(length), tuple(sizes.astype(float).tolist()), every_sample=True)
    walk = np.cumsum(1e-4 * np.sqrt(3.0) * 30.0 / length * rng.standard_normal((2 * length + 1000, 6)), axis=0)
    values = walk + 1e-4 * rng.standard_normal(walk.shape)
    estimator.add_samples(make_block(np.arange(2 * length), values[: 2 * length]))
    refit, new_fits = estimator._refit, np.zeros(6, int)
    bounded_count = 0
    for i in range(2 * length, len(values)):
        estimator.add_samples(make_block(np.array([i]), values[i : i + 1]))
        new_fits += refit._ages == 0
        bounded_count += int((refit._state.output.status[:, 3] == 1).sum())
    assert bounded_count > 1000
    assert new_fits.max() < 20
