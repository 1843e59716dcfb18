"""Past results: the reply to ``imu/<device>/history`` and the output of ``history --json``.

All lists are indexed by bucket. For each number, ``value`` is the last value of its bucket, and ``low`` and ``high``
are the extremes. A coefficient also has a status and the interval of its last value. The status is ``upper_bound`` if
the coefficient was bounded but never estimated within the bucket. Numbers are written with nine digits, so that the
decoded float32 values equal the stored values exactly.
"""

from typing import Any, Final, Literal, Self

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats, Ints
from monitor.common import topics
from monitor.estimation.fit.coefficient_values import SYMBOLS, Status
from monitor.history.bucket import COUNTS, STATES
from monitor.history.column_conversion import HEALTH_COLUMNS, TEMPERATURE_COLUMNS
from monitor.history.history_table import MAX_EVENTS, ColumnStatistics, HistoryTable
from monitor.history.query_parameters import COEFFICIENTS, DEVIATIONS, EVENTS, STATUS, HistoryQuery
from monitor.history.stored_events import StoredEvent
from monitor.history.time_ranges import TimeRange
from monitor.publishing.messages.message import Message, decode_message, remove_control_characters, shared_fields

MAX_BUCKETS: Final = 1_000_000
"""Largest number of buckets accepted in a message."""
MAX_HISTORY_BYTES: Final = 1 << 30
STATUS_COLUMNS: Final = (*HEALTH_COLUMNS, *TEMPERATURE_COLUMNS)
_STATUS_NAMES: Final = {status.value: status.name.lower() for status in Status}


