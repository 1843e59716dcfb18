"""Covariances, degrees of freedom and χ² confidence intervals of overlapping Allan variances.

For Gaussian noise, Isserlis' theorem gives Cov(d², e²) = 2 Cov(d, e)² for second differences d and e. The covariance of
two overlapping Allan variances is therefore a quadratic form in θ = (Q², N², B², K²):

    Cov(σ²_i, σ²_j) = Σ_ab θ_a θ_b C^ab_ij,   C^ab_ij = 1/(2 M_i M_j) Σ_c w(c) r^a_ij(c) r^b_ij(c).

Here r is the covariance, divided by m_i m_j, of two second differences at lag c over clusters of m_i and m_j samples.
The covariance follows from the generalised autocovariances of phase, which are δ(t) for Q, −|t|/2 for N, t² ln|t| / 2π
for B, and (|t|³ − |t|)/12 for K. The factor w(c) is the number of pairs of second differences at lag c, and M is the
number of second differences.

For any mixture of noise terms, the number of degrees of freedom is 2 σ⁴ / Var(σ²). The formulas of Greenhall & Riley
(PTTI 2003) hold only for a single power law. Their error is 15–25 % near m = 1.

Time is in units of one sample interval τ0, so θ = (Q²/τ0², N²/τ0, B², K² τ0, R² τ0²).
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled
from monitor.common.distributions import Chi2Level, chi2_quantile, expand_chi2_quantile
from monitor.noise.effects.ieee952.bias_instability import FLICKER_AVAR, BiasInstability

Q, N, B, K, R = range(5)

NOISES: Final = 4
"""Number of random noise terms Q, N, B and K. The linear drift R is deterministic and adds no variance."""

PAIRS: Final = ((0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3))
"""Pairs a ≤ b of noise terms, in the order of the last dimension of ``CovarianceTable.covariance``."""

LAG_STEP: Final = 0.5
"""Ratio between the length of a summation block and the distance of the block from the nearest kink."""

TAIL: Final = 8.0
"""Lag in units of m_i + m_j beyond which differences of t² ln t are computed from a series expansion."""

UNLIMITED_SAMPLES: Final = 1 << 62
"""Number of samples that means "unlimited"."""

TABLE_STEP: Final = 1.1
"""Factor by which the number of samples must grow before the covariance table is recomputed."""


@dataclass(frozen=True, slots=True, weakref_slot=True, eq=False)
class CovarianceTable:
    """Covariances of Allan variances for one window length and unit coefficients, in read-only arrays."""

    n: int  # number of samples in the window
    factors: Ints  # [m] cluster sizes in samples
    terms: Ints  # [m] number of second differences if no samples are missing; ≤ 0 if the window is too short
    covariance: Floats  # [m, m, 10] C^ab_ij for the pairs a ≤ b; NaN if the window is too short
    slope: Floats  # [4] variance of ``batch.rate_slope_from_thirds`` for each unit coefficient
    bend: Floats  # [m, 4] covariance of ``slope`` with ``batch.rate_slope_per_tau``


class CovarianceTablesByAxis:
    """Covariance tables for six axes with a growing number of samples.

    All axes that use the whole window share one covariance table.

    Parameters
    ----------
    factors : ndarray of int64, shape (m,)
        Cluster sizes in samples.
    capacity : int
        Length of the full window in samples.
    """

    def __init__(self, factors: Ints, capacity: int) -> None:
        self._factors = factors
        self._capacity = capacity
        self._tables: dict[int | None, CovarianceTable] = {}  # by index of a restarted axis; None for the whole window

    def table_of_axis(self, axis: int, n: int, window_samples: int) -> CovarianceTable:
        """Return the covariance table of an axis, computed for n or up to 10 % fewer samples.

        Parameters
        ----------
        axis : int
            Index of the axis.
        n : int
            Number of newest samples that the axis uses.
        window_samples : int
            Number of samples in the window.
        """
        key = None if n == window_samples else axis
        known = self._tables.get(key)
        if known is None or not (known.n == n or known.n < n < min(self._capacity, TABLE_STEP * known.n)):
            known = self._tables[key] = covariance_table(n, self._factors)
        return known

    def samples_until_table_expires(self, table: CovarianceTable, n: int) -> int:
        """Return the number of further samples after which a covariance table must be recomputed.

        The table of a full window never expires, so the result is ``UNLIMITED_SAMPLES``.

        Parameters
        ----------
        table : CovarianceTable
            Result of ``table_of_axis`` for n samples.
        n : int
            Number of newest samples that the axis uses.
        """
        if n >= self._capacity:
            return UNLIMITED_SAMPLES
        return min(self._capacity, math.ceil(TABLE_STEP * table.n)) - n


def covariance_table(n: int, factors: Ints) -> CovarianceTable:
    """Compute the covariances of the overlapping Allan variances of n samples.

    As the example shows, 30 000 second differences of white noise at m = 1 have 20 000 degrees of freedom.

    Parameters
    ----------
    n : int
        Number of samples in the window.
    factors : ndarray of int64, shape (m,)
        Cluster sizes in samples.

    >>> t = covariance_table(30_001, np.array([1, 2]))
    >>> round(2 * 1.0**2 / t.covariance[0, 0, PAIRS.index((1, 1))])
    20000
    """
    factors = np.ascontiguousarray(factors, np.int64)
    covariance = np.full((factors.size, factors.size, len(PAIRS)), np.nan)
    _fill(n, factors, covariance)
    # The autocovariance t² ln t describes continuous 1/f noise. Sampled 1/f noise is weaker at the shortest τ.
    share = np.array([_sampled_flicker(m) for m in factors.tolist()])
    for pair, (a, b) in enumerate(PAIRS):
        covariance[:, :, pair] *= np.outer(share, share) ** ((a == B) + (b == B))
    terms = n + 1 - 2 * factors
    slope, bend = _slope_variance(n), np.array([_bend_covariance(n, m) for m in factors.tolist()])
    for array in (terms, covariance, slope, bend):
        array.flags.writeable = False
    return CovarianceTable(n, factors, terms, covariance, slope, bend)


@cache
def _sampled_flicker(m: int) -> float:
    """Return the ratio between the Allan deviations of sampled and continuous 1/f noise at one cluster size."""
    return float(np.sqrt(BiasInstability(B=1.0).avar(np.array([float(m)]), 1.0)[0] / FLICKER_AVAR))


def _slope_variance(n: int) -> Floats:
    """Return the variance [4] of ``batch.rate_slope_from_thirds`` for unit Q, N, B and K and τ0 = 1.

    The slope is a weighted sum of four phase points at intervals of τ = n/3, divided by 2τ². The variance of the
    weighted sum is 4 for Q, 2τ for N, (9 ln 3 − 8 ln 2) τ²/π for B, and 5τ³/3 for K.
    """
    if n < 3:
        return np.full(NOISES, np.nan)
    tau = n / 3.0
    flicker = (9.0 * np.log(3.0) - 8.0 * np.log(2.0)) / np.pi
    return np.array([4.0, 2.0 * tau, flicker * tau**2, 5.0 / 3.0 * tau**3]) / (4.0 * tau**4)


def _bend_covariance(n: int, m: int) -> Floats:
    """Return the covariance [4] of the two slopes in ``batch`` at one cluster size for unit Q, N, B and K.

    Each slope is a weighted sum of phase points. To limit the effort, at most 128 phase points represent a block of m
    points.
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


