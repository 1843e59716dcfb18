"""Read stored results as a table with a limited number of time buckets.

The function ``read_history`` merges the stored rows that fall into the same time bucket while it reads them. The
required memory therefore depends on the number of requested points and not on the length of the time range. A time
bucket is at least as wide as the stored rows.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints
from drivers.errors import NotReady
from drivers.number_ranges import DAY_S
from monitor.common.unit_formatting import format_utc
from monitor.history.history_row import HistoryRow, Singles, merge_rows, select_columns
from monitor.history.sqlite_store import HistoryReader
from monitor.history.stored_events import StoredEvent
from monitor.history.time_ranges import TimeRange

DEFAULT_POINTS: Final = 1000
"""Approximate number of time buckets in a table. If the stored rows differ in width, there may be twice as many."""
MAX_EVENTS: Final = 1000
BUCKET_WIDTHS_S: Final = (
    *(60, 300, 900, 1800, 3600, 10_800, 21_600, 43_200),
    *(days * DAY_S for days in (1, 2, 4, 7, 30, 90, 365)),
)
"""Allowed widths of time buckets [s]. Each width is a multiple of all row widths that do not exceed it."""


@dataclass(frozen=True, slots=True)
class HistoryTable:
    """Stored results of one device, with k columns and p time buckets."""

    device: str
    span: TimeRange  # requested time range, limited to the stored time range
    step_s: int  # width of the time buckets, unless the stored rows are wider
    start_s: Ints  # [p] Unix time of the start of each time bucket
    width_s: Ints  # [p]
    names: tuple[str, ...]  # [k] column names, see ``minute_aggregation``
    n: Ints  # [p, k] number of values
    low: Singles  # [p, k] minimum, SI units; NaN if there is no value
    high: Singles
    last: Singles
    counts: Ints  # [p, 4] increments of bucket.COUNTS within each bucket
    state: Ints  # [p] index of the worst state in bucket.STATES
    events: tuple[StoredEvent, ...]  # newest events in the time range
    events_in_all: int  # total number of events in the time range

    def __len__(self) -> int:
        return int(self.start_s.size)

    @property
    def end_s(self) -> Ints:
        """Unix time of the end of each time bucket [p] in seconds."""
        return self.start_s + self.width_s

    def select_column(self, name: str) -> "ColumnStatistics":
        """Return the statistics of one column. For an unknown column, all values are NaN."""
        if name not in self.names:
            nothing: Floats = np.full(len(self), np.nan)
            return ColumnStatistics(np.zeros(len(self), np.int64), nothing, nothing, nothing)
        at = self.names.index(name)
        parts = [np.asarray(part[:, at], np.float64) for part in (self.low, self.high, self.last)]
        return ColumnStatistics(self.n[:, at], *parts)

    def list_axes(self) -> tuple[str, ...]:
        """Return the axes that have at least one column."""
        found = dict.fromkeys(name.split(".")[0] for name in self.names if "." in name)
        return tuple(found)

    def list_tau_labels(self) -> tuple[str, ...]:
        """Return the averaging times [s] that occur in the names of Allan deviation columns, in ascending order."""
        found = {name.split(".sigma.")[1] for name in self.names if ".sigma." in name}
        return tuple(sorted(found, key=float))


@dataclass(frozen=True, slots=True)
class ColumnStatistics:
    """Statistics of one column over p time buckets."""

    n: Ints  # [p] number of values
    low: Floats  # [p] minimum; NaN if there is no value
    high: Floats
    last: Floats


def read_history(
    reader: HistoryReader,
    device: str,
    span: TimeRange | None,
    wants_column: Callable[[str], bool] = lambda _name: True,
    step_s: int | None = None,
    points: int = DEFAULT_POINTS,
) -> HistoryTable:
    """Read the stored results of a device as a table.

    Parameters
    ----------
    reader
        Reader of the history file.
    device
        Name of the device.
    span
        Time range to read. None means the last stored day.
    wants_column
        Function that returns True for the names of columns to read.
    step_s
        Minimum width of a time bucket [s]. None means that ``points`` determines the width.
    points
        Approximate number of time buckets.

    Raises
    ------
    NotReady
        If the time range contains neither rows nor events.
    RecordingError
        If a row is damaged.
    """
    held = reader.stored_range(device)
    if held is None:
        raise NotReady(f"{device}: no history yet")
    span = _clip_to_stored(span or TimeRange(held[1] - DAY_S, held[1]), held)
    step_s = choose_bucket_width_s(
        replace(span, start_s=max(span.start_s, held[0]), end_s=min(span.end_s, held[1])), step_s, points
    )
    parts: dict[tuple[int, int], list[HistoryRow]] = {}
    names: dict[tuple[str, ...], tuple[str, ...]] = {}
    for key, rows in groupby(reader.read_rows(device, span), key=lambda row: _bucket(row, step_s)):
        one = merge_rows(list(rows), *key)
        if one.names not in names:
            names[one.names] = tuple(name for name in one.names if wants_column(name))
        parts.setdefault(key, []).append(select_columns(one, names[one.names]))
    found = [merge_rows(part, *key) for key, part in sorted(parts.items())]
    events, in_all = reader.read_events(device, span, MAX_EVENTS)
    if not found and not events:
        raise NotReady(f"{device}: no results in this time range; stored are {_format_range(held)}")
    return build_table(device, span, step_s, found, events, in_all)


def build_table(
    device: str,
    span: TimeRange,
    step_s: int,
    rows: Sequence[HistoryRow],
    events: Sequence[StoredEvent],
    events_in_all: int,
) -> HistoryTable:
    """Build a table from history rows.

    Parameters
    ----------
    device
        Name of the device.
    span
        Time range of the table.
    step_s
        Width of a time bucket [s].
    rows
        Rows in chronological order.
    events
        Events in the time range.
    events_in_all
        Total number of events in the time range, including events that are not in ``events``.
    """
    names = tuple(dict.fromkeys(name for row in rows for name in row.names))
    rows = [select_columns(row, names) for row in rows]
    shape = (len(rows), len(names))
    return HistoryTable(
        device,
        span,
        step_s,
        np.array([row.start_s for row in rows], np.int64),
        np.array([row.width_s for row in rows], np.int64),
        names,
        np.array([row.n for row in rows], np.int64).reshape(shape),
        np.array([row.low for row in rows], np.float32).reshape(shape),
        np.array([row.high for row in rows], np.float32).reshape(shape),
        np.array([row.last for row in rows], np.float32).reshape(shape),
        np.array([row.counts for row in rows], np.int64).reshape(len(rows), 4),
        np.array([row.state for row in rows], np.int64),
        tuple(events),
        events_in_all,
    )


def choose_bucket_width_s(span: TimeRange, step_s: int | None = None, points: int = DEFAULT_POINTS) -> int:
    """Return the smallest allowed width [s] of at least ``step_s`` that gives about ``points`` time buckets.

    >>> choose_bucket_width_s(TimeRange(0.0, 86_400.0)), choose_bucket_width_s(TimeRange(0.0, 5 * 31_536_000.0))
    (300, 172800)
    >>> choose_bucket_width_s(TimeRange(0.0, 3600.0), 900)
    900

    Parameters
    ----------
    span
        Time range.
    step_s
        Minimum width of a time bucket [s].
    points
        Approximate number of time buckets.
    """
    least_s = max((span.end_s - span.start_s) / points, step_s or 0)
    return next(
        (one for one in BUCKET_WIDTHS_S if one >= least_s),
        math.ceil(least_s / BUCKET_WIDTHS_S[-1]) * BUCKET_WIDTHS_S[-1],
    )


def _clip_to_stored(span: TimeRange, held: tuple[float, float]) -> TimeRange:
    """Limit a time range to the stored rows plus one day, because events may precede or follow the rows."""
    start_s, end_s = max(span.start_s, held[0] - DAY_S), min(span.end_s, held[1] + DAY_S)
    return replace(span, start_s=min(start_s, end_s), end_s=max(start_s, end_s))


def _bucket(row: HistoryRow, step_s: int) -> tuple[int, int]:
    width_s = max(row.width_s, step_s)
    return row.start_s // width_s * width_s, width_s


def _format_range(held: tuple[float, float]) -> str:
    return f"{format_utc(held[0])} to {format_utc(held[1])} UTC"
