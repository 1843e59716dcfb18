"""HBK/MicroStrain inertial sensors with the MIP protocol, such as 3DM-CX5, 3DM-GX5 and 3DM-CV7, over UART or USB.

The format is ``75 65 | descriptor set u8 | payload length u8 | fields | checksum``, big-endian. A field consists of
``length u8 | descriptor u8 | data``, and its length includes the first two bytes. The checksum is the Fletcher checksum
of all preceding bytes: the sum of the bytes, then the sum of the intermediate sums, each modulo 256. Sources: 3DM-CV7
manual, section "Data Overview", and the definitions and recorded packets of LORD-MicroStrain/mip_sdk.

Packets of the descriptor set 0x80 (sensor data) contain samples. Packets of other sets are ignored.

- 0x04 and 0x05 are the scaled acceleration in g and the scaled angular rate in rad/s.
- 0x07 and 0x08 are the integrals of the angular rate in rad and of the acceleration in g·s. Field 0xD6 contains the
  duration of both integrals in ns. If ``increments`` is true, the decoder uses these fields instead.
- 0xD5 is the reference time of the sample in ns. The time never jumps.
- 0x18 contains the overrange bits of accelerometers (0 to 2) and gyroscopes (4 to 6). A sample with such a bit is bad.

A sample that contains a non-finite number is bad. If a packet contains only accelerations or only angular rates, the
other axes are marked as not measured. Field 0x14 contains the lowest, highest and mean temperature since the last
reset. None of them is the current temperature, so the samples contain no temperature. The z axis points down and
measures -1 g at rest.
"""

import struct
from typing import Final, Literal

import numpy as np
from pydantic import Field

from drivers.data_types import (
    NO_TICK,
    NS_PER_S,
    ArrivalTimedFormat,
    Chunk,
    CounterTimedFormat,
    Floats,
    Ints,
    SampleBlock,
    Timing,
)
from drivers.decoders import base
from drivers.units import G0
from drivers.validation.settings_model import SettingsModel

SYNC: Final = b"\x75\x65"
LONGEST: Final = 4 + 255 + 2
SENSOR_DATA: Final = 0x80
"""Descriptor set of the packets with samples."""

# descriptor and size of the data in bytes
ACCEL, GYRO = (0x04, 12), (0x05, 12)
DELTA_THETA, DELTA_VELOCITY = (0x07, 12), (0x08, 12)
OVERRANGE: Final = (0x18, 2)
REFERENCE_TIME, REFERENCE_TIME_DELTA = (0xD5, 8), (0xD6, 8)
OVERRANGE_BITS: Final = 0x77
"""Overrange bits of the accelerometers and gyroscopes."""

TICKS: Final = 1 << 62
"""Number of ticks of 1 ns after which the device time wraps to 0.

The reference time is an unsigned 64-bit integer. Its lowest 62 bits fit into int64 and wrap after 146 years.
"""
ENCODED_DELTA_NS: Final = 10_000_000
"""Duration in ns that a simulated sensor reports for its increments."""

