"""Points that the viewer draws for stored history. The module does no I/O.

Each bucket has a point for its last value with the interval, at the end of the bucket. An extreme outside this interval
has an additional point. A minimum is drawn after one third of the bucket, a maximum after two thirds.
"""

import numpy as np

from drivers.data_types import Floats
from monitor.history.history_table import ColumnStatistics, HistoryTable
from monitor.publishing.plots.style import omit_wide_intervals


def history_points(past: HistoryTable, column: ColumnStatistics, lo: Floats, hi: Floats) -> tuple[Floats, Floats]:
    """Return the Unix times [m] of the points, and their value, lo and hi [m, 3].

    A row of NaN marks each gap and the end, so that the line is interrupted there.

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
    """Return the rows for which ``there`` is True, as time, value, lo and hi, shape [rows, 4]."""
    return np.column_stack([t_s, value, lo, hi])[there]
