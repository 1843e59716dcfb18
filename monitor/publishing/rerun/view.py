"""Live view in Rerun: accepts results from the main loop of the service and draws them in a separate thread.

Every call adds samples, estimates, events or health reports to a bounded queue and returns at once. The thread opens
the viewer, draws new data five times a second, and checks once a second that the data have reached the viewer. If the
viewer does not answer (stopped or hung), the state is ``stalled``: drawing waits, the queue drops its oldest entries,
and ``state`` reports their number. If the viewer is missing, cannot start or was closed, ``state`` says so and the
attempt is repeated. No exception reaches the main loop.

Properties of Rerun that determine this design: a logging call blocks without limit if the viewer does not read. So
does the exit handler, which is therefore removed. So does freeing a stream, which is therefore never done (see
``sinks``). The first import takes half a second, so it is done in the thread, and not at all with mode ``none``.
"""

import importlib
import os
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from drivers.sample import Event, Floats
from monitor.common.health import Health
from monitor.drift.compensation.live_compensation import DriftUpdate
from monitor.drift.thermal.live_thermal import ThermalUpdate
from monitor.estimation.detection.model_gap import ModelGap
from monitor.estimation.estimate import Estimate, concatenate_histories
from monitor.history.reading import HistoryTable
from monitor.publishing.bounded_queue import BoundedQueue
from monitor.publishing.rerun.viewer_settings import DeviceInfo, ViewerClosed, ViewerError, ViewerSettings

if TYPE_CHECKING:
    from monitor.publishing.rerun.scene import Scene
    from monitor.publishing.rerun.sinks import Output, ViewerProcess

BACKLOG_BYTES: Final = 16_000_000  # about 25 s of 16 devices at 1 kHz with six axes
CONFIRM_PERIOD_S: Final = 1.0  # interval between checks that drawn data have reached the viewer
PATIENCE_S: Final = 1.0  # timeout of this check
STALL_TIMEOUT_S: Final = 2.0  # duration of one Rerun call above which the viewer counts as stalled
RETRY_S: Final = (2.0, 5.0, 15.0, 30.0)
PLOTS_PER_S: Final = 8.0  # rate of Allan plots, shared by all devices; at most one per second and device
POINTS_PERIOD_S: Final = 5.0  # interval at which collected coefficient points are sent
POINT_INTERVAL_S: Final = 1.0  # interval between two coefficient points, in sample time
MIN_WINDOW_LIFETIME_S: Final = 10.0  # a window that closes sooner is taken as not working
MISSING: Final = 'rerun-sdk is not installed: pip install "imu-monitor[viewer]"'

Recall = Callable[[str], HistoryTable | None]
"""Function that returns the stored history of a device, or None."""
Message = tuple[str, "_Samples | _Estimate | _Gap | _Thermal | _Rates | _Drift | _Event | _Health | _Overview"]


@dataclass(frozen=True, slots=True)
class _Samples:
    """Samples of a batch."""

    wall_s: Floats
    values: Floats
    temperature_c: Floats


@dataclass(frozen=True, slots=True)
class _Estimate:
    """Estimate with its time."""

    wall_s: float
    estimate: Estimate


@dataclass(frozen=True, slots=True)
class _Gap:
    """Comparison with the model, with its time."""

    wall_s: float
    gap: ModelGap


@dataclass(frozen=True, slots=True)
class _Rates:
    """Drift-compensated rates of a batch."""

    wall_s: Floats
    values: Floats


@dataclass(frozen=True, slots=True)
class _Drift:
    """State of the drift compensation, with its time."""

    wall_s: float
    look: DriftUpdate


@dataclass(frozen=True, slots=True)
class _Thermal:
    """Result of the thermal model, with its time."""

    wall_s: float
    look: ThermalUpdate


@dataclass(frozen=True, slots=True)
class _Event:
    """Event with its time."""

    wall_s: float
    event: Event


