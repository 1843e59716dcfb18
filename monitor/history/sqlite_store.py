"""History on disk: one SQLite file in WAL mode, with one writer and any number of readers in threads and processes.

Three levels of rows: a minute for a week, a quarter of an hour for three months, six hours for good. Age is counted
from a device's newest row, or from now where that lies in the future. ``Store.thin`` makes one row of those of a longer
bucket, bucket by bucket, each in a transaction of its own: a process killed anywhere leaves every moment in exactly one
row. A row for a bucket that is there already is added to it, so restarts, late rows and recordings played again leave
one row a bucket. Events are all kept up to EVENTS_AT_MOST a device; beyond, of a kind, axis and day the first, the last
and the surest stay, then of a month, then of a year, and what is gone is counted in ``stands_for`` of the last.

A file that is damaged, of a newer version or somebody else's is never touched: RecordingError says which it is. What a
full or read-only disk does comes through as ``sqlite3.Error``; a transaction is whole or has not happened.
"""

import contextlib
import errno
import math
import os
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import msgspec

from drivers.errors import RecordingError
from drivers.file_access import check_folder, check_regular
from monitor.history.bucket import NUMBERS_AT_MOST, STATES, Row, merged, pack, unpack
from monitor.history.time_ranges import Span

FILE: Final = "history.sqlite"
VERSION: Final = 1
APPLICATION: Final = 0x494D5548  # "IMUH"
DAY_S: Final = 86_400
LEVELS: Final = ((60, 7 * DAY_S), (900, 90 * DAY_S), (21_600, None))
"""Width of a row, and its age at which it becomes part of one of the next width; all in s."""
EVENTS_AT_MOST: Final = 20_000
"""Of one device."""
EVENT_SPANS_S: Final = (DAY_S, 30 * DAY_S, 365 * DAY_S)
TEXT_AT_MOST: Final = 2000
BUSY_S: Final = 5.0
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
BESIDE: Final = ("-wal", "-shm", "-journal")
"""Ends of the names of files that SQLite keeps beside a database."""
DELETED: Final = "was deleted or renamed"
REPLACED: Final = "was replaced by another file"
EMPTIED: Final = "was emptied"
CHANGED: Final = "was changed by another program"
MOVE: Final = "move it away, and a new one is begun"
_ROW: Final = "start, width, newest, layout, received, lost, bad, overflowed, state, numbers"


_Stat = tuple[int, int, int, int]
"""Device, inode, size and time of change of a file."""


@dataclass(frozen=True, slots=True)
class PastEvent:
    """Something that happened to a device."""

    t_s: float  # Unix
    kind: str
    text: str
    axis: str | None = None
    what: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    since_s: float | None = None
    sigma: float | None = None
    stands_for: int = 1  # events, itself and those of its kind that were thinned out before it


class UnusableHistory(RecordingError):
    """A file in place of a history that is damaged or holds something else."""


