"""Read the stored results of a time range as one table with a limited number of buckets.

``read`` merges the rows of each bucket while it reads them from disk. Memory therefore depends on the number of points
requested and not on the length of the time range. A bucket is never narrower than the stored rows of its time. Merging
(see ``bucket``) preserves the extremes.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Final

import numpy as np

from drivers.errors import NotReady
from drivers.sample import Floats, Ints
from monitor.history.bucket import Row, Singles, chosen, merged
from monitor.history.sqlite_store import PastEvent, Reader
from monitor.history.time_ranges import Span

DEFAULT_POINTS: Final = 1000
"""Approximate number of buckets in a table; at most twice as many if old and new rows differ in width."""
EVENTS: Final = 1000
DAY_S: Final = 86_400
BUCKET_WIDTHS_S: Final = (
    *(60, 300, 900, 1800, 3600, 10_800, 21_600, 43_200),
    *(days * DAY_S for days in (1, 2, 4, 7, 30, 90, 365)),
)
"""Permitted bucket widths [s]; each is a multiple of every row width that is not larger."""


@dataclass(frozen=True, slots=True)
class Past:
    """History of one device: k numbers in p buckets, ordered by time."""

    device: str
    span: Span  # the requested time range, clipped to the stored one
    step_s: int  # width of the buckets, except where the stored rows are wider
    start_s: Ints  # [p] Unix time
    width_s: Ints  # [p]
    names: tuple[str, ...]  # [k], see ``columns``
    n: Ints  # [p, k] count of values
    low: Singles  # [p, k] SI; NaN if the bucket has no value
    high: Singles
    last: Singles
    counts: Ints  # [p, 4] increments of bucket.COUNTS within each bucket
    state: Ints  # [p] index of the worst of bucket.STATES
    events: tuple[PastEvent, ...]  # the newest events
    events_in_all: int  # number of events in the time range

    def __len__(self) -> int:
        return int(self.start_s.size)

    @property
    def end_s(self) -> Ints:
        """Unix time at which each bucket ends [s], shape [p]."""
        return self.start_s + self.width_s

    def column(self, name: str) -> "Course":
        """Return one number over time; all values are missing if the table has no column of this name."""
        if name not in self.names:
            nothing: Floats = np.full(len(self), np.nan)
            return Course(np.zeros(len(self), np.int64), nothing, nothing, nothing)
        at = self.names.index(name)
        parts = [np.asarray(part[:, at], np.float64) for part in (self.low, self.high, self.last)]
        return Course(self.n[:, at], *parts)

    def axes(self) -> tuple[str, ...]:
        """Return the axes that have at least one column."""
        found = dict.fromkeys(name.split(".")[0] for name in self.names if "." in name)
        return tuple(found)

    def taus(self) -> tuple[str, ...]:
        """Return the averaging times of the deviations [s] as they appear in the column names, in ascending order."""
        found = {name.split(".sigma.")[1] for name in self.names if ".sigma." in name}
        return tuple(sorted(found, key=float))


@dataclass(frozen=True, slots=True)
class Course:
    """One number over p buckets."""

    n: Ints  # [p] count of values
    low: Floats  # [p] NaN if the bucket has no value
    high: Floats
    last: Floats


def read(
    reader: Reader,
    device: str,
    span: Span | None,
    wanted: Callable[[str], bool] = lambda _name: True,
    step_s: int | None = None,
    points: int = DEFAULT_POINTS,
) -> Past:
    """Read the history of a device as a table.

    Parameters
    ----------
    reader
        Reader of the history file.
    device
        Name of the device.
    span
        Time range. None: the last stored day.
    wanted
        Predicate that selects columns by name.
    step_s
        Minimum bucket width [s]. None: as narrow as ``points`` allows.
    points
        Approximate number of buckets.

    Raises
    ------
    NotReady
        The time range contains no rows and no events.
    RecordingError
        A row cannot be read.
    """
    held = reader.held(device)
    if held is None:
        raise NotReady(f"{device}: no history yet")
    span = bounded(span or Span(held[1] - 86_400.0, held[1]), held)
    step_s = step(replace(span, start_s=max(span.start_s, held[0]), end_s=min(span.end_s, held[1])), step_s, points)
    parts: dict[tuple[int, int], list[Row]] = {}
    names: dict[tuple[str, ...], tuple[str, ...]] = {}
    for key, rows in groupby(reader.rows(device, span), key=lambda row: _bucket(row, step_s)):
        one = merged(list(rows), *key)
        if one.names not in names:
            names[one.names] = tuple(name for name in one.names if wanted(name))
        parts.setdefault(key, []).append(chosen(one, names[one.names]))
    found = [merged(part, *key) for key, part in sorted(parts.items())]
    events, in_all = reader.events(device, span, EVENTS)
    if not found and not events:
        raise NotReady(f"{device}: nothing in that time; kept are {_format_range(held)}")
    return table(device, span, step_s, found, events, in_all)


def table(
    device: str, span: Span, step_s: int, rows: Sequence[Row], events: Sequence[PastEvent], events_in_all: int
) -> Past:
    """Arrange rows as a table.

    Parameters
    ----------
    device
        Name of the device.
    span
        Time range of the table.
    step_s
        Bucket width [s].
    rows
        Rows, ordered by time.
    events
        Events in the time range.
    events_in_all
        Number of events in the time range, including those not in ``events``.
    """
    names = tuple(dict.fromkeys(name for row in rows for name in row.names))
    rows = [chosen(row, names) for row in rows]
    shape = (len(rows), len(names))
    return Past(
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


def step(span: Span, step_s: int | None = None, points: int = DEFAULT_POINTS) -> int:
    """Return the bucket width [s]: the smallest permitted one for this number of points, at least ``step_s``.

    >>> step(Span(0.0, 86_400.0)), step(Span(0.0, 5 * 31_536_000.0)), step(Span(0.0, 3600.0), 900)
    (300, 172800, 900)

    Parameters
    ----------
    span
        Time range.
    step_s
        Minimum bucket width [s].
    points
        Approximate number of buckets.
    """
    least_s = max((span.end_s - span.start_s) / points, step_s or 0)
    return next(
        (one for one in BUCKET_WIDTHS_S if one >= least_s),
        math.ceil(least_s / BUCKET_WIDTHS_S[-1]) * BUCKET_WIDTHS_S[-1],
    )


def bounded(span: Span, held: tuple[float, float]) -> Span:
    """Clip a time range to the stored one, extended by one day, because events may lie outside the rows.

    Parameters
    ----------
    span
        Time range.
    held
        Start and end of the stored rows, Unix time [s].
    """
    start_s, end_s = max(span.start_s, held[0] - 86_400.0), min(span.end_s, held[1] + 86_400.0)
    return replace(span, start_s=min(start_s, end_s), end_s=max(start_s, end_s))


def _bucket(row: Row, step_s: int) -> tuple[int, int]:
    """Return the start and width [s] of the bucket that contains a row."""
    width_s = max(row.width_s, step_s)
    return row.start_s // width_s * width_s, width_s


def _format_range(held: tuple[float, float]) -> str:
    """Format the stored time range for a message."""
    from monitor.history.time_ranges import said

    return f"{said(held[0])} to {said(held[1])} UTC"
