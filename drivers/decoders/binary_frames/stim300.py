"""Sensonor STIM300 normal-mode datagrams over RS-422.

The format is big-endian without a sync word: ``id | gyro 3 x i24, status | [acceleration 3 x i24, status] |
[inclinometer ...] | [temperature 3 x i16, status of each included sensor] | [aux or PPS i24, status] | counter u8 |
latency u16 | CRC u32``, then CR LF if the line end is enabled. The identifier states which parts follow. The CRC-32 has
the polynomial 0x04C11DB7 and the initial value 0xFFFFFFFF, and is not reflected. The CRC covers all preceding bytes,
padded with zeros to a multiple of four bytes. Sources: vortexntnu/stim300-driver, the frame published in
geirhovland/stim300, and tables 5-21 to 5-23 of the data sheet TS1524 as quoted in public drivers.

The datagram contains neither the range of the accelerometer nor the output units, so the range and the units must be
configured. An "increment" is the change of angle or velocity during one sample. The sample rate converts an increment
to an angular rate or an acceleration. Integrated outputs are not supported. The decoder assumes that the counter
advances at the internal sampling rate of 2000 Hz, which is 4 counts per sample at 500 Hz. The counter rate has not been
tested with a device.

The gyroscopes and the accelerometers have a status byte. A sample is bad if a status byte reports a system integrity
error (bit 7), start-up (bit 6), overload (bit 4) or a channel error (bit 3). Bit 5 reports operation outside the
specified conditions, for example in a climate chamber. A sample with only bit 5 set is accepted, because the sensor
still measures. The temperature is the mean of the three temperature sensors of the gyroscopes. The temperature is
marked as not measured if the status byte of the temperature sensors reports an error.
"""

import zlib
from collections.abc import Iterator
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field

from drivers.data_types import Chunk, CounterTimedFormat, Floats, Ints, SampleBlock, Timing
from drivers.decoders import base
from drivers.errors import ConfigError
from drivers.units import DEGREE, G0
from drivers.validation.number_ranges import RATE_HZ
from drivers.validation.settings_model import Conflict, KeywordOrType, SettingsModel, checked_by

ACCEL_PART, INCL_PART, TEMPERATURE_PART, AUX_PART = 1, 2, 4, 8
# The index of an identifier in its list is the bit mask of the parts. The datagrams F0 to F7 contain PPS (pulse per
# second) instead of the auxiliary input. Hardware up to revision C sends 97 in place of A7.
IDENTIFIERS: Final = {
    **dict(zip((0x90, 0x91, 0x92, 0x93, 0x94, 0xA5, 0xA6, 0xA7), range(8), strict=True)),
    **dict(zip((0x98, 0x99, 0x9A, 0x9B, 0x9C, 0xAD, 0xAE, 0xAF), range(8, 16), strict=True)),
    **dict(zip(range(0xF0, 0xF8), range(8, 16), strict=True)),
    0x97: 7,
}
"""Bit mask of the parts that follow the gyroscope part, for each datagram identifier."""


def _datagram_size(parts: int) -> int:
    """Return the length in bytes of a datagram with these parts, including the CRC but not CR LF."""
    sensors = 1 + (parts & (ACCEL_PART | INCL_PART)).bit_count()
    temperatures = sensors if parts & TEMPERATURE_PART else 0
    return 1 + 10 * sensors + 7 * temperatures + (4 if parts & AUX_PART else 0) + 1 + 2 + 4


SIZES: Final = {identifier: _datagram_size(parts) for identifier, parts in IDENTIFIERS.items()}
"""Length in bytes of the datagram with each identifier, including the CRC but not CR LF."""
LONGEST: Final = max(SIZES.values())

ACCEL_BITS: Final = {"2g": 21, "5g": 20, "10g": 19, "30g": 18, "80g": 16}
"""Exponent of the resolution for each accelerometer range.

The least significant bit is 2**-bits g for an acceleration, and 2**-(bits + 3) m/s for an increment.
"""
ERROR_BITS: Final = 0x80 | 0x40 | 0x10 | 0x08
START_UP: Final = 0x40
CHANNEL_ERROR: Final = 0x08


