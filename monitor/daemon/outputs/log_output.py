"""Output of the daemon that writes events and changes of the status as log lines."""

import structlog

from drivers.data_types import Event
from monitor.common.device_health import Health
from monitor.daemon.outputs.output import Output

_log = structlog.get_logger("imu-monitor")


class EventAndStatusLogOutput(Output):
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
