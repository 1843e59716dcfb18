"""Outputs of a Rerun stream: a viewer window, a web page or a file.

A window and a web page use a Rerun server in a separate process, so that the viewer data do not take up memory in the
daemon. The viewer program is started directly, because it would continue to run if its Python wrapper were killed. The
program listens only on the loopback interface and sends no usage statistics.

Rerun raises no error if a port is in use, so ports are checked first. If a Rerun server already listens on the port of
a window, the daemon connects to this server. If the port of the web page is in use, the next free port is used.
Importing this module imports Rerun.
"""

import contextlib
import ctypes
import fcntl
import http.client
import os
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import webbrowser
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final
from urllib.parse import quote

# Rerun reads this variable while it is imported. The warning about a missing footer says nothing to the user.
os.environ.setdefault("RUST_LOG", "warn,re_log_encoding::rrd::file_sink=error")

import rerun as rr
import rerun_cli  # type: ignore[import-untyped]

from drivers.host.safe_file_reading import check_regular_file
from monitor.common.folder_lock import LOCKS_UNSUPPORTED_ERRNOS
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerClosed, ViewerError, ViewerSettings

LOOPBACK: Final = "127.0.0.1"
APPLICATION: Final = "imu-monitor"
START_TIMEOUT_S: Final = 20.0  # loading the program of 300 MB from a slow disk takes time
PORTS_TRIED: Final = 20
CLOSED: Final = "viewer was closed: start `rerun` to open it again"
PROGRAM_MIB: Final = 256  # memory limit of the viewer program without data; an empty window uses 125 to 170 MB
LIVE_FLUSH_PERIOD_S: Final = 0.2  # each flush sends about 1 kB in addition to the data
PROBE_METHOD: Final = "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadTables"


