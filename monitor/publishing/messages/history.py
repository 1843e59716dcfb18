"""Encoding and decoding of past results: the JSON of ``imu/<device>/history`` and ``history --json``.

All lists are indexed by bucket. For each number, ``value`` is the last value of its bucket, and ``low`` and ``high``
are the extremes. A coefficient also has the interval of its last value and its status. The status is ``upper_bound``
if the value was bounded and never estimated within the bucket. NaN becomes null. Stored values have seven digits.
Nine are written, so that the decoded float32 values equal the stored ones exactly.
"""

from collections.abc import Sequence
from typing import Any, Final, Literal

import msgspec
import numpy as np

from drivers.sample import AXES, Floats
from monitor.common import topics
from monitor.estimation.fit.coefficients import SYMBOLS, Status
from monitor.history.bucket import COUNTS, STATES, Singles
from monitor.history.columns import HEALTH_COLUMNS, TEMPERATURE_COLUMNS
from monitor.history.query import COEFFICIENTS, DEVIATIONS, EVENTS, STATUS, HistoryQuery
from monitor.history.reading import MAX_EVENTS as EVENTS_AT_MOST
from monitor.history.reading import ColumnStatistics, HistoryTable
from monitor.history.sqlite_store import StoredEvent
from monitor.history.time_ranges import TimeRange

MAX_BUCKETS: Final = 1_000_000
"""Largest number of buckets accepted in a message."""
Numbers = list[float | None]
State = Literal["ended", "running", "waiting", "lost"]
_ENCODER: Final = msgspec.json.Encoder()
_STATUSES: Final = {status: status.name.lower() for status in Status}


class Number(msgspec.Struct, frozen=True, kw_only=True):
    """Number over time: last value, minimum and maximum of each bucket."""

    value: Numbers
    low: Numbers
    high: Numbers


class CoefficientHistory(Number, frozen=True, kw_only=True):
    """Coefficient of one axis over time, with interval, count and status."""

    lo: Numbers
    hi: Numbers
    n: list[int]
    status: list[str]


class Deviation(msgspec.Struct, frozen=True, kw_only=True):
    """Deviations of one axis: a list by bucket, each a list by τ."""

    value: list[Numbers]
    low: list[Numbers]
    high: list[Numbers]


class Deviations(msgspec.Struct, frozen=True, kw_only=True):
    """Deviations of all axes and their averaging times [s]."""

    tau: list[float]
    axes: dict[str, Deviation]


class StatusHistory(msgspec.Struct, frozen=True, kw_only=True):
    """State and counters of the device over time."""

    state: list[State]
    received: list[int]
    lost: list[int]
    bad: list[int]
    overflowed: list[int]
    rate: Number | None = None
    latency: Number | None = None
    memory: Number | None = None
    temperature: Number | None = None


class EventMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Event of the device."""

    t: float
    kind: str
    text: str
    axis: str | None = None
    what: dict[str, dict[str, float | None]] = {}
    since: float | None = None
    sigma: float | None = None
    stands_for: int = 1


class HistoryMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Message ``imu/<device>/history``."""

    schema: str
    device: str
    t: float
    samples: int
    from_: float = msgspec.field(name="from")
    to: float
    step: int
    start: list[int]
    width: list[int]
    axes: dict[str, dict[str, CoefficientHistory]] | None = None
    deviations: Deviations | None = None
    status: StatusHistory | None = None
    events: list[EventMessage] | None = None
    events_in_all: int = 0


def encode_history(past: HistoryTable, asked: HistoryQuery, unix_s: float, samples: int) -> bytes:
    """Encode the reply to a history query.

    Parameters
    ----------
    past
        The stored results.
    asked
        The query.
    unix_s
        Unix time of the newest sample [s].
    samples
        Number of samples since the start of the device.
    """
    payload: dict[str, Any] = {
        "schema": topics.HISTORY.schema(),
        "device": past.device,
        "t": unix_s,
        "samples": samples,
        "from": past.span.start_s,
        "to": past.span.end_s,
        "step": past.step_s,
        "start": past.start_s.tolist(),
        "width": past.width_s.tolist(),
    }
    if COEFFICIENTS in asked.what:
        shown = [axis for axis in asked.axes if axis in past.axes()]
        payload["axes"] = {axis: {letter: _letter(past, axis, letter) for letter in asked.letters} for axis in shown}
    if DEVIATIONS in asked.what:
        payload["deviations"] = _deviations(past, asked.axes)
    if STATUS in asked.what:
        payload["status"] = {
            "state": [STATES[one] for one in past.state.tolist()],
            **{name: past.counts[:, i].tolist() for i, name in enumerate(COUNTS)},
            **{
                name: _number(past.column(name))
                for name in (*HEALTH_COLUMNS, *TEMPERATURE_COLUMNS)
                if name in past.names
            },
        }
    if EVENTS in asked.what:
        payload["events"] = [_event(one) for one in past.events]
        payload["events_in_all"] = past.events_in_all
    return _ENCODER.encode(payload)


