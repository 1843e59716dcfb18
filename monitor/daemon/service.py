"""Main service of the daemon: starts the device workers and outputs, runs the main loop, and stops.

In each round, ``Service.run_main_loop`` calls every device worker, which processes the new samples and publishes the
results. If an output fails, the status of every device reports the problem, and sampling continues. systemd receives
the readiness message after the first attempt to start each output.

To stop, the service stops the readers, processes the remaining samples, and closes the outputs.
"""

import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import structlog

from drivers.errors import ConfigError
from drivers.links.replay_link import ReplayLink
from drivers.recordings.segment_file import SegmentMetadata
from monitor.common.device_health import Health, format_service_status
from monitor.daemon import config_changes
from monitor.daemon.command_handler import CommandHandler
from monitor.daemon.config_changes import ConfigChange
from monitor.daemon.device.device_worker import DeviceWorker
from monitor.daemon.kernels.kernel_readiness import KernelReadiness
from monitor.daemon.operations.hooks import Hooks
from monitor.daemon.operations.log_level import set_log_level
from monitor.daemon.operations.reconcile_on_request import Reconciler
from monitor.daemon.operations.systemd import SystemdNotifier
from monitor.daemon.outputs.history_output import HistoryOutput
from monitor.daemon.outputs.output import Output
from monitor.daemon.outputs.terminal_outputs import TableOutput
from monitor.daemon.outputs.viewer_output import ViewerOutput
from monitor.daemon.outputs.zenoh_output import ZenohOutput
from monitor.daemon.storage.recorder import Recorder, segment_metadata
from monitor.history.bucketed_history import HistoryTable
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription, ViewerSettings
from monitor.publishing.terminal.queued_writer import QueuedWriter
from monitor.publishing.zenoh.publisher import ZenohPublisher
from monitor.settings.loading import Config, Device, Storage, VirtualTable

if TYPE_CHECKING:
    from monitor.daemon.operations.prometheus_metrics import MetricsOutput
    from monitor.daemon.outputs.influx_output import InfluxOutput
    from monitor.daemon.outputs.ros2_output import Ros2Output
    from monitor.publishing.rerun.queued_view import RerunView

MAX_IDLE_S: Final = 0.05
"""Longest sleep of the main loop if no samples arrive."""
ROUND_PAUSE_S: Final = 0.02
"""Pause between two rounds if no device publishes every block."""
STATUS_INTERVAL_S: Final = 1.0
"""Interval of the status messages."""
STARTING_STATES: Final = ("not open yet", "starting")
"""States of an output before the first attempt to start it."""
READY_TIMEOUT_S: Final = 30.0
"""Time after which readiness is reported to systemd, even if an output has not been started."""
JOIN_TIMEOUT_S: Final = 3.0
"""Longest wait for the end of a reader thread."""

_log = structlog.get_logger("imu-monitor")