class NumberHistory(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Last value, minimum and maximum of a number in each bucket."""

    value: Floats
    low: Floats
    high: Floats

    @classmethod
    def from_column(cls, column: ColumnStatistics) -> Self:
        """Return the history of a stored column."""
        return cls(value=_nine_digits(column.last), low=_nine_digits(column.low), high=_nine_digits(column.high))

    def to_column(self, *shape: int) -> ColumnStatistics:
        """Return the stored column, or several columns for an array of shape [buckets, columns]."""
        low, high, last = (_checked(one, shape) for one in (self.low, self.high, self.value))
        return ColumnStatistics((~np.isnan(last)).astype(np.int64), low, high, last)


class CoefficientHistory(NumberHistory, frozen=True, kw_only=True):
    """Coefficient of one axis over time, with intervals, numbers of estimates and statuses."""

    lo: Floats
    hi: Floats
    n: Ints
    status: list[str]

    @classmethod
    def coefficient_from_history(cls, past: HistoryTable, value_column: str) -> Self:
        """Return the history of a coefficient, given the column of its value, such as gz.N."""
        value, bound = past.column(value_column), past.column(f"{value_column}.bound")
        lo, hi = (past.column(f"{value_column}.{end}") for end in ("lo", "hi"))
        estimated, bounded = value.n > 0, bound.n > 0
        status = np.where(estimated, Status.ESTIMATED, np.where(bounded, Status.UPPER_BOUND, Status.UNESTIMATED))
        only_bounded = bounded & ~estimated
        return cls(
            value=_nine_digits(value.last),
            low=_nine_digits(value.low),
            high=_nine_digits(value.high),
            lo=_nine_digits(np.where(only_bounded, 0.0, lo.last)),
            hi=_nine_digits(np.where(only_bounded, bound.last, hi.last)),
            n=value.n,
            status=[_STATUS_NAMES[one] for one in status.tolist()],
        )

    def coefficient_columns(self, value_column: str, buckets: int) -> dict[str, ColumnStatistics]:
        """Return the stored columns of the coefficient.

        Parameters
        ----------
        value_column
            Name of the column of the value, such as gz.N.
        buckets
            Number of buckets.
        """
        value, n = self.to_column(buckets), _checked(self.n, (buckets,))
        lo, hi = (_checked(one, (buckets,)) for one in (self.lo, self.hi))
        only_bounded = np.array([one == _STATUS_NAMES[Status.UPPER_BOUND] for one in self.status], np.bool_)
        if only_bounded.shape != (buckets,):
            raise ValueError("lists of different lengths")
        return {
            value_column: ColumnStatistics(n, value.low, value.high, value.last),
            f"{value_column}.lo": _column_without_extremes(np.where(only_bounded, np.nan, lo)),
            f"{value_column}.hi": _column_without_extremes(np.where(only_bounded, np.nan, hi)),
            f"{value_column}.bound": _column_without_extremes(np.where(only_bounded, hi, np.nan)),
        }


class DeviationHistory(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Deviations of all axes over time. The arrays of each axis have the shape [buckets, τ]."""

    tau: list[float]
    axes: dict[str, NumberHistory]

    @classmethod
    def deviations_from_history(cls, past: HistoryTable, axes: tuple[str, ...]) -> Self:
        """Return the stored deviations of the given axes."""
        taus, found = past.taus(), {}
        for axis in axes:
            columns = [past.column(f"{axis}.sigma.{tau}") for tau in taus]
            if any(one.n.any() for one in columns):
                n, low, high, last = (
                    np.column_stack([getattr(one, part) for one in columns]) for part in ("n", "low", "high", "last")
                )
                found[axis] = NumberHistory.from_column(ColumnStatistics(n, low, high, last))
        return cls(tau=[float(tau) for tau in taus], axes=found)

    def deviation_columns(self, buckets: int) -> dict[str, ColumnStatistics]:
        """Return the stored columns of all axes."""
        columns = {}
        for axis in (axis for axis in self.axes if axis in AXES):
            one = self.axes[axis].to_column(buckets, len(self.tau))
            for i, tau in enumerate(self.tau):
                columns[f"{axis}.sigma.{tau:g}"] = ColumnStatistics(
                    one.n[:, i], one.low[:, i], one.high[:, i], one.last[:, i]
                )
        return columns


class StatusHistory(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """State and sample counters of the device over time."""

    state: list[Literal["ended", "running", "waiting", "lost"]]
    received: Ints
    lost: Ints
    bad: Ints
    overflowed: Ints
    rate: NumberHistory | UnsetType | None = UNSET
    latency: NumberHistory | UnsetType | None = UNSET
    memory: NumberHistory | UnsetType | None = UNSET
    temperature: NumberHistory | UnsetType | None = UNSET

    @classmethod
    def status_from_history(cls, past: HistoryTable) -> Self:
        """Return the stored states, counters and numbers."""
        counts: dict[str, Any] = {name: past.counts[:, i] for i, name in enumerate(COUNTS)}
        numbers: dict[str, Any] = {
            name: NumberHistory.from_column(past.column(name)) for name in STATUS_COLUMNS if name in past.names
        }
        return cls(state=[STATES[one] for one in past.state.tolist()], **counts, **numbers)

    def status_columns(self, buckets: int) -> dict[str, ColumnStatistics]:
        """Return the stored columns of the numbers."""
        numbers = {name: getattr(self, name) for name in STATUS_COLUMNS}
        return {name: one.to_column(buckets) for name, one in numbers.items() if isinstance(one, NumberHistory)}


class PastEvent(
    msgspec.Struct,
    frozen=True,
    kw_only=True,
    rename={"t_s": "t", "since_s": "since", "represented_events": "stands_for"},
):
    """Stored event of the device.

    ``stands_for`` is the number of events that the entry represents, because older events of the same kind are deleted.
    """

    t_s: float
    kind: str
    axis: str | None = None
    what: dict[str, dict[str, float | None]] = {}
    since_s: float | None = None
    sigma: float | None = None
    text: str
    represented_events: int = 1

    @classmethod
    def from_stored_event(cls, event: StoredEvent) -> Self:
        """Return a stored event."""
        return cls(**shared_fields(cls, event) | {"what": {name: dict(sides) for name, sides in event.what.items()}})

    def to_event(self) -> StoredEvent:
        """Return the stored event, without control characters in its texts."""
        what = {
            name: {side: np.nan if one is None else one for side, one in sides.items()}
            for name, sides in self.what.items()
        }
        known = {name: getattr(self, name) for name in self.__struct_fields__} | {
            "kind": remove_control_characters(self.kind),
            "text": remove_control_characters(self.text),
            "axis": self.axis if self.axis in AXES else None,
            "what": what,
        }
        return StoredEvent(**known)


class HistoryMessage(Message, frozen=True, kw_only=True, tag=topics.HISTORY.schema_name()):
    """Message ``imu/<device>/history``. Parts that were not requested are absent."""

    topic = topics.HISTORY
    from_: float = msgspec.field(name="from")
    to: float
    step: int
    start: Ints
    width: Ints
    axes: dict[str, dict[str, CoefficientHistory]] | UnsetType | None = UNSET
    deviations: DeviationHistory | UnsetType | None = UNSET
    status: StatusHistory | UnsetType | None = UNSET
    events: list[PastEvent] | UnsetType | None = UNSET
    events_in_all: int | UnsetType = UNSET

    @classmethod
    def reply(cls, past: HistoryTable, query: HistoryQuery, t: float, samples: int) -> Self:
        """Build the reply to a query.

        Parameters
        ----------
        past
            The stored results.
        query
            The query.
        t
            Unix time of the newest sample [s].
        samples
            Number of samples since the start of the device.
        """
        axes = {
            axis: {
                symbol: CoefficientHistory.coefficient_from_history(past, f"{axis}.{symbol}")
                for symbol in query.symbols
            }
            for axis in query.axes
            if axis in past.axes()
        }
        return cls(
            device=past.device,
            t=t,
            samples=samples,
            from_=past.span.start_s,
            to=past.span.end_s,
            step=past.step_s,
            start=past.start_s,
            width=past.width_s,
            axes=axes if COEFFICIENTS in query.what else UNSET,
            deviations=DeviationHistory.deviations_from_history(past, query.axes)
            if DEVIATIONS in query.what
            else UNSET,
            status=StatusHistory.status_from_history(past) if STATUS in query.what else UNSET,
            events=[PastEvent.from_stored_event(one) for one in past.events] if EVENTS in query.what else UNSET,
            events_in_all=past.events_in_all if EVENTS in query.what else UNSET,
        )

    def to_table(self) -> HistoryTable:
        """Return the history as a table.

        Raises
        ------
        ValueError
            If the lists have different lengths, or if there are more than MAX_BUCKETS buckets.
        """
        buckets = self.start.size
        if self.width.shape != (buckets,) or buckets > MAX_BUCKETS:
            raise ValueError(f"the lists do not have one length of at most {MAX_BUCKETS:,} buckets")
        columns: dict[str, ColumnStatistics] = {}
        for axis, coefficients in (self.axes or {}).items():
            for symbol, one in coefficients.items():
                if axis in AXES and symbol in SYMBOLS:
                    columns |= one.coefficient_columns(f"{axis}.{symbol}", buckets)
        if self.deviations:
            columns |= self.deviations.deviation_columns(buckets)
        counts, state = np.zeros((buckets, len(COUNTS)), np.int64), np.full(buckets, STATES.index("running"))
        if self.status:
            columns |= self.status.status_columns(buckets)
            counts = np.column_stack([_checked(getattr(self.status, name), (buckets,)) for name in COUNTS])
            state = _checked(np.array([STATES.index(one) for one in self.status.state], np.int64), (buckets,))
        with np.errstate(over="ignore"):  # a value beyond the range of float32 becomes infinite
            low, high, last = (
                np.array([getattr(one, part) for one in columns.values()]).reshape(-1, buckets).T.astype(np.float32)
                for part in ("low", "high", "last")
            )
        return HistoryTable(
            remove_control_characters(self.device),
            TimeRange(self.from_, self.to),
            self.step,
            self.start,
            self.width,
            tuple(columns),
            np.array([one.n for one in columns.values()], np.int64).reshape(len(columns), buckets).T,
            low,
            high,
            last,
            counts,
            state,
            tuple(one.to_event() for one in (self.events or [])[:MAX_EVENTS]),
            self.events_in_all or 0,
        )


def decode_history(payload: bytes) -> HistoryTable:
    """Decode the reply to a history query.

    Raises
    ------
    ValueError
        If the payload is not a history message.
    """
    return decode_message(HistoryMessage, payload, MAX_HISTORY_BYTES).to_table()


def _column_without_extremes(last: Floats) -> ColumnStatistics:
    """Return a column for which only last values are stored; they also serve as extremes."""
    return ColumnStatistics((~np.isnan(last)).astype(np.int64), last, last, last)


def _nine_digits(column: Floats) -> Floats:
    """Return values rounded to nine digits, which identify every float32."""
    return np.array([float(f"{one:.9g}") for one in column.ravel().tolist()]).reshape(column.shape)


def _checked(array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return the array in the expected shape. An empty array is accepted if there are no buckets."""
    if array.shape != shape and (array.size or 0 not in shape):
        raise ValueError("lists of different lengths")
    return array.reshape(shape)
