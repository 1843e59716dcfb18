"""Tests of the ARMA model of drift: likelihood, order selection and confidence intervals."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.signal import lfilter

from drivers.errors import NotReady
from monitor.drift.compensation import arma
from monitor.drift.compensation.arma import compute_likelihood_sums, fit_arma

TRUE_PARAMETERS = ((1.2, -0.5), -0.4)


def simulate_arma(n: int, seed: int, phi=TRUE_PARAMETERS[0], theta=TRUE_PARAMETERS[1]) -> np.ndarray:
    a = np.random.default_rng(seed).standard_normal(n + 500)
    return lfilter([1.0, theta], [1.0, -phi[0], -phi[1]], a)[500:]


def compute_autocovariance(phi, theta, n: int) -> np.ndarray:
    """Return the autocovariance for noise of variance 1, computed from the impulse response."""
    response = lfilter([1.0, theta], [1.0, -phi[0], -phi[1]], np.eye(1, 4000)[0])
    return np.array([response[: 4000 - k] @ response[k:] for k in range(n)])


@pytest.mark.parametrize("white", [0.0, 0.7])
def test_likelihood_equals_that_of_the_dense_covariance_with_missing_values(white):
    n, variance = 60, 1.3
    z = simulate_arma(n, 1) + 0.3
    z[[5, 6, 20, 41]] = np.nan
    known = np.isfinite(z)
    lags = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    whole = variance * compute_autocovariance(*TRUE_PARAMETERS, n)[lags] + white * np.eye(n)
    c = whole[np.ix_(known, known)]
    inverse = np.linalg.inv(c)
    ones = np.ones(known.sum())
    mean = ones @ inverse @ z[known] / (ones @ inverse @ ones)
    left = z[known] - mean
    count, logs, square, found = compute_likelihood_sums(z, *TRUE_PARAMETERS[0], TRUE_PARAMETERS[1], variance, white)
    assert count == known.sum()
    assert logs == pytest.approx(np.linalg.slogdet(c)[1], rel=1e-9)
    assert square == pytest.approx(left @ inverse @ left, rel=1e-9)
    assert found == pytest.approx(mean, rel=1e-9)


def test_fit_is_invariant_to_offset_and_scale():
    z = simulate_arma(400, 2)
    fit, scaled_fit = fit_arma(z, 0.2), fit_arma(5.0 + 1e-4 * z, 0.2e-8)
    assert fit.order == scaled_fit.order
    assert scaled_fit.phi == pytest.approx(fit.phi, abs=1e-6)
    assert scaled_fit.mean == pytest.approx(5.0 + 1e-4 * fit.mean, rel=1e-9)
    assert scaled_fit.variance == pytest.approx(1e-8 * fit.variance, rel=1e-5)


@pytest.mark.parametrize(
    ("phi", "theta", "order"),
    [((0.0, 0.0), 0.0, (0, 0)), ((0.95, 0.0), 0.0, (1, 0)), ((0.95, 0.0), -0.6, (1, 1)), ((1.6, -0.7), -0.5, (2, 1))],
)
def test_bic_selects_the_true_order(phi, theta, order):
    found = [fit_arma(simulate_arma(2000, seed, phi, theta)).order for seed in range(5)]
    assert found.count(order) >= 4


def test_known_white_noise_is_separated_from_the_drift():
    rng = np.random.default_rng(3)
    drift = lfilter([1.0], [1.0, -0.98], 0.2 * rng.standard_normal(4000))[2000:]
    found = fit_arma(drift + 2.0 * rng.standard_normal(2000), 4.0, [(1, 0)])
    assert found.phi[0] == pytest.approx(0.98, abs=0.02)
    assert found.variance == pytest.approx(0.04, rel=0.6)
    assert found.white_variance == pytest.approx(4.0)
    assert (found.variance * arma.stationary_covariance(*found.phi, found.theta)[0]) ** 0.5 == pytest.approx(
        1.0, rel=0.4
    )


@pytest.mark.long
def test_confidence_intervals_contain_the_true_parameters():
    """With 95 % coverage, fewer than 51 of 60 would be inside only once in 2000 trials."""
    inside = np.zeros(3)
    for seed in range(60):
        found = fit_arma(simulate_arma(400, seed), orders=[(2, 1)], with_confidence_intervals=True)
        true = np.array([*TRUE_PARAMETERS[0], TRUE_PARAMETERS[1]])
        inside += (np.array(found.lo) <= true) & (true <= np.array(found.hi))
        assert np.all(np.array(found.lo) <= [*found.phi, found.theta])
    assert np.all(inside >= 51)


def test_constant_has_no_coefficients():
    found = fit_arma(np.random.default_rng(4).standard_normal(500), 1.0, with_confidence_intervals=True)
    assert found.name == "constant"
    assert np.isnan(found.lo).all()
    assert found.variance == 0.0


def test_too_few_or_equal_values_are_refused():
    with pytest.raises(NotReady, match="30 are needed"):
        fit_arma(np.arange(10.0))
    with pytest.raises(NotReady, match="equal"):
        fit_arma(np.ones(100))


@pytest.mark.parametrize("white", [0.0, 0.5])
def test_parameters_and_intervals_equal_those_found_with_scipy(monkeypatch, white):
    z = simulate_arma(600, 4) + white**0.5 * np.random.default_rng(5).standard_normal(600)
    found = fit_arma(z, white, with_confidence_intervals=True)

    def minimize_with_scipy(function, start, gradient_tolerance):
        result = minimize(function, start, method="BFGS", options={"gtol": gradient_tolerance})
        return float(result.fun), result.x

    monkeypatch.setattr(arma, "minimize_bfgs", minimize_with_scipy)
    expected = fit_arma(z, white, with_confidence_intervals=True)
    assert found.order == expected.order
    assert (*found.phi, found.theta) == pytest.approx((*expected.phi, expected.theta), abs=1e-4)
    assert (*found.lo, *found.hi) == pytest.approx((*expected.lo, *expected.hi), abs=1e-3, nan_ok=True)
