"""The thread that writes: nothing waits for it, what is in its way is said, and what could be kept is."""

import contextlib
import os
import resource
import shutil
import sqlite3
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from monitor.history import writer as writers
from monitor.history.sqlite_store import APPLICATION, SQLITE_SUFFIXES, VERSION, HistoryFileWriter, open_history
from monitor.history.stored_events import StoredEvent
from monitor.history.writer import HistoryWriter
from tests.monitor.history.kills import ALL
from tests.monitor.history.made import row
from tests.support.waiting import PATIENCE_S, wait_for

T0 = 1_760_400_000
RNG = np.random.default_rng(1)


@contextlib.contextmanager
def started(path: Path) -> Iterator[HistoryWriter]:
    writer = HistoryWriter(path, lambda: T0 + 1e6)
    writer.start()
    try:
        yield writer
    finally:
        writer.close()


def count(path: Path) -> tuple[int, int]:
    with open_history(path) as reader:
        return len(list(reader.read_rows("a", ALL))), reader.read_events("a", ALL, 1000)[1]


def fill(writer: HistoryWriter, n: int, first: int = 0) -> None:
    for i in range(first, first + n):
        writer.queue_item("a", row(T0 + 60 * i, RNG))
        writer.queue_item("a", StoredEvent(T0 + 60.0 * i, "moved", "x"))


def test_what_is_handed_over_is_in_the_file_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    with started(path) as writer:
        fill(writer, 100)
        writer.queue_item("a", None)
    assert (writer.state, writer.written) == ("ok", 200)
    assert not path.with_name("h.sqlite-wal").exists()
    assert count(path) == (100, 100)


def _checked_briskly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writers, "RETRY_S", 0.05)
    monkeypatch.setattr(writers, "CHECK_S", 0.05)


def aside(path: Path) -> list[Path]:
    return sorted(
        one
        for one in path.parent.glob(f"{path.name}{writers.RENAMED_SUFFIX}*")
        if not one.name.endswith(SQLITE_SUFFIXES)
    )


def test_a_damaged_file_is_moved_aside_unchanged_and_a_new_one_is_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _checked_briskly(monkeypatch)
    path = tmp_path / "h.sqlite"
    data = b"this was a history once" * 1000
    path.write_bytes(data)
    with started(path) as writer:
        fill(writer, 10)
        wait_for(lambda: writer.written == 20)
        (old,) = aside(path)
        assert old.read_bytes() == data
        assert writer.state.startswith("ok, but")
        assert "damaged" in writer.state
        assert old.name in writer.state
    assert count(path) == (10, 10)


def test_no_more_than_some_files_are_moved_aside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _checked_briskly(monkeypatch)
    monkeypatch.setattr(writers, "MAX_RENAMED_FILES", 2)
    path = tmp_path / "h.sqlite"
    with started(path) as writer:
        for i in range(3):
            wait_for(lambda: path.exists() and writer.state.startswith("ok"))
            replace(path, b"rubbish" * (i + 1000))
            if i < 2:
                wait_for(lambda i=i: len(aside(path)) == i + 1)
        wait_for(lambda: "2 such files exist already" in writer.state)
        assert path.read_bytes().startswith(b"rubbish")
        for one in aside(path):
            one.unlink()
        fill(writer, 5)
        wait_for(lambda: writer.written == 10)


def test_a_history_of_a_newer_version_is_left_where_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _checked_briskly(monkeypatch)
    path = tmp_path / "h.sqlite"
    HistoryFileWriter(path).close()
    with contextlib.closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA user_version = 99")
    data = path.read_bytes()
    with started(path) as writer:
        fill(writer, 5)
        wait_for(lambda: "newer imu-monitor" in writer.state)
        assert path.read_bytes() == data
        assert not aside(path)
        path.rename(tmp_path / "newer")
        wait_for(lambda: writer.written == 10 and writer.state == "ok", lambda: (writer.written, writer.state))


def replace(path: Path, data: bytes) -> None:
    """A new file of the same name."""
    other = path.with_name("other")
    other.write_bytes(data)
    other.rename(path)


def overwrite(path: Path, data: bytes) -> None:
    """Another content in the same file."""
    with path.open("r+b", buffering=0) as file:
        file.write(data)
        file.truncate()


def drop_tables(path: Path) -> None:
    with contextlib.closing(sqlite3.connect(path, isolation_level=None, timeout=20.0)) as db:
        db.execute("DROP TABLE row")


def without_tables(path: Path) -> None:
    """An SQLite file that says it is a history, and has nothing in it."""
    other = path.with_name("other")
    with contextlib.closing(sqlite3.connect(other, isolation_level=None)) as db:
        db.execute("CREATE TABLE something (x)")
        db.execute("DROP TABLE something")
        db.execute(f"PRAGMA application_id = {APPLICATION}")
        db.execute(f"PRAGMA user_version = {VERSION}")
    other.rename(path)


def remove_folder(path: Path) -> None:
    shutil.rmtree(path.parent)