def has_desktop() -> bool:
    """Return True if this machine can open a window."""
    return sys.platform in ("darwin", "win32") or bool({"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys())


class ViewerProcess:
    """Process that runs the viewer program, whose last log line explains an early end."""

    def __init__(self, arguments: list[str]) -> None:
        self._log: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the child
        # CI is the only variable that switches the usage statistics of Rerun off.
        quiet = {"CI": "1", "RERUN_APP_ONLY": "true", "NO_COLOR": "1", "RUST_LOG": "warn"}
        self._process = subprocess.Popen(
            [*_death_signal_prefix(), str(viewer_program_path()), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            env={**os.environ, **quiet},
        )

    @property
    def pid(self) -> int:
        """Process identifier of the viewer program."""
        return self._process.pid

    def exit_reason(self) -> str | None:
        """Return the reason why the process has ended, or None if the process is running."""
        status = self._process.poll()
        return None if status is None else f"viewer ended ({status}): {self._last_log_line()}"

    def exited_normally(self) -> bool:
        """Return True if the process ended normally, for example because a user closed the window."""
        return self._process.poll() == 0

    def terminate(self, timeout_s: float = 0.5) -> None:
        """Terminate the process, and kill it after ``timeout_s`` seconds, because a stopped process ignores SIGTERM."""
        with contextlib.suppress(OSError):
            self._process.terminate()
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(5.0)
        self._log.close()

    def kill(self) -> None:
        """Kill the process. Any thread may call this method."""
        self._process.kill()

    def _last_log_line(self) -> str:
        self._log.seek(0)
        lines = self._log.read()[-2000:].decode(errors="replace").strip().splitlines()
        return lines[-1].strip()[:200] if lines else "no message"


@dataclass
class RerunStreamWithSink:
    """Rerun stream together with the viewer process or the file that receives its data."""

    stream: rr.RecordingStream
    flush_every_s: float
    url: str = ""  # address of the web page or of the Rerun server
    child: ViewerProcess | None = None
    port: int | None = None  # port of the Rerun server; None for a file
    note: str = ""  # configured ports that were in use, and the replacement ports
    lock: IO[bytes] | None = None  # lock against other processes that write the file

    def raise_if_viewer_ended(self) -> None:
        """Raise an exception if the viewer has ended.

        Raises
        ------
        ViewerClosed
            If a user closed the window.
        ViewerError
            If the viewer ended for another reason.
        """
        if self.child is not None and self.child.exited_normally():
            raise ViewerClosed(CLOSED)
        trouble = self.child.exit_reason() if self.child is not None else None
        if trouble is None and self.port is not None and not is_listening(self.port):
            trouble = f"the viewer on port {self.port} was closed"
        if trouble is not None:
            raise ViewerError(trouble)

    def confirm_delivery(self, timeout_s: float) -> bool:
        """Return True if the viewer has received all logged data within ``timeout_s`` seconds.

        A completed send is no proof of delivery, because the sockets of a stopped viewer accept two more
        megabytes.
        """
        try:
            self.stream.flush(timeout_sec=timeout_s)
        except RuntimeError:  # Rerun raises this exception after a timeout and if the connection is lost
            return False
        return self.port is None or _grpc_call(self.port, "/imu.monitor/Ping", timeout_s) is not None

    def close(self) -> None:
        """Complete the file, or end the viewer process."""
        try:
            if self.child is not None:
                self.child.terminate()
            if self.port is None:
                self.stream.disconnect()
        finally:
            if self.lock is not None:
                self.lock.close()


def viewer_program_path() -> Path:
    """Return the path of the viewer program in the package ``rerun_cli``."""
    folder = Path(rerun_cli.__file__).parent
    names = ("Rerun.app/Contents/MacOS/Rerun", "rerun.exe", "rerun")
    found = next((folder / name for name in names if (folder / name).is_file()), None)
    if found is None:
        raise ViewerError(f"the package rerun-sdk contains no viewer program in {folder}; reinstall it")
    return found


def _death_signal_prefix() -> list[str]:
    """Return a command prefix that makes a program end as soon as the thread that started it ends (Linux only).

    Without the program ``setpriv`` (util-linux), the viewer continues to run after the daemon has been killed.
    """
    setpriv = shutil.which("setpriv") if sys.platform == "linux" else None
    return [] if setpriv is None else [setpriv, "--pdeathsig", "TERM", "--"]


def is_listening(port: int) -> bool:
    """Return True if a program accepts connections on a port of the loopback interface."""
    with contextlib.suppress(OSError), socket.create_connection((LOOPBACK, port), 0.5):
        return True
    return False


def is_rerun_server(port: int) -> bool:
    """Return True if a Rerun server listens on a port of the loopback interface.

    Other gRPC servers answer a Rerun call with "unimplemented" (status 12).
    """
    reply = _grpc_call(port, PROBE_METHOD, 1.0)
    return reply is not None and "grpc" in reply.get("content-type", "") and reply.get("grpc-status") != "12"


def _grpc_call(port: int, path: str, timeout_s: float) -> dict[str, str] | None:
    """Return the headers of the reply to an empty gRPC call, or None if there is no reply."""
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=timeout_s)
    headers = {"content-type": "application/grpc-web+proto", "x-grpc-web": "1"}
    try:
        connection.request("POST", path, bytes(5), headers)
        return {name.lower(): value for name, value in connection.getresponse().getheaders()}
    except (OSError, http.client.HTTPException):
        return None
    finally:
        connection.close()


def find_free_port(first_port: int, skipped_port: int | None = None) -> int:
    """Return the first free port that is not less than the given port.

    Parameters
    ----------
    first_port
        First port to try.
    skipped_port
        Port that is not used even if it is free.

    Raises
    ------
    ViewerError
        If PORTS_TRIED ports are in use.
    """
    for port in range(first_port, min(first_port + PORTS_TRIED, 65536)):
        if port != skipped_port and _bindable(port):
            return port
    raise ViewerError(f"cannot listen on {first_port} to {first_port + PORTS_TRIED - 1}: all busy")


def _bindable(port: int) -> bool:
    with socket.socket() as probe:
        if os.name == "posix":
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError:
            return False
    return True


def open_output(settings: ViewerSettings, recording_id: str, should_stop: Callable[[], bool]) -> RerunStreamWithSink:
    """Open the output that the settings select, and wait until the viewer listens.

    Parameters
    ----------
    settings
        Settings of the viewer.
    recording_id
        Identifier of the recording in Rerun.
    should_stop
        Function that returns True if the caller no longer waits for the viewer.

    Raises
    ------
    ViewerError
        If the output cannot be opened.
    ViewerClosed
        If the mode is ``join`` and no viewer is open.
    """
    if settings.mode.endswith(".rrd"):
        return _open_file(Path(settings.mode), recording_id)
    if settings.mode in ("native", "join") or (settings.mode == "auto" and has_desktop()):
        return _open_native(settings, recording_id, should_stop)
    return _open_web(settings, recording_id, should_stop)


def _open_file(path: Path, recording_id: str) -> RerunStreamWithSink:
    try:
        if path.exists():
            check_regular_file(path)  # opening a FIFO would block until another process reads it
        lock = path.open("ab")
    except OSError as error:
        raise ViewerError(f"cannot write {path}: {error.strerror}") from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the system releases the lock when this process ends
    except BlockingIOError:
        lock.close()
        raise ViewerError(f"{path}: another process writes this file; choose another file") from None
    except OSError as error:  # some file systems do not support locks
        if error.errno not in LOCKS_UNSUPPORTED_ERRNOS:
            lock.close()
            raise ViewerError(f"cannot lock {path}: {error.strerror}") from error
    try:
        stream = _stream(recording_id)
        # To write a footer, Rerun would keep data about every chunk in memory while the daemon runs.
        stream.set_sinks(rr.FileSink(path, write_footer=False))
    except BaseException:
        lock.close()
        raise
    return RerunStreamWithSink(stream, flush_every_s=1.0, lock=lock)


def _open_native(settings: ViewerSettings, recording_id: str, should_stop: Callable[[], bool]) -> RerunStreamWithSink:
    port = settings.port
    if is_listening(port):
        if not is_rerun_server(port):
            raise ViewerError(f"cannot listen on {port}: busy")
        return _connected(port, recording_id)
    if settings.mode == "join":
        raise ViewerClosed(CLOSED)
    if not has_desktop():
        raise ViewerError('no desktop here (DISPLAY and WAYLAND_DISPLAY are not set): use viewer mode "web"')
    child = ViewerProcess([
        *("--bind", LOOPBACK, "--port", str(port)),
        *("--memory-limit", _add_program_memory(settings.memory), "--server-memory-limit", "64MiB"),
        *("--hide-welcome-screen", "--expect-data-soon"),
    ])  # fmt: skip
    _wait_for(port, child, should_stop)
    return _connected(port, recording_id, child=child)


def _open_web(settings: ViewerSettings, recording_id: str, should_stop: Callable[[], bool]) -> RerunStreamWithSink:
    port = find_free_port(settings.port)
    web_port = find_free_port(settings.web_port, skipped_port=port)
    child = ViewerProcess([
        *("--serve-web", "--bind", LOOPBACK, "--port", str(port), "--web-viewer-port", str(web_port)),
        # A page that is opened late shows the present results first, instead of the results since the start.
        *("--server-memory-limit", settings.memory, "--newest-first"),
    ])  # fmt: skip
    _wait_for(port, child, should_stop)
    output = _connected(port, recording_id, child=child)
    moved = {settings.port: port, settings.web_port: web_port}
    output.note = ", ".join(f"port {old} is busy: {new} is used" for old, new in moved.items() if old != new)
    output.url = f"http://{LOOPBACK}:{web_port}/?url={quote(server_url(port), safe='')}"
    if has_desktop():
        webbrowser.open(output.url)
    return output


def _add_program_memory(memory: str) -> str:
    """Return the memory limit of a viewer window, which is the memory limit for data plus PROGRAM_MIB.

    >>> _add_program_memory("256MiB"), _add_program_memory("1GiB"), _add_program_memory("25%")
    ('512MiB', '1280MiB', '25%')
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(MiB|GiB)", memory.strip())
    if found is None:
        return memory
    mebibytes = float(found[1]) * {"MiB": 1, "GiB": 1024}[found[2]]
    return f"{mebibytes + PROGRAM_MIB:.0f}MiB"


def server_url(port: int) -> str:
    """Return the address of a Rerun server on the loopback interface."""
    return f"rerun+http://{LOOPBACK}:{port}/proxy"


def _connected(port: int, recording_id: str, child: ViewerProcess | None = None) -> RerunStreamWithSink:
    stream = _stream(recording_id)
    stream.set_sinks(rr.GrpcSink(server_url(port)))
    return RerunStreamWithSink(stream, LIVE_FLUSH_PERIOD_S, server_url(port), child, port)


def _stream(recording_id: str) -> rr.RecordingStream:
    """Create a Rerun stream that is never freed.

    Freeing a stream waits for the viewer while holding a lock that all streams need. If a stream were freed after the
    viewer has ended, it would therefore block all other streams and the exit of the process. The stream keeps a few
    kilobytes of memory for each viewer that was opened.
    """
    stream = rr.RecordingStream(APPLICATION, recording_id=recording_id)
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(stream))
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    return stream


def _wait_for(port: int, child: ViewerProcess, should_stop: Callable[[], bool]) -> None:
    """Wait until the viewer listens on the port. After a timeout, terminate the viewer and raise ViewerError."""
    end = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < end and not should_stop():
        trouble = child.exit_reason()
        if trouble is not None:
            child.terminate()
            raise ViewerError(trouble)
        if is_listening(port):
            return
        time.sleep(0.05)
    child.terminate()
    raise ViewerError(f"the viewer did not listen on port {port} within {START_TIMEOUT_S:.0f} s")
