"""Tests of the Generalized Method of Wavelet Moments by direct sums, simulations and known models."""

import numpy as np
import pytest
from scipy.signal import lfilter

from drivers.data_types import Floats
from tests.experiments.benchmarks import gmwm

pytestmark = pytest.mark.long

N = 1 << 14
SCALES = gmwm.dyadic_scales(N)


def haar_weights(scale: int) -> Floats:
    """Return the weights [scale] of a wavelet coefficient, which is half the difference of two successive means."""
    return np.repeat([-1.0, 1.0], scale // 2) / scale


def sum_variance(autocovariance: Floats, scale: int) -> float:
    """Return Σ w_s w_t C(s − t) of a stationary series."""
    w = haar_weights(scale)
    lags = np.abs(np.subtract.outer(np.arange(scale), np.arange(scale)))
    return float(w @ autocovariance[lags] @ w)


def simulate_series(
    rng: np.random.Generator, n: int, white: float, sigma: float, time: float, walk: float = 0.0
) -> Floats:
    """Return a series [n] of white noise, a stationary AR1 and a random walk."""
    phi = np.exp(-1.0 / time)
    steps = rng.normal(size=n) * sigma * np.sqrt(1.0 - phi**2)
    steps[0] = sigma * rng.normal()
    return np.asarray(
        white * rng.normal(size=n) + lfilter([1.0], [1.0, -phi], steps) + walk * np.cumsum(rng.normal(size=n))
    )


# --- closed forms


def test_variance_is_the_mean_square_of_all_coefficients() -> None:
    y = np.random.default_rng(1).normal(size=300) + 9.81
    found = gmwm.wavelet_variance(y)
    assert found.scales.tolist() == [2, 4, 8, 16, 32, 64, 128, 256]
    for scale, variance in zip(found.scales.astype(int), found.variance, strict=True):
        coefficients = np.correlate(y, haar_weights(scale), "valid")
        assert coefficients.size == 300 - scale + 1
        assert variance == pytest.approx(float(np.mean(coefficients**2)), rel=1e-9)


@pytest.mark.parametrize("time", [0.5, 3.0, 40.0, 1000.0])
def test_correlated_noise_is_the_sum_over_its_autocovariance(time: float) -> None:
    scales = np.array([2.0, 4.0, 16.0, 128.0])
    expected = [sum_variance(np.exp(-np.arange(128) / time), int(scale)) for scale in scales]
    assert gmwm.ar1_variance(scales, time) == pytest.approx(expected, rel=1e-6)


def test_terms_are_sums_over_the_weights_of_a_coefficient() -> None:
    for scale in (2, 8, 64):
        w = haar_weights(scale)
        steps = np.cumsum(w[::-1])  # weight of each step of the random walk
        expected = {
            "WN": w @ w,
            "QN": np.sum(np.diff(w, prepend=0.0, append=0.0) ** 2),
            "RW": steps @ steps,
            "DR": float(w @ np.arange(scale)) ** 2,
        }
        for term in gmwm.TERMS:
            assert gmwm.term_variance(term, np.array([float(scale)]))[0] == pytest.approx(expected[term], rel=1e-12), (
                term
            )


def test_variances_are_integrals_of_the_densities() -> None:
    n = 1 << 12
    scales = gmwm.dyadic_scales(n)[:6]
    model = gmwm.FittedModel(("WN", "QN", "RW"), (1.0, 0.5, 1e-3), (30.0,), (0.2,), 0.0, 0.0)
    f = np.arange(1, n // 2 + 1) / n
    half = 0.5 * scales[:, None]
    gain = np.sin(np.pi * f * half) ** 4 / (half * np.sin(np.pi * f)) ** 2
    summed = 2.0 / n * (gain[:, :-1] @ model.density(n)[:-1]) + gain[:, -1] * model.density(n)[-1] / n
    summed += 1e-3 * scales**2 / 16.0 / n  # the random walk at frequency 0
    terms = sum(size * gmwm.term_variance(term, scales) for term, size in zip(model.terms, model.sizes, strict=True))
    assert summed == pytest.approx(terms + 0.04 * gmwm.ar1_variance(scales, 30.0), rel=1e-3)


# --- intervals and covariance


def test_intervals_have_the_degrees_of_freedom_of_their_scale() -> None:
    found = gmwm.with_intervals(np.ones(10), 1024)
    # χ² of one degree of freedom, where one coefficient is left: 1/5.0239 and 1/0.00098207
    assert found.lo[-1] == pytest.approx(0.19905, rel=1e-4)
    assert found.hi[-1] == pytest.approx(1018.26, rel=1e-4)
    assert (np.diff(found.hi - found.lo) > 0.0).all()


def test_covariance_is_that_of_simulated_series() -> None:
    rng = np.random.default_rng(2)
    n, compared = 4096, 8  # the last scales have too few coefficients for an asymptotic formula
    law = gmwm.FittedModel(("WN", "RW"), (1.0, 1e-4), (20.0,), (0.5,), 0.0, 0.0)
    slope = 2e-3
    ramp = slope * np.arange(n)
    variances = np.array(
        [
            gmwm.wavelet_variance(simulate_series(rng, n, 1.0, 0.5, 20.0, 1e-2) + ramp).variance[:compared]
            for _ in range(3000)
        ]
    )
    expected = gmwm.covariance(n, law.density(n), slope, 1e-4)[:compared, :compared]
    errors = np.sqrt(np.diag(expected))
    measured = np.cov(variances.T)
    assert np.diag(measured) == pytest.approx(np.diag(expected), rel=0.12)
    assert measured / np.outer(errors, errors) == pytest.approx(expected / np.outer(errors, errors), abs=0.12)


# --- fit and ranking


def test_recovers_white_and_correlated_noise() -> None:
    rng = np.random.default_rng(4)
    best = [gmwm.rank(gmwm.wavelet_variance(simulate_series(rng, 50_000, 1.0, 0.3, 200.0)))[0] for _ in range(10)]
    assert all("WN" in one.terms and one.times for one in best)
    right = [one for one in best if one.terms == ("WN",) and len(one.times) == 1]
    assert len(right) >= 7  # the criterion sometimes accepts an additional term by chance
    assert np.mean([one.size("WN") for one in right]) == pytest.approx(1.0, rel=0.01)
    assert np.mean([one.sigmas[0] for one in right]) == pytest.approx(0.3, rel=0.05)
    assert np.mean([one.times[0] for one in right]) == pytest.approx(200.0, rel=0.1)


def test_exact_variances_give_the_true_parameters() -> None:
    variance = gmwm.term_variance("WN", SCALES) + 1e-6 * gmwm.term_variance("RW", SCALES)
    variance += 0.04 * gmwm.ar1_variance(SCALES, 50.0) + 0.09 * gmwm.ar1_variance(SCALES, 900.0)
    found = gmwm.rank(gmwm.with_intervals(variance, N))
    same = next(one for one in found if one.terms == ("WN", "RW") and len(one.times) == 2)
    assert same.objective == pytest.approx(0.0, abs=1e-4)
    assert same.times == pytest.approx((50.0, 900.0), rel=0.05)
    assert same.sigmas == pytest.approx((0.2, 0.3), rel=0.05)


def test_ramp_and_quantization_noise_are_identified() -> None:
    rng = np.random.default_rng(5)
    ramp = gmwm.rank(gmwm.wavelet_variance(rng.normal(size=N) + 1e-3 * np.arange(N)))[0]
    assert "DR" in ramp.terms
    assert ramp.size("DR") == pytest.approx(1e-6, rel=0.05)
    quantized = gmwm.rank(gmwm.wavelet_variance(0.5 * rng.normal(size=N) + np.diff(rng.normal(size=N + 1))))[0]
    assert quantized.terms[:2] == ("WN", "QN")
    assert quantized.size("QN") == pytest.approx(1.0, rel=0.05)


def test_additional_term_reduces_objective_and_increases_optimism() -> None:
    found = gmwm.rank(gmwm.wavelet_variance(simulate_series(np.random.default_rng(6), N, 1.0, 0.3, 100.0)))
    for small in found:
        for large in found:
            if set(small.terms) <= set(large.terms) and small.times == large.times and small is not large:
                assert large.objective <= small.objective * (1.0 + 1e-9)
                assert large.optimism >= small.optimism


def test_optimism_is_the_mean_difference_to_a_new_series() -> None:
    """The optimism is the mean difference of the objectives of a new and the fitted series, for given weights."""
    rng = np.random.default_rng(7)
    n, runs = 4096, 1000
    law = gmwm.with_intervals(gmwm.term_variance("WN", gmwm.dyadic_scales(n)), n)
    weight = 1.0 / (law.hi - law.lo)
    white = weight * law.variance
    series = weight * np.array([gmwm.wavelet_variance(rng.normal(size=n)).variance for _ in range(2 * runs)])
    one, new = series[:runs], series[runs:]
    fitted = np.outer(one @ white / (white @ white), white)
    gap = ((new - fitted) ** 2).sum(axis=1) - ((one - fitted) ** 2).sum(axis=1)
    optimism = next(model for model in gmwm.rank(law, most=0) if model.terms == ("WN",)).optimism
    assert optimism == pytest.approx(gap.mean(), abs=4.0 * gap.std() / runs**0.5)
    assert optimism > 4.0 * gap.std() / runs**0.5


def test_known_part_needs_no_term() -> None:
    y = simulate_series(np.random.default_rng(8), N, 1.0, 0.3, 100.0)
    law = gmwm.FittedModel(("WN",), (1.0,), (100.0,), (0.3,), 0.0, 0.0)
    variance = gmwm.term_variance("WN", SCALES) + 0.09 * gmwm.ar1_variance(SCALES, 100.0)
    best = gmwm.rank(gmwm.wavelet_variance(y), gmwm.KnownPart(variance, law.density(N)))[0]
    assert best.terms == ()
    assert best.times == ()
