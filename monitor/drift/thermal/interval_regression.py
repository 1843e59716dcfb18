"""Generalised least-squares regression of interval means whose noise is white noise plus a random walk.

A random walk of the bias correlates with any slow temperature by chance. Tests and intervals are therefore computed for
white noise plus a random walk with correlated increments. The ratio of the two variances and the correlation are
unknown, so each regression is repeated for every pair on a grid, the noise models. Their restricted log-likelihoods
(Harville, J. Am. Stat. Assoc. 72, 1977) are the weights with which p-values, coefficients and covariance matrices are
averaged. Tests and intervals therefore include the uncertainty of the noise model.

Flicker noise lies between white noise and a random walk, and is described by their sum. A constant bias is always
part of the regression. The measured rates of false positives and of intervals that contain the true value are given in
docs/measurements/thermal-models.md.
"""

from dataclasses import dataclass
from math import inf
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.compiled import compiled
from monitor.common.distributions import incomplete_beta

MIN_FREE: Final = 4
"""Minimum number of residual degrees of freedom of a regression."""
MIN_WEIGHT: Final = 1e-3
"""Minimum weight of a noise model, relative to the most likely one. Noise models with a smaller weight are omitted."""
WALK_RATIOS: Final = (0.0, *np.geomspace(1e-3, 1e3, 9).tolist())
"""Grid of the variance of the random walk increments, divided by the variance of the white noise."""
INCREMENT_CORRELATIONS: Final = (0.0, 0.5, 0.8, 0.95)
"""Grid of the correlation between successive increments of the random walk."""
NOISE_MODELS: Final = np.array(
    [(ratio, one) for ratio in WALK_RATIOS for one in INCREMENT_CORRELATIONS if ratio or not one]
)
"""Variance ratio and correlation of each noise model."""
MIN_NEW_SHARE: Final = 1e-4
"""Minimum fraction of a regressor that must be linearly independent of the preceding regressors."""


@dataclass(frozen=True, slots=True)
class RegressorTest:
    """Result of an F test of additional regressors."""

    p_value: float  # p-value, averaged over the noise models
    likelihood: float  # largest log-likelihood; comparable between regressions of the same means
    coefficients: Floats  # [m] coefficients of the most likely noise model, 0 for dependent regressors
    noise: Floats  # variance ratio and correlation of the most likely noise model


@dataclass(frozen=True, slots=True)
class CoefficientEstimate:
    """Coefficients of a regression, averaged over the noise models."""

    coefficients: Floats  # [m]
    covariance: Floats  # [m, m]
    degrees_of_freedom: int


@compiled
def whiten_columns(columns: Floats, known: np.ndarray, noise_models: Floats) -> tuple[Floats, Floats]:
    """Whiten columns with the prediction errors of a Kalman filter for each noise model.

    The state is the level of the random walk and its next increment. The initial level is unknown. Increments without
    correlation are those of an averaged random walk: their neighbours have the correlation 1/4.

    Parameters
    ----------
    columns : ndarray, shape (n, m)
        Regressors and values; rows that are not known are ignored.
    known : ndarray, shape (n,), bool
        True where the bias and the temperature are known; at least one.
    noise_models : ndarray, shape (g, 2)
        Variance of the random walk increments relative to the white noise, and their correlation.

    Returns
    -------
    whitened : ndarray, shape (g, known - 1, m)
        Prediction errors divided by their standard deviation for white noise of variance 1. The first known row
        determines the level.
    log_determinants : ndarray, shape (g,)
        Logarithm of the determinant of the covariance matrix of the differences between successive known rows.
    """
    n, m = columns.shape
    models = noise_models.shape[0]
    count = 0
    for i in range(n):
        if known[i]:
            count += 1
    whitened = np.empty((models, count - 1, m))
    log_determinants = np.zeros(models)
    level, increment = np.empty(m), np.empty(m)
    for g in range(models):
        ratio, correlation = noise_models[g, 0], noise_models[g, 1]
        stationary = ratio * (1.0 - correlation) / (1.0 + correlation) if correlation > 0.0 else 0.0
        driving = stationary * (1.0 - correlation**2)
        # The mean of a random walk without correlation over an interval differs from its level at the start.
        walk = 0.0 if correlation > 0.0 else ratio
        white, cross = 1.0 + walk / 3.0, 0.5 * walk
        ll = ld = dd = 0.0
        at = -1
        for i in range(n):
            if at < 0:
                if known[i]:
                    at = 0
                    for j in range(m):
                        level[j], increment[j] = columns[i, j], 0.0
                    ll, ld, dd = 1.0 + walk / 3.0 + stationary, correlation * stationary, stationary
                continue
            gain_l = gain_d = 0.0
            variance = ll + white
            if known[i]:
                gain_l, gain_d = (ll + ld + cross) / variance, correlation * ld / variance
                root = variance**0.5
                for j in range(m):
                    error = columns[i, j] - level[j]
                    whitened[g, at, j] = error / root
                    level[j] += increment[j] + gain_l * error
                    increment[j] = correlation * increment[j] + gain_d * error
                log_determinants[g] += np.log(variance)
                at += 1
            else:
                for j in range(m):
                    level[j] += increment[j]
                    increment[j] *= correlation
            ll, ld, dd = (
                ll + 2.0 * ld + dd + walk - gain_l**2 * variance,
                correlation * (ld + dd) - gain_l * gain_d * variance,
                correlation**2 * dd + driving - gain_d**2 * variance,
            )
    return whitened, log_determinants


