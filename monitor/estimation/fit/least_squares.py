"""Small weighted least-squares problems in compiled loops: five columns, non-negative, correlated observations.

The caller provides all arrays. ``columns`` and ``weighted`` = V⁻¹ columns hold all τ, and ``rows`` lists the τ in use.
The code uses loops because they compile several times faster than array expressions.
"""

from typing import Final

import numpy as np

from monitor.common.compiled import compiled
from monitor.estimation.allan.uncertainty import NOISES

SINGULAR: Final = 1e-9
"""Pivots of the correlation matrix below this value are rounding errors."""

Q, N, B, K, R = range(5)
"""Rows of the coefficients in θ."""


@compiled
def variance_form(theta, c):  # type: ignore[no-untyped-def]
    """Return Σ_ab θ_a θ_b C^ab for one entry of the table. A negative Q² stands for a band limit and adds nothing.

    Parameters
    ----------
    theta : ndarray of float64, shape (5,)
        Squared coefficients in units of one sample.
    c : ndarray of float64, shape (10,)
        Entry of ``Table.covariance``.
    """
    q, n, b, k = max(theta[0], 0.0), theta[1], theta[2], theta[3]
    return (
        q * (q * c[0] + 2.0 * (n * c[1] + b * c[2] + k * c[3]))
        + n * (n * c[4] + 2.0 * (b * c[5] + k * c[6]))
        + b * (b * c[7] + 2.0 * k * c[8])
        + k * k * c[9]
    )


@compiled
def variances(rows, theta, covariance, stretch, variance):  # type: ignore[no-untyped-def]
    """Compute the variances of σ²_i under the model.

    Parameters
    ----------
    rows : ndarray of int64
        Rows in use.
    theta : ndarray of float64, shape (5,)
        Squared coefficients of the model.
    covariance : ndarray of float64, shape (m, m, 10)
        See ``Table.covariance``.
    stretch : ndarray of float64, shape (m,)
        Square root of the terms in a window without gaps over the terms present.
    variance : ndarray of float64, shape (m,)
        Result.
    """
    for i in rows:
        variance[i] = variance_form(theta, covariance[i, i]) * stretch[i] * stretch[i]


@compiled
def whiten(rows, theta, covariance, stretch, columns, blind, variance, weighted):  # type: ignore[no-untyped-def]
    """Compute V⁻¹ columns by Cholesky decomposition of the correlations.

    Parameters
    ----------
    rows, theta, covariance, stretch, columns, blind, variance
        See ``weight_columns``.
    weighted : ndarray of float64, shape (m, 5)
        Result.

    Returns
    -------
    bool
        False if the correlation matrix is not positive definite.
    """
    m = rows.size
    factor = np.empty((m, m))
    for k in range(m):
        for j in range(k + 1):
            i, h = rows[k], rows[j]
            x = variance_form(theta, covariance[i, h]) * stretch[i] * stretch[h] + blind[i] * blind[h]
            x /= np.sqrt(variance[i] * variance[h])
            for c in range(j):
                x -= factor[k, c] * factor[j, c]
            if j < k:
                factor[k, j] = x / factor[j, j]
            elif x < SINGULAR:
                return False
            else:
                factor[k, k] = np.sqrt(x)
    for a in range(5):
        for k in range(m):
            x = columns[rows[k], a] / np.sqrt(variance[rows[k]])
            for c in range(k):
                x -= factor[k, c] * weighted[rows[c], a]
            weighted[rows[k], a] = x / factor[k, k]
        for k in range(m - 1, -1, -1):
            x = weighted[rows[k], a]
            for c in range(k + 1, m):
                x -= factor[c, k] * weighted[rows[c], a]
            weighted[rows[k], a] = x / factor[k, k]
        for k in range(m):
            weighted[rows[k], a] /= np.sqrt(variance[rows[k]])
    return True


@compiled
def weight_columns(rows, theta, covariance, stretch, columns, blind, full, variance, weighted):  # type: ignore[no-untyped-def]
    """Compute ``weighted`` = V⁻¹ columns with the covariance V of the τ under the model, or with its diagonal.

    Parameters
    ----------
    rows : ndarray of int64
        Rows in use.
    theta : ndarray of float64, shape (5,)
        Squared coefficients of the model.
    covariance : ndarray of float64, shape (m, m, 10)
        See ``Table.covariance``.
    stretch : ndarray of float64, shape (m,)
        Square root of the terms in a window without gaps over the terms present.
    columns : ndarray of float64, shape (m, 5)
        Columns of the fit.
    blind : ndarray of float64, shape (m,)
        Direction that the fit ignores. ``blind`` blindᵀ is added to V.
    full : bool
        True to use the covariances, False to use the variances alone.
    variance : ndarray of float64, shape (m,)
        Variances under the model, overwritten.
    weighted : ndarray of float64, shape (m, 5)
        Result.
    """
    variances(rows, theta, covariance, stretch, variance)
    if full and whiten(rows, theta, covariance, stretch, columns, blind, variance, weighted):
        return
    for i in rows:
        for a in range(5):
            weighted[i, a] = columns[i, a] / variance[i]


