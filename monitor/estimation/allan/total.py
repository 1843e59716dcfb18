"""Total variance of a rate, which is the Allan variance of a recording that is extended by reflection at both ends.

The rate must be reflected as a rate and not as a phase ("Applications of total variance method in random error analysis
of the fiber optic gyro signal"). The total variance equals Howe's TOTVAR of the integrated rate (NIST SP 1065 eq. 25).
The variance is the mean of d_i² / (2 m²) over the inner phase points i. Here d_i = x*_{i-m} − 2 x*_i + x*_{i+m} is a
second difference of the extended phase x*. Before the start of the recording, x*_{-j} = 2 x_0 − x_j.

The function ``total_variance`` returns biased variances, and ``compute_total_curve`` corrects the bias. For τ ≤ T/2,
the expectation of the total variance is the Allan variance times 1 − a τ/T. The factor a is 0 for white noise, 0.481
for flicker noise, 0.750 for random walk (SP 1065 table 7) and −4/3 for quantization noise. The expectation and the
degrees of freedom are computed for any mixture of noise terms.

Confidence intervals are computed only for τ ≤ T/2, because the bias correction depends on coefficients that were fitted
to the same recording. Beyond T/2, nominal 95 % intervals would contain the true value in only 67 to 92 of 100
recordings.

A linear drift R adds a known offset to every second difference. The square of the offset increases the mean, and the
product of offset and noise reduces the degrees of freedom.

Missing samples are reflected like the other samples. A second difference counts if 60 % of the samples in each cluster
of the extended recording are present, and the mean of a cluster is the mean of its present samples. The excess of
missing samples (``missing_samples``) takes into account that samples near the ends occur twice in a cluster, or in both
clusters.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled, inlined
from monitor.estimation.allan.batch import NO_PAUSES, octave_cluster_sizes
from monitor.estimation.allan.curve import VarianceCurve
from monitor.estimation.allan.missing_samples import min_present
from monitor.estimation.allan.squared_difference_moments import (
    NUM_COEFFICIENTS,
    EstimatorMoments,
    PhaseRing,
    correct_bias_and_compute_intervals,
    missing_between,
    phase_autocovariance,
    summation_nodes,
    variance_from_squared_differences,
)
from monitor.estimation.allan.window_kernel import difference_of_means

MIN_SHARE: Final = 0.5
"""Minimum share of the second differences that must count for a bias correction.

Suppose that missing samples in the middle of a recording remove half of the second differences. In 3000 simulated
recordings, the total variance was then 18 % too low for random walk and 21 % too high for quantization noise.
"""
MAX_EXACT_TERMS: Final = 256
"""Maximum number of samples for which all covariances are summed.

