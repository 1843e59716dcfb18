"""Tests of the writing thread of the history: errors, damaged or replaced files, and full disks."""

import contextlib
import errno
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
from tests.monitor.history.kill_writers import ALL_TIMES
from tests.monitor.history.random_rows import make_row
from tests.support.waiting import PATIENCE_S, wait_for

T0 = 1_760_400_000
RNG = np.random.default_rng(1)


@contextlib.contextmanager
def start_writer(path: Path) -> Iterator[HistoryWriter]:
    writer = HistoryWriter(path, lambda: T0 + 1e6)
    writer.start()
    try:
        yield writer
    finally:
        writer.close()


def count_rows_and_events(path: Path) -> tuple[int, int]:
    with open_history(path) as reader:
        return len(list(reader.read_rows("a", ALL_TIMES))), reader.read_events("a", ALL_TIMES, 1000)[1]


def queue_rows_and_events(writer: HistoryWriter, n: int, first: int = 0) -> None:
    for i in range(first, first + n):
        writer.queue_item("a", make_row(T0 + 60 * i, RNG))
        writer.queue_item("a", StoredEvent(T0 + 60.0 * i, "moved", "x"))


def test_queued_items_are_in_the_file_after_closing(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    with start_writer(path) as writer:
        queue_rows_and_events(writer, 100)
        writer.queue_item("a", None)
    assert (writer.state, writer.written) == ("ok", 200)
    assert not path.with_name("h.sqlite-wal").exists()
    assert count_rows_and_events(path) == (100, 100)


def _shorten_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writers, "RETRY_S", 0.05)
    monkeypatch.setattr(writers, "CHECK_S", 0.05)


def list_renamed_files(path: Path) -> list[Path]:
    return sorted(
        renamed
        for renamed in path.parent.glob(f"{path.name}{writers.RENAMED_SUFFIX}*")
        if not renamed.name.endswith(SQLITE_SUFFIXES)
    )


def test_damaged_file_is_renamed_unchanged_and_a_new_file_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _shorten_intervals(monkeypatch)
    path = tmp_path / "h.sqlite"
    data = b"this was a history once" * 1000
    path.write_bytes(data)
    with start_writer(path) as writer:
        queue_rows_and_events(writer, 10)
        wait_for(lambda: writer.written == 20)
        (old,) = list_renamed_files(path)
        assert old.read_bytes() == data
        assert writer.state.startswith("ok, but")
        assert "damaged" in writer.state
        assert old.name in writer.state
    assert count_rows_and_events(path) == (10, 10)


def test_number_of_renamed_files_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _shorten_intervals(monkeypatch)
    monkeypatch.setattr(writers, "MAX_RENAMED_FILES", 2)
    path = tmp_path / "h.sqlite"
    with start_writer(path) as writer:
        for i in range(3):
            wait_for(lambda: path.exists() and writer.state.startswith("ok"))
            replace_file(path, b"rubbish" * (i + 1000))
            if i < 2:
                wait_for(lambda i=i: len(list_renamed_files(path)) == i + 1)
        wait_for(lambda: "2 such files exist already" in writer.state)
        assert path.read_bytes().startswith(b"rubbish")
        for renamed in list_renamed_files(path):
            renamed.unlink()
        queue_rows_and_events(writer, 5)
        wait_for(lambda: writer.written == 10)


def test_history_of_a_newer_version_is_left_in_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _shorten_intervals(monkeypatch)
    path = tmp_path / "h.sqlite"
    HistoryFileWriter(path).close()
    with contextlib.closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA user_version = 99")
    data = path.read_bytes()
    with start_writer(path) as writer:
        queue_rows_and_events(writer, 5)
        wait_for(lambda: "newer imu-monitor" in writer.state)
        assert path.read_bytes() == data
        assert not list_renamed_files(path)
        path.rename(tmp_path / "newer")
        wait_for(lambda: writer.written == 10 and writer.state == "ok", lambda: (writer.written, writer.state))


def replace_file(path: Path, data: bytes) -> None:
    """Replace the file by a new file of the same name."""
    other = path.with_name("other")
    other.write_bytes(data)
    other.rename(path)


