"""VectorNav VN-100/200/300 binary messages.

The format is ``FA | groups u8 | a field mask u16le for each group | payload little-endian | CRC u16be``. The field
masks specify the fields of the payload, in the order of groups and bits. Messages of groups 1, 2, 3 and 5 are decoded.
Messages of other groups are rejected, since the decoder does not know the sizes of their fields. The CRC-16 has the
polynomial 0x1021 and the initial value 0, and covers all bytes after 0xFA. The CRC of a valid message, including the
CRC field, is 0 (VN-100 user manual UM001 v2.1, pages 27-43).

For noise analysis, the fields TimeStartup and Imu of group 1 are recommended (``FA 01 01 02``, 38 bytes). The fields
Imu, UncompGyro and UncompAccel contain the measured values. The fields AngularRate and Accel contain compensated
values, from which the on-board filter has subtracted a bias estimate. The subtraction hides bias instability and random
walk. If a message contains measured and compensated values, the key ``compensated`` selects one of them. If a message
contains only accelerations or only angular rates, the other axes are marked as not measured. A message without
accelerations and angular rates is ignored. The z axis of VectorNav sensors points down and measures -9.8 m/s² at rest.
"""

import binascii
import struct
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from pydantic import Field

from drivers.data_types import NO_TICK, ArrivalTimedFormat, Chunk, CounterTimedFormat, Floats, SampleBlock, Timing
from drivers.decoders import base
from drivers.validation.settings_model import SettingsModel

FIELD_SIZES: Final = {
    1: (8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8),
    2: (8, 8, 8, 2, 8, 8, 8, 4, 4),
    3: (2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12),
    5: (2, 12, 16, 36, 12, 12, 12, 12, 12, 12, 28),
}
"""Sizes in bytes of the fields of each group, in the order of the mask bits."""
LONGEST: Final = 1 + 1 + 2 * len(FIELD_SIZES) + sum(map(sum, FIELD_SIZES.values())) + 2

# Each entry is (group, bit, offset within the field). Preferred fields come first.
TIME: Final = ((1, 0, 0), (2, 0, 0))
UNCOMPENSATED_GYRO: Final = ((1, 9, 12), (3, 3, 0))
UNCOMPENSATED_ACCEL: Final = ((1, 9, 0), (3, 2, 0))
COMPENSATED_GYRO: Final = ((1, 5, 0), (3, 10, 0))
COMPENSATED_ACCEL: Final = ((1, 8, 0), (3, 9, 0))
TEMPERATURE: Final = ((1, 10, 12), (3, 4, 0))

TICKS: Final = 1 << 62
"""Number of ticks of 1 ns after which the device time wraps to 0.

TimeStartup is an unsigned 64-bit integer. Its lowest 62 bits fit into int64 and wrap after 146 years.
"""

