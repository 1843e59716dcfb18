"""Stored results as JSON, for the zenoh reply ``imu/<device>/history`` and for ``history --json``.

A history divides time into intervals, which are called buckets. Each list has one element per bucket. For each
quantity, ``value`` is the last value in a bucket, and ``low`` and ``high`` are the smallest and the largest value. The
status of a coefficient is ``upper_bound`` if the bucket contains upper bounds but no estimates. Numbers are written
with nine digits, which preserve every float32 value exactly.
"""

from typing import Any, Final, Literal, Self

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats, Ints
from monitor.common import topics
from monitor.common.control_characters import remove_control_characters
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.history.bucketed_history import MAX_EVENTS, ColumnStatistics, HistoryTable
from monitor.history.history_row import COUNTS, STATES
from monitor.history.minute_aggregation import HEALTH_COLUMNS, TEMPERATURE_COLUMNS
from monitor.history.query_parameters import COEFFICIENTS, DEVIATIONS, EVENTS, STATUS, HistoryQuery
from monitor.history.stored_events import StoredEvent
from monitor.history.time_ranges import TimeRange
from monitor.publishing.messages.message import (
    Message,
    attributes_with_field_names,
    decode_message,
)

MAX_BUCKETS: Final = 1_000_000
"""Largest accepted number of time buckets in a message."""
MAX_HISTORY_BYTES: Final = 1 << 30
STATUS_COLUMNS: Final = (*HEALTH_COLUMNS, *TEMPERATURE_COLUMNS)
_STATUS_NAMES: Final = {status.value: status.name.lower() for status in Status}