def overwrite_file(path: Path, data: bytes) -> None:
    """Replace the content of the same file."""
    with path.open("r+b", buffering=0) as file:
        file.write(data)
        file.truncate()


def drop_tables(path: Path) -> None:
    with contextlib.closing(sqlite3.connect(path, isolation_level=None, timeout=20.0)) as db:
        db.execute("DROP TABLE row")


def replace_by_empty_history(path: Path) -> None:
    """Replace the file by an SQLite file that is marked as a history but has no tables."""
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
    "emptied": (lambda path: overwrite_file(path, b""), "was emptied; a new one was begun"),
    "overwritten": (lambda path: overwrite_file(path, b"foreign" * 999), "damaged"),
    "replaced": (lambda path: replace_file(path, b"foreign" * 999), "damaged"),
    "tables dropped": (drop_tables, "it has no table row"),
    "without tables": (replace_by_empty_history, "it has no table device, event, layout, row"),
    "folder removed": (remove_folder, "was deleted or renamed; a new one was begun"),
    "folder renamed": (
        lambda path: path.parent.rename(path.parent.with_name("away")),
        "was deleted or renamed; a new one was begun",
    ),
}


@pytest.mark.parametrize("name", TAMPERINGS)
def test_removed_or_changed_file_is_noticed_and_a_new_one_is_started(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _shorten_intervals(monkeypatch)
    tamper, message = TAMPERINGS[name]
    path = tmp_path / "store" / "h.sqlite"
    with start_writer(path) as writer:
        queue_rows_and_events(writer, 10)
        wait_for(lambda: writer.written == 20)
        tamper(path)
        wait_for(lambda: message in writer.state)
        queue_rows_and_events(writer, 10, 10)
        wait_for(lambda: writer.written == 40)
        assert writer.state.startswith("ok, but")
    assert count_rows_and_events(path) == (10, 10)
    match name:
        case "renamed":
            assert count_rows_and_events(path.with_name("elsewhere")) == (10, 10)
        case "folder renamed":
            assert count_rows_and_events(tmp_path / "away" / "h.sqlite") == (10, 10)
        case "overwritten" | "replaced":
            assert list_renamed_files(path)[0].read_bytes() == b"foreign" * 999
        case _ if "tables" in name:
            assert len(list_renamed_files(path)) == 1


@pytest.mark.parametrize("failing", ["__init__", "merge_old_rows"])
def test_deletion_is_noticed_although_the_file_cannot_be_used_at_that_moment(
    failing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder that is being removed can be neither read nor written, until its removal has ended."""
    _shorten_intervals(monkeypatch)
    path = tmp_path / "h.sqlite"
    works, failures = getattr(HistoryFileWriter, failing), iter([OSError(errno.EIO, "disk error")] * 2)

    def fail_twice(*args, **options):
        if error := next(failures, None):
            path.unlink(missing_ok=True)
            raise error
        return works(*args, **options)

    with start_writer(path) as writer:
        queue_rows_and_events(writer, 10)
        wait_for(lambda: writer.written == 20)
        monkeypatch.setattr(HistoryFileWriter, failing, fail_twice)
        if failing == "__init__":
            path.unlink()
        wait_for(lambda: "was deleted or renamed; a new one was begun" in writer.state)


def test_other_history_in_place_of_the_file_is_extended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A backup is restored while the daemon runs, as a new file and into the old file."""
    _shorten_intervals(monkeypatch)
    path, other = tmp_path / "h.sqlite", tmp_path / "backup.sqlite"
    with start_writer(other) as writer:
        queue_rows_and_events(writer, 3)
    backup = other.read_bytes()
    with start_writer(path) as writer:
        queue_rows_and_events(writer, 3)
        wait_for(lambda: writer.written == 6)
        replace_file(path, backup)
        wait_for(lambda: "was replaced by another file; results are added to that one" in writer.state)
        queue_rows_and_events(writer, 4, 10)
        wait_for(lambda: writer.written == 14)
        assert count_rows_and_events(path) == (7, 7)
        overwrite_file(path, backup)
        queue_rows_and_events(writer, 2, 20)
        wait_for(lambda: writer.written == 18)
    assert count_rows_and_events(path) == (5, 5)
    with contextlib.closing(sqlite3.connect(path)) as db:
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def test_rows_after_a_deletion_by_another_program_are_stored(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    with start_writer(path) as writer:
        queue_rows_and_events(writer, 3)
        wait_for(lambda: writer.written == 6)
        with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as db:
            for table in ("device", "layout", "row", "event"):
                db.execute(f"DELETE FROM {table}")
        queue_rows_and_events(writer, 4, 10)
        wait_for(lambda: writer.written == 14)
    assert count_rows_and_events(path) == (4, 4)


def test_second_writer_waits_until_the_first_has_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _shorten_intervals(monkeypatch)
    path = tmp_path / "h.sqlite"
    with start_writer(path) as first:
        queue_rows_and_events(first, 3)
        wait_for(lambda: first.written == 6)
        with start_writer(path) as second:
            wait_for(lambda: f"in use by process {os.getpid()}" in second.state)
            queue_rows_and_events(second, 3)
            queue_rows_and_events(first, 2, 3)
            wait_for(lambda: first.written == 10)
            assert count_rows_and_events(path) == (5, 5)
            assert (second.written, second.dropped) == (0, 0)
            first.close()
            wait_for(lambda: second.state == "ok")
            # The row that was being aggregated is already in the file.
            queue_rows_and_events(second, 3, 4)
            wait_for(lambda: second.written == 5)
    assert count_rows_and_events(path) == (7, 8)


def test_full_queue_drops_and_counts_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writers, "QUEUE_CAPACITY", 50)
    folder = tmp_path / "here"
    folder.write_bytes(b"")  # a file where the folder would be
    monkeypatch.setattr(writers, "RETRY_S", 0.05)
    with start_writer(folder / "h.sqlite") as writer:
        queue_rows_and_events(writer, 40)
        wait_for(lambda: "trying again (30 results not stored)" in writer.state)
        folder.unlink()
        wait_for(lambda: writer.written == 50)
        wait_for(lambda: writer.state == "ok, but 30 results not stored")
    assert count_rows_and_events(folder / "h.sqlite") == (25, 25)


def test_locked_file_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writers, "RETRY_S", 0.05)
    monkeypatch.setattr("monitor.history.sqlite_store.BUSY_TIMEOUT_S", 0.05)
    path = tmp_path / "h.sqlite"
    HistoryFileWriter(path).close()
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as other, start_writer(path) as writer:
        other.execute("BEGIN IMMEDIATE")
        queue_rows_and_events(writer, 5)
        wait_for(lambda: "locked" in writer.state)
        other.execute("COMMIT")
        wait_for(lambda: writer.state == "ok")
    assert count_rows_and_events(path) == (5, 5)


def test_full_disk_stores_no_partial_results_and_writing_resumes(tmp_path: Path) -> None:
    """A file size limit in a separate process acts like a full disk until the limit is lifted."""
    program = f"""
        import resource, signal, time
        from pathlib import Path
        from monitor.history import writer as writers
        from tests.monitor.history.test_writer import count_rows_and_events, queue_rows_and_events
        from tests.support.waiting import wait_for
        writers.RETRY_S = 0.05
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        path = Path({str(tmp_path / "h.sqlite")!r})
        writer = writers.HistoryWriter(path, lambda: 0.0)
        writer.start()
        queue_rows_and_events(writer, 20)
        wait_for(lambda: writer.written == 40)
        resource.setrlimit(resource.RLIMIT_FSIZE, (path.with_name("h.sqlite-wal").stat().st_size + 5000, -1))
        queue_rows_and_events(writer, 400, 20)
        wait_for(lambda: "trying again" in writer.state)
        rows, events = count_rows_and_events(path)
        assert rows == events, (rows, events)
        assert rows < 420
        resource.setrlimit(resource.RLIMIT_FSIZE, (-1, -1))
        wait_for(lambda: writer.written == 840)
        writer.close()
        print(writer.state, count_rows_and_events(path))
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
