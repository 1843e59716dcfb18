"""NovAtel / Hexagon SPAN receivers (OEM7): binary logs RAWIMUSX and RAWIMUX.

The format is little-endian. RAWIMUSX (message 1462) usually has the short header ``AA 44 13 | length u8 | ID u16 |
week u16 | ms u32``, and RAWIMUX (message 1461) the long header ``AA 44 12 | header length u8 | ID u16 | ... | length
u16 | ...``. Both headers are accepted for both messages. The payload has 40 bytes: ``IMU info u8 | IMU type u8 | GPS
week u16 | seconds of the week float64 | IMU status u32 | acceleration Z, -Y, X i32 | rate Z, -Y, X i32``. The payload
is followed by a CRC-32 of all preceding bytes (reflected, polynomial 0x04C11DB7, initial value 0, no final inversion).
Other binary logs are ignored. The port must not send ASCII logs, because their bytes would be counted as lost logs.

The six numbers are changes of velocity and angle during one period of the IMU. The type of the IMU determines the scale
and the data rate. A number times both is an acceleration or an angular rate. If the type is not in the table, the keys
``accel_scale`` and ``gyro_scale`` are needed. Sources: NovAtel OEM7 manual (RAWIMUSX, Raw IMU Scale Factors), public
driver novatel/novatel_oem7_driver. The driver converts feet with the factor 3.2808 and the decoder with exactly 0.3048
m, a relative difference of 1e-5. Published logs of types 11, 32 and 41 at rest yield 9.79, 9.82 and 9.86 m/s².

A sample is bad if bit 0 (error) or bit 1 (encrypted data) of the IMU info is set. The meaning of the IMU status depends
on the type, so the status is not evaluated. The GPS week and seconds serve as the device clock, with a resolution of 1
µs.
"""

import struct
import zlib
from collections.abc import Iterator
from typing import Annotated, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.data_types import ArrivalTimedFormat, Chunk, CounterTimedFormat, Floats, Ints, SampleBlock, Timing
from drivers.decoders import base
from drivers.units import DEGREE, G0
from drivers.validation.number_ranges import SCALE, NumberRange
from drivers.validation.settings_model import Conflict, SettingsModel

SYNC: Final = b"\xaa\x44"
LONG_HEADER, SHORT_HEADER = 0x12, 0x13
LONG_HEADER_SIZE, SHORT_HEADER_SIZE = 28, 12  # bytes; a long header states its length and may be longer
MESSAGE_IDS: Final = (1462, 1461)
"""Message numbers of RAWIMUSX and RAWIMUX."""
PAYLOAD: Final = np.dtype(
    [
        ("info", "u1"),
        ("imu_type", "u1"),
        ("week", "<u2"),
        ("seconds", "<f8"),
        ("status", "<u4"),
        ("accel", "<i4", 3),
        ("gyro", "<i4", 3),
    ]
)
MAX_PAYLOAD: Final = 16_384
"""Maximum payload in bytes. The limit prevents a damaged length from blocking the stream."""
LONGEST: Final = 255 + MAX_PAYLOAD + 4
ERROR, ENCRYPTED = 0b01, 0b10  # bits of the IMU info
WEEK_S: Final = 604_800
TICKS_PER_S: Final = 1_000_000
WEEKS: Final = 1 << 16
AXIS_SIGNS: Final = np.array([1.0, -1.0, 1.0])
FOOT: Final = 0.3048

