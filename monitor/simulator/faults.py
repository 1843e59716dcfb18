"""What goes wrong on the way from a simulated sensor to its reader, drawn from a seed; pure.

Each sample has at most one fault: it is lost, sent twice, has one bit flipped, or ends before it is whole. What is
drawn for a sample depends on its number and the seed alone, not on the bursts in which samples go out. A sample of
several chunks (CAN frames) is hurt in the last of them. A CAN frame with a flipped bit does not arrive: the bus's own
checksum rejects it.

``Truth`` counts what was done, so that a test can compare what the reader saw.
"""

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Chunk, Floats
from monitor.settings.loading import FaultsTable

STREAM: Final = crc32(b"faults")
DRAWS: Final = 3
"""Uniform numbers a sample: which fault, where in the frame, whether the cable is pulled."""


class Kind(IntEnum):
    """What becomes of one sample, in the order in which the shares are laid end to end."""

    LOST = 0
    REPEATED = 1
    FLIPPED = 2
    CUT = 3
    WHOLE = 4


@dataclass(slots=True)
class Truth:
    """What a simulated sensor did. All samples made = sent + lost + flipped + cut + dropped."""

    sent: int = 0  # whole and right, the repeated ones among them
    lost: int = 0
    repeated: int = 0
    flipped: int = 0
    cut: int = 0
    dropped: int = 0  # found no cable, no reader or no time
    unplugged: int = 0  # times
    held_s: float = 0.0  # longest time that a burst was held back

    @property
    def made(self) -> int:
        """Samples so far."""
        return self.sent + self.lost + self.flipped + self.cut + self.dropped

    def count(self, kind: Kind, out: bool) -> None:
        """One sample; ``out``: all of it that was to go out found a cable and room."""
        match kind:
            case _ if not out:
                self.dropped += 1
            case Kind.LOST:
                self.lost += 1
            case Kind.FLIPPED:
                self.flipped += 1
            case Kind.CUT:
                self.cut += 1
            case _:
                self.sent += 1
                self.repeated += kind is Kind.REPEATED


@dataclass(frozen=True, slots=True)
class Draws:
    """What becomes of consecutive samples."""

    kind: NDArray[np.int64]  # [n] of Kind
    where: Floats  # [n] of 0 … 1
    pulled: NDArray[np.bool_]  # [n] the cable is pulled before this sample

    def kinds(self) -> list[Kind]:
        """Kind of each."""
        return [Kind(kind) for kind in self.kind.tolist()]

    def __getitem__(self, rows: slice) -> "Draws":
        """Those of some samples."""
        return Draws(self.kind[rows], self.where[rows], self.pulled[rows])


class Faults:
    """The faults of one sensor.

    Args:
        table: how often each happens
        seed: of the sensor
        carrier: of its wire format
    """

    def __init__(self, table: FaultsTable, seed: int, carrier: str) -> None:
        self._edges = np.cumsum([table.lost, table.repeated, table.flipped, table.cut])
        self._pull = table.unplugged
        self._framed = carrier == "frames"
        self._jitter_s = table.jitter
        # bursts have a generator of their own: how many there are depends on the machine
        self._rng, self._holds = (
            np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STREAM, i))) for i in range(2)
        )

    def draw(self, n: int) -> Draws:
        """For the next ``n`` samples."""
        u = self._rng.random((n, DRAWS))
        return Draws(np.searchsorted(self._edges, u[:, 0], "right"), u[:, 1], u[:, 2] < self._pull)

    def hold_s(self) -> float:
        """How long the next burst is held back."""
        return float(self._holds.uniform(0.0, self._jitter_s)) if self._jitter_s else 0.0

    def hurt(self, kind: Kind, where: float, chunks: list[Chunk]) -> list[Chunk]:
        """What of one sample's chunks goes out."""
        match kind:
            case Kind.LOST:
                return []
            case Kind.REPEATED:
                return [*chunks, *chunks]
            case Kind.FLIPPED:
                return [*chunks[:-1], *([] if self._framed else [_flipped(chunks[-1], where)])]
            case Kind.CUT:
                return [*chunks[:-1], _cut(chunks[-1], where)]
            case _:
                return chunks


def _flipped(chunk: Chunk, where: float) -> Chunk:
    """One bit is the other."""
    at, bit = divmod(int(where * 8 * len(chunk.data)), 8)
    data = bytearray(chunk.data)
    data[at] ^= 1 << bit
    return replace(chunk, data=bytes(data))


def _cut(chunk: Chunk, where: float) -> Chunk:
    """At least the first byte, and not the last."""
    return replace(chunk, data=chunk.data[: 1 + int(where * (len(chunk.data) - 1))])
