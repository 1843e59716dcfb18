"""Tests of the regression of interval means against explicit covariance matrices and the F distribution of SciPy."""

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.stats import f as f_distribution

from monitor.drift.thermal.interval_regression import (
    INCREMENT_CORRELATIONS,
    estimate_coefficients,
    estimate_white_noise,
    f_test,
    whiten_columns,
)

N = 40


def make_known(rng: np.random.Generator) -> np.ndarray:
    known = rng.random(N) > 0.2
    known[:2], known[10:15] = False, False
    return known


def difference_covariance(known: np.ndarray, ratio: float, correlation: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix that takes differences of known means, and the covariance matrix of these differences."""
    if correlation:
        increments = (1.0 - correlation) / (1.0 + correlation) * correlation ** np.arange(N - 1)
    else:
        increments = np.pad([2.0 / 3.0, 1.0 / 6.0], (0, N - 3))
    summation = np.tril(np.ones((N, N - 1)), -1)  # the first level is arbitrary
    walk = summation @ toeplitz(increments) @ summation.T
    differences = np.diff(np.eye(N)[known], axis=0)
    return differences, differences @ (np.eye(N) + ratio * walk) @ differences.T


@pytest.mark.parametrize("correlation", INCREMENT_CORRELATIONS)
@pytest.mark.parametrize("ratio", [0.0, 1e-3, 1.0, 1e3])
def test_whitening_agrees_with_the_covariance_matrix(ratio: float, correlation: float) -> None:
    rng = np.random.default_rng(1)
    known, columns = make_known(rng), rng.standard_normal((N, 3)).cumsum(axis=0)
    differences, covariance = difference_covariance(known, ratio, correlation)
    (white,), (log_determinant,) = whiten_columns(columns, known, np.array([[ratio, correlation]]))
    expected = (differences @ columns).T @ np.linalg.solve(covariance, differences @ columns)
    np.testing.assert_allclose(white.T @ white, expected, rtol=1e-9)
    assert log_determinant == pytest.approx(np.linalg.slogdet(covariance)[1], rel=1e-9, abs=1e-9)


def test_white_noise_is_separated_from_the_random_walk() -> None:
    rng = np.random.default_rng(2)
    known, noise = make_known(rng), np.array([0.5, 0.0])
    residuals = rng.standard_normal(int(known.sum())).cumsum()
    differences, covariance = difference_covariance(known, *noise)
    expected = differences[:, known].T @ np.linalg.solve(covariance, differences[:, known] @ residuals)
    np.testing.assert_allclose(estimate_white_noise(residuals, known, noise), expected, atol=1e-9)


def test_white_noise_gives_the_p_value_of_ordinary_regression() -> None:
    """If white noise is by far the most likely model, the coefficients are those of ordinary least squares."""
    rng = np.random.default_rng(3)
    n = 2000
    x, y, known = rng.standard_normal((n, 2)), rng.standard_normal(n), np.ones(n, bool)
    y += 0.05 * x[:, 1]
    rows = np.column_stack([np.ones(n), x])
    expected, (square,), *_ = np.linalg.lstsq(rows, y, rcond=None)
    (null,) = np.linalg.lstsq(rows[:, :2], y, rcond=None)[1]
    found, estimate = f_test(y, x[:, :1], x[:, 1:], known), estimate_coefficients(y, x, known)
    assert found is not None
    assert estimate is not None
    assert found.p_value == pytest.approx(f_distribution.sf((null - square) / (square / (n - 3)), 1, n - 3), rel=0.1)
    np.testing.assert_allclose(estimate.coefficients, expected[1:], rtol=0.05)
    covariance = square / (n - 3) * np.linalg.inv(rows.T @ rows)[1:, 1:]
    np.testing.assert_allclose(np.diag(estimate.covariance), np.diag(covariance), rtol=0.1)


def test_dependent_or_too_many_regressors_are_not_tested() -> None:
    rng = np.random.default_rng(4)
    x, y, known = rng.standard_normal((N, 1)), rng.standard_normal(N), np.ones(N, bool)
    assert f_test(y, x, 2.0 * x + 1.0, known) is None
    assert f_test(y[:6], x[:6], rng.standard_normal((6, 3)), known[:6]) is None
    assert estimate_coefficients(y[:4], x[:4], known[:4]) is None
