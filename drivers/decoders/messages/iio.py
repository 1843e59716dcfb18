"""Decoder of the scans that the link ``iio`` reads from a Linux IIO device.

Each message contains one or more complete scans, and its attachment contains their layout
(``drivers.host.iio_scan_layout``). The kernel reports angular rates in rad/s, accelerations in m/s² and temperatures in
m°C. Other channels are ignored, and an axis without a channel is not measured.

The time of a sample is the time stamp of the kernel. The time stamps must be on the clock ``realtime``, which is the
default of the kernel. With ``clock = "arrival"``, sample times are computed from the arrival times, and the buffer
needs no time stamps.
"""

import struct
from collections.abc import Sequence
from typing import ClassVar, Final, Literal

import numpy as np
from pydantic import Field

from drivers.data_types import (
    AXES,
    NS_PER_S,
    ArrivalTimedFormat,
    Chunk,
    Floats,
    Ints,
    SampleBlock,
    SenderTimedFormat,
    Timing,
)
from drivers.decoders.base import Bytes, Decoder, RejectingDecoder, quantize
from drivers.errors import DecodeError
from drivers.host.iio_scan_layout import TIMESTAMP, ScanElement, ScanLayout, StoredNumber, decode_layout, locate_numbers
from drivers.recordings.table import T_LIMIT_S
from drivers.validation.settings_model import SettingsModel