class Store:
    """The writer. One thread is to use it.

    Args:
        path: the file; made where there is none, its folder too
    Raises:
        RecordingError: the file is not a history, damaged, or of a newer version
        sqlite3.Error, OSError: it cannot be opened now
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        check_folder(path.parent)
        path.parent.mkdir(parents=True, exist_ok=True)
        _check_files(path)
        path.touch()  # it has an identity before SQLite opens it
        before = os.stat(path)
        self._files = _stats(path)
        self._db = sqlite3.connect(path, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
        self._devices: dict[str, int] = {}
        self._layouts = _Layouts(self._db)
        self._version = -1
        try:
            with _explained(path):
                self._prepare()
            if not os.path.samestat(before, os.stat(path)):
                raise OSError(errno.EBUSY, "was replaced while it was being opened", str(path))
            self._files, self._version = _stats(path), self._data_version()
        except BaseException:
            self.close()
            raise

    def _prepare(self) -> None:
        if not check(self._db, self.path):
            self._db.execute("PRAGMA journal_mode = WAL")
            with self._transaction():
                if not check(self._db, self.path):  # another process was as quick
                    for statement in SCHEMA.split(";"):
                        self._db.execute(statement)
                    self._db.execute(f"PRAGMA application_id = {APPLICATION}")
                    self._db.execute(f"PRAGMA user_version = {VERSION}")
        # a commit a minute is on the disk before the next: that costs nothing, and a power cut takes no more than it
        self._db.execute("PRAGMA synchronous = FULL")
        self._db.execute(f"PRAGMA cache_size = -{CACHE_KIB}")

    def add(self, rows: Sequence[tuple[str, Row]], events: Sequence[tuple[str, PastEvent]] = ()) -> None:
        """Rows and events of devices, all of them or none."""
        with _explained(self.path), self._transaction():
            for device, row in rows:
                self._put(self._device(device), row)
            for device, event in events:
                self._put_event(self._device(device), event)
        self._files = _stats(self.path)

    def thin(self, now_s: float, at_most: int = 100) -> int:
        """Let rows be old: merge up to so many buckets, and say how many were; 0 = nothing is due."""
        done = 0
        with _explained(self.path):
            for device, newest_s in self._newest().items():
                done += self._thin_events(device)
                age_from_s = min(newest_s, now_s)
                for (width_s, age_s), (wider_s, _) in pairwise(LEVELS):
                    assert age_s is not None
                    limit_s = (age_from_s - age_s) // wider_s * wider_s
                    while done < at_most and self._merge_oldest(device, width_s, wider_s, limit_s):
                        done += 1
        if done:
            self._files = _stats(self.path)
        return done

    def change(self) -> str:
        """Say what another program has done to the file since this store used it last; "" if nothing.

        SQLite itself notices none of it: it would go on writing to a file that has no name any more.
        """
        now = _stats(self.path)
        if now == self._files:
            return ""
        (before, _), (file, _) = self._files, now
        if file is None:
            return DELETED
        if before is None or file[:2] != before[:2]:
            return REPLACED
        return CHANGED if file[2] else EMPTIED

    def close(self) -> None:
        """What was added stays; without a reader the file is left in one piece.

        SQLite leaves the log of a file that lost its name, and would bring the log into one that was written over.
        """
        before, now = self._files[0], _stats(self.path)[0]
        if before is not None and (now is None or now[:2] != before[:2]):
            with contextlib.suppress(sqlite3.Error):  # a full disk: the log stays, and nothing of it is lost
                self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        elif now != before and not self._committed_by_others():
            with contextlib.suppress(OSError):  # there is no log
                os.truncate(f"{self.path}-wal", 0)
        self._db.close()

    # --- rows

    def _put(self, device: int, row: Row) -> None:
        """Add to the row of that bucket, or be it. Where the bucket was thinned already, to the wider one."""
        for width_s, _ in LEVELS[::-1]:
            start_s = row.start_s // width_s * width_s
            held = self._held(device, width_s, start_s)
            if held is not None and width_s >= row.width_s:
                row = merged([held, row], start_s, width_s)
                break
        self._write(device, row)

    def _held(self, device: int, width_s: int, start_s: int) -> Row | None:
        found = self._db.execute(
            f"SELECT {_ROW} FROM row WHERE device = ? AND width = ? AND start = ?", (device, width_s, start_s)
        ).fetchone()
        return None if found is None else self._layouts.row(found)

    def _write(self, device: int, row: Row) -> None:
        self._db.execute(
            f"INSERT OR REPLACE INTO row (device, {_ROW}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (
                device,
                row.start_s,
                row.width_s,
                row.newest_s,
                self._layouts.id(row.names),
                *row.counts,
                row.state,
                pack(row),
            ),
        )

    def _newest(self) -> dict[int, float]:
        """Of each device the end of its newest row; without one nothing is old."""
        devices = [one for (one,) in self._db.execute("SELECT id FROM device").fetchall()]
        spans = {device: _held_span(self._db, device) for device in devices}
        return {device: -math.inf if span is None else span[1] for device, span in spans.items()}

    def _merge_oldest(self, device: int, width_s: int, wider_s: int, limit_s: float) -> bool:
        """Make one row of the oldest wider bucket that ends at ``limit_s`` or before; False where there is none."""
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
            found = self._db.execute(f"SELECT {_ROW} FROM row WHERE {where} ORDER BY start", bucket).fetchall()
            rows = [self._layouts.row(one) for one in found]
            held = self._held(device, wider_s, start_s)
            self._write(device, merged([*([held] if held else []), *rows], start_s, wider_s))
            self._db.execute(f"DELETE FROM row WHERE {where}", bucket)
        return True

    # --- events

    def _put_event(self, device: int, event: PastEvent) -> None:
        self._db.execute(
            "INSERT INTO event (device, t, kind, axis, since, sigma, stands_for, what, text)"
            " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (
                device,
                event.t_s,
                event.kind,
                event.axis,
                event.since_s,
                event.sigma,
                event.stands_for,
                _what_text(event.what),
                event.text[:TEXT_AT_MOST],
            ),
        )

    def _thin_events(self, device: int) -> int:
        """Whether there were too many; then the oldest half of what may be kept is thinned by days, months, years."""
        if self._count_events(device) <= EVENTS_AT_MOST:
            return 0
        for span_s in EVENT_SPANS_S:
            with self._transaction():
                self._thin_events_of(device, span_s)
            if self._count_events(device) <= EVENTS_AT_MOST // 2:
                break
        return 1

    def _count_events(self, device: int) -> int:
        return int(self._db.execute("SELECT count(*) FROM event WHERE device = ?", (device,)).fetchone()[0])

    def _thin_events_of(self, device: int, span_s: int) -> None:
        """Of a kind, axis and span the first, the last and the surest stay; the last stands for those that go."""
        keep: dict[tuple[Any, ...], list[tuple[Any, ...]]] = {}
        rows = self._db.execute(
            "SELECT id, t, kind, axis, sigma, stands_for FROM event WHERE device = ? ORDER BY t, id", (device,)
        )
        for one in rows:
            keep.setdefault((int(one[1] // span_s), one[2], one[3]), []).append(one)
        for group in keep.values():
            surest = max(group, key=lambda one: -math.inf if one[4] is None else one[4])
            stay = {group[0][0], surest[0], group[-1][0]}
            gone = [one for one in group if one[0] not in stay]
            if not gone:
                continue
            self._db.executemany("DELETE FROM event WHERE id = ?", [(one[0],) for one in gone])
            more = sum(one[5] for one in gone)
            self._db.execute("UPDATE event SET stands_for = stands_for + ? WHERE id = ?", (more, group[-1][0]))

    # --- inside

    def _device(self, name: str) -> int:
        if name not in self._devices:
            self._db.execute("INSERT OR IGNORE INTO device (name) VALUES (?)", (name,))
            (found,) = self._db.execute("SELECT id FROM device WHERE name = ?", (name,)).fetchone()
            self._devices[name] = int(found)
        return self._devices[name]

    def _renumber(self) -> None:
        """Forget the numbers of devices and layouts if another connection has changed the file."""
        version = self._data_version()
        if version != self._version:
            self._version = version
            self._devices.clear()
            self._layouts.forget()

    def _committed_by_others(self) -> bool:
        """Whether another connection of SQLite has changed the file; False for one that was written over."""
        try:
            return self._data_version() != self._version
        except sqlite3.Error:
            return False

    def _data_version(self) -> int:
        """A number that changes with every commit of another connection."""
        return int(self._db.execute("PRAGMA data_version").fetchone()[0])

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        self._db.execute("BEGIN IMMEDIATE")
        try:
            self._renumber()
            yield
            self._db.execute("COMMIT")
        except BaseException:
            self._devices.clear()  # what was numbered within it may not be there
            self._layouts.forget()
            if self._db.in_transaction:
                self._db.execute("ROLLBACK")
            raise


class Reader:
    """A look at a history: all its answers are of one moment. Made by ``reading``."""

    def __init__(self, db: sqlite3.Connection, path: Path) -> None:
        self._db = db
        self.path = path
        self._layouts = _Layouts(db)

    def devices(self) -> tuple[str, ...]:
        """Those of which anything is kept, by name."""
        return tuple(name for (name,) in self._db.execute("SELECT name FROM device ORDER BY name"))

    def held(self, device: str) -> tuple[float, float] | None:
        """From when to when there are rows, Unix s; None where there are none."""
        return _held_span(self._db, self._id(device))

    def newest_s(self, device: str) -> float:
        """Unix time of the newest result in a row; NaN where there is none."""
        query = "SELECT newest FROM row WHERE device = ? AND width = ? ORDER BY start DESC LIMIT 1"
        found = [self._db.execute(query, (self._id(device), width_s)).fetchone() for width_s, _ in LEVELS]
        return max((one[0] for one in found if one is not None), default=math.nan)

    def rows(self, device: str, span: Span) -> Iterator[Row]:
        """Those of which anything is in the span; each level by time, the widest first."""
        for width_s, _ in LEVELS[::-1]:
            found = self._db.execute(
                f"SELECT {_ROW} FROM row WHERE device = ? AND width = ? AND start > ? AND start <= ? ORDER BY start",
                (self._id(device), width_s, _bound(span.start_s - width_s), _bound(span.end_s)),
            )
            for one in found:
                row = self._layouts.row(one)
                if span.touches(row.start_s, row.end_s):
                    yield row

    def events(self, device: str, span: Span, at_most: int) -> tuple[list[PastEvent], int]:
        """The newest of the span, by time, and how many there are in it."""
        where = "device = ? AND t >= ? AND t <= ?"
        bounds = (self._id(device), _bound(span.start_s), _bound(span.end_s))
        found = self._db.execute(
            f"SELECT t, kind, text, axis, what, since, sigma, stands_for FROM event WHERE {where}"
            " ORDER BY t DESC, id DESC LIMIT ?",
            (*bounds, at_most + 2),  # those at the very ends may not belong to it
        ).fetchall()
        events = [
            PastEvent(t, kind, text, axis, _what(what), since, sigma, stands_for)
            for t, kind, text, axis, what, since, sigma, stands_for in found
            if span.holds(t)
        ]
        (count,) = self._db.execute(f"SELECT count(*) FROM event WHERE {where}", bounds).fetchone()
        return events[:at_most][::-1], max(int(count), len(events[:at_most]))

    def _id(self, device: str) -> int:
        found = self._db.execute("SELECT id FROM device WHERE name = ?", (device,)).fetchone()
        return -1 if found is None else int(found[0])


@contextlib.contextmanager
def reading(path: Path) -> Iterator[Reader]:
    """A look at the history in a file, which is left as it is.

    Raises:
        RecordingError: there is none, or it cannot be read
    """
    try:
        os.stat(path)
        _check_files(path)
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: no such file") from error
    except OSError as error:
        raise RecordingError(f"{error.filename or path}: cannot be read: {error.strerror or error}") from error
    try:
        with _explained(path), contextlib.closing(_opened(path)) as db:
            if not check(db, path):
                raise RecordingError(f"{path}: nothing is in it yet")
            db.execute("BEGIN")
            yield Reader(db, path)
    except sqlite3.OperationalError as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from error


def _held_span(db: sqlite3.Connection, device: int) -> tuple[float, float] | None:
    """From when to when a device has rows; each end is a step into the index, none is a scan."""
    starts: list[int] = []
    ends: list[int] = []
    for width_s, _ in LEVELS:
        for what, found in (("min", starts), ("max", ends)):
            query = f"SELECT {what}(start) FROM row WHERE device = ? AND width = ?"
            (one,) = db.execute(query, (device, width_s)).fetchone()
            if one is not None:
                found.append(one if what == "min" else one + width_s)
    return (float(min(starts)), float(max(ends))) if starts else None


def check(db: sqlite3.Connection, path: Path) -> bool:
    """Whether the file is a history; False for an empty one.

    Raises:
        RecordingError: it is something else, or of a newer version
    """
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
        raise UnusableHistory(f"{path}: damaged: it has no table {', '.join(missing)}; {MOVE}")
    return True


class _Layouts:
    """Names of the numbers of rows, by their number in the file."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db
        self._ids: dict[tuple[str, ...], int] = {}
        self._names: dict[int, tuple[str, ...]] = {}

    def forget(self) -> None:
        self._ids.clear()
        self._names.clear()

    def id(self, names: tuple[str, ...]) -> int:
        if names not in self._ids:
            text = " ".join(names)
            self._db.execute("INSERT OR IGNORE INTO layout (names) VALUES (?)", (text,))
            (found,) = self._db.execute("SELECT id FROM layout WHERE names = ?", (text,)).fetchone()
            self._ids[names] = int(found)
        return self._ids[names]

    def row(self, found: Sequence[Any]) -> Row:
        """A row as it was selected."""
        start, width, newest, layout, received, lost, bad, overflowed, state, data = found
        whole = (start, width, layout, received, lost, bad, overflowed, state)
        if not (all(isinstance(one, int) for one in whole) and isinstance(newest, float) and isinstance(data, bytes)):
            raise RecordingError("a row has fields of another kind")
        if width <= 0 or not 0 <= state < len(STATES):
            raise RecordingError(f"a row of {width} s in state {state}")
        if layout not in self._names:
            text = self._db.execute("SELECT names FROM layout WHERE id = ?", (layout,)).fetchone()
            if text is None or len(text[0]) > 64 * NUMBERS_AT_MOST:
                raise RecordingError(f"a row names numbers ({layout}) that are not known")
            self._names[layout] = tuple(text[0].split())
        names = self._names[layout]
        counts = (received, lost, bad, overflowed)
        return Row(start, width, newest, names, *unpack(data, len(names)), counts, state)


