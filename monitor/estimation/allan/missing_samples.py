"""Allan variance of records with missing samples: which differences count, and correction of the bias.

Let two adjacent clusters of m samples contain n_A and n_B samples that are present. The difference of their means
counts if 60 % of the samples of each cluster are present. The mean of the present samples differs from the mean of the
cluster like the mean of a random sample that is drawn without replacement (Cochran, Sampling Techniques, chapter 2).
Half the mean square of the counted differences is therefore too large by e V(m), where

    e = mean of ½ (1/n_A + 1/n_B) − 1/m,    V(m) = mean variance of the samples within a cluster (divisor m − 1).

V is the sum of the Allan variances of all shorter clusters of 1, 2, 4, … samples:

    V(2^J) = 2^J / (2^J − 1) · Σ_{j<J} σ²(2^j) / 2.

The page ``docs/explanation/missing-samples.md`` derives both formulas and says where they cease to hold.
"""

from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.common.compiled import inlined

MIN_PRESENT_SHARE: Final = 0.7
"""Minimum share of samples that must be present to compute a slope of the rate."""


class AllanVariances(NamedTuple):
    """Overlapping Allan variance at m cluster sizes, for one axis or k axes."""

    avar: Floats  # [m] or [m, k] squared units of the axis; NaN if too many samples are missing; may be ≤ 0 under loss
    terms: Ints  # [m] or [m, k] number of counted second differences
    excess: Floats  # [m] or [m, k] contribution of missing samples to the mean square, already subtracted from ``avar``


class VarianceWithinClusters(NamedTuple):
    """Linear map from the Allan variances at R cluster sizes to the variance V within the clusters.

    Rows and columns of ``weights`` are in the order ``order``. Each column belongs to one value of V.
    """

    factors: Ints  # [R] given cluster sizes, followed by added powers of two
    spans: Ints  # [R] number of samples that are used at each cluster size
    order: Ints  # [R] indices of the cluster sizes, ascending in each grid
    first: Ints  # [R] position of the first cluster size of the same grid
    weights: Floats  # [R, R] upper triangular matrix, zero outside the grids


@inlined
def min_present(m: int) -> int:
    """Return the minimum number of present samples in a cluster of m samples, which is ⌈0.6 m⌉.

    If 20 % of the samples are missing at random, nearly all clusters of 8 and more samples contain enough samples.
    """
    return (3 * m + 4) // 5


def variance_within_clusters(factors: Ints, spans: Ints) -> VarianceWithinClusters:
    """Return the linear map from Allan variances to the variance within clusters.

    Each sequence of ascending cluster sizes is a grid of its own. If a grid does not begin with 1, or if a cluster size
    is more than twice its predecessor, the missing powers of two are added.

    The Allan variance at a power of two that is not in the grid is interpolated: m σ²(m) is linear in log m. The
    variance within clusters of another size is interpolated between powers of two.

    Parameters
    ----------
    factors : ndarray of int64, shape (m,)
        Cluster sizes in samples.
    spans : ndarray of int64, shape (m,)
        Number of samples that are used at each cluster size. An added size gets the span of the next larger size.

    >>> v = variance_within_clusters(np.array([1, 2, 4, 3]), np.full(4, 90))
    >>> v.factors.tolist(), v.order.tolist()
    ([1, 2, 4, 3, 1, 2], [0, 1, 2, 4, 5, 3])
    >>> ((1.0 / v.factors[v.order]) @ v.weights).round(12).tolist()  # white noise
    [0.0, 1.0, 1.0, 0.0, 1.0, 1.0]
    """
    edges = [0, *(np.flatnonzero(np.diff(factors) <= 0) + 1).tolist(), factors.size]
    order: list[Ints] = []
    first: list[Ints] = []
    parts: list[Floats] = []
    for begin, end in pairwise(edges):
        own, rows = factors[begin:end], np.arange(begin, end)
        if own[0] > 1 or (own[1:] > 2 * own[:-1]).any():
            octaves = np.setdiff1d(2 ** np.arange(int(own[-1] - 1).bit_length(), dtype=np.int64), own)
            rows = np.concatenate([rows, factors.size + np.arange(octaves.size)])
            spans = np.concatenate([spans, spans[begin:end][np.searchsorted(own, octaves)]])
            factors = np.concatenate([factors, octaves])
        rows = rows[np.argsort(factors[rows])]
        first.append(np.full(rows.size, sum(one.size for one in order)))
        order.append(rows)
        parts.append(_weights_of_grid(factors[rows].astype(np.float64)))
    weights = np.zeros((factors.size, factors.size))
    for at, part in zip(first, parts, strict=True):
        weights[at[0] : at[0] + at.size, at[0] : at[0] + at.size] = part
    return VarianceWithinClusters(factors, spans, np.concatenate(order), np.concatenate(first), weights)


