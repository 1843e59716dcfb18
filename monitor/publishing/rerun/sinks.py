"""Where the drawing goes: a viewer window, a page in the browser, or a file.

In come the viewer's settings, out goes an open ``Output``: a Rerun stream, and the child process that
belongs to it. ``ViewerTrouble`` says in one line what is wrong; the caller tries again later. The viewer's
program is started directly (its Python wrapper would leave it alive when killed) and told to listen on
loopback only, with its usage statistics off. Window and page are the same thing to the daemon: a Rerun
server in a process of its own, so what it holds in memory is not the daemon's. Importing this imports Rerun.

A busy port raises nothing in Rerun, so ports are looked at first: a Rerun server that already listens is
joined by a window, anything else is trouble; a page moves on to the next free port.
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

import rerun as rr
import rerun_cli  # type: ignore[import-untyped]

from drivers.file_access import check_regular
from monitor.common.folder_lock import NO_LOCKS
from monitor.publishing.rerun.viewer_settings import ViewerClosed, ViewerSettings, ViewerTrouble

LOOPBACK: Final = "127.0.0.1"
APPLICATION: Final = "imu-monitor"
START_S: Final = 20.0  # for a viewer to listen: the first start of a 300 MB program from a cold disk
PORTS_TRIED: Final = 20
CLOSED: Final = "viewer was closed: start `rerun` to look again"
PROGRAM_MIB: Final = 256  # an empty viewer window holds 125 to 170 MB
LIVE_FLUSH_S: Final = 0.2  # fluent to the eye; Rerun keeps about 1 kB for every chunk beside its data
PROBE: Final = "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadTables"


def has_desktop() -> bool:
    """Whether a window can be opened here at all."""
    return sys.platform in ("darwin", "win32") or bool({"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys())


class Child:
    """A viewer process, and what it last complained about."""

    def __init__(self, arguments: list[str]) -> None:
        self._log: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the child
        quiet = {"RERUN_ANALYTICS": "0", "RERUN_APP_ONLY": "true", "NO_COLOR": "1", "RUST_LOG": "warn"}
        self._process = subprocess.Popen(
            [*_leash(), str(viewer_program()), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            env={**os.environ, **quiet},
        )

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def trouble(self) -> str | None:
        """Why the process is gone; None while it lives."""
        status = self._process.poll()
        return None if status is None else f"viewer ended ({status}): {self._last_words()}"

    def left(self) -> bool:
        """Whether it went as a program goes whose window is closed."""
        return self._process.poll() == 0

    def end(self, patience_s: float = 0.5) -> None:
        """Ask it to go, then make it: a stopped process hears nothing but SIGKILL."""
        with contextlib.suppress(OSError):
            self._process.terminate()
        try:
            self._process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(5.0)
        self._log.close()

    def signal(self, number: int) -> None:
        """Send a signal to the process."""
        self._process.send_signal(number)

    def kill(self) -> None:
        """End it from another thread, whatever it is doing."""
        self._process.kill()

    def _last_words(self) -> str:
        self._log.seek(0)
        lines = self._log.read()[-2000:].decode(errors="replace").strip().splitlines()
        return lines[-1].strip()[:200] if lines else "no message"


@dataclass
class Output:
    """An open viewer or file."""

    stream: rr.RecordingStream
    flush_every_s: float
    url: str = ""  # of the page, or of the Rerun server
    child: Child | None = None
    port: int | None = None  # of the Rerun server; None for a file
    note: str = ""  # which ports were busy, and what is used in their place
    lock: IO[bytes] | None = None  # of a file: open while it is written, so that no other process writes it

    def check(self) -> None:
        """ViewerTrouble when nobody looks any more, ViewerClosed when that was someone's wish."""
        if self.child is not None and self.child.left():
            raise ViewerClosed(CLOSED)
        trouble = self.child.trouble() if self.child is not None else None
        if trouble is None and self.port is not None and not listens(self.port):
            trouble = f"the viewer on port {self.port} was closed"
        if trouble is not None:
            raise ViewerTrouble(trouble)

    def confirm(self, patience_s: float) -> bool:
        """Whether all that was logged got through within ``patience_s``, and the viewer answers.

        Getting through alone says little: sockets take in a stopped viewer's next two megabytes.
        """
        try:
            self.stream.flush(timeout_sec=patience_s)
        except RuntimeError:  # Rerun's only way to say "timed out" or "connection lost"
            return False
        return self.port is None or ask(self.port, "/imu.monitor/Ping", patience_s) is not None

    def close(self) -> None:
        """End the viewer that was started here; a file is complete afterwards."""
        try:
            if self.child is not None:
                self.child.end()
            if self.port is None:
                self.stream.disconnect()
        finally:
            if self.lock is not None:
                self.lock.close()


