"""What events set off: commands of the user's, and messages on keys of the user's.

An event that a hook waits for becomes JSON. On a zenoh key it is put at once. For a command it goes on a bounded queue,
from which a few threads take: each runs one command at a time, without a shell, with the JSON on its standard input and
nothing of it among its arguments. A command that takes too long is killed with all that it started; of what it prints
only the end is kept. What fails is logged and stands in the status under ``hook`` until something goes well again;
the loop never waits.

A hook runs at most BURST times at once and then once in EVERY_S for each kind of event and device, so that a bad line
that tells of losses every second neither starts a thousand programs nor drowns the one alarm beside it. What is held
back is counted, and said.
"""

import os
import queue
import selectors
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import structlog

from drivers.sample import Event
from monitor.daemon.device_worker import Output
from monitor.publishing.messages import encoding
from monitor.settings.loading import Hook

AT_ONCE: Final = 4
WAITING: Final = 100
BURST: Final = 10
EVERY_S: Final = 6.0
OUTPUT_BYTES: Final = 4096
"""Of what a command prints, its end."""
LINE: Final = 200
"""Characters of its last line that are said."""
LOOK_S: Final = 0.05
"""Whether a command has ended is asked so often."""
LAST_S: Final = 2.0
"""That commands have left when the service ends."""
OWN: Final = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
"""Meant for this process alone."""

_log = structlog.get_logger("imu-monitor")


@dataclass(frozen=True, slots=True)
class _Job:
    hook: Hook
    payload: bytes
    named: Mapping[str, str]  # variables of the environment


