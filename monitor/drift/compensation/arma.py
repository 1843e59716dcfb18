"""ARMA(p, q) of a drift at rest, p ≤ 2, q ≤ 1: exact likelihood, order by criterion, intervals.

    x_k = φ1 x_{k−1} + φ2 x_{k−2} + a_k + θ1 a_{k−1},    z_k = μ + x_k + v_k

z are means over intervals; v is what white noise leaves of a mean, of a variance that the scatter within the intervals
tells beforehand (0 where z is the process itself, as in the paper behind this). In state space by Green's function
(Pandit & Wu 1983; Yuan et al. 2010), the state is the process and what it expects next:

    X_k = [x_k, x̂_{k+1|k}],  X_k = A X_{k−1} + B a_k,  A = [[0, 1], [φ2, φ1]],  B = [G0, G1]ᵀ,  G0 = 1, G1 = φ1 + θ1

The likelihood is a Kalman filter's, so intervals may be missing; μ is the one of generalised least squares. Roots are
kept stable and invertible by writing the coefficients through partial autocorrelations (Monahan 1984).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import atanh, exp, log, pi, sqrt, tanh
from typing import Final

import numpy as np

from drivers.errors import NotReady
from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.common.minimization import minimize_bfgs

Order = tuple[int, int]
Triple = tuple[float, float, float]

ORDERS: Final[tuple[Order, ...]] = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1))
"""p and q to choose among; the paper has (2, 1). The first says that nothing but white noise is seen."""
FEWEST: Final = 30
"""Known values that anything can be said of."""
NEAREST: Final = 0.99999
"""Of a partial autocorrelation to one."""
HALF_CHI2: Final = 1.920729
"""Half of the 95 % quantile of χ² with one degree of freedom."""
MOST: Final = 3
"""Coefficients of the highest order: with fewer nothing can nearly cancel in two ways."""
APART: Final = 0.1
"""Of partial autocorrelations: maxima nearer to each other are one."""
BISECTIONS: Final = 6
"""Of the last step outwards."""
FIRST: Final = {
    0: ((),),
    1: ((0.3,), (0.9,), (0.99,)),
    2: ((0.5, 0.0), (0.9, 0.0), (0.99, 0.0), (0.9, -0.5), (0.3, 0.4)),
}
"""Partial autocorrelations to begin from."""
FIRST_MOVING: Final = (-0.9, -0.5, 0.0, 0.5)
SHARES: Final = (1e-3, 0.03, 0.5)
"""Of the variance of z, where part of it is white: variances of a to begin from."""


@dataclass(frozen=True, slots=True)
class Arma:
    """One process.

    >>> Arma((0.5, 0.3), -0.2, 1.0).green
    (1.0, 0.3)
    """

    phi: tuple[float, float]  # 0 where the order has none
    theta: float
    variance: float  # of a, (rad/s)²
    mean: float = 0.0  # μ, rad/s
    white: float = 0.0  # variance of v
    order: Order = (2, 1)
    lo: tuple[float, float, float] = (np.nan, np.nan, np.nan)  # 95 % of φ1, φ2, θ1
    hi: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    likelihood: float = np.nan  # logarithm
    bic: float = np.nan
    count: int = 0  # values it was identified from

    @property
    def green(self) -> tuple[float, float]:
        """G0 and G1."""
        return 1.0, self.phi[0] + self.theta

    @property
    def spread(self) -> float:
        """Standard deviation of x in the long run; infinite for a random walk."""
        return sqrt(self.variance * stationary(*self.phi, self.theta)[0])

    @property
    def name(self) -> str:
        """For people."""
        return f"ARMA({self.order[0]}, {self.order[1]})" if self.order != (0, 0) else "constant"


def identify(z: Floats, white: float = 0.0, orders: Sequence[Order] = ORDERS, intervals: bool = False) -> Arma:
    """The order with the least BIC (Schwarz 1978), and its parameters.

    Args:
        z: [n] rad/s; NaN = missing
        white: variance of v, (rad/s)²
        intervals: of the coefficients too, which takes ten times as long
    Raises:
        NotReady: fewer than FEWEST values, or all the same
    """
    known = z[np.isfinite(z)]
    if known.size < FEWEST:
        raise NotReady(f"{known.size} values; {FEWEST} are needed to identify a drift")
    origin, scale = float(np.median(known)), float(known.std())
    if not scale > 0.0:
        raise NotReady("all values are the same")
    unit = (z - origin) / scale
    share = white / scale**2
    best = min((_fitted(unit, share, order) for order in orders), key=lambda one: one[0])
    found = _arma(unit, share, origin, scale, best)
    if not intervals:
        return found
    lo, hi = _interval(unit, share, *best[1:])
    return replace(found, lo=lo, hi=hi)


@compiled
def _forward(p11, p12, p22, phi1, phi2, g1, variance):  # type: ignore[no-untyped-def]
    """A P Aᵀ + variance B Bᵀ, as p11, p12, p22."""
    return (
        p22 + variance,
        phi2 * p12 + phi1 * p22 + g1 * variance,
        phi2 * phi2 * p11 + 2.0 * phi1 * phi2 * p12 + phi1 * phi1 * p22 + g1 * g1 * variance,
    )


@compiled
def stationary(phi1, phi2, theta):  # type: ignore[no-untyped-def]
    """P of the state in the long run, for a of variance 1."""
    g1 = phi1 + theta
    more = phi2 * phi2 + 2.0 * phi1 * phi2 * g1 / (1.0 - phi2) + g1 * g1
    p22 = more / (1.0 - phi2 * phi2 - phi1 * phi1 - 2.0 * phi1 * phi1 * phi2 / (1.0 - phi2))
    return p22 + 1.0, (phi1 * p22 + g1) / (1.0 - phi2), p22


@compiled
def innovations(z, phi1, phi2, theta, variance, white):  # type: ignore[no-untyped-def]
    """Values that are there, Σ log S, Σ ε²/S of z about its mean, and that mean, of an exact Kalman filter."""
    g1 = phi1 + theta
    p11, p12, p22 = stationary(phi1, phi2, theta)
    p11, p12, p22 = p11 * variance, p12 * variance, p22 * variance
    x1 = x2 = o1 = o2 = 0.0  # of z, and of a series of ones, whose sizes together give the mean
    count, logs, zz, zo, oo = 0, 0.0, 0.0, 0.0, 0.0
    for k in range(z.size):
        if z[k] == z[k]:
            s = p11 + white
            gain1, gain2 = p11 / s, p12 / s
            e, o = z[k] - x1, 1.0 - o1
            logs += np.log(s)
            zz, zo, oo, count = zz + e * e / s, zo + e * o / s, oo + o * o / s, count + 1
            x1, x2, o1, o2 = x1 + gain1 * e, x2 + gain2 * e, o1 + gain1 * o, o2 + gain2 * o
            p22 = p22 - gain2 * p12
            p11, p12 = white * gain1, white * gain2
        x1, x2 = x2, phi2 * x1 + phi1 * x2
        o1, o2 = o2, phi2 * o1 + phi1 * o2
        p11, p12, p22 = _forward(p11, p12, p22, phi1, phi2, g1, variance)
    mean = zo / oo if oo > 0.0 else 0.0
    return count, logs, zz - mean * zo, mean


_Tried = tuple[float, Order, Floats]  # BIC, order, parameters of the search


def _fitted(z: Floats, white: float, order: Order) -> _Tried:
    """Most likely parameters of one order: partial autocorrelations and θ through atanh, ln variance where v is."""
    count = int(np.isfinite(z).sum())
    free = sum(order) + (white > 0.0 and order != (0, 0))

    def loss(u: Floats) -> float:
        return -_likelihood(z, white, order, u)

    starts = _starts(white, order)
    tried = sorted(((loss(u), i) for i, u in enumerate(starts)))
    best, at = tried[0][0], starts[tried[0][1]]
    if free:
        for _, i in tried[:2]:
            least, place = minimize_bfgs(loss, starts[i], 1e-4 * count**0.5)
            if least < best:
                best, at = least, place
    return 2.0 * best + (free + 2) * log(count), order, at


def _starts(white: float, order: Order) -> list[Floats]:
    return [
        np.array([*map(atanh, partial), *((atanh(theta),) if order[1] else ()), *((log(share),) if share else ())])
        for partial in FIRST[order[0]]
        for theta in (FIRST_MOVING if order[1] else (0.0,))
        for share in (SHARES if white > 0.0 and order != (0, 0) else (0.0,))
    ]


def _likelihood(z: Floats, white: float, order: Order, u: Floats) -> float:
    """Logarithm, with the mean and, where there is no v, the variance at their best."""
    phi1, phi2, theta, variance = _natural(order, u, white)
    count, logs, square, _ = innovations(z, phi1, phi2, theta, variance, white)
    if white > 0.0 and order != (0, 0):
        return float(-0.5 * (count * log(2.0 * pi) + logs + square))
    size = max(square / count, 1e-300)
    return float(-0.5 * (count * (log(2.0 * pi * size) + 1.0) + logs))


def _natural(order: Order, u: Floats, white: float) -> tuple[float, float, float, float]:
    """φ1, φ2, θ1 and the variance of a (1 where it comes of itself)."""
    partial = [max(min(tanh(one), NEAREST), -NEAREST) for one in u[: order[0] + order[1]].tolist()]
    phi1 = phi2 = 0.0
    if order[0] == 1:
        phi1 = partial[0]
    if order[0] == 2:
        phi1, phi2 = partial[0] * (1.0 - partial[1]), partial[1]
    theta = partial[-1] if order[1] else 0.0
    free = white > 0.0 and order != (0, 0)
    return phi1, phi2, theta, exp(min(max(float(u[-1]), -60.0), 60.0)) if free else 1.0


def _arma(z: Floats, white: float, origin: float, scale: float, best: _Tried) -> Arma:
    """In the units of what was measured, with intervals."""
    bic, order, u = best
    phi1, phi2, theta, variance = _natural(order, u, white)
    seen = white if order != (0, 0) else 0.0
    count, _, square, mean = innovations(z, phi1, phi2, theta, variance, seen)
    if seen == 0.0:
        variance = square / count
    nothing = order == (0, 0) and white > 0.0
    return Arma(
        phi=(phi1, phi2),
        theta=theta,
        variance=0.0 if nothing else variance * scale**2,
        mean=origin + scale * mean,
        white=(variance if nothing else white) * scale**2,
        order=order,
        likelihood=_likelihood(z, white, order, u) - count * log(scale),
        bic=bic + 2.0 * count * log(scale),
        count=count,
    )


def _interval(z: Floats, white: float, order: Order, u: Floats) -> tuple[Triple, Triple]:
    """95 % of φ1, φ2, θ1 where the likelihood, at its best in all the others, has fallen by half of χ²(1)'s quantile.

    Where a root nearly cancels θ the likelihood has a long ridge, on which its curvature tells too little, or two tops:
    then the interval reaches from one to the other.
    """
    there = (order[0] > 0, order[0] > 1, order[1] > 0)
    tops = _tops(z, white, order, u)
    best = max(_likelihood(z, white, order, one) for one in tops)
    nothing = (np.nan, np.nan)
    ends = [[_ends(z, white, order, one, i, best) if there[i] else nothing for i in range(3)] for one in tops]
    lo, hi = np.min(ends, axis=0)[:, 0], np.max(ends, axis=0)[:, 1]
    return (float(lo[0]), float(lo[1]), float(lo[2])), (float(hi[0]), float(hi[1]), float(hi[2]))


def _tops(z: Floats, white: float, order: Order, u: Floats) -> list[Floats]:
    """The maxima of the likelihood that are nearly as high as the highest, which is first."""
    found = [u]
    if sum(order) == MOST:
        for start in _starts(white, order):
            _, one = minimize_bfgs(lambda u: -_likelihood(z, white, order, u), start, 0.1)
            if all(np.abs(np.tanh(one[:MOST]) - np.tanh(other[:MOST])).max() > APART for other in found):
                found.append(one)
    best = max(_likelihood(z, white, order, one) for one in found)
    return [one for one in found if best - _likelihood(z, white, order, one) < HALF_CHI2]


def _ends(z: Floats, white: float, order: Order, u: Floats, which: int, top: float) -> tuple[float, float]:
    """Both ends of one coefficient's interval about one maximum, where the highest is ``top``."""
    value = _natural(order, u, white)[which]
    limits = (-NEAREST, NEAREST) if which or order[0] < 2 else (-2.0 * NEAREST, 2.0 * NEAREST)
    found = []
    for limit in limits:
        inside, outside, near = value, limit, _others(order, u, which)
        step = max(abs(limit - value) / 64.0, 1e-9)
        while abs(inside - limit) > 1e-9:  # outwards, each time further
            further = inside + np.sign(limit - value) * min(step, abs(limit - inside))
            fallen, moved = _profile(z, white, order, which, float(further), near)
            if top - fallen > HALF_CHI2:
                outside = float(further)
                break
            inside, near, step = float(further), moved, 1.6 * step
        else:
            found.append(float(limit))
            continue
        for _ in range(BISECTIONS):
            middle = 0.5 * (inside + outside)
            fallen, moved = _profile(z, white, order, which, middle, near)
            if top - fallen > HALF_CHI2:
                outside = middle
            else:
                inside, near = middle, moved
        found.append(0.5 * (inside + outside))
    return found[0], found[1]


