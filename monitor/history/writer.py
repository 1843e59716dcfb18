"""The thread that writes history: rows and events in, a file on disk, the loop never waits.

``put`` and ``tell`` leave things on a bounded queue and return. The thread writes what has come in one transaction,
then lets old rows be thinned, a little at a time. What cannot be written now (disk full, read-only, busy) stays on the
queue and is tried again; when the queue is full, what comes is dropped and counted. A file that is damaged, of a newer
version or somebody else's is left alone, looked at again now and then, and history goes on once it is out of the way.
``state`` says all of that. On ``close`` what is left is written, once.
"""

import sqlite3
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Final

import structlog

from drivers.errors import RecordingError
from monitor.history.row import Row
from monitor.history.store import PastEvent, Store

WAITING_AT_MOST: Final = 4096
"""Rows and events: with one device three days of a full disk, some 12 MB."""
RETRY_S: Final = 5.0
AT_ONCE: Final = 256
THINNED_AT_ONCE: Final = 50
CLOSING_S: Final = 10.0

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
        return f"ok, but {dropped}" if dropped else "ok"

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
            if len(self._waiting) >= WAITING_AT_MOST:
                self.dropped += 1
            else:
                self._waiting.append((device, what))
        self._wake.set()

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
                self._wake.wait()
        if self._waiting:
            self.dropped += len(self._waiting)
            _log.warning("history is not whole", path=str(self.path), state=self.state)
        self._end()

    def _write(self) -> bool:
        """All that waits, and what is due of thinning; False where something was in the way."""
        try:
            store = self._store = self._store or Store(self.path)
            while batch := self._batch():
                rows = [(device, what) for device, what in batch if isinstance(what, Row)]
                events = [(device, what) for device, what in batch if isinstance(what, PastEvent)]
                store.add(rows, events)
                self._done(len(batch))
            while store.thin(self._now_s(), THINNED_AT_ONCE) and not self._waiting and not self._closing.is_set():
                pass
        except (sqlite3.Error, RecordingError, OSError) as error:
            self._say(str(error) if isinstance(error, RecordingError) else f"{self.path}: {error}; trying again")
            self._end()
            return False
        self._say("")
        return True

    def _batch(self) -> list[tuple[str, Row | PastEvent]]:
        with self._lock:
            return [self._waiting[i] for i in range(min(AT_ONCE, len(self._waiting)))]

    def _done(self, count: int) -> None:
        with self._lock:
            for _ in range(count):
                self._waiting.popleft()
        self.written += count

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
