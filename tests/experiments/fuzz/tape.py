"""Bytes read as a programme: numbers, choices and pieces, one after the other, until there are none left.

An input is read from its front, so that a change at one place leaves what comes before it as it was. Past the end all
numbers are 0 and all pieces empty. ``piece`` is a length byte and so many bytes; ``pieces_of`` writes it.
"""

import struct
from collections.abc import Sequence
from typing import Final, TypeVar

T = TypeVar("T")

SHORT: Final = 200
"""A length byte below is the length; above, each step is 64 bytes more."""
STEP: Final = 64


class Tape:
    """One input."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def __bool__(self) -> bool:
        return self._at < len(self._data)

    def byte(self) -> int:
        """0 to 255."""
        return (self.take(1) or b"\0")[0]

    def take(self, n: int) -> bytes:
        """So many bytes, fewer at the end."""
        part = self._data[self._at : self._at + n]
        self._at += n
        return part

    def rest(self) -> bytes:
        """All that is left."""
        return self.take(len(self._data))

    def choice(self, among: Sequence[T]) -> T:
        """One of a few."""
        return among[self.byte() % len(among)]

    def int64(self) -> int:
        """Any int64."""
        number: int = struct.unpack("<q", self.take(8).ljust(8, b"\0"))[0]
        return number

    def float64(self) -> float:
        """Any float64, infinities and NaN too."""
        number: float = struct.unpack("<d", self.take(8).ljust(8, b"\0"))[0]
        return number

    def wild(self) -> float:
        """A float64 that is often a round or an extreme one."""
        kind = self.byte()
        return WILD[kind] if kind < len(WILD) else self.float64()

    def piece(self) -> bytes:
        """A length byte and so many bytes."""
        n = self.byte()
        return self.take(n if n < SHORT else SHORT + STEP * (n - SHORT))


WILD: Final = (
    0.0, -0.0, 1.0, -1.0, 0.5, 1e-9, -1e-9, 1e9, -1e9, 1.7e9, -9.2e9, 9.2e9, 4.6e9, 9.3e9, 1e18, -1e18, 1e300, -1e300,
    5e-324, 1e-310, float("inf"), float("-inf"), float("nan"), 100.0, 1000.0, 0.01, 65535.0, 65536.0, 4294967295.0,
)  # fmt: skip


def pieces_of(data: bytes, before: bytes = b"") -> bytes:
    """The bytes as pieces, each with ``before`` in front."""
    parts = [data[i : i + SHORT - 1] for i in range(0, len(data), SHORT - 1)]
    return b"".join(before + bytes([len(part)]) + part for part in parts)
