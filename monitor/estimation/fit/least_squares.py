"""Compiled solver for small non-negative least-squares problems with correlated observations.

A ``LeastSquares`` object contains the observations at all τ, and ``tau_indices`` selects the τ to use. The code uses
loops because they compile several times faster than array expressions.
"""

from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled
from monitor.estimation.allan.uncertainty import NOISES
from monitor.estimation.fit.fit_kernel_types import LeastSquares

SINGULAR_COVARIANCE: Final = 1e-9
"""Pivot below which the correlation matrix of the observations counts as singular."""
SINGULAR_NORMAL: Final = 1e-12
"""Pivot below which the correlation matrix of the coefficients counts as singular."""

Q, N, B, K, R = range(5)
"""Indices of the coefficients in θ."""


@compiled
def _allan_covariance(theta: Floats, extra: float, c: Floats) -> float:
    """Return the covariance Σ_ab θ_a θ_b C^ab of two Allan variances; a negative Q² counts as zero.

    ``extra`` is added to N². It represents the white noise that missing samples add to the means of clusters.
    """
    q, n, b, k = max(theta[0], 0.0), theta[1] + extra, theta[2], theta[3]
    return float(
        q * (q * c[0] + 2.0 * (n * c[1] + b * c[2] + k * c[3]))
        + n * (n * c[4] + 2.0 * (b * c[5] + k * c[6]))
        + b * (b * c[7] + 2.0 * k * c[8])
        + k * k * c[9]
    )


@compiled
def compute_observation_variances(problem: LeastSquares, tau_indices: Ints, theta: Floats) -> None:
    """Compute the variances of the observations that a noise model predicts.

    Parameters
    ----------
    problem : LeastSquares
        Least-squares problem, whose field ``variance`` is overwritten.
    tau_indices : ndarray of int64
        Indices of the τ to use.
    theta : ndarray of float64, shape (5,)
        Squared coefficients of the noise model.
    """
    for i in tau_indices:
        stretch, extra = problem.stretch[i], problem.extra_white[i]
        problem.variance[i] = _allan_covariance(theta, extra * extra, problem.covariance[i, i]) * stretch * stretch


@compiled
def compute_weights(problem: LeastSquares, tau_indices: Ints, theta: Floats, full_covariance: bool) -> None:
    """Compute the weights V⁻¹ X, where V is the covariance matrix of the observations predicted by a noise model.

    Parameters
    ----------
    problem : LeastSquares
        Least-squares problem, whose fields ``variance`` and ``weighted`` are overwritten.
    tau_indices : ndarray of int64
        Indices of the τ to use.
    theta : ndarray of float64, shape (5,)
        Squared coefficients of the noise model.
    full_covariance : bool
        True to use the full covariance matrix, False to use the variances alone.
    """
    compute_observation_variances(problem, tau_indices, theta)
    if full_covariance and _whiten(problem, tau_indices, theta):
        return
    weighted, columns, variance = problem.weighted, problem.columns, problem.variance
    for i in tau_indices:
        for a in range(5):
            weighted[i, a] = columns[i, a] / variance[i]


@compiled
def _whiten(problem: LeastSquares, tau_indices: Ints, theta: Floats) -> bool:
    """Compute V⁻¹ X by Cholesky decomposition, and return False if the correlation matrix is singular."""
    # Fields are copied to local variables, because each access to a field in a loop changes a reference count.
    _, _, extra, stretch, columns, covariance, ignored_direction, variance, weighted, _, _ = problem
    m = tau_indices.size
    factor, column = np.empty((m, m)), np.empty(m)
    for k in range(m):
        for j in range(k + 1):
            i, h = tau_indices[k], tau_indices[j]
            x = (
                _allan_covariance(theta, extra[i] * extra[h], covariance[i, h]) * stretch[i] * stretch[h]
                + ignored_direction[i] * ignored_direction[h]
            )
            factor[k, j] = x / np.sqrt(variance[i] * variance[h])
    if not _factorize(factor, m, SINGULAR_COVARIANCE):
        return False
    for a in range(5):
        for k in range(m):
            column[k] = columns[tau_indices[k], a] / np.sqrt(variance[tau_indices[k]])
        _substitute(factor, m, column)
        for k in range(m):
            weighted[tau_indices[k], a] = column[k] / np.sqrt(variance[tau_indices[k]])
    return True


@compiled
def compute_normal_equations(problem: LeastSquares, tau_indices: Ints) -> None:
    """Compute the matrices Xᵀ V⁻¹ X and Xᵀ V⁻¹ y of the normal equations.

    A column of zeros represents a noise term that is not fitted.

    Parameters
    ----------
    problem : LeastSquares
        Least-squares problem with weights, whose fields ``normal`` and ``right`` are overwritten.
    tau_indices : ndarray of int64
        Indices of the τ to use.
    """
    level, columns, weighted, normal, right = (
        problem.level, problem.columns, problem.weighted, problem.normal, problem.right
    )  # fmt: skip
    for a in range(5):
        right[a] = 0.0
        for b in range(a + 1):
            normal[a, b] = 0.0
    for i in tau_indices:
        for a in range(5):
            right[a] += weighted[i, a] * level[i]
            for b in range(a + 1):
                normal[a, b] += weighted[i, a] * columns[i, b]
    for a in range(5):
        if normal[a, a] == 0.0:
            normal[a, a], right[a] = 1.0, -1.0
        for b in range(a):
            normal[b, a] = normal[a, b]