For longer recordings, the phase is sampled on a coarse grid.
"""
MIN_CLUSTER_POINTS: Final = 32
"""Minimum number of points of the coarse grid in a cluster."""
SQUARED_WEIGHTS: Final = 2.0
"""Divisor in the definition of the Allan variance, which is the mean of d² / (2 m²) for second differences d."""
_RAMP: Final = NUM_COEFFICIENTS - 1
"""Index of the linear drift R in θ."""


def total_variance(values: Floats, factors: Ints, pauses: Ints = NO_PAUSES) -> tuple[Floats, Ints, Floats]:
    """Return the total variance of rates without bias correction, and the number of averaged second differences.

    Parameters
    ----------
    values : ndarray of float64, shape (n, k)
        Rates of k axes; non-finite values mean missing samples.
    factors : ndarray of int64, shape (m,)
        Cluster sizes in samples, below n.
    pauses : ndarray of int64
        Rows of missing samples that represent a pause of any length. No cluster that contains such a row counts.

    Returns
    -------
    tvar : ndarray of float64, shape (m, k)
        Total variance in squared units of the axis, not corrected for bias. The variance may be negative if missing
        samples contribute most of the mean square.
    terms : ndarray of int64, shape (m, k)
        Number of averaged second differences.
    excess : ndarray of float64, shape (m, k)
        Contribution of missing samples to the mean square, already subtracted from ``tvar``.

    >>> total_variance(np.tile([1.0, 2.0], 50)[:, None], np.array([1, 2]))[0].ravel().round(9).tolist()
    [0.5, 0.002525253]
    """
    return variance_from_squared_differences(values, factors, SQUARED_WEIGHTS, _add_all_terms, pauses)


def compute_total_curve(
    values: Floats, rate_hz: float, theta: Floats, factors: Ints | None = None, pauses: Ints = NO_PAUSES
) -> VarianceCurve:
    """Compute the bias-corrected total variance of a recording with confidence intervals.

    Parameters
    ----------
    values : ndarray of float64, shape (n, k)
        Rates of k axes; non-finite values mean missing samples.
    rate_hz : float
        Sample rate in Hz.
    theta : ndarray of float64, shape (5, k)
        Fitted Q², N², B², K², R² in SI units; NaN means unknown.
    factors : ndarray of int64, shape (m,), or None
        Cluster sizes in samples, below n. None means powers of two.
    pauses : ndarray of int64
        Rows of missing samples that represent a pause of any length. No cluster that contains such a row counts.
    """
    n = len(values)
    factors = octave_cluster_sizes(n - 1) if factors is None else factors
    raw_variance, terms, excess = total_variance(values, factors, pauses)
    return correct_total_variance(
        [total_estimator_moments(n, int(m)) for m in factors], rate_hz, theta, raw_variance, terms, excess
    )


def correct_total_variance(
    moments: Sequence[EstimatorMoments],
    rate_hz: float,
    theta: Floats,
    raw_variance: Floats,
    terms: Ints,
    excess: Floats,
) -> VarianceCurve:
    """Correct given total variances for bias, and compute their degrees of freedom and confidence intervals.

    Parameters
    ----------
    moments : sequence of EstimatorMoments
        Moments of the total variance estimates at m cluster sizes.
    rate_hz : float
        Sample rate in Hz.
    theta : ndarray of float64, shape (5, k)
        Fitted Q², N², B², K², R² in SI units; NaN means unknown.
    raw_variance : ndarray of float64, shape (m, k)
        Total variances that are not corrected for bias.
    terms : ndarray of int64, shape (m, k)
        Number of averaged second differences.
    excess : ndarray of float64, shape (m, k)
        Contribution of missing samples that has been subtracted from the mean squares.
    """
    enough = terms >= MIN_SHARE * np.array([one.terms for one in moments])[:, None]
    raw_variance = np.where(enough, raw_variance, np.nan)
    curve = correct_bias_and_compute_intervals(moments, rate_hz, theta, raw_variance, terms, excess)
    unsure = 2 * curve.factors > np.array([one.n for one in moments])
    curve.lo[unsure] = curve.hi[unsure] = np.nan
    return curve


def total_estimator_moments(n: int, factor: int) -> EstimatorMoments:
    """Return the mean and the covariance of the total variance estimate at one cluster size.

    Parameters
    ----------
    n : int
        Number of samples in the recording.
    factor : int
        Cluster size in samples, from 1 to n − 1.

    >>> one = total_estimator_moments(100_000, 50_000)               # random walk at T/2: 1 − 0.750/2
    >>> print(f"{one.mean[3] / one.allan[3]:.3f}")
    0.625
    """
    places, weights = summation_nodes(1, n, [-(-factor // 2), factor, n - factor, n - factor // 2])
    points, signs = _points(places, n, factor)
    half = 0.5 / factor**2
    mean = half / (n - 1) * (_squares(points, signs) @ weights)
    inner = _squares(factor * np.array([[-1.0, 0.0, 1.0]]), np.array([[1.0, -2.0, 1.0]]))
    return EstimatorMoments(n, factor, n - 1, mean, half * inner[:, 0], _covariance(n, factor))


def _points(places: Floats, n: int, m: int) -> tuple[Floats, Floats]:
    """Return the indices [i, 5] and weights of the phase points in the second differences at ``places``."""
    front, behind = places < m, places > n - m
    points = [0.0 * places, np.abs(places - m), places, np.minimum(places + m, 2 * n - m - places), n + 0.0 * places]
    signs = [2.0 * front, 1.0 - 2.0 * front, -2.0 + 0.0 * places, 1.0 - 2.0 * behind, 2.0 * behind]
    return np.stack(points, axis=1), np.stack(signs, axis=1)


def _squares(points: Floats, signs: Floats) -> Floats:
    """Return the mean squares [5, i] of weighted sums of phase points for each unit coefficient."""
    lags = points[:, :, None] - points[:, None, :]
    random = np.einsum("ip,iq,aipq->ai", signs, signs, phase_autocovariance(lags))
    ramp = (signs * 0.5 * points**2).sum(axis=1) ** 2
    return np.concatenate([random, ramp[None]])


def _covariance(n: int, m: int) -> Floats:
    """Return the matrix C [5, 5] for which Σ_ab θ_a θ_b C_ab is the variance of the total variance estimate.

    For recordings of more than ``MAX_EXACT_TERMS`` samples, the smooth autocovariances are evaluated on a coarse grid.
    If a recording contains many clusters, each additional second difference adds the same amount to the sums.
    """
    scale = 2.0 * (0.5 / (m * m * (n - 1.0))) ** 2
    if n <= MAX_EXACT_TERMS:
        return _pair_sums(n, m, 1.0) * scale
    cluster = m if m <= MIN_CLUSTER_POINTS else max(MIN_CLUSTER_POINTS, round(MAX_EXACT_TERMS * m / n))
    step = m / cluster
    length = max(min(MAX_EXACT_TERMS, round(n / step)), cluster + 1)
    sums = _pair_sums(length, cluster, step)
    beyond = n / step - length
    if beyond >= 1.0:
        sums += beyond * (sums - _pair_sums(length - 1, cluster, step))
    return sums * scale


def _pair_sums(n: int, m: int, step: float) -> Floats:
    """Return the sums [5, 5] of the products of covariances over all pairs of second differences.

    On a coarse grid with one phase point per ``step`` samples, each pair represents step² pairs. The covariance of
    quantization noise is nonzero only if phase points coincide, so each coinciding pair represents ``step`` pairs. The
    two ends of the recording are exceptions, because all reflected second differences contain an end point.

    The autocovariances at a lag multiplied by ``step`` are linear functions of those at the original lag, except for a
    flicker-noise term t² ln(step), which cancels in second differences.
    """
    scale = np.diag([1.0, step, step**2, step**3, step**4, 1.0])
    scale[3, 1] = (step - step**3) / 6.0
    products = step * step * (scale @ _unit_step_products(n, m) @ scale.T)
    products[0] /= step
    products[1:, 0] /= step
    products[_RAMP, _RAMP] = 0.0  # a linear drift without noise has no variance
    joined = products[:NUM_COEFFICIENTS, :NUM_COEFFICIENTS]
    joined[0] += products[NUM_COEFFICIENTS, :NUM_COEFFICIENTS]
    joined[:, 0] += products[:NUM_COEFFICIENTS, NUM_COEFFICIENTS]
    joined[0, 0] += products[NUM_COEFFICIENTS, NUM_COEFFICIENTS]
    return np.asarray(joined)


@lru_cache(maxsize=2048)  # one computation takes about 12 ms, and a growing recording needs the same sizes again
def _unit_step_products(n: int, m: int) -> Floats:
    """Return the 6 × 6 sums of products over all pairs, for Q, N, B, K, R and the ends, with one point per sample."""
    at = np.arange(n + 1)
    lags = phase_autocovariance(np.arange(n + 1.0))[:, np.abs(at[:, None] - at)]
    points, signs = _points(np.arange(1.0, n), n, m)
    rows = points.astype(np.int64)
    random = _combine_points(_combine_points(lags, rows, signs).transpose(0, 2, 1), rows, signs)
    ends = signs[:, [0, 4]] @ signs[:, [0, 4]].T
    random[0] -= ends
    ramp = (signs * 0.5 * points**2).sum(axis=1)
    parts = np.concatenate([random, np.outer(ramp, ramp)[None], ends[None]]).reshape(NUM_COEFFICIENTS + 1, -1)
    return np.asarray(parts @ parts.T)


def _combine_points(of_points: Floats, rows: Ints, signs: Floats) -> Floats:
    """Combine phase points [4, points, …] into second differences [4, terms, …]."""
    terms = signs[:, 0, None] * of_points[:, rows[:, 0]]
    for p in range(1, rows.shape[1]):
        terms += signs[:, p, None] * of_points[:, rows[:, p]]
    return np.asarray(terms)


def _add_all_terms(ring: PhaseRing, m: int, sums: Floats, extra: Floats, terms: Ints) -> None:
    if m < ring.n:
        add_total_variance_squares(ring, m, 1, ring.n, sums, extra, terms)


@compiled
def add_total_variance_squares(
    ring: PhaseRing, m: int, begin: int, end: int, sums: Floats, extra: Floats, terms: Ints
) -> None:
    """Add the squares of a range of second differences of the extended phase to ``sums``.

    Parameters
    ----------
    ring : PhaseRing
        Ring buffer with the phase of the recording.
    m : int
        Cluster size in samples.
    begin, end : int
        Range begin ≤ i < end of the middle phase points of the second differences.
    sums : ndarray of float64, shape (k,)
        Sum of squares of each axis, updated in place.
    extra : ndarray of float64, shape (k,)
        Sum of the excess of missing samples on each axis, updated in place, see ``AddSquares``.
    terms : ndarray of int64, shape (k,)
        Number of second differences of each axis, updated in place.
    """
    phase, missing, first, n = ring.phase, ring.missing, ring.first, ring.n
    last = (first + n) % phase.shape[0]
    for lane in range(sums.size):
        if missing[first, lane] != missing[last, lane]:
            _add_terms_with_missing(phase, missing, first, n, m, begin, end, sums, extra, terms)
            return
    i = begin
    while i < end:
        stop = min(end, m) if i < m else end
        if i <= ring.n - m:
            stop = min(stop, ring.n - m + 1)
        _add_run(ring, m, i, stop, sums, terms)
        i = stop


@compiled
def _add_run(ring: PhaseRing, m: int, begin: int, end: int, sums: Floats, terms: Ints) -> None:
    """Add the squares of consecutive second differences whose phase points are reflected at the same ends.

    A reflected phase point is twice the phase at the end of the recording minus the phase at the mirror point.
    """
    phase, first, n = ring.phase, ring.first, ring.n
    places = phase.shape[0]
    last = (first + n) % places
    before, behind = -1 if begin < m else 1, -1 if begin > n - m else 1
    mirror = np.empty(sums.size, phase.dtype)
    for lane in range(sums.size):
        mirror[lane] = (1 - before) * phase[first, lane] + (1 - behind) * phase[last, lane]
    left, at = (first + abs(begin - m)) % places, (first + begin) % places
    right = (first + min(begin + m, 2 * n - m - begin)) % places
    for _ in range(end - begin):
        x, y, z = np.uintp(left), np.uintp(at), np.uintp(right)
        for lane in range(np.uintp(sums.size)):
            d = float(before * phase[x, lane] - 2 * phase[y, lane] + behind * phase[z, lane] + mirror[lane])
            sums[lane] += d * d
            terms[lane] += 1
        left, at, right = left + before, at + 1, right + behind
        if left < 0:
            left += places
        elif left == places:
            left = 0
        if at == places:
            at = 0
        if right < 0:
            right += places
        elif right == places:
            right = 0


@compiled
def _add_terms_with_missing(
    phase: Floats | Ints,
    missing: NDArray[np.int32] | Ints,
    first: int,
    n: int,
    m: int,
    begin: int,
    end: int,
    sums: Floats,
    extra: Floats,
    terms: Ints,
) -> None:
    """Add the squares of second differences of the extended phase, some of which contain missing samples.

    Near the ends, reflection makes a cluster contain samples twice, or both clusters contain the same samples. The
    page ``docs/explanation/missing-samples.md`` states the excess of such differences.
    """
    places = phase.shape[0]
    most = m - min_present(m)
    last = _row(first, n, places)
    older_share, newer_share, term, counted = 0.0, 0.0, 0.0, False
    for i in range(begin, end):
        left, right = i < m, i > n - m
        a, b = abs(i - m), min(i + m, 2 * n - m - i)
        x, y, z = _row(first, a, places), _row(first, i, places), _row(first, b, places)
        # numbers of samples that occur twice or in both clusters if no samples are missing
        twice = (min(a, i) if left else 0) + (n - max(b, i) if right else 0)
        both = (max(i - b, 0) if right else 0) + (max(a - i, 0) if left else 0)
        both += max(a - b, 0) if left and right else 0
        complete = 2.0 + 2.0 * (twice - both) / m
        before_a, before_i, before_b, before_n = -1, -1, -1, -1  # numbers of missing samples before each index
        older, newer = 0, 0
        for lane in range(sums.size):
            start = missing[first, lane]
            to_a, to_i = missing_between(missing[x, lane], start), missing_between(missing[y, lane], start)
            to_b, to_n = missing_between(missing[z, lane], start), missing_between(missing[last, lane], start)
            if to_a != before_a or to_i != before_i or to_b != before_b or to_n != before_n:
                before_a, before_i, before_b, before_n = to_a, to_i, to_b, to_n
                older = to_i + to_a if left else to_i - to_a
                newer = 2 * to_n - to_i - to_b if right else to_b - to_i
                counted = older <= most and newer <= most
                if counted:
                    older_share, newer_share = 1.0 / (m - older), 1.0 / (m - newer)
                    present_a, present_i, present_b = a - to_a, i - to_i, b - to_b
                    twice_a = min(present_a, present_i) if left else 0
                    twice_b = n - to_n - max(present_b, present_i) if right else 0
                    both = (max(present_i - present_b, 0) if right else 0) + (
                        max(present_a - present_i, 0) if left else 0
                    )
                    both += max(present_a - present_b, 0) if left and right else 0
                    term = (
                        m
                        * (
                            (1.0 + 2 * twice_a * older_share) * older_share
                            + (1.0 + 2 * twice_b * newer_share) * newer_share
                            - 2 * both * older_share * newer_share
                        )
                        - complete
                    )
            if not counted:
                continue
            u, v, w = phase[x, lane], phase[y, lane], phase[z, lane]
            older_sum = (v - phase[first, lane]) + (u - phase[first, lane]) if left else v - u
            newer_sum = (phase[last, lane] - v) + (phase[last, lane] - w) if right else w - v
            d = float(newer_sum - older_sum)
            if older != 0 or newer != 0:
                d = m * difference_of_means(older_sum, newer_sum, m - older, m - newer, older_share, newer_share)
                extra[lane] += term
            sums[lane] += d * d
            terms[lane] += 1


@inlined
def _row(first: int, index: int, places: int) -> int:
    """Return the row of a phase point in the ring buffer."""
    return first + index if first + index < places else first + index - places
