"""Overlapping Allan variance of a whole recording, computed in floating point.

The results serve as a reference for ``AllanWindow``, which uses integer arithmetic. Three measures keep the precision
for 10⁷ samples and more, even for noise of 1e-4 m/s² on a mean of 9.81 m/s².

- The mean of the recording is subtracted from the samples. The subtraction is exact if the noise is small compared with
  the mean (Sterbenz).
- Phase is the running sum of the rates after subtraction of the mean. The rounding errors of the running sum are summed
  separately and added back (Ogita, Rump & Oishi, "Accurate sum and dot product", SIAM J. Sci. Comput. 26(6), 2005).
- The squared differences are accumulated in ``LANES`` separate sums, which NumPy then adds pairwise.

Compared with exact integer arithmetic, the relative error of the Allan variance is 1e-15 for stationary noise and 1e-12
for random walk. For a linear drift over 20 000 times the noise, the relative error is 1e-10.

Clusters with missing samples are treated as described in ``missing_samples``.

The compiled code releases the GIL, so ``overlapping_avar(values, factors, map_axes=pool.map)`` computes the axes in
parallel. The samples are processed in blocks that fit the processor cache. Each block is read once for all τ, because
separate passes over the recording would be limited by the memory bandwidth.
"""

from collections.abc import Callable, Iterable
from typing import Final, Literal

import numpy as np

from drivers.data_types import Floats, Ints
from drivers.errors import ConfigError
from monitor.common.compiled import as_read_only, compiled
from monitor.estimation.allan.missing_samples import (
    MIN_PRESENT_SHARE,
    AllanVariances,
    min_present,
    subtract_excess,
    variance_within_clusters,
)

TauGrid = Literal["octave", "decade10"] | tuple[float, ...]
"""Averaging times: the name of a predefined grid, or a tuple of times in seconds."""

EachAxis = Callable[[Callable[[Floats], AllanVariances], Iterable[Floats]], Iterable[AllanVariances]]
"""Type of the built-in function ``map`` and of the method ``map`` of a thread pool."""

NO_PAUSES: Final = np.empty(0, np.int64)
BLOCK: Final = 16_384
"""Number of phase points in a block. Three blocks, 0.4 MB in total, fit into a second-level cache."""
LANES: Final = 512
"""Number of partial sums of squares per τ. The partial sums fit into the first-level cache."""


def overlapping_avar(values: Floats, factors: Ints, map_axes: EachAxis = map) -> tuple[Floats, Ints]:
    """Return the overlapping Allan variance of rates, and the number of averaged second differences.

    According to NIST SP 1065 eq. 11, σ²(m) = Σ (x_{k+2m} - 2x_{k+m} + x_k)² / (2 m² C). Here x is phase, and C is the
    number of second differences. The unit of time is the sample interval. For clusters with missing samples, see
    ``overlapping_allan_variances``.

    Parameters
    ----------
    values : ndarray of float, shape (n, k)
        Rates of k axes; non-finite values mean missing samples.
    factors : ndarray of int64, shape (m,)
        Cluster sizes in samples, at least 1.
    map_axes : EachAxis
        Function that applies a computation to each axis, for example the method ``map`` of a thread pool.

    Returns
    -------
    avar : ndarray of float64, shape (m, k)
        Allan variance in squared units of the axis; NaN if too many samples are missing.
    terms : ndarray of int64, shape (m, k)
        Number of averaged second differences.

    >>> overlapping_avar(np.tile([1.0, 2.0], 50)[:, None], np.array([1, 2]))[0].ravel().tolist()
    [0.5, 0.0]
    """
    avar, terms, _ = overlapping_allan_variances(values, factors, map_axes)
    return np.maximum(avar, 0.0), terms


def overlapping_avar_axis(rate: Floats, factors: Ints) -> tuple[Floats, Ints]:
    """Return the results of ``overlapping_avar`` for the rates [n] of one axis."""
    avar, terms, _ = _allan_variances_of_axis(rate, factors)
    return np.maximum(avar, 0.0), terms


