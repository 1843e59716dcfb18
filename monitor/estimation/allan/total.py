"""Total variance of a rate: Allan's with the record reflected at both ends, for averaging times up to its length.

"Applications of total variance method in random error analysis of the fiber optic gyro signal" shows that a rate must
be reflected as a rate (y*_{-j} = y_{j-1}), not as a phase, and differences cluster sums, D_k(m) = (1/m) Σ_{i≤m}
(y*_{k+i+m} − y*_{k+i}), σ² = mean of D²/2; here over every k, which is Howe's TOTVAR on the integrated rate (NIST SP
1065 eq. 25). In phase: d_i = x*_{i-m} − 2 x*_i + x*_{i+m} at every inner point i, x*_{-j} = 2 x_0 − x_j at the front,
likewise behind. For m ≤ i ≤ n − m these are the terms of the overlapping Allan variance.

``total`` gives the sums as they are. ``total_curve`` corrects them to what the Allan variance of the same noise would
be: E[TOTVAR] is computed exactly for any mixture (for τ ≤ T/2 it is AVAR (1 − a τ/T), a = 0, 0.481, 0.750 for white,
flicker, random walk, SP 1065 table 7, and −4/3 for quantization), and so are its degrees of freedom; a formula of one
power law holds for neither. Intervals are χ² and end at T/2: with the noise known they hold up to T, but the correction
rests on the noise that was fitted to the same record, and beyond T/2 intervals of such a curve hold the truth in 67 to
92 of 100 records, for 95 stated. There the value stands alone: what the record says of τ if its fit is right. A ramp R
has a known part in every term: its square is in the mean exactly (R²τ²/2 where nothing is reflected, less at the ends),
its product with the noise in the degrees of freedom.

A sample that is missing strikes out the terms that touch it. Bias and degrees of freedom per term stay those of a
record without gaps, so where fewer than MIN_SHARE of the terms are left there is neither correction nor interval.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Floats, Ints
from monitor.common.compiled import compiled
from monitor.estimation.allan.difference_moments import SOURCES, Moments, autocovariance, nodes, per_sample, spread

MIN_SHARE: Final = 0.5
"""Of the terms; with fewer, the reflected ones weigh more than the correction knows: one gap in the middle, half of the
terms left, makes random walk read 18 % low in variance and quantization 21 % high (3000 records)."""
GRID: Final = 256
"""Terms whose covariances are summed one by one; a longer record is looked at on so coarse a grid."""
CLUSTER: Final = 32
"""Grid points of a cluster in a record that is long beside it."""
_RAMP: Final = SOURCES - 1


@dataclass(frozen=True, slots=True)
class TotalCurve:
    """Total variance at m averaging times, corrected for bias: an estimate of the Allan variance of k axes."""

    tau_s: Floats  # [m]
    factors: Ints  # [m] cluster sizes in samples
    tvar: Floats  # [m, k] unit²; NaN where no noise is known, or too little is left beside gaps
    terms: Ints  # [m, k] differences averaged
    edf: Floats  # [m, k] equivalent degrees of freedom; NaN as tvar
    lo: Floats  # [m, k] deviation, lower end of the 95 % interval; NaN beyond half the record
    hi: Floats  # [m, k] deviation, upper end


def total(values: Floats, factors: Ints) -> tuple[Floats, Ints]:
    """Total variance [m, k] of rates [n, k] with its bias, and the number of its terms [m, k]; m < n.

    τ0 does not enter. What is not finite is missing.

    >>> total(np.tile([1.0, 2.0], 50)[:, None], np.array([1, 2]))[0].ravel().round(9).tolist()
    [0.5, 0.002525253]
    """
    phase, missing = phase_of(values)
    n = len(values)
    sums = np.zeros((factors.size, values.shape[1]))
    terms = np.zeros(sums.shape, np.int64)
    for i, m in enumerate(factors):
        if m < n:
            add_total(phase, missing, 0, n, int(m), 1, n, sums[i], terms[i])
    return variance(sums, terms, factors), terms


def total_curve(values: Floats, rate_hz: float, theta: Floats, factors: Ints | None = None) -> TotalCurve:
    """Total variance of a record, corrected, with intervals.

    Args:
        values: [n, k] rates; what is not finite is missing
        rate_hz: samples a second
        theta: [5, k] fitted Q² N² B² K² R² in SI, as ``fit.Fit.theta``; NaN = not known
        factors: cluster sizes below n; None = octaves
    """
    n = len(values)
    factors = octaves(n - 1) if factors is None else factors
    raw, terms = total(values, factors)
    return curve_of([moments(n, int(m)) for m in factors], rate_hz, theta, raw, terms)


def curve_of(known: Iterable[Moments], rate_hz: float, theta: Floats, raw: Floats, terms: Ints) -> TotalCurve:
    """Total variances [m, k] with their bias to a curve without."""
    each = list(known)
    enough = terms >= MIN_SHARE * np.array([one.terms for one in each])[:, None]
    tvar, edf, lo, hi = spread(each, per_sample(theta, rate_hz), np.where(enough, raw, np.nan), terms)
    factors = np.array([one.factor for one in each])
    unsure = 2 * factors > np.array([one.n for one in each])
    lo[unsure] = hi[unsure] = np.nan
    return TotalCurve(factors / rate_hz, factors, tvar, terms, edf, lo, hi)


def octaves(longest: int) -> Ints:
    """1, 2, 4, … up to ``longest``."""
    return 2 ** np.arange(max(longest, 1).bit_length(), dtype=np.int64)


def phase_of(values: Floats) -> tuple[Floats, NDArray[np.int32]]:
    """Phase of the mean-free rate [n + 1, k] and how many samples before each point are missing; C order."""
    phase = np.zeros((len(values) + 1, values.shape[1]))
    missing = np.zeros(phase.shape, np.int32)
    rate = phase[1:]
    rate[:] = values
    absent = ~np.isfinite(rate)
    rate[absent] = 0.0
    # phase of the mean-free rate stays small, and so keeps its digits
    rate -= rate.sum(axis=0) / np.maximum((~absent).sum(axis=0), 1)
    rate[absent] = 0.0
    np.cumsum(rate, axis=0, out=rate)
    np.cumsum(absent, axis=0, out=missing[1:])
    return phase, missing


def variance(sums: Floats, terms: Ints, factors: Ints) -> Floats:
    """Sums of squared second differences to variances."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(terms > 0, sums / (2.0 * factors[:, None] ** 2 * terms), np.nan))


