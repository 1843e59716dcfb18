"""Random transmission faults of a simulated sensor: lost, repeated, corrupted and truncated samples.

Each sample has at most one fault, which depends only on the seed and the sample number. If a sample consists of several
CAN frames, the fault affects the last frame.
"""

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Chunk, Floats
from monitor.settings.loading import FaultsTable

SPAWN_KEY: Final = crc32(b"faults")
"""Spawn key of the random generators for faults."""
DRAWS_PER_SAMPLE: Final = 3
"""Random numbers per sample: kind of fault, position of the fault, and unplugged cable."""


class FaultKind(IntEnum):
    """Kind of transmission fault. The order is the order of the cumulative probabilities."""

    LOST = 0
    REPEATED = 1
    FLIPPED = 2
    CUT = 3
    WHOLE = 4


@dataclass(slots=True)
class FaultCounts:
    """Number of samples of a simulated sensor for each kind of fault."""

    sent: int = 0  # samples sent without corruption; a repeated sample counts once
    lost: int = 0
    repeated: int = 0
    flipped: int = 0
    cut: int = 0
    dropped: int = 0  # not sent because of a pulled cable, a missing reader or lack of time
    unplugged: int = 0  # number of times that the cable was pulled
    held_s: float = 0.0  # longest delay of a burst

    @property
    def total_simulated_samples(self) -> int:
        """Total number of simulated samples: sent + lost + flipped + cut + dropped."""
        return self.sent + self.lost + self.flipped + self.cut + self.dropped

    def count_sample(self, kind: FaultKind, all_sent: bool) -> None:
        """Increment the counter for the fault of a sample.

        Parameters
        ----------
        kind : FaultKind
            Fault of the sample.
        all_sent : bool
            True if all remaining chunks of the sample were sent.
        """
        match kind:
            case _ if not all_sent:
                self.dropped += 1
            case FaultKind.LOST:
                self.lost += 1
            case FaultKind.FLIPPED:
                self.flipped += 1
            case FaultKind.CUT:
                self.cut += 1
            case _:
                self.sent += 1
                self.repeated += kind is FaultKind.REPEATED


@dataclass(frozen=True, slots=True)
class DrawnFaults:
    """Randomly drawn faults of consecutive samples."""

    kind: NDArray[np.int64]  # [n] of FaultKind
    position: Floats  # [n] position of the fault in the frame, 0 to 1
    pulled: NDArray[np.bool_]  # [n] True if the cable is pulled before this sample

    def __getitem__(self, rows: slice) -> "DrawnFaults":
        """Return the faults of the selected samples."""
        return DrawnFaults(self.kind[rows], self.position[rows], self.pulled[rows])


class Faults:
    """Generator of random faults for one simulated sensor.

    Parameters
    ----------
    table : FaultsTable
        Probability of each fault.
    seed : int
        Seed of the simulated sensor.
    carrier : str
        Carrier of the wire format, such as "bytes" or "frames".
    """

    def __init__(self, table: FaultsTable, seed: int, carrier: str) -> None:
        self._edges = np.cumsum([table.lost, table.repeated, table.flipped, table.cut])
        self._unplug_probability = table.unplugged
        self._has_checksum = carrier == "frames"
        self._jitter_s = table.jitter
        # separate generators, because the number of bursts depends on the machine
        self._rng, self._delay_rng = (
            np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(SPAWN_KEY, i))) for i in range(2)
        )

    def draw_faults(self, n: int) -> DrawnFaults:
        """Draw random faults for the next ``n`` samples."""
        u = self._rng.random((n, DRAWS_PER_SAMPLE))
        return DrawnFaults(np.searchsorted(self._edges, u[:, 0], "right"), u[:, 1], u[:, 2] < self._unplug_probability)

    def draw_delay_s(self) -> float:
        """Draw the random delay of the next burst of samples in seconds."""
        return float(self._delay_rng.uniform(0.0, self._jitter_s)) if self._jitter_s else 0.0

    def apply_fault(self, kind: FaultKind, position: float, chunks: list[Chunk]) -> list[Chunk]:
        """Apply a fault to the encoded chunks of one sample, and return the chunks to send.

        Parameters
        ----------
        kind : FaultKind
            Fault of the sample.
        position : float
            Relative position of the fault in the chunk, from 0 to 1.
        chunks : list of Chunk
            Chunks of the encoded sample.
        """
        match kind:
            case FaultKind.LOST:
                return []
            case FaultKind.REPEATED:
                return [*chunks, *chunks]
            case FaultKind.FLIPPED:
                return [*chunks[:-1], *([] if self._has_checksum else [_flipped(chunks[-1], position)])]
            case FaultKind.CUT:
                return [*chunks[:-1], _cut(chunks[-1], position)]
            case _:
                return chunks


def _flipped(chunk: Chunk, position: float) -> Chunk:
    """Flip one bit of a chunk."""
    at, bit = divmod(int(position * 8 * len(chunk.data)), 8)
    data = bytearray(chunk.data)
    data[at] ^= 1 << bit
    return replace(chunk, data=bytes(data))


def _cut(chunk: Chunk, position: float) -> Chunk:
    """Truncate a chunk by at least one byte, and keep at least one byte."""
    return replace(chunk, data=chunk.data[: 1 + int(position * (len(chunk.data) - 1))])