def _check_identifier(identifier: int) -> None:
    if identifier not in IDENTIFIERS:
        known = ", ".join(f"0x{one:02X}" for one in sorted(IDENTIFIERS))
        raise ConfigError(f"{identifier}; possible are {known}")


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]``."""

    accelerometer_range: Literal["2g", "5g", "10g", "30g", "80g"] = Field(
        "10g", description="range of the installed accelerometers, which determines the scale"
    )
    gyro_output: Literal["rate", "increment"] = Field(
        "rate", description="rate: angular rate or its mean in °/s; increment: angle of one sample in °"
    )
    accelerometer_output: Literal["acceleration", "increment"] = Field(
        "acceleration",
        description="acceleration: acceleration or its mean in g; increment: velocity of one sample in m/s",
    )
    rate: Annotated[float, RATE_HZ] | None = Field(
        None, examples=[500.0], description="sample rate in Hz, which is needed if an output is an increment"
    )
    identifier: Annotated[
        int | Literal["auto"], KeywordOrType({"auto": "auto"}, Annotated[int, checked_by(_check_identifier)])
    ] = Field("auto", description="first byte of the datagrams, such as 0x93; auto: as in the first datagram")
    crlf: bool = Field(False, description="true: a simulated sensor ends datagrams with CR LF; both can be read")

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        """Yield a conflict if an output is an increment and the sample rate is missing."""
        if "increment" in (self.gyro_output, self.accelerometer_output) and self.rate is None:
            yield Conflict("rate", 'missing; an output of "increment" needs the sample rate in Hz')


class Stim300Decoder(base.FrameStreamDecoder):
    """Decoder and encoder of STIM300 datagrams."""

    def __init__(self, settings: Settings) -> None:
        wanted = b"" if settings.identifier == "auto" else bytes([settings.identifier])
        super().__init__(wanted, self._match_datagram, LONGEST, bytes(SIZES))
        self._settings = settings
        self.timing: Timing = CounterTimedFormat(256, 1.0 / 2000.0)
        rate = settings.rate or 1.0
        self._gyro_step = DEGREE * (rate / 2**21 if settings.gyro_output == "increment" else 1 / 2**14)
        bits = ACCEL_BITS[settings.accelerometer_range]
        increment = settings.accelerometer_output == "increment"
        self._accel_step = rate / 2 ** (bits + 3) if increment else G0 / 2**bits
        self._status = 0

    @property
    def recent_problem(self) -> str:
        """Error reported by the sensor, or reason for rejected datagrams; "" if there is no problem."""
        if self._status & START_UP:
            return "the sensor is starting up"
        if self._status:
            return f"the sensor reports an error: status 0x{self._status:02X}"
        return super().recent_problem

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        n = len(frames.data)
        values = np.full((n, 6), np.nan)
        temperature_c = np.full(n, np.nan)
        ticks = np.empty(n, np.int64)
        for identifier, rows in base.group_indices([frame[0] for frame in frames.data]):
            data = frames.stack_frames(rows)
            values[rows], temperature_c[rows] = self._read_measurements(data, IDENTIFIERS[identifier])
            ticks[rows] = data[:, -7]
        return self._builder.build_plausible_blocks(frames.t_ns, values, temperature_c, ticks, frames.bad_before)

    def _read_measurements(self, data: base.Bytes, parts: int) -> tuple[Floats, Floats]:
        """Return the values [n, 6] and the temperatures [n] in °C. Values with a sensor error are infinite."""
        values = np.full((len(data), 6), np.nan)
        values[:, :3] = _read_int24(data, 1) * self._gyro_step
        status = data[:, 10]
        if parts & ACCEL_PART:
            values[:, 3:] = _read_int24(data, 11) * self._accel_step
            status = status | data[:, 20]
        values[status & ERROR_BITS != 0] = np.inf
        self._status = int(status[-1]) & ERROR_BITS
        temperature_c = np.full(len(data), np.nan)
        if parts & TEMPERATURE_PART:
            at = _temperature_offset(parts)
            mean = np.ascontiguousarray(data[:, at : at + 6]).view(">i2").mean(axis=1) / 2**8
            temperature_c = np.where(data[:, at + 6] & ERROR_BITS, np.nan, mean)
        return values, temperature_c

    def _match_datagram(self, buffer: bytes, at: int) -> int:
        if at >= len(buffer):
            return base.NEED_MORE
        length = SIZES.get(buffer[at])
        if length is None:
            return base.REJECT
        if len(buffer) < at + length:
            return base.NEED_MORE
        if not has_valid_crc(buffer[at : at + length]):
            return base.REJECT
        self._buffer.sync = buffer[at : at + 1]
        return length

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Return datagrams with the configured identifier.

        If the identifier is "auto", the datagrams contain rates and accelerations. Temperatures are included if
        ``samples`` contains any. The status byte reports a channel error if an axis is not measured.
        """
        identifier = self._settings.identifier
        if identifier == "auto":
            identifier = 0xA5 if np.isfinite(samples.temperature_c).any() else 0x91
        parts = IDENTIFIERS[identifier]
        data = np.zeros((len(samples), SIZES[identifier] - 4), np.uint8)
        data[:, 0] = identifier
        _write_int24(data, 1, samples.values[:, :3], self._gyro_step)
        if parts & ACCEL_PART:
            _write_int24(data, 11, samples.values[:, 3:], self._accel_step)
        if parts & TEMPERATURE_PART:
            at = _temperature_offset(parts)
            raw = base.quantize(samples.temperature_c, 2**-8, 16).astype(">i2")
            data[:, at : at + 6] = np.repeat(raw[:, None], 3, axis=1).view(np.uint8)
            data[:, at + 6] = np.where(np.isnan(samples.temperature_c), CHANNEL_ERROR, 0)
        data[:, -3] = samples.ticks & 0xFF
        tail = b"\r\n" if self._settings.crlf else b""
        return base.make_chunks([row + datagram_crc(row) + tail for row in map(bytes, data)], samples.t_ns)


