"""Storage of history rows and events in an SQLite file.

With the write-ahead log (WAL) of SQLite, one writer and any number of readers can access the file at the same time.
Rows cover one minute for a week, 15 minutes for three months, and six hours for all earlier times. The age of a row is
measured from the newest row of the device, or from the current time if that is earlier.
``HistoryFileWriter.merge_old_rows`` replaces old rows by one wider row per transaction. Even if the process is killed,
no result is lost or stored twice. A new row for a stored period is merged with the stored row, so restarts and repeated
replays do not create duplicates.

A file that is damaged, has a newer version or is not a history file raises RecordingError and is never modified. A full
or read-only disk raises ``sqlite3.Error``.
"""

import contextlib
import errno
import math
import os
import sqlite3
import time
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import msgspec

from drivers.errors import RecordingError
from drivers.host.safe_file_reading import check_folder_or_absent, check_regular_file
from drivers.validation.number_ranges import DAY_S
from monitor.history.history_row import (
    MAX_COLUMNS,
    STATES,
    HistoryRow,
    merge_rows,
    pack_count_min_max_last,
    unpack_count_min_max_last,
)
from monitor.history.stored_events import (
    MAX_EVENTS,
    THINNING_SPANS_S,
    StoredEvent,
    clamp_to_sqlite_range,
    count_events,
    insert_event,
    read_events,
    thin_events,
)
from monitor.history.time_ranges import TimeRange

FILE_NAME: Final = "history.sqlite"
VERSION: Final = 1
APPLICATION: Final = 0x494D5548  # "IMUH"
LEVELS: Final = ((60, 7 * DAY_S), (900, 90 * DAY_S), (21_600, None))
"""Width of rows [s], and the age [s] at which they are merged into wider rows. None means never."""
BUSY_TIMEOUT_S: Final = 5.0
CACHE_KIB: Final = 2048
SCHEMA: Final = """
CREATE TABLE device (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE);
CREATE TABLE layout (id INTEGER PRIMARY KEY, names TEXT NOT NULL UNIQUE);
CREATE TABLE row (
    device INTEGER NOT NULL, width INTEGER NOT NULL, start INTEGER NOT NULL, newest REAL NOT NULL,
    layout INTEGER NOT NULL, received INTEGER NOT NULL, lost INTEGER NOT NULL, bad INTEGER NOT NULL,
    overflowed INTEGER NOT NULL, state INTEGER NOT NULL, numbers BLOB NOT NULL,
    UNIQUE (device, width, start)
);
CREATE TABLE event (
    id INTEGER PRIMARY KEY, device INTEGER NOT NULL, t REAL NOT NULL, kind TEXT NOT NULL, axis TEXT,
    since REAL, sigma REAL, stands_for INTEGER NOT NULL, what TEXT NOT NULL, text TEXT NOT NULL
);
CREATE INDEX event_time ON event (device, t);
"""
TABLES: Final = frozenset({"device", "layout", "row", "event"})
SQLITE_SUFFIXES: Final = ("-wal", "-shm", "-journal")
"""Suffixes of the additional files that belong to an SQLite database."""
DELETED: Final = "was deleted or renamed"
REPLACED: Final = "was replaced by another file"
EMPTIED: Final = "was emptied"
CHANGED: Final = "was changed by another program"
MOVE_HINT: Final = "move it away, and a new one is begun"
_FIELDS: Final = "start, width, newest, layout, received, lost, bad, overflowed, state, numbers"


_FileState = tuple[int, int, int, int]
"""Device number, inode, size and modification time of a file."""


class UnusableHistory(RecordingError):
    """Exception for a history file that is damaged or is not a history file."""


