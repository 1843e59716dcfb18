"""Data types that modules exchange: ``Chunk`` (received bytes), ``SampleBlock`` (decoded samples) and ``Event``.

Angular rates are in rad/s, accelerations in m/s² and temperatures in °C. Sample times ``t_ns`` are in nanoseconds. If
the source provides Unix times, ``t_ns`` is a Unix time; otherwise it is a time on the monotonic clock of the host.
``ticks`` contains the values of the device counter.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Times = Floats | Ints
"""Times of the samples of a recording: int64 in ns, or float64 in s."""

AXES: Final = ("gx", "gy", "gz", "ax", "ay", "az")
"""Column order of every array with six columns: three gyroscope axes, then three accelerometer axes."""

NS_PER_S: Final = 1e9
"""Nanoseconds per second."""

NO_TICK: Final = -1
"""Value of ``ticks`` for a sample whose frame carried no counter."""

EXTENDED_ID: Final = 1 << 31
"""Bit that marks a CAN address as a 29-bit identifier."""

ANY_SOURCE: Final = 1 << 30
"""Bit that makes a CAN address match a J1939 parameter group from any source address."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes received by a link, with their arrival time."""

    data: bytes
    t_ns: int  # arrival time on the monotonic clock of the host, or recorded Unix time if the link replays a file
    address: int = 0  # CAN identifier; bit 31 set for 29-bit identifiers
    attachment: bytes = b""  # additional data of a zenoh message


@dataclass(frozen=True, slots=True)
class SampleBlock:
    """One or more consecutive samples of one device.

    ``lost`` is the number of samples missing just before the first one.
    """

    t_ns: Ints  # [n]
    values: Floats  # [n, 6] in AXES order, rad/s and m/s²; NaN = not measured
    temperature_c: Floats  # [n] °C; NaN = not measured
    ticks: Ints  # [n] device counter as transmitted; NO_TICK = none
    lost: int = 0

    def __len__(self) -> int:
        return int(self.t_ns.size)

    def __getitem__(self, rows: slice) -> "SampleBlock":
        """Return a range of samples. ``lost`` is kept if the range includes the first sample and is 0 otherwise."""
        first, last, step = rows.indices(len(self))
        if (first, last, step) == (0, len(self), 1):
            return self
        return SampleBlock(
            self.t_ns[rows],
            self.values[rows],
            self.temperature_c[rows],
            self.ticks[rows],
            self.lost if first == 0 else 0,
        )

    def with_times(self, t_ns: Ints, lost: int) -> "SampleBlock":
        """Return the samples with other times, which become read-only, and another number of missing samples."""
        t_ns.flags.writeable = False
        return SampleBlock(t_ns, self.values, self.temperature_c, self.ticks, lost)

    def with_values(self, values: Floats) -> "SampleBlock":
        """Return the samples with other values in a contiguous array, which becomes read-only."""
        values.flags.writeable = False
        return SampleBlock(self.t_ns, values, self.temperature_c, self.ticks, self.lost)


def make_block(
    t_ns: Ints,
    values: Floats,
    temperature_c: Floats | None = None,
    ticks: Ints | None = None,
    lost: int = 0,
) -> SampleBlock:
    """Return a ``SampleBlock`` with read-only contiguous arrays.

    Parameters
    ----------
    t_ns
        [n] int64, times in ns.
    values
        [n, 6] float64 in the order of AXES, rad/s and m/s². NaN means not measured.
    temperature_c
        [n] float64 in °C, NaN means not measured. None if no temperature was measured.
    ticks
        [n] int64, counter of the device. None if there is no counter.
    lost
        Number of samples that are missing just before the first sample.
    """
    n = int(t_ns.size)
    temperature_c = np.full(n, np.nan) if temperature_c is None else temperature_c
    ticks = np.full(n, NO_TICK, np.int64) if ticks is None else ticks
    # the kernels are compiled for contiguous arrays only, and another layout would be compiled while samples wait
    t_ns, ticks = np.ascontiguousarray(t_ns), np.ascontiguousarray(ticks)
    values, temperature_c = np.ascontiguousarray(values), np.ascontiguousarray(temperature_c)
    for array in (t_ns, values, temperature_c, ticks):
        array.flags.writeable = False
    return SampleBlock(t_ns, values, temperature_c, ticks, lost)


