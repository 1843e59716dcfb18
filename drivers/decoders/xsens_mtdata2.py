"""Xsens / Movella MTi over UART or USB: MTData2 messages of the Xbus protocol.

``FA FF 36 | LEN | payload | CS``, big-endian; LEN = 0xFF is followed by the true length as u16. The low byte
of the sum of all behind 0xFA is 0. The payload is a list of ``DID u16 | size u8 | data``. The two low bits
of a DID give the number format: float32, fixed 12.20, fixed 16.32, float64; the rest of its low nibble a
frame of orientation, masked off here. A fixed 16.32 number is sent with its 32-bit fraction first, then its
16-bit integer part, each big-endian (three independent public parsers agree; the manual was not at hand).
Source: Movella, MT low level communication protocol (MT0101P).

Of a packet are read: acceleration 0x4020 (or HR 0x4040), rate of turn 0x8020 (or HR 0x8040), the clock
0x1060 or 0x1020, and temperature 0x0810. Free acceleration 0x4030 has gravity removed by the orientation
filter and is no measurement of the sensor: never used. A packet with acceleration alone, or rates alone,
leaves the other axes unmeasured (NaN); one with neither makes no sample and is not bad. Temperature often
comes in slower packets of its own: the last one is held until the next, or until the link is opened anew.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray

from drivers.decoders.base import (
    NEED_MORE,
    REJECT,
    Decoder,
    DecoderSettings,
    FrameBuffer,
    Frames,
    Rows,
    invalid,
    one_chunk_each,
)
from drivers.sample import NO_TICK, Arrival, Chunk, Counter, Floats, Ints, SampleBlock, Timing

SYNC: Final = b"\xfa\xff\x36"
MAX_PAYLOAD: Final = 2048
"""Bytes; no configuration of an MTi comes near it, and a damaged length must not stall the stream."""
LONGEST: Final = 7 + MAX_PAYLOAD

TEMPERATURE: Final = 0x0810
PACKET_COUNTER: Final = 0x1020
SAMPLE_TIME_FINE: Final = 0x1060
ACCEL, ACCEL_HR = 0x4020, 0x4040
GYRO, GYRO_HR = 0x8020, 0x8040

Format = Literal["float32", "fp12.20", "fp16.32", "float64"]
FORMATS: Final[tuple[Format, ...]] = ("float32", "fp12.20", "fp16.32", "float64")
"""By the two low bits of a DID."""
SIZES: Final = (4, 4, 6, 8)
"""Bytes of one number, by the two low bits of a DID."""


class Settings(DecoderSettings, frozen=True):
    """Keys of ``[device.driver.decoder_options]``."""

    clock: Literal["sample_time_fine", "packet_counter", "arrival"] = "sample_time_fine"
    """Sample times from SampleTimeFine (0.1 ms), from PacketCounter (one a packet), or from arrival."""
    high_rate: bool = False
    """Read the HR items, 0x4040 and 0x8040, instead of 0x4020 and 0x8020."""
    format: Format = "float32"
    """Number format that ``encode`` writes; reading understands all four."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the items of a packet lie: (DID, offset of the data, its size), and what is not data."""

    items: tuple[tuple[int, int, int], ...]
    skeleton: tuple[int, ...]  # offsets of all DID and size bytes

    def find(self, kind: int, numbers: int) -> tuple[int, int] | None:
        """(offset, DID) of the first item of this kind that holds so many numbers of its format."""
        for did, at, size in self.items:
            if did & 0xFFF0 == kind and size == numbers * SIZES[did & 3]:
                return at, did
        return None

    def find_integer(self, kind: int, size: int) -> int:
        """Offset of an unsigned integer item of so many bytes; 0 if there is none."""
        return next((at for did, at, n in self.items if did & 0xFFF0 == kind and n == size), 0)


def layout(frame: bytes) -> Layout | None:
    """Layout of a packet that passed its checksum; None if its items do not fill it exactly."""
    at = 6 if frame[3] == 0xFF else 4
    end = len(frame) - 1
    items, skeleton = [], []
    while at + 3 <= end:
        skeleton += [at, at + 1, at + 2]
        size = frame[at + 2]
        items.append((frame[at] << 8 | frame[at + 1], at + 3, size))
        at += 3 + size
    return Layout(tuple(items), tuple(skeleton)) if at == end else None


