"""Interface of a decoder, and the functions that decoders share. Decoders convert bytes to samples and do no I/O.

A decoder module ``drivers/decoders/<protocol>.py`` defines ``Settings`` and ``build(settings) -> Decoder``.
``Settings`` is a pydantic model with the keys of ``[device.driver.decoder_options]``. ``build`` raises one
``ConfigError`` with a line for each mistake that the model does not find. The line begins with the key:
"signals.gx: ...".

``feed`` never raises an exception for bad bytes. A frame that fails its check is left out and counted in ``bad``. The
next block counts it in ``lost``, so that its place in time stays empty.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from drivers.sample import NO_TICK, Chunk, Floats, Ints, SampleBlock, make_block
from drivers.sample import ArrivalTiming as ArrivalTiming  # noqa: PLC0414 - re-exported for decoders
from drivers.sample import CounterTiming as CounterTiming  # noqa: PLC0414 - re-exported for decoders
from drivers.sample import SenderTiming as SenderTiming  # noqa: PLC0414 - re-exported for decoders
from drivers.sample import Timing as Timing  # noqa: PLC0414 - re-exported for decoders
from drivers.settings_model import SettingsModel

MAX_GYRO_RAD_S: Final = 1000.0
"""Largest plausible angular rate in rad/s. No MEMS gyroscope turns this fast (the widest range sold is 4000 °/s = 70
rad/s).
"""
MAX_ACCEL_M_S2: Final = 10_000.0
"""Largest plausible acceleration in m/s², about 1000 g. It is above every inertial-grade MEMS range."""
VALUE_LIMITS: Final = np.repeat([MAX_GYRO_RAD_S, MAX_ACCEL_M_S2], 3)
"""Largest plausible values [6] in the order of ``AXES``."""
TEMPERATURE_LIMITS_C: Final = (-100.0, 300.0)
"""Lowest and highest plausible temperature."""


class DecoderSettings(SettingsModel):
    """Base class of the settings of decoders."""


class Decoder(Protocol):
    """Interface of a decoder of one wire format, which converts between bytes and ``SampleBlock``."""

    carrier: ClassVar[str]  # see drivers.links.base.Carrier

    @property
    def timing(self) -> Timing:
        """Timing that the frames carry. It does not change during the life of the decoder."""

    @property
    def bad(self) -> int:
        """Number of rejected frames and samples since the decoder was created."""

    @property
    def hint(self) -> str:
        """Reason for rejected frames, for the status line; "" if there is none."""

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Return the samples that these chunks complete.

        ``t_ns`` is the arrival time of the chunk that completed a sample.
        """

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Return the samples in the wire format as a device would send them. Counters are taken from ``ticks``."""

    def reset(self) -> None:
        """Forget an incomplete frame, because the link was opened again."""


@runtime_checkable
class AddressFilter(Protocol):
    """Interface of a decoder that reads only chunks with certain addresses."""

    @property
    def addresses(self) -> tuple[int, ...]:
        """Addresses to receive, in the form of ``Chunk.address``."""


@runtime_checkable
class LateFrameCounter(Protocol):
    """Interface of a decoder that joins several frames to one sample, and tells late frames from missing ones."""

    @property
    def late(self) -> int:
        """Number of samples left out because some of their frames arrived too late.

        They are not included in ``bad``.
        """

    @property
    def late_hint(self) -> str:
        """Delay of the late frames and the remedy, for the status; "" if no frame has been late for a while."""


class BlockBuilder:
    """Collector of decoded rows. It splits them into blocks where frames were rejected."""

    def __init__(self) -> None:
        self.bad = 0  # rejected frames and implausible rows so far
        self._missing = 0

    def reset(self) -> None:
        """Forget rejected frames that were not followed by a sample."""
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
        """Return the plausible rows as blocks.

        A row with an infinite or implausible value is dropped and leaves an empty place. NaN means not measured and is
        accepted unless all axes are NaN.

        Parameters
        ----------
        t_ns
            [n] int64, times in ns.
        values
            [n, 6] float64 in the order of AXES, rad/s and m/s².
        temperature_c
            [n] float64 in °C.
        ticks
            [n] int64, counter of the device; NO_TICK = none.
        bad_before
            [n] int64, number of frames that were rejected just before each row.
        bad_after
            Number of frames that were rejected after the last row. They count before the first row of the next call.
        """
        good = plausible(values)
        if good.size and good.all() and not bad_before.any():  # fast path for nearly all calls
            carried, self._missing = self._missing, bad_after
            self.bad += bad_after
            return [make_block(t_ns, values, _valid_temperatures(temperature_c), ticks, carried)]
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
        temperature_c = _valid_temperatures(temperature_c)
        cuts = np.flatnonzero(missing[1:]) + 1
        return [
            make_block(t_ns[rows], values[rows], temperature_c[rows], ticks[rows], int(missing[at]))
            for at, rows in zip((0, *cuts), np.split(kept, cuts), strict=True)
        ]


def plausible(values: Floats) -> NDArray[np.bool_]:
    """Return a mask [n] of plausible rows [n, 6].

    A plausible row has at least one measured axis. None of its values is infinite or above the range of a MEMS IMU.
    """
    size = np.abs(values)
    too_large: NDArray[np.bool_] = np.any(size > VALUE_LIMITS, axis=1)
    absent: NDArray[np.bool_] = np.all(np.isnan(values), axis=1)
    return ~(too_large | absent)


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
    at_once: NDArray[np.bool_]  # [n] True if the frame follows the previous one without other bytes

    def keep(self, rows: Sequence[int]) -> tuple["Frames", int]:
        """Return the frames of these rows, and the number of frames rejected after the last of them.

        Frames that were rejected before a frame left out count before the next kept one.
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
"""Result of a ``Match`` function if the buffer ends before the frame does."""
REJECT: Final = -1
"""Result of a ``Match`` function if there is no valid frame."""

