"""Functions that run the service in a terminal, with a live table, log lines and signal handlers.

A separate thread writes to the terminal, so that a blocked terminal or pipe cannot delay the processing of samples.
"""

import contextlib
import errno
import gc
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NoReturn, TextIO, cast

from drivers.errors import ConfigError
from drivers.secret_masking import mask_secrets
from monitor.cli.shared.errors import name_option_in_config_errors
from monitor.common.control_characters import remove_control_characters

if TYPE_CHECKING:
    from collections.abc import MutableMapping

    from monitor.common.unit_formatting import UnitSystem
    from monitor.publishing.terminal.queued_writer import QueuedWriter
    from monitor.settings.loading import Config

STDOUT: Final = "standard output"
STDERR: Final = "standard error"


def run_service(config: "Config", seconds: float | None, viewer_mode: str | None, units: str | None) -> None:
    """Run the service with a live table in a terminal, or with log lines if standard output is not a terminal.

    Without a terminal, the final table is printed when the service ends.

    Parameters
    ----------
    config : Config
        Configuration of the service.
    seconds : float or None
        Duration in seconds. If None, the service runs until a signal is received or all replays have ended.
    viewer_mode : str or None
        Viewer mode that replaces the configured mode. None keeps the configured mode.
    units : str or None
        Unit system of the table and the viewer. None keeps the configured units.

    Raises
    ------
    ConfigError
        If the viewer mode, the unit system or a device cannot be used.
    OSError
        If the final table could not be written to a file or pipe, and no signal ended the service.
    """
    import threading

    import structlog

    from monitor.common.unit_formatting import UNIT_SYSTEMS
    from monitor.daemon.daemon_process import STATUS_INTERVAL_S, DaemonProcess
    from monitor.daemon.operations.systemd import SystemdNotifier
    from monitor.daemon.outputs.terminal_outputs import EventAndStatusLogOutput, TableOutput
    from monitor.daemon.service import Service
    from monitor.daemon.workers.device_spreading import count_workers
    from monitor.daemon.workers.supervisor import WorkerSupervisor
    from monitor.publishing.remote_device_states import RemoteDeviceRegistry
    from monitor.publishing.terminal.console import Console
    from monitor.publishing.terminal.live_device_table import LiveTable
    from monitor.publishing.terminal.queued_writer import QueuedWriter

    unit = SystemdNotifier.from_environment(os.environ)
    config = _with_viewer(config, viewer_mode, units)
    console, board, asked = Console(file=sys.stdout), RemoteDeviceRegistry(), threading.Event()
    table = LiveTable(console, units=UNIT_SYSTEMS[config.viewer.units], begun_s=time.monotonic())
    terminal = console.is_terminal
    screen = QueuedWriter(sys.stdout, STDOUT, table.render, STATUS_INTERVAL_S if terminal else None, tell=_warn)
    writers = {"terminal": screen} if terminal else {}
    shared = terminal and _same_file(sys.stdout, sys.stderr)
    if not shared:
        writers["log"] = QueuedWriter(sys.stderr, STDERR, tell=_warn)
    with _stderr_through(screen if shared else writers["log"]):
        _configure_logging(config)
        for line in config.warnings:
            structlog.get_logger("imu-monitor").warning(line)
        if not shared:
            screen.start()
        try:
            outputs = (
                [TableOutput(board, screen.request_redraw)]
                if terminal
                else [TableOutput(board), EventAndStatusLogOutput()]
            )
            gc.freeze()  # a full collection would examine all imported modules and stop every thread for 0.1 s
            workers = count_workers(config)
            service: DaemonProcess = (
                Service(config, outputs, unit=unit, writers=writers)
                if workers == 1
                else WorkerSupervisor(config, workers, outputs, unit, writers)
            )

            def stop() -> None:
                asked.set()
                service.request_stop()

            # A service in a terminal receives SIGHUP when the terminal is closed.
            install_signal_handlers(stop, stop if terminal else service.request_reload)
            table.states = board
            service.run(seconds)
        finally:
            unread = not screen.close()
        lost = _table_error(screen, unread)
        if lost is not None and not terminal and asked.is_set():
            structlog.get_logger("imu-monitor").warning("the final table was not written", error=str(lost))
    if lost is not None and not terminal and not asked.is_set():
        raise lost