TAMPERINGS = {
    "deleted": (lambda path: path.unlink(), "was deleted or renamed; a new one was begun"),
    "renamed": (lambda path: path.rename(path.with_name("elsewhere")), "was deleted or renamed; a new one was begun"),
    "emptied": (lambda path: overwrite(path, b""), "was emptied; a new one was begun"),
    "overwritten": (lambda path: overwrite(path, b"foreign" * 999), "damaged"),
    "replaced": (lambda path: replace(path, b"foreign" * 999), "damaged"),
    "tables dropped": (drop_tables, "it has no table row"),
    "without tables": (without_tables, "it has no table device, event, layout, row"),
    "folder removed": (remove_folder, "was deleted or renamed; a new one was begun"),
    "folder renamed": (
        lambda path: path.parent.rename(path.parent.with_name("away")),
        "was deleted or renamed; a new one was begun",
    ),
}


@pytest.mark.parametrize("name", TAMPERINGS)
def test_a_file_that_goes_away_while_it_is_written_is_noticed_and_begun_anew(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _checked_briskly(monkeypatch)
    tamper, said = TAMPERINGS[name]
    path = tmp_path / "store" / "h.sqlite"
    with started(path) as writer:
        fill(writer, 10)
        wait_for(lambda: writer.written == 20)
        tamper(path)
        wait_for(lambda: said in writer.state)
        fill(writer, 10, 10)
        wait_for(lambda: writer.written == 40)
        assert writer.state.startswith("ok, but")
    assert count(path) == (10, 10)
    match name:
        case "renamed":
            assert count(path.with_name("elsewhere")) == (10, 10)
        case "folder renamed":
            assert count(tmp_path / "away" / "h.sqlite") == (10, 10)
        case "overwritten" | "replaced":
            assert aside(path)[0].read_bytes() == b"foreign" * 999
        case _ if "tables" in name:
            assert len(aside(path)) == 1


def test_another_history_in_its_place_is_added_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A backup that is restored while the daemon runs, as a new file and over the old one."""
    _checked_briskly(monkeypatch)
    path, other = tmp_path / "h.sqlite", tmp_path / "backup.sqlite"
    with started(other) as writer:
        fill(writer, 3)
    backup = other.read_bytes()
    with started(path) as writer:
        fill(writer, 3)
        wait_for(lambda: writer.written == 6)
        replace(path, backup)
        wait_for(lambda: "was replaced by another file; results are added to that one" in writer.state)
        fill(writer, 4, 10)
        wait_for(lambda: writer.written == 14)
        assert count(path) == (7, 7)
        overwrite(path, backup)
        fill(writer, 2, 20)
        wait_for(lambda: writer.written == 18)
    assert count(path) == (5, 5)
    with contextlib.closing(sqlite3.connect(path)) as db:
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def test_rows_that_another_program_deletes_do_not_hide_those_that_follow(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    with started(path) as writer:
        fill(writer, 3)
        wait_for(lambda: writer.written == 6)
        with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as db:
            for table in ("device", "layout", "row", "event"):
                db.execute(f"DELETE FROM {table}")
        fill(writer, 4, 10)
        wait_for(lambda: writer.written == 14)
    assert count(path) == (4, 4)


def test_a_second_writer_of_a_folder_keeps_nothing_until_the_first_has_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _checked_briskly(monkeypatch)
    path = tmp_path / "h.sqlite"
    with started(path) as first:
        fill(first, 3)
        wait_for(lambda: first.written == 6)
        with started(path) as second:
            wait_for(lambda: f"in use by process {os.getpid()}" in second.state)
            fill(second, 3)
            fill(first, 2, 3)
            wait_for(lambda: first.written == 10)
            assert count(path) == (5, 5)
            assert (second.written, second.dropped) == (0, 0)
            first.close()
            wait_for(lambda: second.state == "ok")
            # the row that was being gathered meanwhile is in the file already
            fill(second, 3, 4)
            wait_for(lambda: second.written == 5)
    assert count(path) == (7, 8)


def test_a_queue_that_is_full_drops_and_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writers, "QUEUE_CAPACITY", 50)
    folder = tmp_path / "here"
    folder.write_bytes(b"")  # a file where the folder would be
    monkeypatch.setattr(writers, "RETRY_S", 0.05)
    with started(folder / "h.sqlite") as writer:
        fill(writer, 40)
        wait_for(lambda: "trying again (30 results not stored)" in writer.state)
        folder.unlink()
        wait_for(lambda: writer.written == 50)
        wait_for(lambda: writer.state == "ok, but 30 results not stored")
    assert count(folder / "h.sqlite") == (25, 25)


def test_a_file_that_is_held_by_another_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writers, "RETRY_S", 0.05)
    monkeypatch.setattr("monitor.history.sqlite_store.BUSY_TIMEOUT_S", 0.05)
    path = tmp_path / "h.sqlite"
    HistoryFileWriter(path).close()
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
        writer = writers.HistoryWriter(path, lambda: 0.0)
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
