"""Adapters: what a station says, as zenoh messages, in the viewer, as log lines, in the terminal. None waits."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import structlog

from drivers.sample import Event, Ints, SampleBlock
from drivers.sample_message import pack
from monitor import topics
from monitor.drift.live import ThermalLook
from monitor.drift.live_compensation import DriftLook
from monitor.estimate.estimate import Estimate
from monitor.estimate.hadamard import HadamardCurve
from monitor.estimate.model_gap import ModelGap
from monitor.estimate.total import TotalCurve
from monitor.health import Health
from monitor.history.minutes import Minutes
from monitor.history.store import PastEvent
from monitor.history.writer import Writer
from monitor.publish import message
from monitor.publish.terminal import Board
from monitor.publish.zenoh_out import ZenohOut
from monitor.station import Output

if TYPE_CHECKING:
    from monitor.publish.rerun_view import RerunView

PREFIX: Final = "imu"
_log = structlog.get_logger("imu-monitor")


class ZenohOutput(Output):
    """Results as zenoh messages."""

    def __init__(self, zenoh: ZenohOut) -> None:
        self._zenoh = zenoh

    def samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """One msgpack batch."""
        self._zenoh.put(topics.SAMPLES, device, pack(device, received, samples, offset_ns))

    def estimate(self, device: str, unix_s: float, estimate: Estimate) -> None:
        """Curve and coefficients."""
        self._zenoh.put(topics.ALLAN, device, message.allan(device, unix_s, estimate))
        self._zenoh.put(topics.COEFFICIENTS, device, message.coefficients(device, unix_s, estimate))

    def gap(self, device: str, unix_s: float, gap: ModelGap) -> None:
        """The window beside the model in force."""
        self._zenoh.put(topics.GAP, device, message.gap(device, unix_s, gap))

    def total(self, device: str, unix_s: float, received: int, total: TotalCurve, hadamard: HadamardCurve) -> None:
        """Total and Hadamard deviations."""
        self._zenoh.put(topics.TOTAL, device, message.total(device, unix_s, received, total, hadamard))

    def compensated(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """One msgpack batch."""
        schema = topics.COMPENSATED.schema()
        self._zenoh.put(topics.COMPENSATED, device, pack(device, received, samples, offset_ns, schema))

    def thermal(self, device: str, unix_s: float, received: int, look: ThermalLook) -> None:
        """The mean of an interval beside what was expected of it."""
        self._zenoh.put(topics.THERMAL, device, message.thermal(device, unix_s, received, look))

    def event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """One event."""
        payload = message.event(device, unix_s, received, event, message.since_s(unix_s, event))
        self._zenoh.put(topics.EVENT, device, payload)

    def health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Status."""
        self._zenoh.put(topics.STATUS, device, message.status(device, unix_s, health))