@dataclass(frozen=True, slots=True)
class _Health:
    """Health report with its time."""

    wall_s: float
    health: Health


@dataclass(frozen=True, slots=True)
class _Overview:
    """Table of all devices as Markdown, with its time."""

    wall_s: float
    text: str


class RerunView:
    """Viewer of all devices. It must be used by one thread; every call returns at once.

    Parameters
    ----------
    settings
        Settings of the viewer.
    devices
        Devices to show in detail.
    recall
        Function that returns the stored history of a device. It is called in the viewer's thread when the viewer opens.
    fleet
        True if there are many more devices, which are shown in the table given to ``overview``.
    """

    def __init__(
        self,
        settings: ViewerSettings,
        devices: Sequence[DeviceInfo],
        recall: Recall | None = None,
        fleet: bool = False,
    ) -> None:
        """Store the settings; the viewer is opened by ``start``."""
        self._settings = settings
        self._recall = recall or _no_history
        self._fleet = fleet
        self._devices = tuple(devices)
        self._backlog: BoundedQueue[Message] = BoundedQueue(BACKLOG_BYTES)
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._phase = "off"
        self._stalled = False
        self._inside_since: float | None = None  # monotonic time at which the current Rerun call began [s]
        self._child: ViewerProcess | None = None
        self._url = ""
        self._recording_id = str(uuid.uuid4())

    @property
    def state(self) -> str:
        """``ok``, or a short description of what is wrong; part of the status message."""
        inside = self._inside_since
        if self._stalled or (inside is not None and time.monotonic() - inside > STALL_TIMEOUT_S):
            return f"stalled ({self._backlog.dropped} dropped)"
        return self._phase

    @property
    def url(self) -> str:
        """Address of the web page or of the Rerun server; "" if there is none."""
        return self._url

    def start(self) -> None:
        """Start the thread; errors are reported in ``state`` and the attempt is repeated."""
        if self._settings.mode == "none" or self._thread is not None:
            return
        self._phase = "starting"
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    def set_devices(self, devices: Sequence[DeviceInfo]) -> None:
        """Set the devices to show; this must be called before data of a new device are passed.

        Parameters
        ----------
        devices
            Devices to show in detail.
        """
        self._devices = tuple(devices)

    def samples(self, device: str, wall_s: Floats, values: Floats, temperature_c: Floats) -> None:
        """Draw samples.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix times [s], shape [n].
        values
            Rates [rad/s] and accelerations [m/s²], shape [n, 6]; NaN if not measured.
        temperature_c
            Temperatures [°C], shape [n]; NaN if not measured.
        """
        weight = wall_s.nbytes + values.nbytes + temperature_c.nbytes
        self._put(device, _Samples(wall_s, values, temperature_c), weight)

    def estimate(self, device: str, wall_s: float, estimate: Estimate) -> None:
        """Draw an estimate; if estimates arrive faster than once a second, plots show the newest one.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix time of the newest sample [s].
        estimate
            The estimate.
        """
        self._put(device, _Estimate(wall_s, estimate), estimate.curve.avar.nbytes * 8)

    def gap(self, device: str, wall_s: float, gap: ModelGap) -> None:
        """Draw a comparison of the window with the model in use.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix time of the newest sample [s].
        gap
            Result of the comparison.
        """
        self._put(device, _Gap(wall_s, gap), 6 * 4 * gap.tau_s.nbytes)

    def compensated(self, device: str, wall_s: Floats, values: Floats) -> None:
        """Draw drift-compensated rates.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix times [s], shape [n].
        values
            Rates [rad/s], shape [n, 3].
        """
        self._put(device, _Rates(wall_s, values), wall_s.nbytes + values.nbytes)

    def drift(self, device: str, wall_s: float, look: DriftUpdate) -> None:
        """Draw the state of the drift compensation after an interval.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix time of the end of the interval [s].
        look
            State of the drift compensation.
        """
        self._put(device, _Drift(wall_s, look), 1000)

    def thermal(self, device: str, wall_s: float, look: ThermalUpdate) -> None:
        """Draw the mean bias of an interval and its prediction from the temperature.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix time of the end of the interval [s].
        look
            Result of the thermal model.
        """
        self._put(device, _Thermal(wall_s, look), 1000)

    def event(self, device: str, wall_s: float, event: Event) -> None:
        """Draw an event.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix time of the event [s].
        event
            The event.
        """
        self._put(device, _Event(wall_s, event), 1000)

    def health(self, device: str, wall_s: float, health: Health) -> None:
        """Draw a health report, about once a second.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix time of the report [s].
        health
            Health of the device.
        """
        self._put(device, _Health(wall_s, health), 1000)

    def overview(self, wall_s: float, text: str) -> None:
        """Draw the table of all devices.

        Parameters
        ----------
        wall_s
            Unix time of the table [s].
        text
            Table as Markdown.
        """
        self._put("", _Overview(wall_s, text), len(text))

    def close(self, timeout_s: float = 2.0) -> None:
        """Draw the remaining data for at most ``timeout_s`` seconds, then end the viewer if it was started here."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._closing.set()
        self._backlog.wake()
        thread.join(0.75 * timeout_s)
        child = self._child
        if thread.is_alive() and child is not None:
            child.kill()  # releases the thread from a viewer that does not respond
        thread.join(0.25 * timeout_s)
        self._phase = "closed"

    def _put(
        self,
        device: str,
        message: "_Samples | _Estimate | _Gap | _Thermal | _Rates | _Drift | _Event | _Health | _Overview",
        weight: int,
    ) -> None:
        """Add a message to the queue if the thread has been started."""
        if self._thread is not None:
            self._backlog.push((device, message), weight)

    # ---- methods of the thread ----

    def _run(self) -> None:
        """Open the viewer and draw; reopen it after failures, until closed."""
        settings, attempt = self._settings, 0
        while not self._closing.is_set():
            started = time.monotonic()
            try:
                _load_rerun()
                self._show(settings)
            except ViewerClosed as closed:
                settings = replace(settings, mode="join")
                self._phase = str(closed)
            except ViewerError as trouble:
                self._phase = str(trouble)
            except ImportError as missing:
                self._phase = MISSING if missing.name in ("rerun", "rerun_cli", "rerun_bindings") else str(missing)
            except Exception as error:  # noqa: BLE001 - a drawing error must not end the view; it is reported in state
                self._phase = f"{type(error).__name__}: {error}"
            settings, attempt = self._wait_and_select_mode(settings, started, attempt)

    def _wait_and_select_mode(
        self, settings: ViewerSettings, started: float, attempt: int
    ) -> tuple[ViewerSettings, int]:
        """Wait before the next attempt; if a window does not work on this host, use the web page instead."""
        self._stalled, self._inside_since, self._url = False, None, ""
        lived_s = time.monotonic() - started
        if self._closing.is_set():
            return settings, attempt
        attempt = 0 if lived_s > 60.0 or settings.mode == "join" else attempt + 1
        if settings.mode == "auto" and lived_s < MIN_WINDOW_LIFETIME_S:
            return replace(settings, mode="web"), attempt
        self._closing.wait(RETRY_S[min(attempt, len(RETRY_S) - 1)])
        return settings, attempt

    def _show(self, settings: ViewerSettings) -> None:
        """Open a viewer and draw until it ends."""
        from monitor.publishing.rerun import scene as rerun_scene
        from monitor.publishing.rerun import sinks

        output = sinks.open_output(settings, self._recording_id, self._closing.is_set)
        self._child, self._url = output.child, output.url
        try:
            scene = rerun_scene.Scene(output.stream, fleet=self._fleet)
            self._draw(output, scene)
        finally:
            self._child = None
            output.close()

    def _send_layout(self, output: "Output", scene: "Scene", devices: Sequence[DeviceInfo]) -> None:
        """Send the layout for the devices and create their entities."""
        from monitor.publishing.rerun import blueprint

        blueprint.send(
            output.stream,
            [d.name for d in devices],
            [d.name for d in devices if d.has_model],
            [d.name for d in devices if d.has_thermal],
            [d.name for d in devices if d.compensated],
            self._fleet,
        )
        scene.show([(d.name, d.about) for d in devices])
        self._phase = f"ok, but {output.note}" if output.note else "ok"

    def _draw_history(self, scene: "Scene", device: str) -> None:
        """Draw the stored history of a device before its live data."""
        self._inside_since = None  # a slow disk must not count as a stalled viewer
        past = self._recall(device)
        self._inside_since = time.monotonic()
        if past is not None:
            scene.past(device, past)

    def _draw(self, output: "Output", scene: "Scene") -> None:
        """Draw new data until closed; raise ViewerError if the viewer has ended."""
        queue = _Pending(plot_every_s=1.0)
        shown: tuple[DeviceInfo, ...] | None = None
        begun: set[str] = set()
        checked = time.monotonic()
        while True:
            closing = self._closing.is_set()
            queue.add(self._backlog.take(0.0))  # before the devices are read, so that each message has a known device
            self._inside_since = time.monotonic()
            if self._devices is not shown:
                shown = self._devices
                queue.plot_every_s = max(1.0, len(shown) / PLOTS_PER_S)
                self._send_layout(output, scene, shown)
                for device in [one.name for one in shown if one.name not in begun]:
                    begun.add(device)
                    self._draw_history(scene, device)
            queue.draw(scene, everything=closing)
            now = time.monotonic()
            if closing or now - checked > CONFIRM_PERIOD_S:
                self._confirm(output)
                checked = time.monotonic()
            self._inside_since = None
            if closing:
                return
            output.check()
            self._closing.wait(output.flush_every_s)

    def _confirm(self, output: "Output") -> None:
        """Wait until all drawn data have reached the viewer, which limits the data held by Rerun to one second."""
        while not output.confirm(PATIENCE_S):
            self._stalled = not self._closing.is_set()
            output.check()
            if self._closing.is_set():
                return
        self._stalled = False


def _no_history(_device: str) -> HistoryTable | None:
    """Return None: no history is stored."""
    return None


@dataclass
class _Pending:
    """Data received since the last drawing, by device."""

    plot_every_s: float
    samples: dict[str, list[_Samples]] = field(default_factory=dict)
    newest: dict[str, _Estimate] = field(default_factory=dict)  # newest estimate, for the Allan plots
    course: dict[str, list[_Estimate]] = field(default_factory=dict)
    gaps: dict[str, list[_Gap]] = field(default_factory=dict)
    thermals: dict[str, list[_Thermal]] = field(default_factory=dict)
    rates: dict[str, list[_Rates]] = field(default_factory=dict)
    drifts: dict[str, list[_Drift]] = field(default_factory=dict)
    healths: dict[str, _Health] = field(default_factory=dict)
    events: list[tuple[str, _Event]] = field(default_factory=list)
    overview: _Overview | None = None
    drawn: dict[tuple[str, str], float] = field(default_factory=dict)  # monotonic time of (plot, device) [s]

    def add(self, messages: Sequence[Message]) -> None:
        """Sort messages by device and kind; only the newest health report and plot of a device are kept."""
        for device, message in messages:
            match message:
                case _Samples():
                    self.samples.setdefault(device, []).append(message)
                case _Estimate():
                    self.newest[device] = message
                    self._add_to_course(device, message)
                case _Gap():
                    self._add_gap(device, message)
                case _Rates():
                    self.rates.setdefault(device, []).append(message)
                case _Drift():
                    self.drifts.setdefault(device, []).append(message)
                case _Thermal():
                    self.thermals.setdefault(device, []).append(message)
                case _Event():
                    self.events.append((device, message))
                case _Health():
                    self.healths[device] = message
                case _Overview():
                    self.overview = message

    def draw(self, scene: "Scene", everything: bool) -> None:
        """Pass the data to the scene; plots and coefficient points only when they are due, or if ``everything``."""
        for device, parts in self.samples.items():
            scene.samples(
                device,
                np.concatenate([p.wall_s for p in parts]),
                np.concatenate([p.values for p in parts]),
                np.concatenate([p.temperature_c for p in parts]),
            )
        self.samples.clear()
        for device, happened in self.events:
            scene.event(device, happened.wall_s, happened.event)
        self.events.clear()
        for device, seen in self.healths.items():
            scene.health(device, seen.wall_s, seen.health)
        self.healths.clear()
        if self.overview is not None:
            scene.overview(self.overview.wall_s, self.overview.text)
            self.overview = None
        for device, rates in self.rates.items():
            scene.compensated(
                device, np.concatenate([one.wall_s for one in rates]), np.concatenate([one.values for one in rates])
            )
        self.rates.clear()
        for device, drifts in self.drifts.items():
            scene.drift(device, np.array([one.wall_s for one in drifts]), [one.look for one in drifts])
        self.drifts.clear()
        for device, means in self.thermals.items():
            scene.thermal(device, np.array([one.wall_s for one in means]), [one.look for one in means])
        self.thermals.clear()
        for device in list(self.gaps):  # before the plot, which also shows the curve of the model
            if everything or self._due("gap", device, POINT_INTERVAL_S):
                looks = self.gaps.pop(device)
                scene.gaps(device, np.array([g.wall_s for g in looks]), [g.gap for g in looks])
        for device in list(self.newest):
            if everything or self._due("plot", device, self.plot_every_s):
                newest = self.newest.pop(device)
                scene.estimate(device, newest.wall_s, newest.estimate)
        for device in list(self.course):
            if everything or self._due("course", device, POINTS_PERIOD_S):
                points = self.course.pop(device)
                scene.coefficients(device, np.array([p.wall_s for p in points]), [p.estimate for p in points])

    def _add_to_course(self, device: str, message: _Estimate) -> None:
        """Add a coefficient point; replace the previous one if it is younger than POINT_INTERVAL_S."""
        points = self.course.setdefault(device, [])
        if len(points) > 1 and message.wall_s - points[-2].wall_s < POINT_INTERVAL_S:
            # The per-sample values between the points are kept.
            course = concatenate_histories(
                [part for part in (points.pop().estimate.history, message.estimate.history) if part]
            )
            message = _Estimate(message.wall_s, replace(message.estimate, history=course))
        points.append(message)

    def _add_gap(self, device: str, message: _Gap) -> None:
        """Add a comparison; replace the previous one if it is younger than POINT_INTERVAL_S."""
        looks = self.gaps.setdefault(device, [])
        if len(looks) > 1 and message.wall_s - looks[-2].wall_s < POINT_INTERVAL_S:
            looks.pop()
        looks.append(message)

    def _due(self, what: str, device: str, every_s: float) -> bool:
        """Return True at most once per ``every_s`` seconds for each plot and device."""
        now = time.monotonic()
        if now - self.drawn.get((what, device), -np.inf) < every_s:
            return False
        self.drawn[what, device] = now
        return True


def _load_rerun() -> None:
    """Import Rerun and remove its exit handler, which waits without limit for a viewer that does not answer.

    Rerun reads RUST_LOG at import. By default its log would report every closed viewer as an error of this process.
    """
    given = os.environ.get("RUST_LOG")
    os.environ["RUST_LOG"] = given or "off"
    os.environ.setdefault("RERUN_ANALYTICS", "0")
    try:
        rerun = importlib.import_module("rerun")
    finally:
        if given is None:
            del os.environ["RUST_LOG"]
    rerun.unregister_shutdown()
