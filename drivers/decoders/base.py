"""What a decoder is, and the work that all of them share. Pure: bytes in, samples out.

A decoder module ``drivers/decoders/<protocol>.py`` holds ``Settings`` (a msgspec struct: the keys of
``[device.driver.decoder_options]``, all of which stand in ``config/defaults.toml``) and ``build(settings) -> Decoder``.
``build`` raises one ``ConfigError`` with a line for each mistake, which begins with the key: "scale.gx: ...". ``feed``
raises nothing on bad bytes: a frame that fails its check costs itself, is counted in ``bad``, and shows up as ``lost``
of the block that follows it, so that its place in time stays empty.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, Protocol, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import NDArray

from drivers.sample import NO_TICK, Chunk, Floats, Ints, SampleBlock, block
from drivers.sample import Arrival as Arrival  # noqa: PLC0414 - decoders find it here
from drivers.sample import Counter as Counter  # noqa: PLC0414 - decoders find it here
from drivers.sample import Given as Given  # noqa: PLC0414 - decoders find it here
from drivers.sample import Timing as Timing  # noqa: PLC0414 - decoders find it here

GYRO_LIMIT: Final = 1000.0
"""rad/s; no MEMS gyroscope turns this fast (the widest range sold is 4000 °/s = 70 rad/s)."""
ACCEL_LIMIT: Final = 10_000.0
"""m/s²; about 1000 g, above every inertial-grade MEMS range."""
LIMITS: Final = np.repeat([GYRO_LIMIT, ACCEL_LIMIT], 3)
"""[6], in the order of ``AXES``."""
TEMPERATURE_LIMITS_C: Final = (-100.0, 300.0)


class DecoderSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of every decoder's settings: unknown keys are errors."""


class Decoder(Protocol):
    """One wire format: bytes <-> SampleBlock."""

    carrier: ClassVar[str]  # see drivers.links.base.Carrier

    @property
    def timing(self) -> Timing:
        """What the frames say about time; the same as long as the decoder lives."""

    @property
    def bad(self) -> int:
        """Frames and samples rejected since the decoder was made."""

    @property
    def hint(self) -> str:
        """Why frames are rejected, for the status line; "" while all is well."""

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Samples completed by these chunks; ``t_ns`` is the arrival of the chunk that completed them."""

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """The wire's form of these samples, as a device would send it; counters from ``ticks``."""

    def reset(self) -> None:
        """The link was opened anew: forget a half-received frame."""


@runtime_checkable
class Addressed(Protocol):
    """A decoder that reads only chunks of certain addresses."""

    @property
    def addresses(self) -> tuple[int, ...]:
        """Addresses as of ``Chunk.address``."""


@runtime_checkable
class CountingLate(Protocol):
    """A decoder that joins several frames to one sample, and tells late frames from missing ones."""

    @property
    def late(self) -> int:
        """Samples left out since the decoder was made because some of their frames came too late; not in ``bad``."""

    @property
    def late_hint(self) -> str:
        """By how much frames come too late and what to do, for the status; "" if none has for a while."""


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
        if good.size and good.all() and not bad_before.any():  # as nearly always, and most chunks hold few frames
            carried, self._missing = self._missing, bad_after
            self.bad += bad_after
            return [block(t_ns, values, _possible(temperature_c), ticks, carried)]
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
        temperature_c = _possible(temperature_c)
        cuts = np.flatnonzero(missing[1:]) + 1
        return [
            block(t_ns[rows], values[rows], temperature_c[rows], ticks[rows], int(missing[at]))
            for at, rows in zip((0, *cuts), np.split(kept, cuts), strict=True)
        ]


def plausible(values: Floats) -> NDArray[np.bool_]:
    """Rows [n] with at least one measured axis and none infinite or beyond what a MEMS IMU can show."""
    size = np.abs(values)
    too_large: NDArray[np.bool_] = np.any(size > LIMITS, axis=1)
    absent: NDArray[np.bool_] = np.all(np.isnan(values), axis=1)
    return ~(too_large | absent)


def _possible(temperature_c: Floats) -> Floats:
    low, high = TEMPERATURE_LIMITS_C
    return np.where((temperature_c >= low) & (temperature_c <= high), temperature_c, np.nan)


@dataclass(frozen=True, slots=True)
class Frames:
    """Frames that passed their check, in order of arrival."""

    data: list[bytes]
    t_ns: Ints  # [n] arrival of the chunk that completed each frame
    bad_before: Ints  # [n] frames rejected just before each
    at_once: NDArray[np.bool_]  # [n] whether no other byte stood between it and the frame before

    def keep(self, rows: Sequence[int]) -> tuple["Frames", int]:
        """Those frames alone, and how many were rejected behind the last of them.

        Rejected frames that stood before a frame left out count before the next kept one.
        """
        if len(rows) == len(self.data):
            return self, 0
        places = np.cumsum(self.bad_before)
        at_kept = places[list(rows)]
        after = int(places[-1] if places.size else 0) - int(at_kept[-1] if at_kept.size else 0)
        at = list(rows)
        kept = Frames([self.data[i] for i in rows], self.t_ns[at], np.diff(at_kept, prepend=0), self.at_once[at])
        return kept, after


NEED_MORE: Final = 0
REJECT: Final = -1

Match = Callable[[bytes, int], int]
"""(buffer, offset of a sync) -> length of the valid frame there, NEED_MORE, or REJECT."""

MUTE_BYTES: Final = 2000
"""So many bytes without one valid frame are worth a hint; no supported frame is as long."""
QUIET_FRAMES: Final = 1000
"""After so many good frames a rejected one is no longer worth a hint."""


