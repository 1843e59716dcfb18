"""Compiled kernels of ``AllanWindow``, which store phase in a ring buffer and update the sums of squared differences.

The arithmetic is described in the module ``window``. All data of a window is stored in one array, because each array
that Python passes to compiled code costs 50 ns.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled, inlined, without_reference_count
from monitor.common.compiled_vectors import (
    LANES,
    broadcast,
    load_column,
    load_vector,
    prefetch,
    store_vector,
    sum_vector,
    to_floats,
    to_integers,
)
from monitor.estimation.allan.missing_samples import MIN_PRESENT_SHARE, min_present, subtract_excess

AXES: Final = 6
MISSING_ROWS: Final = 6
"""Column of the phase that contains the running count of samples that are missing on at least one axis."""
TOTAL, NEWEST, LAST_MISSING, LAST_PARTIAL = 0, 1, 2, 3
"""Indices of the elements of the state array.

The elements are the number of samples since the last reset, the row of the newest phase point, the number of the newest
missing sample, and the number of the newest sample that is missing on some axes only.
"""
RUN_SAMPLES: Final = 64
"""Maximum number of samples whose phase is stored before the sums of squared differences are updated."""
STAGE_SAMPLES: Final = 512
"""Maximum number of samples that are passed to the compiled code at a time."""
LINE: Final = 8
"""Number of 8-byte numbers in a cache line."""
ROUNDING: Final = 1.5 * 2.0**52
"""Number that rounds to a whole number when it is added and subtracted."""
EXCESS_UNIT: Final = 2.0**-38
"""Unit of ``WindowArrays.excess``. The sum of 10⁷ terms stays below 2⁶³."""
MAX_ROUNDING_SQUARE: Final = 2.0**14
"""Largest mean square, in squared units of phase, that rounding causes if samples are missing.

For constant full-scale input and a burst of missing samples that is as long as a cluster permits, it is 11 000.
"""
DISCARDED: Final = 1 << 24
"""Step of the count of missing samples before the oldest sample that an axis keeps.

The step is larger than any window, and the sum of several steps stays below 2³¹.
"""
LEVEL: Final = 64
"""Number of newest samples whose mean is the reference level of an axis."""
NEVER: Final = 1 << 62
"""Value that marks a missing reference level."""
MAX_PHASE_STEP: Final = 4.0e18
"""Largest change of the integer phase by one sample. The phase is a 64-bit integer, so larger values are ambiguous."""
BEND_POINTS: Final = 64
"""Number of phase points that represent a block in a sum.