def _table_error(screen: "QueuedWriter", unread: bool) -> Exception | None:
    """Return the error that prevented the final table from being printed, or None."""
    from monitor.publishing.terminal.queued_writer import CLOSE_S

    if unread:
        return TimeoutError(f"{STDOUT}: the final table was not written, because nobody read it for {CLOSE_S:g} s")
    error = screen.error
    if isinstance(error, OSError) and error.errno == errno.EBADF:
        return None  # standard output was closed from the start
    if isinstance(error, OSError) and not isinstance(error, BrokenPipeError):
        return OSError(f"{STDOUT}: the final table could not be written: {error.strerror}")
    return error


def run_fleet_viewer(
    keyexpr: str,
    connect: Sequence[str],
    zenoh_file: Path | None,
    detailed_devices: Sequence[str],
    viewer_mode: str,
    seconds: float | None,
    units: "UnitSystem",
) -> None:
    """Show the devices of several daemons in one viewer until a signal is received.

    Parameters
    ----------
    keyexpr : str
        Zenoh key expression (topic pattern) that selects the daemons.
    connect : sequence of str
        Zenoh endpoints to which the viewer connects.
    zenoh_file : Path or None
        Zenoh configuration file.
    detailed_devices : sequence of str
        Devices that are shown with samples and Allan deviations.
    viewer_mode : str
        Viewer mode.
    seconds : float or None
        Duration in seconds. If None, the viewer runs until a signal is received.
    units : UnitSystem
        Units of tables and plots.

    Raises
    ------
    ConfigError
        If the viewer mode is invalid.
    """
    import threading

    from monitor.publishing.rerun.fleet import FleetView, full_device_key
    from monitor.publishing.rerun.queued_view import RerunView
    from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription, ViewerSettings
    from monitor.publishing.terminal.queued_writer import QueuedWriter
    from monitor.publishing.zenoh.subscriber import ZenohSubscriber
    from monitor.settings import loading

    with name_option_in_config_errors("--viewer"):
        loading.check_viewer_mode(viewer_mode)
    keys = tuple(dict.fromkeys(full_device_key(device, keyexpr) for device in detailed_devices))
    arriving = ZenohSubscriber(keyexpr, connect, zenoh_file, keys)
    rerun = RerunView(
        ViewerSettings(mode=viewer_mode, units=units),
        [ViewerDeviceDescription(key, "over zenoh") for key in keys],
        fleet=True,
    )
    stop = threading.Event()
    install_signal_handlers(stop.set)

    def say(text: str) -> None:
        print(text, file=_StderrIgnoringWriteErrors(), flush=True)

    log = QueuedWriter(sys.stderr, STDERR, tell=say)
    with _stderr_through(log), contextlib.closing(arriving), contextlib.closing(rerun):
        arriving.start()
        rerun.start()
        FleetView(arriving, rerun, keys).run(stop, say, seconds)


def with_viewer_history_length(config: "Config", history_s: float | None) -> "Config":
    """Return a copy of the configuration with a different length of the history that the viewer shows.

    Parameters
    ----------
    config : Config
        Configuration.
    history_s : float or None
        Length of the history in seconds. None keeps the configured length.

    Raises
    ------
    ConfigError
        If no history is stored with this configuration.
    """
    import dataclasses

    if history_s is None:
        return config
    if config.storage is None or not config.storage.history:
        raise ConfigError("--history: there is no history to show; set folder in [storage]")
    return dataclasses.replace(config, viewer=config.viewer.model_copy(update={"history": history_s}))


def _with_viewer(config: "Config", mode: str | None, units: str | None) -> "Config":
    """Return a copy of the configuration with a different viewer mode or unit system. None keeps the configured one."""
    import dataclasses

    from monitor.cli.shared.options import parse_units
    from monitor.settings import loading

    if mode is not None:
        with name_option_in_config_errors("--viewer"):
            loading.check_viewer_mode(mode)
    if units is not None:
        parse_units(units)
    stated = {key: value for key, value in (("mode", mode), ("units", units)) if value is not None}
    return dataclasses.replace(config, viewer=config.viewer.model_copy(update=stated))


