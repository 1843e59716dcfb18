"""Reader that turns the bytes of an input into numbers, choices and pieces.

An input is read from its beginning, so a changed byte does not affect the values before it. After the end, all numbers
are 0 and all pieces are empty. A piece is a length byte followed by this number of bytes. ``encode_pieces`` writes
pieces.
"""

import struct
from collections.abc import Sequence
from typing import Final, TypeVar

T = TypeVar("T")

SHORT: Final = 200
"""A length byte below this value is the length in bytes. Each step above this value adds STEP bytes."""
STEP: Final = 64


class InputReader:
    """Reader of one input."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def __bool__(self) -> bool:
        return self._at < len(self._data)

    def read_byte(self) -> int:
        """Return the next byte as a number from 0 to 255."""
        return (self.read_bytes(1) or b"\0")[0]

    def read_bytes(self, n: int) -> bytes:
        """Return the next ``n`` bytes, or fewer at the end of the input."""
        part = self._data[self._at : self._at + n]
        self._at += n
        return part

    def read_rest(self) -> bytes:
        """Return all remaining bytes."""
        return self.read_bytes(len(self._data))

    def choose(self, options: Sequence[T]) -> T:
        """Return one of the options, which the next byte selects."""
        return options[self.read_byte() % len(options)]

    def read_int64(self) -> int:
        """Return any int64."""
        number: int = struct.unpack("<q", self.read_bytes(8).ljust(8, b"\0"))[0]
        return number

    def read_float64(self) -> float:
        """Return any float64, including infinity and NaN."""
        number: float = struct.unpack("<d", self.read_bytes(8).ljust(8, b"\0"))[0]
        return number

    def read_special_float(self) -> float:
        """Return a float64 that is often a round or an extreme number."""
        kind = self.read_byte()
        return SPECIAL_FLOATS[kind] if kind < len(SPECIAL_FLOATS) else self.read_float64()

    def read_piece(self) -> bytes:
        """Return the next piece: a length byte determines the number of bytes."""
        n = self.read_byte()
        return self.read_bytes(n if n < SHORT else SHORT + STEP * (n - SHORT))


SPECIAL_FLOATS: Final = (
    0.0, -0.0, 1.0, -1.0, 0.5, 1e-9, -1e-9, 1e9, -1e9, 1.7e9, -9.2e9, 9.2e9, 4.6e9, 9.3e9, 1e18, -1e18, 1e300, -1e300,
    5e-324, 1e-310, float("inf"), float("-inf"), float("nan"), 100.0, 1000.0, 0.01, 65535.0, 65536.0, 4294967295.0,
)  # fmt: skip


def encode_pieces(data: bytes, before: bytes = b"") -> bytes:
    """Return the bytes as pieces, each of which follows the bytes ``before``."""
    parts = [data[i : i + SHORT - 1] for i in range(0, len(data), SHORT - 1)]
    return b"".join(before + bytes([len(part)]) + part for part in parts)
