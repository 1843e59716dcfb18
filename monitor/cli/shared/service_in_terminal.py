"""Service in a terminal: live table, log lines, and the signals that stop the service.

Table and log are written by threads (``QueuedWriter``). A blocked terminal or pipe therefore delays neither samples nor
the end of the process.
"""

import contextlib
import errno
import io
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NoReturn, TextIO, cast

from drivers.credential_masking import mask_secrets
from drivers.errors import ConfigError
from monitor.cli.shared.errors import name_option_in_config_errors

if TYPE_CHECKING:
    from collections.abc import MutableMapping

    from monitor.publishing.terminal.queued_writer import QueuedWriter
    from monitor.settings.loading import Config

STDOUT: Final = "standard output"
STDERR: Final = "standard error"


def run_service(config: "Config", seconds: float | None, viewer_mode: str | None) -> None:
    """Run the service, with a live table in a terminal, or else with log lines and the final table at the end.

    Parameters
    ----------
    config : Config
        Configuration to run.
    seconds : float or None
        Duration in seconds. If None, the service runs until a signal or the end of all replays.
    viewer_mode : str or None
        Viewer mode that replaces the mode of the configuration.

    Raises
    ------
    ConfigError
        If the viewer mode or a device cannot be used.
    OSError
        If the run ended without a signal, and the final table could not be written to a file or pipe.
    """
    import threading

    import structlog
    from rich.console import Console

    from monitor.daemon.operations.systemd import SystemdNotifier
    from monitor.daemon.result_outputs import LogOutput, TableOutput
    from monitor.daemon.service import STATUS_INTERVAL_S, Service
    from monitor.publishing.remote_devices import DeviceStates
    from monitor.publishing.terminal.live_table import LiveTable
    from monitor.publishing.terminal.queued_writer import QueuedWriter

    unit = SystemdNotifier.from_environment(os.environ)
    config = _with_viewer(config, viewer_mode)
    console, board, asked = Console(file=sys.stdout), DeviceStates(), threading.Event()
    table, terminal = LiveTable(console), console.is_terminal
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
            outputs = [TableOutput(board, screen.redraw)] if terminal else [TableOutput(board), LogOutput()]
            service = Service(config, outputs, unit=unit, writers=writers)

            def stop() -> None:
                asked.set()
                service.request_stop()

            # in a terminal, SIGHUP means that the terminal has been closed
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
    """Return the reason why the final table has not been written to standard output, or None if it has."""
    from monitor.publishing.terminal.queued_writer import CLOSE_S

    if unread:
        return TimeoutError(f"{STDOUT}: the final table was not written, because nobody read it for {CLOSE_S:g} s")
    error = screen.error
    if isinstance(error, OSError) and error.errno == errno.EBADF:
        return None  # standard output was already closed at the start, so no table is expected
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
) -> None:
    """Run the viewer of a fleet until a signal, and print its address and its errors on standard error.

    Parameters
    ----------
    keyexpr : str
        Zenoh key expression of the daemons.
    connect : sequence of str
        Zenoh endpoints to connect to.
    zenoh_file : Path or None
        Zenoh configuration file.
    detailed_devices : sequence of str
        Devices that are shown with samples and Allan deviations.
    viewer_mode : str
        Viewer mode.
    seconds : float or None
        Duration in seconds. If None, the viewer runs until a signal.

    Raises
    ------
    ConfigError
        If the viewer mode is invalid.
    """
    import threading

    from monitor.publishing.rerun.fleet import FleetView, full_device_key
    from monitor.publishing.rerun.queued_view import RerunView
    from monitor.publishing.rerun.viewer_settings import DeviceInfo, ViewerSettings
    from monitor.publishing.terminal.queued_writer import QueuedWriter
    from monitor.publishing.zenoh.subscriber import ZenohSubscriber
    from monitor.settings import loading

    with name_option_in_config_errors("--viewer"):
        loading.check_viewer_mode(viewer_mode)
    keys = tuple(dict.fromkeys(full_device_key(device, keyexpr) for device in detailed_devices))
    arriving = ZenohSubscriber(keyexpr, connect, zenoh_file, keys)
    rerun = RerunView(ViewerSettings(mode=viewer_mode), [DeviceInfo(key, "over zenoh") for key in keys], fleet=True)
    stop = threading.Event()
    install_signal_handlers(stop.set)

    def say(text: str) -> None:
        print(text, file=_ErrorStream(), flush=True)

    log = QueuedWriter(sys.stderr, STDERR, tell=say)
    with _stderr_through(log), contextlib.closing(arriving), contextlib.closing(rerun):
        arriving.start()
        rerun.start()
        FleetView(arriving, rerun, keys).run(stop, say, seconds)


