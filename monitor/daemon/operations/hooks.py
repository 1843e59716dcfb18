"""Hooks: user commands and zenoh messages that are triggered by events.

An event that matches a hook is encoded as JSON. The JSON is published on the zenoh key of the hook, or passed to the
standard input of a command. Commands wait in a bounded queue and run in a few threads, without a shell. The time limit
applies to the command and to all processes that it has started, which are then killed. On Linux, these processes are
found in ``/proc`` by their parents and by a variable in their environment, so that a process in a session of its own is
killed as well. On other systems, only the process group of the command is killed. The status shows the error of the
newest run.

For each kind of event and each device, a hook runs at most BURST times in a row and then once in RUN_INTERVAL_S. A
faulty cable that reports losses every second therefore starts only a few programs.
"""

import contextlib
import os
import queue
import secrets
import select
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import structlog

from drivers.data_types import Event
from drivers.secret_masking import mask_secrets
from monitor.common.unexpected_errors import log_unexpected_error
from monitor.daemon.outputs.output import Output
from monitor.publishing.messages.results import EventMessage
from monitor.settings.loading import Hook

THREADS: Final = 4
"""Number of threads that run commands."""
MAX_QUEUED: Final = 100
"""Maximum number of queued commands."""
BURST: Final = 10
"""Maximum number of runs in a row."""
RUN_INTERVAL_S: Final = 6.0
"""Mean interval between two runs after a burst."""
OUTPUT_BYTES: Final = 4096
"""Maximum number of bytes that are kept from the output of a command."""
MAX_LINE_CHARS: Final = 200
"""Maximum length of an output line in a message, in characters."""
MAX_LAST_READS: Final = 16
"""Maximum number of reads of the output after a command has ended."""
CHILD_POLL_S: Final = 0.5
"""Interval between two checks of whether the processes that a command has started have ended."""
MAX_KILL_ROUNDS: Final = 20
"""Maximum number of searches for processes to kill, which may start further processes in the meantime."""
RUN_VARIABLE: Final = "IMU_MONITOR_HOOK_RUN"
"""Environment variable that identifies the processes of one run of a command."""
POLL_S: Final = 0.05
"""Interval between two checks of whether a command has ended."""
CLOSE_TIMEOUT_S: Final = 2.0
"""Longest wait for running commands when the service stops."""
PRIVATE_VARIABLES: Final = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
"""Environment variables that are not passed to commands."""

_log = structlog.get_logger("imu-monitor")


@dataclass(frozen=True, slots=True)
class _Job:
    hook: Hook
    payload: bytes
    named: Mapping[str, str]  # additional environment variables