TICK_BITS: Final = np.uint64(TICKS - 1)


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]``."""

    compensated: bool = Field(
        False, description="true: if a message contains both, use the values that the on-board filter has corrected"
    )
    clock: Literal["time_startup", "arrival"] = Field("time_startup", description="source of the sample times")


@lru_cache(maxsize=256)
def build_message_dtype(header: bytes, prefer_compensated: bool) -> np.dtype[np.void] | None:
    """Return the structured dtype of messages with a given header.

    Parameters
    ----------
    header
        Group byte and field masks.
    prefer_compensated
        True if compensated fields are preferred.

    Returns
    -------
    dtype or None
        Structured dtype of a complete message with the fields time, gyro, accel and temperature. Fields that the
        message does not contain are omitted. The result is None if the header contains unknown groups or fields.
    """
    offsets = _locate_fields(header)
    if offsets is None:
        return None
    last = max(offsets, key=lambda field: offsets[field])
    end = offsets[last] + FIELD_SIZES[last[0]][last[1]]
    return _build_layout(offsets, end + 2, prefer_compensated)


def _locate_fields(header: bytes) -> dict[tuple[int, int], int] | None:
    """Return the offset of each field (group, bit), or None if the header contains unknown groups or fields."""
    groups = [g for g in range(1, 9) if header[0] >> (g - 1) & 1]
    masks = struct.unpack(f"<{len(groups)}H", header[1:])
    offsets: dict[tuple[int, int], int] = {}
    end = 1 + len(header)
    for group, mask in zip(groups, masks, strict=True):
        sizes = FIELD_SIZES.get(group, ())
        if mask >> len(sizes) or not mask:
            return None
        for bit, size in enumerate(sizes):
            if mask >> bit & 1:
                offsets[group, bit] = end
                end += size
    return offsets


def _build_layout(offsets: dict[tuple[int, int], int], length: int, prefer_compensated: bool) -> np.dtype[np.void]:
    """Return the structured dtype of messages of ``length`` bytes.

    ``offsets`` maps (group, bit) to the offset of a field.
    """
    order = -1 if prefer_compensated else 1
    gyro = (UNCOMPENSATED_GYRO, COMPENSATED_GYRO)[::order]
    accel = (UNCOMPENSATED_ACCEL, COMPENSATED_ACCEL)[::order]
    sources = (
        ("time", "<u8", TIME),
        ("gyro", "<3f4", gyro[0] + gyro[1]),
        ("accel", "<3f4", accel[0] + accel[1]),
        ("temperature", "<f4", TEMPERATURE),
    )
    names, formats, starts = [], [], []
    for name, number_format, source in sources:
        found = [offsets[group, bit] + inside for group, bit, inside in source if (group, bit) in offsets]
        if found:
            names.append(name)
            formats.append(number_format)
            starts.append(found[0])
    return np.dtype({"names": names, "formats": formats, "offsets": starts, "itemsize": length})


@lru_cache(maxsize=256)
def _contains_compensated_gyro(header: bytes, prefer_compensated: bool) -> bool:
    """Return True if the angular rates of messages with this header are taken from a compensated field."""
    fields = _locate_fields(header) or {}
    compensated = any((group, bit) in fields for group, bit, _ in COMPENSATED_GYRO)
    return compensated and (
        prefer_compensated or all((group, bit) not in fields for group, bit, _ in UNCOMPENSATED_GYRO)
    )


def _header_end(groups: int) -> int:
    # Bit 7 announces a second group byte, which the decoder does not support.
    return 0 if groups == 0 or groups & 0x80 else 2 + 2 * groups.bit_count()


HEADER_END: Final = tuple(map(_header_end, range(256)))
"""Offset of the payload for each group byte; 0 if the group byte is invalid or not supported."""


class VectornavBinaryDecoder(base.FrameStreamDecoder):
    """Decoder and encoder of VectorNav binary messages."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(b"\xfa", self._match_message, LONGEST)
        self._compensated = settings.compensated
        self._uses_device_time = settings.clock == "time_startup"
        self.timing: Timing = CounterTimedFormat(TICKS, 1e-9) if self._uses_device_time else ArrivalTimedFormat()
        self._time_missing = self._reads_compensated_gyro = False

    @property
    def on_board_filter_note(self) -> str:
        """Note that the newest message contained corrected angular rates; "" if they were not corrected."""
        return f"{base.ON_BOARD_FILTER_NOTE}; select the field Imu" if self._reads_compensated_gyro else ""

    @property
    def recent_problem(self) -> str:
        """Reason why messages were rejected, or note that the device time is missing; "" if there is no problem."""
        if self._time_missing:
            return 'messages contain no TimeStartup: enable it in the sensor, or set clock = "arrival"'
        return super().recent_problem

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        n = len(frames.data)
        values = np.full((n, 6), np.nan)
        temperature_c: Floats | None = None
        ticks = np.full(n, NO_TICK, np.int64)
        for header, rows in base.group_indices([f[1 : HEADER_END[f[1]]] for f in frames.data]):
            layout = build_message_dtype(header, self._compensated)
            assert layout is not None, "the buffer accepts only messages with a known layout"
            messages, at = frames.stack_records(rows, layout), base.index_of_rows(rows, n)
            fields = layout.names or ()
            self._reads_compensated_gyro = _contains_compensated_gyro(header, self._compensated)
            with np.errstate(invalid="ignore"):  # converting a signalling NaN causes a warning
                if "gyro" in fields:
                    values[at, :3] = base.nan_to_infinity(messages["gyro"])
                if "accel" in fields:
                    values[at, 3:] = base.nan_to_infinity(messages["accel"])
                if "temperature" in fields:
                    temperature_c = np.full(n, np.nan) if temperature_c is None else temperature_c
                    temperature_c[at] = messages["temperature"]
            if "time" in fields and self._uses_device_time:
                ticks[at] = messages["time"] & TICK_BITS
        blocks, last = self._build_measured_blocks(frames, values, temperature_c, ticks)
        if last is not None:
            self._time_missing = self._uses_device_time and int(ticks[last]) == NO_TICK
        return blocks

    def _match_message(self, buffer: bytes, at: int) -> int:
        have = len(buffer) - at
        if have < 2:
            return base.NEED_MORE
        header_end = HEADER_END[buffer[at + 1]]
        if not header_end:
            return base.REJECT
        if have < header_end:
            return base.NEED_MORE
        layout = build_message_dtype(buffer[at + 1 : at + header_end], self._compensated)
        if layout is None:
            return base.REJECT
        length = layout.itemsize
        if have < length:
            return base.NEED_MORE
        return base.REJECT if binascii.crc_hqx(buffer[at + 1 : at + length], 0) else length

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode samples with the fields TimeStartup and Imu of group 1.

        MagPres is added if the samples have temperatures.
        """
        has_temperature = bool(np.isfinite(samples.temperature_c).any())
        header = bytes.fromhex("01 01 06" if has_temperature else "01 01 02")
        layout = build_message_dtype(header, prefer_compensated=False)
        assert layout is not None, "this header is in the tables"
        rows = np.zeros(len(samples), layout)
        rows["time"] = samples.ticks & (TICKS - 1)
        rows["gyro"], rows["accel"] = samples.values[:, :3], samples.values[:, 3:]
        if has_temperature:
            rows["temperature"] = samples.temperature_c
        inner = [header + row.tobytes()[1 + len(header) : -2] for row in rows]
        frames = [b"\xfa" + part + binascii.crc_hqx(part, 0).to_bytes(2, "big") for part in inner]
        return base.make_chunks(frames, samples.t_ns)


def build(settings: Settings) -> base.Decoder:
    """Return a decoder of VectorNav binary messages with the given settings."""
    return VectornavBinaryDecoder(settings)
