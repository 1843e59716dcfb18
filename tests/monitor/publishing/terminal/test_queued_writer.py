"""Tests of the queued writer for destinations that block or fail: nothing waits, and losses are counted."""

import io
import os
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TextIO

import pytest

from monitor.publishing.terminal import queued_writer
from monitor.publishing.terminal.queued_writer import QueuedLines, QueuedWriter
from tests.support.waiting import PATIENCE_S, wait_for


class BlockablePipe:
    """A pipe that can be filled, so that the next write to it blocks."""

    def __init__(self) -> None:
        self.reading, writing = os.pipe()
        self.stream: TextIO = os.fdopen(writing, "w", encoding="utf-8")

    def fill(self) -> int:
        """Fill the pipe; return the number of bytes in it."""
        descriptor, count = self.stream.fileno(), 0
        os.set_blocking(descriptor, False)
        try:
            while True:
                count += os.write(descriptor, bytes(1024))
        except BlockingIOError:
            return count
        finally:
            os.set_blocking(descriptor, True)

    def read(self, count: int) -> bytes:
        """Read this many bytes."""
        data = b""
        while len(data) < count:
            data += os.read(self.reading, count - len(data))
        return data


@pytest.fixture
def pipe() -> Iterator[BlockablePipe]:
    pipe = BlockablePipe()
    yield pipe
    pipe.stream.close()
    os.close(pipe.reading)


@pytest.fixture(autouse=True)
def _short_blocked_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(queued_writer, "BLOCKED_S", 0.1)


def test_lines_are_written_in_order_before_closing(pipe: BlockablePipe) -> None:
    with QueuedWriter(pipe.stream, "the pipe") as writer:
        for i in range(1000):
            writer.put(f"{i}\n")
    assert writer.state == "ok"
    assert pipe.read(3890).decode() == "".join(f"{i}\n" for i in range(1000))


def test_blocked_pipe_drops_the_oldest_lines_and_reports_their_number(pipe: BlockablePipe) -> None:
    reports: list[str] = []
    filled = pipe.fill()
    writer = QueuedWriter(pipe.stream, "the pipe", limit=40, tell=reports.append)
    writer.start()
    writer.put("in the write call\n")
    wait_for(lambda: writer.state.startswith("blocked for 0 s: nobody reads the pipe"))
    for i in range(10):
        writer.put(f"{i:09}\n")  # each line has 10 characters, so four remain
    assert writer.state.endswith("; 6 log lines dropped")
    assert reports == []
    pipe.read(filled)
    wait_for(lambda: writer.state == "ok, but 6 log lines dropped")
    assert pipe.read(58).decode() == "in the write call\n000000006\n000000007\n000000008\n000000009\n"
    assert writer.close()
    assert reports == ["6 log lines were dropped because nobody read the pipe"]


def test_permanently_blocked_pipe_is_abandoned(pipe: BlockablePipe) -> None:
    filled = pipe.fill()
    writer = QueuedWriter(pipe.stream, "the pipe")
    writer.start()
    writer.put("never read\n")
    wait_for(lambda: writer.state.startswith("blocked"))
    assert not writer.close(0.1)
    os.write(pipe.stream.fileno(), bytes(1 << 20))  # output of the interpreter at exit does not block
    pipe.read(filled)  # ends the thread
    wait_for(lambda: writer.close(0.0))


def test_non_blocking_descriptor_loses_nothing(pipe: BlockablePipe) -> None:
    """Another program on the same terminal may have set O_NONBLOCK."""
    filled = pipe.fill()
    os.set_blocking(pipe.stream.fileno(), False)
    text = "".join(f"line {i}\n" for i in range(20_000))  # more than the capacity of the pipe
    writer = QueuedWriter(pipe.stream, "the pipe")
    writer.start()
    writer.put(text)
    wait_for(lambda: writer.state.startswith("blocked"))
    pipe.read(filled)
    assert pipe.read(len(text)).decode() == text
    assert writer.close()
    assert writer.error is None


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_full_disk_is_reported_and_counted() -> None:
    reports: list[str] = []
    with open("/dev/full", "w", encoding="utf-8") as full:
        writer = QueuedWriter(full, "the log", tell=reports.append)
        writer.start()
        writer.put("one\n")
        wait_for(lambda: writer.state == "the log cannot be written: No space left on device; 1 log line dropped")
        free, busy = os.pipe()
        os.dup2(busy, full.fileno())  # there is space again
        writer.put("two\n")
        wait_for(lambda: reports)
        assert os.read(free, 100) == b"two\n"
        assert reports == ["1 log line was dropped because the log could not be written: No space left on device"]
        assert writer.state == "ok, but 1 log line dropped"
        assert writer.close()
        os.close(free)
        os.close(busy)


