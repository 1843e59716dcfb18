"""Points that the viewer draws for the stored history of a device.

The history divides time into intervals (buckets). Each bucket is drawn as a point at its end, which shows the last
value with its confidence interval. If the smallest or largest value lies outside the confidence interval, an additional
point is drawn.
"""

import numpy as np

from drivers.data_types import Floats
from monitor.history.bucketed_history import ColumnStatistics, HistoryTable
from monitor.publishing.plots.style import omit_wide_intervals


def history_points(
    past: HistoryTable, column: ColumnStatistics, interval_lo: Floats, interval_hi: Floats
) -> tuple[Floats, Floats]:
    """Return the points to draw: Unix times, shape [m], and values with ends of the interval, shape [m, 3].

    A row of NaN interrupts the line at the end of the history and where buckets are missing.

    Parameters
    ----------
    past
        History of the device with p buckets.
    column
        Last, smallest and largest value of a quantity in each bucket.
    interval_lo, interval_hi
        Lower and upper end of the confidence interval of each last value, shape [p]; NaN if there is none.
    """
    start_s, width_s = past.start_s.astype(np.float64), past.width_s.astype(np.float64)
    newest_s = start_s + width_s
    interval_lo, interval_hi = omit_wide_intervals(column.last, interval_lo, interval_hi)
    ends = [np.fmin(interval_lo, column.last), np.fmax(interval_hi, column.last)]
    parts = [_rows(newest_s, column.last, interval_lo, interval_hi, np.isfinite(column.last))]
    parts.append(_rows(start_s + width_s / 3.0, column.low, interval_lo, interval_hi, column.low < ends[0]))
    parts.append(_rows(start_s + width_s / 1.5, column.high, interval_lo, interval_hi, column.high > ends[1]))
    missing = np.full(start_s.size, np.nan)
    broken = np.append(past.start_s[1:] > past.end_s[:-1], True)
    broken |= ~np.isfinite(column.last)
    parts.append(_rows(newest_s + 1e-3, missing, missing, missing, broken))
    table = np.concatenate(parts)
    table = table[np.argsort(table[:, 0], kind="stable")]
    return table[:, 0], table[:, 1:]


def _rows(
    t_s: Floats,
    value: Floats,
    interval_lo: Floats,
    interval_hi: Floats,
    there: "np.ndarray[tuple[int], np.dtype[np.bool_]]",
) -> Floats:
    """Return the selected points as rows of time, value, and lower and upper end of the interval, shape [rows, 4]."""
    return np.column_stack([t_s, value, interval_lo, interval_hi])[there]
