"""Interface of a decoder, and functions shared by the decoders. Decoders convert bytes to samples and do no I/O.

A decoder module, such as ``drivers/decoders/binary_frames/stim300.py``, defines ``Settings`` and
``build(settings) -> Decoder``. ``Settings`` is a pydantic model with the keys of ``[device.driver.decoder_options]``.
If the model accepts settings that are invalid for the decoder, ``build`` raises one ``ConfigError`` with a line for
each mistake. Each line of the ``ConfigError`` begins with the configuration key, for example "signals.gx: ...".

``feed`` never raises an exception because of invalid bytes. A frame with a wrong checksum or format is dropped and
counted in ``Decoder.bad``. The field ``lost`` of the next sample block includes the number of dropped frames.
"""

import re
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import ClassVar, Final, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import NO_TICK, Chunk, Floats, Ints, SampleBlock, Timing, make_block
from drivers.live_stream_check import LiveStreamCheck, StreamConfiguration

MAX_GYRO_RAD_S: Final = 1000.0
"""Largest plausible angular rate in rad/s. The widest range of MEMS gyroscopes is 4000 °/s, which is 70 rad/s."""
MAX_ACCEL_M_S2: Final = 10_000.0
"""Largest plausible acceleration in m/s², about 1000 g. No inertial-grade MEMS sensor has a wider range."""
VALUE_LIMITS: Final = np.repeat([MAX_GYRO_RAD_S, MAX_ACCEL_M_S2], 3)
"""Largest plausible values [6] in the order of ``AXES``."""
TEMPERATURE_LIMITS_C: Final = (-100.0, 300.0)
"""Lowest and highest plausible temperature in °C."""

Bytes = NDArray[np.uint8]

_BITS = np.arange(256, dtype=np.uint8)[:, None] >> np.arange(8, dtype=np.uint8) & 1
BIT_REVERSAL: Final = np.packbits(_BITS, axis=1).tobytes()
"""Translation table that reverses the bits of each byte.

The table converts between the reflected and the unreflected form of a CRC.
"""


class Decoder(Protocol):
    """Interface of a decoder, which converts between the bytes of one wire format and ``SampleBlock`` objects."""

    carrier: ClassVar[str]  # see drivers.links.base.Carrier

    @property
    def timing(self) -> Timing:
        """Source of the sample times, such as arrival times or a device counter."""

    @property
    def bad(self) -> int:
        """Number of rejected frames and samples since the decoder was created."""

    @property
    def recent_problem(self) -> str:
        """Description of a recent decoding problem, such as rejected frames; "" if there was no problem."""

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Return the samples that are complete after the given chunks.

        ``t_ns`` of a sample is the arrival time of the chunk that completed the sample.
        """

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode samples in the wire format of the device. The encoded device counters are ``samples.ticks``."""

    def forget_stream_state(self) -> None:
        """Discard a partially received frame after the link has been reopened."""


@runtime_checkable
class AddressFilteringDecoder(Protocol):
    """Interface of a decoder that accepts only chunks with certain addresses."""

    @property
    def accepted_addresses(self) -> tuple[int, ...]:
        """Addresses of the chunks to receive, encoded as in ``Chunk.address``."""


@runtime_checkable
class LateFrameCountingDecoder(Protocol):
    """Interface of a decoder that assembles a sample from several frames and distinguishes late from lost frames."""

    @property
    def dropped_late_samples(self) -> int:
        """Number of samples dropped because of late frames. ``bad`` does not include late samples."""

    @property
    def late_frames_hint(self) -> str:
        """Message that states the delay of late frames and suggests a remedy; "" if no frame was late recently."""


@runtime_checkable
class FilterReportingDecoder(Protocol):
    """Decoder interface for sensors that can send values already corrected by their own filter."""

    @property
    def on_board_filter_note(self) -> str:
        """Note that the samples are corrected by a filter of the sensor; "" if they are not corrected."""


ON_BOARD_FILTER_NOTE: Final = (
    "the filter of the sensor has corrected these angular rates, which hides bias instability B and random walk K"
)