def overlapping_allan_variances(
    values: Floats, factors: Ints, map_axes: EachAxis = map, pauses: Ints = NO_PAUSES
) -> AllanVariances:
    """Return the overlapping Allan variances of rates, corrected for missing samples.

    The method is described in ``missing_samples``. The corrected Allan variance is unbiased. It may be negative if
    missing samples contribute most of the mean square.

    Parameters
    ----------
    values, factors, map_axes
        See ``overlapping_avar``.
    pauses : ndarray of int64
        Rows of missing samples that represent a pause of any length. No cluster that contains such a row counts.
    """
    columns = list(map_axes(lambda column: _allan_variances_of_axis(column, factors, pauses), values.T))
    return AllanVariances(*(np.stack(parts, axis=1) for parts in zip(*columns, strict=True)))


def _allan_variances_of_axis(rate: Floats, factors: Ints, pauses: Ints = NO_PAUSES) -> AllanVariances:
    phase = np.empty(len(rate) + 1)
    phase[0] = 0.0
    phase[1:] = rate  # copied to float64, because sums in float32 would be too inaccurate
    absent = ~np.isfinite(phase)
    m = np.ascontiguousarray(factors, np.int64)
    if not absent.any():
        lanes, terms = np.zeros((m.size, LANES)), np.zeros(m.size, np.int64)
        _integrate(phase)
        _add_complete(phase, m, lanes, terms)
        with np.errstate(invalid="ignore"):  # 0/0 if no second difference exists
            return AllanVariances(lanes.sum(axis=1) / (2.0 * m * m * terms), terms, np.zeros(m.size))
    missing = absent.astype(np.int64)
    missing[pauses + 1] = len(rate)
    np.cumsum(missing, out=missing)
    within = variance_within_clusters(m, np.full(m.size, len(rate)))
    all_m = within.factors
    lanes, extra, terms = *np.zeros((2, all_m.size, LANES)), np.zeros(all_m.size, np.int64)
    _integrate(phase)
    _add_with_missing(phase, missing, all_m, lanes, extra, terms)
    with np.errstate(invalid="ignore"):  # 0/0 if no second difference counts
        avar, share = lanes.sum(axis=1) / (2.0 * all_m * all_m * terms), extra.sum(axis=1) / (2.0 * all_m * terms)
    excess = np.empty(all_m.size)
    subtract_excess(all_m, within.order, within.first, within.weights, share[:, None], avar[:, None], excess[:, None])
    return AllanVariances(avar[: m.size], terms[: m.size], excess[: m.size])


def rate_slope_from_thirds(values: Floats) -> Floats:
    """Return the slope of the rates of a recording, computed from the means of its first and last third.

    The difference between the two means is divided by two thirds of the duration T. For white noise, the variance of
    this slope is 13.5 N²/T³. A slope from linear regression would have a variance of 12 N²/T³. The rates have the shape
    (n, k), and the slope has the shape (k,) in units per sample. The slope is NaN if more than 30 % of the samples are
    missing.

    >>> rate_slope_from_thirds(0.5 * np.arange(9.0)[:, None]).tolist()
    [0.5]
    """
    third = len(values) // 3
    if third == 0:
        return np.full(values.shape[1], np.nan)
    newest = as_read_only(np.ascontiguousarray(values[len(values) - 3 * third :], np.float64))
    parts = [_mean(newest[part * third : (part + 1) * third]) for part in range(3)]
    counts = np.stack([count for count, _ in parts])
    whole = (counts.sum(axis=0) >= MIN_PRESENT_SHARE * 3 * third) & (counts[::2] >= MIN_PRESENT_SHARE * third).all(
        axis=0
    )
    return np.where(whole, (parts[2][1] - parts[0][1]) / (2.0 * third), np.nan)


