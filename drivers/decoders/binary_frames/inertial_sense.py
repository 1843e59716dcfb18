"""Inertial Sense IMX-5, IMX-6 and uINS with the Inertial Sense binary protocol (ISB) 2, usually at 921600 baud.

The format is ``EF 49 | flags u8 | data set u8 | payload length u16 | payload | checksum``, little-endian. The lower
four bits of the flags are the packet type, which is 4 for data. Flag 0x20 means that the payload begins with a u16
offset into the data set. The checksum consists of the two 8-bit Fletcher sums of all preceding bytes.

======== ==== =========================================================================================================
data set DID  payload
======== ==== =========================================================================================================
pimu     3    time f64 in s | duration f32 in s | status u32 | angle increments 3 x f32 | velocity increments 3 x f32
imu      58   time f64 in s | status u32 | angular rates 3 x f32 in rad/s | accelerations 3 x f32 in m/s²
imu_raw  97   the same as imu
======== ==== =========================================================================================================

The increments are in rad and m/s, and are divided by the duration. The time since power-on serves as the device clock.
No set contains the temperature. Packets with other data sets or with an offset are ignored. ``pimu`` contains the sum
of all IMU samples. ``imu`` is derived from ``pimu``. ``imu_raw`` has a higher rate than both.

Sources: the ISB page of the manual, and ISComm.h and data_sets.h of inertialsense/inertial-sense-sdk (version 2 and the
development version of 2026). The packet format and the three data sets are the same in both versions. The versions
disagree about the status. In version 2, bits 16 to 21 report working sensors and bits 0 to 5 saturated sensors. In the
development version, bits 0 to 5 report valid axes and bits 30 and 31 saturation. The decoder therefore uses the first
meaning if one of the bits 16 to 21 is set. Samples of saturated sensors are bad. A public script for Raspberry Pi reads
the velocity increments before the angle increments. The decoder follows the SDK.

The protocol of release 1, whose packets begin with FF, is not supported.
"""

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.data_types import (
    NO_TICK,
    ArrivalTimedFormat,
    Chunk,
    CounterTimedFormat,
    Floats,
    Ints,
    SampleBlock,
    Timing,
)
from drivers.decoders import base
from drivers.validation.settings_model import SettingsModel

SYNC: Final = b"\xef\x49"
DATA: Final = 4
"""Packet type of data."""
PACKET_TYPES: Final = range(1, 9)
HAS_OFFSET: Final = 0x20
"""Flag of a payload that begins with an offset into the data set."""
LONGEST: Final = 2048
"""Length in bytes of the longest packet that the SDK accepts."""
HEADER_SIZE, CHECKSUM_SIZE = 6, 2

DataSet = Literal["pimu", "imu", "imu_raw"]
IMU: Final = np.dtype([("time", "<f8"), ("status", "<u4"), ("gyro", "<f4", 3), ("accel", "<f4", 3)])
PIMU: Final = np.dtype(
    [("time", "<f8"), ("duration", "<f4"), ("status", "<u4"), ("gyro", "<f4", 3), ("accel", "<f4", 3)]
)
DATA_SETS: Final[dict[DataSet, tuple[int, np.dtype[np.void]]]] = {
    "pimu": (3, PIMU),
    "imu": (58, IMU),
    "imu_raw": (97, IMU),
}
"""Data set number and layout of the payload."""
NAMES: Final = {number: name for name, (number, _) in DATA_SETS.items()}
PAYLOAD_SIZES: Final = {number: layout.itemsize for number, layout in DATA_SETS.values()}