@dataclass(frozen=True, slots=True)
class _Solution:
    """Regression with every noise model, in terms of orthonormal combinations of the regressors."""

    triangles: Floats  # [g, terms + 1, terms + 1] triangular factors of the whitened regressors and values
    log_determinants: Floats  # [g]
    kept: np.ndarray  # [terms] indices of the linearly independent regressors
    mixing: Floats  # [terms, terms] triangular factor of the independent regressors
    scale: Floats  # [m] norm of each regressor
    count: int  # number of whitened rows

    @property
    def free(self) -> int:
        """Return the residual degrees of freedom."""
        return self.count - self.kept.size

    @property
    def residual_squares(self) -> Floats:
        """Return the sum of the squared whitened residuals [g]."""
        return np.asarray(self.triangles[:, -1, -1] ** 2)

    def likely_models(self) -> tuple[np.ndarray, Floats]:
        """Return the indices and the weights of the noise models with at least MIN_WEIGHT."""
        diagonal = np.abs(np.diagonal(self.triangles, axis1=1, axis2=2)[:, :-1])
        restricted = -0.5 * (self.free * np.log(self.residual_squares) + self.log_determinants) - np.log(
            np.maximum(diagonal, 1e-300)
        ).sum(axis=1)
        weights = np.exp(restricted - restricted.max())
        models = np.flatnonzero(weights >= MIN_WEIGHT)
        return models, weights[models] / weights[models].sum()

    @property
    def max_log_likelihood(self) -> float:
        """Return the largest log-likelihood, which is comparable between regressions of the same means."""
        return float((-0.5 * (self.count * np.log(self.residual_squares) + self.log_determinants)).max())

    def coefficients(self, model: int) -> Floats:
        """Return the coefficients [m] of a noise model, 0 for dependent regressors."""
        found = np.zeros(self.scale.size)
        triangle = self.triangles[model]
        found[self.kept] = np.linalg.solve(self.mixing, np.linalg.solve(triangle[:-1, :-1], triangle[:-1, -1]))
        return found / self.scale


def _solve(y: Floats, columns: Floats, known: np.ndarray) -> _Solution | None:
    """Solve the regression for every noise model, or return None if there are too few interval means."""
    if int(known.sum()) <= MIN_FREE + 1:
        return None
    rows = columns[known]
    rows = rows - rows.mean(axis=0)
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    _, r = np.linalg.qr(rows / scale)
    kept = np.flatnonzero(np.abs(np.diag(r)) > MIN_NEW_SHARE)
    q, mixing = np.linalg.qr((rows / scale)[:, kept])
    values = y[known] - y[known].mean()
    whole = np.zeros((known.size, kept.size + 1))
    whole[known] = np.column_stack([q, values])
    whitened, log_determinants = whiten_columns(whole, known, NOISE_MODELS)
    if whitened.shape[1] - kept.size < MIN_FREE:
        return None
    triangles = np.asarray(np.linalg.qr(whitened, mode="r"))
    floor = max(np.finfo(float).eps * float(values @ values) ** 0.5, 1e-150)
    triangles[:, -1, -1] = np.maximum(np.abs(triangles[:, -1, -1]), floor)
    return _Solution(triangles, log_determinants, kept, mixing, scale, whitened.shape[1])


