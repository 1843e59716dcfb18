"""Sensonor STIM300 normal-mode datagrams over RS-422.

The format is big-endian without a sync word: ``id | gyro 3 x i24, status | [acceleration 3 x i24, status] |
[inclinometer ...] | [temperature 3 x i16, status of each included sensor] | [aux or PPS i24, status] | counter u8 |
latency u16 | CRC u32``, then CR LF if that is enabled. The identifier states which parts follow. The CRC-32 has the
polynomial 0x04C11DB7 and the initial value 0xFFFFFFFF, and is not reflected. It covers all bytes before it, padded with
zeros to a multiple of four bytes. Sources: vortexntnu/stim300-driver, the frame published in geirhovland/stim300, and
data sheet TS1524 tables 5-21 to 5-23 as restated by public drivers.

The datagram contains neither the range of the accelerometer nor the output units, so both must be configured. An
"increment" is the change of angle or velocity during one sample. ``rate`` is needed to convert an increment to a rate.
Integrated outputs are not supported. The counter runs with the internal 2000 Hz sampling. This has not been confirmed
on a device. The counter would then step by 4 at 500 Hz.

The status byte of gyro and accelerometer marks a sample as bad if it reports a system integrity error (bit 7), start-up
(6), overload (4) or a channel error (3). The values of such a sample are wrong or unsettled. A sample outside the
operating conditions (5) is accepted, because the sensor still measures, for example in a climate chamber beyond the
stated range. The temperature is the mean of the three sensors of the gyro. If the status of these sensors shows an
error, the temperature is not measured.
"""

import zlib
from collections.abc import Iterator
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field

from drivers.decoders.base import (
    NEED_MORE,
    REJECT,
    Bytes,
    Decoder,
    DecoderSettings,
    FrameBuffer,
    Frames,
    FrameStreamDecoder,
    chunk_per_sample,
    group_indices,
    quantize,
)
from drivers.errors import ConfigError
from drivers.number_ranges import RATE_HZ
from drivers.sample import Chunk, CounterTimedFormat, Floats, Ints, SampleBlock, Timing
from drivers.settings_model import Conflict, WordOr, checked_by
from drivers.units import DEGREE, G0

ACCEL_PART, INCL_PART, TEMPERATURE_PART, AUX_PART = 1, 2, 4, 8
# The order is that of the part bits. F0 to F7 contain PPS instead of aux. 97 is A7 of hardware up to revision C.
IDENTIFIERS: Final = {
    **dict(zip((0x90, 0x91, 0x92, 0x93, 0x94, 0xA5, 0xA6, 0xA7), range(8), strict=True)),
    **dict(zip((0x98, 0x99, 0x9A, 0x9B, 0x9C, 0xAD, 0xAE, 0xAF), range(8, 16), strict=True)),
    **dict(zip(range(0xF0, 0xF8), range(8, 16), strict=True)),
    0x97: 7,
}
"""Bit mask of the parts in addition to the gyro, by identifier."""


def _datagram_size(parts: int) -> int:
    """Return the length of a datagram with these parts in bytes, with CRC but without CR LF."""
    sensors = 1 + (parts & (ACCEL_PART | INCL_PART)).bit_count()
    temperatures = sensors if parts & TEMPERATURE_PART else 0
    return 1 + 10 * sensors + 7 * temperatures + (4 if parts & AUX_PART else 0) + 1 + 2 + 4


SIZES: Final = {identifier: _datagram_size(parts) for identifier, parts in IDENTIFIERS.items()}
"""Length of a datagram in bytes by identifier, with CRC but without CR LF."""
LONGEST: Final = max(SIZES.values())

ACCEL_BITS: Final = {"2g": 21, "5g": 20, "10g": 19, "30g": 18, "80g": 16}
"""Exponent of the resolution by accelerometer range. The least significant bit is 2**-bits g.

The least significant bit of an increment is 2**-(bits + 3) m/s.
"""
ERROR_BITS: Final = 0x80 | 0x40 | 0x10 | 0x08
START_UP: Final = 0x40
CHANNEL_ERROR: Final = 0x08

_BITS = np.arange(256, dtype=np.uint8)[:, None] >> np.arange(8, dtype=np.uint8) & 1
BIT_REVERSAL: Final = np.packbits(_BITS, axis=1).tobytes()
"""Each byte with its bits in reverse order, for conversions between the CRC and the reflected CRC of zlib."""


def _check_identifier(identifier: int) -> None:
    """Raise ConfigError if no datagram begins with this byte."""
    if identifier not in IDENTIFIERS:
        known = ", ".join(f"0x{one:02X}" for one in sorted(IDENTIFIERS))
        raise ConfigError(f"{identifier}; possible are {known}")


