"""Tests that a frozen terminal, an unread log or a full disk stops neither the measurement nor the end of a process."""

import contextlib
import json
import os
import platform
import re
import signal
import subprocess
import sys
import termios
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.recordings import save_samples
from tests.support.ports import free_endpoint
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.zenoh_sessions import open_router, open_session

PROGRAM = [sys.executable, "-m", "imu_monitor"]
FINAL_HEADER = re.compile(rb"^imu-monitor ran for \S+ s +1 device", re.MULTILINE)
CONFIG = """
[[device]]
name = "bench"
rate = 100.0
driver = {{ link = "virtual" }}
[zenoh]
connect = ["{endpoint}"]
[viewer]
mode = "none"
"""
REPLAY = """
[[device]]
name = "bench"
rate = 100.0
driver = { link = "replay", path = "short.npz", speed = "max" }
[zenoh]
mode = "none"
[viewer]
mode = "none"
"""
MANY_LINES = """
import structlog
from imu_monitor import main
from monitor.daemon.service import Service
run = Service.run
def run_after_many_lines(self, seconds=None):
    for number in range(1000):
        structlog.get_logger("imu-monitor").warning("filler", number=number, text="no " * 333)
    run(self, seconds)
Service.run = run_after_many_lines
main()
"""
SLOW_TO_STOP = """
import sys, time
from pathlib import Path
from monitor.cli import main
from monitor.daemon.service import Service
def drain(self):
    Path(sys.argv[2]).with_name("stopping").touch()
    time.sleep(600.0)
Service._drain = drain
main()
"""


class Daemon:
    """Daemon in a separate process, with the messages that it publishes."""

    def __init__(self, process: "subprocess.Popen[bytes]", subscriber: Any) -> None:
        self.process = process
        self._subscriber = subscriber
        self.counts = {"samples": 0, "coefficients": 0, "status": 0}
        self.outputs: dict[str, str] = {}  # states in the newest status

    def listen(self) -> None:
        """Take all messages that have arrived."""
        while (message := self._subscriber.try_recv()) is not None:
            topic = str(message.key_expr).rpartition("/")[2]
            if topic in self.counts:
                self.counts[topic] += 1
            if topic == "status":
                self.outputs = json.loads(message.payload.to_bytes())["outputs"]

    def wait_for_output_state(self, output: str, condition: Callable[[str], Any]) -> str:
        """Wait until the state of an output in the status fulfils ``condition``. Return the state."""

        def has_state() -> bool:
            self.listen()
            return bool(condition(self.outputs.get(output, "")))

        try:
            wait_for(has_state)
        except AssertionError:
            raise AssertionError(f"{output}: {self.outputs}, received {self.counts}") from None
        return self.outputs[output]

    def check_publishing_continues(self) -> None:
        """Wait for more samples, coefficients and states."""
        self.listen()
        before = dict(self.counts)

        def more() -> bool:
            self.listen()
            return all(count >= before[topic] + 3 for topic, count in self.counts.items())

        wait_for(more)


@contextlib.contextmanager
def start_daemon(folder: Path, stdout: int, stderr: int, source: str | None = None) -> Iterator[Daemon]:
    endpoint = free_endpoint()
    path = folder / "config.toml"
    path.write_text(CONFIG.format(endpoint=endpoint))
    command = PROGRAM if source is None else [sys.executable, "-c", source]
    with open_router(endpoint), open_session(connect=[endpoint]) as client:
        subscriber = client.declare_subscriber("imu/**")
        with start_program([*command, "run", str(path)], stdout, stderr) as process:
            yield Daemon(process, subscriber)


@contextlib.contextmanager
def start_program(
    command: list[str], stdout: int, stderr: int, folder: Path | None = None
) -> Iterator["subprocess.Popen[bytes]"]:
    environment = os.environ | {"TERM": "xterm-256color", "COLUMNS": "120", "LINES": "40", "PYTHONPATH": os.getcwd()}
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr, cwd=folder, env=environment
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait(PATIENCE_S)


def send_signal_and_wait(process: "subprocess.Popen[bytes]", number: int) -> int:
    """Send a signal to the process and return its exit status."""
    process.send_signal(number)
    return process.wait(PATIENCE_S)


