"""Mean and covariance of squared differences of phase: what bias and degrees of freedom are computed from.

A variance of the Allan family is an average over k of squares d_k², d_k = Σ_p w_p x(k_p) a weighted sum of a few phase
points that no constant rate moves: Σ w_p = Σ w_p k_p = 0. So Cov(d_j, d_k) = Σ_pq w_p w_q G(j_p − k_q) with the
generalised autocovariances G of phase (Q δ, N −|t|/2, B t² ln|t| / 2π, K (|t|³ − |t|)/12), also where the points were
reflected at the ends of a record, and for Gaussian noise (Isserlis) Cov(d_j², d_k²) = 2 Cov(d_j, d_k)². ``Moments``
holds, for one cluster size, the mean of the variance and of Allan's for coefficients of one, and the quadratic form of
its variance. A ramp moves a second difference by a known amount: its square adds to the mean, its product with the
noise to the variance, nothing by itself.

Everything here is in units of one sample: τ0 = 1, and θ = Q²/τ0², N²/τ0, B², K² τ0, R² τ0².
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from drivers.sample import Floats, Ints
from monitor.estimation.allan.uncertainty import intervals
from monitor.estimation.fit.coefficient_fit import TO_SI

SOURCES: Final = 5
"""Q N B K R, in the order of θ."""

_GROWTH: Final = 1.5
"""Blocks of terms grow by this ratio with their distance from a kink."""


@dataclass(frozen=True, slots=True)
class Moments:
    """One variance at one cluster size of a record of ``n`` samples without gaps."""

    n: int
    factor: int
    terms: int
    mean: Floats  # [5] expectation of the variance for each coefficient of one
    allan: Floats  # [5] Allan variance of the same, which a corrected variance estimates
    covariance: Floats  # [5, 5] Var = Σ_ab θ_a θ_b C_ab


def per_sample(theta: Floats, rate_hz: float) -> Floats:
    """θ [5, k] of a fit in SI to units of one sample; Q² < 0 stands for a band limit, which has no part here."""
    return np.asarray(np.maximum(theta, 0.0) * (rate_hz ** (-2.0 * TO_SI))[:, None])


def spread(
    moments: Iterable[Moments], theta: Floats, variance: Floats, terms: Ints
) -> tuple[Floats, Floats, Floats, Floats]:
    """What measured variances [m, k] say of Allan's: corrected for bias, degrees of freedom, ends of the deviation.

    Degrees of freedom edf = 2 E²/Var of the noise θ [5, k], in proportion to the terms that are there; NaN where θ is
    not known, or there is no noise at all.
    """
    each = list(moments)
    mean = np.stack([one.mean for one in each]) @ theta
    allan = np.stack([one.allan for one in each]) @ theta
    square = np.einsum("ak,mab,bk->mk", theta, np.stack([one.covariance for one in each]), theta)
    whole = np.array([one.terms for one in each])[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        edf = np.where(variance > 0.0, 2.0 * mean * mean / square * (terms / whole), np.nan)
        corrected = variance * (allan / mean)
    edf[~np.isfinite(edf)] = np.nan
    lo, hi = intervals(corrected, edf)
    return corrected, edf, lo, hi


def autocovariance(t: Floats) -> Floats:
    """Generalised autocovariance of phase [4, …] of Q N B K at lags t in samples: discrete sums of white noise."""
    t = np.abs(t)
    flicker = t * t * np.log(np.where(t == 0.0, 1.0, t)) / (2.0 * np.pi)
    return np.stack([np.where(t == 0.0, 1.0, 0.0), -0.5 * t, flicker, (t * t - 1.0) * t / 12.0])


def nodes(begin: int, end: int, kinks: Iterable[int]) -> tuple[Floats, Floats]:
    """Places and weights that sum a function over begin ≤ k < end, smooth but at the kinks.

    Blocks that grow with the distance to the nearest kink, each by the three-point Gauss rule of L equally spaced
    points, exact to degree 5: their second and fourth moments are (L² − 1)/12 and (L² − 1)(3L² − 7)/240.

    >>> places, weights = nodes(0, 1000, [0, 400])
    >>> places.size < 200, round(float(weights @ places**5) / sum(k**5 for k in range(1000)), 12)
    (True, 1.0)
    """
    steps = [0, 1]
    while 2 * steps[-1] < end - begin:
        steps.append(max(steps[-1] + 1, int(_GROWTH * steps[-1])))
    growing = np.array(steps)
    corners = np.unique([begin, *(k for k in kinks if begin < k < end), end])
    edges = np.unique(
        np.concatenate(
            [
                np.concatenate([a + growing[2 * growing <= b - a], b - growing[2 * growing <= b - a]])
                for a, b in pairwise(corners.tolist())
            ]
        )
    )
    length, centre = np.diff(edges).astype(np.float64), 0.5 * (edges[1:] + edges[:-1] - 1.0)
    square = np.where(length > 1.0, (3.0 * length**2 - 7.0) / 20.0, 1.0)
    outer = (length**2 - 1.0) / 24.0 / square
    reach = np.sqrt(square)
    places = np.concatenate([centre, centre - reach, centre + reach])
    weights = np.concatenate([length * (1.0 - 2.0 * outer), length * outer, length * outer])
    return places[weights != 0.0], weights[weights != 0.0]
