"""What a decoder is, and the work that all of them share. Pure: bytes in, samples out.

A decoder module ``drivers/decoders/<protocol>.py`` holds ``Settings`` (a msgspec struct: the keys of
``[device.driver.decoder_options]``) and ``build(settings) -> Decoder``. ``feed`` raises nothing on bad
bytes: a frame that fails its check costs itself, is counted in ``bad``, and shows up as ``lost`` of the
block that follows it, so that its place in time stays empty.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from drivers.sample import NO_TICK, Chunk, Floats, Ints, SampleBlock, block

GYRO_LIMIT: Final = 1000.0
"""rad/s; no MEMS gyroscope turns this fast (the widest range sold is 4000 °/s = 70 rad/s)."""
ACCEL_LIMIT: Final = 10_000.0
"""m/s²; about 1000 g, above every inertial-grade MEMS range."""
TEMPERATURE_LIMITS_C: Final = (-100.0, 300.0)


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


class DecoderSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of every decoder's settings: unknown keys are errors."""


class Decoder(Protocol):
    """One wire format: bytes <-> SampleBlock."""

    carrier: ClassVar[str]  # see drivers.links.base.Carrier
    timing: Timing
    bad: int  # frames and samples rejected since the decoder was made
    hint: str  # why frames are rejected, for the status line; "" while all is well

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Samples completed by these chunks; ``t_ns`` is the arrival of the chunk that completed them."""

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """The wire's form of these samples, as a device would send it; counters from ``ticks``."""

    def reset(self) -> None:
        """The link was opened anew: forget a half-received frame."""


class Rows:
    """Collects decoded rows in order and cuts them into blocks at the places where frames were bad."""

    def __init__(self) -> None:
        self.bad = 0  # rejected frames and implausible rows so far
        self._missing = 0

    def reset(self) -> None:
        """Forget bad frames that no sample followed."""
        self._missing = 0

    def blocks(
        self,
        t_ns: Ints,
        values: Floats,
        temperature_c: Floats,
        ticks: Ints,
        bad_before: Ints,
        bad_after: int = 0,
    ) -> list[SampleBlock]:
        """Blocks of the plausible rows.

        ``bad_before[i]`` frames were rejected just before row i, ``bad_after`` behind the last one (they
        count before the next call's first row). A row with an infinite or impossible value is dropped
        and leaves an empty place; NaN means "not measured" and passes, but not on every axis.
        """
        good = plausible(values)
        kept = np.flatnonzero(good)
        # places lost before each kept row: rejected frames plus implausible rows since the last kept one
        places = np.cumsum(bad_before + ~good)
        at_kept = places[kept]
        missing = np.diff(at_kept, prepend=0)
        total = int(places[-1]) if places.size else 0
        self.bad += total + bad_after
        carried, self._missing = self._missing, bad_after
        if kept.size == 0:
            self._missing += carried + total
            return []
        missing[0] += carried
        self._missing += total - int(at_kept[-1])
        temperature_c = np.where(_possible_temperature(temperature_c), temperature_c, np.nan)
        cuts = np.flatnonzero(missing[1:]) + 1
        return [
            block(t_ns[rows], values[rows], temperature_c[rows], ticks[rows], int(missing[at]))
            for at, rows in zip((0, *cuts), np.split(kept, cuts), strict=True)
        ]


def plausible(values: Floats) -> NDArray[np.bool_]:
    """Rows [n] with at least one measured axis and none infinite or beyond what a MEMS IMU can show."""
    size = np.abs(values)
    limits = np.repeat([GYRO_LIMIT, ACCEL_LIMIT], 3)
    too_large = (size > limits).any(axis=1)
    result: NDArray[np.bool_] = ~too_large & ~np.isnan(values).all(axis=1)
    return result


def _possible_temperature(temperature_c: Floats) -> NDArray[np.bool_]:
    low, high = TEMPERATURE_LIMITS_C
    result: NDArray[np.bool_] = (temperature_c >= low) & (temperature_c <= high)
    return result


