"""The in-memory twin of every link: what a test writes into it, a driver reads out of it.

It keeps the contract of a real link (bytes, None on timeout, ``LinkLost``, ``LinkEnded``,
``LinkUnavailable``) with no hardware, and lets the writer cause each of these from any thread: ``write``,
``drop``, ``end``, and the flag ``absent``. What is written before ``open`` waits, as it would in a
kernel's buffer.
"""

import threading
import time
from collections import deque
from typing import Final, Literal

from drivers.errors import LinkEnded, LinkLost, LinkUnavailable
from drivers.links.base import Carrier, Link, LinkSettings
from drivers.sample import Chunk

DEFAULT_DECODER: Final = ""


class Settings(LinkSettings, frozen=True, kw_only=True):
    """Keys of the loopback link."""

    carrier: Carrier = "bytes"


class LoopbackLink:
    """A link whose other end is ``write``."""

    def __init__(self, carrier: Carrier = "bytes", epoch: Literal["monotonic", "unix"] = "monotonic") -> None:
        self.carrier: Carrier = carrier
        self.epoch: Literal["monotonic", "unix"] = epoch
        self.name = "loopback"
        self.absent = False  # True: opening fails, as with an unplugged device
        self._changed = threading.Condition()
        self._waiting: deque[Chunk] = deque()
        self._open = False
        self._dropped = False
        self._ended = False

    def write(self, data: Chunk | bytes) -> None:
        """Hand bytes (stamped now) or a whole chunk to the reader."""
        chunk = data if isinstance(data, Chunk) else Chunk(data, time.monotonic_ns())
        with self._changed:
            self._waiting.append(chunk)
            self._changed.notify_all()

    def drop(self) -> None:
        """Lose the peer: what is still unread is lost with it, and the next ``read`` says so."""
        with self._changed:
            self._dropped = True
            self._waiting.clear()
            self._changed.notify_all()

    def end(self) -> None:
        """Nothing more will come: once all is read, ``read`` raises ``LinkEnded``."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def open(self) -> None:
        """Open, unless ``absent``; heals a ``drop``."""
        with self._changed:
            if self._open:
                return
            if self.absent:
                raise LinkUnavailable("loopback: nobody is at the other end; set absent to False")
            self._open = True
            self._dropped = False

    def read(self, timeout_s: float) -> list[Chunk] | None:
        """All that was written since the last call; waits up to ``timeout_s`` for the first."""
        with self._changed:
            self._changed.wait_for(self._something, timeout_s)
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
        """Close; ends a waiting ``read``."""
        with self._changed:
            self._open = False
            self._changed.notify_all()

    def _something(self) -> bool:
        return bool(self._waiting) or self._dropped or self._ended or not self._open


def build(settings: Settings) -> Link:
    """A loopback link; its writer needs the object itself, so a configuration file has no use for it."""
    return LoopbackLink(settings.carrier)