class Service:
    """Service of all configured devices and outputs.

    Parameters
    ----------
    config : Config
        Configuration to run.
    more : sequence of Output, optional
        Additional outputs, for example the table in the terminal.
    reconciler : Reconciler, optional
        Runner of ``command/reconcile``.
    unit : SystemdNotifier, optional
        Notifier of systemd. By default, no message is sent.
    writers : mapping of str to QueuedWriter, optional
        Text outputs by name, such as "terminal" and "log".

    Raises
    ------
    ConfigError
        If the settings of a simulated sensor or a noise model are invalid.
    """

    def __init__(
        self,
        config: Config,
        more: Sequence[Output] = (),
        reconciler: Reconciler | None = None,
        unit: SystemdNotifier | None = None,
        writers: Mapping[str, QueuedWriter] | None = None,
    ) -> None:
        self.config = config
        self._writers = dict(writers or {})
        self._unit = unit or SystemdNotifier()
        self._started_s = time.monotonic()
        self._wake = threading.Event()
        self._ready = KernelReadiness()
        self._stop = threading.Event()
        self._reload_asked = False
        self.recorder = _build_recorder(config)
        self.outputs: list[Output] = []
        self.workers = [self._build_worker(device) for device in config.devices]
        storage = config.storage
        self.history = HistoryOutput(storage.folder) if storage is not None and storage.history else None
        answer_query = None if self.history is None else self.history.answer_query
        self.zenoh = ZenohPublisher(config.zenoh, [worker.name for worker in self.workers], answer_query)
        self._commands = CommandHandler(self.zenoh, reconciler or Reconciler())
        self.viewer = _build_view(config, self._read_viewer_history)
        self._viewer_url = ""  # last announced URL of the web viewer
        self.hooks = Hooks(config.hooks, self.zenoh.publish_json_return_error)
        self.metrics = _build_metrics_output(config)
        self.influx = _build_influx_output(config)
        self.ros2 = _build_ros2_output(config)
        viewer = None if self.viewer is None else ViewerOutput(self.viewer)
        optional = (self.metrics, self.influx, self.ros2, viewer, self.history)
        self.outputs += [ZenohOutput(self.zenoh), self.hooks, *more, *(one for one in optional if one is not None)]

    def request_stop(self) -> None:
        """Request the end of the main loop, from any thread."""
        self._stop.set()
        self._wake.set()

    def request_reload(self) -> None:
        """Request a reload of the configuration file, from any thread."""
        self._reload_asked = True
        self._wake.set()

    def run(self, seconds: float | None = None) -> None:
        """Run the service until ``request_stop`` is called, all replays have ended, or ``seconds`` have passed."""
        threading.Thread(target=self._ready.compile_kernels, args=(self._wake,), name="warm-up", daemon=True).start()
        try:
            self._start()
            self.run_main_loop(None if seconds is None else time.monotonic() + seconds)
        finally:
            self._close()

    def _start(self) -> None:
        for output in (self.history, self.zenoh, self.metrics, self.influx, self.ros2, self.viewer):
            if output is not None:
                output.start()
        for worker in self.workers:
            worker.start_reader_and_resume_recording()
        if self.recorder is not None:
            self.recorder.start()
            threading.Thread(target=self._rebuild_windows, args=(self.workers,), name="rebuild", daemon=True).start()

    def run_main_loop(self, until_s: float | None) -> None:
        """Process the samples of all devices in rounds, and publish the status once a second.

        The loop ends after ``request_stop``, at the end of all replays, or at the monotonic time ``until_s``.
        """
        status_s = 0.0
        while not self._stop.is_set():
            now_s = time.monotonic()
            self._work_devices(now_s)
            workers = {worker.name: worker for worker in self.workers}
            self._commands.handle_commands(workers)
            self._commands.publish_reconciled(workers)
            if now_s >= status_s:
                status_s = now_s + STATUS_INTERVAL_S
                self._publish_status()
            if until_s is not None and now_s >= until_s:
                return
            if all(worker.replay_finished for worker in self.workers):
                return
            if self._reload_asked:
                self._reload_asked = False
                self._reload()
            self._wake.wait(MAX_IDLE_S)
            self._wake.clear()
            if not any(worker.device.publish_s == 0.0 for worker in self.workers):
                self._stop.wait(ROUND_PAUSE_S)

    def _work_devices(self, now_s: float) -> None:
        for worker in self.workers:
            worker.process_new_samples(now_s)
            self.zenoh.set_alive(worker.name, worker.driver.state == "running")

    def output_states(self) -> dict[str, str]:
        """Return the state of each output by name: "ok", or a description of the problem."""
        outputs = {
            "zenoh": self.zenoh,
            "viewer": self.viewer,
            "recording": self.recorder,
            "history": self.history,
            "metrics": self.metrics,
            "influx": self.influx,
            "ros2": self.ros2,
            "hook": self.hooks if self.hooks.hooks else None,
            **self._writers,
        }
        return {name: output.state for name, output in outputs.items() if output is not None}

    def _read_viewer_history(self, device: str) -> HistoryTable | None:
        """Return the stored results that the viewer shows at the start, or None if there are no results.

        Results of a device with its own time stamps, such as a replayed recording, are not shown.
        """
        history_s = self.config.viewer.history
        self_timed = any(worker.name == device and worker.driver.times_are_unix for worker in self.workers)
        if self.history is None or history_s is None or self_timed:
            return None
        assert isinstance(history_s, float)
        return self.history.read_recent_history(device, history_s)

    def _rebuild_windows(self, workers: Sequence[DeviceWorker]) -> None:
        self._ready.all.wait()
        for worker in workers:
            worker.refill_window_from_recording()

    def _build_worker(self, device: Device) -> DeviceWorker:
        link, simulated = device.link, None
        if isinstance(link, VirtualTable):
            from monitor.simulator import SimulatedDevice

            simulated = SimulatedDevice(link, device.decoder, device.name)
            link = simulated.port.link
        return DeviceWorker(device, link, self.outputs, self._wake, self._ready, self.recorder, simulated)

    # --- reload of the configuration

    def _reload(self) -> None:
        """Read the configuration file again, and apply the changes if the file contains no error."""
        self._unit.send_reloading()
        try:
            change = config_changes.compare_with_file(
                self.config, {worker.name: worker.model for worker in self.workers}
            )
            built = [self._build_worker(device) for device in change.added]
        except ConfigError as error:
            _log.error("not reloaded, the running configuration stays in force", error=str(error))
        else:
            self._apply(change, built)
            (_log.warning if change.restart else _log.info)("reloaded", text=change.describe_changes())
        if self._unit.ready_sent:
            self._unit.send_ready()

    def _apply(self, change: ConfigChange, built: Sequence[DeviceWorker]) -> None:
        leaving = [worker for worker in self.workers if worker.name in change.removed]
        for worker in leaving:
            worker.stop_reader_thread()  # all readers stop in parallel
        for worker in leaving:
            self._remove(worker)
        for device in change.limited:
            next(worker for worker in self.workers if worker.name == device.name).replace_limits(device)
        self.config = change.config
        self.hooks.hooks = change.config.hooks
        set_log_level(change.config.log.level)
        order = [device.name for device in change.config.devices]
        self.workers = sorted([*self.workers, *built], key=lambda worker: order.index(worker.name))
        if self.viewer is not None:
            self.viewer.set_detailed_devices(_device_features(change.config.devices))
        for worker in built:
            self._start_added(worker)

    def _start_added(self, worker: DeviceWorker) -> None:
        self.zenoh.add_device(worker.name)
        if self.ros2 is not None:
            self.ros2.add_device(worker.device)
        if self.recorder is not None:
            self.recorder.start_recordings(_segment_origins(self.config.storage, worker.device))
        worker.start_reader_and_resume_recording()
        if self.recorder is not None:
            threading.Thread(target=self._rebuild_windows, args=([worker],), name="rebuild", daemon=True).start()

    def _remove(self, worker: DeviceWorker) -> None:
        """Publish the remaining samples of a stopped device and remove the device, while other devices continue."""
        if not self._work_until(lambda: worker.join_reader_thread(0.0) and not worker.restore.active):
            _log.warning("reader did not end in time", device=worker.name)
        worker.process_new_samples(time.monotonic(), drain=True)
        self.workers = [one for one in self.workers if one is not worker]
        self.zenoh.remove_device(worker.name)
        if self.recorder is not None:
            self.recorder.remove_device(worker.name)
            self._work_until(lambda: self.recorder is None or not self.recorder.is_recording(worker.name))
        for output in self.outputs:
            output.remove_device(worker.name)

    def _work_until(self, done: Callable[[], bool]) -> bool:
        """Process all devices until ``done`` returns True or JOIN_TIMEOUT_S has passed; return the value of
        ``done``.
        """
        until_s = time.monotonic() + JOIN_TIMEOUT_S
        while not (ended := done()) and time.monotonic() < until_s:
            self._work_devices(time.monotonic())
            time.sleep(ROUND_PAUSE_S)
        return ended

    # --- status and commands

    def _publish_status(self) -> None:
        self._publish_recorder_events()
        states, memory = self.output_states(), _measure_memory_bytes()
        self._announce_viewer_url()
        healths = {worker.name: worker.slew_and_publish_status(states, memory) for worker in self.workers}
        if self.ros2 is not None:
            self.ros2.publish_diagnostics()
        self._notify_systemd(healths, states)

    def _notify_systemd(self, healths: Mapping[str, Health], states: Mapping[str, str]) -> None:
        now_s = time.monotonic()
        tried = (
            not any(state in STARTING_STATES for state in states.values()) or now_s - self._started_s > READY_TIMEOUT_S
        )
        if tried and not self._unit.ready_sent:
            self._unit.send_ready()
        turns = {worker.name: worker.reader_progress_count for worker in self.workers}
        stuck = self._unit.send_watchdog({name: count for name, count in turns.items() if count is not None}, now_s)
        self._unit.send_status(format_service_status(healths, states, stuck))

    def _publish_recorder_events(self) -> None:
        workers = {worker.name: worker for worker in self.workers}
        for event in self.recorder.take_events() if self.recorder is not None else ():
            if event.device in workers:
                workers[event.device].publish_event(event.kind, event.text)

    def _announce_viewer_url(self) -> None:
        """Log the URL of the web viewer each time the URL changes."""
        url = self.viewer.url if self.viewer is not None else ""
        page = url if url.startswith("http://") else ""
        if page == self._viewer_url:
            return
        self._viewer_url = page
        if page:
            _log.info("viewer", url=page)
        for output in self.outputs:
            if isinstance(output, TableOutput):
                output.set_viewer_url(page)

    def _close(self) -> None:
        self._unit.send_stopping()
        try:
            self._drain()
        finally:
            self._commands.abort_reconciliations()
            self._commands.publish_reconciled({worker.name: worker for worker in self.workers})
            exporters = (self.metrics, self.influx, self.ros2, self.viewer, self.zenoh)
            for output in (self.recorder, self.hooks, *exporters, self.history):
                if output is not None:
                    output.close()

    def _drain(self) -> None:
        for worker in self.workers:
            worker.stop_reader_thread()
        if any(worker.waits_for_all for worker in self.workers):
            self._ready.all.wait()  # the samples are still in the ring buffer
        for worker in self.workers:
            until_s = time.monotonic() + JOIN_TIMEOUT_S
            while not (ended := worker.join_reader_thread(ROUND_PAUSE_S)) and time.monotonic() < until_s:
                worker.process_new_samples(time.monotonic())  # a replay waits for space in the ring buffer
            if not ended:
                _log.warning("reader did not end in time", device=worker.name)
            worker.process_new_samples(time.monotonic(), drain=True)
            self.zenoh.set_alive(worker.name, False)
        self._publish_status()


