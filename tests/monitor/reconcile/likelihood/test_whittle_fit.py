"""Tests of the Whittle likelihood and its maximum against dense covariance matrices and SciPy's minimizers."""

import numpy as np
import pytest
from scipy.linalg import solve_triangular
from scipy.optimize import minimize

from monitor.reconcile.likelihood.whittle_fit import BinnedRegressionSums, maximise_whittle_likelihood
from monitor.reconcile.preparation.cosine_bins import build_frequency_bins, cosine_transform

n = 160
D = np.array([cosine_transform(row) for row in np.eye(n)]).T  # [n − 1, n]: coefficients of a series
STEPS = np.tril(np.ones((n, n)))
COVARIANCES = np.array([D @ D.T, D @ STEPS @ STEPS.T @ D.T])  # of white noise and of a random walk
BASES = np.diagonal(COVARIANCES, axis1=1, axis2=2).copy()
T = np.arange(n)
REGRESSORS = np.array(
    [cosine_transform(T / n), cosine_transform(np.where(T > 60, 1.0, 0.0)), cosine_transform(np.cos(0.3 * T))]
)
NONE = np.zeros((0, n - 1))
BETA = (3.0, -2.0, 1.0)


def draw_coefficients(seed, theta=(1.0, 0.02), beta=(0.0, 0.0, 0.0)):
    rng = np.random.default_rng(seed)
    y = theta[0] ** 0.5 * rng.standard_normal(n) + theta[1] ** 0.5 * np.cumsum(rng.standard_normal(n))
    return cosine_transform(y) + np.asarray(beta) @ REGRESSORS


def compute_covariance(theta):
    return np.einsum("j,jab->ab", theta, COVARIANCES)


def dense_log_likelihood(y, theta, beta=(0.0, 0.0, 0.0)):
    """Return the log-likelihood without the constant term of 2π."""
    factor = np.linalg.cholesky(compute_covariance(theta))
    whitened = solve_triangular(factor, y - np.asarray(beta) @ REGRESSORS, lower=True)
    return -np.sum(np.log(np.diag(factor))) - 0.5 * whitened @ whitened


def fit(y, regressors=NONE, start=(1.0, 1.0), constant=0.0):
    """Fit the variances with one coefficient in each bin."""
    products = np.einsum("ik,jk->ijk", regressors, regressors)
    found = BinnedRegressionSums(y**2, regressors * y, products)
    return maximise_whittle_likelihood(np.ones(n - 1), found, BASES, np.full(n - 1, constant), np.array(start))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_likelihood_and_maximum_equal_a_dense_gaussian(seed):
    y = draw_coefficients(seed)
    found = fit(y)
    assert found.log_likelihood == pytest.approx(dense_log_likelihood(y, found.theta), abs=1e-6)
    best = minimize(
        lambda x: -dense_log_likelihood(y, np.exp(x)), [0.0, -3.0], method="Nelder-Mead", options={"fatol": 1e-6}
    )
    assert found.log_likelihood == pytest.approx(-best.fun, abs=1e-3)
    assert found.theta == pytest.approx(np.exp(best.x), rel=0.02)
    assert found.residual == pytest.approx(y**2)
    assert found.variance == pytest.approx(found.theta @ BASES)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
def test_regressors_are_fitted_together_with_variances(seed):
    y = draw_coefficients(seed, beta=BETA)
    found = fit(y, REGRESSORS)
    assert found.log_likelihood == pytest.approx(dense_log_likelihood(y, found.theta, found.beta), abs=1e-6)
    best = minimize(
        lambda x: -dense_log_likelihood(y, np.exp(x[:2]), x[2:]),
        [0.0, -3.0, *BETA],
        method="Nelder-Mead",
        options={"fatol": 1e-6, "maxfev": 4000},
    )
    assert found.log_likelihood == pytest.approx(-best.fun, abs=1e-3)
    assert found.beta == pytest.approx(best.x[2:], abs=0.05)
    weighted = np.linalg.solve(compute_covariance(found.theta), REGRESSORS.T)
    covariance = np.linalg.inv(REGRESSORS @ weighted)
    np.testing.assert_allclose(found.beta_covariance, covariance, rtol=1e-3)
    assert found.beta == pytest.approx(covariance @ weighted.T @ y, rel=1e-3, abs=1e-5)
    assert found.residual == pytest.approx((y - found.beta @ REGRESSORS) ** 2, abs=1e-9)


