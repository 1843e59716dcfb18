"""The thread that writes history: rows and events in, a file on disk, the loop never waits.

``put`` and ``tell`` leave things on a bounded queue and return. The thread writes what has come in one transaction,
then lets old rows be thinned, a little at a time. What cannot be written now (disk full, read-only, busy) stays on the
queue and is tried again; when the queue is full, what comes is dropped and counted. A file of a newer version is left
alone, and history goes on once it is out of the way. A file that is damaged or holds something else is renamed and a
new one is begun, as long as fewer than ASIDE_AT_MOST such files are kept. Before each write and every CHECK_S the
thread checks that the file is still the one that it wrote. If it was deleted, replaced or emptied, a new one is begun.
``state`` says all of that. On ``close`` what is left is written, once.

One process at a time writes the history of a folder (``FolderLock``). While another one does, rows and events are
discarded, since the other keeps its own; ``state`` says which process it is. When that process ends this one goes on.
The first row of each device is discarded then: it began before, and is partly in the file already.
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
from monitor.history.bucket import Row
from monitor.history.sqlite_store import BESIDE, DELETED, EMPTIED, MOVE, REPLACED, PastEvent, Store, UnusableHistory

WAITING_AT_MOST: Final = 4096
"""Rows and events: with one device three days of a full disk, some 12 MB."""
RETRY_S: Final = 5.0
CHECK_S: Final = 10.0
"""Between two looks whether the file is still there, where nothing is to be written."""
ASIDE_AT_MOST: Final = 10
"""Files that were moved aside; beyond, the next one stays where it is until people have looked."""
AT_ONCE: Final = 256
THINNED_AT_ONCE: Final = 50
CLOSING_S: Final = 10.0
ASIDE: Final = ".aside-"
"""Between the name of a history and the time at which it was moved aside."""

_log = structlog.get_logger("imu-monitor")


class Writer:
    """One file's writer.

    Args:
        path: the file
        now_s: Unix time
    """

    def __init__(self, path: Path, now_s: Callable[[], float]) -> None:
        self.path = path
        self.dropped = 0  # rows and events, since it was made
        self.written = 0
        self._now_s = now_s
        self._wrong = ""
        self._note = ""  # the newest thing that happened to the file
        self._folder = FolderLock(path.parent, HISTORY_LOCK)
        self._excluded = False  # another process keeps the history of this folder
        self._partial: set[str] | None = None  # devices whose row since then was discarded; None: none is to be
        self._waiting: deque[tuple[str, Row | PastEvent]] = deque()
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._store: Store | None = None
        self._thread = threading.Thread(target=self._run, name="history", daemon=True)

    @property
    def state(self) -> str:
        """``ok``, or what is wrong: for the status."""
        dropped = f"{self.dropped} results not kept" if self.dropped else ""
        if self._wrong:
            return f"{self._wrong} ({dropped})" if dropped else self._wrong
        but = "; ".join(filter(None, (self._note, self._folder.warning, dropped)))
        return f"ok, but {but}" if but else "ok"

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()

    def put(self, device: str, row: Row | None) -> None:
        """A row to be written; None is nothing."""
        if row is not None:
            self._push(device, row)

    def tell(self, device: str, event: PastEvent) -> None:
        """An event to be written."""
        self._push(device, event)

    def close(self) -> None:
        """Write what is left, and end."""
        self._closing.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(CLOSING_S)
            if self._thread.is_alive():
                _log.warning("history did not end in time", path=str(self.path))

    def _push(self, device: str, what: Row | PastEvent) -> None:
        with self._lock:
            if self._discards(device, what):
                return
            if len(self._waiting) >= WAITING_AT_MOST:
                self.dropped += 1
            else:
                self._waiting.append((device, what))
        self._wake.set()

    def _discards(self, device: str, what: Row | PastEvent) -> bool:
        """Return True for what another process keeps."""
        if self._excluded:
            return True
        if self._partial is None or device in self._partial or isinstance(what, PastEvent):
            return False
        self._partial.add(device)
        return True

    # --- the thread

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
            _log.warning("history is not whole", path=str(self.path), state=self.state)
        self._end()
        self._folder.release()

    def _write(self) -> bool:
        """All that waits, and what is due of thinning; False where something was in the way."""
        try:
            if holder := self._folder.hold():
                self._exclude(holder)
                return False
            self._include()
            store = self._checked()
            while batch := self._batch():
                rows = [(device, what) for device, what in batch if isinstance(what, Row)]
                events = [(device, what) for device, what in batch if isinstance(what, PastEvent)]
                store.add(rows, events)
                self._done(len(batch))
            while store.thin(self._now_s(), THINNED_AT_ONCE) and not self._waiting and not self._closing.is_set():
                pass
        except UnusableHistory as error:
            self._end()
            return self._move_aside(error) and self._write()
        except (sqlite3.Error, RecordingError, OSError) as error:
            self._say(str(error) if isinstance(error, RecordingError) else f"{self.path}: {_why(error)}; trying again")
            self._end()
            return False
        self._say("")
        return True

    def _exclude(self, holder: str) -> None:
        """Keep nothing while another process does."""
        self._end()
        with self._lock:
            self._excluded = True
            self._waiting.clear()
        self._say(f"{holder}; no history is kept here until it ends; end it, or choose another folder in [storage]")

    def _include(self) -> None:
        """Go on where another process has ended."""
        if self._excluded:
            with self._lock:
                self._excluded, self._partial = False, set()

    def _checked(self) -> Store:
        """The open file; opened anew if another program has changed it."""
        change = "" if self._store is None else self._store.change()
        if change:
            self._end()
        if self._store is None:
            self._store = Store(self.path)
        if change in (DELETED, EMPTIED):
            self._tell(f"{self.path} {change}; a new one was begun")
        elif change == REPLACED:
            self._tell(f"{self.path} {change}; results are added to that one")
        return self._store

    def _move_aside(self, error: UnusableHistory) -> bool:
        """Rename a file that is no history, and return True, so that a new one is begun."""
        taken = {one.name for one in self.path.parent.iterdir() if one.name.startswith(f"{self.path.name}{ASIDE}")}
        if sum(not name.endswith(BESIDE) for name in taken) >= ASIDE_AT_MOST:
            self._say(f"{error}; {ASIDE_AT_MOST} such files are kept already: look at {self.path.name}{ASIDE}*")
            return False
        when = datetime.fromtimestamp(self._now_s(), UTC)
        name = f"{self.path.name}{ASIDE}{when:%Y-%m-%dT%H-%M-%SZ}"
        name = next(one for one in chain([name], (f"{name}.{i}" for i in count(2))) if one not in taken)
        try:
            for end in (*BESIDE, ""):  # SQLite takes what is beside a file for a part of it
                with contextlib.suppress(FileNotFoundError):
                    os.rename(f"{self.path}{end}", self.path.with_name(f"{name}{end}"))
        except OSError as failed:
            self._say(f"{error}; it cannot be moved: {_why(failed)}")
            return False
        why = str(error).removesuffix(f"; {MOVE}")
        self._tell(f"{why}; it was moved to {name}, and a new one was begun")
        return True

    def _batch(self) -> list[tuple[str, Row | PastEvent]]:
        with self._lock:
            return [self._waiting[i] for i in range(min(AT_ONCE, len(self._waiting)))]

    def _done(self, n: int) -> None:
        with self._lock:
            for _ in range(n):
                self._waiting.popleft()
        self.written += n

    def _tell(self, note: str) -> None:
        """Keep for the state what has happened to the file, and log it."""
        self._note = note
        _log.warning("history", text=note)

    def _say(self, wrong: str) -> None:
        """Keep for the state what is wrong, and log it when it has changed."""
        if wrong == self._wrong:
            return
        self._wrong = wrong
        if wrong:
            _log.warning("history", text=wrong)
        else:
            _log.info("history", text="written again")

    def _end(self) -> None:
        store, self._store = self._store, None
        if store is not None:
            store.close()


def _why(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