def f_test(y: Floats, nuisance: Floats, tested: Floats, known: np.ndarray) -> RegressorTest | None:
    """Perform the F test of additional regressors.

    Parameters
    ----------
    y : ndarray, shape (n,)
        Interval means.
    nuisance : ndarray, shape (n, k)
        Regressors of the null hypothesis, in addition to a constant.
    tested : ndarray, shape (n, m)
        Additional regressors.
    known : ndarray, shape (n,), bool
        True where ``y`` is known.

    Returns
    -------
    RegressorTest or None
        Result, or None if there are too few interval means or no independent additional regressor.
    """
    found = _solve(y, np.hstack([nuisance, tested]), known)
    if found is None:
        return None
    at, terms = int((found.kept < nuisance.shape[1]).sum()), found.kept.size
    if at == terms:
        return None
    models, weights = found.likely_models()
    left = found.residual_squares[models]
    gained = (found.triangles[models, at:terms, terms] ** 2).sum(axis=1)
    # These are the p-values of F = gained / (terms - at) / (left / free).
    p_values = incomplete_beta(0.5 * found.free, 0.5 * (terms - at), left / (left + gained))
    best = int(models[weights.argmax()])
    return RegressorTest(
        float(weights @ p_values), found.max_log_likelihood, found.coefficients(best), NOISE_MODELS[best]
    )


def max_log_likelihood(y: Floats, columns: Floats, known: np.ndarray) -> float:
    """Return the largest log-likelihood of all noise models, or -inf if there are too few interval means.

    Parameters
    ----------
    y : ndarray, shape (n,)
        Interval means.
    columns : ndarray, shape (n, m)
        Regressors, in addition to a constant.
    known : ndarray, shape (n,), bool
        True where ``y`` is known.
    """
    found = _solve(y, columns, known)
    return -inf if found is None else found.max_log_likelihood


def estimate_coefficients(y: Floats, columns: Floats, known: np.ndarray) -> CoefficientEstimate | None:
    """Estimate the coefficients of regressors, or return None if there are too few interval means.

    Parameters
    ----------
    y : ndarray, shape (n,)
        Interval means.
    columns : ndarray, shape (n, m)
        Regressors, in addition to a constant.
    known : ndarray, shape (n,), bool
        True where ``y`` is known.
    """
    found = _solve(y, columns, known)
    if found is None:
        return None
    mean, square = np.zeros(found.scale.size), np.zeros((found.scale.size, found.scale.size))
    for model, weight in zip(*found.likely_models(), strict=True):
        sizes = found.coefficients(model)
        inverse = np.linalg.inv(found.triangles[model, :-1, :-1] @ found.mixing) / found.scale[found.kept][:, None]
        own = np.outer(sizes, sizes)
        own[np.ix_(found.kept, found.kept)] += inverse @ inverse.T * found.residual_squares[model] / found.free
        mean += weight * sizes
        square += weight * own
    return CoefficientEstimate(mean, square - np.outer(mean, mean), found.free)


def estimate_white_noise(residuals: Floats, known: np.ndarray, noise: Floats) -> Floats:
    """Return the estimated white noise [known] in residuals [known] of a regression.

    Parameters
    ----------
    residuals : ndarray, shape (known,)
        Residuals of the known interval means.
    known : ndarray, shape (n,), bool
        True where the interval mean is known.
    noise : ndarray, shape (2,)
        Variance ratio and correlation of the noise model.
    """
    identity = np.zeros((known.size, residuals.size))
    identity[known] = np.eye(residuals.size)
    (whitener,), _ = whiten_columns(identity, known, noise[None, :])
    return np.asarray(whitener.T @ (whitener @ residuals))