def _build_recorder(config: Config) -> Recorder | None:
    storage = config.storage
    origins = [one for device in config.devices for one in _segment_origins(storage, device)]
    return Recorder(storage, origins) if storage is not None and origins else None


def _segment_origins(storage: Storage | None, device: Device) -> list[SegmentMetadata]:
    """Return the metadata of the recordings to write for a device, or an empty list for a replay."""
    if storage is None or isinstance(device.link, ReplayLink):
        return []
    origins = [segment_metadata(device.name, device.axes)] if storage.record else []
    return origins + (
        [segment_metadata(device.name, device.axes, "raw", device.decoder.carrier)] if storage.raw else []
    )


def _measure_memory_bytes() -> int:
    import resource  # missing on Windows

    try:
        return int(Path("/proc/self/statm").read_text("ascii").split()[1]) * resource.getpagesize()
    except OSError:  # only the peak is available outside Linux
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024


def _build_metrics_output(config: Config) -> "MetricsOutput | None":
    if config.metrics is None:
        return None
    from monitor.daemon.operations.prometheus_metrics import (
        MetricsOutput,  # imports http.server, so only if it is needed
    )

    return MetricsOutput(config.metrics)


def _build_influx_output(config: Config) -> "InfluxOutput | None":
    settings = config.influx
    if settings is None or settings.url is None:
        return None
    from monitor.daemon.outputs.influx_output import InfluxOutput  # imports http.client, so only if it is needed

    return InfluxOutput(settings.url, settings.token_file, settings.interval_s)


def _build_ros2_output(config: Config) -> "Ros2Output | None":
    if config.ros2 is None:
        return None
    from monitor.daemon.outputs.ros2_output import Ros2Output

    return Ros2Output(config.ros2, config.devices)


def _build_view(config: Config, recall: Callable[[str], HistoryTable | None]) -> "RerunView | None":
    if config.viewer.mode == "none":
        return None
    from monitor.publishing.rerun.queued_view import RerunView

    own = config.viewer
    return RerunView(
        ViewerSettings(own.mode, own.port, own.web_port, own.memory), _device_features(config.devices), recall
    )


def _device_features(devices: Sequence[Device]) -> list[ViewerDeviceDescription]:
    return [
        ViewerDeviceDescription(
            device.name,
            "simulated" if isinstance(device.link, VirtualTable) else device.link.name,
            device.model is not None,
            device.thermal_s is not None,
            device.compensate,
        )
        for device in devices
    ]
