"""How sure an Allan variance is: covariances of the estimates, degrees of freedom, χ² intervals.

The covariance of two overlapping Allan variances of Gaussian noise is a quadratic form in the
variances θ = (Q², N², B², K²) of its terms (Isserlis: Cov(d², e²) = 2 Cov(d, e)²),

    Cov(σ²_i, σ²_j) = Σ_ab θ_a θ_b C^ab_ij,   C^ab_ij = 1/(2 M_i M_j) Σ_c w(c) r^a_ij(c) r^b_ij(c)

with r the second differences, over clusters of m_i and of m_j samples, of the generalised
autocovariance of phase (Q δ, N −|t|/2, B t² ln|t| / 2π, K (|t|³ − |t|)/12: discrete sums of white
noise), w(c) how many pairs of terms stand c samples apart, and M the number of terms. ``table``
computes C once for a window length and a list of cluster sizes; a fit then costs products only.

It gives the exact degrees of freedom of mixed noise, edf = 2 σ⁴ / Cov_ii. The usual formulas
(Greenhall & Riley, PTTI 2003) hold for one power law at a time and are 15–25 % off near m = 1;
since the exact sum takes milliseconds, they are not used. Everything here is in units of one
sample: τ0 = 1, and θ stands for Q²/τ0², N²/τ0, B², K² τ0, R² τ0².
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from drivers.sample import AXES, Floats, Ints
from monitor.common.compiled import compiled
from monitor.common.distributions import chi2_quantile
from monitor.noise.effects.bias_instability import BiasInstability

Q, N, B, K, R = range(5)

NOISES: Final = 4
"""Random terms of the table, Q N B K; the ramp R is deterministic and adds no variance of its own."""

PAIRS: Final = ((0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3))
"""The pairs a ≤ b of noises, in the order of the table's last index."""

LAG_STEP: Final = 0.5
"""Lags are summed in blocks of this share of their distance to the nearest kink of r."""

TAIL: Final = 8.0
"""Beyond this many (m_i + m_j) the differences of t² ln t are taken from their series."""

FOR_EVER: Final = 1 << 62

TABLE_STEP: Final = 1.1
"""While a window grows, its table is renewed at this ratio of lengths; terms rescale it between."""


@dataclass(frozen=True, slots=True)
class Table:
    """C for one window length; read-only arrays."""

    n: int  # samples in the window
    factors: Ints  # [m] cluster sizes
    terms: Ints  # [m] second differences in a window without gaps; ≤ 0 where it is too short
    covariance: Floats  # [m, m, 10] C^ab_ij of the pairs a ≤ b; NaN where the window is too short
    slope: Floats  # [4] variance of the slope of thirds, for θ of one
    bend: Floats  # [m, 4] its covariance with the slope that each τ sees (``window_kernel.mean_bend``)


class Tables:
    """Hands out the table that fits a window, and makes a new one when the window has outgrown it."""

    def __init__(self, factors: Ints, capacity: int) -> None:
        self._factors = factors
        self._capacity = capacity
        self._table: Table | None = None

    def at(self, n: int) -> Table:
        """A table of n samples, or of up to a tenth fewer while the window is growing."""
        known = self._table
        if known is None or not (known.n == n or known.n < n < min(self._capacity, TABLE_STEP * known.n)):
            known = self._table = table(n, self._factors)
        return known

    def lasts(self, n: int) -> int:
        """For how many samples, the one of n included, ``at(n)`` stays the table to use; for ever in a full window."""
        known = self.at(n)
        if n >= self._capacity:
            return FOR_EVER
        return min(self._capacity, math.ceil(TABLE_STEP * known.n)) - n


class AxisTables:
    """The tables of six axes: all that reach back over the whole window share one, each that began anew has its own."""

    def __init__(self, factors: Ints, capacity: int) -> None:
        self._shared = Tables(factors, capacity)
        self._own = [Tables(factors, capacity) for _ in AXES]

    def of(self, axis: int, n: int, filled: int) -> Tables:
        """For an axis with the newest ``n`` of the ``filled`` samples that the window holds."""
        return self._shared if n == filled else self._own[axis]


def table(n: int, factors: Ints) -> Table:
    """Covariances of overlapping Allan variances of ``n`` samples at these cluster sizes.

    White noise, m = 1: neighbours share one sample, edf = 2/3 of the terms.

    >>> t = table(30_001, np.array([1, 2]))
    >>> round(2 * 1.0**2 / t.covariance[0, 0, PAIRS.index((1, 1))])
    20000
    """
    factors = np.ascontiguousarray(factors, np.int64)
    covariance = np.full((factors.size, factors.size, len(PAIRS)), np.nan)
    _fill(n, factors, covariance)
    # t² ln t is continuous 1/f; sampled, there is none above half the rate: less at the shortest τ
    share = np.array([_sampled_flicker(m) for m in factors.tolist()])
    for pair, (a, b) in enumerate(PAIRS):
        covariance[:, :, pair] *= np.outer(share, share) ** ((a == B) + (b == B))
    terms = n + 1 - 2 * factors
    slope, bend = _slope_variance(n), np.array([_bend_covariance(n, m) for m in factors.tolist()])
    for array in (terms, covariance, slope, bend):
        array.flags.writeable = False
    return Table(n, factors, terms, covariance, slope, bend)


