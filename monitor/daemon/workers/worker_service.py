"""Worker process of the daemon: a ``Service`` of some devices, whose results are sent to the main process.

The worker reads its devices, estimates their noise and records their samples. A pipe carries the calls of the outputs
to the main process, which publishes them. In the other direction, the pipe carries commands. A worker stops when the
main process asks for it, and also when the main process ends.
"""

import gc
import os
import signal
import threading
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, NamedTuple, NoReturn

import structlog

from drivers.data_types import Event, Ints, SampleBlock
from drivers.errors import ConfigError
from monitor.common.device_health import Health
from monitor.daemon.config_changes import compare_configurations
from monitor.daemon.operations.log_level import set_log_level
from monitor.daemon.operations.systemd import SystemdNotifier
from monitor.daemon.outputs.output import Output
from monitor.daemon.service import Service
from monitor.publishing.zenoh.publisher import Command
from monitor.settings import loading
from monitor.settings.loading import Config

START: Final = "start"
STOP: Final = "stop"
RELOAD: Final = "reload"
ENDED: Final = "ended"
COMMAND: Final = "command"

_log = structlog.get_logger("imu-monitor")


class Call(NamedTuple):
    """A method call to the other process."""

    name: str
    arguments: tuple[Any, ...]


class PipeOutput(Output):
    """Output that sends all calls of one round to the main process as one message.

    Parameters
    ----------
    connection : Connection
        Pipe to the main process.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._calls: deque[Call] = deque()

    def call(self, name: str, *arguments: Any) -> None:
        """Add a call to the next message, from any thread."""
        self._calls.append(Call(name, arguments))

    def finish_round(self) -> None:
        """Send the collected calls. If the main process has ended, the calls are dropped."""
        calls = [self._calls.popleft() for _ in range(len(self._calls))]
        if calls:
            with suppress(OSError):  # the main process has ended, so that this process ends as well
                self._connection.send(calls)

    def publish_samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Send a block of samples."""
        self.call("publish_samples", device, received, samples, offset_ns)

    def publish_drift_compensated_samples(
        self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int
    ) -> None:
        """Send a block of samples after compensation of the gyroscope drift."""
        self.call("publish_drift_compensated_samples", device, received, samples, offset_ns)

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Send a result."""
        self.call("publish_result", device, unix_s, received, result)

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Send an event."""
        self.call("publish_event", device, unix_s, received, event)

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Send the status of a device."""
        self.call("publish_health", device, unix_s, health)

    def set_alive(self, device: str, samples_arrive: bool) -> None:
        """Send whether samples of a device arrive."""
        self.call("set_alive", device, samples_arrive)


class _ProgressNotifier(SystemdNotifier):
    """Notifier that sends the progress of the readers to the main process, which notifies systemd."""

    def __init__(self, output: PipeOutput) -> None:
        super().__init__()
        self._output = output

    def send_watchdog(self, reader_progress_count: Mapping[str, int], now_s: float) -> list[str]:
        self._output.call("set_progress", dict(reader_progress_count))
        return []


class WorkerService(Service):
    """Handles a subset of the devices and sends their results to the main process.

    Parameters
    ----------
    config : Config
        Configuration of the devices of this process.
    output : PipeOutput
        Output to the main process.
    main_pid : int
        Process id of the main process, in whose name the recording folder is locked.
    """

    def __init__(self, config: Config, output: PipeOutput, main_pid: int) -> None:
        super().__init__(config, [output], unit=_ProgressNotifier(output), owner_pid=main_pid)
        self._output = output
        self._new_table: tuple[Any, ...] = ()  # arguments of the last call RELOAD
        self.generation = 0
        """Number of the newest applied configuration."""

    def receive_calls(self, connection: Connection) -> None:
        """Execute calls from the main process until it requests a stop or exits, or until no call can be received."""
        try:
            with suppress(EOFError, OSError):
                while (call := connection.recv()).name != STOP:
                    self._execute(call)
        finally:  # a worker that receives no calls, for example without free memory, would never end
            self.request_stop()

    def _execute(self, call: Call) -> None:
        if call.name == RELOAD:
            self._new_table = call.arguments
            self.request_reload()
        elif call.name == COMMAND:
            number, device, verb = call.arguments
            reply, refuse = (partial(self._output.call, name, number) for name in ("reply_result", "reply_refusal"))
            self.zenoh.commands.put(Command(device, verb, reply, refuse))

    def _begin_reload(self) -> None:
        table, folder, self.generation = self._new_table
        try:
            new, models = loading.load_selected_devices(table, folder), {one.name: one.model for one in self.workers}
            self._apply(compare_configurations(self.config, new, models))
        except ConfigError as error:  # for example, a file has been deleted since the main process read it
            _log.error("not reloaded, the running configuration stays in force", error=str(error))
        for name, samples_arrive in self._alive.items():  # the main process may have removed and added a device
            self._output.set_alive(name, samples_arrive)


def run_worker(descriptor: int) -> NoReturn:
    """Run a worker process until the main process asks it to stop.

    Parameters
    ----------
    descriptor : int
        File descriptor of the socket to the main process, whose first message is the configuration.
    """
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):  # systemd sends SIGTERM to all processes of a unit
        signal.signal(number, signal.SIG_IGN)
    with Connection(descriptor) as connection:
        table, folder, main_pid = connection.recv().arguments
        output = PipeOutput(connection)
        _send_log_lines(output)
        try:
            _run_service(table, folder, main_pid, connection, output)
        except ConfigError as error:
            output.call("refuse", error.mistake_lines)
        output.finish_round()
    os._exit(0)  # threads that identify drift models abort a process whose interpreter ends


def _run_service(
    table: Mapping[str, Any], folder: Path, main_pid: int, connection: Connection, output: PipeOutput
) -> None:
    config = loading.load_selected_devices(table, folder)
    set_log_level(config.log.level)
    gc.freeze()  # as in the main process
    service = WorkerService(config, output, main_pid)
    threading.Thread(target=service.receive_calls, args=(connection,), name="calls", daemon=True).start()
    service.run()
    output.call(ENDED, service.generation)


def _send_log_lines(output: PipeOutput) -> None:
    """Send all log lines to the main process."""

    def send(_logger: Any, method: str, line: Any) -> NoReturn:
        output.call("log", method, dict(line))
        raise structlog.DropEvent

    structlog.configure(processors=[send], cache_logger_on_first_use=False)
