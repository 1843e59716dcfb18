"""The live view: takes results from the service's loop and draws them in Rerun from a thread of its own.

In come samples, estimates, events and health; every call puts them on a backlog and returns. The thread
opens the viewer, draws what has come five times a second, and once a second asks Rerun whether it
all got through. A viewer that does not answer (stopped, hung) is ``stalled``: nothing more is drawn until it
answers, the backlog drops its oldest, and the drops are counted in ``state``. A viewer that is missing,
cannot start or was closed is said in ``state`` too, and tried again. Nothing here ever raises into the loop.

Traps of Rerun that shape this file: a logging call blocks for ever on a viewer that does not read; so does
its exit handler (taken off), and so does freeing a stream (never done, see ``rerun_sinks``); a first import
takes half a second (done in the thread, and not at all with mode ``none``).
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
from monitor.drift.compensation.live_compensation import DriftLook
from monitor.drift.thermal.live_thermal import ThermalLook
from monitor.estimation.detection.model_gap import ModelGap
from monitor.estimation.estimate import Estimate, joined
from monitor.history.reading import Past
from monitor.publishing.rerun.bounded_queue import Backlog
from monitor.publishing.rerun.viewer_settings import DeviceInfo, ViewerClosed, ViewerSettings, ViewerTrouble

if TYPE_CHECKING:
    from monitor.publishing.rerun.scene import Scene
    from monitor.publishing.rerun.sinks import Child, Output

BACKLOG_BYTES: Final = 16_000_000  # about 25 s of 16 devices at 1 kHz, six axes
CHECK_EVERY_S: Final = 1.0  # whether what was drawn has reached the viewer
PATIENCE_S: Final = 1.0  # for the viewer to answer that
STALL_S: Final = 2.0  # inside one call of Rerun before it counts as stalled
RETRY_S: Final = (2.0, 5.0, 15.0, 30.0)
PLOTS_PER_S: Final = 8.0  # Allan plots drawn, shared by all devices; one a second for each at most
COURSE_EVERY_S: Final = 5.0  # the points of the coefficient courses are sent together
COURSE_STEP_S: Final = 1.0  # of sample time between two points of a course
EARLY_END_S: Final = 10.0  # a window that ends sooner never worked
MISSING: Final = 'rerun-sdk is not installed: pip install "imu-monitor[viewer]"'

Recall = Callable[[str], Past | None]
Message = tuple[str, "_Samples | _Estimate | _Gap | _Thermal | _Rates | _Drift | _Event | _Health | _Overview"]


@dataclass(frozen=True, slots=True)
class _Samples:
    wall_s: Floats
    values: Floats
    temperature_c: Floats


@dataclass(frozen=True, slots=True)
class _Estimate:
    wall_s: float
    estimate: Estimate


@dataclass(frozen=True, slots=True)
class _Gap:
    wall_s: float
    gap: ModelGap


@dataclass(frozen=True, slots=True)
class _Rates:
    wall_s: Floats
    values: Floats


@dataclass(frozen=True, slots=True)
class _Drift:
    wall_s: float
    look: DriftLook


@dataclass(frozen=True, slots=True)
class _Thermal:
    wall_s: float
    look: ThermalLook


@dataclass(frozen=True, slots=True)
class _Event:
    wall_s: float
    event: Event


@dataclass(frozen=True, slots=True)
class _Health:
    wall_s: float
    health: Health


@dataclass(frozen=True, slots=True)
class _Overview:
    wall_s: float
    text: str


class RerunView:
    """One viewer for all devices. Called by one thread; every call returns at once.

    ``fleet``: the devices are those in detail of many more, whose table comes by ``overview``.
    """

    def __init__(
        self,
        settings: ViewerSettings,
        devices: Sequence[DeviceInfo],
        recall: Recall | None = None,
        fleet: bool = False,
    ) -> None:
        """Opens nothing yet. ``recall``: what is kept of a device, asked for in the viewer's thread when it opens."""
        self._settings = settings
        self._recall = recall or _nothing
        self._fleet = fleet
        self._devices = tuple(devices)
        self._backlog: Backlog[Message] = Backlog(BACKLOG_BYTES)
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._phase = "off"
        self._stalled = False
        self._inside_since: float | None = None  # monotonic s at which the thread went into Rerun
        self._child: Child | None = None
        self._url = ""
        self._recording_id = str(uuid.uuid4())

    @property
    def state(self) -> str:
        """``ok``, or in a few words what is wrong: for the status line."""
        inside = self._inside_since
        if self._stalled or (inside is not None and time.monotonic() - inside > STALL_S):
            return f"stalled ({self._backlog.dropped} dropped)"
        return self._phase

    @property
    def url(self) -> str:
        """Where to look: the page, the Rerun server, or "" while there is none."""
        return self._url

    def start(self) -> None:
        """Start the thread; trouble shows in ``state`` and is tried again there."""
        if self._settings.mode == "none" or self._thread is not None:
            return
        self._phase = "starting"
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    def show(self, devices: Sequence[DeviceInfo]) -> None:
        """From now on these devices; to be called before anything is said of a new one."""
        self._devices = tuple(devices)

    def samples(self, device: str, wall_s: Floats, values: Floats, temperature_c: Floats) -> None:
        """Samples at Unix times ``wall_s`` [n]: [n, 6] rad/s and m/s², [n] °C; NaN = not measured."""
        weight = wall_s.nbytes + values.nbytes + temperature_c.nbytes
        self._put(device, _Samples(wall_s, values, temperature_c), weight)

    def estimate(self, device: str, wall_s: float, estimate: Estimate) -> None:
        """A refit; of a fast stream of them the viewer draws the newest, once a second."""
        self._put(device, _Estimate(wall_s, estimate), estimate.curve.avar.nbytes * 8)

    def gap(self, device: str, wall_s: float, gap: ModelGap) -> None:
        """The window beside the model in force."""
        self._put(device, _Gap(wall_s, gap), 6 * 4 * gap.tau_s.nbytes)

    def compensated(self, device: str, wall_s: Floats, values: Floats) -> None:
        """Rates without drift at Unix times ``wall_s`` [n]: [n, 3] rad/s."""
        self._put(device, _Rates(wall_s, values), wall_s.nbytes + values.nbytes)

    def drift(self, device: str, wall_s: float, look: DriftLook) -> None:
        """What an interval taught of the gyros' drift."""
        self._put(device, _Drift(wall_s, look), 1000)

    def thermal(self, device: str, wall_s: float, look: ThermalLook) -> None:
        """An interval beside what temperature let expect of it."""
        self._put(device, _Thermal(wall_s, look), 1000)

    def event(self, device: str, wall_s: float, event: Event) -> None:
        """Something happened to a device."""
        self._put(device, _Event(wall_s, event), 1000)

    def health(self, device: str, wall_s: float, health: Health) -> None:
        """How a device does, about once a second."""
        self._put(device, _Health(wall_s, health), 1000)

    def overview(self, wall_s: float, text: str) -> None:
        """The table of a fleet, as Markdown."""
        self._put("", _Overview(wall_s, text), len(text))

    def close(self, timeout_s: float = 2.0) -> None:
        """Draw what is left for at most ``timeout_s``, then end the viewer that was started here."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._closing.set()
        self._backlog.wake()
        thread.join(0.75 * timeout_s)
        child = self._child
        if thread.is_alive() and child is not None:
            child.kill()  # frees the thread from a frozen viewer
        thread.join(0.25 * timeout_s)
        self._phase = "closed"

    def _put(
        self,
        device: str,
        message: "_Samples | _Estimate | _Gap | _Thermal | _Rates | _Drift | _Event | _Health | _Overview",
        weight: int,
    ) -> None:
        if self._thread is not None:
            self._backlog.push((device, message), weight)

    # ---- the thread ----

    def _run(self) -> None:
        """Open, draw, and open again after a while, until closed."""
        settings, attempt = self._settings, 0
        while not self._closing.is_set():
            started = time.monotonic()
            try:
                _load_rerun()
                self._show(settings)
            except ViewerClosed as closed:
                settings = replace(settings, mode="join")
                self._phase = str(closed)
            except ViewerTrouble as trouble:
                self._phase = str(trouble)
            except ImportError as missing:
                self._phase = MISSING if missing.name in ("rerun", "rerun_cli", "rerun_bindings") else str(missing)
            except Exception as error:  # noqa: BLE001 - a drawing must not end the view: said, and tried again
                self._phase = f"{type(error).__name__}: {error}"
            settings, attempt = self._after(settings, started, attempt)

    def _after(self, settings: ViewerSettings, started: float, attempt: int) -> tuple[ViewerSettings, int]:
        """Wait before the next try; a window that does not work here gives way to the page."""
        self._stalled, self._inside_since, self._url = False, None, ""
        lived_s = time.monotonic() - started
        if self._closing.is_set():
            return settings, attempt
        attempt = 0 if lived_s > 60.0 or settings.mode == "join" else attempt + 1
        if settings.mode == "auto" and lived_s < EARLY_END_S:
            return replace(settings, mode="web"), attempt
        self._closing.wait(RETRY_S[min(attempt, len(RETRY_S) - 1)])
        return settings, attempt

    def _show(self, settings: ViewerSettings) -> None:
        """One viewer, from opening to its end."""
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

    def _lay_out(self, output: "Output", scene: "Scene", devices: Sequence[DeviceInfo]) -> None:
        """A place for each device."""
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

    def _begin(self, scene: "Scene", device: str) -> None:
        """What was, before what comes."""
        self._inside_since = None  # a disk may be slow; that is not the viewer's fault
        past = self._recall(device)
        self._inside_since = time.monotonic()
        if past is not None:
            scene.past(device, past)

    def _draw(self, output: "Output", scene: "Scene") -> None:
        """Draw what comes until closed or nobody looks any more."""
        queue = _Pending(plot_every_s=1.0)
        shown: tuple[DeviceInfo, ...] | None = None
        begun: set[str] = set()
        checked = time.monotonic()
        while True:
            closing = self._closing.is_set()
            queue.add(self._backlog.take(0.0))  # before it is asked which devices there are: none is unknown then
            self._inside_since = time.monotonic()
            if self._devices is not shown:
                shown = self._devices
                queue.plot_every_s = max(1.0, len(shown) / PLOTS_PER_S)
                self._lay_out(output, scene, shown)
                for device in [one.name for one in shown if one.name not in begun]:
                    begun.add(device)
                    self._begin(scene, device)
            queue.draw(scene, everything=closing)
            now = time.monotonic()
            if closing or now - checked > CHECK_EVERY_S:
                self._confirm(output)
                checked = time.monotonic()
            self._inside_since = None
            if closing:
                return
            output.check()
            self._closing.wait(output.flush_every_s)

    def _confirm(self, output: "Output") -> None:
        """Return when all that was drawn has reached the viewer: bounds what Rerun holds to a second's worth."""
        while not output.confirm(PATIENCE_S):
            self._stalled = not self._closing.is_set()
            output.check()
            if self._closing.is_set():
                return
        self._stalled = False


