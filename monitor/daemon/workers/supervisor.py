"""Main process of a daemon with worker processes: starts the workers, publishes their results, and restarts them.

Each worker process runs a ``Service`` with some of the devices. This process owns all outputs, so that subscribers, the
viewer, the table and the metrics do not depend on the number of workers. If a worker ends unexpectedly, its devices are
reported as lost, and a new process continues with the windows from the recording.
"""

import os
import socket
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from multiprocessing import connection as pipes
from pathlib import Path
from typing import Any, Final

import structlog

from drivers.errors import ConfigError, describe_error
from monitor.common.device_health import Health
from monitor.common.program_command_line import PROGRAM
from monitor.daemon import config_changes
from monitor.daemon.config_changes import ConfigChange
from monitor.daemon.daemon_process import MAX_IDLE_S, DaemonProcess, measure_memory_bytes
from monitor.daemon.operations.coefficient_limits import read_model_in_force
from monitor.daemon.operations.systemd import SystemdNotifier
from monitor.daemon.outputs.output import Output, call_outputs
from monitor.daemon.workers.device_spreading import spread_devices
from monitor.daemon.workers.worker_service import COMMAND, RELOAD, START, STOP, Call
from monitor.publishing.terminal.queued_writer import QueuedWriter
from monitor.publishing.zenoh.publisher import Command
from monitor.settings import loading
from monitor.settings.loading import Config, VirtualTable

RESTART_PAUSE_S: Final = 2.0
"""Delay before a worker is restarted, long enough for the ended worker to finish its recording."""
STOP_TIMEOUT_S: Final = 60.0
"""Longest wait for the end of all workers. A worker may compile kernels before it can process its last samples."""
MAX_MESSAGES: Final = 10
"""Maximum number of messages of one worker in a round."""

_log = structlog.get_logger("imu-monitor")


class _Worker:
    """Worker process, which is kept running as long as it has devices."""

    def __init__(self, number: int) -> None:
        self.name = f"worker {number}"
        self.devices: tuple[str, ...] = ()  # devices of the newest configuration, which the process may not have yet
        self.generation = 0  # number of the newest configuration that was sent
        self.ended_generation = -1  # number of the configuration with which the process ended
        self.progress: Mapping[str, int] = {}
        self.memory_bytes = 0
        self.restart_s: float | None = None  # monotonic time of the next start, or None
        self.process: subprocess.Popen[bytes] | None = None
        self.pipe: pipes.Connection | None = None

    def start(self, table: Mapping[str, Any], folder: Path) -> None:
        """Start the process with the configuration of its devices. Raise OSError if this is impossible."""
        ours, theirs = socket.socketpair()
        with ours, theirs:
            descriptor = theirs.fileno()
            self.process = subprocess.Popen(  # a session of its own, because the terminal sends Ctrl-C to all processes
                [*PROGRAM, "worker", str(descriptor)], pass_fds=[descriptor], start_new_session=True
            )
            self.pipe, self.restart_s = pipes.Connection(ours.detach()), None
        self.generation, self.ended_generation = 0, -1
        self.call(START, table, folder, os.getpid())

    def call(self, name: str, *arguments: Any) -> None:
        """Send a call to the process. If the process has ended, ``receive`` will report the end."""
        if self.pipe is not None:
            with suppress(OSError):
                self.pipe.send(Call(name, arguments))

    def receive(self) -> list[Call]:
        """Return the calls that have arrived. Raise EOFError at the end of the process."""
        calls: list[Call] = []
        for _ in range(MAX_MESSAGES):
            if self.pipe is None or not self.pipe.poll():
                break
            try:
                calls += self.pipe.recv()
            except (EOFError, OSError) as error:  # an OSError means that the process was killed
                if calls:
                    break  # the next call reports the end
                raise EOFError from error
        return calls

    def reap(self, timeout_s: float | None = None) -> int:
        """Return the exit status of the ended process."""
        assert self.process is not None
        assert self.pipe is not None
        self.pipe.close()
        self.pipe, self.progress, self.memory_bytes = None, {}, 0
        return self.process.wait(timeout_s)