def _weights_of_grid(m: Floats) -> Floats:
    log_m = np.log2(m)
    log_octaves = np.arange(np.ceil(log_m[-1]) + 1.0)
    octaves = np.exp2(log_octaves)
    # the rows are octaves, the columns are cluster sizes
    allan = np.stack([np.interp(log_octaves, log_m, m * one) for one in np.eye(m.size)], axis=1) / octaves[:, None]
    below = 0.5 * (np.cumsum(allan, axis=0) - allan)  # sum over the shorter octaves
    within = below * (octaves / np.maximum(octaves - 1.0, 1.0))[:, None]
    return np.stack([np.interp(log_m, log_octaves, column) for column in within.T])


def variance_within_clusters_from_octaves(avar: Floats, factors: Ints) -> Floats:
    """Return the variance V within clusters [m, k], computed from Allan variances at powers of two.

    The variance within clusters of another size is interpolated between powers of two. If an Allan variance is not
    known, white noise is assumed at this cluster size.

    Parameters
    ----------
    avar : ndarray of float64, shape (j, k)
        Allan variances at 1, 2, 4, … samples; NaN means unknown.
    factors : ndarray of int64, shape (m,)
        Cluster sizes in samples, up to 2^j.

    >>> white = np.array([[1.0], [0.5], [np.nan]])
    >>> variance_within_clusters_from_octaves(white, np.array([1, 2, 3, 8])).ravel().tolist()
    [0.0, 1.0, 1.0, 1.0]
    """
    known = avar.copy()
    for j in range(1, len(known)):
        known[j] = np.where(np.isnan(known[j]), 0.5 * known[j - 1], known[j])
    octaves = np.exp2(np.arange(len(known) + 1.0))
    below = np.concatenate([np.zeros((1, avar.shape[1])), 0.5 * np.cumsum(known, axis=0)])
    within = below * (octaves / np.maximum(octaves - 1.0, 1.0))[:, None]
    return np.stack([np.interp(np.log2(factors), np.log2(octaves), column) for column in within.T], axis=1)


@inlined
def subtract_excess(
    factors: Ints, order: Ints, first: Ints, weights: Floats, share: Floats, avar: Floats, excess: Floats
) -> None:
    """Subtract the contribution e V of missing samples from the mean squares.

    If an Allan variance that V needs is not known, white noise is assumed at this cluster size.

    Parameters
    ----------
    factors, order, first, weights
        Fields of ``VarianceWithinClusters``.
    share : ndarray of float64, shape (R, k)
        The factor e of k axes.
    avar : ndarray of float64, shape (R, k)
        On input, half the mean square of the differences; NaN if no difference counts. On output, Allan variance.
    excess : ndarray of float64, shape (R, k)
        Output array for the subtracted contribution.
    """
    axes = avar.shape[1]
    within, known = np.zeros((order.size, axes)), np.full(axes, np.nan)
    for p in range(order.size):
        i, own = order[p], weights[p, p]
        ratio = factors[order[p - 1]] / factors[i] if p > first[p] else np.nan
        for axis in range(axes):
            raw = avar[i, axis]
            avar[i, axis] = (raw - share[i, axis] * within[p, axis]) / (1.0 + share[i, axis] * own)
            known[axis] = avar[i, axis] if raw == raw else known[axis] * ratio
            excess[i, axis] = raw - avar[i, axis] if raw == raw else 0.0
        if p == first[p]:
            for axis in range(axes):
                if known[axis] != known[axis]:
                    known[axis] = _white_noise_level(factors, order, first, avar[:, axis], p)
        for r in range(p, order.size):
            for axis in range(axes):
                within[r, axis] += weights[p, r] * known[axis] if known[axis] == known[axis] else 0.0


@inlined
def _white_noise_level(factors: Ints, order: Ints, first: Ints, avar: Floats, p: int) -> float:
    """Return the Allan variance at position p that white noise would have, from the next known value of the grid."""
    for q in range(p + 1, order.size):
        if first[q] == p and avar[order[q]] == avar[order[q]]:
            return float(avar[order[q]] * factors[order[q]] / factors[order[p]])
    return np.nan
