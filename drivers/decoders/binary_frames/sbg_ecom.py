"""SBG Systems sensors with the sbgECom protocol, such as Ellipse, Ekinox and Pulse, over UART.

The format is ``FF 5A | message u8 | class u8 | length u16 | data | CRC u16 | 33``, little-endian. The CRC-16 has the
polynomial 0x1021 and the initial value 0, and is reflected (CRC-16/KERMIT). The CRC covers the bytes from the message
identifier to the end of the data. Sources: SBG Systems, sbgECom 5.2, pages "Binary protocol" and "Log messages", and
the C library sbgECom. The decoder of ArduPilot uses the same layout and scales.

Two messages of class 0 contain samples, and both begin with ``time stamp u32 [µs] | status u16``.

- ``imu_short`` (message 44): ``acceleration 3 x i32 | rate 3 x i32 | temperature i16``. The scales are 1048576 LSB for
  1 m/s², 67108864 LSB for 1 rad/s and 256 LSB for 1 °C. If bit 10 of the status is set, the scale of the rates is
  12304174 LSB for 1 rad/s. The C library calls the fields delta velocity and delta angle. The manual and the library
  divide the fields by these scales but not by a duration, so the fields are already accelerations and rates.
- ``imu_data`` (message 3): ``acceleration 3 x f32 | rate 3 x f32 | temperature f32 | the same six values again``. The C
  library states that most products extrapolate these values to the time of the navigation filter. The extrapolation
  adds noise, so ``imu_short`` is recommended.

All other messages are ignored. Both messages contain values that the navigation filter has not corrected. Bits 0 to 9
of the status are 1 if the communication and all self-tests have passed and all values are in range. A sample is bad if
one of these bits is 0.
"""

import binascii
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.data_types import Chunk, CounterTimedFormat, Floats, SampleBlock, Timing
from drivers.decoders import base
from drivers.validation.settings_model import SettingsModel

SYNC: Final = b"\xff\x5a"
END: Final = 0x33
MAX_PAYLOAD: Final = 4086
LONGEST: Final = 6 + MAX_PAYLOAD + 3
LARGE_FRAME: Final = 0x80
"""Bit of the class that marks a part of a large frame. Only answers to commands are sent in large frames."""

Message = Literal["imu_short", "imu_data"]


def _message_layout(number: str, temperature: str, length: int) -> np.dtype[np.void]:
    """Return the structured dtype of a complete frame with ``length`` bytes of data."""
    fields = {
        "header": ("<u2", 2),
        "length": ("<u2", 4),
        "time": ("<u4", 6),
        "status": ("<u2", 10),
        "accel": (f"<3{number}", 12),
        "gyro": (f"<3{number}", 24),
        "temperature": (f"<{temperature}", 36),
    }
    formats, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": length + 9})


HEADERS: Final[dict[Message, bytes]] = {"imu_short": b"\x2c\x00", "imu_data": b"\x03\x00"}
"""Message identifier and class of each message with samples."""
LAYOUTS: Final[dict[Message, np.dtype[np.void]]] = {
    "imu_short": _message_layout("i4", "i2", 32),
    "imu_data": _message_layout("f4", "f4", 58),
}
LENGTHS: Final = {HEADERS[message]: layout.itemsize - 9 for message, layout in LAYOUTS.items()}
"""Length of the data in bytes for each message with samples."""