def rate_slope_per_tau(rates: Floats, factors: Ints) -> Floats:
    """Return the slope of the rates at each averaging time, computed from the mean second difference of phase.

    The slope is the mean second difference of phase, divided by m². A linear drift with this slope contributes slope²
    τ²/2 to the Allan variance. If samples are missing, the slope is the mean difference between the newest and the
    oldest m clusters, divided by their distance. A pair counts if 60 % of the samples of each cluster are present.

    Parameters
    ----------
    rates : ndarray of float, shape (n, k)
        Rates of k axes; non-finite values mean missing samples.
    factors : ndarray of int64, shape (m,)
        Cluster sizes in samples.

    Returns
    -------
    ndarray of float64, shape (m, k)
        Slope in units per sample; NaN if more than 30 % of the samples are missing.

    >>> rate_slope_per_tau(0.5 * np.arange(90.0)[:, None], np.array([1, 8])).round(12).ravel().tolist()
    [0.5, 0.5]
    """
    m = np.asarray(factors, np.int64)
    rates = as_read_only(np.ascontiguousarray(rates, np.float64))
    terms = len(rates) + 1 - 2 * m
    ends = np.stack([np.zeros_like(m), m, 2 * m, terms, terms + m, terms + 2 * m])
    places, at = np.unique(ends, return_inverse=True)
    count, mean = _mean(rates)
    first, second, third, fourth, fifth, sixth = _sums_of_phase(rates, mean, places)[at.reshape(6, -1)]
    blocks = (sixth - 2.0 * fifth + fourth) - (third - 2.0 * second + first)
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = np.where((terms > 0)[:, None], blocks / (terms * m.astype(np.float64) ** 2)[:, None], np.nan)
    for axis in np.flatnonzero(count < len(rates)):
        enough = count[axis] >= MIN_PRESENT_SHARE * len(rates)
        slopes[:, axis] = _slopes_with_missing(rates[:, axis] - mean[axis], m) if enough else np.nan
    return slopes


def _slopes_with_missing(rate: Floats, factors: Ints) -> Floats:
    present = np.isfinite(rate)
    n, count = len(rate), np.concatenate([[0], np.cumsum(present)])
    phase = np.concatenate([[0.0], np.cumsum(np.where(present, rate, 0.0))])
    slopes = np.full(factors.size, np.nan)
    for i, m in enumerate(factors.tolist()):
        if 2 * m > n:
            continue
        old, new = m - 1 - np.arange(m), n - m - np.arange(m)  # begins of the clusters
        held, kept = count[old + m] - count[old], count[new + m] - count[new]
        some = 5 * np.minimum(held, kept) >= 3 * m
        if some.any():
            old, new, held, kept = old[some], new[some], held[some], kept[some]
            rise = (phase[new + m] - phase[new]) / kept - (phase[old + m] - phase[old]) / held
            slopes[i] = rise.mean() / (n + 1.0 - 2 * m)
    return slopes


@compiled
def _mean(values: Floats) -> tuple[Ints, Floats]:
    """Return the number [k] and the mean [k] of the finite values in each column.

    To keep precision, the differences from the first finite value are summed instead of the values.
    """
    n, k = values.shape
    first, total, count = np.zeros(k), np.zeros(k), np.zeros(k, np.int64)
    for i in range(n):
        for a in range(k):
            if np.isfinite(values[i, a]):
                if count[a] == 0:
                    first[a] = values[i, a]
                total[a] += values[i, a] - first[a]
                count[a] += 1
    return count, first + total / np.maximum(count, 1)


@compiled
def _sums_of_phase(values: Floats, mean: Floats, places: Ints) -> Floats:
    """Return the running sum of phase before each index in ``places``, which must be in ascending order."""
    n, k = values.shape
    phase, total, result = np.zeros(k), np.zeros(k), np.zeros((places.size, k))
    at = 0
    while at < places.size and places[at] < 2:
        at += 1
    for i in range(n):
        for a in range(k):
            if np.isfinite(values[i, a]):
                phase[a] += values[i, a] - mean[a]
            total[a] += phase[a]
        if at < places.size and places[at] == i + 2:
            result[at] = total
            at += 1
    return result


def octave_cluster_sizes(largest: int) -> Ints:
    """Return the powers of two 1, 2, 4, … up to ``largest``."""
    return 2 ** np.arange(max(largest, 1).bit_length(), dtype=np.int64)


def cluster_sizes(samples: int, rate_hz: float, tau: TauGrid = "octave") -> Ints:
    """Return the cluster sizes m = τ · rate for a set of averaging times.

    The grid ``octave`` contains powers of two, and the grid ``decade10`` contains ten sizes per decade. The cluster
    sizes of a grid are at most a quarter of the window length. Averaging times in seconds may reach half the window
    length.

    Parameters
    ----------
    samples : int
        Length of the window or recording in samples.
    rate_hz : float
        Sample rate in Hz.
    tau : TauGrid
        Name of a grid, or a tuple of averaging times in seconds, which are rounded to whole samples.

    Returns
    -------
    ndarray of int64, shape (m,)
        Cluster sizes in samples, in ascending order.

    Raises
    ------
    ConfigError
        If no averaging time lies between one sample and half the window.
    """
    longest = samples // 4
    if tau == "octave":
        return octave_cluster_sizes(longest)
    if tau == "decade10":
        exponents = np.arange(0, np.log10(max(longest, 1)) + 1e-9, 0.1)
        return np.unique(np.rint(10.0**exponents).astype(np.int64))
    wanted = np.rint(np.array(tau, float) * rate_hz)
    possible = np.unique(wanted[(wanted >= 1) & (2 * wanted <= samples)].astype(np.int64))
    if possible.size == 0:
        raise ConfigError(
            f"tau: none of {list(tau)} s lies between one sample ({1 / rate_hz:g} s) "
            f"and half the window ({samples / 2 / rate_hz:g} s)"
        )
    return possible


