"""Loopback link: an in-memory link. A test writes data into the link, and a driver reads the data from the link.

It behaves like a real link (bytes, None after a timeout, ``LinkLost``, ``LinkEnded``, ``LinkUnavailable``) without
hardware. The writer can cause each of these from any thread with ``write``, ``drop``, ``end`` and the flag ``absent``.
Data written before ``open`` wait in a buffer, like in the kernel.
"""

import threading
import time
from collections import deque
from typing import Literal

from drivers.data_types import Chunk
from drivers.errors import LinkEnded, LinkLost, LinkUnavailable
from drivers.links.base import Carrier


class LoopbackLink:
    """Link whose data come from ``write``."""

    def __init__(self, carrier: Carrier = "bytes", epoch: Literal["monotonic", "unix"] = "monotonic") -> None:
        self.carrier: Carrier = carrier
        self.epoch: Literal["monotonic", "unix"] = epoch
        self.name = "loopback"
        self.absent = False  # True if opening shall fail, as with an unplugged device
        self._changed = threading.Condition()
        self._waiting: deque[Chunk] = deque()
        self._open = False
        self._dropped = False
        self._ended = False

    def write(self, data: Chunk | bytes) -> None:
        """Pass bytes (time-stamped now) or a complete chunk to the reader."""
        chunk = data if isinstance(data, Chunk) else Chunk(data, time.monotonic_ns())
        with self._changed:
            self._waiting.append(chunk)
            self._changed.notify_all()

    def drop(self) -> None:
        """Simulate a lost connection. Unread data are lost, and the next read raises ``LinkLost``."""
        with self._changed:
            self._dropped = True
            self._waiting.clear()
            self._changed.notify_all()

    def end(self) -> None:
        """End the data. After all data have been read, the next read raises ``LinkEnded``."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def open(self) -> None:
        """Open the link and clear a ``drop``. Raise LinkUnavailable if ``absent`` is True."""
        with self._changed:
            if self._open:
                return
            if self.absent:
                raise LinkUnavailable("loopback: nobody is at the other end; set absent to False")
            self._open = True
            self._dropped = False

    def wait_for_chunks_or_timeout(self, timeout_s: float) -> list[Chunk] | None:
        """Return all chunks written since the last call, after waiting up to ``timeout_s`` seconds for the first."""
        with self._changed:
            self._changed.wait_for(self._can_return, timeout_s)
            if not self._open:
                raise LinkLost("loopback: the link is closed")
            if self._dropped:
                self._open = False
                raise LinkLost("loopback: the other end is gone")
            if self._waiting:
                chunks = list(self._waiting)
                self._waiting.clear()
                return chunks
            if self._ended:
                raise LinkEnded("loopback: the end of what was written")
            return None

    def close(self) -> None:
        """Close the link and end a waiting read."""
        with self._changed:
            self._open = False
            self._changed.notify_all()

    def _can_return(self) -> bool:
        """Return True if a waiting read can return."""
        return bool(self._waiting) or self._dropped or self._ended or not self._open