class DegreesOfFreedomWithSpanPerTau:
    """Degrees of freedom of Allan variances that are computed from a different number of samples at each τ.

    Parameters
    ----------
    factors : ndarray of int64, shape (m,)
        Cluster sizes in samples.
    spans : ndarray of int64, shape (m,)
        Number of newest samples that are used at each τ.
    columns : ndarray of float64, shape (m, 4 or more)
        Allan variances of unit Q, N, B and K at τ0 = 1, in the first four columns.
    """

    def __init__(self, factors: Ints, spans: Ints, columns: Floats) -> None:
        tables = [covariance_table(int(span), np.array([m])) for m, span in zip(factors, spans, strict=True)]
        self._covariance = np.array([one.covariance[0, 0] for one in tables])  # [m, 10]
        self._columns = columns
        self._terms = np.array([one.terms[0] for one in tables])

    def edf(self, theta: Floats, rate_hz: float, terms: Ints, excess: Floats) -> Floats:
        """Return the degrees of freedom [m, k] of the Allan variances of k axes.

        White noise is assumed for axes without fitted coefficients.

        Parameters
        ----------
        theta : ndarray of float64, shape (5, k)
            Squared coefficients Q², N², B², K², R² in SI units; NaN means not fitted.
        rate_hz : float
            Sample rate in Hz.
        terms : ndarray of int64, shape (m, k)
            Number of averaged second differences.
        excess : ndarray of float64, shape (m, k)
            Contribution of missing samples that has been subtracted from the mean square.
        """
        edf = np.empty(terms.shape)
        # the kernel is compiled only for contiguous arrays
        theta, terms, excess = np.ascontiguousarray(theta), np.ascontiguousarray(terms), np.ascontiguousarray(excess)
        _fill_edf(theta, rate_hz, self._columns, self._covariance, self._terms, terms, excess, edf)
        return edf


