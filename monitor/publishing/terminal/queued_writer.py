"""Text output to a terminal, a pipe or a file in a separate thread, so that a blocked write delays no other thread.

A write call blocks while a terminal is stopped (Ctrl-S, a suspended remote shell) or while no program reads from a
pipe. ``QueuedWriter`` queues lines, drops the oldest lines if the queue is full, and can redraw a table periodically.
The property ``state`` reports how many lines and table frames were lost.

The thread writes to the file descriptor and not to ``sys.stdout``, because a blocked write to ``sys.stdout`` holds the
lock of the stream. If this lock is held, the interpreter aborts at exit.
"""

import contextlib
import errno
import io
import os
import select
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Final, TextIO

from monitor.common.unit_formatting import format_count
from monitor.publishing.bounded_queue import BoundedQueue

MAX_QUEUED_CHARACTERS: Final = 256 * 1024
"""Maximum number of characters in the queue, enough for about 2000 log lines."""
CHUNK_BYTES: Final = 1024
"""Number of bytes per write call. Short calls make it possible to distinguish a slow terminal from a blocked one."""
BLOCKED_S: Final = 2.0
"""Duration [s] after which a write call counts as blocked."""
FRAME_DELAY_S: Final = 0.05
"""Delay [s] before the table is redrawn, so that simultaneous results appear in one drawing."""
IDLE_WAIT_S: Final = 1.0
CLOSE_S: Final = 2.0

Render = Callable[[Sequence[str], bool], str]
"""Function that converts queued lines to the text to write. The second argument is True for the last call."""


class QueuedWriter:
    """Thread that writes text to a stream without blocking the caller.

    Parameters
    ----------
    stream : TextIO or None
        Stream that receives the text, or None to discard the text. A stream without a descriptor may block the
        caller.
    place : str
        Name of the stream in messages, such as "standard error".
    render : callable, optional
        Function that the thread calls to convert queued lines to text. By default, lines are joined.
    period_s : float, optional
        Interval [s] at which ``render`` is called even if no lines are queued. By default, lines are required.
    limit : int
        Number of queued characters above which the oldest lines are dropped. The newest line is always kept.
    tell : callable, optional
        Function that receives a report of dropped lines when the stream accepts text again.
    """

    def __init__(
        self,
        stream: TextIO | None,
        place: str,
        render: Render | None = None,
        period_s: float | None = None,
        limit: int = MAX_QUEUED_CHARACTERS,
        tell: Callable[[str], None] | None = None,
    ) -> None:
        self.error: Exception | None = None  # exception of the last write or rendering; None after success
        self._stream = stream
        self._descriptor = descriptor_of(stream)
        self._place = place
        self._render = render or (lambda lines, _last: "".join(lines))
        self._period_s = period_s
        self._tell = tell
        self._queue: BoundedQueue[str] = BoundedQueue(limit)
        self._lost_lines = 0  # number of lines taken from the queue but not written
        self._told_lines = 0  # number of dropped lines that were reported through tell
        self._lost_frames = 0
        self._reason = ""  # reason for the loss of the newest lines
        self._write_since_s: float | None = None  # monotonic time at which the current write call began
        self._closing = threading.Event()
        self._given_up = False  # True if the thread did not end before the timeout
        self._thread = threading.Thread(target=self._run, name=f"writer of {place}", daemon=True)

    def __enter__(self) -> "QueuedWriter":
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self.close()
        if kind is None and self.error is not None:
            raise self.error

    @property
    def state(self) -> str:
        """``ok`` or a description of the problem, with the number of lines and frames dropped since the start."""
        blocked_s = self._blocked_s()
        frames = self._lost_frames + self._frames_in(blocked_s)
        counts = ((frames, "frame"), (self.dropped_lines, "log line"))
        dropped = " and ".join(format_count(count, name) for count, name in counts if count)
        if blocked_s:
            wrong = f"blocked for {blocked_s:.0f} s: nobody reads {self._place}"
        elif (error := self.error) is not None:
            wrong = f"{self._place} cannot be written: {_reason(error)}"
        else:
            return f"ok, but {dropped} dropped" if dropped else "ok"
        return f"{wrong}; {dropped} dropped" if dropped else wrong

    @property
    def dropped_lines(self) -> int:
        """Number of lines that were not written."""
        return self._queue.dropped + self._lost_lines

    def start(self) -> None:
        """Start the thread that writes the queued text."""
        self._thread.start()

    def put(self, text: str) -> None:
        """Add whole lines to the queue and return at once."""
        self._queue.push(text, len(text))

    def request_redraw(self) -> None:
        """Request that ``render`` be called before the current period ends."""
        self._queue.wake()

    def wait_until_written(self, stop: threading.Event) -> None:
        """Wait until the thread has written all queued text and ended, or until ``stop`` is set."""
        self._begin_closing()
        while self._thread.is_alive() and not stop.is_set():
            self._thread.join(0.1)

    def close(self, timeout_s: float = CLOSE_S) -> bool:
        """Write all queued text and end the thread. Return False if the output is still blocked after ``timeout_s``.

        The null device replaces a blocked file descriptor, so that the interpreter cannot block at exit.
        """
        self._begin_closing()
        if self._thread.is_alive() and not self._given_up:
            self._thread.join(timeout_s)
        self._given_up = self._thread.is_alive()
        if self._given_up or not can_write(self._descriptor):
            redirect_to_null_device(self._stream)
        return not self._given_up

    # --- methods of the thread

    def _run(self) -> None:
        while True:
            closing = self._closing.is_set()  # read before the queue, to write all lines queued before close()
            lines = self._queue.take(0.0 if closing else self._period_s or IDLE_WAIT_S)
            if self._period_s is not None and not closing:
                self._closing.wait(FRAME_DELAY_S)
                lines += self._queue.take(0.0)
            self._process_batch([line for line in lines if line], closing)
            if closing:
                if rest := self._queue.take(0.0):  # the previous batch may have queued a report of dropped lines
                    self._process_batch(rest, closing)
                return

    def _process_batch(self, lines: list[str], last: bool) -> None:
        if not lines and not last and self._period_s is None:
            return
        dropped = self.dropped_lines
        text, failed = self._rendered(lines, last)
        try:
            self._write(text)
        except (OSError, ValueError) as error:  # a closed stream raises ValueError
            self._lost_lines += len(lines)
            self._lost_frames += self._period_s is not None
            self._reason = f"{self._place} could not be written: {_reason(error)}"
            self.error = error
        else:
            self.error = failed
            self._tell_dropped(dropped)
        finally:
            self._write_since_s = None

    def _rendered(self, lines: list[str], last: bool) -> tuple[str, Exception | None]:
        try:
            return self._render(lines, last), None
        except Exception as error:  # noqa: BLE001 - the state reports the error, and the log continues
            self._lost_frames += 1
            return "".join(lines), error

    def _write(self, text: str) -> None:
        if self._stream is None or not text:
            return
        self._write_since_s = time.monotonic()
        if self._descriptor is None:
            self._stream.write(text)
            self._stream.flush()
            return
        left = memoryview(text.encode(self._stream.encoding or "utf-8", "replace"))
        while left:
            try:
                left = left[os.write(self._descriptor, left[:CHUNK_BYTES]) :]
            except BlockingIOError:  # another process has made the terminal non-blocking
                can_write(self._descriptor, IDLE_WAIT_S)
                continue
            if blocked_s := self._blocked_s():
                self._lost_frames += self._frames_in(blocked_s)
                self._reason = f"nobody read {self._place}"
            self._write_since_s = time.monotonic()

    def _tell_dropped(self, dropped: int) -> None:
        """Report dropped lines. The queue has space for the report, because it has just been emptied."""
        count = dropped - self._told_lines
        if count and self._tell is not None:
            self._told_lines = dropped
            were = "was" if count == 1 else "were"
            self._tell(
                f"{format_count(count, 'log line')} {were} dropped because {self._reason or 'the queue was full'}"
            )

    # --- counting

    def _blocked_s(self) -> float:
        """Return the duration of the blocked write call [s], or 0 if no call is blocked."""
        since_s = self._write_since_s
        blocked_s = 0.0 if since_s is None else time.monotonic() - since_s
        return blocked_s if blocked_s >= BLOCKED_S else 0.0

    def _frames_in(self, blocked_s: float) -> int:
        return 0 if self._period_s is None else int(blocked_s / self._period_s)

    def _begin_closing(self) -> None:
        self._closing.set()
        self._queue.push("", 0)  # wake() would not reach a thread that does not wait yet