def viewer_program() -> Path:
    """The viewer's own program inside the package ``rerun_cli``."""
    room = Path(rerun_cli.__file__).parent
    names = ("Rerun.app/Contents/MacOS/Rerun", "rerun.exe", "rerun")
    found = next((room / name for name in names if (room / name).is_file()), None)
    if found is None:
        raise ViewerTrouble(f"rerun-sdk came without its viewer: no program in {room}")
    return found


def _leash() -> list[str]:
    """What makes a program end when the thread that started it does, however that comes: Linux alone has it.

    ``setpriv`` (util-linux) sets it and then becomes the program; without it a killed daemon leaves its viewer.
    """
    setpriv = shutil.which("setpriv") if sys.platform == "linux" else None
    return [] if setpriv is None else [setpriv, "--pdeathsig", "TERM", "--"]


def listens(port: int) -> bool:
    """Whether anyone accepts connections on this port of loopback."""
    with contextlib.suppress(OSError), socket.create_connection((LOOPBACK, port), 0.5):
        return True
    return False


def is_rerun(port: int) -> bool:
    """Whether a Rerun server answers there: it knows the service of its own protocol.

    Any other gRPC server says "unimplemented" (status 12), any other server no gRPC at all.
    """
    reply = ask(port, PROBE, 1.0)
    return reply is not None and "grpc" in reply.get("content-type", "") and reply.get("grpc-status") != "12"


def ask(port: int, path: str, timeout_s: float) -> dict[str, str] | None:
    """Headers of the reply to an empty gRPC call; None when nobody answers in time."""
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=timeout_s)
    headers = {"content-type": "application/grpc-web+proto", "x-grpc-web": "1"}
    try:
        connection.request("POST", path, bytes(5), headers)
        return {name.lower(): value for name, value in connection.getresponse().getheaders()}
    except (OSError, http.client.HTTPException):
        return None
    finally:
        connection.close()


def free_port(wanted: int, taken: int | None = None) -> int:
    """``wanted``, or the next port after it that nobody holds."""
    for port in range(wanted, min(wanted + PORTS_TRIED, 65536)):
        if port != taken and _bindable(port):
            return port
    raise ViewerTrouble(f"cannot listen on {wanted} to {wanted + PORTS_TRIED - 1}: all busy")


def _bindable(port: int) -> bool:
    with socket.socket() as probe:
        if os.name == "posix":
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError:
            return False
    return True


def open_output(settings: ViewerSettings, recording_id: str, given_up: Callable[[], bool]) -> Output:
    """Open what the settings ask for; waits until it listens or ``given_up``. ViewerTrouble says why not."""
    if settings.mode.endswith(".rrd"):
        return _open_file(Path(settings.mode), recording_id)
    if settings.mode in ("native", "join") or (settings.mode == "auto" and has_desktop()):
        return _open_native(settings, recording_id, given_up)
    return _open_web(settings, recording_id, given_up)


def _open_file(path: Path, recording_id: str) -> Output:
    try:
        if path.exists():
            check_regular(path)  # opening a FIFO would wait for its reader
        lock = path.open("ab")
    except OSError as error:
        raise ViewerTrouble(f"cannot write {path}: {error.strerror}") from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # released by the system when this process ends
    except BlockingIOError:
        lock.close()
        raise ViewerTrouble(f"{path}: another process writes this file; name another one") from None
    except OSError as error:  # a file system without locks
        if error.errno not in NO_LOCKS:
            lock.close()
            raise ViewerTrouble(f"cannot lock {path}: {error.strerror}") from error
    try:
        stream = _stream(recording_id)
        # A footer would keep a line about every chunk in memory for as long as the daemon runs.
        stream.set_sinks(rr.FileSink(path, write_footer=False))
    except BaseException:
        lock.close()
        raise
    return Output(stream, flush_every_s=1.0, lock=lock)


