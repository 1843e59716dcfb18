"""Counting of the missing samples in each gap of a recording, based on the time stamps.

A missing sample delays all later time stamps by one sample period, whereas a late sample does not affect later time
stamps. For each gap, the median delay of ``ROWS_BESIDE_GAP`` samples after the gap is compared with the median delay
before the gap. The increase, rounded to whole periods, is the number of missing samples. It cannot exceed the number
that the clock reported.

A sender that was delayed may send many samples late. The range after the gap is therefore extended by twice the number
of samples that seem to be missing. If the range contains other gaps, the smallest median delay is used.

The sample period is the median over parts of the recording without a gap, so missing samples do not bias the period.
"""

from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled

ROWS_BESIDE_GAP: Final = 60
"""Number of samples on each side of a gap from which the median delay is computed.

Most of these samples must be on time.

Some bus adapters send twenty late samples at once.
"""
MIN_SHIFT_PERIODS: Final = 2.0 / 3.0
"""Minimum increase of the delay, in sample periods, that is attributed to missing samples."""
MAX_CATCH_UP_ROWS: Final = 10_000
"""Maximum number of samples that a delayed sender may need to catch up."""
MAX_RATE_VARIATION: Final = 0.01
"""Maximum relative variation of the sample rate after a gap.

A delay that decreases faster indicates a sender that catches up.
"""
STRETCH_ROWS: Final = (256, 128, 64, 32, 16, 8, 4, 2)
"""Lengths, in samples, of the intervals from which the period is computed, in order of preference."""
MIN_STRETCH_RATIO: Final = 4
"""A length from ``STRETCH_ROWS`` is used if at least a quarter of all intervals of this length contain no gap."""


def count_missing_before_gaps(
    t_ns: Ints, rows_after_gaps: Ints, missing_by_clock: Ints, rows_after_jumps: Ints
) -> Ints:
    """Return the number of missing samples in each gap.

    Parameters
    ----------
    t_ns : ndarray of int64, shape (n,)
        Time stamps of the samples in nanoseconds, in the order of the recording.
    rows_after_gaps : ndarray of int64, shape (k,)
        Index of the first sample after each gap, in ascending order.
    missing_by_clock : ndarray of int64, shape (k,)
        Number of missing samples in each gap that the clock reported. The clock counts late samples as missing.
    rows_after_jumps : ndarray of int64
        Index of the first sample after each jump of the time stamps. Samples are only compared between two jumps.

    Returns
    -------
    ndarray of int64, shape (k,)
        Number of missing samples in each gap, at most ``missing_by_clock``.

    >>> t_ns = 10_000_000 * np.arange(300)
    >>> t_ns[100:110] += 10_000_000  # late
    >>> t_ns[200:] += 10_000_000  # missing
    >>> count_missing_before_gaps(t_ns, np.array([100, 200]), np.array([1, 1]), np.array([], int)).tolist()
    [0, 1]
    """
    period_ns = _period_ns(t_ns, np.concatenate([rows_after_gaps, rows_after_jumps]))
    if not period_ns > 0.0:
        return missing_by_clock
    # The first time stamp is subtracted, because a double cannot resolve Unix time to a fraction of a period.
    late = (t_ns - t_ns[0]) / period_ns - np.arange(t_ns.size)
    ends = np.unique(np.concatenate([[0], rows_after_gaps, rows_after_jumps, [t_ns.size]]))
    return _count_missing(late, rows_after_gaps, missing_by_clock, ends, np.searchsorted(ends, rows_after_gaps))


def _period_ns(t_ns: Ints, edges: Ints) -> float:
    part = np.zeros(t_ns.size, np.int64)
    part[edges] = 1
    part = np.cumsum(part)
    for rows in STRETCH_ROWS:
        if t_ns.size <= rows:
            continue
        whole = part[rows:] == part[:-rows]
        if MIN_STRETCH_RATIO * whole.sum() >= t_ns.size:
            return float(np.median((t_ns[rows:] - t_ns[:-rows])[whole])) / rows
    return float(np.median(np.diff(t_ns)))


@compiled
def _count_missing(late: Floats, rows: Ints, claimed: Ints, ends: Ints, at: Ints) -> Ints:
    """Count the missing samples in each gap.

    ``late`` [n] is the delay of each sample in periods. Sample ``ends[at[k]]`` is the first sample after gap k.
    """
    holes = rows.size
    reach = np.empty(holes, np.int64)
    after = np.empty(holes)
    for k in range(holes):
        reach[k] = rows[k] + ROWS_BESIDE_GAP + min(2 * claimed[k], MAX_CATCH_UP_ROWS)
        end = ends[at[k] + 1]
        near = np.median(late[rows[k] : min(rows[k] + ROWS_BESIDE_GAP, end)])
        far = np.median(late[rows[k] : min(reach[k], end)])
        after[k] = far if near - far > MAX_RATE_VARIATION * (reach[k] - rows[k]) else near
    missing = np.zeros(holes, np.int64)
    level = 0.0
    for k in range(holes):
        if k == 0 or rows[k] >= reach[k - 1] or ends[at[k] - 1] != rows[k - 1]:
            level = np.median(late[max(rows[k] - ROWS_BESIDE_GAP, ends[at[k] - 1]) : rows[k]])
        on_time = after[k]
        j = k + 1
        while j < holes and rows[j] < reach[k] and ends[at[j] - 1] == rows[j - 1]:
            on_time = min(on_time, after[j])
            j += 1
        if on_time - level > MIN_SHIFT_PERIODS:
            missing[k] = min(claimed[k], np.int64(np.rint(on_time - level)))
        level = on_time
    return missing