def _opened(path: Path) -> sqlite3.Connection:
    """For reading; where the folder cannot be written to either, and no writer left anything beside the file, as is."""
    options = ["mode=ro"]
    if not Path(f"{path}-wal").exists():
        options.append("mode=ro&immutable=1")
    for option in options:
        db = sqlite3.connect(f"{path.resolve().as_uri()}?{option}", uri=True, timeout=BUSY_S, isolation_level=None)
        try:
            db.execute("SELECT count(*) FROM sqlite_master").fetchone()
        except sqlite3.OperationalError:
            db.close()
            if option == options[-1]:
                raise
        else:
            return db
    raise AssertionError("one of them was the last")


def _stats(path: Path) -> tuple[_Stat | None, _Stat | None]:
    """What the file and its log look like; None for one that is not there, and for an empty log."""
    found: list[_Stat | None] = []
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
    """Raise OSError if the file or one that SQLite keeps beside it is there and is not a regular file."""
    for end in ("", *BESIDE):
        with contextlib.suppress(FileNotFoundError):
            check_regular(Path(f"{path}{end}"))


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    """What is wrong with the file itself, in a line; what may pass (busy, full, read-only) as it is."""
    try:
        yield
    except sqlite3.OperationalError:
        raise
    except RecordingError as error:
        if str(error).startswith(str(path)):
            raise
        raise UnusableHistory(f"{path}: damaged: {error}; {MOVE}") from error
    except (sqlite3.DatabaseError, msgspec.DecodeError, UnicodeDecodeError) as error:
        raise UnusableHistory(f"{path}: damaged: {error}; {MOVE}") from error


def _bound(t_s: float) -> float:
    """A time that SQLite can compare."""
    return max(min(t_s, 1e18), -1e18)


def _what_text(what: Mapping[str, Mapping[str, float]]) -> str:
    """As JSON; NaN as null. What is longer than any of our own events is left out."""
    text = msgspec.json.encode(what).decode()
    return text if len(text) <= TEXT_AT_MOST else "{}"


def _what(text: str) -> dict[str, dict[str, float]]:
    found = msgspec.json.decode(text, type=dict[str, dict[str, float | None]])
    return {
        name: {key: math.nan if one is None else one for key, one in sides.items()} for name, sides in found.items()
    }