The resulting error is 1 % of the standard deviation of the sum.
"""


CACHED_ROWS: Final = 8192
"""Number of rows of phase that fit into the cache of a processor core."""
Offsets = tuple[np.uintp, np.uintp, np.uintp]
"""Offsets of the newest, the middle and the oldest phase point of a second difference in the ring buffer."""


class WindowBuffers(NamedTuple):
    """Memory of a sliding window, which is passed to compiled code."""

    memory: Ints  # all fields of ``WindowArrays``
    taus: int  # number of cluster sizes
    length: int  # number of samples in a full window


class WindowArrays(NamedTuple):
    """Views of the data of a sliding window with m cluster sizes."""

    state: Ints  # [LANES] elements at the indices ``TOTAL`` to ``LAST_PARTIAL``
    factors: Ints  # [m] cluster sizes in samples
    spans: Ints  # [m] number of newest samples that are used at each cluster size
    terms: Ints  # [m · LANES] number of second differences in each sum
    excess: Ints  # [m · LANES] sums of m/n_A + m/n_B − 2 in ``EXCESS_UNIT``, where n samples of a cluster are present
    order: Ints  # [m] field of ``VarianceWithinClusters``
    first: Ints  # [m] field of ``VarianceWithinClusters``
    phase: Ints  # [places · LANES] ring buffer of integer phase
    scaling: Floats  # [2 · LANES] scale factors to integer phase, and rounding errors to add to the next sample
    scratch: Floats  # [4 · LANES] weights of eight differences
    sums: Floats  # [m · LANES] sums of squared second differences
    rest: Floats  # [m · LANES] rounding errors of the sums
    stage: Floats  # [at least STAGE_SAMPLES · AXES] input buffer
    weights: Floats  # [m · m] field of ``VarianceWithinClusters``
    missing: NDArray[np.int32]  # [places · LANES] running count of missing samples


def window_memory_size(length: int, taus: int) -> int:
    """Return the number of 8-byte numbers that a window of ``length`` samples with ``taus`` cluster sizes needs."""
    header = LANES + (4 * taus + LINE - 1) // LINE * LINE + (taus * taus + LINE - 1) // LINE * LINE
    samples = 6 + 4 * taus + STAGE_SAMPLES
    return header + samples * LANES + (length + 1 + RUN_SAMPLES) * (LANES + LANES // 2)


def view_window_arrays(memory: Ints, taus: int) -> WindowArrays:
    """Return a view of each field in the memory of a sliding window.

    Parameters
    ----------
    memory, taus
        Fields of ``WindowBuffers``.
    """
    weights = LANES + (4 * taus + LINE - 1) // LINE * LINE
    terms = weights + (taus * taus + LINE - 1) // LINE * LINE
    excess = terms + taus * LANES
    scaling = excess + taus * LANES
    scratch = scaling + 2 * LANES
    sums = scratch + 4 * LANES
    rest, stage = sums + taus * LANES, sums + 2 * taus * LANES
    phase = stage + STAGE_SAMPLES * LANES
    missing = phase + (memory.size - phase) // 3 * 2  # a count of missing samples takes half the memory of a phase
    floats = memory.view(np.float64)
    return WindowArrays(
        memory[:LANES], memory[LANES : LANES + taus], memory[LANES + taus : LANES + 2 * taus], memory[terms:excess],
        memory[excess:scaling], memory[LANES + 2 * taus : LANES + 3 * taus],
        memory[LANES + 3 * taus : LANES + 4 * taus], memory[phase:missing], floats[scaling:scratch],
        floats[scratch:sums], floats[sums:rest], floats[rest:stage], floats[stage:phase],
        floats[weights : weights + taus * taus], memory[missing:].view(np.int32),
    )  # fmt: skip


compiled_view_window_arrays = inlined(view_window_arrays)
"""Version of ``view_window_arrays`` that compiled code can call."""


@compiled
def append_staged_samples(memory: Ints, taus: int, start: int, n: int) -> None:
    """Append n samples from the input buffer to the window, and update the sums of all cluster sizes.

    The phase of up to ``RUN_SAMPLES`` samples is stored before the sums of each τ are updated. In this order, the
    processor can prefetch the few memory ranges that belong to one τ.

    Parameters
    ----------
    memory, taus
        Fields of ``WindowBuffers``.
    start : int
        Index of the first sample in the input buffer.
    n : int
        Number of samples.
    """
    # All fields are unpacked at once, because each field access on a named tuple takes time.
    state, factors, spans, terms, excess, _, _, phase, scaling, scratch, sums, rest, stage, _, missing = (
        compiled_view_window_arrays(without_reference_count(memory), taus)
    )
    places = phase.size // LANES
    length = places - 1 - RUN_SAMPLES
    done, end = start, start + n
    while done < end:
        run = min(RUN_SAMPLES, end - done)
        first = state[NEWEST] + 1 if state[NEWEST] + 1 < places else 0
        for row in range(done, done + run):
            _append(stage[row * AXES : (row + 1) * AXES], scaling, phase, missing, state)
        done += run
        count = state[TOTAL] - run  # number of samples before this run of samples
        whole = count - state[LAST_MISSING] > length
        shared = count - state[LAST_PARTIAL] > length
        _add_run(
            first, run, count, whole, shared, factors, spans, phase, missing, scratch, terms, excess, sums, rest
        )  # fmt: skip


@inlined
def wrap_count(count: int | np.int64) -> int:
    """Return a count of missing samples, or a difference of two counts, modulo 2³² in the range of int32.

    Differences of counts within a window are below 2³¹, so they are exact although the counts wrap around.
    """
    return int(((count + (1 << 31)) & ((1 << 32) - 1)) - (1 << 31))


@compiled
def _append(sample: Floats, scaling: Floats, phase: Ints, missing: NDArray[np.int32], state: Ints) -> None:
    before = LANES * state[NEWEST]
    now = before + LANES if before + LANES < phase.size else 0
    state[TOTAL] += 1
    state[NEWEST] = now // LANES
    lost = 0
    for lane in range(sample.size):
        y = sample[lane] * scaling[lane] + scaling[LANES + lane]
        if abs(y) < MAX_PHASE_STEP:  # also false for NaN
            step = np.rint(y)
            scaling[LANES + lane] = y - step
            phase[now + lane] = phase[before + lane] + np.int64(step)
            count = int(missing[before + lane])
        else:
            phase[now + lane] = phase[before + lane]
            count = wrap_count(np.int64(missing[before + lane]) + 1)
            lost += 1
        if missing[now + lane] != count:  # Skipping writes of zeros saves memory.
            missing[now + lane] = count
    phase[now + MISSING_ROWS] = phase[before + MISSING_ROWS] + (lost > 0)
    if lost > 0:
        state[LAST_MISSING] = state[TOTAL]
        if lost < sample.size:
            state[LAST_PARTIAL] = state[TOTAL]


@compiled
def _add_run(
    first: int,
    run: int,
    count: int,
    whole: bool,
    shared: bool,
    factors: Ints,
    spans: Ints,
    phase: Ints,
    missing: NDArray[np.int32],
    scratch: Floats,
    terms: Ints,
    excess: Ints,
    sums: Floats,
    rest: Floats,
) -> None:
    """Update the sums of each τ with ``run`` new samples, whose phase begins at row ``first`` of the ring buffer."""
    places = phase.size // LANES
    for i in range(factors.size):
        m, span, own = factors[i], spans[i], i * LANES
        row = max(0, 2 * m - 1 - count)  # first new sample that completes a second difference
        while row < run:
            # stop at the sample at which second differences begin to leave the window
            leaving = count + row >= span
            rows = (run if leaving else min(run, span - count)) - row
            now = first + row if first + row < places else first + row - places
            new1, new2 = ring_row(now - m, places), ring_row(now - 2 * m, places)
            old = now - span - 1
            old0, old1, old2 = ring_row(old + 2 * m, places), ring_row(old + m, places), ring_row(old, places)
            if not leaving:
                old0 = old1 = old2 = now  # the difference of equal phase points is zero
            if rows > 1:  # up to the end of the ring buffer
                rows = min(rows, places - max(now, new1, new2, old0, old1, old2))
            elif places > CACHED_ROWS:
                for at in (new1, new2, old0, old1, old2):
                    prefetch(phase, (at + 1) * LANES)
            row += rows
            if not leaving:
                for lane in range(AXES):  # the functions below subtract one difference for each row
                    terms[own + lane] += rows
            new = (np.uintp(now * LANES), np.uintp(new1 * LANES), np.uintp(new2 * LANES))
            gone = (np.uintp(old0 * LANES), np.uintp(old1 * LANES), np.uintp(old2 * LANES))
            if whole or (shared and not _has_missing(phase, new, rows) and not _has_missing(phase, gone, rows)):
                _exchange_complete(phase, new, gone, rows, sums, rest, own)
            elif shared:
                _exchange_shared(phase, new, gone, rows, m, scratch, sums, rest, terms, excess, own)
            else:
                _exchange_partial(phase, missing, new, gone, rows, m, sums, rest, terms, excess, own)


@compiled
def ring_row(index: int, rows: int) -> int:
    """Return the row of a phase point in the ring buffer for an index that may be negative.

    Parameters
    ----------
    index : int
        Index of the phase point. A negative index counts from the end of the ring buffer.
    rows : int
        Number of rows in the ring buffer.
    """
    return index if index >= 0 else index + rows


def weights_of_differences(older: Any, newer: Any, m: float, most: float) -> tuple[Any, Any, Any, Any]:
    """Return the weights of second differences with missing samples.

    Let n_A and n_B samples of the older and the newer cluster be present. From the second difference D = x₀ − 2x₁ + x₂
    and the sum T = x₀ − x₂ of all present samples, m times the difference of the means of the present samples is

        ½ (m/n_A + m/n_B) D + ½ (m/n_B − m/n_A) T.

    The weight of D is exactly 1 if no sample is missing. Without missing samples, the difference is therefore D.

    Parameters
    ----------
    older, newer : float, or vector of floats
        Numbers of missing samples in the older and the newer cluster.
    m : float
        Cluster size in samples.
    most : float
        Largest number of missing samples in a cluster of a difference that counts.

    Returns
    -------
    d_weight, t_weight : float, or vector of floats
        Weights of D and T; zero if the difference does not count.
    counted : float, or vector of floats
        1.0 if the difference counts, otherwise 0.0.
    excess : float, or vector of floats
        m/n_A + m/n_B − 2 in ``EXCESS_UNIT``, rounded to whole numbers; zero if the difference does not count.
    """
    counted = (1.0 * (older <= most)) * (1.0 * (newer <= most))
    share = counted / ((m - older) * (m - newer) + (1.0 - counted))  # 1/(n_A n_B)
    excess = (m * (older + newer) - 2.0 * older * newer) * share
    v = (newer - older) * (0.5 * m) * share
    return counted + 0.5 * excess, v, counted, (excess / EXCESS_UNIT + ROUNDING) - ROUNDING


_weights = inlined(weights_of_differences)
_vector_weights = inlined(weights_of_differences)


@inlined
def _has_missing(phase: Ints, at: Offsets, rows: int) -> bool:
    """Return True if samples are missing between the phase points of ``rows`` second differences."""
    newest, oldest = at[0] + np.uintp((rows - 1) * LANES + MISSING_ROWS), at[2] + np.uintp(MISSING_ROWS)
    return bool(phase[newest] != phase[oldest])


@inlined
def _exchange_complete(
    phase: Ints, new: Offsets, gone: Offsets, rows: int, sums: Floats, rest: Floats, own: int
) -> None:
    """Add and subtract the squares of differences without missing samples."""
    total, error = load_vector(sums, own), load_vector(rest, own)
    for row in range(np.uintp(rows)):
        k = row * np.uintp(LANES)
        d, e = _second_difference(phase, new, k), _second_difference(phase, gone, k)
        total, error = _exchange_squares(total, error, d * d, e * e)
    store_vector(sums, own, total)
    store_vector(rest, own, error)


@inlined
def _exchange_shared(
    phase: Ints, new: Offsets, gone: Offsets, rows: int, m: int, scratch: Floats,
    sums: Floats, rest: Floats, terms: Ints, excess: Ints, own: int,
) -> None:  # fmt: skip
    """Add and subtract the squares of differences whose missing samples are missing on all axes.

    The weights of eight differences are computed at a time, and those of the remaining differences one by one.
    """
    total, error = load_vector(sums, own), load_vector(rest, own)
    counts, extras, count, extra = 0.0 * total, 0.0 * total, 0.0, 0.0
    size, most, step, end = float(m), float(m - min_present(m)), np.uintp(LANES), np.uintp(rows)
    v0, u1, v1 = step, step + step, step + step + step  # places of the weights in ``scratch``
    for begin in range(np.uintp(0), end, step):
        n, k = min(step, end - begin), begin * step
        if n == step:
            u, v, counted, more = _vector_weights(*_missing_in_rows(phase, new, k), size, most)
            store_vector(scratch, 0, u)
            store_vector(scratch, v0, v)
            counts, extras = counts + counted, extras + more
            u, v, counted, more = _vector_weights(*_missing_in_rows(phase, gone, k), size, most)
            store_vector(scratch, u1, u)
            store_vector(scratch, v1, v)
            counts, extras = counts - counted, extras - more
        else:
            for j in range(n):
                own_k = k + j * step
                scratch[j], scratch[v0 + j], added, more = _weights(*_missing_in_row(phase, new, own_k), size, most)
                scratch[u1 + j], scratch[v1 + j], evicted, less = _weights(
                    *_missing_in_row(phase, gone, own_k), size, most
                )
                count += added - evicted
                extra += more - less
        for j in range(n):
            own_k = k + j * step
            d = _weighted_difference(phase, new, own_k, broadcast(scratch[j]), broadcast(scratch[v0 + j]))
            e = _weighted_difference(phase, gone, own_k, broadcast(scratch[u1 + j]), broadcast(scratch[v1 + j]))
            total, error = _exchange_squares(total, error, d * d, e * e)
    store_vector(sums, own, total)
    store_vector(rest, own, error)
    change, change_of_excess = np.int64(sum_vector(counts) + count), np.int64(sum_vector(extras) + extra)
    for lane in range(own, own + AXES):
        terms[lane] += change
        excess[lane] += change_of_excess


@inlined
def _exchange_partial(
    phase: Ints, missing: NDArray[np.int32], new: Offsets, gone: Offsets, rows: int, m: int,
    sums: Floats, rest: Floats, terms: Ints, excess: Ints, own: int,
) -> None:  # fmt: skip
    """Add and subtract the squares of differences if each axis has missing samples of its own."""
    total, error = load_vector(sums, own), load_vector(rest, own)
    counts, extras = 0.0 * total, 0.0 * total
    size, most = float(m), float(m - min_present(m))
    for row in range(np.uintp(rows)):
        k = row * np.uintp(LANES)
        u, v, added, more = _vector_weights(*_missing_on_axes(missing, new, k), size, most)
        d = _weighted_difference(phase, new, k, u, v)
        u, v, evicted, less = _vector_weights(*_missing_on_axes(missing, gone, k), size, most)
        e = _weighted_difference(phase, gone, k, u, v)
        total, error = _exchange_squares(total, error, d * d, e * e)
        counts, extras = counts + (added - evicted), extras + (more - less)
    store_vector(sums, own, total)
    store_vector(rest, own, error)
    store_vector(terms, own, load_vector(terms, own) + to_integers(counts))
    store_vector(excess, own, load_vector(excess, own) + to_integers(extras))


@inlined
def _missing_in_rows(phase: Ints, at: Offsets, k: np.uintp) -> tuple[Floats, Floats]:
    """Return the numbers of missing samples in the older and the newer clusters of eight differences."""
    i = k + np.uintp(MISSING_ROWS)
    x0, x1, x2 = load_column(phase, at[0] + i), load_column(phase, at[1] + i), load_column(phase, at[2] + i)
    return to_floats(x1 - x2), to_floats(x0 - x1)


@inlined
def _missing_in_row(phase: Ints, at: Offsets, k: np.uintp) -> tuple[float, float]:
    """Return the numbers of missing samples in the older and the newer cluster of a difference."""
    i = k + np.uintp(MISSING_ROWS)
    return float(phase[at[1] + i] - phase[at[2] + i]), float(phase[at[0] + i] - phase[at[1] + i])


@inlined
def _missing_on_axes(missing: NDArray[np.int32], at: Offsets, k: np.uintp) -> tuple[Floats, Floats]:
    """Return the numbers of missing samples of each axis in the older and the newer clusters of a difference."""
    c0, c1, c2 = load_vector(missing, at[0] + k), load_vector(missing, at[1] + k), load_vector(missing, at[2] + k)
    return to_floats(c1 - c2), to_floats(c0 - c1)


@inlined
def _second_difference(phase: Ints, at: Offsets, k: np.uintp) -> Floats:
    x1 = load_vector(phase, at[1] + k)
    return to_floats(load_vector(phase, at[0] + k) - x1 - x1 + load_vector(phase, at[2] + k))


@inlined
def _weighted_difference(phase: Ints, at: Offsets, k: np.uintp, u: Floats, v: Floats) -> Floats:
    """Return m times the differences of the means of the present samples, see ``weights_of_differences``."""
    both = to_floats(load_vector(phase, at[0] + k) - load_vector(phase, at[2] + k))
    return u * _second_difference(phase, at, k) + v * both


@inlined
def _exchange_squares(total: Floats, error: Floats, added: Floats, evicted: Floats) -> tuple[Floats, Floats]:
    """Add squares to sums and subtract other squares, and add the rounding errors to ``error``.

    TwoSum: Knuth, TAOCP vol. 2, 4.2.2, theorem B.
    """
    t = total + added
    z = t - total
    first = (total - (t - z)) + (added - z)
    u = t - evicted
    z = u - t
    return u, error + (first + ((t - (u - z)) - (evicted + z)))


@inlined
def missing_between(newer: np.int32, older: np.int32) -> int:
    """Return the difference of two elements of the running count of missing samples, which wraps around."""
    return int(np.int32(newer - older))


@inlined
def difference_of_means(
    older_sum: int, newer_sum: int, older: int, newer: int, older_share: float, newer_share: float
) -> float:
    """Return the difference between the means of the present samples in two clusters, in integer units.

    The integer closest to the mean of the older cluster is subtracted from all samples, so no precision is lost.

    Parameters
    ----------
    older_sum, newer_sum : int
        Sums of the present samples.
    older, newer : int
        Numbers of present samples.
    older_share, newer_share : float
        Reciprocals of these numbers.
    """
    level = np.int64(np.rint(older_sum * older_share))
    return float(newer_sum - level * newer) * newer_share - float(older_sum - level * older) * older_share


@compiled
def keep_newest(memory: Ints, taus: int, axis: int, n: int) -> None:
    """Mark all but the newest n samples of one axis as missing, and recompute the sums from the newest n samples.

    Parameters
    ----------
    memory, taus
        Fields of ``WindowBuffers``.
    axis : int
        Index of the axis.
    n : int
        Number of newest samples to keep.
    """
    w = compiled_view_window_arrays(memory, taus)
    state, missing, places = w.state, w.missing, w.phase.size // LANES
    # No cluster that contains a discarded sample counts, whatever its length.
    oldest = ring_row(state[NEWEST] - n, places) * LANES + axis
    for back in range(1, min(state[TOTAL], places - 1 - RUN_SAMPLES) - n + 1):
        missing[ring_row(state[NEWEST] - n - back, places) * LANES + axis] = missing[oldest] - DISCARDED - back
    state[LAST_MISSING] = state[LAST_PARTIAL] = max(state[LAST_MISSING], state[TOTAL] - n)
    for i in range(taus):
        _recompute_sum(w, i, axis, n)


@compiled
def _recompute_sum(w: WindowArrays, i: int, axis: int, n: int) -> None:
    phase, missing, m, own, places = w.phase, w.missing, w.factors[i], i * LANES + axis, w.phase.size // LANES
    most, total, left, count, excess = m - min_present(m), 0.0, 0.0, 0, 0
    for back in range(min(n, w.spans[i]) - 2 * m, -1, -1):
        at = w.state[NEWEST] - back
        i0, i1 = ring_row(at, places) * LANES + axis, ring_row(at - m, places) * LANES + axis
        i2 = ring_row(at - 2 * m, places) * LANES + axis
        a, b = missing_between(missing[i1], missing[i2]), missing_between(missing[i0], missing[i1])
        u, v, counted, extra = _weights(float(a), float(b), float(m), float(most))
        d = u * float(phase[i0] - 2 * phase[i1] + phase[i2]) + v * float(phase[i0] - phase[i2])
        s = total + d * d
        z = s - total
        left += (total - (s - z)) + (d * d - z)
        total = s
        count += int(counted)
        excess += int(extra)
    w.sums[own], w.rest[own], w.terms[own], w.excess[own] = total, left, count, excess


@inlined
def _reference_level(phase: Ints, missing: NDArray[np.int32], newest: int, n: int, axis: int) -> int:
    """Return the mean of the newest samples of an axis in integer units, or ``NEVER`` if all of them are missing."""
    places = phase.size // LANES
    last, first = newest * LANES + axis, ring_row(newest - min(n, LEVEL), places) * LANES + axis
    present = min(n, LEVEL) - missing_between(missing[last], missing[first])
    return (phase[last] - phase[first]) // present if present > 0 else NEVER


@inlined
def integer_slope_from_thirds(phase: Ints, missing: NDArray[np.int32], newest: int, n: int, axis: int) -> float:
    """Return the slope of the rate of one axis, from the means of the first and the last third of n samples.

    Parameters
    ----------
    phase : ndarray of int64, shape (places · LANES,)
        Ring buffer of integer phase.
    missing : ndarray of int32, shape (places · LANES,)
        Running count of missing samples.
    newest : int
        Row of the newest phase point.
    n : int
        Number of newest samples from which the slope is computed.
    axis : int
        Index of the axis.

    Returns
    -------
    float
        Slope in integer units per sample; NaN if too many samples are missing.
    """
    third, places = n // 3, phase.size // LANES
    middle = _reference_level(phase, missing, newest, n, axis)
    if third == 0 or middle == NEVER:
        return np.nan
    at0, at1 = newest * LANES + axis, ring_row(newest - third, places) * LANES + axis
    at2, at3 = ring_row(newest - 2 * third, places) * LANES + axis, ring_row(newest - 3 * third, places) * LANES + axis
    late, early = (
        third - missing_between(missing[at0], missing[at1]),
        third - missing_between(missing[at2], missing[at3]),
    )
    if (
        min(late, early) < MIN_PRESENT_SHARE * third
        or 3 * third - missing_between(missing[at0], missing[at3]) < MIN_PRESENT_SHARE * 3 * third
    ):
        return np.nan
    # Phase wraps modulo 2⁶⁴, so the small difference is computed before the conversion to floating point.
    rise = float(phase[at0] - phase[at1] - middle * late) / late
    rise -= float(phase[at2] - phase[at3] - middle * early) / early
    return float(rise / (2.0 * third))


@inlined
def half_mean_square(total: float, count: int, excess: int, unit: float) -> float:
    """Return half the mean square of the differences between cluster means in squared units of the axis.

    Parameters
    ----------
    total : float
        Sum of the squared second differences of phase.
    count : int
        Number of second differences.
    excess : int
        Element of ``WindowArrays.excess``.
    unit : float
        Value 2 m² in squared integer units.

    Returns
    -------
    float
        Half the mean square; 0 if it may be caused by rounding alone, as on a constant axis; NaN without differences.
    """
    if count == 0:
        return np.nan
    return total / (unit * count) if total > (MAX_ROUNDING_SQUARE if excess != 0 else 1.0) * count else 0.0


@compiled
def copy_variances(memory: Ints, taus: int, avar: Floats, terms: Ints, excess: Floats) -> None:
    """Compute the Allan variance of each axis at each averaging time.

    Parameters
    ----------
    memory, taus
        Fields of ``WindowBuffers``.
    avar : ndarray of float64, shape (m, 6)
        Output array for the Allan variances in squared units of the axis; NaN if too many samples are missing.
    terms : ndarray of int64, shape (m, 6)
        Output array for the number of second differences that each Allan variance averages.
    excess : ndarray of float64, shape (m, 6)
        Output array for the contributions of missing samples, which have been subtracted.
    """
    w = compiled_view_window_arrays(memory, taus)
    compute_variances(w, taus, avar, excess, np.empty((taus, AXES)))
    for i in range(taus):
        for axis in range(AXES):
            terms[i, axis] = w.terms[i * LANES + axis]


@inlined
def compute_variances(w: WindowArrays, rows: int, avar: Floats, excess: Floats, share: Floats) -> None:
    """Compute the Allan variances of all axes for the first ``rows`` elements of ``w.order``.

    Parameters
    ----------
    w : WindowArrays
        Data of the window with m cluster sizes.
    rows : int
        Number of cluster sizes; a multiple of whole grids.
    avar : ndarray of float64, shape (m, 6)
        Output array for the Allan variances in squared units of the axis.
    excess : ndarray of float64, shape (m, 6)
        Output array for the contributions of missing samples, which have been subtracted.
    share : ndarray of float64, shape (m, 6)
        Memory for intermediate results.
    """
    # Fields are copied to local variables, because each access to a field in a loop changes a reference count.
    factors, order, sums, rest, terms, extra = w.factors, w.order, w.sums, w.rest, w.terms, w.excess
    taus, scaling, complete = factors.size, w.scaling, True
    for p in range(rows):
        i = order[p]
        for axis in range(AXES):
            at, unit = i * LANES + axis, factors[i] * scaling[axis]
            avar[i, axis] = half_mean_square(sums[at] + rest[at], terms[at], extra[at], 2.0 * unit * unit)
            excess[i, axis] = share[i, axis] = 0.0
            if extra[at] != 0:
                share[i, axis] = 0.5 * EXCESS_UNIT * extra[at] / (float(factors[i]) * terms[at])
                complete = False
    if not complete:
        subtract_excess(factors, order[:rows], w.first, w.weights.reshape(taus, taus), share, avar, excess)


@compiled
def drift_slopes_by_axis_and_tau(memory: Ints, taus: int, lengths: Ints, slope: Floats, slopes: Floats) -> None:
    """Compute the slope of the rate of each axis, and the slope at each of the first m averaging times.

    Parameters
    ----------
    memory, taus
        Fields of ``WindowBuffers``.
    lengths : ndarray of int64, shape (6,)
        Number of newest samples that are used for each axis.
    slope : ndarray of float64, shape (6,)
        Output array for the result of ``integer_slope_from_thirds`` in units of the axis.
    slopes : ndarray of float64, shape (6, m)
        Output array for the result of ``mean_rate_slope`` in units of the axis.
    """
    w = compiled_view_window_arrays(memory, taus)
    newest = w.state[NEWEST]
    for axis in range(AXES):
        slope[axis] = integer_slope_from_thirds(w.phase, w.missing, newest, lengths[axis], axis) / w.scaling[axis]
    for i in range(slopes.shape[1]):
        for axis in range(AXES):  # all axes read the same cache lines
            bend = mean_rate_slope(w.phase, w.missing, newest, lengths[axis], w.factors[i], axis)
            slopes[axis, i] = bend / w.scaling[axis]


@compiled
def mean_rate_slope(phase: Ints, missing: NDArray[np.int32], newest: int, n: int, m: int, axis: int) -> float:
    """Return the mean second difference of phase over clusters of m samples, divided by m².

    In the sum of all second differences, only four blocks of m phase points near the ends do not cancel. About
    ``BEND_POINTS`` phase points represent each block. If samples are missing, the result is the mean difference between
    the newest and the oldest clusters, divided by their distance. The result is in integer units per sample, or NaN if
    too many samples are missing. The other parameters are those of ``integer_slope_from_thirds``.
    """
    places = phase.size // LANES
    last, first = newest * LANES + axis, ring_row(newest - n, places) * LANES + axis
    if n < 2 * m or n - missing_between(missing[last], missing[first]) < MIN_PRESENT_SHARE * n:
        return np.nan
    stride, has_gaps = max(1, m // BEND_POINTS), missing[last] != missing[first]
    most, total, points = m - min_present(m), 0.0, 0
    for k in range(0, m, stride):
        at0, at1 = ring_row(newest - k, places) * LANES + axis, ring_row(newest - m - k, places) * LANES + axis
        at2 = ring_row(newest - n + 2 * m - 1 - k, places) * LANES + axis
        at3 = ring_row(newest - n + m - 1 - k, places) * LANES + axis
        if has_gaps:
            a, b = missing_between(missing[at2], missing[at3]), missing_between(missing[at0], missing[at1])
            if a > most or b > most:
                continue
            change = m * difference_of_means(
                phase[at2] - phase[at3], phase[at0] - phase[at1], m - a, m - b, 1.0 / (m - a), 1.0 / (m - b)
            )
        else:
            change = float(phase[at0] - phase[at1] - phase[at2] + phase[at3])
        total += change
        points += 1
    if points == 0:
        return np.nan
    # The number of second differences is n + 1 − 2m.
    return total / points * m / (n + 1.0 - 2 * m) / (float(m) * m)
