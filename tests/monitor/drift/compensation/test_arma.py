"""ARMA of a drift: the likelihood beside a dense Gaussian one, orders, intervals."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.signal import lfilter

from drivers.errors import NotReady
from monitor.drift.compensation import arma
from monitor.drift.compensation.arma import ArmaModel, compute_likelihood_sums, fit_arma

TRUE = ((1.2, -0.5), -0.4)


def drawn(n: int, seed: int, phi=TRUE[0], theta=TRUE[1]) -> np.ndarray:
    a = np.random.default_rng(seed).standard_normal(n + 500)
    return lfilter([1.0, theta], [1.0, -phi[0], -phi[1]], a)[500:]


def autocovariance(phi, theta, n: int) -> np.ndarray:
    """Of a of variance 1, by the process's answer to one impulse: no state space in it."""
    answer = lfilter([1.0, theta], [1.0, -phi[0], -phi[1]], np.eye(1, 4000)[0])
    return np.array([answer[: 4000 - k] @ answer[k:] for k in range(n)])


@pytest.mark.parametrize("white", [0.0, 0.7])
def test_the_likelihood_is_that_of_the_dense_covariance_also_with_holes(white):
    n, variance = 60, 1.3
    z = drawn(n, 1) + 0.3
    z[[5, 6, 20, 41]] = np.nan
    there = np.isfinite(z)
    lags = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    whole = variance * autocovariance(*TRUE, n)[lags] + white * np.eye(n)
    c = whole[np.ix_(there, there)]
    inverse = np.linalg.inv(c)
    one = np.ones(there.sum())
    mean = one @ inverse @ z[there] / (one @ inverse @ one)
    left = z[there] - mean
    count, logs, square, found = compute_likelihood_sums(z, *TRUE[0], TRUE[1], variance, white)
    assert count == there.sum()
    assert logs == pytest.approx(np.linalg.slogdet(c)[1], rel=1e-9)
    assert square == pytest.approx(left @ inverse @ left, rel=1e-9)
    assert found == pytest.approx(mean, rel=1e-9)


def test_units_move_nothing_but_the_units():
    z = drawn(400, 2)
    one, other = fit_arma(z, 0.2), fit_arma(5.0 + 1e-4 * z, 0.2e-8)
    assert one.order == other.order
    assert other.phi == pytest.approx(one.phi, abs=1e-6)
    assert other.mean == pytest.approx(5.0 + 1e-4 * one.mean, rel=1e-9)
    assert other.variance == pytest.approx(1e-8 * one.variance, rel=1e-5)
    assert other.bic == pytest.approx(one.bic + 2.0 * 400 * np.log(1e-4), rel=1e-6)


@pytest.mark.parametrize(
    ("phi", "theta", "order"),
    [((0.0, 0.0), 0.0, (0, 0)), ((0.95, 0.0), 0.0, (1, 0)), ((0.95, 0.0), -0.6, (1, 1)), ((1.6, -0.7), -0.5, (2, 1))],
)
def test_the_criterion_finds_the_order(phi, theta, order):
    found = [fit_arma(drawn(2000, seed, phi, theta)).order for seed in range(5)]
    assert found.count(order) >= 4


def test_white_noise_that_is_known_is_told_from_the_drift():
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
def test_intervals_hold_the_truth():
    """60 drifts, 3 coefficients: fewer than 51 inside would come by chance once in 2000 at 95 %."""
    inside = np.zeros(3)
    for seed in range(60):
        found = fit_arma(drawn(400, seed), orders=[(2, 1)], with_confidence_intervals=True)
        true = np.array([*TRUE[0], TRUE[1]])
        inside += (np.array(found.lo) <= true) & (true <= np.array(found.hi))
        assert np.all(np.array(found.lo) <= [*found.phi, found.theta])
    assert np.all(inside >= 51)


def test_a_constant_has_no_coefficients():
    found = fit_arma(np.random.default_rng(4).standard_normal(500), 1.0, with_confidence_intervals=True)
    assert found.name == "constant"
    assert np.isnan(found.lo).all()
    assert found.variance == 0.0


def test_too_few_and_all_the_same_are_refused():
    with pytest.raises(NotReady, match="30 are needed"):
        fit_arma(np.arange(10.0))
    with pytest.raises(NotReady, match="equal"):
        fit_arma(np.ones(100))


def test_green():
    assert ArmaModel((0.5, 0.3), -0.2, 1.0).green_function_values == (1.0, pytest.approx(0.3))


@pytest.mark.parametrize("white", [0.0, 0.5])
def test_parameters_and_intervals_are_those_that_scipy_finds(monkeypatch, white):
    z = drawn(600, 4) + white**0.5 * np.random.default_rng(5).standard_normal(600)
    found = fit_arma(z, white, with_confidence_intervals=True)

    def by_scipy(function, start, gradient_tolerance):
        result = minimize(function, start, method="BFGS", options={"gtol": gradient_tolerance})
        return float(result.fun), result.x

    monkeypatch.setattr(arma, "minimize_bfgs", by_scipy)
    expected = fit_arma(z, white, with_confidence_intervals=True)
    assert found.order == expected.order
    assert found.bic == pytest.approx(expected.bic, abs=1e-5)
    assert (*found.phi, found.theta) == pytest.approx((*expected.phi, expected.theta), abs=1e-4)
    assert (*found.lo, *found.hi) == pytest.approx((*expected.lo, *expected.hi), abs=1e-3, nan_ok=True)
