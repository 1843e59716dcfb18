"""Live display in Rerun, which draws results of the main loop in a separate thread.

The method ``put`` adds a result to a bounded queue and returns at once. If the viewer does not answer, the property
``state`` reports ``stalled`` and the queue drops the oldest results. If the viewer is missing, cannot start or was
closed, ``state`` reports the reason and the thread tries again to open the viewer.

If the viewer does not read, a logging call of Rerun blocks without limit. The exit handler of Rerun may also block and
is therefore removed. The thread imports Rerun, because the import takes half a second.
"""

import importlib
import os
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from drivers.host.extras import install_command
from monitor.history.bucketed_history import HistoryTable
from monitor.publishing.bounded_queue import BoundedQueue
from monitor.publishing.rerun.viewer_settings_and_errors import (
    ViewerClosed,
    ViewerDeviceDescription,
    ViewerError,
    ViewerSettings,
)
from monitor.publishing.result_kinds import RESULT_KINDS, DrawingSchedule, TimedResult, kind_of

if TYPE_CHECKING:
    from monitor.publishing.rerun.sinks import RerunStreamWithSink, ViewerProcess
    from monitor.publishing.rerun.viewer_scene import AllDevicesScene

BACKLOG_BYTES: Final = 16_000_000  # enough for about 25 s of samples of 16 six-axis devices at 1 kHz
CONFIRM_PERIOD_S: Final = 1.0  # interval between two checks that the viewer has received the drawn data
PATIENCE_S: Final = 1.0  # longest duration of such a check
STALL_TIMEOUT_S: Final = 2.0  # a Rerun call that takes longer shows that the viewer is stalled
RETRY_S: Final = (2.0, 5.0, 15.0, 30.0)
LAYOUT_PERIODS_S: Final = (2.0, 10.0)
"""Shortest interval before the second layout and before each further layout [s].

A new layout selects the first page. A viewer that joins late receives all layouts before the newest results.
"""
PLOTS_PER_S: Final = 8.0  # number of Allan plots of all devices that are drawn per second
MIN_WINDOW_LIFETIME_S: Final = 10.0  # a window that closes earlier does not work on this machine
MISSING: Final = f"rerun-sdk is not installed: {install_command('imu-monitor[viewer]')}"

HistorySource = Callable[[str], HistoryTable | None]
"""Function that returns the stored history of a device, or None if there is none."""


