"""Interface of a decoder, and the functions that decoders share. Decoders convert bytes to samples and do no I/O.

A decoder module ``drivers/decoders/<protocol>.py`` defines ``Settings`` and ``build(settings) -> Decoder``.
``Settings`` is a pydantic model with the keys of ``[device.driver.decoder_options]``. ``build`` raises one
``ConfigError`` with a line for each mistake that the model does not find. The line begins with the key:
"signals.gx: ...".

``feed`` never raises an exception for bad bytes. A frame that fails its check is left out and counted in ``bad``. The
next block counts it in ``lost``, so that its place in time stays empty.
"""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from drivers.sample import NO_TICK, Chunk, Floats, Ints, SampleBlock, Timing, make_block
from drivers.settings_model import SettingsModel

MAX_GYRO_RAD_S: Final = 1000.0
"""Largest plausible angular rate in rad/s. The widest range of MEMS gyroscopes is 4000 °/s, which is 70 rad/s."""
MAX_ACCEL_M_S2: Final = 10_000.0
"""Largest plausible acceleration in m/s², about 1000 g. No inertial-grade MEMS sensor has a wider range."""
VALUE_LIMITS: Final = np.repeat([MAX_GYRO_RAD_S, MAX_ACCEL_M_S2], 3)
"""Largest plausible values [6] in the order of ``AXES``."""
TEMPERATURE_LIMITS_C: Final = (-100.0, 300.0)
"""Lowest and highest plausible temperature."""

Bytes = NDArray[np.uint8]


class DecoderSettings(SettingsModel):
    """Base class of the settings of decoders."""


class Decoder(Protocol):
    """Interface of a decoder of one wire format, which converts between bytes and ``SampleBlock``."""

    carrier: ClassVar[str]  # see drivers.links.base.Carrier

    @property
    def timing(self) -> Timing:
        """Timing information that the frames carry. The kind of timing does not change."""

    @property
    def bad(self) -> int:
        """Number of rejected frames and samples since the decoder was created."""

    @property
    def recent_problem(self) -> str:
        """Reason for rejected frames, for the status line; "" if no frame was rejected recently."""

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Return the samples that these chunks complete.

        ``t_ns`` is the arrival time of the chunk that completed a sample.
        """

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Return the samples in the wire format as a device would send them. Counters are taken from ``ticks``."""

    def reset(self) -> None:
        """Discard an incomplete frame, because the link was opened again."""


@runtime_checkable
class AddressFilter(Protocol):
    """Interface of a decoder that reads only chunks with certain addresses."""

    @property
    def addresses(self) -> tuple[int, ...]:
        """Addresses to receive, encoded as in ``Chunk.address``."""


@runtime_checkable
class LateFrameCountingDecoder(Protocol):
    """Interface of a decoder that joins frames to samples, and distinguishes late frames from lost frames."""

    @property
    def dropped_late_samples(self) -> int:
        """Number of samples left out because some of their frames arrived too late.

        These samples are not included in ``bad``.
        """

    @property
    def late_frames_hint(self) -> str:
        """Delay of the late frames and the remedy, for the status; "" if no frame has been late for a while."""


HINT_FRAMES: Final = 1000
"""Number of good frames after a rejected frame until the hint about the rejected frame ends."""


class RecentRejection:
    """Reason for the last rejected frame, which is shown until HINT_FRAMES good frames have followed."""

    def __init__(self) -> None:
        self._text = ""
        self._good_frames = HINT_FRAMES

    @property
    def rejection_reason(self) -> str:
        """Reason for the last rejected frame; "" if no frame was rejected recently."""
        return self._text if self._good_frames < HINT_FRAMES else ""

    def note_rejection(self, text: str) -> None:
        """Store the reason for a rejected frame."""
        self._text, self._good_frames = text, 0

    def count_good_frames(self, frames: int = 1) -> None:
        """Count good frames."""
        self._good_frames += frames


