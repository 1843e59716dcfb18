"""Mean and covariance of squared phase differences, which determine the bias and degrees of freedom of a variance.

The Allan, total and Hadamard variances are means of squared phase differences d_k². Each difference d_k = Σ_p w_p
x(k_p) is a weighted sum of a few phase points. The covariance of two differences is Cov(d_j, d_k) = Σ_pq w_p w_q G(j_p
− k_q), where G is the generalised autocovariance of phase (``phase_autocovariance``). The formula also holds for phase
points that are reflected at the ends of a recording. For Gaussian noise, Isserlis' theorem gives Cov(d_j², d_k²) = 2
Cov(d_j, d_k)².

A linear drift of the rate adds a known offset to each second difference. The square of the offset increases the mean of
the estimate, and the product of offset and noise increases its variance.

Time is in units of one sample interval τ0, so θ = (Q²/τ0², N²/τ0, B², K² τ0, R² τ0²).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats, Ints
from monitor.common.compiled import inlined
from monitor.estimation.allan.batch import octave_cluster_sizes, overlapping_allan_variances
from monitor.estimation.allan.curve import VarianceCurve
from monitor.estimation.allan.missing_samples import variance_within_clusters_from_octaves
from monitor.estimation.allan.uncertainty import N, deviation_intervals
from monitor.estimation.fit.coefficient_fit import TO_SI

NUM_COEFFICIENTS: Final = 5
"""Number of noise coefficients Q, N, B, K and R."""

_BLOCK_GROWTH: Final = 1.5
"""Ratio between the lengths of successive summation blocks."""


@dataclass(frozen=True, slots=True)
class EstimatorMoments:
    """Mean and covariance of a variance estimate at one cluster size, for a recording without missing samples."""

    n: int  # number of samples in the recording
    factor: int  # cluster size in samples
    terms: int  # number of averaged differences
    mean: Floats  # [5] expectation of the variance estimate for each unit coefficient
    allan: Floats  # [5] Allan variance for each unit coefficient
    covariance: Floats  # [5, 5] matrix C, so that the variance of the estimate is Σ_ab θ_a θ_b C_ab


class PhaseRing(NamedTuple):
    """Ring buffer with at least n + 1 phase points for n samples."""

    phase: Floats | Ints  # [places, at least k] phase in floating point, or integer phase modulo 2⁶⁴
    missing: NDArray[np.int32] | Ints  # [places, at least k] running count of missing samples, which may wrap around
    first: int  # row of the oldest phase point
    n: int  # number of samples


AddSquares = Callable[[PhaseRing, int, Floats, Floats, Ints], None]
"""Type of a function that adds the squared differences at one cluster size to sums [k].

