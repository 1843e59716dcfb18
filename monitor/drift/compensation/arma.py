"""Identification of ARMA(p, q) models for the gyro drift at rest, with p ≤ 2 and q ≤ 1.

The bias is averaged over successive intervals. The drift x in interval k and the interval mean z are modelled as

    x_k = φ1 x_{k−1} + φ2 x_{k−2} + a_k + θ1 a_{k−1},    z_k = μ + x_k + v_k

where a is the innovation and v is the white noise of an interval mean. The variance of v is estimated from the scatter
within the intervals. If the variance of v is zero, the model is that of Yuan et al. (2010). The state-space form of the
ARMA model uses Green's function (Pandit & Wu 1983):

    X_k = [x_k, x̂_{k+1|k}],  X_k = A X_{k−1} + B a_k,  A = [[0, 1], [φ2, φ1]],  B = [G0, G1]ᵀ,  G0 = 1, G1 = φ1 + θ1

A Kalman filter computes the exact likelihood, even if interval means are missing. The coefficients are expressed by
partial autocorrelations, so that the ARMA model is always stable and invertible (Monahan 1984).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import atanh, exp, log, pi, tanh
from typing import Final

import numpy as np

from drivers.data_types import Floats
from drivers.errors import NotReady
from monitor.common.compiled import compiled
from monitor.common.distributions import HALF_CHI2_95
from monitor.common.minimization import minimize_bfgs

Order = tuple[int, int]
"""Order (p, q) of an ARMA model."""
_Triple = tuple[float, float, float]

ORDERS: Final[tuple[Order, ...]] = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1))
"""Orders (p, q) from which the fit selects. Yuan et al. (2010) use (2, 1). The order (0, 0) means white noise."""
MIN_VALUES: Final = 30
"""Minimum number of interval means from which an ARMA model is identified."""
MAX_PARTIAL_AUTOCORRELATION: Final = 0.99999
MAX_COEFFICIENTS: Final = 3
"""Number of coefficients of the highest order. Only for this order can the likelihood have several maxima."""
MIN_MAXIMA_DISTANCE: Final = 0.1
"""Minimum difference between the partial autocorrelations at which two likelihood maxima count as distinct."""
BISECTION_STEPS: Final = 6
"""Number of bisection steps in the search for the end of a confidence interval."""
START_PARTIAL_AUTOCORRELATIONS: Final = {
    0: ((),),
    1: ((0.3,), (0.9,), (0.99,)),
    2: ((0.5, 0.0), (0.9, 0.0), (0.99, 0.0), (0.9, -0.5), (0.3, 0.4)),
}
"""Start values of the partial autocorrelations for each autoregressive order p."""
START_THETAS: Final = (-0.9, -0.5, 0.0, 0.5)
"""Start values of the moving-average coefficient."""
START_VARIANCE_SHARES: Final = (1e-3, 0.03, 0.5)
"""Start values of the innovation variance, relative to the variance of the interval means."""


@dataclass(frozen=True, slots=True)
class ArmaModel:
    """Identified ARMA model."""

    phi: tuple[float, float]  # φ1 and φ2; 0 for coefficients that are not part of the model
    theta: float
    variance: float  # variance of the innovation a, (rad/s)²
    mean: float = 0.0  # μ, rad/s
    white_variance: float = 0.0  # variance of the white noise v, (rad/s)²
    order: Order = (2, 1)
    # limits of the 95 % confidence intervals of φ1, φ2 and θ1; NaN if they are not computed
    lo: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    hi: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    count: int = 0  # number of interval means from which the model was identified

    @property
    def name(self) -> str:
        """Return the name of the ARMA model for display, for example "ARMA(2, 1)"."""
        return f"ARMA({self.order[0]}, {self.order[1]})" if self.order != (0, 0) else "constant"


def fit_arma(
    interval_means: Floats,
    white_variance: float = 0.0,
    orders: Sequence[Order] = ORDERS,
    with_confidence_intervals: bool = False,
) -> ArmaModel:
    """Fit an ARMA model of each given order, and return the model with the smallest BIC (Schwarz 1978).

    Parameters
    ----------
    interval_means : ndarray, shape (n,)
        Interval means in rad/s; NaN means missing.
    white_variance : float
        Variance of the white noise v of an interval mean, (rad/s)².
    orders : sequence of (p, q)
        Orders among which the fit selects.
    with_confidence_intervals : bool
        True to compute the confidence intervals of the coefficients. The fit then takes ten times as long.

    Raises
    ------
    NotReady
        If fewer than MIN_VALUES interval means are known, or if they are all equal.
    """
    known = interval_means[np.isfinite(interval_means)]
    if known.size < MIN_VALUES:
        raise NotReady(f"{known.size} values; at least {MIN_VALUES} are needed to identify a drift")
    origin, scale = float(np.median(known)), float(known.std())
    if not scale > 0.0:
        raise NotReady("all values are equal")
    unit = (interval_means - origin) / scale
    share = white_variance / scale**2
    likelihoods = [_ArmaLikelihood(unit, share, order) for order in orders]
    _, u, likelihood = min(((*_maximize(one), one) for one in likelihoods), key=lambda fit: fit[0])
    found = _to_model(likelihood, u, origin, scale)
    if not with_confidence_intervals:
        return found
    lo, hi = _confidence_intervals(likelihood, u)
    return replace(found, lo=lo, hi=hi)


@compiled
def _propagate_covariance(
    p11: float, p12: float, p22: float, phi1: float, phi2: float, g1: float, variance: float
) -> _Triple:
    """Return the elements p11, p12 and p22 of the predicted covariance matrix A P Aᵀ + variance · B Bᵀ."""
    return (
        p22 + variance,
        phi2 * p12 + phi1 * p22 + g1 * variance,
        phi2 * phi2 * p11 + 2.0 * phi1 * phi2 * p12 + phi1 * phi1 * p22 + g1 * g1 * variance,
    )


@compiled
def stationary_covariance(phi1: float, phi2: float, theta: float) -> _Triple:
    """Return the elements p11, p12 and p22 of the stationary covariance matrix for innovations of unit variance.

    Parameters
    ----------
    phi1, phi2 : float
        Autoregressive coefficients φ1 and φ2.
    theta : float
        Moving-average coefficient θ1.
    """
    g1 = phi1 + theta
    more = phi2 * phi2 + 2.0 * phi1 * phi2 * g1 / (1.0 - phi2) + g1 * g1
    p22 = more / (1.0 - phi2 * phi2 - phi1 * phi1 - 2.0 * phi1 * phi1 * phi2 / (1.0 - phi2))
    return p22 + 1.0, (phi1 * p22 + g1) / (1.0 - phi2), p22


@compiled
def compute_likelihood_sums(
    values: Floats, phi1: float, phi2: float, theta: float, innovation_variance: float, white_variance: float
) -> tuple[int, float, float, float]:
    """Compute the sums that determine the exact log-likelihood of an ARMA model, with a Kalman filter.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Interval means; NaN means missing.
    phi1, phi2, theta : float
        Coefficients φ1, φ2 and θ1.
    innovation_variance : float
        Variance of the innovation a, in squared units of the interval means.
    white_variance : float
        Variance of the white noise v, in squared units of the interval means.

    Returns
    -------
    count : int
        Number of values that are not missing.
    log_determinant : float
        Σ log S, where S is the variance of the Kalman filter innovation ε.
    square : float
        Σ ε²/S after subtraction of the estimated mean.
    mean : float
        Generalised least-squares estimate of the mean μ.
    """
    g1 = phi1 + theta
    p11, p12, p22 = stationary_covariance(phi1, phi2, theta)
    p11, p12, p22 = p11 * innovation_variance, p12 * innovation_variance, p22 * innovation_variance
    x1 = x2 = o1 = o2 = 0.0  # The filter also processes a series of ones, from whose innovations the mean is estimated.
    count, logs, zz, zo, oo = 0, 0.0, 0.0, 0.0, 0.0
    for k in range(values.size):
        if values[k] == values[k]:
            s = p11 + white_variance
            gain1, gain2 = p11 / s, p12 / s
            e, o = values[k] - x1, 1.0 - o1
            logs += np.log(s)
            zz, zo, oo, count = zz + e * e / s, zo + e * o / s, oo + o * o / s, count + 1
            x1, x2, o1, o2 = x1 + gain1 * e, x2 + gain2 * e, o1 + gain1 * o, o2 + gain2 * o
            p22 = p22 - gain2 * p12
            p11, p12 = white_variance * gain1, white_variance * gain2
        x1, x2 = x2, phi2 * x1 + phi1 * x2
        o1, o2 = o2, phi2 * o1 + phi1 * o2
        p11, p12, p22 = _propagate_covariance(p11, p12, p22, phi1, phi2, g1, innovation_variance)
    mean = zo / oo if oo > 0.0 else 0.0
    return count, logs, zz - mean * zo, mean


@dataclass(frozen=True, slots=True)
class _ArmaLikelihood:
    """Likelihood of the ARMA models of one order, as a function of the search parameters u.

    The search parameters are the inverse hyperbolic tangents of the partial autocorrelations and of θ1. If the white
    noise v has a positive variance, the logarithm of the innovation variance is an additional search parameter.
    """

    z: Floats  # [n] interval means; NaN means missing
    white: float  # variance of the white noise v
    order: Order

    @property
    def has_variance_parameter(self) -> bool:
        """True if the innovation variance is a search parameter."""
        return self.white > 0.0 and self.order != (0, 0)

    def start_parameters(self) -> list[Floats]:
        return [
            np.array(
                [
                    *map(atanh, partial),
                    *((atanh(theta),) if self.order[1] else ()),
                    *((log(share),) if self.has_variance_parameter else ()),
                ]
            )
            for partial in START_PARTIAL_AUTOCORRELATIONS[self.order[0]]
            for theta in (START_THETAS if self.order[1] else (0.0,))
            for share in (START_VARIANCE_SHARES if self.has_variance_parameter else (0.0,))
        ]

    def model_coefficients(self, u: Floats) -> tuple[float, float, float, float]:
        """Convert search parameters to φ1, φ2, θ1 and the innovation variance."""
        p, q = self.order
        partial = [
            max(min(tanh(one), MAX_PARTIAL_AUTOCORRELATION), -MAX_PARTIAL_AUTOCORRELATION)
            for one in u[: p + q].tolist()
        ]
        phi1 = phi2 = 0.0
        if p == 1:
            phi1 = partial[0]
        if p == 2:
            phi1, phi2 = partial[0] * (1.0 - partial[1]), partial[1]
        theta = partial[-1] if q else 0.0
        return phi1, phi2, theta, exp(min(max(float(u[-1]), -60.0), 60.0)) if self.has_variance_parameter else 1.0

    def log_likelihood(self, u: Floats) -> float:
        """Return the log-likelihood, maximised over the mean.

        Without white noise, the log-likelihood is also maximised over the innovation variance.
        """
        count, logs, square, _ = compute_likelihood_sums(self.z, *self.model_coefficients(u), self.white)
        if self.has_variance_parameter:
            return float(-0.5 * (count * log(2.0 * pi) + logs + square))
        size = max(square / count, 1e-300)
        return float(-0.5 * (count * (log(2.0 * pi * size) + 1.0) + logs))

    def negative_log_likelihood(self, u: Floats) -> float:
        return -self.log_likelihood(u)


def _maximize(likelihood: _ArmaLikelihood) -> tuple[float, Floats]:
    """Return the BIC of the model with the maximum likelihood, and its search parameters."""
    count = int(np.isfinite(likelihood.z).sum())
    loss, starts = likelihood.negative_log_likelihood, likelihood.start_parameters()
    tried = sorted((loss(u), i) for i, u in enumerate(starts))
    best, at = tried[0][0], starts[tried[0][1]]
    if at.size:
        for _, i in tried[:2]:
            least, place = minimize_bfgs(loss, starts[i], 1e-4 * count**0.5)
            if least < best:
                best, at = least, place
    return 2.0 * best + (at.size + 2) * log(count), at


def _to_model(likelihood: _ArmaLikelihood, u: Floats, origin: float, scale: float) -> ArmaModel:
    phi1, phi2, theta, variance = likelihood.model_coefficients(u)
    white = likelihood.white if likelihood.order != (0, 0) else 0.0
    count, _, square, mean = compute_likelihood_sums(likelihood.z, phi1, phi2, theta, variance, white)
    if white == 0.0:
        variance = square / count
    nothing = likelihood.order == (0, 0) and likelihood.white > 0.0
    return ArmaModel(
        phi=(phi1, phi2),
        theta=theta,
        variance=0.0 if nothing else variance * scale**2,
        mean=origin + scale * mean,
        white_variance=(variance if nothing else likelihood.white) * scale**2,
        order=likelihood.order,
        count=count,
    )


def _confidence_intervals(likelihood: _ArmaLikelihood, u: Floats) -> tuple[_Triple, _Triple]:
    """Compute the 95 % confidence intervals of φ1, φ2 and θ1 from the profile likelihood.

    If a root of the autoregressive polynomial nearly cancels θ1, the likelihood has a long ridge or two maxima. The
    curvature at the maximum would then underestimate the uncertainty. The confidence intervals therefore include all
    maxima within the 95 % limit.
    """
    p, q = likelihood.order
    there = (p > 0, p > 1, q > 0)
    tops = _likelihood_maxima(likelihood, u)
    best = max(map(likelihood.log_likelihood, tops))
    nothing = (np.nan, np.nan)
    ends = [[_interval_ends(likelihood, one, i, best) if there[i] else nothing for i in range(3)] for one in tops]
    lo, hi = np.min(ends, axis=0)[:, 0], np.max(ends, axis=0)[:, 1]
    return (float(lo[0]), float(lo[1]), float(lo[2])), (float(hi[0]), float(hi[1]), float(hi[2]))


def _likelihood_maxima(likelihood: _ArmaLikelihood, u: Floats) -> list[Floats]:
    """Return the search parameters at all likelihood maxima within the 95 % limit. The global maximum comes first."""
    found = [u]
    if sum(likelihood.order) == MAX_COEFFICIENTS:
        for start in likelihood.start_parameters():
            _, one = minimize_bfgs(likelihood.negative_log_likelihood, start, 0.1)
            if all(
                np.abs(np.tanh(one[:MAX_COEFFICIENTS]) - np.tanh(other[:MAX_COEFFICIENTS])).max() > MIN_MAXIMA_DISTANCE
                for other in found
            ):
                found.append(one)
    best = max(map(likelihood.log_likelihood, found))
    return [one for one in found if best - likelihood.log_likelihood(one) < HALF_CHI2_95]


def _interval_ends(likelihood: _ArmaLikelihood, u: Floats, which: int, top: float) -> tuple[float, float]:
    """Return the ends of the confidence interval of one coefficient around a likelihood maximum."""
    value = likelihood.model_coefficients(u)[which]
    largest = MAX_PARTIAL_AUTOCORRELATION * (1.0 if which or likelihood.order[0] < 2 else 2.0)
    found = []
    for limit in (-largest, largest):
        inside, outside, near = value, limit, np.delete(u, _parameter_index(likelihood.order, which))
        step = max(abs(limit - value) / 64.0, 1e-9)
        while abs(inside - limit) > 1e-9:  # The search for the end moves outwards in growing steps.
            further = inside + np.sign(limit - value) * min(step, abs(limit - inside))
            fallen, moved = _profile_likelihood(likelihood, which, float(further), near)
            if top - fallen > HALF_CHI2_95:
                outside = float(further)
                break
            inside, near, step = float(further), moved, 1.6 * step
        else:
            found.append(float(limit))
            continue
        for _ in range(BISECTION_STEPS):
            middle = 0.5 * (inside + outside)
            fallen, moved = _profile_likelihood(likelihood, which, middle, near)
            if top - fallen > HALF_CHI2_95:
                outside = middle
            else:
                inside, near = middle, moved
        found.append(0.5 * (inside + outside))
    return found[0], found[1]


def _parameter_index(order: Order, which: int) -> int:
    """Return the index of the search parameter that corresponds to φ1, φ2 or θ1."""
    return order[0] if which == 2 else which


def _profile_likelihood(likelihood: _ArmaLikelihood, which: int, value: float, near: Floats) -> tuple[float, Floats]:
    """Maximise the log-likelihood for a fixed coefficient, and return the maximum and its position."""
    at = _parameter_index(likelihood.order, which)

    def insert_coefficient_held_at_value(free: Floats) -> Floats:
        if which or likelihood.order[0] == 1:
            return np.insert(free, at, atanh(value))
        # the relation φ1 = r1 (1 − φ2) implies |φ1| < 1 − φ2
        highest = 1.0 - abs(value)
        phi2 = (
            -MAX_PARTIAL_AUTOCORRELATION
            + 0.5 * (1.0 + tanh(float(free[0]))) * (highest + MAX_PARTIAL_AUTOCORRELATION) * MAX_PARTIAL_AUTOCORRELATION
        )
        r1 = max(min(value / (1.0 - phi2), MAX_PARTIAL_AUTOCORRELATION), -MAX_PARTIAL_AUTOCORRELATION)
        return np.array([atanh(r1), atanh(phi2), *free[1:]])

    def loss(free: Floats) -> float:
        return likelihood.negative_log_likelihood(insert_coefficient_held_at_value(free))

    least, place = minimize_bfgs(loss, near, 1e-2) if near.size else (loss(near), near)
    return -least, place
