"""The peer's wavelet variances against slow sums, its covariance against simulations, and models that it must find."""

import numpy as np
import pytest
from scipy.signal import lfilter

from drivers.data_types import Floats
from tests.experiments.benchmarks import gmwm

pytestmark = pytest.mark.long

N = 1 << 14
SCALES = gmwm.dyadic(N)


def haar(scale: int) -> Floats:
    """Weights [scale] of a wavelet coefficient: half the difference of two neighbouring means."""
    return np.repeat([-1.0, 1.0], scale // 2) / scale


def slowly(autocovariance: Floats, scale: int) -> float:
    """Σ w_s w_t C(s − t) of a stationary series."""
    w = haar(scale)
    lags = np.abs(np.subtract.outer(np.arange(scale), np.arange(scale)))
    return float(w @ autocovariance[lags] @ w)


def drawn(rng: np.random.Generator, n: int, white: float, sigma: float, time: float, walk: float = 0.0) -> Floats:
    """[n] of white noise, an AR1 that is stationary from the first sample, and a random walk."""
    phi = np.exp(-1.0 / time)
    steps = rng.normal(size=n) * sigma * np.sqrt(1.0 - phi**2)
    steps[0] = sigma * rng.normal()
    return np.asarray(
        white * rng.normal(size=n) + lfilter([1.0], [1.0, -phi], steps) + walk * np.cumsum(rng.normal(size=n))
    )


# --- closed forms


def test_variance_is_that_of_every_coefficient() -> None:
    y = np.random.default_rng(1).normal(size=300) + 9.81
    found = gmwm.moments(y)
    assert found.scales.tolist() == [2, 4, 8, 16, 32, 64, 128, 256]
    for scale, variance in zip(found.scales.astype(int), found.variance, strict=True):
        coefficients = np.correlate(y, haar(scale), "valid")
        assert coefficients.size == 300 - scale + 1
        assert variance == pytest.approx(float(np.mean(coefficients**2)), rel=1e-9)


@pytest.mark.parametrize("time", [0.5, 3.0, 40.0, 1000.0])
def test_correlated_noise_is_the_sum_over_its_autocovariance(time: float) -> None:
    scales = np.array([2.0, 4.0, 16.0, 128.0])
    expected = [slowly(np.exp(-np.arange(128) / time), int(scale)) for scale in scales]
    assert gmwm.correlated(scales, time) == pytest.approx(expected, rel=1e-6)


def test_terms_are_sums_over_the_weights_of_a_coefficient() -> None:
    for scale in (2, 8, 64):
        w = haar(scale)
        steps = np.cumsum(w[::-1])  # what the steps of a walk weigh: all that come after
        expected = {
            "WN": w @ w,
            "QN": np.sum(np.diff(w, prepend=0.0, append=0.0) ** 2),
            "RW": steps @ steps,
            "DR": float(w @ np.arange(scale)) ** 2,
        }
        for term in gmwm.TERMS:
            assert gmwm.column(term, np.array([float(scale)]))[0] == pytest.approx(expected[term], rel=1e-12), term


def test_densities_make_the_variances() -> None:
    n = 1 << 12
    scales = gmwm.dyadic(n)[:6]
    model = gmwm.Ranked(("WN", "QN", "RW"), (1.0, 0.5, 1e-3), (30.0,), (0.2,), 0.0, 0.0)
    f = np.arange(1, n // 2 + 1) / n
    half = 0.5 * scales[:, None]
    gain = np.sin(np.pi * f * half) ** 4 / (half * np.sin(np.pi * f)) ** 2
    summed = 2.0 / n * (gain[:, :-1] @ model.density(n)[:-1]) + gain[:, -1] * model.density(n)[-1] / n
    summed += 1e-3 * scales**2 / 16.0 / n  # the random walk at no frequency at all
    terms = sum(size * gmwm.column(term, scales) for term, size in zip(model.terms, model.sizes, strict=True))
    assert summed == pytest.approx(terms + 0.04 * gmwm.correlated(scales, 30.0), rel=1e-3)


# --- intervals and covariance


def test_intervals_have_the_degrees_of_freedom_of_their_scale() -> None:
    found = gmwm.with_intervals(np.ones(10), 1024)
    # χ² of one degree of freedom, where one coefficient is left: 1/5.0239 and 1/0.00098207
    assert found.lo[-1] == pytest.approx(0.19905, rel=1e-4)
    assert found.hi[-1] == pytest.approx(1018.26, rel=1e-4)
    assert (np.diff(found.hi - found.lo) > 0.0).all()


def test_covariance_is_that_of_simulated_series() -> None:
    rng = np.random.default_rng(2)
    n, few = 4096, 8  # the last scales have too few coefficients for an asymptotic formula
    law = gmwm.Ranked(("WN", "RW"), (1.0, 1e-4), (20.0,), (0.5,), 0.0, 0.0)
    slope = 2e-3
    ramp = slope * np.arange(n)
    seen = np.array([gmwm.moments(drawn(rng, n, 1.0, 0.5, 20.0, 1e-2) + ramp).variance[:few] for _ in range(3000)])
    expected = gmwm.covariance(n, law.density(n), slope, 1e-4)[:few, :few]
    errors = np.sqrt(np.diag(expected))
    measured = np.cov(seen.T)
    assert np.diag(measured) == pytest.approx(np.diag(expected), rel=0.12)
    assert measured / np.outer(errors, errors) == pytest.approx(expected / np.outer(errors, errors), abs=0.12)


# --- fit and ranking


def test_recovers_white_and_correlated_noise() -> None:
    rng = np.random.default_rng(4)
    best = [gmwm.rank(gmwm.moments(drawn(rng, 50_000, 1.0, 0.3, 200.0)))[0] for _ in range(10)]
    assert all("WN" in one.terms and one.times for one in best)
    right = [one for one in best if one.terms == ("WN",) and len(one.times) == 1]
    assert len(right) >= 7  # the criterion pays a term with twice what it gains by chance, and takes one now and then
    assert np.mean([one.size("WN") for one in right]) == pytest.approx(1.0, rel=0.01)
    assert np.mean([one.sigmas[0] for one in right]) == pytest.approx(0.3, rel=0.05)
    assert np.mean([one.times[0] for one in right]) == pytest.approx(200.0, rel=0.1)


def test_exact_moments_give_their_own_parameters() -> None:
    variance = gmwm.column("WN", SCALES) + 1e-6 * gmwm.column("RW", SCALES)
    variance += 0.04 * gmwm.correlated(SCALES, 50.0) + 0.09 * gmwm.correlated(SCALES, 900.0)
    found = gmwm.rank(gmwm.with_intervals(variance, N))
    same = next(one for one in found if one.terms == ("WN", "RW") and len(one.times) == 2)
    assert same.objective == pytest.approx(0.0, abs=1e-4)
    assert same.times == pytest.approx((50.0, 900.0), rel=0.05)
    assert same.sigmas == pytest.approx((0.2, 0.3), rel=0.05)


def test_ramp_and_quantization_are_taken_for_what_they_are() -> None:
    rng = np.random.default_rng(5)
    ramp = gmwm.rank(gmwm.moments(rng.normal(size=N) + 1e-3 * np.arange(N)))[0]
    assert "DR" in ramp.terms
    assert ramp.size("DR") == pytest.approx(1e-6, rel=0.05)
    quantized = gmwm.rank(gmwm.moments(0.5 * rng.normal(size=N) + np.diff(rng.normal(size=N + 1))))[0]
    assert quantized.terms[:2] == ("WN", "QN")
    assert quantized.size("QN") == pytest.approx(1.0, rel=0.05)


def test_a_term_more_never_fits_worse_and_costs_more() -> None:
    found = gmwm.rank(gmwm.moments(drawn(np.random.default_rng(6), N, 1.0, 0.3, 100.0)))
    for small in found:
        for large in found:
            if set(small.terms) <= set(large.terms) and small.times == large.times and small is not large:
                assert large.objective <= small.objective * (1.0 + 1e-9)
                assert large.optimism >= small.optimism


def test_optimism_is_how_much_the_fit_flatters_itself() -> None:
    """Mean over simulations of what the objective lacks of that of a fresh series, with weights that are given."""
    rng = np.random.default_rng(7)
    n, runs = 4096, 1000
    law = gmwm.with_intervals(gmwm.column("WN", gmwm.dyadic(n)), n)
    weight = 1.0 / (law.hi - law.lo)
    white = weight * law.variance
    series = weight * np.array([gmwm.moments(rng.normal(size=n)).variance for _ in range(2 * runs)])
    one, fresh = series[:runs], series[runs:]
    fitted = np.outer(one @ white / (white @ white), white)
    gap = ((fresh - fitted) ** 2).sum(axis=1) - ((one - fitted) ** 2).sum(axis=1)
    told = next(each for each in gmwm.rank(law, most=0) if each.terms == ("WN",)).optimism
    assert told == pytest.approx(gap.mean(), abs=4.0 * gap.std() / runs**0.5)
    assert told > 4.0 * gap.std() / runs**0.5


def test_what_is_known_needs_no_term() -> None:
    y = drawn(np.random.default_rng(8), N, 1.0, 0.3, 100.0)
    law = gmwm.Ranked(("WN",), (1.0,), (100.0,), (0.3,), 0.0, 0.0)
    variance = gmwm.column("WN", SCALES) + 0.09 * gmwm.correlated(SCALES, 100.0)
    best = gmwm.rank(gmwm.moments(y), gmwm.Known(variance, law.density(N)))[0]
    assert best.terms == ()
    assert best.times == ()