class XsensMtdata2Decoder:
    """MTData2 packets <-> SampleBlock."""

    carrier: ClassVar[str] = "bytes"

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        # (timing, DID, bytes of the counter)
        clocks: dict[str, tuple[Timing, int, int]] = {
            "sample_time_fine": (Counter(1 << 32, 1e-4), SAMPLE_TIME_FINE, 4),
            "packet_counter": (Counter(1 << 16), PACKET_COUNTER, 2),
            "arrival": (Arrival(), 0, 0),
        }
        self.timing, self._clock, self._clock_size = clocks[settings.clock]
        self._accel, self._gyro = (ACCEL_HR, GYRO_HR) if settings.high_rate else (ACCEL, GYRO)
        self._buffer = FrameBuffer(SYNC, match, LONGEST)
        self._rows = Rows()
        self._temperature_c = np.nan
        self._clockless = False

    @property
    def bad(self) -> int:
        """Packets that failed their check, and samples that cannot be."""
        return self._rows.bad

    @property
    def hint(self) -> str:
        """What to do about packets that are rejected or lack their clock."""
        if self._clockless:
            return f'packets hold no {self._settings.clock}: switch it on in the device, or set "clock"'
        return self._buffer.hint

    def reset(self) -> None:
        """Forget a half-received packet and the last temperature."""
        self._buffer.reset()
        self._rows.reset()
        self._temperature_c = np.nan

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Samples of the packets that these chunks complete."""
        frames = self._buffer.feed(chunks)
        n = len(frames.data)
        if not n:
            return []
        values = np.full((n, 6), np.nan)
        temperature_c = np.full(n, np.nan)
        ticks = np.full(n, NO_TICK, np.int64)
        for form, at, packets in alike(frames.data):
            if form is None:
                values[at] = np.inf
            else:
                self._read(form, packets, at, values, temperature_c, ticks)
        temperature_c = self._held(temperature_c)
        return self._blocks(frames, values, temperature_c, ticks)

    def _blocks(self, frames: Frames, values: Floats, temperature_c: Floats, ticks: Ints) -> list[SampleBlock]:
        rows = np.flatnonzero(~np.isnan(values).all(axis=1))
        kept, bad_after = frames.keep(rows.tolist())
        if rows.size:
            self._clockless = self._clock != 0 and int(ticks[rows[-1]]) == NO_TICK
        return self._rows.blocks(kept.t_ns, values[rows], temperature_c[rows], ticks[rows], kept.bad_before, bad_after)

    def _read(
        self,
        form: Layout,
        packets: NDArray[np.uint8],
        at: NDArray[np.intp],
        values: Floats,
        temperature_c: Floats,
        ticks: Ints,
    ) -> None:
        for kind, axes in ((self._gyro, slice(0, 3)), (self._accel, slice(3, 6))):
            if found := form.find(kind, 3):
                values[at, axes] = invalid(numbers(packets, *found, 3))
        if found := form.find(TEMPERATURE, 1):
            temperature_c[at] = numbers(packets, *found, 1)[:, 0]
        if self._clock and (offset := form.find_integer(self._clock, self._clock_size)):
            weights = 256 ** np.arange(self._clock_size - 1, -1, -1)
            ticks[at] = packets[:, offset : offset + self._clock_size].astype(np.int64) @ weights

    def _held(self, temperature_c: Floats) -> Floats:
        """Each packet's temperature, or the last one before it."""
        known = np.concatenate([[self._temperature_c], temperature_c])
        last = np.maximum.accumulate(np.where(np.isnan(known), 0, np.arange(known.size)))
        held: Floats = known[last][1:]
        self._temperature_c = float(held[-1])
        return held

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """One packet a sample: both clocks, temperature where there is one, the measured triples."""
        kind = FORMATS.index(self._settings.format)
        frames = []
        rows = zip(samples.values, samples.temperature_c.tolist(), samples.ticks.tolist(), strict=True)
        for row, temperature_c, tick in rows:
            payload = struct.pack(">HBH", PACKET_COUNTER, 2, tick & 0xFFFF)
            payload += struct.pack(">HBI", SAMPLE_TIME_FINE, 4, tick & 0xFFFFFFFF)
            if not np.isnan(temperature_c):
                payload += struct.pack(">HBf", TEMPERATURE, 4, temperature_c)
            for did, triple in ((self._accel, row[3:]), (self._gyro, row[:3])):
                if not np.isnan(triple).all():
                    payload += struct.pack(">HB", did | kind, 3 * SIZES[kind]) + written(triple, kind)
            frames.append(message(payload))
        return one_chunk_each(frames, samples.t_ns)