HG1700: Final = (2.0**-33 * 100.0, 2.0**-27 * FOOT * 100.0)
STIM300: Final = (2.0**-21 * DEGREE * 125.0, 2.0**-22 * 125.0)
G320: Final = (0.008 / 2**16 * DEGREE, 0.2e-3 / 2**16 * G0)
SCALES: Final = {
    5: HG1700,  # Honeywell HG1900 CA29
    11: HG1700,  # Honeywell HG1700 AG58
    20: HG1700,  # Honeywell HG1930 AA99
    27: HG1700,  # Honeywell HG1900 CA50
    28: HG1700,  # Honeywell HG1930 CA50
    31: (720.0 / 2**31 * DEGREE * 200.0, 200.0 / 2**31 * 200.0),  # Analog Devices ADIS16488
    32: STIM300,  # Sensonor STIM300
    41: G320,  # Epson G320, 125 Hz; its scale does not depend on the rate
    58: (2.0**-33 * 100.0, 2.0**-29 * 100.0),  # Honeywell HG4930 AN01
    61: (0.0151515 / 2**16 * DEGREE, 0.4e-3 / 2**16 * G0),  # Epson G370, 200 Hz
    62: G320,  # Epson G320, 200 Hz
    68: (2.0**-33 * 100.0, 2.0**-29 * 100.0),  # Honeywell HG4930 AN04
    69: (2.0**-33 * 400.0, 2.0**-29 * 400.0),  # Honeywell HG4930 AN04, 400 Hz
}
"""Scale of the rates in rad/s and of the accelerations in m/s² for each IMU type, multiplied by the data rate."""


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]``."""

    gyro_scale: Annotated[float, SCALE] | None = Field(
        None, examples=[9.1e-10], description="angular rate of one count in rad/s; absent: according to the IMU type"
    )
    accel_scale: Annotated[float, SCALE] | None = Field(
        None, examples=[1.9e-7], description="acceleration of one count in m/s²; absent: according to the IMU type"
    )
    clock: Literal["gps", "arrival"] = Field("gps", description="source of the sample times")
    imu_type: Annotated[int, NumberRange("", 0, 255)] = Field(
        32, description="IMU type that a simulated sensor sends; every type can be read"
    )

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        """Yield a conflict if only one scale is configured, or if a simulated sensor has no scale."""
        given = {"gyro_scale": self.gyro_scale, "accel_scale": self.accel_scale}
        missing = [name for name, value in given.items() if value is None]
        if len(missing) == 1:
            yield Conflict(missing[0], "missing; gyro_scale and accel_scale are needed together")
        elif missing and self.imu_type not in SCALES:
            known = ", ".join(map(str, SCALES))
            yield Conflict(
                "imu_type", f"{self.imu_type} needs gyro_scale and accel_scale; types with a scale are {known}"
            )


class NovatelRawimusxDecoder(base.FrameStreamDecoder):
    """Decoder and encoder of RAWIMUSX and RAWIMUX logs."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(SYNC, _match_log, LONGEST)
        self._imu_type = settings.imu_type
        self._scales: tuple[float, float] | None = None
        if settings.gyro_scale is not None and settings.accel_scale is not None:
            self._scales = (settings.gyro_scale, settings.accel_scale)
        self.timing: Timing = ArrivalTimedFormat()
        if settings.clock == "gps":
            self.timing = CounterTimedFormat(WEEKS * WEEK_S * TICKS_PER_S, 1.0 / TICKS_PER_S)
        self._problem = ""

    @property
    def recent_problem(self) -> str:
        """Reason why samples are bad; "" if there is no problem."""
        return self._problem or super().recent_problem

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        kept = frames.select_frames([i for i, frame in enumerate(frames.data) if _is_imu_log(frame)])
        logs = np.frombuffer(b"".join(frame[_header_size(frame) : -4] for frame in kept.data), PAYLOAD)
        ticks: Ints | None = None
        if isinstance(self.timing, CounterTimedFormat):
            seconds = np.where(_has_valid_time(logs), logs["seconds"], 0.0)
            weeks_ticks = logs["week"].astype(np.int64) * (WEEK_S * TICKS_PER_S)
            ticks = (weeks_ticks + np.rint(seconds * TICKS_PER_S).astype(np.int64)) % self.timing.modulus
        values = self._read_values(logs)
        return self._builder.build_plausible_blocks(kept.t_ns, values, None, ticks, kept.bad_before, kept.bad_after)

    def _read_values(self, logs: NDArray[np.void]) -> Floats:
        """Return the values [n, 6]. Values of logs with an error or an unknown scale are infinite."""
        values = np.full((len(logs), 6), np.inf)
        is_valid = _has_valid_time(logs) & (logs["info"] & (ERROR | ENCRYPTED) == 0)
        imu_types = logs["imu_type"].tolist()
        for imu_type in set(imu_types):
            scales = self._scales or SCALES.get(imu_type)
            if scales is not None:
                rows = is_valid & (logs["imu_type"] == imu_type)
                values[rows, :3] = _to_axes(logs["gyro"][rows]) * scales[0]
                values[rows, 3:] = _to_axes(logs["accel"][rows]) * scales[1]
        if imu_types:
            self._problem = self._describe_problem(imu_types[-1], int(logs["info"][-1]))
        return values

    def _describe_problem(self, imu_type: int, info: int) -> str:
        if info & ENCRYPTED:
            return "the IMU data are encrypted (IMU info, bit 1)"
        if info & ERROR:
            return "the receiver reports an IMU error (IMU info, bit 0)"
        if self._scales is None and imu_type not in SCALES:
            return f"IMU type {imu_type} has no known scale: set gyro_scale and accel_scale in decoder_options"
        return ""

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode each sample as a RAWIMUSX log with a short header. Axes that are not measured are sent as 0."""
        gyro_scale, accel_scale = self._scales or SCALES[self._imu_type]
        logs = np.zeros(len(samples), PAYLOAD)
        logs["imu_type"] = self._imu_type
        week, rest = np.divmod(samples.ticks % (WEEKS * WEEK_S * TICKS_PER_S), WEEK_S * TICKS_PER_S)
        logs["week"], logs["seconds"] = week, rest / TICKS_PER_S
        logs["gyro"] = base.quantize(_to_axes(samples.values[:, :3]), gyro_scale, 32)
        logs["accel"] = base.quantize(_to_axes(samples.values[:, 3:]), accel_scale, 32)
        heads = zip(week.tolist(), (rest // 1000).tolist(), logs, strict=True)
        frames = [encode_short_log(MESSAGE_IDS[0], week, ms, log.tobytes()) for week, ms, log in heads]
        return base.make_chunks(frames, samples.t_ns)


def _to_axes(numbers: NDArray[Any]) -> Floats:
    """Convert between the order Z, -Y, X of a log and the order X, Y, Z [n, 3]. The function is its own inverse."""
    ordered: Floats = numbers[:, ::-1] * AXIS_SIGNS
    return ordered


def _has_valid_time(logs: NDArray[np.void]) -> NDArray[np.bool_]:
    found: NDArray[np.bool_] = (logs["seconds"] >= 0) & (logs["seconds"] < WEEK_S)
    return found


def encode_short_log(message_id: int, week: int, ms: int, payload: bytes) -> bytes:
    """Return a binary log with the short header.

    Parameters
    ----------
    message_id
        Number of the log, such as 1462.
    week
        GPS week.
    ms
        Time of the week in milliseconds.
    payload
        Content of at most 255 bytes.
    """
    body = SYNC + struct.pack("<BBHHI", SHORT_HEADER, len(payload), message_id, week, ms) + payload
    return body + compute_crc(body).to_bytes(4, "little")


def compute_crc(data: bytes) -> int:
    """Return the CRC-32 of a log. ASCII logs have the same CRC."""
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF


def _header_size(frame: bytes) -> int:
    return frame[3] if frame[2] == LONG_HEADER else SHORT_HEADER_SIZE


def _is_imu_log(frame: bytes) -> bool:
    is_expected_size = len(frame) == _header_size(frame) + PAYLOAD.itemsize + 4
    return is_expected_size and int.from_bytes(frame[4:6], "little") in MESSAGE_IDS


def _match_log(buffer: bytes, at: int) -> int:
    if len(buffer) < at + SHORT_HEADER_SIZE:
        return base.NEED_MORE
    kind, size = buffer[at + 2], buffer[at + 3]
    if kind == SHORT_HEADER:
        end = at + SHORT_HEADER_SIZE + size + 4
    elif kind == LONG_HEADER and size >= LONG_HEADER_SIZE:
        payload = int.from_bytes(buffer[at + 8 : at + 10], "little")
        if payload > MAX_PAYLOAD:
            return base.REJECT
        end = at + size + payload + 4
    else:
        return base.REJECT
    if len(buffer) < end:
        return base.NEED_MORE
    # The CRC of a whole log, including the CRC field, is 0.
    return base.REJECT if compute_crc(buffer[at:end]) else end - at


def build(settings: Settings) -> base.Decoder:
    """Return a decoder of RAWIMUSX and RAWIMUX logs with the given settings."""
    return NovatelRawimusxDecoder(settings)