Layout = tuple[tuple[tuple[int, int], int], ...]
"""Descriptor, size and offset of the data of each field of a packet."""


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]``."""

    increments: bool = Field(
        False, description="true: read delta theta and delta velocity, which are divided by the delta time 0xD6"
    )
    clock: Literal["reference_time", "arrival"] = Field("reference_time", description="source of the sample times")


class MicrostrainMipDecoder(base.FrameStreamDecoder):
    """Decoder and encoder of MIP packets."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(SYNC, _match_packet, LONGEST)
        self._increments = settings.increments
        self._gyro, self._accel = (DELTA_THETA, DELTA_VELOCITY) if settings.increments else (GYRO, ACCEL)
        self._uses_device_time = settings.clock == "reference_time"
        self.timing: Timing = CounterTimedFormat(TICKS, 1e-9) if self._uses_device_time else ArrivalTimedFormat()
        self._time_missing = False

    @property
    def recent_problem(self) -> str:
        """Note about missing fields, or reason why packets were rejected; "" if there is no problem."""
        if self._lacks_samples:
            needed = "0x07 or 0x08 and the delta time 0xD6" if self._increments else "0x04 or 0x05"
            return f"packets arrive, but none with the fields {needed} of set 0x80: enable these fields"
        if self._time_missing:
            return 'packets contain no reference time 0xD5: enable it, or set clock = "arrival"'
        return super().recent_problem

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        n = len(frames.data)
        values = np.full((n, 6), np.nan)
        ticks = np.full(n, NO_TICK, np.int64)
        for layout, rows in base.group_indices([_find_fields(packet) for packet in frames.data]):
            if layout is None:
                values[rows] = np.inf
            elif layout:
                offsets = dict(reversed(layout))
                packets = frames.stack_frames(rows)
                values[rows] = self._read_values(packets, offsets)
                if self._uses_device_time and REFERENCE_TIME in offsets:
                    ticks[rows] = _read_integers(packets, offsets[REFERENCE_TIME]) & (TICKS - 1)
        blocks, last = self._build_measured_blocks(frames, values, np.full(n, np.nan), ticks)
        if last is not None:
            self._time_missing = self._uses_device_time and int(ticks[last]) == NO_TICK
        return blocks

    def _read_values(self, packets: base.Bytes, offsets: dict[tuple[int, int], int]) -> Floats:
        """Return the values [n, 6] of packets that have the same fields. Invalid values are infinite."""
        values = np.full((len(packets), 6), np.nan)
        scale: Floats | float = 1.0
        if self._increments:
            if REFERENCE_TIME_DELTA not in offsets:
                return values
            duration_ns = _read_integers(packets, offsets[REFERENCE_TIME_DELTA])[:, None]
            scale = NS_PER_S / np.where(duration_ns > 0, duration_ns, np.nan)
        for field, axes, unit in ((self._gyro, slice(0, 3), 1.0), (self._accel, slice(3, 6), G0)):
            if field in offsets:
                values[:, axes] = base.nan_to_infinity(_read_triples(packets, offsets[field]) * unit * scale)
        if OVERRANGE in offsets:
            overrange = packets[:, offsets[OVERRANGE] + 1] & OVERRANGE_BITS != 0
            values[overrange[:, None] & ~np.isnan(values)] = np.inf
        return values

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode each sample as one packet with the reference time and the measured quantities."""
        scale = ENCODED_DELTA_NS / NS_PER_S if self._increments else 1.0
        frames = []
        for row, tick in zip(samples.values * scale, samples.ticks.tolist(), strict=True):
            payload = _encode_field(REFERENCE_TIME, struct.pack(">Q", tick & (TICKS - 1)))
            if self._increments:
                payload += _encode_field(REFERENCE_TIME_DELTA, struct.pack(">Q", ENCODED_DELTA_NS))
            for field, triple in ((self._accel, row[3:] / G0), (self._gyro, row[:3])):
                if not np.isnan(triple).all():
                    payload += _encode_field(field, triple.astype(">f4").tobytes())
            frames.append(encode_packet(SENSOR_DATA, payload))
        return base.make_chunks(frames, samples.t_ns)


def _find_fields(packet: bytes) -> Layout | None:
    """Return the fields of a packet with samples.

    The result is empty for packets of other descriptor sets. The result is None if the lengths of the fields do not
    match the payload.
    """
    if packet[2] != SENSOR_DATA:
        return ()
    at, end = 4, len(packet) - 2
    fields: list[tuple[tuple[int, int], int]] = []
    while at + 2 <= end and packet[at] >= 2:
        fields.append(((packet[at + 1], packet[at] - 2), at + 2))
        at += packet[at]
    return tuple(fields) if at == end else None


def _read_triples(packets: base.Bytes, at: int) -> Floats:
    with np.errstate(invalid="ignore"):  # converting a signalling NaN causes a warning
        return np.ascontiguousarray(packets[:, at : at + 12]).view(">f4").astype(np.float64)


def _read_integers(packets: base.Bytes, at: int) -> Ints:
    """Return an unsigned 64-bit integer from each packet [n]. Values above the range of int64 are negative."""
    return np.ascontiguousarray(packets[:, at : at + 8]).view(">i8")[:, 0].astype(np.int64)


def _encode_field(field: tuple[int, int], data: bytes) -> bytes:
    return bytes([len(data) + 2, field[0]]) + data


def encode_packet(descriptor_set: int, payload: bytes) -> bytes:
    """Return a MIP packet.

    Parameters
    ----------
    descriptor_set
        Descriptor set of the fields, such as 0x80.
    payload
        Encoded fields, at most 255 bytes.
    """
    body = SYNC + bytes([descriptor_set, len(payload)]) + payload
    return body + base.fletcher_checksum(body)


def _match_packet(buffer: bytes, at: int) -> int:
    if len(buffer) < at + 4:
        return base.NEED_MORE
    end = at + 4 + buffer[at + 3]
    if len(buffer) < end + 2:
        return base.NEED_MORE
    return end + 2 - at if base.fletcher_checksum(buffer[at:end]) == buffer[end : end + 2] else base.REJECT


def build(settings: Settings) -> base.Decoder:
    """Return a decoder of MIP packets with the given settings."""
    return MicrostrainMipDecoder(settings)