@compiled
def solve_nonnegative(normal: Floats, right_side: Floats, q_may_be_negative: bool, theta: Floats) -> None:
    """Solve the least-squares problem with the constraint that the squared coefficients are non-negative.

    The positive coefficients of the solution are those that satisfy the Kuhn–Tucker conditions.

    Parameters
    ----------
    normal : ndarray of float64, shape (5, 5)
        Matrix Xᵀ V⁻¹ X of the normal equations.
    right_side : ndarray of float64, shape (5,)
        Right-hand side Xᵀ V⁻¹ y of the normal equations.
    q_may_be_negative : bool
        True to allow a negative Q².
    theta : ndarray of float64, shape (5,)
        Output array for the solution.
    """
    for subset in range(2**NOISES - 1, 0, -1):
        if not solve_on_subset(normal, right_side, subset, theta):
            continue
        allowed = True
        for a in range(NOISES):
            if subset >> a & 1:
                allowed = allowed and (theta[a] >= 0.0 or (q_may_be_negative and a == Q))
            else:
                pull = right_side[a]
                for b in range(NOISES):
                    pull -= normal[a, b] * theta[b]
                allowed = allowed and pull <= 1e-9 * abs(right_side[a])
        if allowed:
            return
    for a in range(5):
        theta[a] = 0.0
    theta[N] = right_side[N] / normal[N, N]


@compiled
def solve_on_subset(normal: Floats, right_side: Floats, subset: int, solution: Floats) -> bool:
    """Solve the normal equations for a subset of the coefficients by Cholesky decomposition.

    Parameters
    ----------
    normal : ndarray of float64, shape (5, 5)
        Matrix Xᵀ V⁻¹ X of the normal equations.
    right_side : ndarray of float64, shape (5,)
        Right-hand side Xᵀ V⁻¹ y of the normal equations.
    subset : int
        Bit set of the coefficients.
    solution : ndarray of float64, shape (5,)
        Output array for the solution, which is zero outside the subset.

    Returns
    -------
    bool
        False if the matrix of the subset is singular.
    """
    terms, scale, factor, scaled = np.empty(5, np.int64), np.empty(5), np.empty((5, 5)), np.empty(5)
    for a in range(5):
        solution[a] = 0.0
    n = _factorize_on_subset(normal, subset, terms, scale, factor)
    if n < 0:
        return False
    for k in range(n):
        scaled[k] = right_side[terms[k]] * scale[k]
    _substitute(factor, n, scaled)
    for k in range(n):
        solution[terms[k]] = scaled[k] * scale[k]
    return True


@compiled
def _factorize_on_subset(normal: Floats, subset: int, terms: Ints, scale: Floats, factor: Floats) -> int:
    """Compute the Cholesky factor of the correlation matrix of a subset of the coefficients.

    ``terms`` receives the indices of the coefficients, and ``scale`` the factors that normalize them. The result is the
    number of coefficients, or -1 if the matrix is singular.
    """
    n = 0
    for a in range(5):
        if subset >> a & 1:
            terms[n], scale[n] = a, 1.0 / np.sqrt(normal[a, a])
            n += 1
    for k in range(n):
        for j in range(k + 1):
            factor[k, j] = normal[terms[k], terms[j]] * scale[k] * scale[j]
    return n if _factorize(factor, n, SINGULAR_NORMAL) else -1


@compiled
def _factorize(matrix: Floats, n: int, singular: float) -> bool:
    """Replace a correlation matrix [n, n] by its Cholesky factor, and return False if the matrix is singular."""
    for k in range(n):
        for j in range(k + 1):
            x = matrix[k, j]
            for c in range(j):
                x -= matrix[k, c] * matrix[j, c]
            if j < k:
                matrix[k, j] = x / matrix[j, j]
            elif x < singular:
                return False
            else:
                matrix[k, k] = np.sqrt(x)
    return True


@compiled
def _substitute(factor: Floats, n: int, x: Floats) -> None:
    """Solve a linear system in place, where ``factor`` is the Cholesky factor and x [n] the right-hand side."""
    for k in range(n):
        y = x[k]
        for c in range(k):
            y -= factor[k, c] * x[c]
        x[k] = y / factor[k, k]
    for k in range(n - 1, -1, -1):
        y = x[k]
        for c in range(k + 1, n):
            y -= factor[c, k] * x[c]
        x[k] = y / factor[k, k]


@compiled
def nonzero_term_bits(theta: Floats) -> int:
    """Return the bit set of the nonzero coefficients."""
    subset = 0
    for a in range(NOISES):
        if theta[a] != 0.0:
            subset |= 1 << a
    return subset


@compiled
def invert_on_subset(normal: Floats, subset: int, inverse: Floats) -> bool:
    """Compute the inverse of the normal matrix for a subset of the coefficients.

    Parameters
    ----------
    normal : ndarray of float64, shape (5, 5)
        Matrix Xᵀ V⁻¹ X of the normal equations.
    subset : int
        Bit set of the selected coefficients.
    inverse : ndarray of float64, shape (5, 5), or (4, 4) if the subset does not contain R
        Output array for the inverse, which is zero outside the subset.

    Returns
    -------
    bool
        False if the selected part of the normal matrix is singular.
    """
    terms, scale, factor, column = np.empty(5, np.int64), np.empty(5), np.empty((5, 5)), np.empty(5)
    for a in range(inverse.shape[0]):
        for b in range(inverse.shape[0]):
            inverse[a, b] = 0.0
    n = _factorize_on_subset(normal, subset, terms, scale, factor)
    for j in range(n):
        for k in range(n):
            column[k] = 1.0 if k == j else 0.0
        _substitute(factor, n, column)
        for k in range(n):
            inverse[terms[k], terms[j]] = column[k] * scale[k] * scale[j]
    return n >= 0