@compiled
def normal_equations(level, rows, columns, weighted, normal, right):  # type: ignore[no-untyped-def]
    """Compute Xᵀ V⁻¹ X and Xᵀ V⁻¹ y. A column of zeros is a term that is not fitted; its solution is zero.

    Parameters
    ----------
    level : ndarray of float64, shape (m,)
        Observations y.
    rows : ndarray of int64
        Rows in use.
    columns : ndarray of float64, shape (m, 5)
        Columns X of the fit.
    weighted : ndarray of float64, shape (m, 5)
        V⁻¹ X.
    normal : ndarray of float64, shape (5, 5)
        Result Xᵀ V⁻¹ X.
    right : ndarray of float64, shape (5,)
        Result Xᵀ V⁻¹ y.
    """
    for a in range(5):
        right[a] = 0.0
        for b in range(a + 1):
            normal[a, b] = 0.0
    for i in rows:
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
def solve_nonnegative(normal, right, free, theta):  # type: ignore[no-untyped-def]
    """Solve least squares with non-negative Q N B K by finding the subset that meets the Kuhn–Tucker conditions.

    Terms in the subset are positive, and the error would not decrease if one of the others grew.

    Parameters
    ----------
    normal : ndarray of float64, shape (5, 5)
        Normal matrix.
    right : ndarray of float64, shape (5,)
        Right-hand side.
    free : bool
        True if Q² may be negative.
    theta : ndarray of float64, shape (5,)
        Solution.
    """
    for subset in range(2**NOISES - 1, 0, -1):
        if not solve(normal, right, subset, theta):
            continue
        allowed = True
        for a in range(NOISES):
            if subset >> a & 1:
                allowed = allowed and (theta[a] >= 0.0 or (free and a == Q))
            else:
                pull = right[a]
                for b in range(NOISES):
                    pull -= normal[a, b] * theta[b]
                allowed = allowed and pull <= 1e-9 * abs(right[a])
        if allowed:
            return
    for a in range(5):
        theta[a] = 0.0
    theta[N] = right[N] / normal[N, N]


@compiled
def solve(normal, right, subset, solution):  # type: ignore[no-untyped-def]
    """Solve the normal equations on a subset of the columns by Cholesky decomposition, each column scaled to one.

    Parameters
    ----------
    normal : ndarray of float64, shape (5, 5)
        Normal matrix.
    right : ndarray of float64, shape (5,)
        Right-hand side.
    subset : int
        Bit set of the columns.
    solution : ndarray of float64, shape (5,)
        Solution, zero outside the subset.

    Returns
    -------
    bool
        False if the columns cannot be distinguished.
    """
    factor = np.zeros((5, 5))
    for a in range(5):
        solution[a] = 0.0
    for a in range(5):
        if not subset >> a & 1:
            continue
        y = right[a] / np.sqrt(normal[a, a])
        for b in range(a + 1):
            if not subset >> b & 1:
                continue
            x = normal[a, b] / np.sqrt(normal[a, a] * normal[b, b])
            for c in range(b):
                x -= factor[a, c] * factor[b, c]
            if b < a:
                factor[a, b] = x / factor[b, b]
            elif x < 1e-12:
                return False
            else:
                factor[a, a] = np.sqrt(x)
        for c in range(a):
            y -= factor[a, c] * solution[c]
        solution[a] = y / factor[a, a]
    for a in range(4, -1, -1):
        if not subset >> a & 1:
            continue
        x = solution[a]
        for c in range(a + 1, 5):
            x -= factor[c, a] * solution[c]
        solution[a] = x / factor[a, a]
    for a in range(5):
        if subset >> a & 1:
            solution[a] /= np.sqrt(normal[a, a])
    return True


@compiled
def nonzero_terms(theta):  # type: ignore[no-untyped-def]
    """Return the bit set of the terms that are not zero."""
    subset = 0
    for a in range(NOISES):
        if theta[a] != 0.0:
            subset |= 1 << a
    return subset


@compiled
def invert(normal, subset, inverse):  # type: ignore[no-untyped-def]
    """Compute the inverse [NOISES, NOISES] on the terms of a subset, zero elsewhere.

    Parameters
    ----------
    normal : ndarray of float64, shape (5, 5)
        Normal matrix.
    subset : int
        Bit set of the terms.
    inverse : ndarray of float64, shape (4, 4)
        Result.

    Returns
    -------
    bool
        False if the terms cannot be distinguished.
    """
    unit, solution = np.empty(5), np.empty(5)
    for a in range(NOISES):
        for b in range(5):
            unit[b] = 1.0 if b == a else 0.0
            solution[b] = 0.0
        if subset >> a & 1 and not solve(normal, unit, subset, solution):
            return False
        for b in range(NOISES):
            inverse[b, a] = solution[b]
    return True