def _others(order: Order, u: Floats, which: int) -> Floats:
    """What is free when one coefficient is held: ``u`` without it; beside φ1, φ2 by its place in what is stable."""
    held = order[0] if which == 2 else which
    return np.delete(u, held)


def _profile(z: Floats, white: float, order: Order, which: int, value: float, near: Floats) -> tuple[float, Floats]:
    """The likelihood with one coefficient held, and where the others have it at its best."""

    def full(free: Floats) -> Floats:
        u = np.insert(free, order[0] if which == 2 else which, 0.0)
        if which == 2:
            u[order[0]] = atanh(value)
        elif order[0] == 1 or which == 1:
            u[which] = atanh(value)
        else:  # φ1 = r1 (1 − φ2): |φ1| < 1 − φ2
            highest = 1.0 - abs(value)
            phi2 = -NEAREST + 0.5 * (1.0 + tanh(float(u[1]))) * (highest + NEAREST) * NEAREST
            u[1] = atanh(phi2)
            u[0] = atanh(max(min(value / (1.0 - phi2), NEAREST), -NEAREST))
        return u

    if not near.size:
        return _likelihood(z, white, order, full(near)), near
    least, place = minimize_bfgs(lambda free: -_likelihood(z, white, order, full(free)), near, 1e-2)
    return -least, place
