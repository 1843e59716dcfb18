"""Tests of the fit of a random variation of the noise variance."""

import numpy as np
import pytest

from monitor.noise.effects import NoiseStep, WanderingVariance
from monitor.reconcile.likelihood.variance_change_tests import compare_variance_change_forms
from monitor.reconcile.likelihood.wandering_variance_fit import estimate_wandering_std, fit_wandering_variance

N = 60_000
TAU0 = 0.01


def draw_gain(seed, deviation=0.4, correlation_time=10.0):
    effect = WanderingVariance(deviation=deviation, correlation_time=correlation_time)
    return effect.start_gain(1.0 / TAU0, np.random.default_rng([seed, 1])).compute_gain(0, N)


def draw_noise(seed):
    return np.random.default_rng([seed, 2]).standard_normal(N)


def kalman_log_likelihood(logs, error_variance, deviation, decay):
    """Compute the log-likelihood of Gauss–Markov noise with white errors in the time domain."""
    state, variance, total = 0.0, deviation**2, 0.0
    for log in logs - logs.mean():
        predicted = variance + error_variance
        total -= 0.5 * (np.log(predicted) + (log - state) ** 2 / predicted)
        weight = variance / predicted
        state, variance = decay * (state + weight * (log - state)), decay**2 * (1.0 - weight) * variance
        variance += deviation**2 * (1.0 - decay**2)
    return total


@pytest.mark.parametrize("unit", [1e-4, 1.0])
def test_gain_agrees_with_a_kalman_filter(unit):
    found = fit_wandering_variance(unit * draw_gain(0) * draw_noise(0), TAU0)
    length = 32
    logs = np.log(np.mean((draw_gain(0) * draw_noise(0)).reshape(-1, length) ** 2, axis=1))
    decay = np.exp(-length * TAU0 / found.correlation_time.value)
    error = 2.0 / length + 2.0 / length**2 + 4.0 / (3.0 * length**3)  # variance of the logarithm of χ²/32
    gain = kalman_log_likelihood(logs, error, found.deviation.value, decay)
    gain -= kalman_log_likelihood(logs, error, 0.0, decay)
    assert found.gain > 100.0
    assert found.gain == pytest.approx(gain, rel=0.02)


def test_intervals_contain_the_true_values():
    inside = 0
    for seed in range(100):
        found = fit_wandering_variance(draw_gain(seed) * draw_noise(seed), TAU0)
        inside += found.deviation.lo <= 0.4 <= found.deviation.hi
        inside += found.correlation_time.lo <= 10.0 <= found.correlation_time.hi
    assert 176 <= inside <= 200  # of 200 at 95 %


def test_constant_variance_has_no_gain():
    gains = [fit_wandering_variance(draw_noise(seed), TAU0).gain for seed in range(40)]
    assert max(gains) < 8.0


@pytest.mark.parametrize("seed", range(5))
def test_bursts_and_random_variation_are_told_apart(seed):
    wandering = fit_wandering_variance(draw_gain(seed) * draw_noise(seed), TAU0)
    assert abs(wandering.misfit_z) < 4.0
    bursts = draw_noise(seed)
    for start in np.random.default_rng(seed).integers(0, N - 400, 12):
        bursts[start : start + 400] *= 2.0
    assert fit_wandering_variance(bursts, TAU0).misfit_z > 4.0


def test_division_by_the_estimate_makes_the_variance_constant():
    series = draw_gain(0) * draw_noise(0)
    std = estimate_wandering_std(series, TAU0, 0.4, 10.0)
    assert np.corrcoef(np.log(std), np.log(draw_gain(0)))[0, 1] > 0.9
    assert np.mean((series / std) ** 2) == pytest.approx(np.mean(series**2))
    assert fit_wandering_variance(series / std, TAU0).gain < 3.0


def test_short_series_is_not_fitted():
    short = draw_noise(0)[:200]
    assert fit_wandering_variance(short, TAU0) is None
    assert (estimate_wandering_std(short, TAU0, 0.4, 10.0) == 1.0).all()


def test_step_has_no_smaller_likelihood_than_random_variation():
    gain = NoiseStep(time=300.0, ratio=1.3).start_gain(1.0 / TAU0, np.random.default_rng(0)).compute_gain(0, N)
    series = gain * draw_noise(0)
    assert compare_variance_change_forms(series, TAU0).step.gain > fit_wandering_variance(series, TAU0).gain
