"""Service that processes devices in its own process.

In each round of the main loop, every device worker processes the new samples and publishes the results.

To stop, the service stops the readers, processes the remaining samples, and closes the outputs.
"""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import structlog

from drivers.links.replay_link import ReplayLink
from drivers.recordings.segment_file import SegmentMetadata
from monitor.common.shared_library_memory import LLVM_LIBRARY, release_library_pages
from monitor.daemon import config_changes
from monitor.daemon.command_handler import CommandHandler
from monitor.daemon.config_changes import ConfigChange
from monitor.daemon.daemon_process import MAX_IDLE_S, DaemonProcess, measure_memory_bytes
from monitor.daemon.device.device_worker import DeviceWorker
from monitor.daemon.kernels.kernel_readiness import KernelReadiness
from monitor.daemon.operations.reconcile_on_request import Reconciler
from monitor.daemon.operations.systemd import SystemdNotifier
from monitor.daemon.outputs.output import Output, call_outputs
from monitor.daemon.storage.recorder import Recorder, segment_metadata
from monitor.publishing.terminal.queued_writer import QueuedWriter
from monitor.settings.loading import Config, Device, Storage, VirtualTable

ROUND_PAUSE_S: Final = 0.02
"""Shortest interval between the starts of two rounds if no device publishes every block."""
JOIN_TIMEOUT_S: Final = 3.0
"""Longest wait for the end of a reader thread."""

_log = structlog.get_logger("imu-monitor")