class RerunView:
    """Viewer of all devices, whose methods return at once. Only one thread may call the methods.

    Parameters
    ----------
    settings
        Settings of the viewer.
    devices
        Devices to show in detail.
    history_source
        Function that returns the stored history of a device. The thread of the viewer calls this function.
    fleet
        True if the device table also contains devices that are not shown in detail.
    """

    def __init__(
        self,
        settings: ViewerSettings,
        devices: Sequence[ViewerDeviceDescription],
        history_source: HistorySource = lambda _device: None,
        fleet: bool = False,
    ) -> None:
        self.units = settings.units
        self._settings = settings
        self._history_source = history_source
        self._fleet = fleet
        self._devices = tuple(devices)
        self._backlog: BoundedQueue[tuple[str, float, Any]] = BoundedQueue(BACKLOG_BYTES)
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._phase = "off"
        self._stalled = False
        self._inside_since: float | None = None  # monotonic time at which the current Rerun call began [s]
        self._child: ViewerProcess | None = None
        self.url = ""  # address of the web page or of the Rerun server
        self._recording_id = str(uuid.uuid4())

    @property
    def state(self) -> str:
        """``ok`` or a short description of the problem, for the status message."""
        inside = self._inside_since
        if self._stalled or (inside is not None and time.monotonic() - inside > STALL_TIMEOUT_S):
            return f"stalled ({self._backlog.dropped} dropped)"
        return self._phase

    def start(self) -> None:
        """Start the thread of the viewer."""
        if self._settings.mode == "none" or self._thread is not None:
            return
        self._phase = "starting"
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    def set_detailed_devices(self, devices: Sequence[ViewerDeviceDescription]) -> None:
        """Set the devices to show in detail. A new device must be included before its first result is queued."""
        self._devices = tuple(devices)

    def put(self, device: str, unix_s: float, result: Any) -> None:
        """Add a result to the queue of results to draw.

        Parameters
        ----------
        device
            Name of the device.
        unix_s
            Unix time of the result [s].
        result
            Result of one of the kinds in ``monitor.publishing.result_kinds``.
        """
        if self._thread is not None:
            self._backlog.push((device, unix_s, result), kind_of(result).size_bytes(result))

    def close(self, timeout_s: float = 2.0) -> None:
        """Draw the remaining results for at most ``timeout_s`` seconds, and close the viewer or the file."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._closing.set()
        self._backlog.wake()
        thread.join(0.75 * timeout_s)
        child = self._child
        if thread.is_alive() and child is not None:
            child.kill()  # ends a Rerun call that waits for the viewer
        thread.join(0.25 * timeout_s)
        self._phase = "closed"

    # ---- methods of the thread ----

    def _run(self) -> None:
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
            except Exception as error:  # noqa: BLE001 - the state reports the error, and the view continues
                self._phase = f"{type(error).__name__}: {error}"
            settings, attempt = self._wait_and_select_mode(settings, started, attempt)

    def _wait_and_select_mode(
        self, settings: ViewerSettings, started: float, attempt: int
    ) -> tuple[ViewerSettings, int]:
        """Wait before the next attempt to open a viewer, and select the web page if windows fail on this machine."""
        self._stalled, self._inside_since, self.url = False, None, ""
        lived_s = time.monotonic() - started
        if self._closing.is_set():
            return settings, attempt
        attempt = 0 if lived_s > 60.0 or settings.mode == "join" else attempt + 1
        if settings.mode == "auto" and lived_s < MIN_WINDOW_LIFETIME_S:
            return replace(settings, mode="web"), attempt
        self._closing.wait(RETRY_S[min(attempt, len(RETRY_S) - 1)])
        return settings, attempt

    def _show(self, settings: ViewerSettings) -> None:
        from monitor.publishing.rerun import sinks
        from monitor.publishing.rerun import viewer_scene as rerun_scene

        output = sinks.open_output(settings, self._recording_id, self._closing.is_set)
        self._child, self.url = output.child, output.url
        try:
            scene = rerun_scene.AllDevicesScene(output.stream, self._fleet, settings.units)
            self._draw(output, scene)
        finally:
            self._child = None
            output.close()

    def _send_layout_if_changed(
        self,
        output: "RerunStreamWithSink",
        scene: "AllDevicesScene",
        devices: Sequence[ViewerDeviceDescription],
        sent: list[tuple[str, str]] | None,
    ) -> list[tuple[str, str]]:
        """Send the layout if its views differ from the views that were sent, and return the views."""
        from monitor.publishing.rerun import blueprint

        layout = blueprint.blueprint(devices, self._fleet, scene.entities, scene.units)
        views = [(str(view.origin), str(view.name)) for view in blueprint.list_views(layout.root_container)]
        if views != sent:
            for path, text in blueprint.guide_texts(layout.root_container).items():
                scene.log_static_text(path, text)
            output.stream.send_blueprint(layout, make_active=True, make_default=True)
        return views

    def _draw_history(self, scene: "AllDevicesScene", device: str) -> None:
        self._inside_since = None  # a slow disk must not count as a stalled viewer
        past = self._history_source(device)
        self._inside_since = time.monotonic()
        if past is not None:
            scene.draw_history(device, past)

    def _draw(self, output: "RerunStreamWithSink", scene: "AllDevicesScene") -> None:
        waiting = _WaitingResults()
        shown: tuple[ViewerDeviceDescription, ...] | None = None
        begun: set[str] = set()
        views: list[tuple[str, str]] | None = None  # views of the layout that was sent last
        laid_out_entities: set[str] = set()  # entities with data when the layout was checked last
        layouts = 0  # number of layouts that were sent for the present devices
        checked = laid_out = time.monotonic()
        while True:
            closing = self._closing.is_set()
            waiting.add_results(
                self._backlog.take(0.0)
            )  # taken before self._devices is read, so that the device of each result is known
            self._inside_since = time.monotonic()
            if self._devices is not shown:
                shown = self._devices
                waiting.period_factor = max(1.0, len(shown) / PLOTS_PER_S)
                scene.set_detailed_devices(shown)
                views, layouts = None, 0
                self._phase = f"ok, but {output.note}" if output.note else "ok"
                for device in [one.name for one in shown if one.name not in begun]:
                    begun.add(device)
                    self._draw_history(scene, device)
            waiting.draw_due_results(scene, draw_all=closing)
            now = time.monotonic()
            period_s = LAYOUT_PERIODS_S[min(layouts, len(LAYOUT_PERIODS_S)) - 1]
            if views is None or (now - laid_out > period_s and scene.entities != laid_out_entities):
                sent, views = views, self._send_layout_if_changed(output, scene, shown, views)
                layouts += views != sent
                laid_out, laid_out_entities = now, set(scene.entities)
            if closing or now - checked > CONFIRM_PERIOD_S:
                self._confirm(output)
                checked = time.monotonic()
            self._inside_since = None
            if closing:
                return
            output.raise_if_viewer_ended()
            self._closing.wait(output.flush_every_s)

    def _confirm(self, output: "RerunStreamWithSink") -> None:
        """Wait until the viewer has received all drawn data, which limits the memory use of Rerun."""
        while not output.confirm_delivery(PATIENCE_S):
            self._stalled = not self._closing.is_set()
            output.raise_if_viewer_ended()
            if self._closing.is_set():
                return
        self._stalled = False


class _WaitingResults:
    def __init__(self) -> None:
        self.period_factor = 1.0  # factor for the drawing periods of plots whose rate the devices share
        self._waiting: dict[DrawingSchedule, dict[str, list[TimedResult]]] = {
            drawing: {} for kind in RESULT_KINDS for drawing in kind.drawings
        }
        self._drawn_s: dict[
            tuple[DrawingSchedule, str], float
        ] = {}  # monotonic time of the last drawing of a device [s]

    def add_results(self, results: Sequence[tuple[str, float, Any]]) -> None:
        for device, unix_s, result in results:
            for drawing in kind_of(result).drawings:
                drawing.merge(self._waiting[drawing].setdefault(device, []), (unix_s, result))

    def draw_due_results(self, scene: "AllDevicesScene", draw_all: bool) -> None:
        for drawing, devices in self._waiting.items():
            period_s = drawing.period_s * (self.period_factor if drawing.shares_rate else 1.0)
            for device in list(devices):
                now_s = time.monotonic()
                if draw_all or now_s - self._drawn_s.get((drawing, device), float("-inf")) >= period_s:
                    self._drawn_s[drawing, device] = now_s
                    scene.draw(device, drawing.panel, devices.pop(device))


def _load_rerun() -> None:
    """Import Rerun and remove its exit handler, which may block without limit.

    RUST_LOG is set before the import, because Rerun would otherwise report every closed viewer as an error.
    """
    given = os.environ.get("RUST_LOG")
    os.environ["RUST_LOG"] = given or "off"
    try:
        rerun = importlib.import_module("rerun")
    finally:
        if given is None:
            del os.environ["RUST_LOG"]
    rerun.unregister_shutdown()
