"""Outputs of the daemon: zenoh messages, viewer, history file, log lines and the table in the terminal. None blocks.

The parameters of all methods are described in ``monitor.daemon.output.Output``.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import structlog

from drivers.sample import Event, Ints, SampleBlock
from drivers.zenoh.sample_message import encode_samples
from monitor.common import topics
from monitor.common.health import Health
from monitor.daemon.output import Output
from monitor.drift.compensation.live_compensation import DriftUpdate
from monitor.drift.thermal.live_thermal import ThermalUpdate
from monitor.estimation.allan.hadamard import HadamardCurve
from monitor.estimation.allan.total import TotalCurve
from monitor.estimation.detection.model_gap import ModelGap
from monitor.estimation.estimate import Estimate
from monitor.history.minute_aggregation import MinuteAggregator
from monitor.history.sqlite_store import StoredEvent
from monitor.history.writer import HistoryWriter
from monitor.publishing.messages.results import (
    AllanMessage,
    CoefficientsMessage,
    EventMessage,
    GapMessage,
    SlowStatistics,
    StatusMessage,
    ThermalMessage,
    TotalMessage,
    event_start_s,
)
from monitor.publishing.remote_devices import DeviceStates
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

    def samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Publish a block as one msgpack batch."""
        self._zenoh.put(topics.SAMPLES, device, encode_samples(device, received, samples, offset_ns))

    def estimate(self, device: str, unix_s: float, estimate: Estimate) -> None:
        """Publish the Allan curve and the coefficients."""
        self._zenoh.put(topics.ALLAN, device, AllanMessage.of(device, unix_s, 0, estimate).encode())
        self._zenoh.put(topics.COEFFICIENTS, device, CoefficientsMessage.of(device, unix_s, 0, estimate).encode())

    def model_gap(self, device: str, unix_s: float, gap: ModelGap) -> None:
        """Publish the comparison of the window with the model in force."""
        self._zenoh.put(topics.GAP, device, GapMessage.of(device, unix_s, 0, gap).encode())

    def total(self, device: str, unix_s: float, received: int, total: TotalCurve, hadamard: HadamardCurve) -> None:
        """Publish the total and Hadamard deviations."""
        self._zenoh.put(
            topics.TOTAL, device, TotalMessage.of(device, unix_s, received, SlowStatistics(total, hadamard)).encode()
        )

    def compensated(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Publish a block of compensated samples as one msgpack batch."""
        schema = topics.COMPENSATED.schema()
        self._zenoh.put(topics.COMPENSATED, device, encode_samples(device, received, samples, offset_ns, schema))

    def thermal(self, device: str, unix_s: float, received: int, look: ThermalUpdate) -> None:
        """Publish the mean of an interval and its prediction from temperature."""
        self._zenoh.put(topics.THERMAL, device, ThermalMessage.of(device, unix_s, received, look).encode())

    def event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Publish an event."""
        payload = EventMessage.of(device, unix_s, received, event).encode()
        self._zenoh.put(topics.EVENT, device, payload)

    def health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Publish the status."""
        self._zenoh.put(topics.STATUS, device, StatusMessage.of(device, unix_s, 0, health).encode())


class ViewerOutput(Output):
    """Output that shows the results in the Rerun viewer."""

    def __init__(self, view: "RerunView") -> None:
        self._view = view

    def samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Show raw samples."""
        self._view.samples(device, (samples.t_ns + offset_ns) / 1e9, samples.values, samples.temperature_c)

    def estimate(self, device: str, unix_s: float, estimate: Estimate) -> None:
        """Show the Allan curve and the coefficients."""
        self._view.estimate(device, unix_s, estimate)

    def model_gap(self, device: str, unix_s: float, gap: ModelGap) -> None:
        """Show the time series of the gaps, and the model's curves with the measured curves."""
        self._view.gap(device, unix_s, gap)

    def compensated(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Show compensated rates together with the measured rates."""
        self._view.compensated(device, (samples.t_ns + offset_ns) / 1e9, samples.values[:, :3])

    def drift(self, device: str, unix_s: float, look: DriftUpdate) -> None:
        """Show the time series of the drift and of its innovations, and the drift models."""
        self._view.drift(device, unix_s, look)

    def thermal(self, device: str, unix_s: float, received: int, look: ThermalUpdate) -> None:
        """Show the time series of the interval means and their predictions."""
        self._view.thermal(device, unix_s, look)

    def event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Show an event as one line of the log."""
        self._view.event(device, unix_s, event)

    def health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Show the status, once the time of the first sample is known: the viewer has a single time axis."""
        if unix_s is not None:
            self._view.health(device, unix_s, health)


class HistoryOutput(Output):
    """Output that aggregates the results by the minute, and passes them with the events to the history file.

    Parameters
    ----------
    writer : Writer
        Writer of the history file.
    """

    def __init__(self, writer: HistoryWriter) -> None:
        self.received: dict[str, int] = {}  # number of samples of each device since the start
        self._writer = writer
        self._minutes: dict[str, MinuteAggregator] = {}

    def samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Aggregate the temperature of the samples."""
        unix_s = float((samples.t_ns + offset_ns)[-1]) / 1e9
        self._writer.put_row(device, self._minutes_of(device).add_temperature(unix_s, samples.temperature_c))

    def estimate(self, device: str, unix_s: float, estimate: Estimate) -> None:
        """Aggregate the coefficients, and the deviations on a coarse grid."""
        self._writer.put_row(device, self._minutes_of(device).add_estimate(unix_s, estimate))

    def event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Store an event."""
        since_s = event_start_s(unix_s, event)
        # SQLite does not accept NumPy scalars, so they are converted to plain numbers
        what = {name: {side: float(one) for side, one in sides.items()} for name, sides in event.values.items()}
        sigma = None if event.sigma is None else float(event.sigma)
        told = StoredEvent(unix_s, event.kind, event.text, event.axis, what, since_s, sigma)
        self._writer.put_event(device, told)

    def health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Aggregate counts and state, once the time of the first sample is known: rows are minutes of sample time."""
        self.received[device] = health.received
        if unix_s is None:
            return
        self._writer.put_row(device, self._minutes_of(device).add_health(unix_s, health))

    def device_removed(self, device: str) -> None:
        """Store the last minute of a device that was removed."""
        self.received.pop(device, None)
        minutes = self._minutes.pop(device, None)
        if minutes is not None:
            self._writer.put_row(device, minutes.flush())

    def end(self) -> None:
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

    def event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Write one line for an event."""
        _log.info(event.kind, device=device, axis=event.axis, text=event.text)

    def health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Write a line if the state or its message has changed."""
        now = (health.state, health.text)
        if self._last_status.get(device) != now:
            self._last_status[device] = now
            say = _log.info if health.state in ("running", "ended") and not health.text else _log.warning
            say("status", device=device, state=health.state, text=health.text, received=health.received)

    def device_removed(self, device: str) -> None:
        """Forget the state of a removed device, so that it is logged if the device is added again."""
        self._last_status.pop(device, None)


class TableOutput(Output):
    """Output for the table in the terminal, the same table that ``watch`` shows for other processes.

    Parameters
    ----------
    board : Board
        Content of the table.
    redraw : callable, optional
        Called once a second for each device; asks another thread to draw the table.
    """

    def __init__(self, board: DeviceStates, redraw: Callable[[], None] | None = None) -> None:
        self.board = board
        self._redraw = redraw
        self._latest: dict[str, tuple[float, Estimate]] = {}
        self._gaps: dict[str, tuple[float, ModelGap]] = {}

    def viewer_at(self, url: str) -> None:
        """Set the line above the table, which shows the address of the viewer's web page; "" removes it."""
        self.board.note = f"viewer: {url}" if url else ""

    def estimate(self, device: str, unix_s: float, estimate: Estimate) -> None:
        """Keep an estimate until the row of the device is updated."""
        self._latest[device] = (unix_s, estimate)

    def model_gap(self, device: str, unix_s: float, gap: ModelGap) -> None:
        """Keep a comparison with the model until the row of the device is updated."""
        self._gaps[device] = (unix_s, gap)

    def event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Add an event to the lines below the table."""
        self.board.process_message(
            topics.EVENT.key(PREFIX, device), EventMessage.of(device, unix_s, received, event).encode()
        )

    def health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Update the row of a device."""
        self.board.process_message(
            topics.STATUS.key(PREFIX, device), StatusMessage.of(device, unix_s, 0, health).encode()
        )
        if device in self._latest:
            at_s, estimate = self._latest.pop(device)
            self.board.process_message(
                topics.COEFFICIENTS.key(PREFIX, device), CoefficientsMessage.of(device, at_s, 0, estimate).encode()
            )
        if device in self._gaps:
            self.board.process_message(
                topics.GAP.key(PREFIX, device),
                GapMessage.of(device, self._gaps[device][0], 0, self._gaps.pop(device)[1]).encode(),
            )
        if self._redraw is not None:
            self._redraw()

    def device_removed(self, device: str) -> None:
        """Remove the row of a device."""
        self._latest.pop(device, None)
        self._gaps.pop(device, None)
        self.board.remove(topics.STATUS.key(PREFIX, device))