AXIS_CHANNELS: Final = tuple(f"in_{'anglvel' if axis[0] == 'g' else 'accel'}_{axis[1]}" for axis in AXES)
TEMPERATURE_CHANNELS: Final = ("in_temp", "in_temp0")
CELSIUS_PER_UNIT: Final = 1e-3
"""Unit of temperatures in °C (m°C)."""
CLOCK: Final = "realtime"
"""Name of the Unix clock in the sysfs attribute ``current_timestamp_clock``."""
ENCODED_SCALES: Final = (1e-6, 1e-6, 1e-6, 1e-5, 1e-5, 1e-5)
"""Size of one bit of each axis in encoded scans, in rad/s and m/s²."""
ENCODED_TEMPERATURE_SCALE: Final = 10.0
"""Size of one bit of the temperature in encoded scans, in m°C."""
ENCODED_LAYOUT: Final = ScanLayout(
    CLOCK,
    [
        *(ScanElement(name, "be:s32/32>>0", scale) for name, scale in zip(AXIS_CHANNELS, ENCODED_SCALES, strict=True)),
        ScanElement("in_temp0", "be:s16/16>>0", ENCODED_TEMPERATURE_SCALE),
        ScanElement(TIMESTAMP, "le:s64/64>>0"),
    ],
)
"""Layout of encoded scans, which is the layout of an ADIS16475."""


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]`` for an IIO device."""

    clock: Literal["timestamp", "arrival"] = Field(
        "timestamp", description="sample times: the time stamps of the kernel, or computed from the arrival times"
    )


class IioDecoder(RejectingDecoder):
    """Decoder and encoder of IIO scans."""

    carrier: ClassVar[str] = "messages"

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        self._uses_timestamps = settings.clock == "timestamp"
        self.timing: Timing = SenderTimedFormat() if self._uses_timestamps else ArrivalTimedFormat()
        self._attachment = b""  # attachment that describes the layout
        self._elements: list[tuple[ScanElement, StoredNumber]] = []
        self._scan_bytes = 0

    def forget_stream_state(self) -> None:
        """Do not count samples that were rejected before the link was reopened as missing."""
        self._builder.forget_missing_samples()

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Return one sample per scan."""
        parts: list[tuple[Ints, Floats, Floats]] = []
        bad_before: list[Ints] = []
        rejected = 0
        for chunk in chunks:
            try:
                part = self._decode_scans(chunk)
            except DecodeError as error:
                self._rejection.note_rejection(str(error))
                rejected += 1
                continue
            self._rejection.add_good_frames(part[0].size)
            parts.append(part)
            bad_before.append(np.zeros(part[0].size, np.int64))
            bad_before[-1][0] = rejected
            rejected = 0
        if not parts:
            return self._builder.build_plausible_blocks(np.empty(0, np.int64), np.empty((0, 6)), bad_after=rejected)
        t_ns, values, temperature_c = (np.concatenate(column) for column in zip(*parts, strict=True))
        return self._builder.build_plausible_blocks(
            t_ns, values, temperature_c, bad_before=np.concatenate(bad_before), bad_after=rejected
        )

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Return one scan per sample. The time stamp is ``t_ns``."""
        attachment = ENCODED_LAYOUT.encode()
        axes = np.column_stack([quantize(samples.values[:, i], ENCODED_SCALES[i], 32) for i in range(len(AXES))])
        temperature = quantize(samples.temperature_c, ENCODED_TEMPERATURE_SCALE * CELSIUS_PER_UNIT, 16)
        return [
            Chunk(struct.pack(">6ih6x", *row, degrees) + struct.pack("<q", t_ns), t_ns, attachment=attachment)
            for row, degrees, t_ns in zip(axes.tolist(), temperature.tolist(), samples.t_ns.tolist(), strict=True)
        ]

    def _decode_scans(self, chunk: Chunk) -> tuple[Ints, Floats, Floats]:
        """Return the times [n], the values [n, 6] and the temperatures [n] of a message.

        Raise ``DecodeError`` if the layout is invalid or does not fit the number of bytes.
        """
        if chunk.attachment != self._attachment or not self._attachment:
            self._read_layout(chunk.attachment)
        count, rest = divmod(len(chunk.data), self._scan_bytes)
        if rest or not count:
            raise DecodeError(f"{len(chunk.data)} bytes are not a whole number of scans of {self._scan_bytes} bytes")
        scans = np.frombuffer(chunk.data, np.uint8).reshape(count, self._scan_bytes)
        t_ns = np.full(count, chunk.t_ns, np.int64)
        values, temperature_c = np.full((count, len(AXES)), np.nan), np.full(count, np.nan)
        for element, number in self._elements:
            raw = _extract_numbers(scans, number)
            if element.channel == TIMESTAMP:
                t_ns = _check_times(raw)
                continue
            value = (raw + element.offset) * element.scale
            if element.channel in AXIS_CHANNELS:
                values[:, AXIS_CHANNELS.index(element.channel)] = value
            else:
                temperature_c = value * CELSIUS_PER_UNIT
        return t_ns, values, temperature_c

    def _read_layout(self, attachment: bytes) -> None:
        """Read the layout of the scans. Raise ``DecodeError`` if the layout is invalid or has no usable time stamps."""
        self._attachment = b""
        layout = decode_layout(attachment)
        numbers, self._scan_bytes = locate_numbers(layout.elements)
        if self._uses_timestamps and TIMESTAMP not in numbers:
            raise DecodeError('the buffer has no in_timestamp: enable this channel, or set clock = "arrival"')
        if self._uses_timestamps and layout.clock != CLOCK:
            raise DecodeError(
                f"the time stamps are on the clock {layout.clock}: write {CLOCK} to current_timestamp_clock, "
                'or set clock = "arrival"'
            )
        used = (*AXIS_CHANNELS, *TEMPERATURE_CHANNELS, *((TIMESTAMP,) if self._uses_timestamps else ()))
        self._elements = [(one, numbers[one.channel]) for one in layout.elements if one.channel in used]
        self._attachment = attachment


def _extract_numbers(scans: Bytes, number: StoredNumber) -> Ints:
    """Return one number [n] of each scan [n, size]."""
    stored = np.ascontiguousarray(scans[:, number.offset : number.offset + number.size])
    raw = stored.view(f"{number.byte_order}u{number.size}")[:, 0].astype(np.uint64) >> np.uint64(number.shift)
    if number.bits == 64:
        return raw.view(np.int64)
    integers: Ints = (raw & np.uint64((1 << number.bits) - 1)).astype(np.int64)
    sign = 1 << (number.bits - 1) if number.signed else 0
    return (integers ^ sign) - sign


def _check_times(t_ns: Ints) -> Ints:
    """Return the times [n]. Raise ``DecodeError`` if a time is not a plausible Unix time."""
    if t_ns.min() < 0 or t_ns.max() >= T_LIMIT_S * NS_PER_S:
        raise DecodeError("a time stamp of the kernel is no Unix time")
    return t_ns


def build(settings: Settings) -> Decoder:
    """Return a decoder of IIO scans."""
    return IioDecoder(settings)
