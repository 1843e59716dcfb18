"""Xsens / Movella MTi over UART or USB: MTData2 messages of the Xbus protocol.

The format is ``FA FF 36 | LEN | payload | CS``, big-endian. If LEN is 0xFF, the length follows as u16. The sum of all
bytes after 0xFA is 0 modulo 256. The payload is a list of items ``DID u16 | size u8 | data``. The two low bits of the
data identifier (DID) specify the number format: float32, fixed 12.20, fixed 16.32 or float64. The next two bits specify
the coordinate frame and are ignored. In a fixed 16.32 number, the 32-bit fraction precedes the 16-bit integer part, and
each part is big-endian. The byte order of fixed 16.32 numbers was taken from three independent public parsers. Source:
Movella, MT low level communication protocol (MT0101P).

The decoder reads the acceleration 0x4020 or 0x4040 (high-rate), the rate of turn 0x8020 or 0x8040 (high-rate), the
clock 0x1060 or 0x1020, and the temperature 0x0810. Free acceleration 0x4030 is not used, since the orientation filter
has removed gravity. If a packet contains only accelerations or only rates, the other axes are marked as not measured
(NaN). A packet without accelerations and rates is ignored. Temperatures often arrive in separate packets at a lower
rate. Each sample contains the newest temperature that has been received since the link was opened.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from pydantic import Field

from drivers.data_types import NO_TICK, ArrivalTimedFormat, Chunk, CounterTimedFormat, Floats, Ints, SampleBlock, Timing
from drivers.decoders import base
from drivers.validation.settings_model import SettingsModel

SYNC: Final = b"\xfa\xff\x36"
MAX_PAYLOAD: Final = 2048
"""Maximum payload in bytes, far larger than the payload of any MTi configuration.

The limit prevents a damaged length field from blocking the stream.
"""
LONGEST: Final = 7 + MAX_PAYLOAD

TEMPERATURE: Final = 0x0810
PACKET_COUNTER: Final = 0x1020
SAMPLE_TIME_FINE: Final = 0x1060
ACCEL, ACCEL_HR = 0x4020, 0x4040
GYRO, GYRO_HR = 0x8020, 0x8040

Format = Literal["float32", "fp12.20", "fp16.32", "float64"]
FORMATS: Final[tuple[Format, ...]] = ("float32", "fp12.20", "fp16.32", "float64")
"""Number formats, indexed by the two low bits of a data identifier (DID)."""
SIZES: Final = (4, 4, 6, 8)
"""Size of one number in bytes, indexed by the two low bits of a data identifier (DID)."""


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]``."""

    clock: Literal["sample_time_fine", "packet_counter", "arrival"] = Field(
        "sample_time_fine", description="source of the sample times"
    )
    high_rate: bool = Field(
        False, description="true: read the high-rate items 0x4040 and 0x8040 instead of 0x4020 and 0x8020"
    )
    format: Format = Field(
        "float32", description="number format that a simulated sensor writes; all four formats can be read"
    )


@dataclass(frozen=True, slots=True)
class PacketLayout:
    """Positions of the data items in an MTData2 packet."""

    items: tuple[tuple[int, int, int], ...]  # DID, offset of the data and size of each item
    header_offsets: tuple[int, ...]  # offsets of the DID and size bytes of all items

    def locate_numbers(self, data_id: int, count: int) -> tuple[int, int] | None:
        """Find the first item with a given data identifier and number of values.

        Parameters
        ----------
        data_id
            Data identifier (DID) without its low nibble.
        count
            Number of values in the item.

        Returns
        -------
        tuple of int, or None
            Offset of the data, and index of the number format in FORMATS.
        """
        for found, at, size in self.items:
            if found & 0xFFF0 == data_id and size == count * SIZES[found & 3]:
                return at, found & 3
        return None

    def locate_integer(self, data_id: int, size: int) -> int:
        """Return the offset of an item with one unsigned integer, or 0 if the packet contains no such item.

        Parameters
        ----------
        data_id
            Data identifier (DID) without its low nibble.
        size
            Size of the integer in bytes.
        """
        return next((at for found, at, n in self.items if found & 0xFFF0 == data_id and n == size), 0)