def test_every_start_gives_the_same_maximum():
    y = draw_coefficients(5)
    heights = [fit(y, start=start).log_likelihood for start in ((1.0, 1.0), (0.0, 3.0), (100.0, 0.0), (1e-4, 1e-4))]
    assert max(heights) - min(heights) < 1e-3


def test_variances_are_not_negative():
    """The lowest coefficients are too small for white noise, so a negative variance would increase the likelihood."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        y = rng.standard_normal(n - 1)
        y[:6] *= 0.3
        found = fit(y)
        assert found.theta[1] == 0.0
        assert found.theta[0] == pytest.approx(np.mean(y**2), rel=1e-4)
        more = dense_log_likelihood(y, (found.theta[0], 1e-4))
        assert more < found.log_likelihood


def test_constant_variance_is_kept():
    y = draw_coefficients(7)
    constant = 0.3
    found = fit(y, constant=constant)
    assert found.variance == pytest.approx(found.theta @ BASES + constant)
    # a constant variance is white noise too: the sum is what is fitted
    assert found.theta[0] + constant == pytest.approx(fit(y).theta[0], rel=1e-3)


def test_stated_errors_equal_the_scatter_of_many_runs():
    found = [fit(draw_coefficients(seed, (1.0, 0.3), BETA), REGRESSORS) for seed in range(300)]
    sizes = np.array([np.append(one.theta, one.beta) for one in found])
    stated = [
        np.append(np.linalg.inv(one.theta_information).diagonal(), one.beta_covariance.diagonal()) for one in found
    ]
    # scatter of 300 runs: 4 %; the information is that of the variances that were fitted, not of the true ones
    assert np.std(sizes, axis=0) == pytest.approx(np.sqrt(np.mean(stated, axis=0)), rel=0.15)
    assert np.mean(sizes, axis=0) == pytest.approx((1.0, 0.3, *BETA), rel=0.15)


def test_wide_bin_is_the_sum_of_its_coefficients():
    rng = np.random.default_rng(1)
    binned = build_frequency_bins(3000, 100.0)
    y = rng.standard_normal(2999)
    regressors = rng.standard_normal((2, 2999))
    bases = np.array([np.ones(binned.count.size), 1.0 / binned.f_hz])
    products = np.array([[binned.sum_over_bins(a * b) for b in (y, *regressors)] for a in (y, *regressors)])
    sums = BinnedRegressionSums(products[0, 0], products[1:, 0], products[1:, 1:])
    found = maximise_whittle_likelihood(binned.count, sums, bases, np.zeros(binned.count.size), np.ones(2))
    each = binned.expand_to_coefficients(found.variance)
    left = y - found.beta @ regressors
    assert found.log_likelihood == pytest.approx(-0.5 * np.sum(np.log(each) + left**2 / each))
    assert found.residual == pytest.approx(binned.sum_over_bins(left**2))
    information = 0.5 * (binned.count * bases / found.variance**2) @ bases.T
    assert found.theta_information == pytest.approx(information, rel=0.01)


def test_equal_regressors_share_their_coefficient():
    y = draw_coefficients(2, beta=(3.0, 0.0, 0.0))
    one = fit(y, REGRESSORS[:1])
    twice = fit(y, REGRESSORS[[0, 0]])
    assert twice.log_likelihood == pytest.approx(one.log_likelihood, abs=1e-3)
    assert twice.beta.sum() == pytest.approx(one.beta[0], rel=1e-4)


def test_zeros_have_a_finite_likelihood():
    found = fit(np.zeros(n - 1))
    assert np.isfinite(found.log_likelihood)
