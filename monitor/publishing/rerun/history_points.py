"""Points that the viewer draws for the stored history of a device.

Each time bucket has a point at the end of the bucket for the last value, with the interval of the value. An extreme
outside the interval has an additional point.
"""

import numpy as np

from drivers.data_types import Floats
from monitor.history.history_table import ColumnStatistics, HistoryTable
from monitor.publishing.plots.style import omit_wide_intervals


def history_points(past: HistoryTable, column: ColumnStatistics, lo: Floats, hi: Floats) -> tuple[Floats, Floats]:
    """Return Unix times, shape [m], and values with interval ends, shape [m, 3], of the points to draw.

    A row of NaN interrupts the line at the end and where buckets are missing.

    Parameters
    ----------
    past
        History that contains the p buckets.
    column
        Statistics of a number in each bucket.
    lo, hi
        Ends of the interval of each last value, shape [p]; NaN if there is none.
    """
    start_s, width_s = past.start_s.astype(np.float64), past.width_s.astype(np.float64)
    newest_s = start_s + width_s
    lo, hi = omit_wide_intervals(column.last, lo, hi)
    ends = [np.fmin(lo, column.last), np.fmax(hi, column.last)]
    parts = [_rows(newest_s, column.last, lo, hi, np.isfinite(column.last))]
    parts.append(_rows(start_s + width_s / 3.0, column.low, lo, hi, column.low < ends[0]))
    parts.append(_rows(start_s + width_s / 1.5, column.high, lo, hi, column.high > ends[1]))
    missing = np.full(start_s.size, np.nan)
    broken = np.append(past.start_s[1:] > past.end_s[:-1], True)
    broken |= ~np.isfinite(column.last)
    parts.append(_rows(newest_s + 1e-3, missing, missing, missing, broken))
    table = np.concatenate(parts)
    table = table[np.argsort(table[:, 0], kind="stable")]
    return table[:, 0], table[:, 1:]


def _rows(
    t_s: Floats, value: Floats, lo: Floats, hi: Floats, there: "np.ndarray[tuple[int], np.dtype[np.bool_]]"
) -> Floats:
    """Return the selected points as rows of time, value and interval ends, shape [rows, 4]."""
    return np.column_stack([t_s, value, lo, hi])[there]