class Settings(DecoderSettings):
    """Keys of ``[device.driver.decoder_options]``."""

    accelerometer_range: Literal["2g", "5g", "10g", "30g", "80g"] = Field(
        "10g", description="range of the installed accelerometers, which determines the scale"
    )
    gyro_output: Literal["rate", "increment"] = Field(
        "rate", description="angular rate or its mean in °/s, or the angle of one sample in °"
    )
    accelerometer_output: Literal["acceleration", "increment"] = Field(
        "acceleration", description="acceleration or its mean in g, or the velocity of one sample in m/s"
    )
    rate: Annotated[float, RATE_HZ] | None = Field(
        None, examples=[500.0], description="sample rate in Hz, which is needed if an output is an increment"
    )
    identifier: Annotated[
        int | Literal["auto"], WordOr({"auto": "auto"}, Annotated[int, checked_by(_check_identifier)])
    ] = Field("auto", description="first byte of the datagrams, such as 0x93; auto takes it from the first datagram")
    crlf: bool = Field(False, description="true: a simulated sensor ends datagrams with CR LF; both can be read")

    def find_conflicts(self) -> Iterator[Conflict]:
        """Yield a conflict if an increment cannot be converted to a rate."""
        if "increment" in (self.gyro_output, self.accelerometer_output) and self.rate is None:
            yield Conflict("rate", 'missing; an output of "increment" needs the sample rate in Hz')


class Stim300Decoder(FrameStreamDecoder):
    """Decoder and encoder of STIM300 datagrams."""

    def __init__(self, settings: Settings) -> None:
        wanted = b"" if settings.identifier == "auto" else bytes([settings.identifier])
        super().__init__(FrameBuffer(wanted, self._match_datagram, LONGEST))
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
        """Meaning of the status byte, or reason for rejected datagrams."""
        if self._status & START_UP:
            return "the sensor is starting up"
        if self._status:
            return f"the sensor reports an error: status 0x{self._status:02X}"
        return super().recent_problem

    def _decode(self, frames: Frames) -> list[SampleBlock]:
        """Return the samples of these datagrams. The sensor may have switched to another identifier among them."""
        n = len(frames.data)
        values = np.full((n, 6), np.nan)
        temperature_c = np.full(n, np.nan)
        ticks = np.empty(n, np.int64)
        for identifier, rows in group_indices([frame[0] for frame in frames.data]):
            data = frames.stack_bytes(rows)
            values[rows], temperature_c[rows] = self._read_measurements(data, IDENTIFIERS[identifier])
            ticks[rows] = data[:, -7]
        return self._builder.build_plausible_blocks(frames.t_ns, values, temperature_c, ticks, frames.bad_before)

    def _read_measurements(self, data: Bytes, parts: int) -> tuple[Floats, Floats]:
        """Return values [n, 6], infinite where the status byte shows an error, and temperatures [n] in °C."""
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
        """Return the length of a datagram (see ``drivers.decoders.base.FrameMatcher``)."""
        if at >= len(buffer):
            return NEED_MORE
        length = SIZES.get(buffer[at])
        if length is None:
            return REJECT
        if len(buffer) < at + length:
            return NEED_MORE
        if not has_valid_crc(buffer[at : at + length]):
            return REJECT
        self._buffer.sync = buffer[at : at + 1]
        return length

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Return datagrams with the configured identifier.

        With auto, they contain acceleration, and temperature if there is any. A row with an unmeasured axis has the
        channel error set.
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
            raw = quantize(samples.temperature_c, 2**-8, 16).astype(">i2")
            data[:, at : at + 6] = np.repeat(raw[:, None], 3, axis=1).view(np.uint8)
            data[:, at + 6] = np.where(np.isnan(samples.temperature_c), CHANNEL_ERROR, 0)
        data[:, -3] = samples.ticks & 0xFF
        tail = b"\r\n" if self._settings.crlf else b""
        return chunk_per_sample([row + datagram_crc(row) + tail for row in map(bytes, data)], samples.t_ns)


def _temperature_offset(parts: int) -> int:
    """Return the offset of the temperatures of the gyro."""
    return 1 + 10 * (1 + (parts & (ACCEL_PART | INCL_PART)).bit_count())


def _read_int24(data: Bytes, at: int) -> Ints:
    """Return three signed 24-bit big-endian integers [n, 3] of each datagram, beginning at the offset ``at``."""
    wide = np.zeros((len(data), 3, 4), np.uint8)
    wide[:, :, :3] = data[:, at : at + 9].reshape(-1, 3, 3)
    raised: Ints = wide.view(">i4")[:, :, 0].astype(np.int64) >> 8
    return raised


def _write_int24(data: Bytes, at: int, values: Floats, step: float) -> None:
    """Write three values and their status byte at the offset ``at`` of each datagram."""
    raw = quantize(values, step, 24).astype(">i4").reshape(-1, 3, 1).view(np.uint8)
    data[:, at : at + 9] = raw[:, :, 1:].reshape(-1, 9)
    data[:, at + 9] = np.where(np.isnan(values).any(axis=1), CHANNEL_ERROR, 0)


def datagram_crc(body: bytes) -> bytes:
    """Return the four CRC bytes of a datagram."""
    return _reflected_crc(body.translate(BIT_REVERSAL)).to_bytes(4, "little").translate(BIT_REVERSAL)


def has_valid_crc(frame: bytes) -> bool:
    """Return True if the CRC of a complete datagram is correct."""
    mirrored = frame.translate(BIT_REVERSAL)
    return _reflected_crc(mirrored[:-4]) == int.from_bytes(mirrored[-4:], "little")


def _reflected_crc(mirrored: bytes) -> int:
    """Return the CRC with reversed bits of a datagram whose bytes have reversed bits."""
    # reversed zeros are zeros, so the padding can be appended after the reversal
    return zlib.crc32(bytes(-len(mirrored) % 4), zlib.crc32(mirrored)) ^ 0xFFFFFFFF


def build(settings: Settings) -> Decoder:
    """Return a decoder with these settings."""
    return Stim300Decoder(settings)