def _parse_layout(frame: bytes) -> PacketLayout | None:
    """Return the layout of a packet, or None if the sizes of the items do not match the payload."""
    at = 6 if frame[3] == 0xFF else 4
    end = len(frame) - 1
    items: list[tuple[int, int, int]] = []
    while at + 3 <= end:
        size = frame[at + 2]
        items.append((frame[at] << 8 | frame[at + 1], at + 3, size))
        at += 3 + size
    headers = tuple(start - back for _, start, _ in items for back in (3, 2, 1))
    return PacketLayout(tuple(items), headers) if at == end else None


class XsensMtdata2Decoder(base.FrameStreamDecoder):
    """Decoder and encoder of MTData2 packets."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(SYNC, _match_message, LONGEST)
        self._settings = settings
        # (timing, DID, size of the counter in bytes)
        clocks: dict[str, tuple[Timing, int, int]] = {
            "sample_time_fine": (CounterTimedFormat(1 << 32, 1e-4), SAMPLE_TIME_FINE, 4),
            "packet_counter": (CounterTimedFormat(1 << 16), PACKET_COUNTER, 2),
            "arrival": (ArrivalTimedFormat(), 0, 0),
        }
        self.timing, self._clock, self._clock_size = clocks[settings.clock]
        self._accel, self._gyro = (ACCEL_HR, GYRO_HR) if settings.high_rate else (ACCEL, GYRO)
        self._temperature_c = np.nan
        self._clock_missing = False

    @property
    def recent_problem(self) -> str:
        """Reason why packets were rejected, or note that the device clock is missing; "" if there is no problem."""
        if self._clock_missing:
            return f'packets contain no {self._settings.clock}: enable it in the device, or set "clock"'
        return super().recent_problem

    def forget_stream_state(self) -> None:
        """Discard a partially received packet and the last temperature."""
        super().forget_stream_state()
        self._temperature_c = np.nan

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        """Return the samples of packets with angular rates or accelerations.

        Packets with an invalid layout are rejected.
        """
        n = len(frames.data)
        values = np.full((n, 6), np.nan)
        temperature_c = np.full(n, np.nan)
        ticks = np.full(n, NO_TICK, np.int64)
        for layout, rows, packets in _group_by_layout(frames):
            own = base.index_of_rows(rows, n)
            if layout is None:
                values[own] = np.inf
                continue
            for data_id, axes in ((self._gyro, slice(0, 3)), (self._accel, slice(3, 6))):
                if found := layout.locate_numbers(data_id, 3):
                    values[own, axes] = base.nan_to_infinity(_read_numbers(packets, *found, 3))
            if found := layout.locate_numbers(TEMPERATURE, 1):
                temperature_c[own] = _read_numbers(packets, *found, 1)[:, 0]
            if self._clock and (at := layout.locate_integer(self._clock, self._clock_size)):
                weights = 256 ** np.arange(self._clock_size - 1, -1, -1)
                ticks[own] = packets[:, at : at + self._clock_size].astype(np.int64) @ weights
        blocks, last = self._build_measured_blocks(frames, values, self._fill_temperatures(temperature_c), ticks)
        if last is not None:
            self._clock_missing = self._clock != 0 and int(ticks[last]) == NO_TICK
        return blocks

    def _fill_temperatures(self, temperature_c: Floats) -> Floats:
        known = np.concatenate([[self._temperature_c], temperature_c])
        last = np.maximum.accumulate(np.where(np.isnan(known), 0, np.arange(known.size)))
        filled: Floats = known[last][1:]
        self._temperature_c = float(filled[-1])
        return filled

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode each sample as one packet with both clocks and the measured quantities."""
        number_format = FORMATS.index(self._settings.format)
        frames = []
        rows = zip(samples.values, samples.temperature_c.tolist(), samples.ticks.tolist(), strict=True)
        for row, temperature_c, tick in rows:
            payload = struct.pack(">HBH", PACKET_COUNTER, 2, tick & 0xFFFF)
            payload += struct.pack(">HBI", SAMPLE_TIME_FINE, 4, tick & 0xFFFFFFFF)
            if not np.isnan(temperature_c):
                payload += struct.pack(">HBf", TEMPERATURE, 4, temperature_c)
            for data_id, triple in ((self._accel, row[3:]), (self._gyro, row[:3])):
                if not np.isnan(triple).all():
                    payload += struct.pack(">HB", data_id | number_format, 3 * SIZES[number_format])
                    payload += _encode_numbers(triple, number_format)
            frames.append(encode_message(payload))
        return base.make_chunks(frames, samples.t_ns)


