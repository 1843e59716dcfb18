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
    log_likelihood: float = np.nan  # logarithm of the maximum likelihood
    bic: float = np.nan
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
    best = min((_fit_order(unit, share, order) for order in orders), key=lambda one: one[0])
    found = _to_model(unit, share, origin, scale, best)
    if not with_confidence_intervals:
        return found
    lo, hi = _confidence_intervals(unit, share, *best[1:])
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


_OrderFit = tuple[float, Order, Floats]  # BIC, order and search parameters


def _fit_order(z: Floats, white: float, order: Order) -> _OrderFit:
    """Fit an ARMA model of the given order by maximum likelihood.

    The search parameters are the inverse hyperbolic tangents of the partial autocorrelations and of θ1. If the white
    noise v has a positive variance, the logarithm of the innovation variance is an additional search parameter.
    """
    count = int(np.isfinite(z).sum())
    free = sum(order) + (white > 0.0 and order != (0, 0))

    def loss(u: Floats) -> float:
        return -_log_likelihood(z, white, order, u)

    starts = _start_parameters(white, order)
    tried = sorted(((loss(u), i) for i, u in enumerate(starts)))
    best, at = tried[0][0], starts[tried[0][1]]
    if free:
        for _, i in tried[:2]:
            least, place = minimize_bfgs(loss, starts[i], 1e-4 * count**0.5)
            if least < best:
                best, at = least, place
    return 2.0 * best + (free + 2) * log(count), order, at


def _start_parameters(white: float, order: Order) -> list[Floats]:
    return [
        np.array([*map(atanh, partial), *((atanh(theta),) if order[1] else ()), *((log(share),) if share else ())])
        for partial in START_PARTIAL_AUTOCORRELATIONS[order[0]]
        for theta in (START_THETAS if order[1] else (0.0,))
        for share in (START_VARIANCE_SHARES if white > 0.0 and order != (0, 0) else (0.0,))
    ]


def _log_likelihood(z: Floats, white: float, order: Order, u: Floats) -> float:
    """Return the log-likelihood, maximised over the mean.

    Without white noise, the log-likelihood is also maximised over the innovation variance.
    """
    phi1, phi2, theta, variance = _model_coefficients(order, u, white)
    count, logs, square, _ = compute_likelihood_sums(z, phi1, phi2, theta, variance, white)
    if white > 0.0 and order != (0, 0):
        return float(-0.5 * (count * log(2.0 * pi) + logs + square))
    size = max(square / count, 1e-300)
    return float(-0.5 * (count * (log(2.0 * pi * size) + 1.0) + logs))


def _model_coefficients(order: Order, u: Floats, white: float) -> tuple[float, float, float, float]:
    """Convert search parameters to φ1, φ2, θ1 and the innovation variance."""
    partial = [
        max(min(tanh(one), MAX_PARTIAL_AUTOCORRELATION), -MAX_PARTIAL_AUTOCORRELATION)
        for one in u[: order[0] + order[1]].tolist()
    ]
    phi1 = phi2 = 0.0
    if order[0] == 1:
        phi1 = partial[0]
    if order[0] == 2:
        phi1, phi2 = partial[0] * (1.0 - partial[1]), partial[1]
    theta = partial[-1] if order[1] else 0.0
    free = white > 0.0 and order != (0, 0)
    return phi1, phi2, theta, exp(min(max(float(u[-1]), -60.0), 60.0)) if free else 1.0


def _to_model(z: Floats, white: float, origin: float, scale: float, best: _OrderFit) -> ArmaModel:
    bic, order, u = best
    phi1, phi2, theta, variance = _model_coefficients(order, u, white)
    seen = white if order != (0, 0) else 0.0
    count, _, square, mean = compute_likelihood_sums(z, phi1, phi2, theta, variance, seen)
    if seen == 0.0:
        variance = square / count
    nothing = order == (0, 0) and white > 0.0
    return ArmaModel(
        phi=(phi1, phi2),
        theta=theta,
        variance=0.0 if nothing else variance * scale**2,
        mean=origin + scale * mean,
        white_variance=(variance if nothing else white) * scale**2,
        order=order,
        log_likelihood=_log_likelihood(z, white, order, u) - count * log(scale),
        bic=bic + 2.0 * count * log(scale),
        count=count,
    )