def decode_history(payload: bytes) -> HistoryTable:
    """Decode a history message.

    Raises
    ------
    ValueError
        The payload is not a history message.
    """
    said = msgspec.json.decode(payload, type=HistoryMessage)
    p = len(said.start)
    if said.schema != topics.HISTORY.schema() or len(said.width) != p or p > MAX_BUCKETS:
        raise ValueError("not an answer of a history")
    columns: dict[str, ColumnStatistics] = {}
    for axis, letters in (said.axes or {}).items():
        for letter, one in letters.items():
            if axis in AXES and letter in SYMBOLS:
                columns |= _letter_columns(f"{axis}.{letter}", one, p)
    if said.deviations is not None:
        columns |= _deviation_columns(said.deviations, p)
    counts = np.zeros((p, len(COUNTS)), np.int64)
    state = np.full(p, STATES.index("running"))
    if said.status is not None:
        counts = np.column_stack([_integers(getattr(said.status, name), p) for name in COUNTS]).reshape(p, len(COUNTS))
        state = _integers([STATES.index(one) for one in said.status.state], p)
        for name in (*HEALTH_COLUMNS, *TEMPERATURE_COLUMNS):
            number = getattr(said.status, name)
            if number is not None:
                columns[name] = _course(number, p)
    names = tuple(columns)
    low, high, last = (
        _singles([getattr(one, part) for one in columns.values()], p) for part in ("low", "high", "last")
    )
    return HistoryTable(
        clean(said.device),
        TimeRange(said.from_, said.to),
        said.step,
        _integers(said.start, p),
        _integers(said.width, p),
        names,
        np.array([one.n for one in columns.values()], np.int64).reshape(len(columns), p).T,
        low,
        high,
        last,
        counts,
        state,
        tuple(_read_event(one) for one in (said.events or [])[:EVENTS_AT_MOST]),
        said.events_in_all,
    )


def _letter(past: HistoryTable, axis: str, letter: str) -> dict[str, Any]:
    """Encode one coefficient of one axis."""
    value, bound = past.column(f"{axis}.{letter}"), past.column(f"{axis}.{letter}.bound")
    lo, hi = (past.column(f"{axis}.{letter}.{end}") for end in ("lo", "hi"))
    estimated, bounded = value.n > 0, bound.n > 0
    status = np.where(estimated, Status.ESTIMATED, np.where(bounded, Status.UPPER_BOUND, Status.UNESTIMATED))
    only = bounded & ~estimated
    return {
        **_number(value),
        "lo": _list(np.where(only, 0.0, lo.last)),
        "hi": _list(np.where(only, bound.last, hi.last)),
        "n": value.n.tolist(),
        "status": [_STATUSES[Status(one)] for one in status.tolist()],
    }


def _letter_columns(name: str, one: CoefficientHistory, p: int) -> dict[str, ColumnStatistics]:
    """Return the stored columns of one decoded coefficient."""
    n = _integers(one.n, p)
    value, lo, hi = _course(one, p), _floats(one.lo, p), _floats(one.hi, p)
    if len(one.status) != p:
        raise ValueError("lists of different lengths")
    only = np.array([status == _STATUSES[Status.UPPER_BOUND] for status in one.status], np.bool_)
    missing = np.full(p, np.nan)
    return {
        name: ColumnStatistics(n, value.low, value.high, value.last),
        f"{name}.lo": _column_without_extremes(np.where(only, missing, lo)),
        f"{name}.hi": _column_without_extremes(np.where(only, missing, hi)),
        f"{name}.bound": _column_without_extremes(np.where(only, hi, missing)),
    }