TICKS_PER_S: Final = 1_000_000
TICKS: Final = 1 << 48
"""Number of ticks after which the encoded time wraps around (nine years)."""
SENSOR_BITS: Final = 0x3F << 16
"""Status bits of working sensors in version 2."""
SATURATION_BITS: Final = 0x3F
"""Status bits of saturated sensors in version 2."""
NEW_SATURATION_BITS: Final = 0b11 << 30
"""Status bits of saturated sensors in the development version."""
ENCODED_DURATION_S: Final = 2.0**-8
"""Duration of the increments of a simulated sensor."""


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]``."""

    data_set: DataSet = Field("pimu", description="data set with the samples: DID_PIMU, DID_IMU or DID_IMU_RAW")
    clock: Literal["device", "arrival"] = Field("device", description="source of the sample times")


class InertialSenseDecoder(base.FrameStreamDecoder):
    """Decoder and encoder of ISB packets with inertial data."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(SYNC, _match_packet, LONGEST)
        self._data_set = settings.data_set
        self._number, self._layout = DATA_SETS[settings.data_set]
        self._has_increments = settings.data_set == "pimu"
        self.timing: Timing = ArrivalTimedFormat()
        if settings.clock == "device":
            self.timing = CounterTimedFormat(TICKS, 1.0 / TICKS_PER_S)
        self._saturated = False
        self._other_number = 0  # inertial data set that arrives instead of the configured one

    @property
    def recent_problem(self) -> str:
        """Reason why there are no samples; "" if there is no problem."""
        if self._lacks_samples:
            name = NAMES.get(self._other_number)
            hint = f'set data_set = "{name}"' if name else "enable this data set in the sensor"
            return f"packets arrive, but none with the data set {self._data_set}: {hint}"
        if self._saturated:
            return "the sensor reports a saturated gyroscope or accelerometer"
        return super().recent_problem

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        numbers = [_find_data_set(packet) for packet in frames.data]
        rows = np.array([i for i, number in enumerate(numbers) if number == self._number], np.int64)
        others = [number for number in numbers if number not in (0, self._number)]
        self._other_number = others[-1] if others else self._other_number
        n = len(numbers)
        values = np.full((n, 6), np.nan)
        ticks = np.full(n, NO_TICK)
        if rows.size:
            packets = frames.stack_frames(rows)[:, HEADER_SIZE:-CHECKSUM_SIZE]
            payloads = np.ascontiguousarray(packets).view(self._layout)[:, 0]
            values[rows], time_ticks = self._read_payloads(payloads)
            if isinstance(self.timing, CounterTimedFormat):
                ticks[rows] = time_ticks
        return self._build_measured_blocks(frames, values, np.full(n, np.nan), ticks)[0]

    def _read_payloads(self, payloads: NDArray[np.void]) -> tuple[Floats, Ints]:
        """Return the values [n, 6] and the times [n] in ticks. Invalid values are infinite."""
        with np.errstate(invalid="ignore"):  # converting a signalling NaN causes a warning
            values = base.nan_to_infinity(np.hstack([payloads["gyro"], payloads["accel"]]).astype(np.float64))
            time_s = payloads["time"]
            valid = (time_s >= 0.0) & (time_s < TICKS / TICKS_PER_S)
            if self._has_increments:
                duration_s = payloads["duration"].astype(np.float64)
                valid &= (duration_s > 0.0) & np.isfinite(duration_s)
                values /= np.where(valid, duration_s, 1.0)[:, None]
        status = payloads["status"]
        saturation_bits = np.where(status & SENSOR_BITS, SATURATION_BITS, NEW_SATURATION_BITS)
        saturated = status & saturation_bits != 0
        self._saturated = bool(saturated[-1])
        values[~valid | saturated] = np.inf
        return values, np.rint(np.where(valid, time_s, 0.0) * TICKS_PER_S).astype(np.int64) % TICKS

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode each sample as one packet with the configured data set."""
        rows = np.zeros(len(samples), self._layout)
        rows["time"] = (samples.ticks % TICKS) / TICKS_PER_S
        rows["status"] = SENSOR_BITS
        scale = 1.0
        if self._has_increments:
            rows["duration"] = scale = ENCODED_DURATION_S
        rows["gyro"], rows["accel"] = samples.values[:, :3] * scale, samples.values[:, 3:] * scale
        packets = [encode_packet(DATA, self._number, row.tobytes()) for row in rows]
        return base.make_chunks(packets, samples.t_ns)


def encode_packet(flags: int, number: int, payload: bytes) -> bytes:
    """Return an ISB packet.

    Parameters
    ----------
    flags
        Packet type and flags.
    number
        Number of the data set.
    payload
        Content, at most 2040 bytes.
    """
    body = SYNC + bytes([flags, number]) + len(payload).to_bytes(2, "little") + payload
    return body + base.fletcher_checksum(body)


def _find_data_set(packet: bytes) -> int:
    """Return the number of the inertial data set in a packet, or 0 for any other content."""
    return packet[3] if packet[2] == DATA and packet[3] in PAYLOAD_SIZES else 0


def _match_packet(buffer: bytes, at: int) -> int:
    if len(buffer) < at + HEADER_SIZE:
        return base.NEED_MORE
    flags, number = buffer[at + 2], buffer[at + 3]
    size = int.from_bytes(buffer[at + 4 : at + HEADER_SIZE], "little")
    end = at + HEADER_SIZE + size
    has_wrong_size = not flags & HAS_OFFSET and flags & 0xF == DATA and size != PAYLOAD_SIZES.get(number, size)
    if has_wrong_size or flags & 0xF not in PACKET_TYPES or end + CHECKSUM_SIZE - at > LONGEST:
        return base.REJECT
    if len(buffer) < end + CHECKSUM_SIZE:
        return base.NEED_MORE
    is_valid = base.fletcher_checksum(buffer[at:end]) == buffer[end : end + CHECKSUM_SIZE]
    return end + CHECKSUM_SIZE - at if is_valid else base.REJECT


def build(settings: Settings) -> base.Decoder:
    """Return a decoder of ISB packets with the given settings."""
    return InertialSenseDecoder(settings)
