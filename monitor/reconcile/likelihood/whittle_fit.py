"""Whittle likelihood of one axis, maximised over noise variances and regressor sizes.

The cosine transform coefficients Y_k of an axis are independent and Gaussian (Whittle 1953). The mean of Y_k is Σ_i β_i
R_ik with the regressor transforms R_i and the regressor sizes β_i. The variance of the n_b coefficients in bin b is

    v_b = c_b + Σ_j θ_j B_jb,    θ_j ≥ 0,

with the fixed variance c_b, the variance bases B_j and the squared sizes θ_j of the noise effects. With the residual
power P_b = Σ_k (Y_k − Σ_i β_i R_ik)² of bin b, the log-likelihood is

    ln L = −½ Σ_b (n_b ln v_b + P_b/v_b).

Fisher scoring for θ and generalised least squares for β alternate until ln L converges.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.compiled import compiled

MAX_FIT_ITERATIONS: Final = 200
MAX_STEP_HALVINGS: Final = 12
CONVERGENCE_NATS: Final = 1e-5
MIN_VARIANCE_RATIO: Final = 1e-20
"""Lower limit of a variance, relative to the largest power of a bin."""


@dataclass(frozen=True, slots=True)
class BinnedRegressionSums:
    """Sums of products of the axis Y and the regressors R over each frequency bin."""

    power: Floats  # [m] Σ Y²
    cross: Floats  # [q, m] Σ R_i Y
    gram: Floats  # [q, q, m] Σ R_i R_j


@dataclass(frozen=True)
class WhittleFit:
    """Maximum of the Whittle likelihood."""

    theta: Floats  # [p] variances
    beta: Floats  # [q] sizes of the regressors
    variance: Floats  # [m] variance of a coefficient in each bin
    residual: Floats  # [m] sum of squares in each bin after the regressors are removed
    log_likelihood: float
    theta_information: Floats  # [p, p] Fisher information of θ
    beta_information: Floats  # [q, q] Fisher information of β

    @cached_property
    def beta_covariance(self) -> Floats:
        """Covariance of β, shape (q, q)."""
        return np.asarray(np.linalg.pinv(self.beta_information)) if self.beta.size else np.zeros((0, 0))


def maximise_whittle_likelihood(
    count: Floats, sums: BinnedRegressionSums, variance_bases: Floats, fixed_variance: Floats, start_theta: Floats
) -> WhittleFit:
    """Maximise the Whittle likelihood over the noise variances θ and the regressor sizes β.

    Parameters
    ----------
    count : ndarray of float64, shape (m,)
        Number of coefficients in each bin.
    sums : BinnedRegressionSums
        Sums over bins of the products of the axis and the regressors.
    variance_bases : ndarray of float64, shape (p, m)
        Variance of a coefficient for θ_j = 1.
    fixed_variance : ndarray of float64, shape (m,)
        Variance that is not fitted.
    start_theta : ndarray of float64, shape (p,)
        Starting values of θ.
    """
    floor = MIN_VARIANCE_RATIO * float((sums.power / np.maximum(count, 1.0)).max(initial=0.0)) or MIN_VARIANCE_RATIO
    theta, beta, variance, residual, likelihood, information, normal = _maximise(
        count,
        sums.power,
        np.ascontiguousarray(sums.cross),
        np.ascontiguousarray(sums.gram),
        np.ascontiguousarray(variance_bases),
        fixed_variance + floor,
        np.maximum(start_theta, 0.0),
    )
    return WhittleFit(theta, beta, variance, residual, float(likelihood), information, normal)


@compiled
def _maximise(
    count: Floats, power: Floats, cross: Floats, gram: Floats, bases: Floats, constant: Floats, start: Floats
) -> tuple[Floats, Floats, Floats, Floats, float, Floats, Floats]:
    theta = start.copy()
    variance, beta, normal, residual, best = _profile(theta, count, power, cross, gram, bases, constant)
    information = np.zeros((theta.size, theta.size))
    for _ in range(MAX_FIT_ITERATIONS):
        gradient = _score_and_information(count, bases, variance, residual, information)
        aim = _nonnegative_maximum(information, gradient, theta)
        before = best
        share = 1.0
        for _ in range(MAX_STEP_HALVINGS):
            trial = theta + share * (aim - theta)
            v, b, n, r, value = _profile(trial, count, power, cross, gram, bases, constant)
            if value > best:
                theta, variance, beta, normal, residual, best = trial, v, b, n, r, value
                break
            share *= 0.5
        if not best > before + CONVERGENCE_NATS:
            break
    return theta, beta, variance, residual, best, information, normal


@compiled
def _profile(
    theta: Floats, count: Floats, power: Floats, cross: Floats, gram: Floats, bases: Floats, constant: Floats
) -> tuple[Floats, Floats, Floats, Floats, float]:
    """Fit β for a given θ. Return the variances, β, the normal matrix, the residuals and the log-likelihood."""
    variance = constant.copy()
    for j in range(theta.size):
        if theta[j] > 0.0:
            for b in range(variance.size):
                variance[b] += theta[j] * bases[j, b]
    q = cross.shape[0]
    beta, normal, residual = np.zeros(q), np.zeros((q, q)), power.copy()
    if q:
        beta, normal = _regress(cross, gram, variance)
        residual = _residual(power, cross, gram, beta)
    total = 0.0
    for b in range(count.size):
        total -= 0.5 * (count[b] * np.log(variance[b]) + residual[b] / variance[b])
    return variance, beta, normal, residual, total


@compiled
def _score_and_information(
    count: Floats, bases: Floats, variance: Floats, residual: Floats, information: Floats
) -> Floats:
    p = bases.shape[0]
    gradient = np.zeros(p)
    slope, weight = 0.5 * (residual / variance - count) / variance, 0.5 * count / variance**2
    for j in range(p):
        gradient[j] = np.dot(bases[j], slope)
        weighted = bases[j] * weight
        for i in range(j + 1):
            information[j, i] = information[i, j] = np.dot(weighted, bases[i])
    return gradient


@compiled
def _regress(cross: Floats, gram: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Return the generalised least-squares estimate of β and the normal matrix.

    A small ridge term allows collinear regressors.
    """
    q = cross.shape[0]
    weight = 1.0 / variance
    normal = np.zeros((q, q))
    right = np.zeros(q)
    for i in range(q):
        right[i] = np.dot(cross[i], weight)
        for j in range(i + 1):
            normal[i, j] = normal[j, i] = np.dot(gram[i, j], weight)
    scaled = np.zeros((q, q))
    scale = np.zeros(q)
    for i in range(q):
        scale[i] = np.sqrt(normal[i, i])
        if normal[i, i] <= 0.0:  # a regressor without values in this recording, whose product is a rounding error
            scale[i], right[i] = 1.0, 0.0
    for i in range(q):
        for j in range(q):
            scaled[i, j] = normal[i, j] / (scale[i] * scale[j])
        scaled[i, i] += 1e-10
    return np.linalg.solve(scaled, right / scale) / scale, normal


@compiled
def _residual(power: Floats, cross: Floats, gram: Floats, beta: Floats) -> Floats:
    q, m = cross.shape
    left = power.copy()
    for i in range(q):
        for b in range(m):
            left[b] -= 2.0 * beta[i] * cross[i, b]
        for j in range(q):
            for b in range(m):
                left[b] += beta[i] * beta[j] * gram[i, j, b]
    return np.maximum(left, 0.0)  # negative only by rounding


@compiled
def _nonnegative_maximum(information: Floats, gradient: Floats, theta: Floats) -> Floats:
    """Maximise the quadratic approximation of the log-likelihood over θ ≥ 0 by coordinate descent."""
    p = theta.size
    found = theta.copy()
    slope = gradient.copy()
    for _ in range(500):
        largest_gain = 0.0
        for j in range(p):
            if information[j, j] <= 0.0:
                continue
            new = max(found[j] + slope[j] / information[j, j], 0.0)
            change = new - found[j]
            if change != 0.0:
                for i in range(p):
                    slope[i] -= information[i, j] * change
                found[j] = new
                largest_gain = max(largest_gain, change * change * information[j, j])
        if largest_gain < 1e-12:
            break
    return found