class BlockBuilder:
    """Builder of blocks from decoded samples. A new block begins where frames were rejected."""

    def __init__(self) -> None:
        self.bad = 0  # rejected frames and implausible samples so far
        self._missing = 0  # samples missing before the next block

    def forget_rejected_frames(self) -> None:
        """Set the number of samples missing before the next block to 0."""
        self._missing = 0

    def build_plausible_blocks(
        self,
        t_ns: Ints,
        values: Floats,
        temperature_c: Floats | None = None,
        ticks: Ints | None = None,
        bad_before: Ints | None = None,
        bad_after: int = 0,
    ) -> list[SampleBlock]:
        """Return the plausible samples as blocks.

        A sample with an infinite or implausible value is dropped and counted as missing. NaN means not measured and is
        accepted unless all axes are NaN.

        Parameters
        ----------
        t_ns
            [n] int64, times in ns.
        values
            [n, 6] float64 in the order of AXES, rad/s and m/s².
        temperature_c
            [n] float64 in °C. None if the format contains no temperature.
        ticks
            [n] int64, counter of the device, NO_TICK for a frame without a counter. None if the format contains none.
        bad_before
            [n] int64, number of frames that were rejected just before each sample. None if no frame was rejected.
        bad_after
            Number of frames that were rejected after the last sample. The next call counts them before its first
            sample.
        """
        n = t_ns.size
        bad_before = np.zeros(n, np.int64) if bad_before is None else bad_before
        ticks = np.full(n, NO_TICK, np.int64) if ticks is None else ticks
        temperature_c = np.full(n, np.nan) if temperature_c is None else _valid_temperatures(temperature_c)
        good = are_plausible(values)
        carried, self._missing = self._missing, bad_after
        if n and good.all() and not bad_before.any():  # fast path for nearly all calls
            self.bad += bad_after
            return [make_block(t_ns, values, temperature_c, ticks, carried)]
        kept = np.flatnonzero(good)
        # number of frames and samples that have been dropped up to each sample
        dropped = np.cumsum(bad_before + ~good)
        total = int(dropped[-1]) if n else 0
        self.bad += total + bad_after
        if kept.size == 0:
            self._missing += carried + total
            return []
        missing = np.diff(dropped[kept], prepend=0)
        missing[0] += carried
        self._missing += total - int(dropped[kept[-1]])
        cuts = np.flatnonzero(missing[1:]) + 1
        return [
            make_block(t_ns[rows], values[rows], temperature_c[rows], ticks[rows], int(missing[first]))
            for first, rows in zip((0, *cuts), np.split(kept, cuts), strict=True)
        ]


def are_plausible(values: Floats) -> NDArray[np.bool_]:
    """Return a mask [n] of the plausible samples among ``values`` [n, 6].

    A plausible sample has at least one measured axis. None of its values is infinite or above the range of a MEMS IMU.
    """
    too_large: NDArray[np.bool_] = np.any(np.abs(values) > VALUE_LIMITS, axis=1)
    unmeasured: NDArray[np.bool_] = np.all(np.isnan(values), axis=1)
    return ~(too_large | unmeasured)


def _valid_temperatures(temperature_c: Floats) -> Floats:
    """Replace implausible temperatures by NaN."""
    low, high = TEMPERATURE_LIMITS_C
    return np.where((temperature_c >= low) & (temperature_c <= high), temperature_c, np.nan)


@dataclass(frozen=True, slots=True)
class Frames:
    """Frames that passed their check, in order of arrival."""

    data: list[bytes]
    t_ns: Ints  # [n] arrival of the chunk that completed each frame
    bad_before: Ints  # [n] number of frames rejected just before each frame
    adjacent: NDArray[np.bool_]  # [n] True if the frame follows the previous one without other bytes
    bad_after: int = 0  # number of frames rejected after the last frame

    def select_frames(self, rows: Sequence[int]) -> "Frames":
        """Return the frames with these indices.

        The rejected frames before an omitted frame are added to ``bad_before`` of the next selected frame, or to
        ``bad_after``.
        """
        if len(rows) == len(self.data):
            return self
        at = list(rows)
        rejected = np.cumsum(self.bad_before)
        rejected_at = rejected[at]
        after = int(rejected[-1] if rejected.size else 0) - int(rejected_at[-1] if rejected_at.size else 0)
        bad_before = np.diff(rejected_at, prepend=0)
        return Frames([self.data[i] for i in at], self.t_ns[at], bad_before, self.adjacent[at], after)

    def stack_bytes(self, rows: Sequence[int]) -> Bytes:
        """Return the frames with these indices, which have the same length, as an array [n, length] of uint8."""
        return np.frombuffer(b"".join([self.data[i] for i in rows]), np.uint8).reshape(len(rows), -1)


NEED_MORE: Final = 0
"""Result of a ``FrameMatcher`` if the buffer ends before the frame does."""
REJECT: Final = -1
"""Result of a ``FrameMatcher`` if the bytes at the offset are not a valid frame."""

FrameMatcher = Callable[[bytes, int], int]
"""Function of the buffer and the offset of a sync pattern that returns the length of the frame, NEED_MORE or REJECT."""

MAX_BYTES_WITHOUT_FRAME: Final = 2000
"""Bytes without a valid frame after which a hint is given. Every supported frame is shorter."""
NO_OFFSET: Final = -(1 << 62)
"""Offset far before every byte of the stream."""