def _temperature_offset(parts: int) -> int:
    return 1 + 10 * (1 + (parts & (ACCEL_PART | INCL_PART)).bit_count())


def _read_int24(data: base.Bytes, at: int) -> Ints:
    """Return the three signed 24-bit big-endian integers [n, 3] at an offset of each datagram."""
    wide = np.zeros((len(data), 3, 4), np.uint8)
    wide[:, :, :3] = data[:, at : at + 9].reshape(-1, 3, 3)
    raised: Ints = wide.view(">i4")[:, :, 0].astype(np.int64) >> 8
    return raised


def _write_int24(data: base.Bytes, at: int, values: Floats, step: float) -> None:
    """Write three values [n, 3] and a status byte at the offset ``at`` of each datagram."""
    raw = base.quantize(values, step, 24).astype(">i4").reshape(-1, 3, 1).view(np.uint8)
    data[:, at : at + 9] = raw[:, :, 1:].reshape(-1, 9)
    data[:, at + 9] = np.where(np.isnan(values).any(axis=1), CHANNEL_ERROR, 0)


def datagram_crc(body: bytes) -> bytes:
    """Return the four CRC bytes of a datagram."""
    return _reflected_crc(body.translate(base.BIT_REVERSAL)).to_bytes(4, "little").translate(base.BIT_REVERSAL)


def has_valid_crc(frame: bytes) -> bool:
    """Return True if the CRC of a complete datagram is correct."""
    mirrored = frame.translate(base.BIT_REVERSAL)
    return _reflected_crc(mirrored[:-4]) == int.from_bytes(mirrored[-4:], "little")


def _reflected_crc(mirrored: bytes) -> int:
    """Return the reflected CRC of a datagram whose bytes have been bit-reversed."""
    # Reversing the bits does not change the padding, which consists of zeros.
    return zlib.crc32(bytes(-len(mirrored) % 4), zlib.crc32(mirrored)) ^ 0xFFFFFFFF


def build(settings: Settings) -> base.Decoder:
    """Return a STIM300 decoder with the given settings."""
    return Stim300Decoder(settings)