def test_report_of_dropped_lines_is_the_last_line(pipe: BlockablePipe) -> None:
    """The report is written even if the reader resumes only during closing."""
    filled = pipe.fill()
    writer = QueuedWriter(pipe.stream, "the pipe", limit=100, tell=lambda text: writer.put(f"{text}\n"))
    writer.start()
    writer.put("a\n")
    wait_for(lambda: writer.state.startswith("blocked"))
    for _ in range(60):
        writer.put("b\n")  # each line has 2 characters, so 50 remain
    closing = threading.Thread(target=writer.close, args=(60.0,))
    closing.start()
    pipe.read(filled)
    closing.join(PATIENCE_S)
    expected = "a\n" + 50 * "b\n" + "10 log lines were dropped because nobody read the pipe\n"
    assert pipe.read(len(expected)).decode() == expected


def test_rendering_error_neither_ends_the_thread_nor_loses_lines(pipe: BlockablePipe) -> None:
    broken = threading.Event()
    broken.set()

    def render(lines: Sequence[str], last: bool) -> str:
        if broken.is_set():
            raise RuntimeError("no table")
        return "".join(lines) + ("last\n" if last else "frame\n")

    writer = QueuedWriter(pipe.stream, "the pipe", render, period_s=0.05)
    writer.start()
    writer.put("one\n")
    assert pipe.read(4) == b"one\n"
    wait_for(lambda: writer.state.startswith("the pipe cannot be written: RuntimeError: no table; "))
    broken.clear()
    assert pipe.read(6) == b"frame\n"
    assert writer.close()
    assert writer.state.startswith("ok, but ")
    pipe.stream.close()
    assert os.read(pipe.reading, 100_000).endswith(b"last\n")


def test_frames_are_redrawn_and_counted_while_nobody_reads(pipe: BlockablePipe) -> None:
    writer = QueuedWriter(pipe.stream, "the pipe", lambda _lines, last: "last\n" if last else "f\n", period_s=0.05)
    filled = pipe.fill()
    writer.start()
    wait_for(lambda: "frames dropped" in writer.state)
    assert writer.state.startswith("blocked for ")
    pipe.read(filled)
    assert pipe.read(4) == b"f\nf\n"
    assert writer.state.startswith("ok, but ")
    assert writer.state.endswith("frames dropped")
    assert writer.close()


def test_missing_stream_is_accepted() -> None:
    """The stream is missing if the process was started with standard error closed."""
    with QueuedWriter(None, "nowhere") as writer:
        writer.put("one\n")
    assert writer.state == "ok"


def test_stream_without_a_descriptor_is_written() -> None:
    stream = io.StringIO()
    with QueuedWriter(stream, "memory") as writer:
        writer.put("one\n")
    assert stream.getvalue() == "one\n"


def test_unencodable_characters_are_replaced(tmp_path: Path) -> None:
    with open(tmp_path / "log", "w", encoding="ascii") as stream, QueuedWriter(stream, "the log") as writer:
        writer.put("3 µrad\n")
    assert (tmp_path / "log").read_bytes() == b"3 ?rad\n"


def test_partial_lines_are_joined(tmp_path: Path) -> None:
    with open(tmp_path / "log", "w", encoding="utf-8") as stream, QueuedWriter(stream, "the log") as writer:
        lines = QueuedLines(writer, terminal=False)
        print("one", 2, file=lines)
        lines.write("three\nfo")
        assert not lines.isatty()
        print("ur", file=lines)
    assert (tmp_path / "log").read_text() == "one 2\nthree\nfour\n"
