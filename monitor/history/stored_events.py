"""Functions that insert, read and delete the events in a history file.

If a device has more than MAX_EVENTS events, the events are thinned out. Only the first, the last and the most
significant event of each kind, axis and day are kept. If more than half of MAX_EVENTS remain, days are replaced by
months, and then by years. The field ``represented_events`` of the last event includes the number of deleted events.
"""

import math
import sqlite3
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import msgspec

from drivers.validation.number_ranges import DAY_S
from monitor.history.time_ranges import TimeRange

MAX_EVENTS: Final = 20_000
"""Maximum number of events per device."""
THINNING_SPANS_S: Final = (DAY_S, 30 * DAY_S, 365 * DAY_S)
"""Lengths of the periods in which only a few events are kept [s]."""
MAX_TEXT_LENGTH: Final = 2000
_FIELDS: Final = "t, kind, text, axis, what, since, sigma, stands_for"


@dataclass(frozen=True, slots=True)
class StoredEvent:
    """Event of a device in a history file."""

    t_s: float  # Unix time
    kind: str
    text: str
    axis: str | None = None
    what: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    since_s: float | None = None  # Unix time at which the reported condition began
    sigma: float | None = None
    represented_events: int = 1  # number of events that this event represents, including deleted earlier events


def insert_event(db: sqlite3.Connection, device_id: int, event: StoredEvent) -> None:
    """Insert an event into the history file.

    Parameters
    ----------
    db
        Connection to the history file.
    device_id
        Identifier of the device.
    event
        Event to insert.
    """
    text, values = event.text[:MAX_TEXT_LENGTH], _encode_values(event.what)
    fields = (event.t_s, event.kind, text, event.axis, values, event.since_s, event.sigma, event.represented_events)
    db.execute(f"INSERT INTO event (device, {_FIELDS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", (device_id, *fields))


def read_events(
    db: sqlite3.Connection, device_id: int, span: TimeRange, max_events: int
) -> tuple[list[StoredEvent], int]:
    """Return the newest events in a time range in chronological order, and the total number of events.

    Parameters
    ----------
    db
        Connection to the history file.
    device_id
        Identifier of the device.
    span
        Time range.
    max_events
        Maximum number of events to return.
    """
    where = "device = ? AND t >= ? AND t <= ?"
    bounds = (device_id, clamp_to_sqlite_range(span.start_s), clamp_to_sqlite_range(span.end_s))
    found = db.execute(
        f"SELECT {_FIELDS} FROM event WHERE {where} ORDER BY t DESC, id DESC LIMIT ?",
        (*bounds, max_events + 2),  # the time range may exclude events exactly at its ends
    ).fetchall()
    events = [
        StoredEvent(t, kind, text, axis, _decode_values(values), *rest)
        for t, kind, text, axis, values, *rest in found
        if span.contains(t)
    ]
    (count,) = db.execute(f"SELECT count(*) FROM event WHERE {where}", bounds).fetchone()
    return events[:max_events][::-1], max(int(count), len(events[:max_events]))


def count_events(db: sqlite3.Connection, device_id: int) -> int:
    """Return the number of stored events of a device.

    Parameters
    ----------
    db
        Connection to the history file.
    device_id
        Identifier of the device.
    """
    return int(db.execute("SELECT count(*) FROM event WHERE device = ?", (device_id,)).fetchone()[0])


def thin_events(db: sqlite3.Connection, device_id: int, interval_s: int) -> None:
    """Delete all events except the first, last and most significant event of each kind, axis and period.

    Parameters
    ----------
    db
        Connection to the history file.
    device_id
        Identifier of the device.
    interval_s
        Length of the periods [s].
    """
    groups: dict[tuple[Any, ...], list[tuple[Any, ...]]] = {}
    rows = db.execute(
        "SELECT id, t, kind, axis, sigma, stands_for FROM event WHERE device = ? ORDER BY t, id", (device_id,)
    )
    for one in rows:
        groups.setdefault((int(one[1] // interval_s), one[2], one[3]), []).append(one)
    for group in groups.values():
        most_significant = max(group, key=lambda one: -math.inf if one[4] is None else one[4])
        kept = {group[0][0], most_significant[0], group[-1][0]}
        deleted = [one for one in group if one[0] not in kept]
        if deleted:
            db.executemany("DELETE FROM event WHERE id = ?", [(one[0],) for one in deleted])
            more = sum(one[5] for one in deleted)
            db.execute("UPDATE event SET stands_for = stands_for + ? WHERE id = ?", (more, group[-1][0]))


def clamp_to_sqlite_range(t_s: float) -> float:
    """Limit a time to ±1e18 s, so that SQLite can compare it."""
    return max(min(t_s, 1e18), -1e18)


def _encode_values(what: Mapping[str, Mapping[str, float]]) -> str:
    """Encode event values as JSON, with null for NaN. If the JSON text is too long, it is replaced by ``{}``."""
    text = msgspec.json.encode(what).decode()
    return text if len(text) <= MAX_TEXT_LENGTH else "{}"


def _decode_values(text: str) -> dict[str, dict[str, float]]:
    found = msgspec.json.decode(text, type=dict[str, dict[str, float | None]])
    return {
        name: {key: math.nan if one is None else one for key, one in sides.items()} for name, sides in found.items()
    }