@contextlib.contextmanager
def _stderr_through(writer: "QueuedWriter") -> Iterator[None]:
    """Redirect standard error to a separate writer thread.

    If the writer thread is still blocked when the context ends, standard error is redirected to the null device.
    """
    from monitor.publishing.terminal.queued_writer import (
        QueuedLines,
        can_write,
        descriptor_of,
        redirect_to_null_device,
    )

    stream = sys.stderr
    with contextlib.redirect_stderr(QueuedLines(writer, stream is not None and stream.isatty())):
        writer.start()
        try:
            yield
        finally:
            if not writer.close() or not can_write(descriptor_of(stream)):
                redirect_to_null_device(stream)


def _same_file(one: TextIO | None, other: TextIO | None) -> bool:
    """Return True if two streams write to the same terminal, pipe or file."""
    from monitor.publishing.terminal.queued_writer import descriptor_of

    descriptors = descriptor_of(one), descriptor_of(other)
    return None not in descriptors and os.path.sameopenfile(*cast("tuple[int, int]", descriptors))


def _warn(text: str) -> None:
    import structlog

    structlog.get_logger("imu-monitor").warning("log", text=text)


class _StderrIgnoringWriteErrors:
    """Text stream that writes to the current standard error and ignores write errors.

    A subclass of ``io.IOBase`` would be flushed when the interpreter ends, after this module has been cleared.
    """

    def write(self, text: str) -> int:
        """Write text to standard error. Write errors, such as a full disk, are ignored."""
        with contextlib.suppress(OSError):
            sys.stderr.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            sys.stderr.flush()


def _configure_logging(config: "Config") -> None:
    import structlog

    from monitor.daemon.operations.log_level import set_log_level

    json = config.log.format == "json"
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            _without_secrets_and_control_characters,
            structlog.processors.JSONRenderer() if json else structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty()),
        ],
        logger_factory=structlog.PrintLoggerFactory(cast("TextIO", _StderrIgnoringWriteErrors())),
        cache_logger_on_first_use=False,  # reloading the configuration may change the log level
    )
    set_log_level(config.log.level)


def _without_secrets_and_control_characters(
    _logger: Any, _method: str, line: "MutableMapping[str, Any]"
) -> "MutableMapping[str, Any]":
    texts = {
        key: remove_control_characters(mask_secrets(value)) for key, value in line.items() if isinstance(value, str)
    }
    return {**line, **texts}


def install_signal_handlers(stop: Callable[[], None], on_hangup: Callable[[], None] | None = None) -> None:
    """Install handlers for the signals SIGINT, SIGTERM and SIGHUP.

    The first SIGINT or SIGTERM calls ``stop``. A second SIGINT ends the process immediately. SIGHUP calls
    ``on_hangup``.

    Parameters
    ----------
    stop : callable
        Function that starts an orderly shutdown.
    on_hangup : callable, optional
        Function that handles SIGHUP. By default, the existing handler of SIGHUP is kept.
    """
    import threading

    def handle_first_signal(number: int, _frame: Any) -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        # Call ``stop`` in another thread, because the main thread may hold the lock of the event that ``stop`` sets.
        threading.Thread(target=stop, name="stop", daemon=True).start()

    signal.signal(signal.SIGINT, handle_first_signal)
    signal.signal(signal.SIGTERM, handle_first_signal)
    if on_hangup is not None:
        call = on_hangup
        signal.signal(signal.SIGHUP, lambda *_: threading.Thread(target=call, name="hung up", daemon=True).start())


def exit_on_sigterm() -> None:
    """Make SIGTERM end the program in the same way as Ctrl-C, so that incomplete files are removed."""

    def ended(_number: int, _frame: Any) -> NoReturn:
        sys.exit(128 + signal.SIGTERM)

    signal.signal(signal.SIGTERM, ended)
