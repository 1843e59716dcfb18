"""What a link is: it moves bytes and knows no IMU.

A link module ``drivers/links/<name>_link.py`` holds ``Settings`` (a msgspec struct: the link's own keys
in ``[device.driver]``), ``build(settings) -> Link`` and ``DEFAULT_DECODER`` (a decoder's name, or ""
where the user must choose). Nothing is opened before ``open``. ``build`` raises one ``ConfigError`` with a line for
each mistake in the settings; the line begins with the key: "speed: ...". Every key stands in ``config/defaults.toml``.
"""

from collections.abc import Sequence
from typing import Annotated, Literal, Protocol, runtime_checkable

import msgspec

from drivers.quantities import SILENCE_S
from drivers.sample import Chunk

Carrier = Literal["bytes", "frames", "messages"]
"""bytes: a stream cut anywhere (serial); frames: one CAN frame a chunk; messages: one message a chunk."""


class LinkSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys that every link understands."""

    silence: Annotated[float, SILENCE_S.meta] = 3.0
    """Seconds without a byte after which the link is opened anew; 0 = never."""


class Link(Protocol):
    """Moves bytes from one place. ``read`` is called from one thread, ``close`` from any."""

    carrier: Carrier
    epoch: Literal["monotonic", "unix"]  # clock of Chunk.t_ns
    name: str  # for people: "/dev/ttyUSB0 at 460800 baud"

    def open(self) -> None:
        """Open, or raise ``LinkUnavailable`` with what to do about it. Opening twice is harmless."""

    def read(self, timeout_s: float) -> list[Chunk] | None:
        """What has come, waiting up to ``timeout_s`` for the first of it; None when nothing came.

        Raises ``LinkLost`` when the other side is gone or the link was closed, ``LinkEnded`` at the end
        of a replay.
        """

    def close(self) -> None:
        """Close; ends a waiting ``read``. Closing twice is harmless."""


@runtime_checkable
class Filtering(Protocol):
    """A link that need not bring everything: told before ``open`` what its decoder wants."""

    def accept(self, addresses: Sequence[int]) -> None:
        """Bring only chunks of these addresses."""
