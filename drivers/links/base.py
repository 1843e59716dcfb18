"""Interface of a link. A link moves bytes and does not interpret them.

A link module ``drivers/links/<name>_link.py`` defines ``Settings``, ``build(settings) -> Link`` and
``DEFAULT_DECODER``. ``Settings`` is a pydantic model with the keys of the link in ``[device.driver]``.
``DEFAULT_DECODER`` is the name of a decoder, or "" if the user must choose one. Nothing is opened before ``open`` is
called. ``build`` raises one ``ConfigError`` with a line for each mistake that the model does not find. The line begins
with the key: "interface: ...".
"""

from collections.abc import Sequence
from typing import Annotated, Literal, Protocol, runtime_checkable

from pydantic import Field

from drivers.quantities import SILENCE_S
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
    name: str  # for messages: "/dev/ttyUSB0 at 460800 baud"

    def open(self) -> None:
        """Open the link. If it is already open, do nothing.

        Raises
        ------
        LinkUnavailable
            The link cannot be opened. The text says what to do.
        """

    def read(self, timeout_s: float) -> list[Chunk] | None:
        """Return the received chunks, after waiting up to ``timeout_s`` seconds for the first; None if nothing arrived.

        Raises
        ------
        LinkLost
            The other side is gone, or the link was closed.
        LinkEnded
            A replay has reached its end.
        """

    def close(self) -> None:
        """Close the link and end a waiting ``read``. If it is already closed, do nothing."""


@runtime_checkable
class AddressFilteringLink(Protocol):
    """Interface of a link that can filter by address."""

    def accept(self, addresses: Sequence[int]) -> None:
        """Receive only chunks of these addresses. This is called before ``open``."""