class Hooks(Output):
    """Output that runs the hooks of events.

    Parameters
    ----------
    hooks : sequence of Hook
        Configured hooks.
    put : callable
        Function that publishes a message on a zenoh key, and returns "" or a description of the error.
    now : callable, optional
        Monotonic clock in seconds.
    """

    name = "hook"

    def __init__(
        self, hooks: Sequence[Hook], put: Callable[[str, bytes], str], now: Callable[[], float] = time.monotonic
    ) -> None:
        self.hooks = tuple(hooks)
        self._put = put
        self._now = now
        self._jobs: queue.Queue[_Job | None] = queue.Queue(MAX_QUEUED)
        self._allowed: dict[tuple[Hook, str, str], tuple[float, float]] = {}  # number of allowed runs at a time
        self._threads: list[threading.Thread] = []
        self._closing = threading.Event()
        self._last_error = ""  # error of the newest run; empty if it succeeded
        self._failed = 0
        self._held_back = 0

    @property
    def state(self) -> str:
        """Status message: ``ok``, or the error of the newest run."""
        held_back = (
            f"{self._held_back} runs suppressed, because too many events occurred at once" if self._held_back else ""
        )
        if self._last_error:
            return "; ".join(filter(None, [f"{self._last_error} ({self._failed} failed since the start)", held_back]))
        return f"ok, but {held_back}" if held_back else "ok"

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Run the hooks that match an event."""
        wanted = [one for one in self.hooks if _matches(one, device, event.kind)]
        if not wanted:
            return
        payload = EventMessage.from_result(device, unix_s, received, event).encode()
        named = {"IMU_MONITOR_DEVICE": device, "IMU_MONITOR_KIND": event.kind, "IMU_MONITOR_AXIS": event.axis or ""}
        for hook in wanted:
            if not self._may_run(hook, event.kind, device):
                self._held_back += 1
                continue
            if hook.key is not None:
                self._log_result(hook.key, self._put(hook.key, payload))
            if hook.command:
                self._start(_Job(hook, payload + b"\n", named))

    def close(self) -> None:
        """Wait up to CLOSE_TIMEOUT_S for the commands, and kill the commands that are still running."""
        for _ in self._threads:
            try:
                self._jobs.put_nowait(None)
            except queue.Full:  # the queue is full of commands
                break
        until_s = time.monotonic() + CLOSE_TIMEOUT_S
        for thread in self._threads:
            thread.join(max(0.0, until_s - time.monotonic()))
        self._closing.set()
        for thread in self._threads:
            thread.join(CLOSE_TIMEOUT_S)
        self._threads = []

    # --- private methods

    def _may_run(self, hook: Hook, kind: str, device: str) -> bool:
        now_s = self._now()
        left, at_s = self._allowed.get((hook, kind, device), (float(BURST), now_s))
        left = min(float(BURST), left + (now_s - at_s) / RUN_INTERVAL_S)
        may = left >= 1.0
        self._allowed[hook, kind, device] = (left - 1.0 if may else left, now_s)
        return may

    def _start(self, job: _Job) -> None:
        try:
            while len(self._threads) < THREADS:
                thread = threading.Thread(target=self._run_queued, name=f"hooks {len(self._threads)}", daemon=True)
                thread.start()
                self._threads.append(thread)
        except RuntimeError as error:  # the system allows no more threads
            self._log_result(job.hook.command[0], f"cannot be started: {error}")
        try:
            self._jobs.put_nowait(job)
        except queue.Full:
            self._held_back += 1

    def _run_queued(self) -> None:
        while not self._closing.is_set() and (job := self._jobs.get()) is not None:
            try:
                wrong = _run_command(job.hook, job.payload, job.named, self._closing.is_set)
            except Exception as error:  # noqa: BLE001 - the status shows the error, and other commands are still run
                wrong = log_unexpected_error("hook", error)
            self._log_result(job.hook.command[0], wrong)

    def _log_result(self, what: str, wrong: str) -> None:
        if wrong:
            self._failed += 1
            _log.warning("hook", hook=what, error=wrong)
        else:
            _log.debug("hook", hook=what)
        self._last_error = f"{Path(what).name}: {wrong}" if wrong else ""


def _matches(hook: Hook, device: str, kind: str) -> bool:
    return ("*" in hook.on or kind in hook.on) and (not hook.devices or device in hook.devices)


def _run_command(hook: Hook, payload: bytes, named: Mapping[str, str], ending: Callable[[], bool]) -> str:
    """Run the command of a hook, and return "" or a description of the error."""
    environment = {name: value for name, value in os.environ.items() if name not in PRIVATE_VARIABLES}
    run = secrets.token_hex(8)
    try:
        process = subprocess.Popen(
            hook.command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**environment, **named, RUN_VARIABLE: run},
            start_new_session=True,  # so that all child processes can be killed
        )
    except (OSError, ValueError) as error:
        return f"cannot be started: {getattr(error, 'strerror', None) or error}"
    assert process.stdin is not None
    assert process.stdout is not None
    with process.stdout as output:
        try:
            with contextlib.suppress(BrokenPipeError), process.stdin:  # the command may close its standard input
                process.stdin.write(payload)  # does not block, because a pipe buffers more bytes
            until_s = time.monotonic() + hook.timeout_s
            wrong = _wait_for_end(process, output.fileno(), hook.timeout_s, ending)
            while not wrong and find_processes_of_run(run):
                if ending() or time.monotonic() > until_s:
                    return "" if ending() else f"its child processes were killed after {hook.timeout_s:g} s"
                time.sleep(CHILD_POLL_S)
            return wrong
        finally:
            _kill_run(process, run)


def _wait_for_end(process: "subprocess.Popen[bytes]", output: int, timeout_s: float, ending: Callable[[], bool]) -> str:
    """Wait for the end of a command or kill the command; return "" or a description of the error."""
    os.set_blocking(output, False)
    readable = select.poll()
    readable.register(output, select.POLLIN)
    until_s, tail = time.monotonic() + timeout_s, b""
    while process.poll() is None:
        if ending():
            return "killed because the service ended"
        if time.monotonic() > until_s:
            return f"killed after {timeout_s:g} s"
        if readable.poll(1000.0 * POLL_S):
            data = _read(output)
            tail = (tail + data)[-OUTPUT_BYTES:]
            if not data:  # the command has closed its output
                time.sleep(POLL_S)
    if process.returncode == 0:
        return ""
    for _ in range(MAX_LAST_READS):
        tail = (tail + _read(output))[-OUTPUT_BYTES:]
    how = f"signal {-process.returncode}" if process.returncode < 0 else f"exit status {process.returncode}"
    lines = tail.decode("utf-8", "replace").strip().splitlines()
    last = "".join(letter if letter.isprintable() else "�" for letter in mask_secrets(lines[-1])) if lines else ""
    return f"{how}: {last[-MAX_LINE_CHARS:]}" if last else how


def _kill_run(process: "subprocess.Popen[bytes]", run: str) -> None:
    """Kill a command and all processes that it has started."""
    pids = find_processes_of_run(run)  # searched before the parents of the processes are killed
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)  # the process id is valid, because the process is not reaped
    for _ in range(MAX_KILL_ROUNDS):
        for pid in pids:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
        process.wait()
        pids = find_processes_of_run(run)
        if not pids:
            return


def find_processes_of_run(run: str) -> set[int]:
    """Return the process ids of a run, which are processes with the variable of the run and their child processes.

    Parameters
    ----------
    run : str
        Value of RUN_VARIABLE in the environment of the command.
    """
    mark = f"{RUN_VARIABLE}={run}".encode()
    found: set[int] = set()
    parents: dict[int, int] = {}
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # the process has ended, or belongs to another user
            parents[int(path.name)] = int((path / "stat").read_text("utf-8", "replace").rpartition(")")[2].split()[1])
            if mark in (path / "environ").read_bytes().split(b"\0"):
                found.add(int(path.name))
    while more := {pid for pid, parent in parents.items() if parent in found} - found:
        found |= more
    return found


def _read(output: int) -> bytes:
    try:
        return os.read(output, OUTPUT_BYTES)
    except BlockingIOError:
        return b""