class FrameBuffer:
    """Buffer that finds the frames in a byte stream. The stream may be split anywhere, damaged, or begin anywhere.

    After a rejected candidate, the search continues one byte later in the same bytes, since a sync pattern may occur
    inside a payload. The number of frames lost between two valid frames is the larger of two counts: rejected
    candidates at least one frame length apart, and complete frames that fit between the valid frames. Bytes before the
    first frame are not counted, because reading may begin inside a frame. At most ``longest`` bytes are kept between
    calls of ``feed``.

    Parameters
    ----------
    sync
        Fixed start of a frame; empty if a frame can start with any byte. ``match`` may narrow the attribute ``sync`` to
        the first byte of all further frames. The attribute is widened again after MAX_BYTES_WITHOUT_FRAME bytes.
    match
        Function that checks one candidate.
    longest
        Maximum length of a frame in bytes.
    """

    def __init__(self, sync: bytes, match: FrameMatcher, longest: int) -> None:
        self.sync = self._initial_sync = sync
        self._match = match
        self._longest = longest
        self._buffer = b""
        self._arrivals: deque[tuple[int, int]] = deque()  # (stream offset of the end of a chunk, t_ns)
        self._buffer_offset = 0  # stream offset of the first byte in the buffer
        self.reset()

    def reset(self) -> None:
        """Discard the buffered bytes, the synchronization, and the narrowed ``sync``."""
        self.sync = self._initial_sync
        self._buffer_offset += len(self._buffer)
        self._buffer = b""
        self._arrivals.clear()
        self._synchronized = False
        self._frame_length = 0
        self._skipped_bytes = 0  # bytes skipped since the last frame
        self._rejected = 0  # candidates rejected since the last frame
        self._last_rejected = NO_OFFSET  # stream offset of the last rejected candidate
        self._rejection = RecentRejection()

    @property
    def recent_problem(self) -> str:
        """Reason for rejected or missing frames; "" if the stream is free of errors."""
        if self._skipped_bytes >= MAX_BYTES_WITHOUT_FRAME:
            return f"{self._skipped_bytes} bytes without a valid frame: is the baud rate right, and the decoder?"
        return self._rejection.rejection_reason

    def feed(self, chunks: Sequence[Chunk]) -> Frames:
        """Return all frames that these chunks complete."""
        buffer = self._append_chunks(chunks)
        found: list[bytes] = []
        ends: list[int] = []  # offset in the buffer after each frame
        bad_before: list[int] = []
        adjacent: list[bool] = []
        at = 0
        while True:
            start, length = self._examine_candidate(buffer, at)
            at = start + max(length, 0)
            if length == NEED_MORE:
                break
            if length == REJECT:
                self._count_rejected(start)
                self._skipped_bytes += 1
                at = start + 1
                continue
            found.append(buffer[start:at])
            ends.append(at)
            adjacent.append(not self._skipped_bytes)
            bad_before.append(self._take_lost_frames() if self._skipped_bytes else 0)
            self._frame_length = length
            self._synchronized = True
        frames = Frames(found, self._arrival_times(ends), np.array(bad_before, np.int64), np.array(adjacent, np.bool_))
        self._buffer = buffer[at:]
        self._buffer_offset += at
        while len(self._arrivals) > 1 and self._arrivals[0][0] <= self._buffer_offset:
            self._arrivals.popleft()
        self._rejection.count_good_frames(len(found))
        return frames

    def _examine_candidate(self, buffer: bytes, at: int) -> tuple[int, int]:
        """Return the offset of the next candidate and the length of its frame, NEED_MORE or REJECT."""
        start = buffer.find(self.sync, at)
        if self.sync != self._initial_sync:
            widen_at = at + MAX_BYTES_WITHOUT_FRAME - self._skipped_bytes
            if widen_at <= len(buffer) and not at <= start < widen_at:
                self._skipped_bytes += widen_at - at
                self.sync = self._initial_sync
                return self._examine_candidate(buffer, widen_at)
        if start < 0:
            # the end of the buffer may be the first part of a sync pattern
            start = max(at, len(buffer) - len(self.sync) + 1)
            self._skipped_bytes += start - at
            return start, NEED_MORE
        self._skipped_bytes += start - at
        length = self._match(buffer, start)
        if length == NEED_MORE and len(buffer) - start >= self._longest:
            return start, REJECT
        return start, length

    def _append_chunks(self, chunks: Sequence[Chunk]) -> bytes:
        """Return the buffer with the data of these chunks, and note their arrival times."""
        end = self._buffer_offset + len(self._buffer)
        for chunk in chunks:
            if chunk.data:
                end += len(chunk.data)
                self._arrivals.append((end, chunk.t_ns))
        return b"".join((self._buffer, *[chunk.data for chunk in chunks]))

    def _count_rejected(self, at: int) -> None:
        """Count a rejected candidate unless the previous rejected candidate is less than a frame length away."""
        offset = self._buffer_offset + at
        if offset - self._last_rejected >= max(self._frame_length, 1):
            self._rejected += 1
            self._last_rejected = offset

    def _take_lost_frames(self) -> int:
        """Return the number of frames lost since the last frame, and reset the counts."""
        fitting = round(self._skipped_bytes / self._frame_length) if self._frame_length else 0
        count = max(self._rejected, fitting) if self._synchronized else 0
        self._skipped_bytes = self._rejected = 0
        self._last_rejected = NO_OFFSET
        if count:
            self._rejection.note_rejection("frames fail their check: bytes are lost or damaged on the line")
        return count

    def _arrival_times(self, ends: list[int]) -> Ints:
        """Return the arrival times [n] of the chunks that contain the last byte of each frame."""
        if not ends:
            return np.empty(0, np.int64)
        offsets, t_ns = np.array(self._arrivals, np.int64).T
        arrived: Ints = t_ns[np.searchsorted(offsets, np.array(ends) + self._buffer_offset)]
        return arrived


