"""Outputs of the daemon: zenoh messages, viewer, log lines, and the table in the terminal.

``monitor.daemon.output_interface.Output`` describes the parameters of the methods.
``monitor.publishing.result_kinds`` lists the messages and drawings of each kind of result.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import structlog

from drivers.data_types import Event, Ints, SampleBlock
from drivers.zenoh.sample_message import encode_samples
from monitor.common import topics
from monitor.common.device_health import Health
from monitor.daemon.output_interface import Output
from monitor.estimation.detection.model_comparison import ModelComparison
from monitor.estimation.estimate import Estimate
from monitor.publishing.messages.message import Message
from monitor.publishing.messages.results import (
    CoefficientsMessage,
    EventMessage,
    ModelGapMessage,
    StatusMessage,
)
from monitor.publishing.remote_devices import DeviceStates
from monitor.publishing.result_kinds import CompensatedRows, SampleRows, kind_of
from monitor.publishing.zenoh.publisher import ZenohPublisher

if TYPE_CHECKING:
    from monitor.publishing.rerun.queued_view import RerunView

PREFIX: Final = "imu"
"""First part of the keys of the messages for the table in the terminal."""
_log = structlog.get_logger("imu-monitor")


class ZenohOutput(Output):
    """Output that publishes the results as zenoh messages."""

    def __init__(self, zenoh: ZenohPublisher) -> None:
        self._zenoh = zenoh

    def publish_samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Publish a block of samples as one msgpack message."""
        self._zenoh.put(topics.SAMPLES, device, encode_samples(device, received, samples, offset_ns))

    def publish_compensated_samples(
        self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int
    ) -> None:
        """Publish a block of compensated samples as one msgpack message."""
        schema = topics.COMPENSATED.schema_name()
        self._zenoh.put(topics.COMPENSATED, device, encode_samples(device, received, samples, offset_ns, schema))

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Publish a result as JSON messages."""
        self._publish_messages(device, unix_s, received, result)

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Publish an event as a JSON message."""
        self._publish_messages(device, unix_s, received, event)

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Publish the status as a JSON message."""
        self._publish_messages(device, unix_s, health.received, health)

    def _publish_messages(self, device: str, unix_s: float | None, received: int, result: Any) -> None:
        for message in kind_of(result).messages:
            self._zenoh.put(message.topic, device, message.from_result(device, unix_s, received, result).encode())


class ViewerOutput(Output):
    """Output that shows the results in the Rerun viewer."""

    def __init__(self, view: "RerunView") -> None:
        self._view = view

    def publish_samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Show the measured samples in the viewer."""
        unix_s = (samples.t_ns + offset_ns) / 1e9
        self._view.put(device, float(unix_s[-1]), SampleRows(unix_s, samples.values, samples.temperature_c))

    def publish_compensated_samples(
        self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int
    ) -> None:
        """Show the compensated angular rates together with the measured rates."""
        unix_s = (samples.t_ns + offset_ns) / 1e9
        self._view.put(device, float(unix_s[-1]), CompensatedRows(unix_s, samples.values[:, :3]))

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Show a result in the panels that draw this kind of result."""
        self._view.put(device, unix_s, result)

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Show an event as one line of the event log."""
        self._view.put(device, unix_s, event)

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Show the status of a device if the present time is known."""
        if unix_s is not None:
            self._view.put(device, unix_s, health)


class LogOutput(Output):
    """Output that writes events and changes of the status as log lines."""

    def __init__(self) -> None:
        self._last_status: dict[str, tuple[str, str]] = {}

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Write one log line for an event."""
        _log.info(event.kind, device=device, axis=event.axis, text=event.text)

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Write a log line if the state or the status message of a device has changed."""
        now = (health.state, health.text)
        if self._last_status.get(device) != now:
            self._last_status[device] = now
            write = _log.info if health.state in ("running", "ended") and not health.text else _log.warning
            write("status", device=device, state=health.state, text=health.text, received=health.received)

    def remove_device(self, device: str) -> None:
        """Remove the stored status of a device."""
        self._last_status.pop(device, None)


class TableOutput(Output):
    """Output for the table in the terminal.

    Parameters
    ----------
    states : DeviceStates
        Content of the table.
    request_redraw : callable, optional
        Function that requests another thread to draw the table.
    """

    def __init__(self, states: DeviceStates, request_redraw: Callable[[], None] | None = None) -> None:
        self.states = states
        self._redraw = request_redraw
        self._newest: dict[str, dict[type[Message], tuple[float, int, Any]]] = {}  # results since the last status

    def set_viewer_url(self, url: str) -> None:
        """Show the URL of the viewer above the table, or remove the line if the URL is ""."""
        self.states.note = f"viewer: {url}" if url else ""

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Store the newest estimate and the newest comparison with the noise model until the next status."""
        if isinstance(result, Estimate | ModelComparison):
            message: type[Message] = CoefficientsMessage if isinstance(result, Estimate) else ModelGapMessage
            self._newest.setdefault(device, {})[message] = (unix_s, received, result)

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Add an event to the lines below the table."""
        self._process(EventMessage.from_result(device, unix_s, received, event))

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Update the row of a device in the table."""
        self._process(StatusMessage.from_result(device, unix_s, health.received, health))
        for message, newest in self._newest.pop(device, {}).items():
            self._process(message.from_result(device, *newest))
        if self._redraw is not None:
            self._redraw()

    def remove_device(self, device: str) -> None:
        """Remove the row of a device from the table."""
        self._newest.pop(device, None)
        self.states.remove_device(topics.STATUS.key(PREFIX, device))

    def _process(self, message: Message) -> None:
        self.states.process_message(message.topic.key(PREFIX, message.device), message.encode())
