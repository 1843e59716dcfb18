"""Overlapping Hadamard variance, which is insensitive to a linear drift of the rate.

The Hadamard variance (NIST SP 1065 eq. 20) of a rate is the mean of (x_{i+3m} − 3 x_{i+2m} + 3 x_{i+m} − x_i)² / 6m²
over all i, where x is phase and m ≤ n/3. For white noise, the Hadamard variance equals the Allan variance. For cluster
sizes above a few samples, the ratio of the two variances is 10/9 for quantization noise, 0.811 for flicker noise and
0.5 for random walk.

The degrees of freedom are computed from the covariance of the third differences for the fitted mixture of noise terms.
In contrast, the formula of Greenhall & Riley (PTTI 2003, d = 3) holds only for a single power law. Clusters with
missing samples are treated as described in ``missing_samples``.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled
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

SQUARED_WEIGHTS: Final = 6.0
"""Divisor in the definition of the Hadamard variance, which is the mean of d² / (6 m²) for third differences d."""

MAX_LAG_CLUSTERS: Final = 16
"""Lag in clusters beyond which third differences are treated as uncorrelated.

At a lag of 16 clusters, the squared correlation coefficient of third differences of flicker noise is 1e-9.
"""


def hadamard_variance(values: Floats, factors: Ints, pauses: Ints = NO_PAUSES) -> tuple[Floats, Ints, Floats]:
    """Return the overlapping Hadamard variance of rates and the number of averaged third differences.

    The parameters and results are those of ``total.total_variance``, but cluster sizes must not exceed n/3.

    >>> ramp = np.arange(90.0)[:, None]
    >>> hadamard_variance(ramp + np.tile([[0.0], [0.5]], (45, 1)), np.array([1, 2]))[0].ravel().round(12).tolist()
    [0.166666666667, 0.0]
    """
    return variance_from_squared_differences(values, factors, SQUARED_WEIGHTS, add_hadamard_squares, pauses)


def compute_hadamard_curve(
    values: Floats, rate_hz: float, theta: Floats, factors: Ints | None = None, pauses: Ints = NO_PAUSES
) -> VarianceCurve:
    """Compute the Hadamard variance of a recording with confidence intervals.

    The parameters are those of ``total.compute_total_curve``, but cluster sizes must not exceed n/3.
    """
    n = len(values)
    factors = octave_cluster_sizes(n // 3) if factors is None else factors
    raw_variance, terms, excess = hadamard_variance(values, factors, pauses)
    return compute_hadamard_confidence_intervals(
        [hadamard_estimator_moments(n, int(m)) for m in factors], rate_hz, theta, raw_variance, terms, excess
    )


def compute_hadamard_confidence_intervals(
    moments: Sequence[EstimatorMoments],
    rate_hz: float,
    theta: Floats,
    raw_variance: Floats,
    terms: Ints,
    excess: Floats,
) -> VarianceCurve:
    """Compute the degrees of freedom and confidence intervals of given Hadamard variances.

    The parameters are those of ``total.correct_total_variance``.
    """
    curve = correct_bias_and_compute_intervals(moments, rate_hz, theta, raw_variance, terms, excess)
    # the variance has no bias, even if the noise is unknown
    return replace(curve, variance=np.maximum(raw_variance, 0.0))


def hadamard_estimator_moments(n: int, factor: int) -> EstimatorMoments:
    """Return the mean and the covariance of the Hadamard variance estimate at one cluster size.

    As the example shows, 35 000 third differences of white noise at m = 1 have 18 000 degrees of freedom.

    Parameters
    ----------
    n : int
        Number of samples in the recording.
    factor : int
        Cluster size in samples, at most n/3.

    >>> one = hadamard_estimator_moments(35_002, 1)
    >>> round(2 * one.mean[1] ** 2 / one.covariance[1, 1])
    18000
    """
    terms = n + 1 - 3 * factor
    lags, weights = summation_nodes(0, min(terms, MAX_LAG_CLUSTERS * factor), [factor, 2 * factor, 3 * factor])
    shared = np.zeros((4, lags.size))
    for p, weight in zip(range(-3, 4), (-1.0, 6.0, -15.0, 20.0, -15.0, 6.0, -1.0), strict=True):
        shared += weight * phase_autocovariance(lags + p * factor)
    pairs = weights * (terms - lags) * np.where(lags > 0.0, 2.0, 1.0)
    scale = 1.0 / (6.0 * factor**2)
    mean, covariance = np.zeros(NUM_COEFFICIENTS), np.zeros((NUM_COEFFICIENTS, NUM_COEFFICIENTS))
    mean[:4] = scale * shared[:, np.argmin(lags)]
    covariance[:4, :4] = 2.0 * (scale / terms) ** 2 * (shared * pairs @ shared.T)
    return EstimatorMoments(n, factor, terms, mean, mean, covariance)


@compiled
def add_hadamard_squares(ring: PhaseRing, m: int, sums: Floats, extra: Floats, terms: Ints) -> None:
    """Add the squared third differences of phase at one cluster size to ``sums``.

    Parameters
    ----------
    ring : PhaseRing
        Ring buffer with the phase of the recording.
    m : int
        Cluster size in samples.
    sums : ndarray of float64, shape (k,)
        Sum of squares of each axis, updated in place.
    extra : ndarray of float64, shape (k,)
        Sum of the excess of missing samples on each axis, updated in place, see ``AddSquares``.
    terms : ndarray of int64, shape (k,)
        Number of third differences of each axis, updated in place.
    """
    phase, missing, first, n = ring.phase, ring.missing, ring.first, ring.n
    places = phase.shape[0]
    last = (first + n) % places
    whole = True
    for lane in range(sums.size):
        whole = whole and missing[first, lane] == missing[last, lane]
    most = m - min_present(m)
    a, b, c, d = first % places, (first + m) % places, (first + 2 * m) % places, (first + 3 * m) % places
    for _ in range(n + 1 - 3 * m):
        u, v, w, x = np.uintp(a), np.uintp(b), np.uintp(c), np.uintp(d)
        for lane in range(np.uintp(sums.size)):
            if whole or missing[u, lane] == missing[x, lane]:
                e = float(phase[x, lane] - phase[u, lane] - 3 * (phase[w, lane] - phase[v, lane]))
                sums[lane] += e * e
                terms[lane] += 1
                continue
            older = missing_between(missing[v, lane], missing[u, lane])
            middle = missing_between(missing[w, lane], missing[v, lane])
            newer = missing_between(missing[x, lane], missing[w, lane])
            if older > most or middle > most or newer > most:
                continue
            older_share, middle_share, newer_share = 1.0 / (m - older), 1.0 / (m - middle), 1.0 / (m - newer)
            older_sum, middle_sum = phase[v, lane] - phase[u, lane], phase[w, lane] - phase[v, lane]
            newer_sum = phase[x, lane] - phase[w, lane]
            e = m * (
                difference_of_means(middle_sum, newer_sum, m - middle, m - newer, middle_share, newer_share)
                - difference_of_means(older_sum, middle_sum, m - older, m - middle, older_share, middle_share)
            )
            sums[lane] += e * e
            extra[lane] += older * older_share + 4.0 * middle * middle_share + newer * newer_share
            terms[lane] += 1
        a, b, c, d = a + 1, b + 1, c + 1, d + 1
        if a == places:
            a = 0
        if b == places:
            b = 0
        if c == places:
            c = 0
        if d == places:
            d = 0