class MinMaxLastHistory(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Last value, minimum and maximum of a quantity in each time bucket."""

    value: Floats
    low: Floats
    high: Floats

    @classmethod
    def from_column(cls, column: ColumnStatistics) -> Self:
        """Build the history of a quantity from the stored statistics."""
        return cls(value=_nine_digits(column.last), low=_nine_digits(column.low), high=_nine_digits(column.high))

    def to_column(self, *shape: int) -> ColumnStatistics:
        """Return the statistics of one quantity, or of several quantities if the shape is [buckets, columns]."""
        low, high, last = (_checked(one, shape) for one in (self.low, self.high, self.value))
        return ColumnStatistics((~np.isnan(last)).astype(np.int64), low, high, last)


class CoefficientHistory(MinMaxLastHistory, frozen=True, kw_only=True):
    """History of one noise coefficient with 95 % intervals, numbers of estimates and statuses."""

    lo: Floats
    hi: Floats
    n: Ints
    status: list[str]

    @classmethod
    def coefficient_from_history(cls, past: HistoryTable, value_column: str) -> Self:
        """Build the history of the coefficient whose values are stored in the given column, such as gz.N."""
        value, bound = past.select_column(value_column), past.select_column(f"{value_column}.bound")
        lo, hi = (past.select_column(f"{value_column}.{end}") for end in ("lo", "hi"))
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

    def stored_columns_of_coefficient(self, value_column: str, bucket_count: int) -> dict[str, ColumnStatistics]:
        """Return the stored columns of the coefficient by name.

        Parameters
        ----------
        value_column
            Name of the column that contains the values, such as gz.N.
        bucket_count
            Number of time buckets.
        """
        value, n = self.to_column(bucket_count), _checked(self.n, (bucket_count,))
        lo, hi = (_checked(one, (bucket_count,)) for one in (self.lo, self.hi))
        only_bounded = np.array([one == _STATUS_NAMES[Status.UPPER_BOUND] for one in self.status], np.bool_)
        if only_bounded.shape != (bucket_count,):
            raise ValueError("lists of different lengths")
        return {
            value_column: ColumnStatistics(n, value.low, value.high, value.last),
            f"{value_column}.lo": _column_without_extremes(np.where(only_bounded, np.nan, lo)),
            f"{value_column}.hi": _column_without_extremes(np.where(only_bounded, np.nan, hi)),
            f"{value_column}.bound": _column_without_extremes(np.where(only_bounded, hi, np.nan)),
        }


class DeviationHistory(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """History of Allan deviations, with arrays of shape [buckets, τ] for each axis."""

    tau: list[float]
    axes: dict[str, MinMaxLastHistory]

    @classmethod
    def deviations_from_history(cls, past: HistoryTable, axes: tuple[str, ...]) -> Self:
        """Build the history of the Allan deviations of the given axes."""
        taus, found = past.list_tau_labels(), {}
        for axis in axes:
            columns = [past.select_column(f"{axis}.sigma.{tau}") for tau in taus]
            if any(one.n.any() for one in columns):
                n, low, high, last = (
                    np.column_stack([getattr(one, part) for one in columns]) for part in ("n", "low", "high", "last")
                )
                found[axis] = MinMaxLastHistory.from_column(ColumnStatistics(n, low, high, last))
        return cls(tau=[float(tau) for tau in taus], axes=found)

    def deviation_columns(self, bucket_count: int) -> dict[str, ColumnStatistics]:
        """Return the stored columns of the Allan deviations by name."""
        columns = {}
        for axis in (axis for axis in self.axes if axis in AXES):
            one = self.axes[axis].to_column(bucket_count, len(self.tau))
            for i, tau in enumerate(self.tau):
                columns[f"{axis}.sigma.{tau:g}"] = ColumnStatistics(
                    one.n[:, i], one.low[:, i], one.high[:, i], one.last[:, i]
                )
        return columns


class DeviceStatusHistory(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """History of the state, the sample counters and the temperature of a device."""

    state: list[Literal["ended", "running", "waiting", "lost"]]
    received: Ints
    lost: Ints
    bad: Ints
    overflowed: Ints
    rate: MinMaxLastHistory | UnsetType | None = UNSET
    latency: MinMaxLastHistory | UnsetType | None = UNSET
    memory: MinMaxLastHistory | UnsetType | None = UNSET
    temperature: MinMaxLastHistory | UnsetType | None = UNSET

    @classmethod
    def status_from_history(cls, past: HistoryTable) -> Self:
        """Build the history of states, sample counters and temperature."""
        counts: dict[str, Any] = {name: past.counts[:, i] for i, name in enumerate(COUNTS)}
        numbers: dict[str, Any] = {
            name: MinMaxLastHistory.from_column(past.select_column(name))
            for name in STATUS_COLUMNS
            if name in past.names
        }
        return cls(state=[STATES[one] for one in past.state.tolist()], **counts, **numbers)

    def device_status_columns(self, bucket_count: int) -> dict[str, ColumnStatistics]:
        """Return the stored columns of rate, latency, memory and temperature by name."""
        numbers = {name: getattr(self, name) for name in STATUS_COLUMNS}
        return {
            name: one.to_column(bucket_count) for name, one in numbers.items() if isinstance(one, MinMaxLastHistory)
        }


class PastEvent(
    msgspec.Struct,
    frozen=True,
    kw_only=True,
    rename={"t_s": "t", "since_s": "since", "represented_events": "stands_for"},
):
    """Stored event of a device. ``represented_events`` counts this event and deleted events of the same kind."""

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
        """Build the entry of a history message from a stored event."""
        return cls(
            **attributes_with_field_names(cls, event)
            | {"what": {name: dict(sides) for name, sides in event.what.items()}}
        )

    def to_event(self) -> StoredEvent:
        """Convert the entry to a stored event, and remove control characters from all texts."""
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
    """Message ``imu/<device>/history`` with stored results. It contains only the requested parts."""

    topic = topics.HISTORY
    from_: float = msgspec.field(name="from")
    to: float
    step: int
    start: Ints
    width: Ints
    axes: dict[str, dict[str, CoefficientHistory]] | UnsetType | None = UNSET
    deviations: DeviationHistory | UnsetType | None = UNSET
    status: DeviceStatusHistory | UnsetType | None = UNSET
    events: list[PastEvent] | UnsetType | None = UNSET
    events_in_all: int | UnsetType = UNSET

    @classmethod
    def build_reply(cls, past: HistoryTable, query: HistoryQuery, t: float, samples: int) -> Self:
        """Build the reply to a history query.

        Parameters
        ----------
        past
            Stored results that the reply contains.
        query
            Parameters of the history query.
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
            if axis in past.list_axes()
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
            status=DeviceStatusHistory.status_from_history(past) if STATUS in query.what else UNSET,
            events=[PastEvent.from_stored_event(one) for one in past.events] if EVENTS in query.what else UNSET,
            events_in_all=past.events_in_all if EVENTS in query.what else UNSET,
        )

    def to_table(self) -> HistoryTable:
        """Convert the message to a table of stored results.

        Raises
        ------
        ValueError
            If the lists have different lengths, or if the number of buckets exceeds MAX_BUCKETS.
        """
        buckets = self.start.size
        if self.width.shape != (buckets,) or buckets > MAX_BUCKETS:
            raise ValueError(f"the lists do not have one length of at most {MAX_BUCKETS:,} buckets")
        columns: dict[str, ColumnStatistics] = {}
        for axis, coefficients in (self.axes or {}).items():
            for symbol, one in coefficients.items():
                if axis in AXES and symbol in SYMBOLS:
                    columns |= one.stored_columns_of_coefficient(f"{axis}.{symbol}", buckets)
        if self.deviations:
            columns |= self.deviations.deviation_columns(buckets)
        counts, state = np.zeros((buckets, len(COUNTS)), np.int64), np.full(buckets, STATES.index("running"))
        if self.status:
            columns |= self.status.device_status_columns(buckets)
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
    return ColumnStatistics((~np.isnan(last)).astype(np.int64), last, last, last)


def _nine_digits(column: Floats) -> Floats:
    """Round values to nine significant digits, which distinguish all float32 values."""
    return np.array([float(f"{one:.9g}") for one in column.ravel().tolist()]).reshape(column.shape)


def _checked(array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return the array if it has the expected shape. Accept any empty array if there are no buckets."""
    if array.shape != shape and (array.size or 0 not in shape):
        raise ValueError("lists of different lengths")
    return array.reshape(shape)