class FrameBuffer:
    """Finds frames in a byte stream that may be cut, damaged or joined late.

    ``sync`` is the fixed start of a frame (empty = any byte), ``match`` checks one candidate. A match may narrow
    ``sync`` to the one byte that further frames begin with; it is wide again after MUTE_BYTES without a frame. After a
    rejection the search goes on one byte further in the same bytes, as a sync may occur inside a payload. A hole
    between two frames counts as the larger of: candidates rejected a frame's length apart, and whole frames that would
    fit in it. What comes before the first frame (joined mid-stream) is not counted. Memory: never more than ``longest``
    bytes are kept between feeds.
    """

    def __init__(self, sync: bytes, match: Match, longest: int) -> None:
        self.sync = self._wide = sync
        self._match = match
        self._longest = longest
        self._buffer = b""
        self._arrivals: deque[tuple[int, int]] = deque()  # (stream offset of a chunk's end, t_ns)
        self._dropped = 0  # stream offset of the buffer's first byte
        self.reset()

    def reset(self) -> None:
        """Forget buffered bytes, being in step and what frames were found to begin with."""
        self.sync = self._wide
        self._dropped += len(self._buffer)
        self._buffer = b""
        self._arrivals.clear()
        self._in_step = False
        self._frame_length = 0
        self._hole = 0  # bytes skipped since the last frame
        self._rejected = 0  # candidates rejected in the hole
        self._last_rejected = -(1 << 62)  # stream offset
        self._quiet = QUIET_FRAMES  # good frames since the last rejected one

    @property
    def mute(self) -> bool:
        """Whether bytes have been coming for a while without one valid frame."""
        return self._hole >= MUTE_BYTES

    @property
    def hint(self) -> str:
        """Why there are rejected frames, or none at all; "" while all is well."""
        if self.mute:
            return f"{self._hole} bytes without a valid frame: is the baud rate right, and the decoder?"
        if self._quiet < QUIET_FRAMES:
            return "frames fail their check: bytes are lost or damaged on the line"
        return ""

    def feed(self, chunks: Sequence[Chunk]) -> Frames:
        """All frames that these chunks complete."""
        buffer, match, longest = self._join(chunks), self._match, self._longest
        found: list[bytes] = []
        ends: list[int] = []  # offset in the buffer behind each frame
        bad_before: list[int] = []
        at_once: list[bool] = []
        at = 0
        while True:
            start = buffer.find(self.sync, at)
            if self.sync != self._wide:
                mute = at + MUTE_BYTES - self._hole
                if mute <= len(buffer) and not at <= start < mute:
                    self._hole += mute - at
                    at, self.sync = mute, self._wide
                    continue
            if start < 0:
                # the tail may be the first part of a sync
                start = max(at, len(buffer) - len(self.sync) + 1)
                self._hole += start - at
                at = start
                break
            self._hole += start - at
            length = match(buffer, start)
            if length > 0:
                at = start + length
                found.append(buffer[start:at])
                ends.append(at)
                at_once.append(not self._hole)
                bad_before.append(self._close_hole() if self._hole else 0)
                self._frame_length = length
                self._in_step = True
            elif length == NEED_MORE and len(buffer) - start < longest:
                at = start
                break
            else:
                self._reject(start)
                self._hole += 1
                at = start + 1
        frames = Frames(found, self._arrived(ends), np.array(bad_before, np.int64), np.array(at_once, np.bool_))
        self._buffer = buffer[at:]
        self._dropped += at
        while len(self._arrivals) > 1 and self._arrivals[0][0] <= self._dropped:
            self._arrivals.popleft()
        self._quiet += len(found)
        return frames

    def _join(self, chunks: Sequence[Chunk]) -> bytes:
        end = self._dropped + len(self._buffer)
        for chunk in chunks:
            if chunk.data:
                end += len(chunk.data)
                self._arrivals.append((end, chunk.t_ns))
        return b"".join((self._buffer, *[chunk.data for chunk in chunks]))

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
        if count:
            self._quiet = 0
        return count

    def _arrived(self, ends: list[int]) -> Ints:
        """[n] arrival of the chunk that holds the byte before each end."""
        if not ends:
            return np.empty(0, np.int64)
        offsets, t_ns = np.array(self._arrivals, np.int64).T
        arrived: Ints = t_ns[np.searchsorted(offsets, np.array(ends) + self._dropped)]
        return arrived


def invalid(values: Floats) -> Floats:
    """The values with NaN turned to infinity: for formats where every number sent is a measurement."""
    return np.where(np.isnan(values), np.inf, values)


def quantize(values: Floats, step: float, bits: int) -> Ints:
    """Signed integers of so many bits, values / step rounded and clipped as sensors saturate; NaN gives 0."""
    top = 1 << (bits - 1)
    return np.clip(np.rint(np.nan_to_num(values / step, nan=0.0)), -top, top - 1).astype(np.int64)


def one_chunk_each(frames: Sequence[bytes], t_ns: Ints) -> list[Chunk]:
    """A chunk for every sample's bytes, arrived at that sample's time."""
    return [Chunk(data, t) for data, t in zip(frames, t_ns.tolist(), strict=True)]


def xor(data: bytes) -> int:
    """Exclusive or of all bytes, by folding one long integer in halves: 1 µs for a sentence.

    >>> xor(b"VNRRG,8") == 0x4B
    True
    """
    bits = 8 << max(len(data) - 1, 0).bit_length()
    folded = int.from_bytes(data, "little")
    while bits > 8:
        bits >>= 1
        folded = (folded >> bits) ^ (folded & ((1 << bits) - 1))
    return folded


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
