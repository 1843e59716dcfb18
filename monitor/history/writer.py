"""Background writer, which writes queued history rows and events to a file in a thread.

The thread writes all queued data in one transaction and then merges a few old rows. If a write fails, for example
because the disk is full, the data remain in the queue and the write is repeated. If the queue is full, new data is
dropped and counted.

A file written by a newer version is not modified. An unusable file is renamed and replaced by a new file, unless
MAX_RENAMED_FILES files have already been renamed. Before each write and every CHECK_S seconds, the thread checks
whether another program has deleted, replaced or emptied the file. If so, the thread opens or creates the file again.

Only one process at a time writes the history files in a folder (``FolderLock``). While another process holds the lock,
rows and events are discarded, because that process stores the same results. After that process has ended, the first row
of each device is discarded, because part of the same minute has already been stored.
"""

import contextlib
import os
import sqlite3
import threading
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from itertools import chain, count
from pathlib import Path
from typing import Final

import structlog

from drivers.errors import RecordingError
from monitor.common.folder_lock import HISTORY_LOCK, FolderLock
from monitor.common.unexpected_errors import RestartedThread, log_unexpected_error
from monitor.history.history_row import HistoryRow
from monitor.history.sqlite_store import (
    DELETED,
    EMPTIED,
    MOVE_HINT,
    REPLACED,
    SQLITE_SUFFIXES,
    HistoryFileWriter,
    UnusableHistory,
)
from monitor.history.stored_events import StoredEvent

QUEUE_CAPACITY: Final = 4096
"""Maximum number of rows and events in the queue, which corresponds to about three days of one device or 12 MB."""
RETRY_S: Final = 5.0
CHECK_S: Final = 10.0
"""Interval in seconds at which the file is checked while the queue is empty."""
MAX_RENAMED_FILES: Final = 10
"""Maximum number of renamed files. When this number is reached, the user must move the renamed files away."""
BATCH_SIZE: Final = 256
MERGES_PER_STEP: Final = 50
CLOSE_TIMEOUT_S: Final = 10.0
NOTED_CHANGES: Final = {
    DELETED: "a new one was begun",
    EMPTIED: "a new one was begun",
    REPLACED: "results are added to that one",
}
"""Consequence of each change by another program that the status reports."""
RENAMED_SUFFIX: Final = ".aside-"
"""Text between the name of a renamed history file and the time at which it was renamed."""

_log = structlog.get_logger("imu-monitor")


