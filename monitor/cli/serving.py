"""The service in a terminal: its table or log lines, its log, and the signals that end it."""

import contextlib
import io
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TextIO, cast

from drivers.errors import ConfigError
from drivers.masked import masked

if TYPE_CHECKING:
    from collections.abc import MutableMapping

    from monitor.settings import Config


def serve(config: "Config", seconds: float | None, viewer: str | None) -> None:
    """Run the service: a table where there is a terminal, else log lines; the last table once more at the end.

    ``viewer`` goes before the configuration's.
    """
    import time
    from contextlib import nullcontext

    import structlog
    from rich.console import Console
    from rich.live import Live

    from monitor.outputs import LogOutput, TableOutput
    from monitor.publish.terminal import Board
    from monitor.service import Service
    from monitor.systemd import Unit

    unit = Unit.of(os.environ)
    config = _with_viewer(config, viewer)
    _log_as(config)
    for line in config.warnings:
        structlog.get_logger("imu-monitor").warning(line)
    console, board = Console(), Board()
    live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
    shown = [TableOutput(board, live)] if live else [TableOutput(board), LogOutput()]
    service = Service(config, shown, unit=unit)
    # in a terminal it means that the terminal is closed
    on_signals(service.stop, service.stop if live else service.reload)
    with live or nullcontext():
        service.run(seconds)
    if live is not None or seconds is not None:
        console.print(board.table(time.monotonic()))


def view(
    keyexpr: str, connect: Sequence[str], file: Path | None, detail: Sequence[str], mode: str, seconds: float | None
) -> None:
    """The viewer of a fleet, until a signal; where its page is, and what is wrong, a line each on standard error."""
    import threading

    from monitor import settings
    from monitor.publish.fleet import FleetView, detail_key
    from monitor.publish.rerun_view import RerunView
    from monitor.publish.viewer import DeviceInfo, ViewerSettings
    from monitor.publish.zenoh_in import ZenohIn

    try:
        settings.viewer_mode(mode)
    except ConfigError as error:
        raise ConfigError(f"--viewer: {error}") from None
    keys = tuple(dict.fromkeys(detail_key(device, keyexpr) for device in detail))
    arriving = ZenohIn(keyexpr, connect, file, keys)
    rerun = RerunView(ViewerSettings(mode=mode), [DeviceInfo(key, "over zenoh") for key in keys], fleet=True)
    stop = threading.Event()
    on_signals(stop.set)
    with contextlib.closing(arriving), contextlib.closing(rerun):
        arriving.start()
        rerun.start()
        FleetView(arriving, rerun, keys).run(stop, lambda said: print(said, file=_Lines(), flush=True), seconds)


def with_history(config: "Config", history_s: float | None) -> "Config":
    """A configuration whose live view opens on so much of what is kept; None: as it says itself."""
    import dataclasses

    import msgspec

    if history_s is None:
        return config
    if config.storage is None or not config.storage.history:
        raise ConfigError("--history: none is kept; [storage] folder says where it would be")
    return dataclasses.replace(config, viewer=msgspec.structs.replace(config.viewer, history=history_s))


def _with_viewer(config: "Config", viewer: str | None) -> "Config":
    import dataclasses

    import msgspec

    from monitor import settings

    if viewer is None:
        return config
    try:
        mode = settings.viewer_mode(viewer)
    except ConfigError as error:
        raise ConfigError(f"--viewer: {error}") from None
    return dataclasses.replace(config, viewer=msgspec.structs.replace(config.viewer, mode=mode))


class _Lines(io.TextIOBase):
    """Standard error as the log's place: a line that cannot be written (disk full, reader gone) is dropped."""

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            sys.stderr.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            sys.stderr.flush()


def _log_as(config: "Config") -> None:
    """Structured lines on standard error."""
    import logging

    import structlog

    from monitor.logs import LEVEL

    json = config.log.format == "json"
    LEVEL.name = config.log.level
    structlog.configure(
        processors=[
            LEVEL,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            _without_secrets,
            structlog.processors.JSONRenderer() if json else structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty()),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(logging.DEBUG),
        logger_factory=structlog.PrintLoggerFactory(cast("TextIO", _Lines())),
        cache_logger_on_first_use=True,
    )


def _without_secrets(_logger: Any, _method: str, line: "MutableMapping[str, Any]") -> "MutableMapping[str, Any]":
    """Every text of a log line, whatever brought it there."""
    return {key: masked(value) if isinstance(value, str) else value for key, value in line.items()}


def on_signals(stop: Callable[[], None], hung_up: Callable[[], None] | None = None) -> None:
    """First SIGINT or SIGTERM: stop in order. A second SIGINT ends at once. SIGHUP: what it means here, if anything."""
    import threading

    def first(number: int, _frame: Any) -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        # in a thread of its own: the main one may hold the lock of the very event that stop sets
        threading.Thread(target=stop, name="stop", daemon=True).start()

    signal.signal(signal.SIGINT, first)
    signal.signal(signal.SIGTERM, first)
    if hung_up is not None:
        call = hung_up  # in a thread, as above
        signal.signal(signal.SIGHUP, lambda *_: threading.Thread(target=call, name="hung up", daemon=True).start())


def end_on_sigterm() -> None:
    """SIGTERM ends work as Ctrl-C does: what is half written is removed."""

    def ended(_number: int, _frame: Any) -> NoReturn:
        sys.exit(128 + signal.SIGTERM)

    signal.signal(signal.SIGTERM, ended)