HINT_FRAMES: Final = 1000
"""Number of valid frames after which an earlier rejected frame is no longer reported."""


class RecentRejection:
    """Record of why the last frame was rejected. The reason is discarded after HINT_FRAMES valid frames."""

    def __init__(self) -> None:
        self._reason = ""
        self._good_frames = HINT_FRAMES

    @property
    def rejection_reason(self) -> str:
        """Reason why a frame was rejected; "" if no frame was rejected recently."""
        return self._reason if self._good_frames < HINT_FRAMES else ""

    def note_rejection(self, reason: str) -> None:
        """Store the reason why a frame was rejected."""
        self._reason, self._good_frames = reason, 0

    def add_good_frames(self, count: int = 1) -> None:
        """Count valid frames since the last rejected frame."""
        self._good_frames += count


class BlockBuilder:
    """Builder of sample blocks from decoded samples. A rejected frame ends the current block."""

    def __init__(self, configuration: StreamConfiguration | None = None) -> None:
        self.bad = 0  # rejected frames and implausible samples so far
        self._missing = 0  # number of samples missing before the next block
        self._check = None if configuration is None else LiveStreamCheck(configuration)

    @property
    def problem(self) -> str:
        """Contradiction between the samples and the configuration; "" if there is none."""
        return self._check.problem if self._check is not None else ""

    def forget_missing_samples(self) -> None:
        """Reset the number of samples missing before the next sample block, and the check of the configuration."""
        self._missing = 0
        if self._check is not None:
            self._check.forget_samples()

    def build_plausible_blocks(
        self,
        t_ns: Ints,
        values: Floats,
        temperature_c: Floats | None = None,
        ticks: Ints | None = None,
        bad_before: Ints | None = None,
        bad_after: int = 0,
    ) -> list[SampleBlock]:
        """Build sample blocks from the plausible samples.

        A sample with an infinite or implausible value is dropped and counted as missing. NaN marks an axis that is not
        measured. A sample whose axes are all NaN is dropped as well.

        Parameters
        ----------
        t_ns
            [n] int64, times in ns.
        values
            [n, 6] float64 in the order of AXES, rad/s and m/s².
        temperature_c
            [n] float64 in °C. None if the format contains no temperature.
        ticks
            [n] int64, counter of the device, NO_TICK for a frame without a counter. None if the format has no counter.
        bad_before
            [n] int64, number of frames that were rejected just before each sample. None if no frame was rejected.
        bad_after
            Number of frames that were rejected after the last sample. The next block counts these frames as missing.
        """
        block = self.build_block_if_all_plausible(t_ns, values, temperature_c, ticks, bad_before, bad_after)
        if block is not None:
            return [block]
        if self.problem:
            values = np.full_like(values, np.inf)
        n = t_ns.size
        temperature_c = None if temperature_c is None else _valid_temperatures(temperature_c)
        good = _find_plausible(values)
        carried, self._missing = self._missing, bad_after
        if n and good.all() and (bad_before is None or not bad_before.any()):
            self.bad += bad_after
            return [make_block(t_ns, values, temperature_c, ticks, carried)]
        bad_before = np.zeros(n, np.int64) if bad_before is None else bad_before
        ticks = np.full(n, NO_TICK, np.int64) if ticks is None else ticks
        temperature_c = np.full(n, np.nan) if temperature_c is None else temperature_c
        kept = np.flatnonzero(good)
        # number of rejected frames and implausible samples up to and including each sample
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

    def build_block_if_all_plausible(
        self,
        t_ns: Ints,
        values: Floats,
        temperature_c: Floats | None = None,
        ticks: Ints | None = None,
        bad_before: Ints | None = None,
        bad_after: int = 0,
    ) -> SampleBlock | None:
        """Build one block of all samples, or return None unless every value is measured and plausible, as usual.

        The result is also None if frames were rejected before a sample, or if the samples contradict the configuration.
        The parameters are those of ``build_plausible_blocks``.
        """
        if self._check is not None:
            self._check.add_samples(t_ns, values)
            if self._check.problem:
                return None
        if not t_ns.size or (bad_before is not None and bad_before.any()) or not (np.abs(values) <= VALUE_LIMITS).all():
            return None
        temperature_c = None if temperature_c is None else _valid_temperatures(temperature_c)
        block = make_block(t_ns, values, temperature_c, ticks, self._missing)
        self._missing = bad_after
        self.bad += bad_after
        return block


