"""Outputs of the daemon: zenoh messages, viewer, history file, log lines and the table in the terminal. None blocks.

The parameters of all methods are described in ``monitor.daemon.output.Output``. The messages and drawings of each kind
of result are listed in ``monitor.publishing.result_kinds``.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import structlog

from drivers.sample import Event, Ints, SampleBlock
from drivers.zenoh.sample_message import encode_samples
from monitor.common import topics
from monitor.common.health import Health
from monitor.daemon.output import Output
from monitor.estimation.detection.model_gap import ModelGap
from monitor.estimation.estimate import Estimate
from monitor.history.minute_aggregation import MinuteAggregator
from monitor.history.stored_events import StoredEvent
from monitor.history.writer import HistoryWriter
from monitor.publishing.messages.message import Message
from monitor.publishing.messages.results import (
    CoefficientsMessage,
    EventMessage,
    GapMessage,
    StatusMessage,
    event_start_s,
)
from monitor.publishing.remote_devices import DeviceStates
from monitor.publishing.result_kinds import CompensatedRows, SampleRows, kind_of
from monitor.publishing.zenoh.publisher import ZenohPublisher

if TYPE_CHECKING:
    from monitor.publishing.rerun.view import RerunView

PREFIX: Final = "imu"
"""First part of the keys under which the table in the terminal receives its messages."""
_log = structlog.get_logger("imu-monitor")


class ZenohOutput(Output):
    """Output that publishes the results as zenoh messages."""

    def __init__(self, zenoh: ZenohPublisher) -> None:
        self._zenoh = zenoh

    def publish_samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Publish a block as one msgpack batch."""
        self._zenoh.put(topics.SAMPLES, device, encode_samples(device, received, samples, offset_ns))

    def publish_compensated_samples(
        self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int
    ) -> None:
        """Publish a block of compensated samples as one msgpack batch."""
        schema = topics.COMPENSATED.schema()
        self._zenoh.put(topics.COMPENSATED, device, encode_samples(device, received, samples, offset_ns, schema))

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Publish the messages of a result."""
        self._publish(device, unix_s, received, result)

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Publish an event."""
        self._publish(device, unix_s, received, event)

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Publish the status."""
        self._publish(device, unix_s, health.received, health)

    def _publish(self, device: str, unix_s: float | None, received: int, result: Any) -> None:
        """Publish the messages of a result."""
        for message in kind_of(result).messages:
            self._zenoh.put(message.topic, device, message.of(device, unix_s, received, result).encode())


class ViewerOutput(Output):
    """Output that shows the results in the Rerun viewer."""

    def __init__(self, view: "RerunView") -> None:
        self._view = view

    def publish_samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Show samples."""
        unix_s = (samples.t_ns + offset_ns) / 1e9
        self._view.put(device, float(unix_s[-1]), SampleRows(unix_s, samples.values, samples.temperature_c))

    def publish_compensated_samples(
        self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int
    ) -> None:
        """Show compensated rates together with the measured rates."""
        unix_s = (samples.t_ns + offset_ns) / 1e9
        self._view.put(device, float(unix_s[-1]), CompensatedRows(unix_s, samples.values[:, :3]))

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Show a result in the panels of its kind."""
        self._view.put(device, unix_s, result)

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Show an event as one line of the log."""
        self._view.put(device, unix_s, event)

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Show the status, once the time of the first sample is known, because the viewer has a single time axis."""
        if unix_s is not None:
            self._view.put(device, unix_s, health)


class HistoryOutput(Output):
    """Output that aggregates the results by the minute, and passes them with the events to the history file.

    Parameters
    ----------
    writer : HistoryWriter
        Writer of the history file.
    """

    def __init__(self, writer: HistoryWriter) -> None:
        self.received: dict[str, int] = {}  # number of samples of each device since the start
        self._writer = writer
        self._minutes: dict[str, MinuteAggregator] = {}

    def publish_samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Aggregate the temperature of the samples."""
        unix_s = float((samples.t_ns + offset_ns)[-1]) / 1e9
        self._writer.put_row(device, self._minutes_of(device).add_temperature(unix_s, samples.temperature_c))

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Aggregate the coefficients of an estimate, and its deviations on a coarse grid."""
        if isinstance(result, Estimate):
            self._writer.put_row(device, self._minutes_of(device).add_estimate(unix_s, result))

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Store an event."""
        # SQLite does not accept NumPy scalars, so they are converted to plain numbers
        what = {name: {side: float(one) for side, one in sides.items()} for name, sides in event.values.items()}
        sigma, since_s = None if event.sigma is None else float(event.sigma), event_start_s(unix_s, event)
        self._writer.put_event(device, StoredEvent(unix_s, event.kind, event.text, event.axis, what, since_s, sigma))

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Aggregate counts and state, once the time of the first sample is known."""
        self.received[device] = health.received
        if unix_s is not None:
            self._writer.put_row(device, self._minutes_of(device).add_health(unix_s, health))

    def remove_device(self, device: str) -> None:
        """Store the last minute of a device that was removed."""
        self.received.pop(device, None)
        minutes = self._minutes.pop(device, None)
        if minutes is not None:
            self._writer.put_row(device, minutes.flush())

    def store_incomplete_minutes(self) -> None:
        """Store the present, incomplete minutes of all devices."""
        for device, minutes in self._minutes.items():
            self._writer.put_row(device, minutes.flush())

    def _minutes_of(self, device: str) -> MinuteAggregator:
        """Return the aggregation of a device."""
        return self._minutes.setdefault(device, MinuteAggregator())


class LogOutput(Output):
    """Output that writes events and changes of state as log lines."""

    def __init__(self) -> None:
        self._last_status: dict[str, tuple[str, str]] = {}

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Write one line for an event."""
        _log.info(event.kind, device=device, axis=event.axis, text=event.text)

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Write a line if the state or its message has changed."""
        now = (health.state, health.text)
        if self._last_status.get(device) != now:
            self._last_status[device] = now
            write = _log.info if health.state in ("running", "ended") and not health.text else _log.warning
            write("status", device=device, state=health.state, text=health.text, received=health.received)

    def remove_device(self, device: str) -> None:
        """Forget the state of a removed device, so that it is logged if the device is added again."""
        self._last_status.pop(device, None)


class TableOutput(Output):
    """Output for the table in the terminal. ``watch`` shows the same table for other processes.

    Parameters
    ----------
    states : DeviceStates
        Content of the table.
    redraw : callable, optional
        Called once a second for each device; asks another thread to draw the table.
    """

    def __init__(self, states: DeviceStates, redraw: Callable[[], None] | None = None) -> None:
        self.states = states
        self._redraw = redraw
        self._newest: dict[str, dict[type[Message], tuple[float, int, Any]]] = {}  # results since the last status

    def set_viewer_url(self, url: str) -> None:
        """Set the line above the table, which shows the address of the viewer's web page; "" removes it."""
        self.states.note = f"viewer: {url}" if url else ""

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Keep the newest estimate and the newest comparison with the model until the next status."""
        if isinstance(result, Estimate | ModelGap):
            message: type[Message] = CoefficientsMessage if isinstance(result, Estimate) else GapMessage
            self._newest.setdefault(device, {})[message] = (unix_s, received, result)

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Add an event to the lines below the table."""
        self._process(EventMessage.of(device, unix_s, received, event))

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Update the row of a device."""
        self._process(StatusMessage.of(device, unix_s, health.received, health))
        for message, newest in self._newest.pop(device, {}).items():
            self._process(message.of(device, *newest))
        if self._redraw is not None:
            self._redraw()

    def remove_device(self, device: str) -> None:
        """Remove the row of a device."""
        self._newest.pop(device, None)
        self.states.remove(topics.STATUS.key(PREFIX, device))

    def _process(self, message: Message) -> None:
        """Pass a message to the table."""
        self.states.process_message(message.topic.key(PREFIX, message.device), message.encode())