class HistoryFileWriter:
    """Writer of a history file, which only one thread may use.

    Parameters
    ----------
    path
        Path of the history file. A missing file or folder is created.

    Raises
    ------
    RecordingError
        If the file is damaged, is not a history file, or was written by a newer version.
    sqlite3.Error, OSError
        If the file cannot be opened, possibly only temporarily.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        check_folder_or_absent(path.parent)
        path.parent.mkdir(parents=True, exist_ok=True)
        _check_files(path)
        path.touch()  # Creates the inode, which is compared after SQLite has opened the file.
        before = os.stat(path)
        self._files = _file_states(path)
        self._db = sqlite3.connect(path, timeout=BUSY_TIMEOUT_S, isolation_level=None, check_same_thread=False)
        self._version = -1
        try:
            with _damage_as_unusable(path):
                self._prepare()
            if not os.path.samestat(before, os.stat(path)):
                raise OSError(errno.EBUSY, "was replaced while it was being opened", str(path))
            self._files, self._version = _file_states(path), self._data_version()
        except BaseException:
            self.close()
            raise

    def _prepare(self) -> None:
        with self._transaction():
            if not _is_history(self._db, self.path):
                for statement in SCHEMA.split(";"):
                    self._db.execute(statement)
                self._db.execute(f"PRAGMA application_id = {APPLICATION}")
                self._db.execute(f"PRAGMA user_version = {VERSION}")
        deadline_s = time.monotonic() + BUSY_TIMEOUT_S
        while True:  # SQLite itself does not always wait while another process opens the new file.
            try:
                self._db.execute("PRAGMA journal_mode = WAL")
                break
            except sqlite3.OperationalError as error:
                if error.sqlite_errorcode != sqlite3.SQLITE_BUSY or time.monotonic() > deadline_s:
                    raise
                time.sleep(0.01)
        # Commits occur about once a minute and are flushed to disk, so a power failure loses at most one commit.
        self._db.execute("PRAGMA synchronous = FULL")
        self._db.execute(f"PRAGMA cache_size = -{CACHE_KIB}")

    def write_rows_and_events(
        self, rows: Sequence[tuple[str, HistoryRow]], events: Sequence[tuple[str, StoredEvent]] = ()
    ) -> None:
        """Write rows and events in one transaction.

        Parameters
        ----------
        rows
            Device name and row of each entry.
        events
            Device name and event of each entry.

        Raises
        ------
        UnusableHistory
            If the file is damaged.
        sqlite3.OperationalError
            If the file cannot be written, possibly only temporarily.
        """
        with _damage_as_unusable(self.path), self._transaction():
            for device, row in rows:
                self._put(_identifier(self._db, "device", "name", device), row)
            for device, event in events:
                insert_event(self._db, _identifier(self._db, "device", "name", device), event)
        self._files = _file_states(self.path)

    def merge_old_rows(self, now_s: float, max_buckets: int = 100) -> int:
        """Merge old rows into wider rows, and return the number of wider rows.

        Parameters
        ----------
        now_s
            Current Unix time [s].
        max_buckets
            Maximum number of wider rows to create in this call.

        Raises
        ------
        UnusableHistory
            If the file is damaged.
        sqlite3.OperationalError
            If the file cannot be written, possibly only temporarily.
        """
        done = 0
        with _damage_as_unusable(self.path):
            for device, newest_s in self._newest_end_s().items():
                if count_events(self._db, device) > MAX_EVENTS:
                    self._thin_events(device)
                    done += 1
                age_from_s = min(newest_s, now_s)
                for (width_s, age_s), (wider_s, _) in pairwise(LEVELS):
                    assert age_s is not None
                    limit_s = (age_from_s - age_s) // wider_s * wider_s
                    while done < max_buckets and self._merge_oldest(device, width_s, wider_s, limit_s):
                        done += 1
        if done:
            self._files = _file_states(self.path)
        return done

    def describe_external_change(self) -> str:
        """Describe how another program has changed the history file. The result is empty if there is no change.

        Without this check, SQLite would continue to write to a file that has been deleted.
        """
        now = _file_states(self.path)
        if now == self._files:
            return ""
        (before, _), (file, _) = self._files, now
        if file is None:
            return DELETED
        if before is None or file[:2] != before[:2]:
            return REPLACED
        return CHANGED if file[2] else EMPTIED

    def close(self) -> None:
        """Close the history file.

        SQLite does not merge the write-ahead log into a file that has been deleted or renamed, so the method merges it
        explicitly. If another program has overwritten the file, the method empties the log, because SQLite would apply
        it to the new content.
        """
        before, now = self._files[0], _file_states(self.path)[0]
        if before is not None and (now is None or now[:2] != before[:2]):
            with contextlib.suppress(sqlite3.Error):  # on a full disk, the log keeps the data
                self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        elif now != before and not self._committed_by_others():
            with contextlib.suppress(OSError):  # the log may not exist
                os.truncate(f"{self.path}-wal", 0)
        self._db.close()

    # --- rows

    def _put(self, device: int, row: HistoryRow) -> None:
        """Store a row, merged with the stored row of the same period if there is one."""
        for width_s, _ in LEVELS[::-1]:
            start_s = row.start_s // width_s * width_s
            held = self._stored_row(device, width_s, start_s)
            if held is not None and width_s >= row.width_s:
                row = merge_rows([held, row], start_s, width_s)
                break
        self._write(device, row)

    def _stored_row(self, device: int, width_s: int, start_s: int) -> HistoryRow | None:
        found = self._db.execute(
            f"SELECT {_FIELDS} FROM row WHERE device = ? AND width = ? AND start = ?", (device, width_s, start_s)
        ).fetchone()
        return None if found is None else _parse_row(self._db, found, {})

    def _write(self, device: int, row: HistoryRow) -> None:
        layout = _identifier(self._db, "layout", "names", " ".join(row.names))
        numbers = pack_count_min_max_last(row)
        fields = (device, row.start_s, row.width_s, row.newest_s, layout, *row.counts, row.state, numbers)
        marks = ", ".join("?" for _ in fields)
        self._db.execute(f"INSERT OR REPLACE INTO row (device, {_FIELDS}) VALUES ({marks})", fields)

    def _newest_end_s(self) -> dict[int, float]:
        """Return the Unix time at which the newest row of each device ends, or -inf if a device has no rows."""
        devices = [one for (one,) in self._db.execute("SELECT id FROM device").fetchall()]
        spans = {device: _stored_span(self._db, device) for device in devices}
        return {device: -math.inf if span is None else span[1] for device, span in spans.items()}

    def _merge_oldest(self, device: int, width_s: int, wider_s: int, limit_s: float) -> bool:
        """Merge the oldest rows into a wider row, or return False if the wider row would end after ``limit_s``."""
        oldest = self._db.execute(
            "SELECT min(start) FROM row WHERE device = ? AND width = ?", (device, width_s)
        ).fetchone()[0]
        if oldest is None:
            return False
        start_s = oldest // wider_s * wider_s
        if start_s + wider_s > limit_s:
            return False
        bucket = (device, width_s, start_s, start_s + wider_s)
        where = "device = ? AND width = ? AND start >= ? AND start < ?"
        with self._transaction():
            found = self._db.execute(f"SELECT {_FIELDS} FROM row WHERE {where} ORDER BY start", bucket).fetchall()
            names: dict[int, tuple[str, ...]] = {}
            rows = [_parse_row(self._db, one, names) for one in found]
            held = self._stored_row(device, wider_s, start_s)
            self._write(device, merge_rows([*([held] if held else []), *rows], start_s, wider_s))
            self._db.execute(f"DELETE FROM row WHERE {where}", bucket)
        return True

    def _thin_events(self, device: int) -> None:
        """Delete less important events per day, month and year until at most half of MAX_EVENTS remain."""
        for span_s in THINNING_SPANS_S:
            with self._transaction():
                thin_events(self._db, device, span_s)
            if count_events(self._db, device) <= MAX_EVENTS // 2:
                break

    # --- internal

    def _committed_by_others(self) -> bool:
        try:
            return self._data_version() != self._version
        except sqlite3.Error:
            return False

    def _data_version(self) -> int:
        """Return a version number that changes with every commit of another connection."""
        return int(self._db.execute("PRAGMA data_version").fetchone()[0])

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        self._db.execute("BEGIN IMMEDIATE")
        try:
            self._version = self._data_version()
            yield
            self._db.execute("COMMIT")
        except BaseException:
            if self._db.in_transaction:
                self._db.execute("ROLLBACK")
            raise


class HistoryReader:
    """Reader of a history file that returns the contents as they were when the file was opened."""

    def __init__(self, db: sqlite3.Connection, path: Path) -> None:
        self._db = db
        self.path = path
        self._names: dict[int, tuple[str, ...]] = {}  # names of the columns by the identifier of the layout

    def list_devices(self) -> tuple[str, ...]:
        """Return the sorted names of all devices in the history file."""
        return tuple(name for (name,) in self._db.execute("SELECT name FROM device ORDER BY name"))

    def stored_range(self, device: str) -> tuple[float, float] | None:
        """Return the Unix times at which the stored rows of a device start and end, or None if there are no rows."""
        return _stored_span(self._db, self._id(device))

    def newest_result_s(self, device: str) -> float:
        """Return the Unix time [s] of the newest result of a device, or NaN if there are no rows."""
        query = "SELECT newest FROM row WHERE device = ? AND width = ? ORDER BY start DESC LIMIT 1"
        found = [self._db.execute(query, (self._id(device), width_s)).fetchone() for width_s, _ in LEVELS]
        return max((one[0] for one in found if one is not None), default=math.nan)

    def read_rows(self, device: str, span: TimeRange) -> Iterator[HistoryRow]:
        """Yield the rows that overlap a time range.

        Wide rows come first, and rows of equal width are in chronological order.

        Parameters
        ----------
        device
            Name of the device.
        span
            Time range.
        """
        for width_s, _ in LEVELS[::-1]:
            found = self._db.execute(
                f"SELECT {_FIELDS} FROM row WHERE device = ? AND width = ? AND start > ? AND start <= ? ORDER BY start",
                (
                    self._id(device),
                    width_s,
                    clamp_to_sqlite_range(span.start_s - width_s),
                    clamp_to_sqlite_range(span.end_s),
                ),
            )
            for one in found:
                row = _parse_row(self._db, one, self._names)
                if span.overlaps(row.start_s, row.end_s):
                    yield row

    def read_events(self, device: str, span: TimeRange, max_events: int) -> tuple[list[StoredEvent], int]:
        """Return the newest events in a time range in chronological order, and the total number of events.

        Parameters
        ----------
        device
            Name of the device.
        span
            Time range.
        max_events
            Maximum number of events to return.
        """
        return read_events(self._db, self._id(device), span, max_events)

    def _id(self, device: str) -> int:
        found = self._db.execute("SELECT id FROM device WHERE name = ?", (device,)).fetchone()
        return -1 if found is None else int(found[0])


@contextlib.contextmanager
def open_history(path: Path) -> Iterator[HistoryReader]:
    """Open a history file for reading. The file is not modified.

    Raises
    ------
    RecordingError
        If the file does not exist or is not a readable history file.
    """
    try:
        os.stat(path)
        _check_files(path)
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: no such file") from error
    except OSError as error:
        raise RecordingError(f"{error.filename or path}: cannot be read: {error.strerror or error}") from error
    try:
        with _damage_as_unusable(path), contextlib.closing(_open_read_only(path)) as db:
            db.execute("BEGIN")
            if not _is_history(db, path):
                raise RecordingError(f"{path}: the history is still empty")
            yield HistoryReader(db, path)
    except sqlite3.OperationalError as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from error


def _stored_span(db: sqlite3.Connection, device: int) -> tuple[float, float] | None:
    starts: list[int] = []
    ends: list[int] = []
    for width_s, _ in LEVELS:
        for what, found in (("min", starts), ("max", ends)):
            query = f"SELECT {what}(start) FROM row WHERE device = ? AND width = ?"
            (one,) = db.execute(query, (device, width_s)).fetchone()
            if one is not None:
                found.append(one if what == "min" else one + width_s)
    return (float(min(starts)), float(max(ends))) if starts else None


def _is_history(db: sqlite3.Connection, path: Path) -> bool:
    """Return True for a history file and False for an empty database. Raise RecordingError for any other database."""
    (version,), (application,) = (
        db.execute(f"PRAGMA {what}").fetchone() for what in ("user_version", "application_id")
    )
    if application == APPLICATION and version > VERSION:
        raise RecordingError(f"{path}: written by a newer imu-monitor (version {version}, this one knows {VERSION})")
    if application != APPLICATION:
        (tables,) = db.execute("SELECT count(*) FROM sqlite_master").fetchone()
        if tables or version or application:
            raise UnusableHistory(f"{path}: an SQLite file, but not a history of imu-monitor")
        return False
    tables = {name for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if missing := sorted(TABLES - tables):
        raise UnusableHistory(f"{path}: damaged: it has no table {', '.join(missing)}; {MOVE_HINT}")
    return True


def _parse_row(
    db: sqlite3.Connection, record: Sequence[Any], names_by_layout: dict[int, tuple[str, ...]]
) -> HistoryRow:
    """Convert a database record to a history row, and add the column names of its layout to ``names_by_layout``."""
    start, width, newest, layout, received, lost, bad, overflowed, state, data = record
    whole = (start, width, layout, received, lost, bad, overflowed, state)
    if not (all(isinstance(one, int) for one in whole) and isinstance(newest, float) and isinstance(data, bytes)):
        raise RecordingError("a row has fields of another kind")
    if width <= 0 or not 0 <= state < len(STATES):
        raise RecordingError(f"a row of {width} s in state {state}")
    if layout not in names_by_layout:
        text = db.execute("SELECT names FROM layout WHERE id = ?", (layout,)).fetchone()
        if text is None or len(text[0]) > 64 * MAX_COLUMNS:
            raise RecordingError(f"a row names numbers ({layout}) that are not known")
        names_by_layout[layout] = tuple(text[0].split())
    names = names_by_layout[layout]
    counts = (received, lost, bad, overflowed)
    return HistoryRow(start, width, newest, names, *unpack_count_min_max_last(data, len(names)), counts, state)


def _identifier(db: sqlite3.Connection, table: str, column: str, text: str) -> int:
    """Return the identifier of a device or column layout, inserting it if it is not stored yet."""
    db.execute(f"INSERT OR IGNORE INTO {table} ({column}) VALUES (?)", (text,))
    return int(db.execute(f"SELECT id FROM {table} WHERE {column} = ?", (text,)).fetchone()[0])


def _open_read_only(path: Path) -> sqlite3.Connection:
    """Open a database for reading. If a read-only folder contains no log, the database is opened as immutable."""
    uri = f"{path.resolve().as_uri()}?mode=ro"
    db = sqlite3.connect(uri, uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None)
    try:
        db.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except BaseException as error:
        db.close()
        if not isinstance(error, sqlite3.OperationalError) or Path(f"{path}-wal").exists():
            raise
        db = sqlite3.connect(f"{uri}&immutable=1", uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None)
    return db


def _file_states(path: Path) -> tuple[_FileState | None, _FileState | None]:
    """Return the states of the database and its write-ahead log, or None for a missing file or an empty log."""
    found: list[_FileState | None] = []
    for one in (path, Path(f"{path}-wal")):
        try:
            seen = os.stat(one)
        except OSError:
            found.append(None)
        else:
            found.append((seen.st_dev, seen.st_ino, seen.st_size, seen.st_mtime_ns))
    file, log = found
    return file, log if log is not None and log[2] else None


def _check_files(path: Path) -> None:
    for end in ("", *SQLITE_SUFFIXES):
        with contextlib.suppress(FileNotFoundError):
            check_regular_file(Path(f"{path}{end}"))


@contextlib.contextmanager
def _damage_as_unusable(path: Path) -> Iterator[None]:
    """Convert errors caused by a damaged file to UnusableHistory, but leave temporary errors unchanged."""
    try:
        yield
    except sqlite3.OperationalError:
        raise
    except RecordingError as error:
        if str(error).startswith(str(path)):
            raise
        raise UnusableHistory(f"{path}: damaged: {error}; {MOVE_HINT}") from error
    except (sqlite3.DatabaseError, msgspec.DecodeError, UnicodeDecodeError) as error:
        raise UnusableHistory(f"{path}: damaged: {error}; {MOVE_HINT}") from error