def _find_plausible(values: Floats) -> NDArray[np.bool_]:
    """Return a mask [n] that is True for each plausible sample in ``values`` [n, 6].

    A plausible sample has at least one measured axis, and every measured value is within the range of MEMS IMUs.
    """
    unmeasured = np.isnan(values)
    allowed = (np.abs(values) <= VALUE_LIMITS) | unmeasured
    plausible: NDArray[np.bool_] = np.all(allowed, axis=1) & ~np.all(unmeasured, axis=1)
    return plausible


def _valid_temperatures(temperature_c: Floats) -> Floats:
    low, high = TEMPERATURE_LIMITS_C
    return np.where((temperature_c >= low) & (temperature_c <= high), temperature_c, np.nan)


@dataclass(frozen=True, slots=True)
class RawFrames:
    """Valid frames in order of arrival."""

    data: list[bytes]
    t_ns: Ints  # [n] arrival time of the chunk that completed each frame
    bad_before: Ints  # [n] number of frames rejected just before each frame
    adjacent: NDArray[np.bool_]  # [n] True if no other bytes lie between the previous frame and this frame
    bad_after: int = 0  # number of frames rejected after the last frame

    def select_frames(self, indices: Sequence[int]) -> "RawFrames":
        """Return the frames at the given indices.

        The number of rejected frames before an omitted frame is added to ``bad_before`` of the next selected frame, or
        to ``bad_after`` if no selected frame follows.
        """
        if len(indices) == len(self.data):
            return self
        at = list(indices)
        rejected = np.cumsum(self.bad_before)
        rejected_at = rejected[at]
        after = int(rejected[-1] if rejected.size else 0) - int(rejected_at[-1] if rejected_at.size else 0)
        after += self.bad_after
        bad_before = np.diff(rejected_at, prepend=0)
        return RawFrames([self.data[i] for i in at], self.t_ns[at], bad_before, self.adjacent[at], after)

    def stack_frames(self, indices: Ints) -> Bytes:
        """Return frames of equal length as a uint8 array [n, length]."""
        return np.frombuffer(self._join_frames(indices), np.uint8).reshape(indices.size, -1)

    def stack_records(self, indices: Ints, layout: np.dtype[np.void]) -> NDArray[np.void]:
        """Return frames of equal length as a structured array [n]."""
        return np.frombuffer(self._join_frames(indices), layout)

    def _join_frames(self, indices: Ints) -> bytes:
        return b"".join(self.data if indices.size == len(self.data) else [self.data[i] for i in indices.tolist()])


NEED_MORE: Final = 0
"""Result of a ``FrameMatcher`` if the buffer contains only the beginning of a frame."""
REJECT: Final = -1
"""Result of a ``FrameMatcher`` if the bytes at the offset are not a valid frame."""

FrameMatcher = Callable[[bytes, int], int]
"""Function that checks a candidate frame.

The arguments are the received bytes and the offset of the candidate. The result is the length of the frame in bytes,
NEED_MORE or REJECT.
"""

MAX_BYTES_WITHOUT_FRAME: Final = 2000
"""Number of bytes without a valid frame after which a problem is reported. Every supported frame is shorter."""
MAX_FRAMES_WITHOUT_SAMPLE: Final = 100
"""Number of consecutive valid frames without a sample after which a problem is reported."""
NO_OFFSET: Final = -(1 << 62)
"""Offset that is smaller than the stream offset of every received byte."""