def _nothing(_device: str) -> Past | None:
    return None


@dataclass
class _Pending:
    """What has come since the last drawing, device by device."""

    plot_every_s: float
    samples: dict[str, list[_Samples]] = field(default_factory=dict)
    newest: dict[str, _Estimate] = field(default_factory=dict)  # for the Allan plots
    course: dict[str, list[_Estimate]] = field(default_factory=dict)
    gaps: dict[str, list[_Gap]] = field(default_factory=dict)
    thermals: dict[str, list[_Thermal]] = field(default_factory=dict)
    rates: dict[str, list[_Rates]] = field(default_factory=dict)
    drifts: dict[str, list[_Drift]] = field(default_factory=dict)
    healths: dict[str, _Health] = field(default_factory=dict)
    events: list[tuple[str, _Event]] = field(default_factory=list)
    overview: _Overview | None = None
    drawn: dict[tuple[str, str], float] = field(default_factory=dict)  # (what, device) -> monotonic s

    def add(self, messages: Sequence[Message]) -> None:
        """Sort by device and kind; of healths and plots only the newest counts."""
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
        """Hand all over to the scene; plots and courses when they are due, or ``everything``."""
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
        for device in list(self.gaps):  # before the plot, that has the model's curve too
            if everything or self._due("gap", device, COURSE_STEP_S):
                looks = self.gaps.pop(device)
                scene.gaps(device, np.array([g.wall_s for g in looks]), [g.gap for g in looks])
        for device in list(self.newest):
            if everything or self._due("plot", device, self.plot_every_s):
                newest = self.newest.pop(device)
                scene.estimate(device, newest.wall_s, newest.estimate)
        for device in list(self.course):
            if everything or self._due("course", device, COURSE_EVERY_S):
                points = self.course.pop(device)
                scene.courses(device, np.array([p.wall_s for p in points]), [p.estimate for p in points])

    def _add_to_course(self, device: str, message: _Estimate) -> None:
        points = self.course.setdefault(device, [])
        if len(points) > 1 and message.wall_s - points[-2].wall_s < COURSE_STEP_S:
            # the samples between the points stay on the course
            course = joined([part for part in (points.pop().estimate.course, message.estimate.course) if part])
            message = _Estimate(message.wall_s, replace(message.estimate, course=course))
        points.append(message)

    def _add_gap(self, device: str, message: _Gap) -> None:
        looks = self.gaps.setdefault(device, [])
        if len(looks) > 1 and message.wall_s - looks[-2].wall_s < COURSE_STEP_S:
            looks.pop()
        looks.append(message)

    def _due(self, what: str, device: str, every_s: float) -> bool:
        now = time.monotonic()
        if now - self.drawn.get((what, device), -np.inf) < every_s:
            return False
        self.drawn[what, device] = now
        return True


def _load_rerun() -> None:
    """Import Rerun without its exit handler, which waits for ever for a viewer that does not answer.

    Its own log, read from RUST_LOG at import, would print every closed viewer as an error of the daemon's.
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