class Hooks(Output):
    """Runs what is hooked to events.

    Args:
        hooks: what to run
        put: a message on a zenoh key; "" or why it did not go out
        now: monotonic time in s
    """

    def __init__(
        self, hooks: Sequence[Hook], put: Callable[[str, bytes], str], now: Callable[[], float] = time.monotonic
    ) -> None:
        self.hooks = tuple(hooks)
        self._put = put
        self._now = now
        self._jobs: queue.Queue[_Job | None] = queue.Queue(WAITING)
        self._allowed: dict[tuple[Hook, str, str], tuple[float, float]] = {}  # runs left, and when that was
        self._threads: list[threading.Thread] = []
        self._closing = threading.Event()
        self._wrong = ""  # of the newest run
        self._failed = 0
        self._held_back = 0

    @property
    def state(self) -> str:
        """``ok``, or what went wrong with the newest run."""
        held_back = f"{self._held_back} held back, too many at once" if self._held_back else ""
        if self._wrong:
            return "; ".join(filter(None, [f"{self._wrong} ({self._failed} failed since the start)", held_back]))
        return f"ok, but {held_back}" if held_back else "ok"

    def event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Set off what waits for this."""
        wanted = [one for one in self.hooks if _waits(one, device, event.kind)]
        if not wanted:
            return
        payload = encoding.event(device, unix_s, received, event, encoding.since_s(unix_s, event))
        named = {"IMU_MONITOR_DEVICE": device, "IMU_MONITOR_KIND": event.kind, "IMU_MONITOR_AXIS": event.axis or ""}
        for hook in wanted:
            if not self._may_run(hook, event.kind, device):
                self._held_back += 1
                continue
            if hook.key is not None:
                self._told(hook.key, self._put(hook.key, payload))
            if hook.command:
                self._start(_Job(hook, payload + b"\n", named))

    def close(self) -> None:
        """Let what waits and runs end, for LAST_S; then kill it."""
        for _ in self._threads:
            try:
                self._jobs.put_nowait(None)
            except queue.Full:  # more waits than can still be done
                break
        until_s = time.monotonic() + LAST_S
        for thread in self._threads:
            thread.join(max(0.0, until_s - time.monotonic()))
        self._closing.set()
        for thread in self._threads:
            thread.join(LAST_S)
        self._threads = []

    # --- inside

    def _may_run(self, hook: Hook, kind: str, device: str) -> bool:
        now_s = self._now()
        left, at_s = self._allowed.get((hook, kind, device), (float(BURST), now_s))
        left = min(float(BURST), left + (now_s - at_s) / EVERY_S)
        may = left >= 1.0
        self._allowed[hook, kind, device] = (left - 1.0 if may else left, now_s)
        return may

    def _start(self, job: _Job) -> None:
        try:
            while len(self._threads) < AT_ONCE:
                thread = threading.Thread(target=self._take, name=f"hooks {len(self._threads)}", daemon=True)
                thread.start()
                self._threads.append(thread)
        except RuntimeError as error:  # the system gives no more threads
            self._told(job.hook.command[0], f"cannot be started: {error}")
        try:
            self._jobs.put_nowait(job)
        except queue.Full:
            self._held_back += 1

    def _take(self) -> None:
        """A thread: one command after the other."""
        while not self._closing.is_set() and (job := self._jobs.get()) is not None:
            self._told(job.hook.command[0], run(job.hook, job.payload, job.named, self._closing.is_set))

    def _told(self, what: str, wrong: str) -> None:
        if wrong:
            self._failed += 1
            _log.warning("hook", hook=what, error=wrong)
        else:
            _log.debug("hook", hook=what)
        self._wrong = f"{Path(what).name}: {wrong}" if wrong else ""


def _waits(hook: Hook, device: str, kind: str) -> bool:
    return ("*" in hook.on or kind in hook.on) and (not hook.devices or device in hook.devices)


def run(hook: Hook, payload: bytes, named: Mapping[str, str], ending: Callable[[], bool]) -> str:
    """Run the command of a hook to its end; "" or what went wrong. ``ending``: whether it is to be killed now."""
    environment = {name: value for name, value in os.environ.items() if name not in OWN}
    try:
        process = subprocess.Popen(
            hook.command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**environment, **named},
            start_new_session=True,  # a group of its own, that can be killed as a whole
        )
    except (OSError, ValueError) as error:
        return f"cannot be started: {getattr(error, 'strerror', None) or error}"
    try:
        with _Pipes(process, payload) as pipes:
            return _followed(process, pipes, hook.timeout_s, ending)
    except OSError as error:  # out of file descriptors
        return f"killed: {error.strerror or error}"
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)  # not waited for yet: the number is still its own
            process.wait()


def _followed(process: "subprocess.Popen[bytes]", pipes: "_Pipes", timeout_s: float, ending: Callable[[], bool]) -> str:
    """To its end, or until it is to be killed; "" or what went wrong."""
    until_s = time.monotonic() + timeout_s
    while process.poll() is None:
        pipes.move()
        if ending():
            return "killed, as the service ended"
        if time.monotonic() > until_s:
            return f"killed after {timeout_s:g} s"
    if process.returncode == 0:
        return ""
    pipes.drain()
    how = f"signal {-process.returncode}" if process.returncode < 0 else f"exit status {process.returncode}"
    return f"{how}{pipes.last_line()}"


class _Pipes:
    """Both ends of a command, moved without waiting for either: one that neither reads nor writes holds up nobody."""

    def __init__(self, process: "subprocess.Popen[bytes]", payload: bytes) -> None:
        assert process.stdin is not None
        assert process.stdout is not None
        self._in, self._out = process.stdin, process.stdout
        self._left = memoryview(payload)
        self._tail = bytearray()
        self._selector = selectors.DefaultSelector()
        for pipe, events in ((self._in, selectors.EVENT_WRITE), (self._out, selectors.EVENT_READ)):
            os.set_blocking(pipe.fileno(), False)
            self._selector.register(pipe, events)

    def __enter__(self) -> "_Pipes":
        return self

    def __exit__(self, *_: object) -> None:
        self._selector.close()
        for pipe in (self._in, self._out):
            pipe.close()

    def move(self) -> None:
        """What can be moved now, or within LOOK_S."""
        for key, _ in self._selector.select(LOOK_S):
            if key.fileobj is self._in:
                self._write()
            else:
                self._read()

    def drain(self) -> None:
        """What is still in the pipe of a command that has ended; what it left running may go on writing."""
        for _ in range(16):
            if self._out.closed or not self._read():
                return

    def last_line(self) -> str:
        """``: `` and the last line it printed, as far as it can be said; "" of none."""
        lines = self._tail.decode("utf-8", "replace").strip().splitlines()
        said = "".join(letter if letter.isprintable() else "�" for letter in lines[-1])[-LINE:] if lines else ""
        return f": {said}" if said else ""

    def _write(self) -> None:
        try:
            self._left = self._left[os.write(self._in.fileno(), self._left) :]
        except BlockingIOError:
            return
        except BrokenPipeError:  # it does not want to know
            self._left = self._left[:0]
        if not self._left:
            self._selector.unregister(self._in)
            self._in.close()

    def _read(self) -> bool:
        """Whether there may be more."""
        try:
            data = os.read(self._out.fileno(), OUTPUT_BYTES)
        except BlockingIOError:
            return False
        self._tail = (self._tail + data)[-OUTPUT_BYTES:]
        if not data and self._out in self._selector.get_map():
            self._selector.unregister(self._out)
        return bool(data)
