"""The compiled part of ``window``: phase into the ring, terms in and out of the sums; see there for the arithmetic.

All of a window lies in three arrays (``Parts``), as the interpreter takes 50 ns to hand one to compiled code.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Floats, Ints
from monitor.common.compiled import compiled, inlined

AXES: Final = 6
LANES: Final = 8
"""Columns kept a sample: six axes padded to a vector register."""
TOTAL, NEWEST, STRUCK, WIDTH = 0, 1, 2, 3
"""Of the state: samples since reset, place of the newest phase point, newest sample that was missing on any axis;
and LANES, from where the compiler cannot know it: it would make eight scalar lines of a vector loop."""
RUN: Final = 64
"""Samples whose phase is written before the τ take their terms."""
STAGE: Final = 512
"""Samples handed to the kernel at a time."""
LINE: Final = 8
"""Numbers of eight bytes in a cache line: a row of phase fills one, and must not lie across two."""
PRESENT: Final = 0.98
"""Share of the samples that must be there for a slope: gaps shift the middle of what is left, by less than this."""
LEVEL: Final = 64
"""Samples whose mean is the level: full scale in the finest phase still fits 64 bits."""
NEVER: Final = 1 << 62
BEND_POINTS: Final = 64
"""Of a block of phase, that stand for its sum to a percent of its scatter."""


class Parts(NamedTuple):
    """The window's arrays, for compiled code."""

    ints: Ints  # see view_ints
    floats: Floats  # see view_floats
    missing: NDArray[np.int32]
    taus: int
    length: int


def view_ints(ints: Ints, taus: int) -> tuple[Ints, Ints, Ints, Ints, Ints]:
    """State, factors [m], spans [m], terms [m · LANES], phase [places · LANES]."""
    spans, terms = LANES + taus, LANES + (2 * taus + LINE - 1) // LINE * LINE
    phase = terms + taus * LANES
    return ints[:LANES], ints[LANES:spans], ints[spans : spans + taus], ints[terms:phase], ints[phase:]