def moments(n: int, factor: int) -> Moments:
    """Mean and covariance of the total variance of ``n`` samples, 1 ≤ factor < n; a few milliseconds.

    >>> one = moments(100_000, 50_000)               # random walk at T/2: 1 − 0.750/2
    >>> print(f"{one.mean[3] / one.allan[3]:.3f}")
    0.625
    """
    places, weights = nodes(1, n, [-(-factor // 2), factor, n - factor, n - factor // 2])
    points, signs = _points(places, n, factor)
    half = 0.5 / factor**2
    mean = half / (n - 1) * (_squares(points, signs) @ weights)
    inner = _squares(factor * np.array([[-1.0, 0.0, 1.0]]), np.array([[1.0, -2.0, 1.0]]))
    return Moments(n, factor, n - 1, mean, half * inner[:, 0], _covariance(n, factor))


def _points(places: Floats, n: int, m: int) -> tuple[Floats, Floats]:
    """Phase points [i, 5] of the terms at ``places``, and their weights: what is reflected, and about what."""
    front, behind = places < m, places > n - m
    points = [0.0 * places, np.abs(places - m), places, np.minimum(places + m, 2 * n - m - places), n + 0.0 * places]
    signs = [2.0 * front, 1.0 - 2.0 * front, -2.0 + 0.0 * places, 1.0 - 2.0 * behind, 2.0 * behind]
    return np.stack(points, axis=1), np.stack(signs, axis=1)


def _squares(points: Floats, signs: Floats) -> Floats:
    """Mean squares [5, i] of differences for each coefficient of one."""
    lags = points[:, :, None] - points[:, None, :]
    random = np.einsum("ip,iq,aipq->ai", signs, signs, autocovariance(lags))
    ramp = (signs * 0.5 * points**2).sum(axis=1) ** 2
    return np.concatenate([random, ramp[None]])


def _covariance(n: int, m: int) -> Floats:
    """Quadratic form [5, 5] of the variance.

    Up to GRID samples the sum over all pairs of terms itself. Above, pairs on a coarse grid, as the autocovariances are
    smooth. In a record longer than GRID/CLUSTER clusters the ends are as in a shorter one, and each term more adds the
    same.
    """
    scale = 2.0 * (0.5 / (m * m * (n - 1.0))) ** 2
    if n <= GRID:
        return _pair_sums(n, m, 1.0) * scale
    cluster = m if m <= CLUSTER else max(CLUSTER, round(GRID * m / n))
    step = m / cluster
    length = max(min(GRID, round(n / step)), cluster + 1)
    sums = _pair_sums(length, cluster, step)
    beyond = n / step - length
    if beyond >= 1.0:
        sums += beyond * (sums - _pair_sums(length - 1, cluster, step))
    return sums * scale


def _pair_sums(n: int, m: int, step: float) -> Floats:
    """Σ_jk r^a_jk r^b_jk [5, 5] over all pairs of terms of a record whose points lie ``step`` samples apart on a grid.

    Quantization is two parts: the two ends, which all reflected terms have in common, and points met along lines, which
    grow with the step where pairs grow with its square.
    """
    at = np.arange(n + 1)
    lags = autocovariance(step * np.arange(n + 1.0))[:, np.abs(at[:, None] - at)]
    points, signs = _points(np.arange(1.0, n), n, m)
    rows = points.astype(np.int64)
    random = _combined(_combined(lags, rows, signs).transpose(0, 2, 1), rows, signs)
    ends = signs[:, [0, 4]] @ signs[:, [0, 4]].T
    random[0] -= ends
    ramp = (signs * 0.5 * (step * points) ** 2).sum(axis=1)
    parts = np.concatenate([random, np.outer(ramp, ramp)[None], ends[None]]).reshape(SOURCES + 1, -1)
    products = step * step * (parts @ parts.T)
    products[0] /= step
    products[1:, 0] /= step
    products[0, 0] = step * (parts[0] @ parts[0])
    products[_RAMP, _RAMP] = 0.0  # a ramp by itself does not vary
    joined = products[:SOURCES, :SOURCES]
    joined[0] += products[SOURCES, :SOURCES]
    joined[:, 0] += products[:SOURCES, SOURCES]
    joined[0, 0] += products[SOURCES, SOURCES]
    return np.asarray(joined)


def _combined(of_points: Floats, rows: Ints, signs: Floats) -> Floats:
    """Rows [4, points, …] of phase points to rows [4, terms, …] of differences."""
    terms = signs[:, 0, None] * of_points[:, rows[:, 0]]
    for p in range(1, rows.shape[1]):
        terms += signs[:, p, None] * of_points[:, rows[:, p]]
    return np.asarray(terms)


@compiled
def add_total(phase, missing, first, n, m, begin, end, sums, terms):  # type: ignore[no-untyped-def]
    """Add the squares of the terms begin ≤ i < end of the n + 1 phase points that start at row ``first`` of a ring.

    phase [places, ≥ k] float64, or integers that wrap; missing alike; sums [k] and terms [k] are added to. The
    reflected neighbour of a term goes the other way with the other sign, beside twice the end's phase.
    """
    places = phase.shape[0]
    last = (first + n) % places
    mirror = np.empty(sums.size, phase.dtype)
    i = begin
    while i < end:
        stop = end
        before, behind = 1, 1
        if i < m:
            before = -1
            stop = min(stop, m)
        if i > n - m:
            behind = -1
        else:
            stop = min(stop, n - m + 1)
        for lane in range(sums.size):
            mirror[lane] = (1 - before) * phase[first, lane] + (1 - behind) * phase[last, lane]
        left, right = (first + abs(i - m)) % places, (first + min(i + m, 2 * n - m - i)) % places
        _add_run(phase, missing, left, (first + i) % places, right, before, behind, first, last, mirror,
                 stop - i, sums, terms)  # fmt: skip
        i = stop


@compiled
def _add_run(phase, missing, left, at, right, before, behind, first, last, mirror, rows, sums, terms):  # type: ignore[no-untyped-def]
    """Terms of one kind, but for those that touch a missing sample from their first to their last point.

    A term that is reflected in front begins with the record, one that is reflected behind ends with it.
    """
    whole = True
    for lane in range(sums.size):
        whole = whole and missing[first, lane] == missing[last, lane]
    for _ in range(rows):
        x, y, z = np.uintp(left), np.uintp(at), np.uintp(right)
        old, new = x if before > 0 else np.uintp(first), z if behind > 0 else np.uintp(last)
        for lane in range(np.uintp(sums.size)):
            if whole or missing[old, lane] == missing[new, lane]:
                d = float(before * phase[x, lane] - 2 * phase[y, lane] + behind * phase[z, lane] + mirror[lane])
                sums[lane] += d * d
                terms[lane] += 1
        left, at, right = left + before, at + 1, right + behind
        if left < 0:
            left += phase.shape[0]
        elif left == phase.shape[0]:
            left = 0
        if at == phase.shape[0]:
            at = 0
        if right < 0:
            right += phase.shape[0]
        elif right == phase.shape[0]:
            right = 0