@compiled
def _add_complete(phase: Floats, factors: Ints, lanes: Floats, terms: Ints) -> None:
    """Add all squared second differences of phase to ``lanes``."""
    for begin in range(0, phase.size, BLOCK):
        end = min(begin + BLOCK, phase.size)
        for i in range(factors.size):
            first = max(begin, 2 * factors[i])
            if first < end:
                terms[i] += end - first
                _add_squares(phase, first, end, factors[i], lanes[i])


@compiled
def _add_with_missing(phase: Floats, missing: Ints, factors: Ints, lanes: Floats, extra: Floats, terms: Ints) -> None:
    """Add the squared differences that count to ``lanes``, and their values m/n_A + m/n_B − 2 to ``extra``."""
    for begin in range(0, phase.size, BLOCK):
        end = min(begin + BLOCK, phase.size)
        for i in range(factors.size):
            first = max(begin, 2 * factors[i])
            if first >= end:
                continue
            if missing[first - 2 * factors[i]] == missing[end - 1]:
                terms[i] += end - first
                _add_squares(phase, first, end, factors[i], lanes[i])
            else:
                terms[i] += _add_incomplete(phase, missing, first, end, factors[i], lanes[i], extra[i])


@compiled
def _integrate(phase: Floats) -> None:
    """Convert the rates that follow ``phase[0]`` to phase. A missing sample does not change the phase."""
    total, count = 0.0, 0
    for i in range(1, phase.size):
        if np.isfinite(phase[i]):
            total += phase[i]
            count += 1
    mean = total / max(count, 1)
    total, rest = 0.0, 0.0
    for i in range(1, phase.size):
        step = phase[i] - mean if np.isfinite(phase[i]) else 0.0
        longer = total + step
        back = longer - total
        rest += (total - (longer - back)) + (step - back)
        total = longer
        phase[i] = total + rest


@compiled
def _add_squares(phase: Floats, first: int, end: int, m: int, lanes: Floats) -> None:
    """Add the squared second differences whose last phase point has an index first ≤ i < end.

    The indices are unsigned because a signed index would prevent vectorization of the inner loop.
    """
    for row in range(first, end, LANES):
        at0, at1, at2 = np.uintp(row), np.uintp(row - m), np.uintp(row - 2 * m)
        for lane in range(np.uintp(min(LANES, end - row))):
            d = (phase[at0 + lane] - phase[at1 + lane]) - (phase[at1 + lane] - phase[at2 + lane])
            lanes[lane] += d * d


@compiled
def _add_incomplete(phase: Floats, missing: Ints, first: int, end: int, m: int, lanes: Floats, extra: Floats) -> int:
    """Add the squares of the differences first ≤ i < end that count, and return their number."""
    most, count = m - min_present(m), 0
    for row in range(first, end, LANES):
        at0, at1, at2 = np.uintp(row), np.uintp(row - m), np.uintp(row - 2 * m)
        for lane in range(np.uintp(min(LANES, end - row))):
            older = missing[at1 + lane] - missing[at2 + lane]
            newer = missing[at0 + lane] - missing[at1 + lane]
            if older <= most and newer <= most:
                # the difference of the sums, and what the missing samples would add to both sums
                a, b = older / (m - older), newer / (m - newer)
                sum_a, sum_b = phase[at1 + lane] - phase[at2 + lane], phase[at0 + lane] - phase[at1 + lane]
                d = (sum_b - sum_a) + (sum_b * b - sum_a * a)
                lanes[lane] += d * d
                extra[lane] += a + b
                count += 1
    return count