def alike(frames: list[bytes]) -> list[tuple[Layout | None, NDArray[np.intp], NDArray[np.uint8]]]:
    """Frames grouped by layout: (layout, which frames, their bytes [k, length]); most often one group."""
    lengths = np.fromiter(map(len, frames), np.intp, len(frames))
    result = []
    for length in dict.fromkeys(lengths.tolist()):
        at = np.flatnonzero(lengths == length)
        packets = np.frombuffer(b"".join([frames[i] for i in at]), np.uint8).reshape(-1, length)
        while at.size:
            form = layout(frames[at[0]])
            fixed = list(form.skeleton) if form else slice(None)
            same = (packets[:, fixed] == packets[0, fixed]).all(axis=1)
            result.append((form, at[same], packets[same]))
            at, packets = at[~same], packets[~same]
    return result


def numbers(packets: NDArray[np.uint8], at: int, did: int, count: int) -> Floats:
    """[k, count] numbers at an offset of each packet, in the format that the DID names."""
    kind = did & 3
    data = np.ascontiguousarray(packets[:, at : at + count * SIZES[kind]])
    if kind == 0:
        with np.errstate(invalid="ignore"):  # a signalling NaN on the wire is just NaN
            return data.view(">f4").astype(np.float64)
    if kind == 1:
        return data.view(">i4") / 2.0**20
    if kind == 2:
        parts = data.view(np.dtype([("fraction", ">u4"), ("integer", ">i2")]))
        both: Floats = parts["integer"] + parts["fraction"] / 2.0**32
        return both
    return data.view(">f8").astype(np.float64)


def written(triple: Floats, kind: int) -> bytes:
    """Three numbers in one of the four formats, clipped to what it can hold."""
    if kind == 0:
        return triple.astype(">f4").tobytes()
    if kind == 3:
        return triple.astype(">f8").tobytes()
    triple = np.nan_to_num(triple)  # a fixed-point number cannot say that it is not measured
    if kind == 1:
        return np.clip(np.rint(triple * 2.0**20), -(2**31), 2**31 - 1).astype(">i4").tobytes()
    whole = [min(max(round(x * 2**32), -(2**47)), 2**47 - 1) for x in triple.tolist()]
    return b"".join(struct.pack(">Ih", x & 0xFFFFFFFF, x >> 32) for x in whole)


def message(payload: bytes) -> bytes:
    """An MTData2 message around a payload."""
    n = len(payload)
    head = b"\xff\x36" + (bytes([n]) if n < 0xFF else b"\xff" + n.to_bytes(2, "big"))
    body = head + payload
    return b"\xfa" + body + bytes([-sum(body) & 0xFF])


def match(buffer: bytes, at: int) -> int:
    """Length of the message at this place, if it is whole and its checksum holds."""
    have = len(buffer) - at
    if have < 6:
        return NEED_MORE
    length = buffer[at + 3] + 5
    if length == 0xFF + 5:
        payload = int.from_bytes(buffer[at + 4 : at + 6], "big")
        if payload > MAX_PAYLOAD:
            return REJECT
        length = payload + 7
    if have < length:
        return NEED_MORE
    return REJECT if sum(buffer[at + 1 : at + length]) & 0xFF else length


def build(settings: Settings) -> Decoder:
    """A decoder with these settings."""
    return XsensMtdata2Decoder(settings)