Match = Callable[[bytes, int], int]
"""Function (buffer, offset of a sync) that returns the length of the valid frame there, NEED_MORE, or REJECT."""

MAX_BYTES_WITHOUT_FRAME: Final = 2000
"""Bytes without a valid frame after which a hint is given. No supported frame is as long."""
HINT_FRAMES: Final = 1000
"""Number of good frames after a rejected one until the hint about it ends."""


class FrameBuffer:
    """Finder of frames in a byte stream that may be split anywhere, damaged, or joined in the middle.

    After a rejected candidate, the search continues one byte later in the same bytes, since a sync pattern may occur
    inside a payload. The number of frames lost between two valid frames is the larger of two counts: rejected
    candidates at least one frame length apart, and complete frames that fit between them. Bytes before the first frame
    (joined in the middle of the stream) are not counted. At most ``longest`` bytes are kept between calls of ``feed``.

    Parameters
    ----------
    sync
        Fixed start of a frame; empty if a frame can start with any byte. ``match`` may narrow the attribute ``sync`` to
        the first byte of all further frames. It is widened again after MUTE_BYTES without a frame.
    match
        Function that checks one candidate.
    longest
        Maximum length of a frame in bytes.
    """

    def __init__(self, sync: bytes, match: Match, longest: int) -> None:
        self.sync = self._initial_sync = sync
        self._match = match
        self._longest = longest
        self._buffer = b""
        self._arrivals: deque[tuple[int, int]] = deque()  # (stream offset of the end of a chunk, t_ns)
        self._buffer_offset = 0  # stream offset of the first byte in the buffer
        self.reset()

    def reset(self) -> None:
        """Forget the buffered bytes, the synchronization, and the narrowed ``sync``."""
        self.sync = self._initial_sync
        self._buffer_offset += len(self._buffer)
        self._buffer = b""
        self._arrivals.clear()
        self._synchronized = False
        self._frame_length = 0
        self._skipped_bytes = 0  # bytes skipped since the last frame
        self._rejected = 0  # candidates rejected since the last frame
        self._last_rejected = -(1 << 62)  # stream offset of the last rejected candidate
        self._frames_since_reject = HINT_FRAMES  # number of good frames since the last rejected one

    @property
    def mute(self) -> bool:
        """True if many bytes have arrived without a valid frame."""
        return self._skipped_bytes >= MAX_BYTES_WITHOUT_FRAME

    @property
    def hint(self) -> str:
        """Reason for rejected or missing frames; "" if there is none."""
        if self.mute:
            return f"{self._skipped_bytes} bytes without a valid frame: is the baud rate right, and the decoder?"
        if self._frames_since_reject < HINT_FRAMES:
            return "frames fail their check: bytes are lost or damaged on the line"
        return ""

    def feed(self, chunks: Sequence[Chunk]) -> Frames:
        """Return all frames that these chunks complete."""
        buffer, match, longest = self._join(chunks), self._match, self._longest
        found: list[bytes] = []
        ends: list[int] = []  # offset in the buffer after each frame
        bad_before: list[int] = []
        at_once: list[bool] = []
        at = 0
        while True:
            start = buffer.find(self.sync, at)
            if self.sync != self._initial_sync:
                mute = at + MAX_BYTES_WITHOUT_FRAME - self._skipped_bytes
                if mute <= len(buffer) and not at <= start < mute:
                    self._skipped_bytes += mute - at
                    at, self.sync = mute, self._initial_sync
                    continue
            if start < 0:
                # the tail may be the first part of a sync
                start = max(at, len(buffer) - len(self.sync) + 1)
                self._skipped_bytes += start - at
                at = start
                break
            self._skipped_bytes += start - at
            length = match(buffer, start)
            if length > 0:
                at = start + length
                found.append(buffer[start:at])
                ends.append(at)
                at_once.append(not self._skipped_bytes)
                bad_before.append(self._close_hole() if self._skipped_bytes else 0)
                self._frame_length = length
                self._synchronized = True
            elif length == NEED_MORE and len(buffer) - start < longest:
                at = start
                break
            else:
                self._reject(start)
                self._skipped_bytes += 1
                at = start + 1
        frames = Frames(found, self._arrived(ends), np.array(bad_before, np.int64), np.array(at_once, np.bool_))
        self._buffer = buffer[at:]
        self._buffer_offset += at
        while len(self._arrivals) > 1 and self._arrivals[0][0] <= self._buffer_offset:
            self._arrivals.popleft()
        self._frames_since_reject += len(found)
        return frames

    def _join(self, chunks: Sequence[Chunk]) -> bytes:
        """Append the data of chunks to the buffer, and note their arrival times."""
        end = self._buffer_offset + len(self._buffer)
        for chunk in chunks:
            if chunk.data:
                end += len(chunk.data)
                self._arrivals.append((end, chunk.t_ns))
        return b"".join((self._buffer, *[chunk.data for chunk in chunks]))

    def _reject(self, at: int) -> None:
        """Count a rejected candidate unless it lies within a frame length of the previous one."""
        offset = self._buffer_offset + at
        if offset - self._last_rejected >= max(self._frame_length, 1):
            self._rejected += 1
            self._last_rejected = offset

    def _close_hole(self) -> int:
        """Return the number of frames lost since the last frame, and reset the counts."""
        fitting = round(self._skipped_bytes / self._frame_length) if self._frame_length else 0
        count = max(self._rejected, fitting) if self._synchronized else 0
        self._skipped_bytes = self._rejected = 0
        self._last_rejected = -(1 << 62)
        if count:
            self._frames_since_reject = 0
        return count

    def _arrived(self, ends: list[int]) -> Ints:
        """Return the arrival times [n] of the chunks that contain the last byte of each frame."""
        if not ends:
            return np.empty(0, np.int64)
        offsets, t_ns = np.array(self._arrivals, np.int64).T
        arrived: Ints = t_ns[np.searchsorted(offsets, np.array(ends) + self._buffer_offset)]
        return arrived


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


class Unmeasured:
    """Constant columns for formats that do not measure a quantity."""

    @staticmethod
    def temperature(n: int) -> Floats:
        """Return a column [n] of NaN."""
        return np.full(n, np.nan)

    @staticmethod
    def ticks(n: int) -> Ints:
        """Return a column [n] of NO_TICK."""
        return np.full(n, NO_TICK, np.int64)
