"""Outputs of the daemon for the terminal: log lines about events and status changes, and the table of devices."""

from collections.abc import Callable
from typing import Any, Final

import structlog

from drivers.data_types import Event
from monitor.common import topics
from monitor.common.device_health import Health
from monitor.daemon.outputs.output import Output
from monitor.estimation.detection.comparison_with_noise_model import ModelComparison
from monitor.estimation.estimate import Estimate
from monitor.publishing.messages.message import Message
from monitor.publishing.messages.results import (
    CoefficientsMessage,
    EventMessage,
    ModelGapMessage,
    StatusMessage,
)
from monitor.publishing.remote_device_states import RemoteDeviceRegistry

_log = structlog.get_logger("imu-monitor")


class EventAndStatusLogOutput(Output):
    """Output that writes events and changes of the status as log lines."""

    name = "log"

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

    def set_viewer_url(self, url: str) -> None:
        """Write a log line with the URL of the viewer."""
        if url:
            _log.info("viewer", url=url)

    def remove_device(self, device: str) -> None:
        """Remove the stored status of a device."""
        self._last_status.pop(device, None)


PREFIX: Final = "imu"
"""Key prefix of the messages for the table in the terminal."""
_log = structlog.get_logger("imu-monitor")


class TableOutput(Output):
    """Output for the table in the terminal.

    Parameters
    ----------
    states : RemoteDeviceRegistry
        Content of the table.
    request_redraw : callable, optional
        Function that requests another thread to draw the table.
    """

    name = "terminal"

    def __init__(self, states: RemoteDeviceRegistry, request_redraw: Callable[[], None] | None = None) -> None:
        self.states = states
        self._redraw = request_redraw
        self._newest: dict[str, dict[type[Message], tuple[float, int, Any]]] = {}  # results since the last status

    def set_viewer_url(self, url: str) -> None:
        """Show the URL of the viewer above a table that is redrawn. Otherwise, the log contains the URL."""
        if self._redraw is not None:
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
            if isinstance(newest[-1], Estimate):
                self.states.set_allan_curve(f"{PREFIX}/{device}", newest[-1].curve)
        if self._redraw is not None:
            self._redraw()

    def remove_device(self, device: str) -> None:
        """Remove the row of a device from the table."""
        self._newest.pop(device, None)
        self.states.remove_device(topics.STATUS.key(PREFIX, device))

    def _process(self, message: Message) -> None:
        self.states.process_message(message.topic.key(PREFIX, message.device), message.encode())