class FrameBuffer:
    """Buffer that finds the frames in a byte stream.

    A chunk may begin or end in the middle of a frame, and bytes may be damaged. The payload of a frame may contain the
    sync pattern. After rejecting a candidate frame, the search therefore continues at the next byte. The number of
    frames lost between two valid frames is estimated in two ways, and the larger estimate is used. The first estimate
    counts the rejected candidate frames that are at least one frame length apart. The second estimate is the number of
    frames that would fit between the two valid frames. Bytes before the first valid frame are ignored, because reading
    may begin in the middle of a frame. The buffer keeps at most ``longest`` bytes between two calls of ``feed``.

    Parameters
    ----------
    sync
        Bytes at the start of every frame; empty if a frame can start with any byte. ``match`` may set the attribute
        ``sync`` to the first byte of a valid frame. The buffer then searches only for frames with this first byte. The
        initial sync pattern is restored after MAX_BYTES_WITHOUT_FRAME bytes without a valid frame.
    match
        Function that checks one candidate frame.
    longest
        Maximum length of a frame in bytes.
    first_bytes
        All bytes that a frame can start with, if ``sync`` is empty. The buffer then rejects every other byte without a
        call of ``match``.
    """

    def __init__(self, sync: bytes, match: FrameMatcher, longest: int, first_bytes: bytes = b"") -> None:
        self.sync = self._initial_sync = sync
        self._first_byte = re.compile(b"[%b]" % re.escape(first_bytes)) if first_bytes else None
        self._match = match
        self._longest = longest
        self._buffer = b""
        self._arrivals: deque[tuple[int, int]] = deque()  # (stream offset of the end of a chunk, t_ns)
        self._buffer_offset = 0  # stream offset of the first byte in the buffer
        self.forget_stream_state()

    def forget_stream_state(self) -> None:
        """Discard the buffered bytes and restore the initial sync pattern."""
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
        """Reason why frames were rejected or are missing; "" if no frame was rejected recently."""
        if self._skipped_bytes >= MAX_BYTES_WITHOUT_FRAME:
            return f"{self._skipped_bytes} bytes without a valid frame: is the baud rate right, and the decoder?"
        return self._rejection.rejection_reason

    def feed(self, chunks: Sequence[Chunk]) -> RawFrames:
        """Return all frames that are complete after the given chunks."""
        buffer = self._append_chunks(chunks)
        found: list[bytes] = []
        t_ns: list[int] = []
        bad_before: list[int] = []
        adjacent: list[bool] = []
        at = 0
        while at < len(buffer):
            # Usually, the next frame follows without a gap.
            start, length = at, self._match(buffer, at) if buffer.startswith(self.sync, at) else NEED_MORE
            if length == NEED_MORE or (length == REJECT and self.sync != self._initial_sync):
                start, length = self._examine_candidate(buffer, at)
            at = start + max(length, 0)
            if length == NEED_MORE:
                break
            if length == REJECT:
                at = self._find_first_byte(buffer, start + 1)
                self._count_rejected(start, at)
                self._skipped_bytes += at - start
                continue
            found.append(buffer[start:at])
            while self._arrivals[0][0] < self._buffer_offset + at:
                self._arrivals.popleft()
            t_ns.append(self._arrivals[0][1])
            adjacent.append(not self._skipped_bytes)
            bad_before.append(self._take_lost_frames() if self._skipped_bytes else 0)
            self._frame_length = length
            self._synchronized = True
        frames = RawFrames(
            found, np.array(t_ns, np.int64), np.array(bad_before, np.int64), np.array(adjacent, np.bool_)
        )
        self._buffer = buffer[at:]
        self._buffer_offset += at
        while self._arrivals and self._arrivals[0][0] <= self._buffer_offset:
            self._arrivals.popleft()
        self._rejection.add_good_frames(len(found))
        return frames

    def _examine_candidate(self, buffer: bytes, at: int) -> tuple[int, int]:
        """Return the offset of the next candidate frame, and the length of the frame, NEED_MORE or REJECT."""
        start = buffer.find(self.sync, at)
        if self.sync != self._initial_sync:
            widen_at = at + MAX_BYTES_WITHOUT_FRAME - self._skipped_bytes
            if widen_at <= len(buffer) and not at <= start < widen_at:
                self._skipped_bytes += widen_at - at
                self.sync = self._initial_sync
                return self._examine_candidate(buffer, widen_at)
        if start < 0:
            # Keep the last bytes, because the buffer may end with the beginning of a sync pattern.
            start = max(at, len(buffer) - len(self.sync) + 1)
            self._skipped_bytes += start - at
            return start, NEED_MORE
        self._skipped_bytes += start - at
        length = self._match(buffer, start)
        if length == NEED_MORE and len(buffer) - start >= self._longest:
            return start, REJECT
        return start, length

    def _append_chunks(self, chunks: Sequence[Chunk]) -> bytes:
        end = self._buffer_offset + len(self._buffer)
        for chunk in chunks:
            if chunk.data:
                end += len(chunk.data)
                self._arrivals.append((end, chunk.t_ns))
        return b"".join((self._buffer, *[chunk.data for chunk in chunks]))

    def _find_first_byte(self, buffer: bytes, at: int) -> int:
        """Return the offset of the next byte that a frame can start with, at the earliest ``at``."""
        if self._first_byte is None or self.sync:
            return at
        first = self._first_byte.search(buffer, at)
        return len(buffer) if first is None else first.start()

    def _count_rejected(self, at: int, end: int) -> None:
        """Count the rejected candidates before ``end``. Candidates closer than one frame length are counted once."""
        step = max(self._frame_length, 1)
        first = max(self._buffer_offset + at, self._last_rejected + step)
        last = self._buffer_offset + end - 1
        if first <= last:
            further = (last - first) // step
            self._rejected += 1 + further
            self._last_rejected = first + further * step

    def _take_lost_frames(self) -> int:
        """Return the number of frames lost since the last valid frame, and reset the number to 0."""
        fitting = round(self._skipped_bytes / self._frame_length) if self._frame_length else 0
        count = max(self._rejected, fitting) if self._synchronized else 0
        self._skipped_bytes = self._rejected = 0
        self._last_rejected = NO_OFFSET
        if count:
            self._rejection.note_rejection("frames fail their check: bytes are lost or damaged on the line")
        return count