@cache
def _sampled_flicker(m: int) -> float:
    """Deviation of sampled 1/f noise over that of continuous, one but at the shortest τ."""
    return float(np.sqrt(BiasInstability(B=1.0).avar(np.array([float(m)]), 1.0)[0] / (2.0 * np.log(2.0) / np.pi)))


def _slope_variance(n: int) -> Floats:
    """Variance of ``fit.slope_of_thirds`` for Q² N² B² K² of one, τ0 = 1, from the autocovariances of phase.

    With τ = n/3 the sums over the four points are 4, 2τ, (9 ln 3 − 8 ln 2) τ²/π and 5τ³/3, over (2τ²)².
    """
    if n < 3:
        return np.full(NOISES, np.nan)
    tau = n / 3.0
    flicker = (9.0 * np.log(3.0) - 8.0 * np.log(2.0)) / np.pi
    return np.array([4.0, 2.0 * tau, flicker * tau**2, 5.0 / 3.0 * tau**3]) / (4.0 * tau**4)


def _bend_covariance(n: int, m: int) -> Floats:
    """Covariance of the slope of thirds and of the mean second difference over m², for Q² N² B² K² of one, τ0 = 1.

    Both are sums over a few points of phase, so it is a sum of the generalised autocovariances over the lags between
    them; of the blocks of m points behind a mean second difference some sixty stand for all.
    """
    if n < 3 or n + 1 <= 2 * m:
        return np.full(NOISES, np.nan)
    k = np.arange(0, m, max(1, m // 64))
    block = np.concatenate([n - k, n - m - k, 2 * m - 1 - k, m - 1 - k])
    sign = np.repeat([1.0, -1.0, -1.0, 1.0], k.size)
    third = n // 3
    lag = np.abs(np.subtract.outer(n - third * np.arange(4), block)).astype(np.float64)
    weight = np.outer([1.0, -1.0, -1.0, 1.0], sign)
    weight *= m / k.size / ((n + 1.0 - 2 * m) * m**2) / (2.0 * third**2)
    flicker = lag**2 * np.log(np.maximum(lag, 1.0)) / (2.0 * np.pi)
    parts = (lag == 0.0, -lag / 2.0, flicker, (lag**2 - 1.0) * lag / 12.0)
    return np.array([float((weight * part).sum()) for part in parts])


class Spans:
    """Degrees of freedom of a curve whose τ look back over different spans."""

    def __init__(self, factors: Ints, spans: Ints, columns: Floats) -> None:
        """``columns`` [m, 4 or more]: Allan variance of Q N B K of one at τ0 = 1."""
        tables = [table(int(span), np.array([m])) for m, span in zip(factors, spans, strict=True)]
        self._covariance = np.array([one.covariance[0, 0] for one in tables])  # [m, 10]
        self._columns = columns[:, :NOISES]
        self._terms = np.array([one.terms[0] for one in tables])

    def edf(self, theta: Floats, rate_hz: float, terms: Ints) -> Floats:
        """Degrees of freedom [m, k] of terms [m, k] under noise of the shape of ``theta`` [5, k], SI.

        Where nothing was fitted, of white noise.
        """
        shape = np.maximum(theta[:NOISES], 0.0) * (rate_hz ** np.array([2.0, 1.0, 0.0, -1.0]))[:, None]
        shape = np.where(np.isnan(shape).any(axis=0) | (shape.sum(axis=0) == 0.0), np.eye(NOISES)[1][:, None], shape)
        level = self._columns @ shape
        pairs = np.array([shape[a] * shape[b] * (1.0 if a == b else 2.0) for a, b in PAIRS])
        with np.errstate(divide="ignore", invalid="ignore"):
            whole = 2.0 * level**2 / (self._covariance @ pairs)
            return np.where(terms > 0, whole * terms / self._terms[:, None], np.nan)


def intervals(avar: Floats, edf: Floats, probability: float = 0.95) -> tuple[Floats, Floats]:
    """Ends of the two-sided χ² interval of the Allan deviation, edf s²/χ² (NIST SP 1065 eq. 45).

    Shapes of ``avar`` and ``edf`` alike; NaN stays NaN.

    >>> lo, hi = intervals(np.array([1.0]), np.array([10.0]))
    >>> print(f"{lo[0]:.3f} {hi[0]:.3f}")
    0.699 1.755
    """
    tail = (1.0 - probability) / 2.0
    safe = np.where(edf > 0.0, edf, np.nan)
    low, high = chi2_quantile(safe, tail), chi2_quantile(safe, 1.0 - tail)
    # a fraction of one degree of freedom bounds nothing from above, not even a sum of zeros
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        lo, hi = np.sqrt(avar * safe / high), np.sqrt(avar * safe / low)
    return lo, np.where((low == 0.0) & (avar >= 0.0), np.inf, hi)


@compiled
def _fill(n, factors, covariance):  # type: ignore[no-untyped-def]
    sums = np.empty(10)
    for i in range(factors.size):
        for j in range(i, factors.size):
            small, large = min(factors[i], factors[j]), max(factors[i], factors[j])
            if n + 1 - 2 * large <= 0:
                continue
            _sum_lags(n, small, large, sums)
            scale = 0.5 / ((n + 1.0 - 2 * small) * (n + 1.0 - 2 * large))
            for pair in range(10):
                covariance[i, j, pair] = scale * sums[pair]
                covariance[j, i, pair] = scale * sums[pair]


@compiled
def _sum_lags(n, small, large, sums):  # type: ignore[no-untyped-def]
    """Σ w(c) r^a(c) r^b(c) over all lags c of the terms' centres: kinks one by one, between them blocks."""
    for pair in range(10):
        sums[pair] = 0.0
    end = n + 1 - small - large  # w(end) = 0
    lower = min(small, large - small)
    kinks = (0, lower, large - lower, large, large + small, end)
    for step in range(6):
        kink = kinks[step]
        if kink >= end or (step > 0 and kink == kinks[step - 1]):
            continue
        _add(float(kink), 1.0 if step == 0 else 2.0, n, small, large, sums)
        behind = end
        for other in kinks:
            if kink < other < behind:
                behind = other
        count = behind - kink - 1
        ahead = count if kink == large + small else (count + 1) // 2
        for done_by in ((1.0, kink, ahead), (-1.0, behind, count - ahead)):
            _add_blocks(done_by[1], done_by[2], done_by[0], n, small, large, sums)


@compiled
def _add_blocks(kink, count, side, n, small, large, sums):  # type: ignore[no-untyped-def]
    """``count`` lags beside a kink in growing blocks, each by the three-point Gauss rule of a block.

    Nodes and weights integrate polynomials of degree 5 exactly over L equally spaced points: the
    second and fourth moments are (L² − 1)/12 and (L² − 1)(3L² − 7)/240.
    """
    done = 0
    while done < count:
        length = min(max(1, int(LAG_STEP * (done + 1))), count - done)
        centre = kink + side * (done + 0.5 * (length + 1))
        inner, reach = 1.0, 0.0
        if length > 1:
            square = (3.0 * length * length - 7.0) / 20.0
            inner = 1.0 - (length * length - 1.0) / 12.0 / square
            reach = np.sqrt(square)
        _add(centre, 2.0 * length * inner, n, small, large, sums)
        if reach > 0.0:
            _add(centre - reach, length * (1.0 - inner), n, small, large, sums)
            _add(centre + reach, length * (1.0 - inner), n, small, large, sums)
        done += length


@compiled
def _add(lag, weight, n, small, large, sums):  # type: ignore[no-untyped-def]
    """One lag: the products of the differences of every two noises, times the pairs so far apart."""
    weight *= min(n + 1.0 - 2 * large, n + 1.0 - small - large - lag)
    if lag > TAIL * (small + large):
        r = small * large / (np.pi * lag * lag) * (1.0 + 0.5 * (small * small + large * large) / (lag * lag))
        sums[7] += weight * r * r
        return
    q, white, flicker, walk = 0.0, 0.0, 0.0, 0.0
    for p in range(-1, 2):
        for s in range(-1, 2):
            t = abs(lag + p * small + s * large)
            c = (1.0 if p else -2.0) * (1.0 if s else -2.0)
            if t == 0.0:
                q += c
                continue
            white -= 0.5 * c * t
            flicker += c * t * t * np.log(t)
            walk += c * (t * t - 1.0) * t
    scale = 1.0 / (small * large)
    q *= scale
    white *= scale
    flicker *= scale / (2.0 * np.pi)
    walk *= scale / 12.0
    sums[0] += weight * q * q
    sums[1] += weight * q * white
    sums[2] += weight * q * flicker
    sums[3] += weight * q * walk
    sums[4] += weight * white * white
    sums[5] += weight * white * flicker
    sums[6] += weight * white * walk
    sums[7] += weight * flicker * flicker
    sums[8] += weight * flicker * walk
    sums[9] += weight * walk * walk
