"""Interface of a link, which receives bytes without interpreting them.

A link module ``drivers/links/<name>_link.py`` defines ``Settings``, ``build(settings) -> Link`` and
``DEFAULT_DECODER``. ``Settings`` is a pydantic model with the keys of the link in ``[device.driver]``.
``DEFAULT_DECODER`` is the name of a decoder, or "" if the user must choose a decoder. ``build`` does not open the link.
If the model accepts settings that are invalid for the link, ``build`` raises one ``ConfigError`` with a line for each
mistake. Each line of the ``ConfigError`` begins with the configuration key, for example "interface: ...".
"""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, Literal, Protocol, runtime_checkable

from pydantic import Field

from drivers.data_types import Chunk
from drivers.errors import LinkLost
from drivers.validation.number_ranges import SILENCE_S
from drivers.validation.settings_model import SettingsModel

Carrier = Literal["bytes", "frames", "messages"]
"""Content of a chunk: part of a byte stream ("bytes"), one CAN frame ("frames") or one message ("messages")."""


class LinkSettings(SettingsModel):
    """Configuration keys that all links share."""

    silence: Annotated[float, SILENCE_S] = Field(
        3.0, description="time without data in s after which the link is opened again; 0 = never"
    )


class Link(Protocol):
    """Interface of a link.

    One thread calls ``open`` and ``wait_for_chunks_or_timeout``. Any thread may call ``close``.
    """

    carrier: Carrier
    epoch: Literal["monotonic", "unix"]  # clock of Chunk.t_ns
    name: str  # name used in messages, such as "/dev/ttyUSB0 at 460800 baud"

    def open(self) -> None:
        """Open the link. Do nothing if the link is open.

        Raises
        ------
        LinkUnavailable
            If the link cannot be opened. The error text contains the reason and a remedy.
        """

    def wait_for_chunks_or_timeout(self, timeout_s: float) -> list[Chunk] | None:
        """Return the received chunks, or None if nothing arrives within ``timeout_s`` seconds.

        Raises
        ------
        LinkLost
            If the connection was lost or the link was closed.
        LinkEnded
            If a replay has reached the end of the file.
        """

    def close(self) -> None:
        """Close the link, and interrupt a thread that waits for chunks. Do nothing if the link is closed."""


class PolledLink(ABC):
    """Base class of links that poll a source. A lock prevents the source from being closed during a read.

    Parameters
    ----------
    name
        Name of the link, used in messages.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._closing = threading.Event()
        self._in_use = threading.Lock()
        self.empty_ns = 0
        """Newest monotonic time in ns at which the source is known to have held no unread data."""
        self.dropped_datagrams = 0
        """Number of datagrams that the kernel is known to have dropped before they could be read."""

    def open(self) -> None:
        """Open the source if the source is closed. Raise ``LinkUnavailable`` if opening fails."""
        with self._in_use:
            if not self._is_open():
                self.empty_ns = time.monotonic_ns()
                self._open_source()
                self._closing.clear()

    def wait_for_chunks_or_timeout(self, timeout_s: float) -> list[Chunk] | None:
        """Return the received chunks, or None if nothing arrives within ``timeout_s`` seconds."""
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
        """Interrupt a waiting call of ``wait_for_chunks_or_timeout``, then close the source."""
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
        """Return the received chunks. Wait at most until the monotonic time ``deadline`` in s."""

    @abstractmethod
    def _close_source(self) -> None:
        """Close the source if it is open."""


@runtime_checkable
class AddressFilteringLink(Protocol):
    """Interface of a link that can filter chunks by address."""

    def set_address_filter(self, addresses: Sequence[int]) -> None:
        """Receive only chunks with these addresses after the next call of ``open``."""


@runtime_checkable
class BatchingLink(Protocol):
    """Interface of a link that holds received bytes until more arrive, so that the driver reads less often."""

    def set_default_read_timeout(self, timeout_s: float) -> None:
        """Set the time in s that received bytes may wait, unless the configuration states ``read_timeout``."""