class QueuedLines(io.TextIOBase):
    """Text stream that passes whole lines to a ``QueuedWriter`` and replaces ``sys.stderr``."""

    def __init__(self, writer: QueuedWriter, terminal: bool) -> None:
        self._writer = writer
        self._terminal = terminal
        self._partial = ""
        self._lock = threading.RLock()  # reentrant, because a warning during garbage collection may call write() again

    def write(self, text: str) -> int:
        """Pass complete lines to the writer and return at once."""
        with self._lock:
            *lines, self._partial = (self._partial + text).split("\n")
            if len(self._partial) > MAX_QUEUED_CHARACTERS:
                lines, self._partial = [*lines, self._partial], ""
        for line in lines:
            self._writer.put(f"{line}\n")
        return len(text)

    def isatty(self) -> bool:
        """Return True if the lines are written to a terminal."""
        return self._terminal


def descriptor_of(stream: TextIO | None) -> int | None:
    """Return the file descriptor of a stream, or None if the stream has no descriptor."""
    try:
        descriptor = -1 if stream is None else stream.fileno()
    except (OSError, ValueError):
        return None
    return descriptor if descriptor >= 0 else None


def redirect_to_null_device(stream: TextIO | None) -> None:
    """Redirect the file descriptor of a stream to the null device, so that later writes cannot block."""
    descriptor = descriptor_of(stream)
    if descriptor is not None:
        with (
            contextlib.suppress(OSError),
            open(os.devnull, "wb") as null,
        ):  # if no descriptor is free, the stream is not changed
            os.dup2(null.fileno(), descriptor)


def can_write(descriptor: int | None, timeout_s: float = 0.0) -> bool:
    """Return True if a short write to the descriptor does not block.

    Parameters
    ----------
    descriptor : int or None
        File descriptor to test. None counts as writable.
    timeout_s : float
        Longest time to wait until a write does not block [s].
    """
    if descriptor is None:
        return True
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    return bool(poll.poll(1000.0 * timeout_s))


def reader_is_gone(stream: TextIO) -> bool:
    """Return True if the stream is a pipe or a socket whose reader has closed it."""
    descriptor = descriptor_of(stream)
    if descriptor is None:
        return False
    poll = select.poll()
    poll.register(descriptor, 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


def _reason(error: Exception) -> str:
    if isinstance(error, OSError):
        return error.strerror or errno.errorcode.get(error.errno or 0, str(error))
    return f"{type(error).__name__}: {error}"