The function also adds the excess of missing samples to sums [k] and counts the differences [k]. Let a difference of
cluster means have the variance a + e S² for white noise, where a is its variance if no samples are missing. The excess
is m e.
"""


def _integrate_to_phase(values: Floats, pauses: Ints) -> PhaseRing:
    phase = np.zeros((len(values) + 1, values.shape[1]))
    missing = np.zeros(phase.shape, np.int64)
    rate = phase[1:]
    rate[:] = values
    absent = ~np.isfinite(rate)
    rate[absent] = 0.0
    # Subtracting the mean of the rates keeps the phase small, so it loses less precision.
    rate -= rate.sum(axis=0) / np.maximum((~absent).sum(axis=0), 1)
    rate[absent] = 0.0
    np.cumsum(rate, axis=0, out=rate)
    missing[1:] = absent
    missing[pauses + 1] = len(values)
    np.cumsum(missing, axis=0, out=missing)
    return PhaseRing(phase, missing, 0, len(values))


@inlined
def missing_between(newer: np.integer | int, older: np.integer | int) -> int:
    """Return the difference of two elements of the running count of missing samples, which may wrap around.

    The function is also correct for 64-bit counts, which pauses may increase by more than 2³¹.
    """
    count = int(newer) - int(older)
    return count if count >= 0 else count + (1 << 32)


def variance_from_squared_differences(
    values: Floats, factors: Ints, squared_weights: float, add_squares: AddSquares, pauses: Ints
) -> tuple[Floats, Ints, Floats]:
    """Return a variance of rates, computed as a mean of squared phase differences, and the number of differences.

    The third result is the contribution of missing samples, which has been subtracted from the mean squares. The
    correction is described in ``missing_samples``.

    Parameters
    ----------
    values : ndarray of float64, shape (n, k)
        Rates of k axes; non-finite values mean missing samples.
    factors : ndarray of int64, shape (m,)
        Cluster sizes in samples.
    squared_weights : float
        Divisor in the definition of the variance: 2 for second differences, 6 for third differences.
    add_squares : AddSquares
        Function that adds the squared differences at one cluster size.
    pauses : ndarray of int64
        Rows of missing samples that represent a pause of any length. No cluster that contains such a row counts.
    """
    ring = _integrate_to_phase(values, pauses)
    sums, extra = np.zeros((2, factors.size, values.shape[1]))
    terms = np.zeros(sums.shape, np.int64)
    for i, m in enumerate(factors):
        add_squares(ring, int(m), sums[i], extra[i], terms[i])
    within = np.zeros_like(sums)
    if extra.any():
        octaves = octave_cluster_sizes(int(factors.max()))
        within = variance_within_clusters_from_octaves(
            overlapping_allan_variances(values, octaves, pauses=pauses).avar, factors
        )
    variance, excess = correct_squared_differences(sums, extra, terms, factors, squared_weights, within)
    return variance, terms, excess


def correct_squared_differences(
    sums: Floats, extra: Floats, terms: Ints, factors: Ints, squared_weights: float, within: Floats
) -> tuple[Floats, Floats]:
    """Convert sums of squared phase differences to variances, and subtract the contribution of missing samples.

    Parameters
    ----------
    sums : ndarray of float64, shape (m, k)
        Sums of squared phase differences.
    extra : ndarray of float64, shape (m, k)
        Sums of the excess of missing samples, see ``AddSquares``.
    terms : ndarray of int64, shape (m, k)
        Number of differences in each sum.
    factors : ndarray of int64, shape (m,)
        Cluster sizes in samples.
    squared_weights : float
        Divisor in the definition of the variance: 2 for second differences, 6 for third differences.
    within : ndarray of float64, shape (m, k)
        Variance V within clusters.

    Returns
    -------
    variance, excess : ndarray of float64, shape (m, k)
        Corrected variance, which may be negative, and the contribution of missing samples.
    """
    with np.errstate(invalid="ignore"):
        count = squared_weights * factors[:, None] * np.where(terms > 0, terms, np.nan)
        excess = np.where(extra == 0.0, 0.0, extra / count * within)
        return sums / (factors[:, None] * count) - excess, excess


def theta_in_sample_units(theta: Floats, rate_hz: float) -> Floats:
    """Convert squared coefficients θ from SI units to units of one sample interval.

    A negative Q², which represents a limited bandwidth, is replaced by 0.

    Parameters
    ----------
    theta : ndarray of float64, shape (5, k)
        Squared coefficients Q², N², B², K², R² in SI units.
    rate_hz : float
        Sample rate in Hz.
    """
    return np.asarray(np.maximum(theta, 0.0) * (rate_hz ** (-2.0 * TO_SI))[:, None])


def correct_bias_and_compute_intervals(
    moments: Sequence[EstimatorMoments],
    rate_hz: float,
    theta: Floats,
    raw_variance: Floats,
    terms: Ints,
    excess: Floats | float = 0.0,
) -> VarianceCurve:
    """Correct measured variances for bias, and compute degrees of freedom and confidence intervals.

    Parameters
    ----------
    moments : sequence of EstimatorMoments
        Moments of the variance estimates at m cluster sizes.
    rate_hz : float
        Sample rate in Hz.
    theta : ndarray of float64, shape (5, k)
        Fitted Q², N², B², K², R² in SI units; NaN means unknown.
    raw_variance : ndarray of float64, shape (m, k)
        Measured variances that are not corrected for bias.
    terms : ndarray of int64, shape (m, k)
        Number of averaged squared differences.
    excess : ndarray of float64, shape (m, k), or float
        Contribution of missing samples that has been subtracted from the mean squares.
    """
    theta = theta_in_sample_units(theta, rate_hz)
    means = np.stack([one.mean for one in moments])
    mean = means @ theta
    allan = np.stack([one.allan for one in moments]) @ theta
    noise = np.repeat(theta[:, None], len(moments), axis=1)
    noise[N] += np.maximum(excess, 0.0) / means[:, N, None]  # missing samples act like white noise
    level = np.einsum("ma,amk->mk", means, noise)
    square = np.einsum("amk,mab,bmk->mk", noise, np.stack([one.covariance for one in moments]), noise)
    whole = np.array([one.terms for one in moments])[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        edf = np.where(raw_variance + excess > 0.0, 2.0 * level * level / square * (terms / whole), np.nan)
        ratio = allan / mean
    edf[~np.isfinite(edf)] = np.nan
    lo, hi = deviation_intervals(raw_variance * ratio, edf, excess=excess * ratio)
    factors = np.array([one.factor for one in moments])
    return VarianceCurve(factors / rate_hz, factors, np.maximum(raw_variance * ratio, 0.0), terms, edf, lo, hi)


def phase_autocovariance(t: Floats) -> Floats:
    """Return the generalised autocovariance of phase [4, …] for unit Q, N, B and K, at lags t in samples.

    The autocovariances are δ(t), −|t|/2, t² ln|t| / 2π and (|t|³ − |t|)/12.
    """
    t = np.abs(t)
    flicker = t * t * np.log(np.where(t == 0.0, 1.0, t)) / (2.0 * np.pi)
    return np.stack([np.where(t == 0.0, 1.0, 0.0), -0.5 * t, flicker, (t * t - 1.0) * t / 12.0])


def summation_nodes(begin: int, end: int, kinks: Iterable[int]) -> tuple[Floats, Floats]:
    """Return nodes and weights that approximate the sum of a function over the integers begin ≤ k < end.

    The range is divided into blocks, whose length grows with the distance from the nearest kink of the function. The
    sum over a block is approximated by a three-point Gauss rule, which is exact for polynomials of degree 5.

    Parameters
    ----------
    begin, end : int
        Range of the integers.
    kinks : iterable of int
        Points at which the function or one of its derivatives is not continuous.

    Returns
    -------
    places, weights : ndarray of float64
        Nodes at which the function is evaluated, and weights of the function values.

    >>> places, weights = summation_nodes(0, 1000, [0, 400])
    >>> places.size < 200, round(float(weights @ places**5) / sum(k**5 for k in range(1000)), 12)
    (True, 1.0)
    """
    steps = [0, 1]
    while 2 * steps[-1] < end - begin:
        steps.append(max(steps[-1] + 1, int(_BLOCK_GROWTH * steps[-1])))
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