class FrameStreamDecoder(ABC):
    """Common part of the decoders that find frames with a ``FrameBuffer`` in a byte stream.

    A subclass defines ``encode``, ``timing`` and ``_decode``.

    Parameters
    ----------
    buffer
        Buffer that finds the frames.
    """

    carrier: ClassVar[str] = "bytes"

    def __init__(self, buffer: FrameBuffer) -> None:
        self._buffer = buffer
        self._builder = BlockBuilder()

    @property
    def bad(self) -> int:
        """Number of frames that failed their check, and of implausible samples."""
        return self._builder.bad

    @property
    def recent_problem(self) -> str:
        """Reason for rejected frames; "" if no frame was rejected recently."""
        return self._buffer.recent_problem

    def reset(self) -> None:
        """Discard an incomplete frame."""
        self._buffer.reset()
        self._builder.forget_rejected_frames()

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Return the samples of the frames that these chunks complete."""
        frames = self._buffer.feed(chunks)
        return self._decode(frames) if frames.data else []

    def _build_measured_blocks(
        self, frames: Frames, values: Floats, temperature_c: Floats, ticks: Ints
    ) -> tuple[list[SampleBlock], int | None]:
        """Return the samples of the frames with at least one measured axis, and the index of the last such frame."""
        rows = np.flatnonzero(~np.isnan(values).all(axis=1))
        kept = frames.select_frames(rows.tolist())
        blocks = self._builder.build_plausible_blocks(
            kept.t_ns, values[rows], temperature_c[rows], ticks[rows], kept.bad_before, kept.bad_after
        )
        return blocks, int(rows[-1]) if rows.size else None

    @abstractmethod
    def _decode(self, frames: Frames) -> list[SampleBlock]:
        """Return the samples of one or more frames."""


Key = TypeVar("Key", bound=Hashable)


def group_indices(keys: Sequence[Key]) -> Iterator[tuple[Key, list[int]]]:
    """Yield each different key with the indices at which it occurs.

    >>> list(group_indices("aba"))
    [('a', [0, 2]), ('b', [1])]
    """
    groups: dict[Key, list[int]] = {}
    for i, key in enumerate(keys):
        groups.setdefault(key, []).append(i)
    yield from groups.items()


def nan_to_infinity(values: Floats) -> Floats:
    """Replace NaN by infinity, for formats in which every number sent is a measurement."""
    return np.where(np.isnan(values), np.inf, values)


def quantize(values: Floats, step: float, bits: int) -> Ints:
    """Return values as signed integers, rounded and clipped like the output of a sensor. NaN becomes 0.

    Parameters
    ----------
    values
        float64 array in any unit.
    step
        Value of one count, in the same unit.
    bits
        Number of bits of the integers.
    """
    top = 1 << (bits - 1)
    return np.clip(np.rint(np.nan_to_num(values / step, nan=0.0)), -top, top - 1).astype(np.int64)


def chunk_per_sample(frames: Sequence[bytes], t_ns: Ints) -> list[Chunk]:
    """Return one chunk per sample.

    Parameters
    ----------
    frames
        Bytes of each sample.
    t_ns
        [n] int64, arrival times of the samples in ns.
    """
    return [Chunk(data, t) for data, t in zip(frames, t_ns.tolist(), strict=True)]


def xor_checksum(data: bytes) -> int:
    """Return the exclusive or of all bytes. One long integer is folded in halves, which takes 1 µs for a sentence.

    >>> xor_checksum(b"VNRRG,8") == 0x4B
    True
    """
    bits = 8 << max(len(data) - 1, 0).bit_length()
    folded = int.from_bytes(data, "little")
    while bits > 8:
        bits >>= 1
        folded = (folded >> bits) ^ (folded & ((1 << bits) - 1))
    return folded