@compiled
def _fill_edf(
    theta: Floats,
    rate_hz: float,
    columns: Floats,
    covariance: Floats,
    whole: Ints,
    terms: Ints,
    excess: Floats,
    edf: Floats,
) -> None:
    shape, noise = np.empty(NOISES), np.empty(NOISES)
    for axis in range(theta.shape[1]):
        total = 0.0
        for a in range(NOISES):
            shape[a] = max(theta[a, axis], 0.0) * rate_hz ** (2.0 - a)
            total += shape[a] if theta[a, axis] == theta[a, axis] else np.nan
        fitted = total > 0.0
        if not fitted:
            shape[:] = 0.0
            shape[N] = 1.0
        for i in range(whole.size):
            level, variance, pair = 0.0, 0.0, 0
            noise[:] = shape
            if fitted:  # missing samples act like white noise
                noise[N] += max(excess[i, axis], 0.0) / columns[i, N]
            for a in range(NOISES):
                level += columns[i, a] * noise[a]
                for b in range(a, NOISES):  # in the order of ``PAIRS``
                    variance += covariance[i, pair] * noise[a] * noise[b] * (1.0 if a == b else 2.0)
                    pair += 1
            edf[i, axis] = 2.0 * level * level / variance * terms[i, axis] / whole[i] if terms[i, axis] > 0 else np.nan


def deviation_intervals(
    avar: Floats, edf: Floats, probability: float = 0.95, excess: Floats | float = 0.0
) -> tuple[Floats, Floats]:
    """Return the ends of the two-sided χ² confidence interval of the Allan deviation (NIST SP 1065 eq. 45).

    The mean square, which is the sum of ``avar`` and ``excess``, has a χ² distribution.

    Parameters
    ----------
    avar : ndarray of float64
        Allan variance. For NaN, the result is NaN.
    edf : ndarray of float64
        Degrees of freedom of the mean square, in the shape of ``avar``.
    probability : float
        Probability that the interval contains the true value.
    excess : ndarray of float64, or float
        Contribution of missing samples that has been subtracted from the mean square.

    Returns
    -------
    lo, hi : ndarray of float64
        Lower and upper end of the interval, in the shape of ``avar``.

    >>> lo, hi = deviation_intervals(np.array([1.0]), np.array([10.0]))
    >>> print(f"{lo[0]:.3f} {hi[0]:.3f}")
    0.699 1.755
    """
    tail = (1.0 - probability) / 2.0
    # the kernel is compiled only for contiguous arrays that can be written
    inputs = np.array((avar, edf, np.broadcast_to(excess, avar.shape)), np.float64)
    ends = np.empty_like(inputs[:2])
    levels = expand_chi2_quantile(tail), expand_chi2_quantile(1.0 - tail)
    _fill_intervals(inputs.reshape(3, -1), *levels, ends.reshape(2, -1))
    return ends[0], ends[1]


@compiled
def _fill_intervals(inputs: Floats, low: Chi2Level, high: Chi2Level, ends: Floats) -> None:
    for i in range(ends.shape[1]):
        edf, excess = inputs[1, i], inputs[2, i]
        raw = inputs[0, i] + excess
        lower, upper = chi2_quantile(edf, low), chi2_quantile(edf, high)
        ends[0, i], ends[1, i] = raw * edf / upper - excess, raw * edf / lower - excess
        for end in range(2):
            ends[end, i] = np.sqrt(ends[end, i] if excess == 0.0 else max(ends[end, i], 0.0))
        if lower == 0.0 and raw >= 0.0:  # with less than one degree of freedom, the upper end may be infinite
            ends[1, i] = np.inf


@compiled
def _fill(n: int, factors: Ints, covariance: Floats) -> None:
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
def _sum_lags(n: int, small: int, large: int, sums: Floats) -> None:
    """Sum the products of covariances over all lags between two second differences.

    The covariances have kinks at a few lags. Between two kinks, the sum over the lags is approximated in blocks.
    """
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
def _add_blocks(kink: int, count: int, side: float, n: int, small: int, large: int, sums: Floats) -> None:
    """Add ``count`` lags on one side of a kink, in blocks whose length grows with the distance from the kink.

    The sum over a block is approximated by the three-point Gauss rule of
    ``squared_difference_moments.summation_nodes``.
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
def _add(lag: float, weight: float, n: int, small: int, large: int, sums: Floats) -> None:
    """Add the products of covariances at one lag, weighted with the number of pairs of second differences."""
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
