"""Outputs of the daemon for the terminal: log lines about events and status changes, and the table of devices."""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
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


FIRST_REPEAT_S: Final = 10.0
"""Shortest time in s from a message to its first repetition. Every repetition doubles the time to the next one."""
MAX_REPEAT_S: Final = 3600.0
MAX_MESSAGE_KINDS: Final = 50
"""Largest number of message kinds that are remembered for a device."""
_VARIABLE_PARTS: Final = re.compile(r"""b?'(?:\\.|[^'\\])*'|b?"(?:\\.|[^"\\])*"|[-+]?\d[\d,.:]*""")
"""Quoted texts and numbers, in which messages of the same kind differ."""


@dataclass(slots=True)
class _LoggedMessage:
    """Last log line of one kind of message of a device."""

    since_s: float  # Unix time of this line
    rejected: int  # number of rejected samples until this line
    pause_s: float = FIRST_REPEAT_S  # time until the next line of this kind
    held: Event | Health | None = None  # newest message that was not written
    count: int = 0  # number of messages that were not written


class EventAndStatusLogOutput(Output):
    """Output that writes events and changes of the status as log lines.

    A message that differs from an earlier one of the same device only in numbers and quoted texts is a repetition.
    Repetitions are written at growing intervals, with their number and the number of rejected samples since the last
    line. When a device runs without a problem again, its next status message is written at once.

    Parameters
    ----------
    clock : callable, optional
        Function that returns the current Unix time [s].
    """

    name = "log"

    def __init__(self, clock: Callable[[], float] = time.time) -> None:
        self._clock = clock
        self._last_status: dict[str, tuple[str, str]] = {}
        self._logged: dict[str, dict[tuple[str, ...], _LoggedMessage]] = {}  # by device and kind of message

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Write a log line for an event, or hold the event if it is a repetition."""
        self._write_or_hold(device, ("event", event.kind, event.axis or ""), event.text, event, 0)

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Write a log line if the status has changed, and write held repetitions whose time has come."""
        now = (health.state, health.text)
        changed = self._last_status.get(device) != now
        self._last_status[device] = now
        kinds = self._logged.setdefault(device, {})
        if changed and health.state == "running" and not health.text:
            for kind in [kind for kind in kinds if kind[0] == "status"]:
                del kinds[kind]
        if changed:
            self._write_or_hold(device, ("status", health.state), health.text, health, health.bad)
        for known in kinds.values():
            if known.held is not None and self._clock() - known.since_s >= known.pause_s:
                self._write_repetition(device, known, health.bad)

    def _write_or_hold(
        self, device: str, kind: tuple[str, ...], text: str, message: Event | Health, rejected: int
    ) -> None:
        kinds = self._logged.setdefault(device, {})
        key = (*kind, _VARIABLE_PARTS.sub("", text))
        if known := kinds.get(key):
            known.held, known.count = message, known.count + 1
            return
        if len(kinds) >= MAX_MESSAGE_KINDS:
            del kinds[next(iter(kinds))]
        kinds[key] = _LoggedMessage(self._clock(), rejected)
        _write(device, message, "")

    def _write_repetition(self, device: str, known: _LoggedMessage, rejected: int) -> None:
        since = f"since {datetime.fromtimestamp(known.since_s).astimezone():%H:%M:%S}"
        if isinstance(known.held, Event):
            _write(device, known.held, f" ({known.count} events of this kind {since})")
        elif known.held is not None:
            more = f", {rejected - known.rejected} lines or frames rejected" if rejected > known.rejected else ""
            _write(device, known.held, f" (repeated{more} {since})")
        known.since_s, known.rejected, known.held, known.count = self._clock(), rejected, None, 0
        known.pause_s = min(2.0 * known.pause_s, MAX_REPEAT_S)

    def set_viewer_url(self, url: str) -> None:
        """Write a log line with the URL of the viewer."""
        if url:
            _log.info("viewer", url=url)

    def remove_device(self, device: str) -> None:
        """Remove the stored messages of a device."""
        self._last_status.pop(device, None)
        self._logged.pop(device, None)


def _write(device: str, message: Event | Health, repetitions: str) -> None:
    text = message.text + repetitions
    if isinstance(message, Event):
        _log.info(message.kind, device=device, axis=message.axis, text=text)
        return
    write = _log.info if message.state in ("running", "ended") and not message.text else _log.warning
    write("status", device=device, state=message.state, text=text, received=message.received)


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
