"""Whittle likelihood of one axis, maximised over the variances of the noise and the sizes of the regressors together.

The coefficients of an axis are independent and Gaussian (Whittle 1953, on the cosine transform). In bin b they have the
variance

    v_b = c_b + Σ_j θ_j B_jb,    θ_j ≥ 0,

about the mean Σ_i β_i R_ik, so that

    ln L = −½ Σ_b [ count_b ln v_b + P_b(β)/v_b ],    P_b = Σ_k (Y_k − Σ β_i R_ik)².

The regressors R depend on time, temperature or another axis. The likelihood needs only sums over bins of products of
the samples and the regressors. θ is found by Fisher scoring. Coordinate descent on the quadratic form keeps the bound θ
≥ 0. For the current v, β is found by generalised least squares. Both steps alternate until ln L no longer increases. A
step that does not increase ln L is halved.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.reconcile.preparation.cosine_bins import Bins

MAX_FIT_ITERATIONS: Final = 200
"""Largest number of iterations."""
CONVERGENCE_NATS: Final = 1e-5
"""Gain in nats below which the iteration stops."""
MIN_VARIANCE_RATIO: Final = 1e-20
"""Lower limit of a variance, relative to the largest power of a bin."""


@dataclass(frozen=True, slots=True)
class BinSums:
    """Sums over bins that the likelihood needs."""

    power: Floats  # [m] Σ Y²
    cross: Floats  # [q, m] Σ R_i Y
    gram: Floats  # [q, q, m] Σ R_i R_j


@dataclass(frozen=True, slots=True)
class WhittleFit:
    """Maximum of the likelihood."""

    theta: Floats  # [p] variances
    beta: Floats  # [q] sizes of the regressors
    variance: Floats  # [m] variance of a coefficient in each bin
    residual: Floats  # [m] sum of squares in each bin after the regressors are removed
    log_likelihood: float
    theta_information: Floats  # [p, p] Fisher information of θ
    beta_covariance: Floats  # [q, q] covariance of β


def bin_sums(bins: Bins, y: Floats, regressors: Floats) -> BinSums:
    """Return the sums over bins of an axis and its regressors.

    Parameters
    ----------
    bins : Bins
        Frequency bins.
    y : ndarray of float64, shape (n − 1,)
        Transform coefficients of the axis.
    regressors : ndarray of float64, shape (q, n − 1)
        Transform coefficients of the regressors.
    """
    q, m = len(regressors), bins.count.size
    cross, gram = np.empty((q, m)), np.empty((q, q, m))
    for i in range(q):
        cross[i] = bins.sums(regressors[i] * y)
        for j in range(i + 1):
            gram[i, j] = gram[j, i] = bins.sums(regressors[i] * regressors[j])
    return BinSums(bins.sums(y * y), cross, gram)


def maximise_whittle(count: Floats, found: BinSums, bases: Floats, constant: Floats, start: Floats) -> WhittleFit:
    """Return the θ and β with the largest likelihood.

    Parameters
    ----------
    count : ndarray of float64, shape (m,)
        Number of coefficients in each bin.
    found : Sums
        Sums over bins of the axis and its regressors.
    bases : ndarray of float64, shape (p, m)
        Variance of a coefficient for θ_j = 1.
    constant : ndarray of float64, shape (m,)
        Variance that is not fitted.
    start : ndarray of float64, shape (p,)
        Starting values of θ.
    """
    least = MIN_VARIANCE_RATIO * float((found.power / np.maximum(count, 1.0)).max(initial=0.0)) or MIN_VARIANCE_RATIO
    theta, beta, variance, residual, likelihood, information, normal = _maximise(
        count, found.power, found.cross, found.gram, bases, constant + least, np.maximum(start, 0.0)
    )
    covariance = np.linalg.pinv(normal) if beta.size else np.zeros((0, 0))
    return WhittleFit(theta, beta, variance, residual, float(likelihood), information, covariance)


@compiled
def _maximise(count, power, cross, gram, bases, constant, start):  # type: ignore[no-untyped-def]
    """Alternate Fisher scoring for θ and least squares for β until the log-likelihood no longer increases."""
    p, m = bases.shape
    q = cross.shape[0]
    theta = start.copy()
    beta = np.zeros(q)
    normal = np.zeros((q, q))
    variance = _variance(bases, constant, theta)
    residual = power.copy()
    if q:
        beta, normal = _regress(cross, gram, variance)
        residual = _residual(power, cross, gram, beta)
    best = _log_likelihood(count, variance, residual)
    information = np.zeros((p, p))
    for _ in range(MAX_FIT_ITERATIONS):
        gradient = np.zeros(p)
        for j in range(p):
            total = 0.0
            for b in range(m):
                total += 0.5 * bases[j, b] * (residual[b] / variance[b] - count[b]) / variance[b]
            gradient[j] = total
            for i in range(j + 1):
                total = 0.0
                for b in range(m):
                    total += 0.5 * count[b] * bases[j, b] * bases[i, b] / variance[b] ** 2
                information[j, i] = total
                information[i, j] = total
        aim = _nonnegative_maximum(information, gradient, theta)
        climbed = False
        share = 1.0
        for _ in range(12):
            trial = theta + share * (aim - theta)
            trial_variance = _variance(bases, constant, trial)
            trial_beta, trial_normal, trial_residual = beta, normal, residual
            if q:
                trial_beta, trial_normal = _regress(cross, gram, trial_variance)
                trial_residual = _residual(power, cross, gram, trial_beta)
            value = _log_likelihood(count, trial_variance, trial_residual)
            if value > best:
                climbed = value > best + CONVERGENCE_NATS
                theta, variance, beta, normal, residual, best = (
                    trial,
                    trial_variance,
                    trial_beta,
                    trial_normal,
                    trial_residual,
                    value,
                )
                break
            share *= 0.5
        if not climbed:
            break
    return theta, beta, variance, residual, best, information, normal


@compiled
def _variance(bases, constant, theta):  # type: ignore[no-untyped-def]
    """Return the variance of a coefficient in each bin."""
    variance = constant.copy()
    for j in range(theta.size):
        if theta[j] > 0.0:
            for b in range(variance.size):
                variance[b] += theta[j] * bases[j, b]
    return variance


@compiled
def _log_likelihood(count, variance, residual):  # type: ignore[no-untyped-def]
    """Return the log-likelihood without its constant term."""
    total = 0.0
    for b in range(count.size):
        total -= 0.5 * (count[b] * np.log(variance[b]) + residual[b] / variance[b])
    return total


@compiled
def _regress(cross, gram, variance):  # type: ignore[no-untyped-def]
    """Return the generalised least-squares estimate of β and its normal matrix.

    A small ridge makes collinear regressors solvable.
    """
    q, m = cross.shape
    normal = np.zeros((q, q))
    right = np.zeros(q)
    for i in range(q):
        for b in range(m):
            right[i] += cross[i, b] / variance[b]
        for j in range(i + 1):
            total = 0.0
            for b in range(m):
                total += gram[i, j, b] / variance[b]
            normal[i, j] = total
            normal[j, i] = total
    scaled = np.zeros((q, q))
    size = np.zeros(q)
    for i in range(q):
        size[i] = np.sqrt(normal[i, i]) if normal[i, i] > 0.0 else 1.0
    for i in range(q):
        for j in range(q):
            scaled[i, j] = normal[i, j] / (size[i] * size[j])
        scaled[i, i] += 1e-10
    return np.linalg.solve(scaled, right / size) / size, normal


@compiled
def _residual(power, cross, gram, beta):  # type: ignore[no-untyped-def]
    """Return the sum of squares in each bin after the regressors are removed."""
    q, m = cross.shape
    left = power.copy()
    for b in range(m):
        for i in range(q):
            left[b] -= 2.0 * beta[i] * cross[i, b]
            for j in range(q):
                left[b] += beta[i] * beta[j] * gram[i, j, b]
        if left[b] < 0.0:
            left[b] = 0.0  # negative only by rounding
    return left


@compiled
def _nonnegative_maximum(information, gradient, theta):  # type: ignore[no-untyped-def]
    """Return the maximum of the quadratic form over θ ≥ 0, by coordinate descent."""
    p = theta.size
    found = theta.copy()
    slope = gradient.copy()
    for _ in range(500):
        moved = 0.0
        for j in range(p):
            if information[j, j] <= 0.0:
                continue
            to = found[j] + slope[j] / information[j, j]
            if to < 0.0:
                to = 0.0
            by = to - found[j]
            if by != 0.0:
                for i in range(p):
                    slope[i] -= information[i, j] * by
                found[j] = to
                worth = by * by * information[j, j]
                if worth > moved:
                    moved = worth
        if moved < 1e-12:
            break
    return found
