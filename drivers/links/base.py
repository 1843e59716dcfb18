"""Interface of a link. A link moves bytes and does not interpret them.

A link module ``drivers/links/<name>_link.py`` defines ``Settings``, ``build(settings) -> Link`` and
``DEFAULT_DECODER``. ``Settings`` is a pydantic model with the keys of the link in ``[device.driver]``.
``DEFAULT_DECODER`` is the name of a decoder, or "" if the user must choose one. Nothing is opened before ``open`` is
called. ``build`` raises one ``ConfigError`` with a line for each mistake that the model does not find. The line begins
with the key: "interface: ...".
"""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, Literal, Protocol, runtime_checkable

from pydantic import Field

from drivers.errors import LinkLost
from drivers.number_ranges import SILENCE_S
from drivers.sample import Chunk
from drivers.settings_model import SettingsModel

Carrier = Literal["bytes", "frames", "messages"]
"""Kind of data of a link: "bytes" is a stream without boundaries (serial). "frames" is one CAN frame per chunk.
"messages" is one message per chunk.
"""


class LinkSettings(SettingsModel):
    """Keys that all links have."""

    silence: Annotated[float, SILENCE_S] = Field(
        3.0, description="time without data in s after which the link is opened again; 0 = never"
    )


class Link(Protocol):
    """Interface of a link. ``read`` is called from one thread, ``close`` from any thread."""

    carrier: Carrier
    epoch: Literal["monotonic", "unix"]  # clock of Chunk.t_ns
    name: str  # for messages, such as "/dev/ttyUSB0 at 460800 baud"

    def open(self) -> None:
        """Open the link. Do nothing if the link is already open.

        Raises
        ------
        LinkUnavailable
            If the link cannot be opened. The text says what to do.
        """

    def poll_chunks(self, timeout_s: float) -> list[Chunk] | None:
        """Return the received chunks, after waiting up to ``timeout_s`` seconds for the first chunk.

        Return None if nothing arrived.

        Raises
        ------
        LinkLost
            If the connection was lost, or the link was closed.
        LinkEnded
            If a replay has reached its end.
        """

    def close(self) -> None:
        """Close the link and end a waiting ``read``. Do nothing if the link is already closed."""


class PolledLink(ABC):
    """Common part of links whose source is polled. A lock is held while the source is read, opened or closed.

    Parameters
    ----------
    name
        Name of the link for messages.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._closing = threading.Event()
        self._in_use = threading.Lock()

    def open(self) -> None:
        """Open the source unless it is open. Raise ``LinkUnavailable`` with the reason and the remedy if this fails."""
        with self._in_use:
            if not self._is_open():
                self._open_source()
                self._closing.clear()

    def poll_chunks(self, timeout_s: float) -> list[Chunk] | None:
        """Return the received chunks, after waiting up to ``timeout_s`` seconds for the first chunk."""
        deadline = time.monotonic() + timeout_s
        with self._in_use:
            while self._is_open() and not self._closing.is_set():
                chunks = self._poll_source(deadline)
                if chunks:
                    return chunks
                if time.monotonic() >= deadline:
                    return None
        raise LinkLost(f"{self.name}: the link is closed")

    def close(self) -> None:
        """Close the source after a waiting ``read`` has ended."""
        self._closing.set()
        with self._in_use:
            self._close_source()

    @abstractmethod
    def _is_open(self) -> bool:
        """Return True if the source is open."""

    @abstractmethod
    def _open_source(self) -> None:
        """Open the source."""

    @abstractmethod
    def _poll_source(self, deadline: float) -> list[Chunk]:
        """Return the chunks that arrive soon, at the latest at the monotonic time ``deadline`` in s."""

    @abstractmethod
    def _close_source(self) -> None:
        """Close the source if it is open."""


@runtime_checkable
class AddressFilteringLink(Protocol):
    """Interface of a link that can filter by address."""

    def set_address_filter(self, addresses: Sequence[int]) -> None:
        """Receive only chunks of these addresses. The method is called before ``open``."""