class WorkerSupervisor(DaemonProcess):
    """Daemon whose devices are spread over worker processes.

    Parameters
    ----------
    config : Config
        Configuration to run.
    workers : int
        Number of worker processes.
    more : sequence of Output, optional
        Additional outputs, for example the table in the terminal.
    unit : SystemdNotifier, optional
        Notifier of systemd. By default, no message is sent.
    writers : mapping of str to QueuedWriter, optional
        Text outputs by name, such as "terminal" and "log".

    Raises
    ------
    ConfigError
        If a noise model is invalid.
    """

    def __init__(
        self,
        config: Config,
        workers: int,
        more: Sequence[Output] = (),
        unit: SystemdNotifier | None = None,
        writers: Mapping[str, QueuedWriter] | None = None,
    ) -> None:
        super().__init__(config, more, unit, writers)
        self._models = {device.name: read_model_in_force(device) for device in config.devices}
        self._workers = [_Worker(number) for number in range(workers)]
        self._places: dict[str, int] = {}
        self._healths: dict[str, tuple[float | None, Health]] = {}
        self._states = self.output_states()
        self._commands: dict[int, tuple[_Worker, Command]] = {}  # unanswered commands by number
        self._command_count = 0

    def _start_devices(self) -> None:
        self._distribute_devices()

    def _distribute_devices(self) -> None:
        """Give each worker its devices: start it, or send it the new configuration.

        A worker without devices ends. The place of a removed device is kept, so that two processes never have it.
        """
        places = spread_devices(self.config.devices, len(self._workers), self._places)
        self._places |= places
        for number, worker in enumerate(self._workers):
            before, worker.devices = worker.devices, tuple(name for name, place in places.items() if place == number)
            if worker.pipe is not None:
                worker.generation += 1
                worker.call(RELOAD, *loading.select_devices(self.config, worker.devices), worker.generation)
            elif set(worker.devices) != set(before):
                worker.restart_s = time.monotonic() if worker.devices else None

    # --- one round

    def _work(self, now_s: float) -> None:
        for worker in self._workers:
            if worker.restart_s is not None and now_s >= worker.restart_s:
                self._start(worker)
            self._receive(worker)
        while not self.zenoh.commands.empty():
            self._forward(self.zenoh.commands.get_nowait())

    def _start(self, worker: _Worker) -> None:
        try:
            worker.start(*loading.select_devices(self.config, worker.devices))
        except OSError as error:
            _log.error("worker", text=f"{worker.name} cannot be started: {describe_error(error)}; trying again")
            worker.restart_s = time.monotonic() + RESTART_PAUSE_S

    def _receive(self, worker: _Worker) -> None:
        try:
            for call in worker.receive():
                self._execute(worker, call)
        except EOFError:
            self._handle_end(worker)

    def _execute(self, worker: _Worker, call: Call) -> None:
        match call.name, call.arguments:
            case "publish_health", (device, unix_s, health):
                worker.memory_bytes = health.memory_bytes
                if device in worker.devices:
                    self._publish_health(device, unix_s, health)
            case "set_progress", (progress,):
                worker.progress = progress
            case "log", (method, line):
                getattr(_log, method)(**line)
            case ("reply_result" | "reply_refusal") as reply, (number, answer):
                _, command = self._commands.pop(number)
                getattr(command, reply)(answer)
            case "ended", (generation,):
                worker.ended_generation = generation
            case "refuse", (lines,):
                if not self._stop.is_set():  # otherwise, another worker's refusal has already ended the daemon
                    raise ConfigError(*lines)
            case method, (device, *_) as arguments:
                if device in worker.devices:  # otherwise, the device was removed in the meantime
                    self._pass_on(method, *arguments)

    def _pass_on(self, method: str, *arguments: Any) -> None:
        call_outputs(self.outputs, method, *arguments)

    def _forward(self, command: Command) -> None:
        worker = self._workers[self._places[command.device]]
        if command.device not in worker.devices or worker.pipe is None:
            command.reply_refusal("the device is not running")
            return
        self._command_count += 1
        self._commands[self._command_count] = worker, command
        worker.call(COMMAND, self._command_count, command.device, command.verb)

    def _wait(self, round_start_s: float) -> None:
        running = [worker.pipe for worker in self._workers if worker.pipe is not None]
        if running:
            pipes.wait(running, MAX_IDLE_S)
        else:
            self._stop.wait(MAX_IDLE_S)

    def _has_ended(self) -> bool:
        return all(worker.pipe is None and worker.restart_s is None for worker in self._workers)

    def _handle_end(self, worker: _Worker) -> None:
        """Restart a worker, unless its replays have ended or its devices were removed."""
        status = worker.reap()
        for number, (_, command) in [one for one in self._commands.items() if one[1][0] is worker]:
            del self._commands[number]
            command.reply_refusal("the process of the device has ended")
        if self._stop.is_set() or (status == 0 and worker.ended_generation == worker.generation):
            return
        if status == 0 or not worker.devices:  # the newest configuration came after the end of the process
            worker.restart_s = time.monotonic() if worker.devices else None
            return
        how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        _log.error("worker", text=f"{worker.name} {how}; starting it again", devices=", ".join(worker.devices))
        worker.restart_s = time.monotonic() + RESTART_PAUSE_S
        for name in worker.devices:
            self._pass_on("set_alive", name, False)
            if name in self._healths:
                unix_s, health = self._healths[name]
                text = f"the process of this device {how}; it is being started again"
                self._publish_health(name, unix_s, replace(health, state="lost", rate_hz=None, text=text))

    # --- reload and status

    def _find_changes(self) -> ConfigChange:
        return config_changes.compare_with_file(self.config, self._models)

    def _apply(self, change: ConfigChange) -> None:
        for device in change.added:
            if isinstance(device.link, VirtualTable):
                from monitor.simulator.encoding_sensor import SimulatedSensor

                SimulatedSensor(device.link, device.decoder, device.name)  # raises ConfigError for invalid settings
        self._adopt(change.config)
        self._models = {device.name: read_model_in_force(device) for device in change.config.devices}
        for name in change.removed:
            self._healths.pop(name, None)
            self._pass_on("remove_device", name)
        for device in change.added:
            self._pass_on("add_device", device)
        self._distribute_devices()

    def _publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        memory = measure_memory_bytes() + sum(worker.memory_bytes for worker in self._workers)
        health = replace(health, outputs={**health.outputs, **self._states}, memory_bytes=memory)
        self._healths[device] = unix_s, health
        self._pass_on("publish_health", device, unix_s, health)

    def _publish_status(self) -> None:
        self._states = self.output_states()
        states = {name: state for _, one in self._healths.values() for name, state in one.outputs.items()}
        progress = {name: count for worker in self._workers for name, count in worker.progress.items()}
        self._report_status(
            {device: health for device, (_, health) in self._healths.items()}, {**states, **self._states}, progress
        )

    # --- end

    def _stop_devices(self) -> None:
        self._stop.set()
        for worker in self._workers:
            worker.restart_s = None
            worker.call(STOP)
        until_s = time.monotonic() + STOP_TIMEOUT_S
        while not self._has_ended() and time.monotonic() < until_s:
            for worker in self._workers:
                self._receive(worker)
            self._wait(time.monotonic())
        for worker in self._workers:
            if worker.pipe is not None and worker.process is not None:
                _log.warning("worker", text=f"{worker.name} did not end in {STOP_TIMEOUT_S:g} s and is killed")
                worker.process.kill()
                worker.reap()
        self._publish_status()