class HistoryWriter:
    """Background thread that writes one history file.

    Parameters
    ----------
    path
        History file.
    now_s
        Function that returns the current Unix time [s].
    """

    def __init__(self, path: Path, now_s: Callable[[], float]) -> None:
        self.path = path
        self.dropped = 0  # number of dropped rows and events
        self.written = 0
        self._now_s = now_s
        self._error = ""
        self._note = ""  # description of the latest change that another program made to the file
        self._folder = FolderLock(path.parent, HISTORY_LOCK)
        self._excluded = False  # True if another process writes the history files in the folder
        # Devices whose first row has been discarded, or None if no rows need to be discarded.
        self._resumed_devices: set[str] | None = None
        self._waiting: deque[tuple[str, HistoryRow | StoredEvent]] = deque()
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._store: HistoryFileWriter | None = None
        self._last_store: HistoryFileWriter | None = None  # the open file, or the last one that was open
        self._change = ""  # change by another program that has not been noted, because no file could be opened since
        self._thread = RestartedThread(self._run, "history", self._closing)

    @property
    def state(self) -> str:
        """Status text, which is "ok" or describes a problem."""
        dropped = f"{self.dropped} results not stored" if self.dropped else ""
        error = self._thread.failure or self._error
        if error:
            return f"{error} ({dropped})" if dropped else error
        but = "; ".join(filter(None, (self._note, self._folder.warning, dropped)))
        return f"ok, but {but}" if but else "ok"

    def start(self) -> None:
        """Start the background thread."""
        self._thread.start()

    def queue_item(self, device: str, item: HistoryRow | StoredEvent | None) -> None:
        """Add a history row or an event to the queue. If the queue is full, the item is dropped and counted.

        Parameters
        ----------
        device
            Name of the device.
        item
            History row or event to write. None is ignored.
        """
        with self._lock:
            if item is None or self._discards(device, item):
                return
            if len(self._waiting) >= QUEUE_CAPACITY:
                self.dropped += 1
            else:
                self._waiting.append((device, item))
        self._wake.set()

    def close(self) -> None:
        """Write the remaining data and stop the thread. Log a warning if this takes longer than CLOSE_TIMEOUT_S."""
        self._closing.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(CLOSE_TIMEOUT_S)
            if self._thread.is_alive():
                _log.warning("history writer did not end in time", path=str(self.path))

    def _discards(self, device: str, what: HistoryRow | StoredEvent) -> bool:
        """Return True if a row or an event must be discarded because another process stores it."""
        if self._excluded:
            return True
        if self._resumed_devices is None or device in self._resumed_devices or isinstance(what, StoredEvent):
            return False
        self._resumed_devices.add(device)
        return True

    # --- methods of the thread

    def _run(self) -> None:
        while True:
            closing = self._closing.is_set()
            self._wake.clear()
            well = self._write()
            if closing:
                break
            if not well:
                self._closing.wait(RETRY_S)
            elif not self._waiting:
                self._wake.wait(CHECK_S)
        if self._waiting:
            self.dropped += len(self._waiting)
            _log.warning("history is not complete", path=str(self.path), state=self.state)
        self._close_store()
        self._folder.release()

    def _write(self) -> bool:
        try:
            if holder := self._folder.ensure_held():
                self._suspend(holder)
                return False
            self._resume()
            store = self._current_store()
            while batch := self._next_batch():
                self._write_batch(store, batch)
                self._remove_written(len(batch))
            while (
                store.merge_old_rows(self._now_s(), MERGES_PER_STEP)
                and not self._waiting
                and not self._closing.is_set()
            ):
                pass
        except UnusableHistory as error:
            self._close_store()
            return self._move_aside(error) and self._write()
        except (sqlite3.Error, RecordingError, OSError) as error:
            self._set_error(
                str(error) if isinstance(error, RecordingError) else f"{self.path}: {_error_text(error)}; trying again"
            )
            self._close_store()
            return False
        self._set_error("")
        return True

    def _write_batch(self, store: HistoryFileWriter, batch: list[tuple[str, HistoryRow | StoredEvent]]) -> None:
        """Write a batch in one transaction. If an unexpected exception occurs, drop only the item that causes it."""
        rows = [(device, what) for device, what in batch if isinstance(what, HistoryRow)]
        events = [(device, what) for device, what in batch if isinstance(what, StoredEvent)]
        try:
            store.write_rows_and_events(rows, events)
        except (sqlite3.Error, RecordingError, OSError):
            raise
        except Exception as error:  # noqa: BLE001 - the status shows the number of dropped items
            if len(batch) == 1:
                self.dropped += 1
                log_unexpected_error(f"history of {batch[0][0]}", error)
                return
            for one in batch:
                self._write_batch(store, [one])

    def _suspend(self, holder: str) -> None:
        self._close_store()
        with self._lock:
            self._excluded = True
            self._waiting.clear()
        self._set_error(
            f"{holder}; no history is kept here until it ends; end it, or choose another folder in [storage]"
        )

    def _resume(self) -> None:
        if self._excluded:
            with self._lock:
                self._excluded, self._resumed_devices = False, set()

    def _current_store(self) -> HistoryFileWriter:
        """Return the open history file. If another program has changed the file, it is opened again."""
        if self._last_store is not None and self._change not in NOTED_CHANGES:
            self._change = self._last_store.describe_external_change()
        if self._change:
            self._close_store()
        if self._store is None:
            self._store = self._last_store = HistoryFileWriter(self.path)
        if self._change in NOTED_CHANGES:
            self._set_note(f"{self.path} {self._change}; {NOTED_CHANGES[self._change]}")
        self._change = ""
        return self._store

    def _move_aside(self, error: UnusableHistory) -> bool:
        """Rename an unusable history file, or return False if it cannot be renamed."""
        taken = {
            one.name for one in self.path.parent.iterdir() if one.name.startswith(f"{self.path.name}{RENAMED_SUFFIX}")
        }
        if sum(not name.endswith(SQLITE_SUFFIXES) for name in taken) >= MAX_RENAMED_FILES:
            self._set_error(
                f"{error}; {MAX_RENAMED_FILES} such files exist already: move {self.path.name}{RENAMED_SUFFIX}* away"
            )
            return False
        when = datetime.fromtimestamp(self._now_s(), UTC)
        name = f"{self.path.name}{RENAMED_SUFFIX}{when:%Y-%m-%dT%H-%M-%SZ}"
        name = next(one for one in chain([name], (f"{name}.{i}" for i in count(2))) if one not in taken)
        try:
            for end in (*SQLITE_SUFFIXES, ""):  # SQLite would apply the additional files to a new database
                with contextlib.suppress(FileNotFoundError):
                    os.rename(f"{self.path}{end}", self.path.with_name(f"{name}{end}"))
        except OSError as failed:
            self._set_error(f"{error}; it cannot be moved: {_error_text(failed)}")
            return False
        self._last_store, self._change = None, ""
        why = str(error).removesuffix(f"; {MOVE_HINT}")
        self._set_note(f"{why}; it was moved to {name}, and a new one was begun")
        return True

    def _next_batch(self) -> list[tuple[str, HistoryRow | StoredEvent]]:
        with self._lock:
            return [self._waiting[i] for i in range(min(BATCH_SIZE, len(self._waiting)))]

    def _remove_written(self, n: int) -> None:
        with self._lock:
            for _ in range(n):
                self._waiting.popleft()
        self.written += n

    def _set_note(self, note: str) -> None:
        self._note = note
        _log.warning("history", text=note)

    def _set_error(self, wrong: str) -> None:
        if wrong == self._error:
            return
        self._error = wrong
        if wrong:
            _log.warning("history", text=wrong)
        else:
            _log.info("history", text="writing continues")

    def _close_store(self) -> None:
        store, self._store = self._store, None
        if store is not None:
            store.close()


def _error_text(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