class ViewerOutput(Output):
    """Results into the Rerun viewer."""

    def __init__(self, view: "RerunView") -> None:
        self._view = view

    def samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Raw samples."""
        self._view.samples(device, (samples.t_ns + offset_ns) / 1e9, samples.values, samples.temperature_c)

    def estimate(self, device: str, unix_s: float, estimate: Estimate) -> None:
        """Curve and coefficients."""
        self._view.estimate(device, unix_s, estimate)

    def gap(self, device: str, unix_s: float, gap: ModelGap) -> None:
        """Courses of the gaps, and the model's curves beside those measured."""
        self._view.gap(device, unix_s, gap)

    def compensated(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Rates beside those measured."""
        self._view.compensated(device, (samples.t_ns + offset_ns) / 1e9, samples.values[:, :3])

    def drift(self, device: str, unix_s: float, look: DriftLook) -> None:
        """Courses of the drift and of its innovations, and the models."""
        self._view.drift(device, unix_s, look)

    def thermal(self, device: str, unix_s: float, received: int, look: ThermalLook) -> None:
        """Courses of the means beside what was expected of them."""
        self._view.thermal(device, unix_s, look)

    def event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """One line of the log."""
        self._view.event(device, unix_s, event)

    def health(self, device: str, unix_s: float | None, health: Health) -> None:
        """The health panel. It is not drawn before the first sample's time is known: the viewer has one time axis."""
        if unix_s is not None:
            self._view.health(device, unix_s, health)


class HistoryOutput(Output):
    """Results gathered by the minute, and events, for the file that keeps them."""

    def __init__(self, writer: Writer) -> None:
        self.received: dict[str, int] = {}  # samples of each device since the start
        self._writer = writer
        self._minutes: dict[str, Minutes] = {}

    def samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Their temperature."""
        unix_s = float((samples.t_ns + offset_ns)[-1]) / 1e9
        self._writer.put(device, self._of(device).temperature(unix_s, samples.temperature_c))

    def estimate(self, device: str, unix_s: float, estimate: Estimate) -> None:
        """Coefficients, and deviations on a coarse grid."""
        self._writer.put(device, self._of(device).estimate(unix_s, estimate))

    def event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """One event."""
        since_s = None if event.since_ns is None else unix_s - (event.t_ns - event.since_ns) / 1e9
        # plain numbers: an array's own are none to SQLite
        what = {name: {side: float(one) for side, one in sides.items()} for name, sides in event.what.items()}
        sigma = None if event.sigma is None else float(event.sigma)
        told = PastEvent(unix_s, event.kind, event.text, event.axis, what, since_s, sigma)
        self._writer.tell(device, told)

    def health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Counts and state. Rows are minutes of the samples' own time, so there is none before the first sample."""
        self.received[device] = health.received
        if unix_s is None:
            return
        self._writer.put(device, self._of(device).health(unix_s, health))

    def gone(self, device: str) -> None:
        """A device that was taken out: its minute is as full as it will be."""
        self.received.pop(device, None)
        minutes = self._minutes.pop(device, None)
        if minutes is not None:
            self._writer.put(device, minutes.end())

    def end(self) -> None:
        """Hand over the minutes that are not full yet."""
        for device, minutes in self._minutes.items():
            self._writer.put(device, minutes.end())

    def _of(self, device: str) -> Minutes:
        return self._minutes.setdefault(device, Minutes())


class LogOutput(Output):
    """Events and changes of state as log lines."""

    def __init__(self) -> None:
        self._said: dict[str, tuple[str, str]] = {}

    def event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """One line an event."""
        _log.info(event.kind, device=device, axis=event.axis, text=event.text)

    def health(self, device: str, unix_s: float | None, health: Health) -> None:
        """A line when the state or its sentence has changed."""
        now = (health.state, health.text)
        if self._said.get(device) != now:
            self._said[device] = now
            say = _log.info if health.state in ("running", "ended") and not health.text else _log.warning
            say("status", device=device, state=health.state, text=health.text, received=health.received)

    def gone(self, device: str) -> None:
        """Its state is news again, should it come back."""
        self._said.pop(device, None)


class TableOutput(Output):
    """Results for the table in the terminal, the same table that ``watch`` shows of other processes.

    Parameters
    ----------
    board : Board
        Content of the table.
    redraw : callable, optional
        Called once a second for each device; asks another thread to draw the table.
    """

    def __init__(self, board: Board, redraw: Callable[[], None] | None = None) -> None:
        self.board = board
        self._redraw = redraw
        self._latest: dict[str, tuple[float, Estimate]] = {}
        self._gaps: dict[str, tuple[float, ModelGap]] = {}

    def viewer_at(self, url: str) -> None:
        """The line above the table: where the viewer's page is, "" = nowhere."""
        self.board.note = f"viewer: {url}" if url else ""

    def estimate(self, device: str, unix_s: float, estimate: Estimate) -> None:
        """Kept until the table is drawn."""
        self._latest[device] = (unix_s, estimate)

    def gap(self, device: str, unix_s: float, gap: ModelGap) -> None:
        """Kept until the table is drawn."""
        self._gaps[device] = (unix_s, gap)

    def event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """One of the last lines."""
        self.board.take(topics.EVENT.key(PREFIX, device), message.event(device, unix_s, received, event, None))

    def health(self, device: str, unix_s: float | None, health: Health) -> None:
        """One row."""
        self.board.take(topics.STATUS.key(PREFIX, device), message.status(device, unix_s, health))
        if device in self._latest:
            at_s, estimate = self._latest.pop(device)
            self.board.take(topics.COEFFICIENTS.key(PREFIX, device), message.coefficients(device, at_s, estimate))
        if device in self._gaps:
            self.board.take(topics.GAP.key(PREFIX, device), message.gap(device, *self._gaps.pop(device)))
        if self._redraw is not None:
            self._redraw()

    def gone(self, device: str) -> None:
        """No row."""
        self._latest.pop(device, None)
        self._gaps.pop(device, None)
        self.board.forget(topics.STATUS.key(PREFIX, device))