def with_viewer_history_length(config: "Config", history_s: float | None) -> "Config":
    """Return the configuration with another length of the history in the viewer.

    Parameters
    ----------
    config : Config
        Configuration.
    history_s : float or None
        Length of the history in seconds. None keeps the value of the configuration.

    Raises
    ------
    ConfigError
        If the configuration stores no history.
    """
    import dataclasses

    if history_s is None:
        return config
    if config.storage is None or not config.storage.history:
        raise ConfigError("--history: there is no history to show; set folder in [storage]")
    return dataclasses.replace(config, viewer=config.viewer.model_copy(update={"history": history_s}))


def _with_viewer(config: "Config", viewer: str | None) -> "Config":
    """Return the configuration with another viewer mode; None keeps the mode."""
    import dataclasses

    from monitor.settings import loading

    if viewer is None:
        return config
    with name_option_in_config_errors("--viewer"):
        loading.check_viewer_mode(viewer)
    return dataclasses.replace(config, viewer=config.viewer.model_copy(update={"mode": viewer}))


@contextlib.contextmanager
def _stderr_through(writer: "QueuedWriter") -> Iterator[None]:
    """Start a writer and redirect standard error to it, for log lines, warnings and tracebacks of threads.

    If the writer is still blocked at the end, standard error is detached, so that the process can end.
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
    """Log a message of a writer as a warning."""
    import structlog

    structlog.get_logger("imu-monitor").warning("log", text=text)


class _ErrorStream(io.TextIOBase):
    """Text stream for the log that forwards to standard error and drops lines that cannot be written."""

    def write(self, text: str) -> int:
        """Write text, or drop it if the disk is full or the reader has gone."""
        with contextlib.suppress(OSError):
            sys.stderr.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush standard error, if it can be written."""
        with contextlib.suppress(OSError):
            sys.stderr.flush()


def _configure_logging(config: "Config") -> None:
    """Configure structlog to write structured lines to standard error."""
    import structlog

    from monitor.daemon.operations.log_level import set_log_level

    json = config.log.format == "json"
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            _without_secrets,
            structlog.processors.JSONRenderer() if json else structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty()),
        ],
        logger_factory=structlog.PrintLoggerFactory(cast("TextIO", _ErrorStream())),
        cache_logger_on_first_use=False,  # a reload may change the level
    )
    set_log_level(config.log.level)


def _without_secrets(_logger: Any, _method: str, line: "MutableMapping[str, Any]") -> "MutableMapping[str, Any]":
    """Mask credentials in every text of a log line."""
    return {key: mask_secrets(value) if isinstance(value, str) else value for key, value in line.items()}


def install_signal_handlers(stop: Callable[[], None], on_hangup: Callable[[], None] | None = None) -> None:
    """Install the signal handlers of a session.

    The first SIGINT or SIGTERM calls ``stop``. A second SIGINT ends the process at once. SIGHUP calls ``on_hangup``.

    Parameters
    ----------
    stop : callable
        Starts an orderly stop.
    on_hangup : callable, optional
        Handles SIGHUP. By default SIGHUP keeps its present handler.
    """
    import threading

    def handle_first_signal(number: int, _frame: Any) -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        # a separate thread is needed, because the main thread may hold the lock of the event that stop sets
        threading.Thread(target=stop, name="stop", daemon=True).start()

    signal.signal(signal.SIGINT, handle_first_signal)
    signal.signal(signal.SIGTERM, handle_first_signal)
    if on_hangup is not None:
        call = on_hangup  # runs in a thread for the same reason
        signal.signal(signal.SIGHUP, lambda *_: threading.Thread(target=call, name="hung up", daemon=True).start())


def exit_on_sigterm() -> None:
    """Let SIGTERM end a command as Ctrl-C does, so that incomplete files are removed."""

    def ended(_number: int, _frame: Any) -> NoReturn:
        sys.exit(128 + signal.SIGTERM)

    signal.signal(signal.SIGTERM, ended)
