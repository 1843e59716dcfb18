"""What travels: a ``Chunk`` from a link, a ``SampleBlock`` from a decoder on, an ``Event`` beside them.

SI throughout: rad/s, m/s², °C. One word per clock: ``t_ns`` is the host's monotonic clock in
nanoseconds, or Unix time where the source brings its own times; ``ticks`` is the device's counter.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

AXES: Final = ("gx", "gy", "gz", "ax", "ay", "az")
"""Axis order of every array with six columns: gyroscopes in rad/s, accelerometers in m/s²."""

NO_TICK: Final = -1
"""``ticks`` of a sample whose frame carried no counter."""

EXTENDED_ID: Final = 1 << 31
"""Flag of a CAN address: a 29-bit identifier."""

ANY_SOURCE: Final = 1 << 30
"""Flag of a CAN address to listen for: J1939, only its parameter group counts, not who sends it."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes as they came."""

    data: bytes
    t_ns: int  # host monotonic at receipt, or Unix time where the link replays recorded times
    address: int = 0  # CAN identifier; bit 31 set for 29-bit identifiers
    attachment: bytes = b""  # what the transport carried beside the payload (zenoh)


@dataclass(frozen=True, slots=True)
class SampleBlock:
    """Consecutive samples of one device, n ≥ 1; ``lost`` samples are missing just before the first."""

    t_ns: Ints  # [n]
    values: Floats  # [n, 6] in AXES order, rad/s and m/s²; NaN = not measured
    temperature_c: Floats  # [n] °C; NaN = not measured
    ticks: Ints  # [n] device counter as on the wire; NO_TICK = none
    lost: int = 0

    def __len__(self) -> int:
        return int(self.t_ns.size)

    def __getitem__(self, rows: slice) -> "SampleBlock":
        """Rows of the block; ``lost`` stays with the first row."""
        first = rows.indices(len(self))[0]
        return SampleBlock(
            self.t_ns[rows],
            self.values[rows],
            self.temperature_c[rows],
            self.ticks[rows],
            self.lost if first == 0 else 0,
        )


def block(
    t_ns: Ints,
    values: Floats,
    temperature_c: Floats | None = None,
    ticks: Ints | None = None,
    lost: int = 0,
) -> SampleBlock:
    """A block with read-only arrays; temperature and counter are absent unless given."""
    n = int(t_ns.size)
    temperature_c = np.full(n, np.nan) if temperature_c is None else temperature_c
    ticks = np.full(n, NO_TICK, np.int64) if ticks is None else ticks
    for array in (t_ns, values, temperature_c, ticks):
        array.flags.writeable = False
    return SampleBlock(t_ns, values, temperature_c, ticks, lost)


@dataclass(frozen=True, slots=True)
class Arrival:
    """No counter on the wire: a sample's time is regressed from when its bytes arrived."""


@dataclass(frozen=True, slots=True)
class Counter:
    """The frame carries a counter. ``tick_s``: seconds a tick, or None where it counts samples."""

    modulus: int
    tick_s: float | None = None


@dataclass(frozen=True, slots=True)
class Given:
    """The payload carries Unix times; ``Chunk.t_ns`` is not used."""


Timing = Arrival | Counter | Given

KINDS: Final = (
    "link_lost",
    "link_back",
    "samples_lost",
    "samples_repeated",
    "clock_jumped",
    "moved",
    "noise_changed",
    "bias_stepped",
    "outlier_burst",
    "drift_unexplained",
    "model_disagrees",
    "temperature_unexplained",
    "reconciled",
    "limit_crossed",
    "limit_back",
    "window_rebuilt",
    "recording_stopped",
    "recording_back",
)
"""Of an ``Event``: what a hook may wait for."""


@dataclass(frozen=True, slots=True)
class Event:
    """Something happened to a device: what, when, how large, how sure."""

    kind: str  # of KINDS
    t_ns: int
    text: str
    axis: str | None = None
    what: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    since_ns: int | None = None
    sigma: float | None = None


def join(blocks: Sequence[SampleBlock]) -> SampleBlock:
    """One block of several; ``lost`` of all is summed at the front."""
    return block(
        np.concatenate([b.t_ns for b in blocks]),
        np.concatenate([b.values for b in blocks]),
        np.concatenate([b.temperature_c for b in blocks]),
        np.concatenate([b.ticks for b in blocks]),
        sum(b.lost for b in blocks),
    )


def unbroken(blocks: Sequence[SampleBlock]) -> list[SampleBlock]:
    """The same samples in as few blocks as can be: a new one only where samples are missing."""
    edges = [*(i for i, one in enumerate(blocks) if i == 0 or one.lost), len(blocks)]
    return [blocks[a] if b - a == 1 else join(blocks[a:b]) for a, b in pairwise(edges)]


def seconds_to_ns(seconds: Floats) -> Ints:
    """Whole nanoseconds; the integer part is kept apart, so nothing is lost beyond the float's own 0.24 µs."""
    whole = np.floor(seconds)
    fraction = np.rint((seconds - whole) * 1e9)
    result: Ints = whole.astype(np.int64) * 1_000_000_000 + fraction.astype(np.int64)
    return result


def ns_to_seconds(t_ns: Ints) -> Floats:
    """A float64 of Unix seconds holds 0.24 µs."""
    whole, rest = np.divmod(t_ns, 1_000_000_000)
    result: Floats = whole + rest * 1e-9
    return result