def _confidence_intervals(z: Floats, white: float, order: Order, u: Floats) -> tuple[_Triple, _Triple]:
    """Compute the 95 % confidence intervals of φ1, φ2 and θ1 from the profile likelihood.

    If a root of the autoregressive polynomial nearly cancels θ1, the likelihood has a long ridge or two maxima. The
    curvature at the maximum would then underestimate the uncertainty. The confidence intervals therefore include all
    maxima within the 95 % limit.
    """
    there = (order[0] > 0, order[0] > 1, order[1] > 0)
    tops = _likelihood_maxima(z, white, order, u)
    best = max(_log_likelihood(z, white, order, one) for one in tops)
    nothing = (np.nan, np.nan)
    ends = [[_interval_ends(z, white, order, one, i, best) if there[i] else nothing for i in range(3)] for one in tops]
    lo, hi = np.min(ends, axis=0)[:, 0], np.max(ends, axis=0)[:, 1]
    return (float(lo[0]), float(lo[1]), float(lo[2])), (float(hi[0]), float(hi[1]), float(hi[2]))


def _likelihood_maxima(z: Floats, white: float, order: Order, u: Floats) -> list[Floats]:
    """Return the search parameters at all likelihood maxima within the 95 % limit. The global maximum comes first."""
    found = [u]
    if sum(order) == MAX_COEFFICIENTS:
        for start in _start_parameters(white, order):
            _, one = minimize_bfgs(lambda u: -_log_likelihood(z, white, order, u), start, 0.1)
            if all(
                np.abs(np.tanh(one[:MAX_COEFFICIENTS]) - np.tanh(other[:MAX_COEFFICIENTS])).max() > MIN_MAXIMA_DISTANCE
                for other in found
            ):
                found.append(one)
    best = max(_log_likelihood(z, white, order, one) for one in found)
    return [one for one in found if best - _log_likelihood(z, white, order, one) < HALF_CHI2_95]


def _interval_ends(z: Floats, white: float, order: Order, u: Floats, which: int, top: float) -> tuple[float, float]:
    """Return the ends of the confidence interval of one coefficient around a likelihood maximum."""
    value = _model_coefficients(order, u, white)[which]
    limits = (
        (-MAX_PARTIAL_AUTOCORRELATION, MAX_PARTIAL_AUTOCORRELATION)
        if which or order[0] < 2
        else (-2.0 * MAX_PARTIAL_AUTOCORRELATION, 2.0 * MAX_PARTIAL_AUTOCORRELATION)
    )
    found = []
    for limit in limits:
        inside, outside, near = value, limit, _free_parameters(order, u, which)
        step = max(abs(limit - value) / 64.0, 1e-9)
        while abs(inside - limit) > 1e-9:  # The search for the end moves outwards in growing steps.
            further = inside + np.sign(limit - value) * min(step, abs(limit - inside))
            fallen, moved = _profile_likelihood(z, white, order, which, float(further), near)
            if top - fallen > HALF_CHI2_95:
                outside = float(further)
                break
            inside, near, step = float(further), moved, 1.6 * step
        else:
            found.append(float(limit))
            continue
        for _ in range(BISECTION_STEPS):
            middle = 0.5 * (inside + outside)
            fallen, moved = _profile_likelihood(z, white, order, which, middle, near)
            if top - fallen > HALF_CHI2_95:
                outside = middle
            else:
                inside, near = middle, moved
        found.append(0.5 * (inside + outside))
    return found[0], found[1]


def _free_parameters(order: Order, u: Floats, which: int) -> Floats:
    """Return the search parameters except the parameter that corresponds to a fixed coefficient."""
    held = order[0] if which == 2 else which
    return np.delete(u, held)


def _profile_likelihood(
    z: Floats, white: float, order: Order, which: int, value: float, near: Floats
) -> tuple[float, Floats]:
    """Maximise the log-likelihood for a fixed coefficient, and return the maximum and its position."""

    def insert_coefficient_held_at_value(free: Floats) -> Floats:
        u = np.insert(free, order[0] if which == 2 else which, 0.0)
        if which == 2:
            u[order[0]] = atanh(value)
        elif order[0] == 1 or which == 1:
            u[which] = atanh(value)
        else:  # the relation φ1 = r1 (1 − φ2) implies |φ1| < 1 − φ2
            highest = 1.0 - abs(value)
            phi2 = (
                -MAX_PARTIAL_AUTOCORRELATION
                + 0.5
                * (1.0 + tanh(float(u[1])))
                * (highest + MAX_PARTIAL_AUTOCORRELATION)
                * MAX_PARTIAL_AUTOCORRELATION
            )
            u[1] = atanh(phi2)
            u[0] = atanh(max(min(value / (1.0 - phi2), MAX_PARTIAL_AUTOCORRELATION), -MAX_PARTIAL_AUTOCORRELATION))
        return u

    if not near.size:
        return _log_likelihood(z, white, order, insert_coefficient_held_at_value(near)), near
    least, place = minimize_bfgs(
        lambda free: -_log_likelihood(z, white, order, insert_coefficient_held_at_value(free)), near, 1e-2
    )
    return -least, place