ACCEL_SCALE: Final = 1048576.0
"""Number of LSB for 1 m/s²."""
GYRO_SCALE, HIGH_RANGE_GYRO_SCALE = 67108864.0, 12304174.0
"""Number of LSB for 1 rad/s."""
TEMPERATURE_SCALE: Final = 256.0
"""Number of LSB for 1 °C."""
VALID: Final = 0x3FF
"""Status bits that are 1 if the IMU is working correctly."""
SELF_TEST_BITS: Final = np.array([1 << 5, 1 << 6, 1 << 7, 1 << 2, 1 << 3, 1 << 4])
"""Status bit of the self-test of each axis [6] in the order of ``AXES``."""
HIGH_RANGE: Final = 1 << 10
"""Status bit that selects the second scale of the rates."""


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]``."""

    message: Message = Field("imu_short", description="message with the samples; imu_data contains extrapolated values")


class SbgEcomDecoder(base.FrameStreamDecoder):
    """Decoder and encoder of sbgECom frames."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(SYNC, _match_frame, LONGEST)
        self._message = settings.message
        self._header = HEADERS[settings.message]
        self._layout = LAYOUTS[settings.message]
        self.timing: Timing = CounterTimedFormat(1 << 32, 1e-6)
        self._failed_bits = 0

    @property
    def recent_problem(self) -> str:
        """Status of the sensor, or reason why frames were rejected; "" if there is no problem."""
        if self._lacks_samples:
            return f"frames arrive, but none with {self._message}: enable this message in the sensor"
        if self._failed_bits:
            return f"the sensor reports an error: the status bits 0x{self._failed_bits:03X} are 0"
        return super().recent_problem

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        n = len(frames.data)
        values = np.full((n, 6), np.nan)
        temperature_c = np.full(n, np.nan)
        ticks = np.zeros(n, np.int64)
        rows = np.array([i for i, frame in enumerate(frames.data) if frame[2:4] == self._header], np.int64)
        if rows.size:
            messages = frames.stack_records(rows, self._layout)
            values[rows], temperature_c[rows] = self._read_measurements(messages)
            ticks[rows] = messages["time"]
            self._failed_bits = ~int(messages["status"][-1]) & VALID
        return self._build_measured_blocks(frames, values, temperature_c, ticks)[0]

    def _read_measurements(self, messages: NDArray[np.void]) -> tuple[Floats, Floats]:
        """Return the values [n, 6] and the temperatures [n] in °C. Values with a sensor error are infinite."""
        status = messages["status"]
        if self._message == "imu_short":
            scale = np.where(status & HIGH_RANGE, HIGH_RANGE_GYRO_SCALE, GYRO_SCALE)[:, None]
            values = np.hstack([messages["gyro"] / scale, messages["accel"] / ACCEL_SCALE])
            temperature_c = messages["temperature"] / TEMPERATURE_SCALE
        else:
            with np.errstate(invalid="ignore"):  # converting a signalling NaN causes a warning
                values = base.nan_to_infinity(np.hstack([messages["gyro"], messages["accel"]]).astype(np.float64))
                temperature_c = messages["temperature"].astype(np.float64)
        values[status & VALID != VALID] = np.inf
        return values, temperature_c

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode samples in the configured message. The status reports a failed self-test if an axis is not measured.

        The second scale of the rates is used if a rate exceeds the range of the first scale.
        """
        gyro, accel = samples.values[:, :3], samples.values[:, 3:]
        rows = np.zeros(len(samples), self._layout)
        rows["header"] = int.from_bytes(self._header, "little")
        rows["length"] = LENGTHS[self._header]
        rows["time"] = samples.ticks & 0xFFFFFFFF
        rows["status"] = VALID & ~(np.isnan(samples.values) @ SELF_TEST_BITS)
        if self._message == "imu_short":
            high = (np.abs(gyro) > 2**31 / GYRO_SCALE).any(axis=1)
            rows["status"][high] |= HIGH_RANGE
            scale = np.where(high, HIGH_RANGE_GYRO_SCALE, GYRO_SCALE)[:, None]
            rows["gyro"] = base.quantize(gyro * scale, 1.0, 32)
            rows["accel"] = base.quantize(accel, 1 / ACCEL_SCALE, 32)
            rows["temperature"] = base.quantize(samples.temperature_c, 1 / TEMPERATURE_SCALE, 16)
        else:
            rows["gyro"], rows["accel"], rows["temperature"] = gyro, accel, samples.temperature_c
        return base.make_chunks([encode_frame(row.tobytes()[2:-3]) for row in rows], samples.t_ns)


def encode_frame(content: bytes) -> bytes:
    """Build a frame from its bytes between the start of the message identifier and the end of the data."""
    return SYNC + content + frame_crc(content) + bytes([END])


def frame_crc(content: bytes) -> bytes:
    """Return the two CRC bytes for the bytes from the message identifier to the end of the data."""
    return binascii.crc_hqx(content.translate(base.BIT_REVERSAL), 0).to_bytes(2, "big").translate(base.BIT_REVERSAL)


def _match_frame(buffer: bytes, at: int) -> int:
    if len(buffer) < at + 6:
        return base.NEED_MORE
    length = int.from_bytes(buffer[at + 4 : at + 6], "little")
    if length != LENGTHS.get(buffer[at + 2 : at + 4], length) or length > MAX_PAYLOAD or buffer[at + 3] & LARGE_FRAME:
        return base.REJECT
    end = at + 6 + length
    if len(buffer) < end + 3:
        return base.NEED_MORE
    is_valid = buffer[end + 2] == END and frame_crc(buffer[at + 2 : end]) == buffer[end : end + 2]
    return end + 3 - at if is_valid else base.REJECT


def build(settings: Settings) -> base.Decoder:
    """Return a decoder of sbgECom frames with the given settings."""
    return SbgEcomDecoder(settings)