def _deviations(past: HistoryTable, axes: Sequence[str]) -> dict[str, Any]:
    """Encode the deviations of the given axes."""
    taus = past.taus()
    found: dict[str, Any] = {}
    for axis in axes:
        columns = [past.column(f"{axis}.sigma.{tau}") for tau in taus]
        if any(one.n.any() for one in columns):
            found[axis] = {
                name: [_list(row) for row in np.column_stack([getattr(one, part) for one in columns])]
                for name, part in (("value", "last"), ("low", "low"), ("high", "high"))
            }
    return {"tau": [float(tau) for tau in taus], "axes": found}


def _deviation_columns(said: Deviations, p: int) -> dict[str, ColumnStatistics]:
    """Return the stored columns of the decoded deviations."""
    columns = {}
    for axis, one in said.axes.items():
        if axis not in AXES:
            continue
        value, low, high = (_two_dimensional(part, p, len(said.tau)) for part in (one.value, one.low, one.high))
        for i, tau in enumerate(said.tau):
            columns[f"{axis}.sigma.{tau:g}"] = ColumnStatistics(
                np.isfinite(value[:, i]) * 1, low[:, i], high[:, i], value[:, i]
            )
    return columns


def _number(course: ColumnStatistics) -> dict[str, Numbers]:
    """Encode a number over time."""
    return {"value": _list(course.last), "low": _list(course.low), "high": _list(course.high)}


def _course(number: Number, p: int) -> ColumnStatistics:
    """Return the stored column of a decoded number."""
    low, high, last = (_floats(one, p) for one in (number.low, number.high, number.value))
    return ColumnStatistics((~np.isnan(last)).astype(np.int64), low, high, last)


def _column_without_extremes(last: Floats) -> ColumnStatistics:
    """Return a column whose extremes equal its last values."""
    return ColumnStatistics((~np.isnan(last)).astype(np.int64), last, last, last)


def _event(event: StoredEvent) -> dict[str, Any]:
    """Encode an event."""
    return {
        "t": event.t_s,
        "kind": event.kind,
        "axis": event.axis,
        "what": event.what,
        "since": event.since_s,
        "sigma": event.sigma,
        "text": event.text,
        "stands_for": event.represented_events,
    }


def _read_event(said: EventMessage) -> StoredEvent:
    """Return the stored form of a decoded event."""
    what = {
        name: {key: np.nan if one is None else one for key, one in sides.items()} for name, sides in said.what.items()
    }
    axis = said.axis if said.axis in AXES else None
    return StoredEvent(said.t, clean(said.kind), clean(said.text), axis, what, said.since, said.sigma, said.stands_for)


def _list(column: Floats) -> Numbers:
    """Return values with nine digits, which represent every float32 exactly."""
    return [float(f"{one:.9g}") for one in column.tolist()]


def _floats(numbers: Numbers, p: int) -> Floats:
    """Return ``p`` numbers as an array; null becomes NaN."""
    found = np.array([np.nan if one is None else one for one in numbers], np.float64)
    if found.shape != (p,):
        raise ValueError("lists of different lengths")
    return found


def _two_dimensional(rows: Sequence[Numbers], p: int, m: int) -> Floats:
    """Return lists of numbers as an array of shape [p, m]."""
    if len(rows) != p:
        raise ValueError("lists of different lengths")
    return np.array([_floats(row, m) for row in rows]).reshape(p, m)


def _singles(columns: Sequence[Floats], p: int) -> Singles:
    """Return k columns of length p as a float32 array of shape [p, k]."""
    with np.errstate(over="ignore"):  # values outside the float32 range, which no sensor produces, become infinite
        return np.array(columns, np.float64).reshape(len(columns), p).T.astype(np.float32)


def _integers(numbers: Sequence[int], p: int) -> "np.ndarray[tuple[int], np.dtype[np.int64]]":
    """Return ``p`` integers as an array."""
    try:
        found = np.array(numbers, np.int64)
    except OverflowError as error:
        raise ValueError("a number beyond all bounds") from error
    if found.shape != (p,):
        raise ValueError("lists of different lengths")
    return found


def clean(text: str) -> str:
    """Replace control characters by spaces, because the text is shown on a terminal."""
    return "".join(one if one.isprintable() else " " for one in text)