class UnreadStream:
    """Terminal or pipe that nobody reads before ``start_reading`` is called.

    Parameters
    ----------
    reading : int
        Descriptor of the end that this process reads.
    writing : int
        Descriptor of the end that the tested process writes. ``close_writer`` closes it.
    thaw : callable, optional
        Called before reading begins.
    """

    def __init__(self, reading: int, writing: int, thaw: Callable[[int], None] = lambda _descriptor: None) -> None:
        self.writing = writing
        self.data = b""
        self._reading = reading
        self._thaw = thaw
        self._thread = threading.Thread(target=self._read, daemon=True)

    def start_reading(self) -> None:
        self._thaw(self.writing)
        self._thread.start()

    def _read(self) -> None:
        with contextlib.suppress(OSError):  # EIO: no process has the terminal open
            while data := os.read(self._reading, 65536):
                self.data += data

    def read_all(self) -> bytes:
        """Return all bytes that the process has written. Call this after the process has ended."""
        self.close_writer()
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
        return self.data

    def close_writer(self) -> None:
        if self.writing >= 0:
            os.close(self.writing)
            self.writing = -1

    def close(self) -> None:
        self.close_writer()
        if self._thread.ident is not None:
            self._thread.join(PATIENCE_S)
        os.close(self._reading)


def fill_buffer(descriptor: int) -> None:
    """Write until a write would block."""
    os.set_blocking(descriptor, False)
    for length in (1000, 1):  # to the last byte
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(descriptor, b"\n" * length)
    os.set_blocking(descriptor, True)


def frozen_terminal(reason: str) -> contextlib.closing[UnreadStream]:
    """Return a terminal that nobody reads ("unread") or that Ctrl-S has stopped ("stopped")."""
    master, slave = os.openpty()
    if reason == "unread":
        fill_buffer(slave)
        return contextlib.closing(UnreadStream(master, slave))
    termios.tcflow(slave, termios.TCOOFF)
    return contextlib.closing(UnreadStream(master, slave, lambda descriptor: termios.tcflow(descriptor, termios.TCOON)))


def unread_pipe() -> contextlib.closing[UnreadStream]:
    reading, writing = os.pipe()
    fill_buffer(writing)
    return contextlib.closing(UnreadStream(reading, writing))


def waits_for_reader(pid: int) -> bool:
    """Return True if a thread of the process is in a write to standard output or standard error."""
    number = {"x86_64": 1, "aarch64": 64}.get(platform.machine())
    if number is None:
        pytest.skip("the number of the system call is not known here")
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # the thread has ended
            try:
                call = (task / "syscall").read_text().split()
            except PermissionError:
                pytest.skip("system calls of another process are not shown here")
            if call[0] == str(number) and int(call[1], 16) in (1, 2):
                return True
    return False


# --- run


@pytest.mark.parametrize(("frozen", "number"), [("unread", signal.SIGTERM), ("stopped", signal.SIGINT)])
def test_frozen_terminal_stops_neither_results_nor_shutdown(tmp_path: Path, frozen: str, number: int) -> None:
    with frozen_terminal(frozen) as screen, start_daemon(tmp_path, screen.writing, screen.writing) as running_daemon:
        running_daemon.wait_for_output_state(
            "terminal", lambda state: state.startswith("blocked for ") and "frames dropped" in state
        )
        assert running_daemon.outputs.keys() == {"zenoh", "terminal"}
        running_daemon.check_publishing_continues()
        assert send_signal_and_wait(running_daemon.process, number) == 0


@pytest.mark.parametrize("frozen", ["unread", "stopped"])
def test_terminal_is_updated_again_once_it_is_read(tmp_path: Path, frozen: str) -> None:
    with frozen_terminal(frozen) as screen:
        with start_daemon(tmp_path, screen.writing, screen.writing) as running_daemon:
            running_daemon.wait_for_output_state("terminal", lambda state: "frames dropped" in state)
            screen.start_reading()
            state = running_daemon.wait_for_output_state("terminal", lambda state: state.startswith("ok"))
            assert re.fullmatch(r"ok, but [\d,]+ frames? dropped", state)
            wait_for(lambda: screen.data.count("● running".encode()) > 2)
            running_daemon.check_publishing_continues()
            assert send_signal_and_wait(running_daemon.process, signal.SIGINT) == 0
        text = screen.read_all()
    hidden, shown = text.index(b"\x1b[?25l"), text.index(b"\x1b[?25h")
    assert hidden < shown
    assert "● running".encode() in text[hidden:shown]
    assert b"imu-monitor" in text[shown:]  # the final table stays
    assert re.search(rb"bench\b", text[shown:])