class RejectingDecoder:
    """Base class of decoders that reject frames and implausible samples."""

    def __init__(self, configuration: StreamConfiguration | None = None) -> None:
        self._builder = BlockBuilder(configuration)
        self._rejection = RecentRejection()

    @property
    def bad(self) -> int:
        """Number of rejected frames and implausible samples."""
        return self._builder.bad

    @property
    def recent_problem(self) -> str:
        """Reason why a frame was rejected; "" if no frame was rejected recently."""
        return self._builder.problem or self._rejection.rejection_reason


class FrameStreamDecoder(RejectingDecoder, ABC):
    """Base class of decoders that find frames in a byte stream.

    A subclass defines ``encode``, ``timing`` and ``_decode``. The constructor has the same parameters as
    ``FrameBuffer``.
    """

    carrier: ClassVar[str] = "bytes"

    def __init__(self, sync: bytes, match: FrameMatcher, longest: int, first_bytes: bytes = b"") -> None:
        super().__init__()
        self._buffer = FrameBuffer(sync, match, longest, first_bytes)
        self._frames_without_sample = 0  # number of valid frames since the last frame with a sample

    @property
    def _lacks_samples(self) -> bool:
        """True if many valid frames contained no sample. The subclass has to use ``_build_measured_blocks``."""
        return self._frames_without_sample > MAX_FRAMES_WITHOUT_SAMPLE

    @property
    def recent_problem(self) -> str:
        """Reason why frames were rejected; "" if no frame was rejected recently."""
        return self._buffer.recent_problem

    def forget_stream_state(self) -> None:
        """Discard a partially received frame."""
        self._buffer.forget_stream_state()
        self._builder.forget_missing_samples()

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Return the samples of all frames that are complete after the given chunks."""
        frames = self._buffer.feed(chunks)
        return self._decode(frames) if frames.data else []

    def _build_measured_blocks(
        self, frames: RawFrames, values: Floats, temperature_c: Floats | None, ticks: Ints
    ) -> tuple[list[SampleBlock], int | None]:
        """Build blocks of the frames that contain a measured axis; also return the index of the last such frame."""
        block = self._builder.build_block_if_all_plausible(
            frames.t_ns, values, temperature_c, ticks, frames.bad_before, frames.bad_after
        )
        if block is not None:
            self._frames_without_sample = 0
            return [block], len(values) - 1
        rows = np.nonzero(~np.isnan(values).all(axis=1))[0]
        earlier = 0 if rows.size else self._frames_without_sample
        self._frames_without_sample = earlier + len(values) - 1 - (int(rows[-1]) if rows.size else -1)
        if rows.size < len(values):
            frames = frames.select_frames(rows.tolist())
            values, ticks = values[rows], ticks[rows]
            temperature_c = None if temperature_c is None else temperature_c[rows]
        blocks = self._builder.build_plausible_blocks(
            frames.t_ns, values, temperature_c, ticks, frames.bad_before, frames.bad_after
        )
        return blocks, int(rows[-1]) if rows.size else None

    @abstractmethod
    def _decode(self, frames: RawFrames) -> list[SampleBlock]:
        """Decode the samples in the given frames."""


Key = TypeVar("Key", bound=Hashable)


def group_indices(keys: Sequence[Key]) -> Iterator[tuple[Key, Ints]]:
    """Yield each distinct key and the indices [k] at which the key occurs.

    >>> list(group_indices("aba"))
    [('a', array([0, 2])), ('b', array([1]))]
    """
    distinct = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    if len(distinct) == 1:  # usually all keys are equal
        yield keys[0], np.arange(len(keys))
        return
    groups = np.array([distinct[key] for key in keys])
    for key, i in distinct.items():
        yield key, np.flatnonzero(groups == i)


def index_of_rows(rows: Ints, count: int) -> Ints | slice:
    """Return an index that selects the given rows of an array with ``count`` rows, which is faster for all rows."""
    return slice(None) if rows.size == count else rows


def nan_to_infinity(values: Floats) -> Floats:
    """Replace NaN with infinity, because ``BlockBuilder`` rejects infinite values but treats NaN as not measured."""
    return np.where(np.isnan(values), np.inf, values)


def quantize(values: Floats, step: float, bits: int) -> Ints:
    """Convert values to signed integers, rounded and clipped like the output of a sensor. NaN becomes 0.

    Parameters
    ----------
    values
        float64 array in any unit.
    step
        Value of one least significant bit, in the unit of ``values``.
    bits
        Number of bits of the integers.
    """
    top = 1 << (bits - 1)
    return np.clip(np.rint(np.nan_to_num(values / step, nan=0.0)), -top, top - 1).astype(np.int64)


def make_chunks(frames: Sequence[bytes], t_ns: Ints) -> list[Chunk]:
    """Return one chunk per frame, with the times ``t_ns`` [n]."""
    return [Chunk(data, t) for data, t in zip(frames, t_ns.tolist(), strict=True)]


def xor_checksum(data: bytes) -> int:
    """Return the exclusive or of all bytes.

    >>> xor_checksum(b"VNRRG,8") == 0x4B
    True
    """
    # Folding one long integer in half repeatedly is faster than a loop over the bytes.
    bits = 8 << max(len(data) - 1, 0).bit_length()
    folded = int.from_bytes(data, "little")
    while bits > 8:
        bits >>= 1
        folded = (folded >> bits) ^ (folded & ((1 << bits) - 1))
    return folded


def fletcher_checksum(data: bytes) -> bytes:
    """Return the two 8-bit Fletcher sums of the data.

    >>> fletcher_checksum(bytes.fromhex("06 00 00 00")).hex()
    '0618'
    """
    sums = list(accumulate(data))
    return bytes([sums[-1] & 0xFF, sum(sums) & 0xFF])