@dataclass(frozen=True, slots=True)
class Frames:
    """Frames that passed their check, in order of arrival."""

    data: list[bytes]
    t_ns: Ints  # [n] arrival of the chunk that completed each frame
    bad_before: Ints  # [n] frames rejected just before each


NEED_MORE: Final = 0
REJECT: Final = -1

Match = Callable[[bytearray, int], int]
"""(buffer, offset of a sync) -> length of the valid frame there, NEED_MORE, or REJECT."""


class FrameBuffer:
    """Finds frames in a byte stream that may be cut, damaged or joined late.

    ``sync`` is the fixed start of a frame, ``match`` checks one candidate. After a rejection the search
    goes on one byte further in the same bytes, as a sync may occur inside a payload. A hole between two
    frames counts as the larger of: candidates rejected a frame's length apart, and whole frames that
    would fit in it. What comes before the first frame (joined mid-stream) is not counted. Memory: never more
    than ``longest`` bytes are kept.
    """

    def __init__(self, sync: bytes, match: Match, longest: int) -> None:
        self._sync = sync
        self._match = match
        self._longest = longest
        self._buffer = bytearray()
        self._arrivals: deque[tuple[int, int]] = deque()  # (stream offset of a chunk's end, t_ns)
        self._dropped = 0  # stream offset of the buffer's first byte
        self.reset()

    def reset(self) -> None:
        """Forget buffered bytes and being in step."""
        self._dropped += len(self._buffer)
        self._buffer.clear()
        self._arrivals.clear()
        self._in_step = False
        self._frame_length = 0
        self._hole = 0  # bytes skipped since the last frame
        self._rejected = 0  # candidates rejected in the hole
        self._last_rejected = -(1 << 62)  # stream offset

    def feed(self, chunks: Sequence[Chunk]) -> Frames:
        """All frames that these chunks complete."""
        for chunk in chunks:
            self._buffer += chunk.data
            self._arrivals.append((self._dropped + len(self._buffer), chunk.t_ns))
        found: list[bytes] = []
        t_ns: list[int] = []
        bad_before: list[int] = []
        at = 0
        buffer, sync, match = self._buffer, self._sync, self._match
        while True:
            start = buffer.find(sync, at)
            if start < 0:
                # the tail may be the first part of a sync
                start = max(at, len(buffer) - len(sync) + 1)
                self._skip(start - at)
                at = start
                break
            self._skip(start - at)
            length = match(buffer, start)
            if length == NEED_MORE and len(buffer) - start < self._longest:
                at = start
                break
            if length <= 0:
                self._reject(start)
                at = start + 1
                self._hole += 1
                continue
            at = start + length
            found.append(bytes(buffer[start:at]))
            t_ns.append(self._arrival(at))
            bad_before.append(self._close_hole())
            self._frame_length = length
            self._in_step = True
        del buffer[:at]
        self._dropped += at
        while len(self._arrivals) > 1 and self._arrivals[0][0] <= self._dropped:
            self._arrivals.popleft()
        return Frames(found, np.array(t_ns, np.int64), np.array(bad_before, np.int64))

    def _skip(self, n: int) -> None:
        self._hole += n

    def _reject(self, at: int) -> None:
        offset = self._dropped + at
        if offset - self._last_rejected >= max(self._frame_length, 1):
            self._rejected += 1
            self._last_rejected = offset

    def _close_hole(self) -> int:
        fitting = round(self._hole / self._frame_length) if self._frame_length else 0
        count = max(self._rejected, fitting) if self._in_step else 0
        self._hole = self._rejected = 0
        self._last_rejected = -(1 << 62)
        return count

    def _arrival(self, at: int) -> int:
        offset = self._dropped + at
        while self._arrivals[0][0] < offset:
            self._arrivals.popleft()
        return self._arrivals[0][1]


class Unmeasured:
    """Constant columns for formats that lack them."""

    @staticmethod
    def temperature(n: int) -> Floats:
        """[n] of NaN."""
        return np.full(n, np.nan)

    @staticmethod
    def ticks(n: int) -> Ints:
        """[n] of NO_TICK."""
        return np.full(n, NO_TICK, np.int64)