def _group_by_layout(frames: base.RawFrames) -> Iterator[tuple[PacketLayout | None, Ints, base.Bytes]]:
    """Yield each layout with the indices and bytes [k, length] of its packets.

    The layout is None for invalid packets.
    """
    for _, rows in base.group_indices([len(packet) for packet in frames.data]):
        packets, at = frames.stack_frames(rows), rows
        while at.size:
            layout = _parse_layout(packets[0].tobytes())
            compared = list(layout.header_offsets) if layout else slice(None)
            same = (packets[:, compared] == packets[0, compared]).all(axis=1)
            if same.all():  # usually all packets have the same layout
                yield layout, at, packets
                break
            yield layout, at[same], packets[same]
            at, packets = at[~same], packets[~same]


def _read_numbers(packets: base.Bytes, at: int, number_format: int, count: int) -> Floats:
    data = np.ascontiguousarray(packets[:, at : at + count * SIZES[number_format]])
    if number_format == 0:
        with np.errstate(invalid="ignore"):  # converting a signalling NaN causes a warning
            return data.view(">f4").astype(np.float64)
    if number_format == 1:
        return data.view(">i4") / 2.0**20
    if number_format == 2:
        parts = data.view(np.dtype([("fraction", ">u4"), ("integer", ">i2")]))
        both: Floats = parts["integer"] + parts["fraction"] / 2.0**32
        return both
    return data.view(">f8").astype(np.float64)


def _encode_numbers(triple: Floats, number_format: int) -> bytes:
    if number_format == 0:
        return triple.astype(">f4").tobytes()
    if number_format == 3:
        return triple.astype(">f8").tobytes()
    triple = np.nan_to_num(triple)  # fixed-point formats cannot represent NaN
    if number_format == 1:
        return base.quantize(triple, 2.0**-20, 32).astype(">i4").tobytes()
    whole = [min(max(round(x * 2**32), -(2**47)), 2**47 - 1) for x in triple.tolist()]
    return b"".join(struct.pack(">Ih", x & 0xFFFFFFFF, x >> 32) for x in whole)


def encode_message(payload: bytes) -> bytes:
    """Return an MTData2 message with this payload."""
    n = len(payload)
    head = b"\xff\x36" + (bytes([n]) if n < 0xFF else b"\xff" + n.to_bytes(2, "big"))
    body = head + payload
    return b"\xfa" + body + bytes([-sum(body) & 0xFF])


def _match_message(buffer: bytes, at: int) -> int:
    have = len(buffer) - at
    if have < 6:
        return base.NEED_MORE
    length = buffer[at + 3] + 5
    if length == 0xFF + 5:
        payload = int.from_bytes(buffer[at + 4 : at + 6], "big")
        if payload > MAX_PAYLOAD:
            return base.REJECT
        length = payload + 7
    if have < length:
        return base.NEED_MORE
    return base.REJECT if sum(buffer[at + 1 : at + length]) & 0xFF else length


def build(settings: Settings) -> base.Decoder:
    """Return a decoder of MTData2 packets with the given settings."""
    return XsensMtdata2Decoder(settings)