def view_floats(floats: Floats, taus: int) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Parts of the workspace.

    Scale and rounding not yet in phase [2 · LANES], two scratches for a run, sums and what their roundings left
    [m · LANES], and the stage [STAGE · AXES and more].
    """
    scratch, sums = 2 * LANES, (2 + 2 * RUN) * LANES
    rest, stage = sums + taus * LANES, sums + 2 * taus * LANES
    return floats[:scratch], floats[scratch:sums], floats[sums:rest], floats[rest:stage], floats[stage:]


cut_ints, cut_floats = compiled(view_ints), compiled(view_floats)
"""The same for kernels."""


@compiled
def advance(ints: Ints, floats: Floats, missing: NDArray[np.int32], taus: int, start: int, n: int) -> None:
    """Advance by n staged samples from row ``start`` of the stage on; see the module's head for the arithmetic.

    Phase is written for a run of up to RUN samples, then each τ takes its terms one by one along that run: few
    streams through memory at a time, which the processor fetches ahead, where a walk over all τ would need a hundred.
    """
    state, factors, spans, terms, phase = cut_ints(ints, taus)
    scaling, scratch, sums, rest, stage = cut_floats(floats, taus)
    places = phase.size // LANES
    length = places - 1 - RUN
    done, end = start, start + n
    while done < end:
        run = min(RUN, end - done)
        first = state[NEWEST] + 1 if state[NEWEST] + 1 < places else 0
        for row in range(done, done + run):
            _append(stage[row * AXES : (row + 1) * AXES], scaling, phase, missing, state)
        done += run
        count = state[TOTAL] - run  # samples before this run
        whole = count - state[STRUCK] > length
        if run == 1 and whole and count >= length:
            for row in range(0, taus, RUN):
                some, lanes = slice(row, row + RUN), slice(row * LANES, (row + RUN) * LANES)
                _swap(first, factors[some], spans[some], phase, scratch, sums[lanes], rest[lanes])
        else:
            _take(first, run, count, whole, factors, spans, phase, missing, scratch, terms, sums, rest, state[WIDTH])


@compiled
def _take(
    first: int,
    run: int,
    count: int,
    whole: bool,
    factors: Ints,
    spans: Ints,
    phase: Ints,
    missing: NDArray[np.int32],
    scratch: Floats,
    terms: Ints,
    sums: Floats,
    rest: Floats,
    lanes: int,
) -> None:
    """Each τ takes the terms of ``run`` samples, whose phase begins at ``first``, after ``count`` samples before."""
    places = phase.size // LANES
    for i in range(factors.size):
        row = max(0, 2 * factors[i] - 1 - count)  # the first whose term is complete
        own = slice(i * LANES, (i + 1) * LANES)
        while row < run:
            # as far as no stream comes to the ring's end, and the span is full throughout or not at all
            now = first + row if first + row < places else first + row - places
            leaving = count + row >= spans[i]
            end = run if leaving else min(run, spans[i] - count)
            row += _slide(
                now, end - row, factors[i], spans[i], leaving, whole,
                phase, missing, scratch, terms[own], sums[own], rest[own], lanes,
            )  # fmt: skip


@compiled
def _append(sample: Floats, scaling: Floats, phase: Ints, missing: NDArray[np.int32], state: Ints) -> None:
    """Write one phase point and the running count of missing samples."""
    before = LANES * state[NEWEST]
    now = before + LANES if before + LANES < phase.size else 0
    state[TOTAL] += 1
    state[NEWEST] = now // LANES
    for lane in range(sample.size):
        y = sample[lane] * scaling[lane] + scaling[LANES + lane]
        if abs(y) < 4.0e18:  # false for NaN too
            step = np.rint(y)
            scaling[LANES + lane] = y - step
            phase[now + lane] = phase[before + lane] + np.int64(step)
            count = missing[before + lane]
        else:
            phase[now + lane] = phase[before + lane]
            count = missing[before + lane] + 1
            state[STRUCK] = state[TOTAL]
        if missing[now + lane] != count:  # not written while it stays 0, so that the system need not give the memory
            missing[now + lane] = count


@compiled
def _slide(
    now: int,
    rows: int,
    m: int,
    span: int,
    leaving: bool,
    whole: bool,
    phase: Ints,
    missing: NDArray[np.int32],
    scratch: Floats,
    terms: Ints,
    sums: Floats,
    rest: Floats,
    lanes: int,
) -> int:
    """Add the terms that end at up to ``rows`` phase points from ``now`` on, evict as many when ``leaving``.

    Returns the rows done: fewer than asked where a stream comes to the end of the ring.
    """
    places = phase.size // LANES
    old = now - span - 1
    new1, new2 = place(now - m, places), place(now - 2 * m, places)
    old0, old1, old2 = place(old + 2 * m, places), place(old + m, places), place(old, places)
    run = min(rows, places - max(now, new1, new2, old0, old1, old2))
    n = run * LANES
    added, evicted = scratch[: RUN * LANES], scratch[RUN * LANES :]
    _square(phase, now, new1, new2, n, added)
    if leaving:
        _square(phase, old0, old1, old2, n, evicted)
    else:
        evicted[:n] = 0.0
    if not whole:
        _strike(missing, now, new2, 1, n, added, terms)
        if leaving:
            _strike(missing, old0, old2, -1, n, evicted, terms)
    elif not leaving:
        terms += run
    _exchange(added, evicted, n, sums, rest, lanes)
    return run


@compiled
def place(index: int, places: int) -> int:
    """Place in the ring of a phase point less than one turn back."""
    return index if index >= 0 else index + places


@compiled
def _square(phase: Ints, at0: int, at1: int, at2: int, n: int, out: Floats) -> None:
    """Squared second differences of n lanes; flat, so that it runs a vector register at a time."""
    i0, i1, i2 = np.uintp(at0 * LANES), np.uintp(at1 * LANES), np.uintp(at2 * LANES)
    for i in range(np.uintp(n)):
        d = float(phase[i0 + i] - 2 * phase[i1 + i] + phase[i2 + i])
        out[i] = d * d


@compiled
def _strike(missing: NDArray[np.int32], at0: int, at2: int, step: int, n: int, squares: Floats, terms: Ints) -> None:
    """Strike out the terms that touch a missing sample, count the others."""
    for i in range(n):
        if missing[at0 * LANES + i] == missing[at2 * LANES + i]:
            terms[i % LANES] += step
        else:
            squares[i] = 0.0


@compiled
def _exchange(added: Floats, evicted: Floats, n: int, sums: Floats, rest: Floats, lanes: int) -> None:
    """sums + rest += added - evicted, row by row, each rounding kept in rest.

    TwoSum: Knuth, TAOCP vol. 2, 4.2.2, theorem B. An index that could be negative, or a known number of
    ``lanes``, would make scalar lines of the inner loop: three times the cost.
    """
    for row in range(np.uintp(0), np.uintp(n), np.uintp(lanes)):
        for lane in range(np.uintp(lanes)):
            s = sums[lane]
            t = s + added[row + lane]
            z = t - s
            first = (s - (t - z)) + (added[row + lane] - z)
            u = t - evicted[row + lane]
            z = u - t
            sums[lane] = u
            rest[lane] += first + ((t - (u - z)) - (evicted[row + lane] + z))


@compiled
def _swap(now: int, factors: Ints, spans: Ints, phase: Ints, scratch: Floats, sums: Floats, rest: Floats) -> None:
    """The same for a single sample of a full window without gaps: all τ in one go.

    Setting up vector loops for each τ would cost more than the work; so the differences are gathered one by one, and
    one loop exchanges them all.
    """
    places = phase.size // LANES
    added, evicted = scratch[: RUN * LANES], scratch[RUN * LANES :]
    at0 = np.uintp(now * LANES)
    for i in range(factors.size):
        m, old = factors[i], now - spans[i] - 1
        at1, at2 = np.uintp(place(now - m, places) * LANES), np.uintp(place(now - 2 * m, places) * LANES)
        old0, old1 = np.uintp(place(old + 2 * m, places) * LANES), np.uintp(place(old + m, places) * LANES)
        old2 = np.uintp(place(old, places) * LANES)
        out = np.uintp(i * LANES)
        for lane in range(np.uintp(AXES)):
            d = float(phase[at0 + lane] - 2 * phase[at1 + lane] + phase[at2 + lane])
            e = float(phase[old0 + lane] - 2 * phase[old1 + lane] + phase[old2 + lane])
            added[out + lane] = d * d
            evicted[out + lane] = e * e
    n = factors.size * LANES
    _exchange(added, evicted, n, sums, rest, n)


@compiled
def forget(ints: Ints, floats: Floats, missing: NDArray[np.int32], taus: int, axis: int, n: int) -> None:
    """Of one axis, all but the newest n samples become missing, and the sums are made anew from those n."""
    state, factors, spans, terms, phase = cut_ints(ints, taus)
    _, _, sums, rest, _ = cut_floats(floats, taus)
    places = phase.size // LANES
    # a count that differs from point to point: no term can begin and end with the same
    oldest = place(state[NEWEST] - n, places) * LANES + axis
    for back in range(1, min(state[TOTAL], places - 1 - RUN) - n + 1):
        missing[place(state[NEWEST] - n - back, places) * LANES + axis] = missing[oldest] - back
    state[STRUCK] = max(state[STRUCK], state[TOTAL] - n)
    for i in range(taus):
        m, own = factors[i], i * LANES + axis
        total, left, count = 0.0, 0.0, 0
        for back in range(min(n, spans[i]) - 2 * m, -1, -1):
            at = state[NEWEST] - back
            at0, at1 = place(at, places) * LANES + axis, place(at - m, places) * LANES + axis
            at2 = place(at - 2 * m, places) * LANES + axis
            if missing[at0] == missing[at2]:
                d = float(phase[at0] - 2 * phase[at1] + phase[at2])
                s = total + d * d
                z = s - total
                left += (total - (s - z)) + (d * d - z)
                total = s
                count += 1
        sums[own], rest[own], terms[own] = total, left, count


@inlined
def level(phase: Ints, missing: NDArray[np.int32], newest: int, n: int, axis: int) -> int:
    """Mean of the newest samples of an axis, in its integers: near enough to its mean that differences fit in 64 bits.

    NEVER where none of them is there.
    """
    places = phase.size // LANES
    last, first = newest * LANES + axis, place(newest - min(n, LEVEL), places) * LANES + axis
    present = min(n, LEVEL) - (missing[last] - missing[first])
    return (phase[last] - phase[first]) // present if present > 0 else NEVER


@inlined
def thirds(phase: Ints, missing: NDArray[np.int32], newest: int, n: int, axis: int) -> float:
    """Slope of the last n samples by their thirds, in units of the integers; NaN where too many are missing."""
    third, places = n // 3, phase.size // LANES
    middle = level(phase, missing, newest, n, axis)
    if third == 0 or middle == NEVER:
        return np.nan
    at0, at1 = newest * LANES + axis, place(newest - third, places) * LANES + axis
    at2, at3 = place(newest - 2 * third, places) * LANES + axis, place(newest - 3 * third, places) * LANES + axis
    late, early = third - (missing[at0] - missing[at1]), third - (missing[at2] - missing[at3])
    if min(late, early) < PRESENT * third or 3 * third - (missing[at0] - missing[at3]) < PRESENT * 3 * third:
        return np.nan
    # phase wraps, and so does the level times a count: their difference is small, and is taken before it is a number
    rise = float(phase[at0] - phase[at1] - middle * late) / late
    rise -= float(phase[at2] - phase[at3] - middle * early) / early
    return float(rise / (2.0 * third))


@compiled
def bends(phase: Ints, missing: NDArray[np.int32], newest: int, lengths: Ints, factors: Ints, out: Floats) -> None:
    """``mean_bend`` of all τ and axes [m, AXES]."""
    for i in range(factors.size):
        for axis in range(AXES):
            out[i, axis] = mean_bend(phase, missing, newest, lengths[axis], factors[i], axis)


@compiled
def mean_bend(phase: Ints, missing: NDArray[np.int32], newest: int, n: int, m: int, axis: int) -> float:
    """Mean second difference of phase over clusters of m in the last n samples, over m²; NaN where too few are there.

    The sum of all second differences telescopes to those of four blocks of m points at the ends. Of a
    long block BEND_POINTS points are taken: phase is so smooth that they stand for all. A missing sample counts as one
    of the level.
    """
    places = phase.size // LANES
    last, first = newest * LANES + axis, place(newest - n, places) * LANES + axis
    middle = level(phase, missing, newest, n, axis)
    if n < 2 * m or middle == NEVER or n - (missing[last] - missing[first]) < PRESENT * n:
        return np.nan
    stride = max(1, m // BEND_POINTS)
    total = 0.0
    for k in range(0, m, stride):
        at0, at1 = place(newest - k, places) * LANES + axis, place(newest - m - k, places) * LANES + axis
        at2 = place(newest - n + 2 * m - 1 - k, places) * LANES + axis
        at3 = place(newest - n + m - 1 - k, places) * LANES + axis
        absent = missing[at0] - missing[at1] - missing[at2] + missing[at3]
        total += float(phase[at0] - phase[at1] - phase[at2] + phase[at3] + middle * absent)
    points = (m + stride - 1) // stride
    # the blocks are n + 1 − 2m apart, so many differences have their mean
    return total / points * m / (n + 1.0 - 2 * m) / (float(m) * m)