@dataclass(frozen=True, slots=True)
class ArrivalTimedFormat:
    """Wire format without a device counter. A regression estimates the sample times from the arrival times.

    If ``answers_requests`` is True, each frame answers a request of the host, so each rejected frame was a sample.
    """

    answers_requests: bool = False


@dataclass(frozen=True, slots=True)
class CounterTimedFormat:
    """Wire format whose frames contain a device counter.

    The counter wraps to 0 after ``modulus`` counts. ``tick_s`` is the duration of one count in seconds, or None if the
    counter counts samples.
    """

    modulus: int
    tick_s: float | None = None


@dataclass(frozen=True, slots=True)
class SenderTimedFormat:
    """Wire format whose messages contain the Unix times of the samples. ``Chunk.t_ns`` is not used."""


Timing = ArrivalTimedFormat | CounterTimedFormat | SenderTimedFormat

EVENT_KINDS: Final = (
    "link_lost",
    "link_back",
    "samples_lost",
    "samples_repeated",
    "clock_jumped",
    "rate_changed",
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
    "estimation_restarted",
    "recording_stopped",
    "recording_back",
)
"""Allowed values of ``Event.kind``. A hook can be configured for each kind of event."""


@dataclass(frozen=True, slots=True)
class Event:
    """Event of a device, such as a lost link or a change in the noise."""

    kind: str  # one of EVENT_KINDS
    t_ns: int
    text: str
    axis: str | None = None
    values: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # such as value and limit of a coefficient
    since_ns: int | None = None  # time at which the condition began
    sigma: float | None = None  # significance in standard errors


def concatenate_blocks(blocks: Sequence[SampleBlock]) -> SampleBlock:
    """Concatenate blocks into one block. The field ``lost`` of the result is the sum over all blocks."""
    return make_block(
        np.concatenate([b.t_ns for b in blocks]),
        np.concatenate([b.values for b in blocks]),
        np.concatenate([b.temperature_c for b in blocks]),
        np.concatenate([b.ticks for b in blocks]),
        sum(b.lost for b in blocks),
    )


def merge_contiguous_blocks(blocks: Sequence[SampleBlock]) -> list[SampleBlock]:
    """Concatenate consecutive blocks between which no samples are missing."""
    if len(blocks) == 1:
        return [*blocks]
    edges = [*(i for i, one in enumerate(blocks) if i == 0 or one.lost), len(blocks)]
    return [blocks[a] if b - a == 1 else concatenate_blocks(blocks[a:b]) for a, b in pairwise(edges)]


def seconds_to_ns(seconds: Floats) -> Ints:
    """Convert seconds [n] to whole nanoseconds [n].

    The integer part and the fraction of the seconds are converted separately to avoid rounding errors.
    """
    whole = np.floor(seconds)
    fraction = np.rint((seconds - whole) * 1e9)
    result: Ints = whole.astype(np.int64) * 1_000_000_000 + fraction.astype(np.int64)
    return result


def ns_to_seconds(t_ns: Ints) -> Floats:
    """Convert nanoseconds [n] to seconds [n]. Unix seconds in float64 have a resolution of 0.24 µs."""
    whole, rest = np.divmod(t_ns, 1_000_000_000)
    result: Floats = whole + rest * 1e-9
    return result


def times_to_seconds(times: Times) -> Floats:
    """Return the times of a recording [n] in s."""
    return ns_to_seconds(cast(Ints, times)) if times.dtype == np.int64 else cast(Floats, times)


def times_to_ns(times: Times) -> Ints:
    """Return the times of a recording [n] in whole nanoseconds. Times in s are rounded."""
    return cast(Ints, times) if times.dtype == np.int64 else seconds_to_ns(cast(Floats, times))
