"""What was, as one table: the rows of a span of time in buckets that are wide enough to be few.

``read`` takes rows as they come off the disk and merges those of one bucket at once, so that five years need no more
memory than the points that are asked for. A bucket is never narrower than the rows that are left of its time, and
extremes come through: merging is that of ``row``.
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

POINTS: Final = 1000
"""Of a table, about; at most twice so many where old and new rows differ in width."""
EVENTS: Final = 1000
DAY_S: Final = 86_400
STEPS_S: Final = (
    *(60, 300, 900, 1800, 3600, 10_800, 21_600, 43_200),
    *(days * DAY_S for days in (1, 2, 4, 7, 30, 90, 365)),
)
"""Widths of buckets: multiples of the widths of all rows that are not wider."""


@dataclass(frozen=True, slots=True)
class Past:
    """p buckets of one device by time, k numbers."""

    device: str
    span: Span  # what was asked for, bounded by what there is
    step_s: int  # width of a bucket whose rows are not wider
    start_s: Ints  # [p] Unix time
    width_s: Ints  # [p]
    names: tuple[str, ...]  # [k], see ``numbers``
    n: Ints  # [p, k]
    low: Singles  # [p, k] SI; NaN where there was none
    high: Singles
    last: Singles
    counts: Ints  # [p, 4] of row.COUNTS, within the bucket
    state: Ints  # [p] index of the worst of row.STATES
    events: tuple[PastEvent, ...]  # the newest
    events_in_all: int

    def __len__(self) -> int:
        return int(self.start_s.size)

    @property
    def end_s(self) -> Ints:
        """[p] where each bucket ends."""
        return self.start_s + self.width_s

    def column(self, name: str) -> "Course":
        """One number over time; all missing where there is none of that name."""
        if name not in self.names:
            nothing: Floats = np.full(len(self), np.nan)
            return Course(np.zeros(len(self), np.int64), nothing, nothing, nothing)
        at = self.names.index(name)
        parts = [np.asarray(part[:, at], np.float64) for part in (self.low, self.high, self.last)]
        return Course(self.n[:, at], *parts)

    def axes(self) -> tuple[str, ...]:
        """Those that any number is of."""
        found = dict.fromkeys(name.split(".")[0] for name in self.names if "." in name)
        return tuple(found)

    def taus(self) -> tuple[str, ...]:
        """Averaging times in s, as in the names of deviations."""
        found = {name.split(".sigma.")[1] for name in self.names if ".sigma." in name}
        return tuple(sorted(found, key=float))


@dataclass(frozen=True, slots=True)
class Course:
    """One number over p buckets."""

    n: Ints  # [p] how often it was there
    low: Floats  # [p] NaN where it never was
    high: Floats
    last: Floats


def read(
    reader: Reader,
    device: str,
    span: Span | None,
    wanted: Callable[[str], bool] = lambda _name: True,
    step_s: int | None = None,
    points: int = POINTS,
) -> Past:
    """A table of what is kept of a device.

    Args:
        reader: of the file
        device: its name
        span: None = the last day that there is
        wanted: which numbers, by name
        step_s: buckets at least so wide; None = as narrow as ``points`` allows
        points: in all, about
    Raises:
        NotReady: there is nothing in the span
        RecordingError: a row cannot be read
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
        raise NotReady(f"{device}: nothing in that time; kept are {_said(held)}")
    return table(device, span, step_s, found, events, in_all)


def table(
    device: str, span: Span, step_s: int, rows: Sequence[Row], events: Sequence[PastEvent], events_in_all: int
) -> Past:
    """Rows by time as one table."""
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


def step(span: Span, step_s: int | None = None, points: int = POINTS) -> int:
    """Width of the buckets, s: as narrow as so many points allow, and not narrower than asked for.

    >>> step(Span(0.0, 86_400.0)), step(Span(0.0, 5 * 31_536_000.0)), step(Span(0.0, 3600.0), 900)
    (300, 172800, 900)
    """
    least_s = max((span.end_s - span.start_s) / points, step_s or 0)
    return next((one for one in STEPS_S if one >= least_s), math.ceil(least_s / STEPS_S[-1]) * STEPS_S[-1])


def bounded(span: Span, held: tuple[float, float]) -> Span:
    """The part of a span of which anything can be kept; events may lie a little beyond the rows."""
    start_s, end_s = max(span.start_s, held[0] - 86_400.0), min(span.end_s, held[1] + 86_400.0)
    return replace(span, start_s=min(start_s, end_s), end_s=max(start_s, end_s))


def _bucket(row: Row, step_s: int) -> tuple[int, int]:
    """Start and width of the bucket that a row belongs to."""
    width_s = max(row.width_s, step_s)
    return row.start_s // width_s * width_s, width_s


def _said(held: tuple[float, float]) -> str:
    from monitor.history.time_ranges import said

    return f"{said(held[0])} to {said(held[1])} UTC"