@pytest.mark.parametrize("shared", [True, False])
def test_log_lines_are_written_above_the_table_or_to_redirected_standard_error(tmp_path: Path, shared: bool) -> None:
    source = MANY_LINES.replace("range(1000)", "range(3)")
    with open(tmp_path / "log", "wb") as file, frozen_terminal("stopped") as screen:
        log = screen.writing if shared else file.fileno()
        screen.start_reading()
        with start_daemon(tmp_path, screen.writing, log, source) as running_daemon:
            running_daemon.wait_for_output_state("terminal", lambda state: state == "ok")
            wait_for(lambda: "● running".encode() in screen.data)
            assert send_signal_and_wait(running_daemon.process, signal.SIGTERM) == 0
        text = screen.read_all()
    written = (tmp_path / "log").read_bytes()
    assert (text.count(b"filler"), written.count(b"filler")) == ((3, 0) if shared else (0, 3))


@pytest.mark.parametrize("number", [1, 2])
def test_run_with_a_closed_standard_stream_succeeds(tmp_path: Path, number: int) -> None:
    (tmp_path / "config.toml").write_text(CONFIG.format(endpoint=free_endpoint()))
    command = ["sh", "-c", f'exec "$@" {number}>&-', "sh", *PROGRAM, "run", "config.toml", "--seconds", "2"]
    with start_program(command, subprocess.PIPE, subprocess.PIPE, tmp_path) as process:
        out, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, stderr
    assert bool(FINAL_HEADER.search(out)) == (number == 2)
    assert b"Traceback" not in stderr


def test_second_interrupt_ends_the_daemon_on_a_frozen_terminal(tmp_path: Path) -> None:
    with (
        frozen_terminal("unread") as screen,
        start_daemon(tmp_path, *2 * [screen.writing], SLOW_TO_STOP) as running_daemon,
    ):
        running_daemon.wait_for_output_state("terminal", lambda state: state.startswith("blocked"))
        running_daemon.process.send_signal(signal.SIGINT)
        wait_for((tmp_path / "stopping").exists)
        assert send_signal_and_wait(running_daemon.process, signal.SIGINT) == -signal.SIGINT


def test_unread_log_stops_neither_results_nor_shutdown(tmp_path: Path) -> None:
    with unread_pipe() as log, start_daemon(tmp_path, subprocess.DEVNULL, log.writing) as running_daemon:
        running_daemon.wait_for_output_state(
            "log", lambda state: re.fullmatch(r"blocked for \d+ s: nobody reads standard error", state)
        )
        assert running_daemon.outputs.keys() == {"zenoh", "log"}
        running_daemon.check_publishing_continues()
        assert send_signal_and_wait(running_daemon.process, signal.SIGTERM) == 0


def test_log_that_is_read_again_reports_the_number_of_dropped_lines(tmp_path: Path) -> None:
    with unread_pipe() as log, start_daemon(tmp_path, subprocess.DEVNULL, log.writing, MANY_LINES) as running_daemon:
        running_daemon.wait_for_output_state(
            "log", lambda state: state.startswith("blocked") and "log lines dropped" in state
        )
        running_daemon.check_publishing_continues()
        log.start_reading()
        state = running_daemon.wait_for_output_state("log", lambda state: state.startswith("ok"))
        assert send_signal_and_wait(running_daemon.process, signal.SIGTERM) == 0
        text = log.read_all().decode()
    found = re.search(r"([\d,]+) log lines were dropped because nobody read standard error", text)
    assert found is not None
    assert state == f"ok, but {found[1]} log lines dropped"
    assert text.count("filler") + int(found[1].replace(",", "")) == 1000
    assert "state=running" in text


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_full_disk_for_table_and_log_stops_neither_results_nor_shutdown(tmp_path: Path) -> None:
    with open("/dev/full", "wb") as full, start_daemon(tmp_path, full.fileno(), full.fileno()) as running_daemon:
        running_daemon.wait_for_output_state(
            "log", lambda state: re.match(r"standard error cannot be written: No space left .*; \d+ log", state)
        )
        running_daemon.check_publishing_continues()
        assert send_signal_and_wait(running_daemon.process, signal.SIGTERM) == 0


# --- the final table


