"""Inertial Labs KERNEL IMUs over UART or RS-422: messages GA and Calibrated HR.

The format is little-endian: ``AA 55 | 01 | ID u8 | length u16 | payload | checksum u16``. The length counts all bytes
except AA 55. The checksum is the sum of all bytes between AA 55 and the checksum. Payloads:

- GA (ID 8F): ``angular rate 3 x i32 | acceleration 3 x i32 | counter u16 | status u16 | u16 | temperature i16``
- Calibrated HR (ID 81): ``angles 3 x i32 | angular rate 3 x i32 | acceleration 3 x i32 | magnetic field 3 x i16 |
  counter u16 | u16 | status u16 | u16 | temperature i16``

The resolution is 1e-5 °/s, 1e-6 g and 0.1 °C. The payloads are those of the header IMUData.h of the Inertial Labs
KERNEL IMU protocol. Length, checksum and status are those of ArduPilot's public driver of the Inertial Labs INS. The
decoder uses g = 9.80665 m/s². The ArduPilot driver uses 9.8106 m/s², which it takes from the documentation of the INS.

The counter counts internal computations of the device. The clock determines their number per sample. A sample is bad if
the status reports a failure of a gyroscope (bit 2), an accelerometer (bit 3) or the electronics (bit 5), or an angular
rate above the range (bits 10 to 12). Other messages are ignored.
"""

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.data_types import ArrivalTimedFormat, Chunk, CounterTimedFormat, Ints, SampleBlock, Timing
from drivers.decoders import base
from drivers.units import DEGREE, G0
from drivers.validation.settings_model import SettingsModel

SYNC: Final = b"\xaa\x55\x01"
OVERHEAD: Final = 8
"""Number of bytes in a message besides its payload."""
MAX_PAYLOAD: Final = 512
LONGEST: Final = OVERHEAD + MAX_PAYLOAD
MEASURED: Final = [("gyro", "<i4", 3), ("accel", "<i4", 3)]
PAYLOADS: Final = {
    "ga": np.dtype([*MEASURED, ("counter", "<u2"), ("status", "<u2"), ("reserved", "<u2"), ("temperature", "<i2")]),
    "calibrated-hr": np.dtype(
        [
            ("angles", "<i4", 3),
            *MEASURED,
            ("magnetic", "<i2", 3),
            ("counter", "<u2"),
            ("reserved1", "<u2"),
            ("status", "<u2"),
            ("reserved2", "<u2"),
            ("temperature", "<i2"),
        ]
    ),
}
"""Payload of each message that contains samples."""
IDS: Final = {"ga": 0x8F, "calibrated-hr": 0x81}
NAMES: Final = {number: name for name, number in IDS.items()}
STEPS: Final = np.repeat([1e-5 * DEGREE, 1e-6 * G0], 3)
TEMPERATURE_STEP: Final = 0.1
STATUS_ERRORS: Final = 1 << 2 | 1 << 3 | 1 << 5 | 0b111 << 10
"""Bits of the status word that make a sample bad."""


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]``."""

    message: Literal["ga", "calibrated-hr"] = Field(
        "ga", description="message that a simulated sensor sends; both messages can be read"
    )
    clock: Literal["counter", "arrival"] = Field("counter", description="source of the sample times")


class InertialLabsDecoder(base.FrameStreamDecoder):
    """Decoder and encoder of GA and Calibrated HR messages."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(SYNC, _match_message, LONGEST)
        self._name = settings.message
        self.timing: Timing = CounterTimedFormat(1 << 16) if settings.clock == "counter" else ArrivalTimedFormat()
        self._status = 0

    @property
    def recent_problem(self) -> str:
        """Error that the sensor reports, or reason for rejected messages; "" if there is no problem."""
        if self._status:
            return f"the sensor reports an error: status 0x{self._status:04X}"
        return super().recent_problem

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        kept = frames.select_frames([i for i, frame in enumerate(frames.data) if frame[3] in NAMES])
        n = len(kept.data)
        values = np.empty((n, 6))
        temperature_c = np.empty(n)
        ticks = np.empty(n, np.int64)
        statuses = np.zeros(n, np.int64)
        for message_id, rows in base.group_indices([frame[3] for frame in kept.data]) if n else ():
            messages = _view_payloads(kept.stack_frames(rows), PAYLOADS[NAMES[message_id]])
            values[rows] = np.hstack([messages["gyro"], messages["accel"]]) * STEPS
            temperature_c[rows] = messages["temperature"] * TEMPERATURE_STEP
            ticks[rows], statuses[rows] = messages["counter"], messages["status"]
        statuses &= STATUS_ERRORS
        values[statuses != 0] = np.inf
        if n:
            self._status = int(statuses[-1])
        counters: Ints | None = ticks if isinstance(self.timing, CounterTimedFormat) else None
        return self._builder.build_plausible_blocks(
            kept.t_ns, values, temperature_c, counters, kept.bad_before, kept.bad_after
        )

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode each sample as one message. Axes that are not measured are sent as 0."""
        rows = np.zeros(len(samples), PAYLOADS[self._name])
        numbers = base.quantize(samples.values / STEPS, 1.0, 32)
        rows["gyro"], rows["accel"] = numbers[:, :3], numbers[:, 3:]
        rows["counter"] = samples.ticks & 0xFFFF
        rows["temperature"] = base.quantize(samples.temperature_c, TEMPERATURE_STEP, 16)
        return base.make_chunks([encode_message(IDS[self._name], row.tobytes()) for row in rows], samples.t_ns)


def _view_payloads(data: base.Bytes, payload: np.dtype[np.void]) -> NDArray[np.void]:
    """Return the payloads [n] of complete messages [n, length]."""
    return np.ascontiguousarray(data[:, 6:-2]).view(payload)[:, 0]


def encode_message(message_id: int, payload: bytes) -> bytes:
    """Return a message.

    Parameters
    ----------
    message_id
        Number of the message, such as 0x8F.
    payload
        Content of at most 512 bytes.
    """
    body = SYNC[2:] + bytes([message_id]) + (len(payload) + OVERHEAD - 2).to_bytes(2, "little") + payload
    return SYNC[:2] + body + (sum(body) & 0xFFFF).to_bytes(2, "little")


def _match_message(buffer: bytes, at: int) -> int:
    if len(buffer) < at + 6:
        return base.NEED_MORE
    length = int.from_bytes(buffer[at + 4 : at + 6], "little") + 2
    name = NAMES.get(buffer[at + 3])
    if not OVERHEAD <= length <= LONGEST or (name and length != OVERHEAD + PAYLOADS[name].itemsize):
        return base.REJECT
    end = at + length
    if len(buffer) < end:
        return base.NEED_MORE
    is_valid = sum(buffer[at + 2 : end - 2]) & 0xFFFF == int.from_bytes(buffer[end - 2 : end], "little")
    return length if is_valid else base.REJECT


def build(settings: Settings) -> base.Decoder:
    """Return a decoder of GA and Calibrated HR messages with the given settings."""
    return InertialLabsDecoder(settings)