class Service(DaemonProcess):
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
    owner_pid : int, optional
        Process id of the daemon, whose processes record into one folder. By default, that of this process.

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
        owner_pid: int | None = None,
    ) -> None:
        super().__init__(config, more, unit, writers)
        self._ready = KernelReadiness()
        self.recorder = _build_recorder(config, owner_pid)
        self._alive: dict[str, bool] = {}  # True if samples of the device arrive
        self.workers = [self._build_worker(device) for device in config.devices]
        self._commands = CommandHandler(self.zenoh, reconciler or Reconciler())

    def _start_devices(self) -> None:
        threading.Thread(target=self._compile_kernels, name="warm-up", daemon=True).start()
        for worker in self.workers:
            worker.start_reader_and_resume_recording()
        if self.recorder is not None:
            self.recorder.start()
            threading.Thread(target=self._rebuild_windows, args=(self.workers,), name="rebuild", daemon=True).start()

    def _work(self, now_s: float) -> None:
        self._work_devices(now_s)
        workers = {worker.name: worker for worker in self.workers}
        self._commands.handle_commands(workers)
        self._commands.publish_reconciled(workers)

    def _work_devices(self, now_s: float) -> None:
        for worker in self.workers:
            worker.process_new_samples(now_s)
            self._set_alive(worker.name, worker.driver.state == "running")

    def _set_alive(self, device: str, samples_arrive: bool) -> None:
        if self._alive.get(device, False) != samples_arrive:
            self._alive[device] = samples_arrive
            call_outputs(self.outputs, "set_alive", device, samples_arrive)

    def _wait(self, round_start_s: float) -> None:
        self._wake.wait_and_clear(MAX_IDLE_S)
        pause_s = round_start_s + ROUND_PAUSE_S - time.monotonic()
        if pause_s > 0.0 and not any(worker.device.publish_s == 0.0 for worker in self.workers):
            self._stop.wait(pause_s)

    def _has_ended(self) -> bool:
        return all(worker.replay_finished for worker in self.workers)

    def output_states(self) -> dict[str, str]:
        """Return the state of each output and of the recording by name."""
        recording = {} if self.recorder is None else {"recording": self.recorder.state}
        return {**super().output_states(), **recording}

    def _compile_kernels(self) -> None:
        self._ready.compile_kernels(self._wake)
        release_library_pages(LLVM_LIBRARY)

    def _rebuild_windows(self, workers: Sequence[DeviceWorker]) -> None:
        self._ready.all.wait()
        for worker in workers:
            worker.refill_window_from_recording()

    def _build_worker(self, device: Device) -> DeviceWorker:
        link, simulated = device.link, None
        if isinstance(link, VirtualTable):
            from monitor.simulator.simulated_device import SimulatedDevice

            simulated = SimulatedDevice(link, device.decoder, device.name)
            link = simulated.port.link
        return DeviceWorker(device, link, self.outputs, self._wake, self._ready, self.recorder, simulated)

    # --- reload of the configuration

    def _find_changes(self) -> ConfigChange:
        return config_changes.compare_with_file(self.config, {worker.name: worker.model for worker in self.workers})

    def _apply(self, change: ConfigChange) -> None:
        built = [self._build_worker(device) for device in change.added]
        leaving = [worker for worker in self.workers if worker.name in change.removed]
        for worker in leaving:
            worker.stop_reader_thread()  # all readers stop in parallel
        self._remove(leaving)
        for device in change.limited:
            next(worker for worker in self.workers if worker.name == device.name).replace_limits(device)
        self._adopt(change.config)
        order = [device.name for device in change.config.devices]
        self.workers = sorted([*self.workers, *built], key=lambda worker: order.index(worker.name))
        for worker in built:
            self._start_added(worker)

    def _start_added(self, worker: DeviceWorker) -> None:
        call_outputs(self.outputs, "add_device", worker.device)
        if self.recorder is not None:
            self.recorder.start_recordings(_segment_origins(self.config.storage, worker.device))
        worker.start_reader_and_resume_recording()
        if self.recorder is not None:
            threading.Thread(target=self._rebuild_windows, args=([worker],), name="rebuild", daemon=True).start()

    def _remove(self, leaving: Sequence[DeviceWorker]) -> None:
        """Publish the remaining samples of stopped devices and remove the devices, while other devices continue."""

        def has_ended(worker: DeviceWorker) -> bool:
            return worker.join_reader_thread(0.0) and not worker.restore.active

        self._work_until(lambda: all(map(has_ended, leaving)))
        recorder = self.recorder
        for worker in leaving:
            if not has_ended(worker):
                _log.warning("reader did not end in time", device=worker.name)
            worker.process_new_samples(time.monotonic(), drain=True)
            self._alive.pop(worker.name, None)
            if recorder is not None:
                recorder.remove_device(worker.name)
        self.workers = [one for one in self.workers if one not in leaving]
        if recorder is not None:  # a device that is added again continues its recording
            self._work_until(lambda: not any(recorder.is_recording(worker.name) for worker in leaving))
        for worker in leaving:
            call_outputs(self.outputs, "remove_device", worker.name)

    def _work_until(self, done: Callable[[], bool]) -> None:
        """Process all devices until ``done`` returns True, JOIN_TIMEOUT_S has passed or the service must stop."""
        until_s = time.monotonic() + JOIN_TIMEOUT_S
        while not done() and time.monotonic() < until_s and not self._stop.is_set():
            self._work_devices(time.monotonic())
            time.sleep(ROUND_PAUSE_S)

    # --- status and end

    def _publish_status(self) -> None:
        self._publish_recorder_events()
        states, memory = self.output_states(), measure_memory_bytes()
        healths = {worker.name: worker.slew_and_publish_status(states, memory) for worker in self.workers}
        progress = {worker.name: worker.reader_progress_count for worker in self.workers}
        self._report_status(healths, states, {name: count for name, count in progress.items() if count is not None})

    def _publish_recorder_events(self) -> None:
        workers = {worker.name: worker for worker in self.workers}
        for event in self.recorder.take_events() if self.recorder is not None else ():
            if event.device in workers:
                workers[event.device].publish_event(event.kind, event.text)

    def _stop_devices(self) -> None:
        try:
            self._drain()
        finally:
            self._commands.abort_reconciliations()
            self._commands.publish_reconciled({worker.name: worker for worker in self.workers})
            if self.recorder is not None:
                self.recorder.close()

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
            self._set_alive(worker.name, False)
        self._publish_status()


def _build_recorder(config: Config, owner_pid: int | None) -> Recorder | None:
    storage = config.storage
    origins = [one for device in config.devices for one in _segment_origins(storage, device)]
    return Recorder(storage, origins, owner_pid=owner_pid) if storage is not None and origins else None


def _segment_origins(storage: Storage | None, device: Device) -> list[SegmentMetadata]:
    """Return the metadata of the recordings to write for a device, or an empty list for a replay."""
    if storage is None or isinstance(device.link, ReplayLink):
        return []
    origins = [segment_metadata(device.name, device.axes)] if storage.record else []
    return origins + (
        [segment_metadata(device.name, device.axes, "raw", device.decoder.carrier)] if storage.raw else []
    )
