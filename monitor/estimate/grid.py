"""A recording on a regular grid: by the same clock that stamps live samples, what is missing is NaN in its place.

The clock calls a step of two periods a hole, as the next sample has to be placed at once. A whole recording knows
better: where samples before and after lie on one line only if none is missing, it came late, and that is all. Rows that
repeat others, time and values, are kept out. Rows that repeat the one before while time goes on stay, as they are what
the sensor's register held. Everything found is said in notes, at most NOTES of one sort.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from drivers.clock import JUMP_S, LONG_S, SampleClock
from drivers.errors import NotReady
from drivers.line import made_rate
from drivers.order import NS
from drivers.sample import Floats, Given, Ints, SampleBlock
from monitor.estimate.stale import stale_share

OFF_RATE: Final = 0.02
"""A stated rate further than this from what the times say is told."""
NOTES: Final = 10
"""Of the clock; what is beyond is counted."""
STALE: Final = 0.01
"""A share below this is not told."""
LONGEST_HOLE: Final = 1_000_000
"""Missing samples kept in place, 48 bytes each; one stands for a longer pause, and keeps terms from reaching across."""
AROUND: Final = 500
"""Rows to both sides of a hole that say whether anything is missing: long enough for a late sender to catch up."""
ASKED: Final = 200
"""Holes that are asked at most, spread over the recording."""
UNEVEN: Final = 0.5
"""Of a period: steps of which a fifth is further off than this are told."""


def on_grid(blocks: Sequence[SampleBlock], rate_hz: float | None) -> tuple[Floats, float, list[str]]:
    """Values [n, 6] at a steady rate, missing samples NaN in their places; the rate; what was found about the times.

    The values may be the blocks' own memory: to be read, not written.
    """
    clock = SampleClock(Given(), rate_hz)
    stamped = [one for samples in blocks for one in clock.stamp(samples)]
    told = [event.text for event in clock.take_events(ended=True)]
    t_ns = np.concatenate([samples.t_ns for samples in stamped])
    lost, late = _without_late(stamped, t_ns)
    rate = rate_hz or _mean_rate(stamped, t_ns, lost)
    values = _placed(stamped, lost)
    notes = told[:NOTES] + ([f"and {len(told) - NOTES} more notes on the times"] if len(told) > NOTES else [])
    notes += _said_of_steps(stamped, t_ns, lost, rate) + _said_late(late)
    notes += _said_stale(values) + _said_missing(lost, rate)
    return values, rate, notes


def _without_late(stamped: Sequence[SampleBlock], t_ns: Ints) -> tuple[Ints, int]:
    """Samples missing before each block, and how many holes were none, as all that is missing only came late.

    Around a true hole times lie on a line against the index that counts what is missing; around a late sample, against
    the one that does not. Most of the holes decide for all: one alone may be unclear.
    """
    lost = np.array([samples.lost for samples in stamped], np.int64)
    short = (lost > 0) & (lost <= LONGEST_HOLE)
    holes = np.flatnonzero(short)
    if not holes.size:
        return lost, 0
    rows = np.cumsum([0, *(len(samples) for samples in stamped[:-1])])
    asked = rows[holes[:: -(-holes.size // ASKED)]]
    missing = np.zeros(t_ns.size, np.int64)
    missing[rows] = lost
    late = 0
    for row in asked.tolist():
        around = slice(max(row - AROUND, 0), row + AROUND)
        t_s = (t_ns[around] - t_ns[row]) / NS
        index = np.arange(t_s.size, dtype=np.float64)
        late += _scatter(index, t_s) < _scatter(index + np.cumsum(missing[around]), t_s)
    if 2 * late <= asked.size:
        return lost, 0
    return np.where(short, 0, lost), int(holes.size)


def _scatter(index: Floats, t_s: Floats) -> float:
    """Sum of squares about the line of least squares."""
    x, y = index - index.mean(), t_s - t_s.mean()
    return float(y @ y - (x @ y) ** 2 / (x @ x))


def _placed(stamped: Sequence[SampleBlock], lost: Ints) -> Floats:
    """All rows in one array [n, 6], NaN where samples are missing; not copied where blocks lie side by side."""
    missing = np.where(lost > LONGEST_HOLE, 1, lost)
    if not missing.any() and (whole := _side_by_side([samples.values for samples in stamped])) is not None:
        return whole
    values = np.empty((int(missing.sum()) + sum(len(samples) for samples in stamped), 6))
    row = 0
    for samples, hole in zip(stamped, missing.tolist(), strict=True):
        values[row : row + hole] = np.nan
        row += hole
        values[row : row + len(samples)] = samples.values
        row += len(samples)
    return values


def _side_by_side(parts: Sequence[Floats]) -> Floats | None:
    """The rows of the one array that these parts are, each beginning where the last ended; None where they are not."""
    whole = parts[0].base
    if len(parts) == 1:
        return parts[0]
    if not isinstance(whole, np.ndarray) or not whole.flags.c_contiguous or whole.dtype != parts[0].dtype:
        return None
    if whole.shape[1:] != parts[0].shape[1:]:
        return None
    begin = end = _address(parts[0])
    for part in parts:
        if part.base is not whole or not part.flags.c_contiguous or _address(part) != end:
            return None
        end += part.nbytes
    first = (begin - _address(whole)) // whole.strides[0]
    return np.asarray(whole[first : first + sum(len(part) for part in parts)])


def _address(array: Floats) -> int:
    return int(array.__array_interface__["data"][0])


def _said_missing(lost: Ints, rate_hz: float) -> list[str]:
    long, short = lost[lost > LONGEST_HOLE], lost[(lost > 0) & (lost <= LONGEST_HOLE)]
    notes = [f"a pause of {n / rate_hz:.6g} s is too long to keep in place; no term reaches across" for n in long]
    if short.size:
        samples = "1 sample is" if short.sum() == 1 else f"{short.sum()} samples are"
        places = "1 place" if short.size == 1 else f"{short.size} places"
        notes.append(f"{samples} missing in {places}; terms that touch them are left out")
    return notes


def _said_late(late: int) -> list[str]:
    if not late:
        return []
    times = "once" if late == 1 else f"{late} times"
    return [f"a sample came late by a period or more {times}, but later ones made good for it: none is missing"]


def _said_stale(values: Floats) -> list[str]:
    share = stale_share(values)
    if share < STALE:
        return []
    percent = 100.0 * share
    return [f"{percent:.2g} % of rows repeat the one before: the sensor updates slower than it is read; they are kept"]


def _said_of_steps(stamped: Sequence[SampleBlock], t_ns: Ints, lost: Ints, rate_hz: float) -> list[str]:
    """Where times step unevenly; where they say another rate, by their steps if steady, else by their mean."""
    steps = np.diff(t_ns)
    if not steps.size:
        return []
    low, middle, high = _spread(steps)
    if middle > 0.0 and high - low <= OFF_RATE * middle:
        if abs(middle * rate_hz - 1.0) < OFF_RATE:
            return []
        return [f"the rate used is {rate_hz:g} Hz, but the times step by {middle:.6g} s, {1.0 / middle:.6g} Hz"]
    uneven = []
    if max(1.0 / rate_hz - low, high - 1.0 / rate_hz) > UNEVEN / rate_hz:
        worst_s = float(steps[steps < LONG_S * NS].max()) / NS
        uneven = [
            f"times step unevenly: by {middle:.3g} s in the median, {high:.3g} s at 90 %, {worst_s:.3g} s at worst; "
            "samples are taken to be even"
        ]
    try:
        mean_hz = _mean_rate(stamped, t_ns, lost)
    except NotReady:
        return [f"the rate used is {rate_hz:g} Hz; the times do not go on and say none"]
    if abs(mean_hz / rate_hz - 1.0) < OFF_RATE:
        return uneven
    return [*uneven, f"the rate used is {rate_hz:g} Hz, but by the times {mean_hz:.5g} samples came a second"]


def _spread(steps: Ints) -> tuple[float, float, float]:
    """Tenth, middle and ninetieth hundredth of the steps, s; where all are near alike, ends and mean stand for them."""
    low, high = int(steps.min()), int(steps.max())
    if high - low <= OFF_RATE * low:
        return low / NS, float(steps.mean()) / NS, high / NS
    tenth, middle, ninetieth = (np.quantile(steps, [0.1, 0.5, 0.9]) / NS).tolist()
    return tenth, middle, ninetieth


def _mean_rate(stamped: Sequence[SampleBlock], t_ns: Ints, lost: Ints) -> float:
    """Samples a second over the whole recording, missing ones included, where its times do not jump."""
    steps = np.diff(t_ns) / NS
    samples_each = np.ones(t_ns.size, np.int64)
    starts = np.cumsum([0, *(len(samples) for samples in stamped[:-1])])
    samples_each[starts] += lost
    steady = (steps > -JUMP_S) & (steps < LONG_S)
    n, span_s = int(samples_each[1:][steady].sum()), float(steps[steady].sum())
    if n < 1 or span_s <= 0.0:
        raise NotReady("the times of the recording do not go on, so that its rate is unknown; state it with --rate HZ")
    return made_rate(n / span_s)
