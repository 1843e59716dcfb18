"""Which holes of a recording are holes: a sample that is missing shifts all later times for good, a late one does not.

The clock calls a step of two periods a hole, as the next sample has to be placed at once. A recording also knows what
came after. Of each hole the times against those of a steady rate, in periods, are looked at on both sides: the medians
of some tens of rows, which bear a few that are late. A late sender may need as many rows as seemed missing to catch up,
so that the rows after a hole are more by those. Where holes are so near each other that a level may be that of a late
sender, the lowest within reach counts, as nothing comes early. What the times are shifted by, as a whole number between
none and what the clock said, is missing.

The rate is the median over stretches without a hole, so that neither what is missing nor what came late bears on it. A
rate that wanders by half a percent shifts times by a quarter of a period within reach, which is not counted.
"""

from typing import Final

import numpy as np

from drivers.sample import Floats, Ints
from monitor.common.compiled import compiled

AROUND: Final = 60
"""Rows to each side: bus adapters were seen to send twenty late at once, and most have to be on time."""
FEWEST: Final = 2.0 / 3.0
"""Periods: times that wander shift by half a period without any loss."""
CATCH_UP: Final = 10_000
"""Rows that a late sender is granted at most to catch up."""
WANDERS: Final = 0.01
"""Of the rate, at most, within reach: a level that falls by less is nothing that was caught up."""
STRETCHES: Final = (256, 128, 64, 32, 16, 8, 4, 2)
"""Rows between two times that the rate is had from: the longest of which there are enough without a hole."""
ENOUGH: Final = 4
"""One in so many rows begins such a stretch."""


def truly_missing(t_ns: Ints, rows: Ints, claimed: Ints, breaks: Ints) -> Ints:
    """Samples [k] that are missing before rows ``rows`` [k] of times [n]; the rest of what the clock said came late.

    Args:
        t_ns: given times, in their order
        rows: of the holes, rising
        claimed: samples [k] that would be missing if nothing came late
        breaks: other rows that times before say nothing about: jumps, long pauses

    >>> t_ns = 10_000_000 * np.arange(300)
    >>> t_ns[100:110] += 10_000_000  # late
    >>> t_ns[200:] += 10_000_000  # missing
    >>> truly_missing(t_ns, np.array([100, 200]), np.array([1, 1]), np.array([], int)).tolist()
    [0, 1]
    """
    period_ns = _period_ns(t_ns, np.concatenate([rows, breaks]))
    if not period_ns > 0.0:
        return claimed
    # seconds of Unix time have no digits left for a period
    late = (t_ns - t_ns[0]) / period_ns - np.arange(t_ns.size)
    ends = np.unique(np.concatenate([[0], rows, breaks, [t_ns.size]]))
    return _decided(late, rows, claimed, ends, np.searchsorted(ends, rows))


def _period_ns(t_ns: Ints, edges: Ints) -> float:
    """Median over stretches that cross no edge; over all steps where these are too few."""
    part = np.zeros(t_ns.size, np.int64)
    part[edges] = 1
    part = np.cumsum(part)
    for rows in STRETCHES:
        if t_ns.size <= rows:
            continue
        whole = part[rows:] == part[:-rows]
        if ENOUGH * whole.sum() >= t_ns.size:
            return float(np.median((t_ns[rows:] - t_ns[:-rows])[whole])) / rows
    return float(np.median(np.diff(t_ns)))


@compiled
def _decided(late: Floats, rows: Ints, claimed: Ints, ends: Ints, at: Ints) -> Ints:
    """Samples missing before each hole, by how late [n] the rows are, in periods; hole k is at ``ends[at[k]]``."""
    holes = rows.size
    reach = np.empty(holes, np.int64)
    after = np.empty(holes)
    for k in range(holes):
        reach[k] = rows[k] + AROUND + min(2 * claimed[k], CATCH_UP)
        end = ends[at[k] + 1]
        near, far = np.median(late[rows[k] : min(rows[k] + AROUND, end)]), np.median(late[rows[k] : min(reach[k], end)])
        after[k] = far if near - far > WANDERS * (reach[k] - rows[k]) else near
    missing = np.zeros(holes, np.int64)
    level = 0.0
    for k in range(holes):
        if k == 0 or rows[k] >= reach[k - 1] or ends[at[k] - 1] != rows[k - 1]:
            level = np.median(late[max(rows[k] - AROUND, ends[at[k] - 1]) : rows[k]])
        on_time = after[k]
        j = k + 1
        while j < holes and rows[j] < reach[k] and ends[at[j] - 1] == rows[j - 1]:
            on_time = min(on_time, after[j])
            j += 1
        if on_time - level > FEWEST:
            missing[k] = min(claimed[k], np.int64(np.rint(on_time - level)))
        level = on_time
    return missing