@pytest.mark.parametrize(
    ("ending", "place"),
    [
        ("seconds", "file"),
        ("SIGINT", "file"),
        ("end of the replay", "pipe"),
        ("SIGTERM", "pipe"),
    ],
)
def test_final_table_is_written_for_every_way_to_end_a_run(tmp_path: Path, ending: str, place: str) -> None:
    values = np.random.default_rng(1).standard_normal((500, 6))
    save_samples(tmp_path / "short.npz", np.arange(500) / 100.0, values)
    text = REPLAY if ending == "end of the replay" else CONFIG.format(endpoint=free_endpoint())
    (tmp_path / "config.toml").write_text(text)
    more = ["--seconds", "3"] if ending == "seconds" else []
    reading, out = os.pipe() if place == "pipe" else (-1, os.open(tmp_path / "out", os.O_RDWR | os.O_CREAT))
    with start_program([*PROGRAM, "run", "config.toml", *more], out, subprocess.PIPE, tmp_path) as process:
        assert process.stderr is not None
        if ending.startswith("SIG"):
            read_stderr_until(process, b"state=running")
            process.send_signal(getattr(signal, ending))
        stderr = process.stderr.read()
        assert process.wait(PATIENCE_S) == 0, stderr
        process.stderr.close()
    os.close(out)
    table = (tmp_path / "out").read_bytes() if place == "file" else os.read(reading, 65536)
    if place == "pipe":
        os.close(reading)
    assert len(FINAL_HEADER.findall(table)) == 1
    assert re.search(rb"^bench +", table, re.MULTILINE)
    assert b"\x1b" not in table


def read_stderr_until(process: "subprocess.Popen[bytes]", words: bytes) -> None:
    """Read standard error up to the first line that contains ``words``."""
    assert process.stderr is not None
    assert any(words in line for line in process.stderr)


@pytest.mark.parametrize("place", ["full disk", "unread pipe"])
def test_unwritable_final_table_at_the_end_of_a_replay_is_an_error(tmp_path: Path, place: str) -> None:
    values = np.random.default_rng(1).standard_normal((500, 6))
    save_samples(tmp_path / "short.npz", np.arange(500) / 100.0, values)
    (tmp_path / "config.toml").write_text(REPLAY)
    if place == "full disk" and not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full here")
    with contextlib.ExitStack() as stack:
        if place == "full disk":
            out = stack.enter_context(open("/dev/full", "wb")).fileno()
        else:
            out = stack.enter_context(unread_pipe()).writing
        process = stack.enter_context(start_program([*PROGRAM, "run", "config.toml"], out, subprocess.PIPE, tmp_path))
        _, stderr = process.communicate(timeout=PATIENCE_S)
        status = process.returncode
    assert status == 1
    why = "could not be written: No space left on device" if place == "full disk" else "was not written, because nobody"
    assert stderr.decode().splitlines()[-1].startswith(f"imu-monitor: standard output: the final table {why}")


# --- watch and view


@pytest.mark.parametrize("place", ["terminal", "pipe", "pipe, once"])
def test_watch_ends_although_nobody_reads_its_output(place: str) -> None:
    endpoint = free_endpoint()
    more = ["--seconds", "1"] if place == "pipe, once" else []
    with contextlib.ExitStack() as stack:
        stack.enter_context(open_router(endpoint))
        out = stack.enter_context(frozen_terminal("unread") if place == "terminal" else unread_pipe())
        command = [*PROGRAM, "watch", "--connect", endpoint, *more]
        process = stack.enter_context(start_program(command, out.writing, subprocess.DEVNULL))
        wait_for(lambda: waits_for_reader(process.pid))
        assert send_signal_and_wait(process, signal.SIGTERM) == 0


def test_watch_is_updated_again_once_its_output_is_read(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with contextlib.ExitStack() as stack:
        stack.enter_context(open_router(endpoint))
        screen = stack.enter_context(frozen_terminal("unread"))
        process = stack.enter_context(
            start_program([*PROGRAM, "watch", "--connect", endpoint], screen.writing, subprocess.DEVNULL)
        )
        wait_for(lambda: waits_for_reader(process.pid))
        screen.start_reading()
        wait_for(lambda: screen.data.count(b"imu-monitor") > 2)
        assert send_signal_and_wait(process, signal.SIGTERM) == 0
        wait_for(lambda: b"\x1b[?25h" in screen.data)


def test_view_ends_although_nobody_reads_its_log() -> None:
    endpoint = free_endpoint()  # nothing listens there, which the program reports on standard error
    with unread_pipe() as log:
        command = [*PROGRAM, "view", "--connect", endpoint, "--viewer", "none"]
        with start_program(command, subprocess.DEVNULL, log.writing) as process:
            wait_for(lambda: waits_for_reader(process.pid))
            assert send_signal_and_wait(process, signal.SIGTERM) == 0