def _open_native(settings: ViewerSettings, recording_id: str, given_up: Callable[[], bool]) -> Output:
    port = settings.port
    if listens(port):
        if not is_rerun(port):
            raise ViewerTrouble(f"cannot listen on {port}: busy")
        return _connected(port, recording_id)
    if settings.mode == "join":
        raise ViewerClosed(CLOSED)
    if not has_desktop():
        raise ViewerTrouble('no desktop here (DISPLAY and WAYLAND_DISPLAY are not set): use viewer mode "web"')
    child = Child([
        *("--bind", LOOPBACK, "--port", str(port)),
        *("--memory-limit", with_program(settings.memory), "--server-memory-limit", "64MiB"),
        *("--hide-welcome-screen", "--expect-data-soon"),
    ])  # fmt: skip
    _wait_for(port, child, given_up)
    return _connected(port, recording_id, child=child)


def _open_web(settings: ViewerSettings, recording_id: str, given_up: Callable[[], bool]) -> Output:
    port = free_port(settings.port)
    web_port = free_port(settings.web_port, taken=port)
    child = Child([
        *("--serve-web", "--bind", LOOPBACK, "--port", str(port), "--web-viewer-port", str(web_port)),
        *("--server-memory-limit", settings.memory),
    ])  # fmt: skip
    _wait_for(port, child, given_up)
    output = _connected(port, recording_id, child=child)
    moved = {settings.port: port, settings.web_port: web_port}
    output.note = ", ".join(f"port {old} is busy: {new} is used" for old, new in moved.items() if old != new)
    output.url = f"http://{LOOPBACK}:{web_port}/?url={quote(server_url(port), safe='')}"
    if has_desktop():
        webbrowser.open(output.url)
    return output


def with_program(memory: str) -> str:
    """What a window is allowed in all, so that ``memory`` is left for data; a share of the machine is as given.

    >>> with_program("256MiB"), with_program("1GiB"), with_program("25%")
    ('512MiB', '1280MiB', '25%')
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(MiB|GiB)", memory.strip())
    if found is None:
        return memory
    mebibytes = float(found[1]) * {"MiB": 1, "GiB": 1024}[found[2]]
    return f"{mebibytes + PROGRAM_MIB:.0f}MiB"


def server_url(port: int) -> str:
    """Where a Rerun server on loopback takes and gives recordings."""
    return f"rerun+http://{LOOPBACK}:{port}/proxy"


def _connected(port: int, recording_id: str, child: Child | None = None, joined_port: int | None = None) -> Output:
    stream = _stream(recording_id)
    stream.set_sinks(rr.GrpcSink(server_url(port)))
    return Output(stream, LIVE_FLUSH_S, server_url(port), child, port)


def _stream(recording_id: str) -> rr.RecordingStream:
    """A stream whose rows stand on ``sample_time`` alone, and that is never freed.

    Freeing one waits for its viewer, with a lock held that every other stream of the process needs: a viewer
    that is gone at the wrong moment would take the next one along, and keep the process from exiting. One
    reference more than anyone holds costs a few kilobytes for each viewer that was opened.
    """
    stream = rr.RecordingStream(APPLICATION, recording_id=recording_id)
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(stream))
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    return stream


def _wait_for(port: int, child: Child, given_up: Callable[[], bool]) -> None:
    end = time.monotonic() + START_S
    while time.monotonic() < end and not given_up():
        trouble = child.trouble()
        if trouble is not None:
            child.end()
            raise ViewerTrouble(trouble)
        if listens(port):
            return
        time.sleep(0.05)
    child.end()
    raise ViewerTrouble(f"the viewer did not listen on {port} within {START_S:.0f} s")
