"""The thread that writes: nothing waits for it, what is in its way is said, and what could be kept is."""

import contextlib
import resource
import sqlite3
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from monitor.history import writer as writers
from monitor.history.store import PastEvent, Store, reading
from monitor.history.writer import Writer
from tests.monitor.history.kills import ALL
from tests.monitor.history.made import row
from tests.support.waiting import PATIENCE_S, wait_for

T0 = 1_760_400_000
RNG = np.random.default_rng(1)


@contextlib.contextmanager
def started(path: Path) -> Iterator[Writer]:
    writer = Writer(path, lambda: T0 + 1e6)
    writer.start()
    try:
        yield writer
    finally:
        writer.close()


def count(path: Path) -> tuple[int, int]:
    with reading(path) as reader:
        return len(list(reader.rows("a", ALL))), reader.events("a", ALL, 1000)[1]


def fill(writer: Writer, n: int, first: int = 0) -> None:
    for i in range(first, first + n):
        writer.put("a", row(T0 + 60 * i, RNG))
        writer.tell("a", PastEvent(T0 + 60.0 * i, "moved", "x"))


def test_what_is_handed_over_is_in_the_file_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    with started(path) as writer:
        fill(writer, 100)
        writer.put("a", None)
    assert (writer.state, writer.written) == ("ok", 200)
    assert not path.with_name("h.sqlite-wal").exists()
    assert count(path) == (100, 100)


def test_a_damaged_file_is_left_alone_and_history_goes_on_when_it_is_moved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writers, "RETRY_S", 0.05)
    path = tmp_path / "h.sqlite"
    path.write_bytes(b"this was a history once" * 1000)
    with started(path) as writer:
        fill(writer, 10)
        wait_for(lambda: "damaged" in writer.state)
        assert path.read_bytes().startswith(b"this was a history once")
        path.rename(tmp_path / "aside")
        wait_for(lambda: writer.state == "ok")
    assert count(path) == (10, 10)


def test_a_queue_that_is_full_drops_and_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writers, "WAITING_AT_MOST", 50)
    folder = tmp_path / "here"
    folder.write_bytes(b"")  # a file where the folder would be
    monkeypatch.setattr(writers, "RETRY_S", 0.05)
    with started(folder / "h.sqlite") as writer:
        fill(writer, 40)
        wait_for(lambda: "trying again (30 results not kept)" in writer.state)
        folder.unlink()
        wait_for(lambda: writer.written == 50)
        assert writer.state == "ok, but 30 results not kept"
    assert count(folder / "h.sqlite") == (25, 25)


def test_a_file_that_is_held_by_another_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writers, "RETRY_S", 0.05)
    monkeypatch.setattr("monitor.history.store.BUSY_S", 0.05)
    path = tmp_path / "h.sqlite"
    Store(path).close()
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as other, started(path) as writer:
        other.execute("BEGIN IMMEDIATE")
        fill(writer, 5)
        wait_for(lambda: "locked" in writer.state)
        other.execute("COMMIT")
        wait_for(lambda: writer.state == "ok")
    assert count(path) == (5, 5)


def test_a_full_disk_keeps_nothing_half_and_resumes(tmp_path: Path) -> None:
    """In a process of its own: no file may grow beyond a limit, as on a full disk, until the limit is lifted."""
    program = f"""
        import resource, signal, time
        from pathlib import Path
        from monitor.history import writer as writers
        from tests.monitor.history.test_writer import count, fill
        from tests.support.waiting import wait_for
        writers.RETRY_S = 0.05
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        path = Path({str(tmp_path / "h.sqlite")!r})
        writer = writers.Writer(path, lambda: 0.0)
        writer.start()
        fill(writer, 20)
        wait_for(lambda: writer.written == 40)
        resource.setrlimit(resource.RLIMIT_FSIZE, (path.with_name("h.sqlite-wal").stat().st_size + 5000, -1))
        fill(writer, 400, 20)
        wait_for(lambda: "trying again" in writer.state)
        rows, events = count(path)
        assert rows == events, (rows, events)
        assert rows < 420
        resource.setrlimit(resource.RLIMIT_FSIZE, (-1, -1))
        wait_for(lambda: writer.written == 840)
        writer.close()
        print(writer.state, count(path))
    """
    assert resource.RLIM_INFINITY == -1
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert (done.returncode, done.stdout.splitlines()[-1:]) == (0, ["ok (420, 420)"]), done.stderr
