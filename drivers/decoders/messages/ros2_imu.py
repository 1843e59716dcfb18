"""Decoder of ROS 2 ``sensor_msgs/msg/Imu`` messages over zenoh (rmw_zenoh, zenoh-bridge-ros2dds).

Each message contains one sample. The payload is XCDR1 (OMG DDSI-RTPS 10.5). The first 4 bytes are the encapsulation:
``00 01`` for little-endian or ``00 00`` for big-endian, and two bytes of options. The following fields are aligned from
byte 4:

- stamp.sec (i32) and stamp.nanosec (u32), the time of the sample;
- frame_id (u32 length including the final NUL, then the characters), and padding to 8 bytes;
- 37 float64: orientation x y z w, angular velocity x y z in rad/s and linear acceleration x y z in m/s², each followed
  by 9 covariances.

If the first covariance of a quantity is -1, the message does not provide the quantity (sensor_msgs/Imu.msg). The
message contains no temperature.

The attachment of an rmw_zenoh message has one of two layouts: labelled (77 bytes) or bare (33 bytes). Both layouts
contain the identifier of the publisher and a sequence number (i64), which reveals lost messages. The attachment is
optional.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from drivers.data_types import NO_TICK, Chunk, Floats, SampleBlock, SenderTimedFormat, Timing
from drivers.decoders.base import Decoder, RejectingDecoder
from drivers.errors import DecodeError
from drivers.settings_model import SettingsModel

HEADER_BYTES: Final = 4
DOUBLES: Final = 37
BODY_BYTES: Final = 8 * DOUBLES
GYRO: Final = slice(13, 16)
GYRO_COVARIANCE: Final = 16
ACCEL: Final = slice(25, 28)
ACCEL_COVARIANCE: Final = 28
NOT_PROVIDED: Final = -1.0
MAX_FRAME_ID_BYTES: Final = 1024
FRAME_ID: Final = b"imu_link\0"
"""frame_id that ``encode`` writes (REP 145)."""
SEQUENCE_OFFSETS: Final = {77: 16, 33: 0}
"""Offset of the sequence number, by the length of the attachment in bytes.

In the labelled layout, the string "sequence_number" with its length byte precedes the number.
"""
MAX_GAP_MESSAGES: Final = 1_000_000_000
"""Maximum number of lost messages (eleven days at 1 kHz). A larger step of the sequence number indicates a restart."""
GID_BYTES: Final = 16  # the publisher identifier ends both attachment layouts
BYTE_ORDERS: Final = {b"\x00\x00": ">", b"\x00\x01": "<"}


class Settings(SettingsModel):
    """Settings of the decoder. There are no options."""


@dataclass(frozen=True, slots=True)
class _Message:
    t_ns: int
    body: bytes  # 37 float64
    little: bool


class Ros2ImuDecoder(RejectingDecoder):
    """Decoder and encoder of ``sensor_msgs/msg/Imu`` messages."""

    carrier: ClassVar[str] = "messages"

    def __init__(self) -> None:
        super().__init__()
        self.timing: Timing = SenderTimedFormat()
        self._lost_in_builder = 0  # number of lost messages that ``BlockBuilder`` has counted as bad
        self._lost = 0  # number of messages lost before the next message
        self._sequence: int | None = None
        self._publisher = b""
        self._encoded = 0

    @property
    def bad(self) -> int:
        """Number of rejected messages and implausible samples."""
        return self._builder.bad - self._lost_in_builder

    def forget_stream_state(self) -> None:
        """Discard the last sequence number, so that no loss is reported for the next message."""
        self._sequence = None
        self._lost = 0
        self._builder.forget_missing_samples()

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Return one sample per message. ``t_ns`` is the time stamp of the message, ``ticks`` the sequence number."""
        messages: list[_Message] = []
        ticks: list[int] = []
        missing: list[int] = []
        rejected = 0
        for chunk in chunks:
            sequence = self._read_sequence(chunk.attachment)
            try:
                messages.append(_parse_message(chunk.data))
            except DecodeError as error:
                self._rejection.note_rejection(str(error))
                rejected += 1
                continue
            self._rejection.add_good_frames()
            ticks.append(sequence)
            missing.append(self._lost + rejected)
            self._lost_in_builder += self._lost
            self._lost = rejected = 0
        return self._builder.build_plausible_blocks(
            np.array([m.t_ns for m in messages], np.int64),
            _read_values(messages),
            ticks=np.array(ticks, np.int64),
            bad_before=np.array(missing, np.int64),
            bad_after=rejected,
        )

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Return little-endian messages with the bare attachment. The sequence number is ``ticks`` if available."""
        chunks = []
        for t_ns, values, tick in zip(samples.t_ns, samples.values, samples.ticks, strict=True):
            self._encoded = self._encoded + 1 if tick == NO_TICK else int(tick)
            attachment = struct.pack("<qqB16s", self._encoded, int(t_ns), GID_BYTES, b"imu-monitor")
            chunks.append(Chunk(_encode_payload(int(t_ns), values), int(t_ns), attachment=attachment))
        return chunks

    def _read_sequence(self, attachment: bytes) -> int:
        """Return the sequence number of a message, and add the number of messages lost before it to ``_lost``."""
        at = SEQUENCE_OFFSETS.get(len(attachment))
        if at is None:
            return NO_TICK
        sequence: int = struct.unpack_from("<q", attachment, at)[0]
        publisher = attachment[-GID_BYTES:]
        before = self._sequence if publisher == self._publisher else None
        self._sequence, self._publisher = sequence, publisher
        if before is not None and 0 < sequence - before <= MAX_GAP_MESSAGES:
            self._lost = min(self._lost + sequence - before - 1, MAX_GAP_MESSAGES)
        return sequence


def _parse_message(data: bytes) -> _Message:
    """Parse the payload of a message. Raise ``DecodeError`` if the payload is not an Imu message."""
    end = BYTE_ORDERS.get(data[:2])
    if end is None:
        raise DecodeError("no XCDR1 message: the encapsulation is not 00 00 or 00 01")
    if len(data) < HEADER_BYTES + 12 + BODY_BYTES:
        raise DecodeError(f"{len(data)} bytes are too few for sensor_msgs/Imu")
    sec, nanosec, length = struct.unpack_from(f"{end}iII", data, HEADER_BYTES)
    if nanosec >= 1_000_000_000 or length > MAX_FRAME_ID_BYTES:
        raise DecodeError("the header is not that of sensor_msgs/Imu; check the type of the topic")
    start = HEADER_BYTES + (12 + length + 7) // 8 * 8
    if len(data) - start - BODY_BYTES not in range(4):  # up to 3 bytes of padding may follow
        raise DecodeError(f"{len(data)} bytes are not the length of sensor_msgs/Imu")
    return _Message(sec * 1_000_000_000 + nanosec, data[start : start + BODY_BYTES], end == "<")


def _read_values(messages: Sequence[_Message]) -> Floats:
    """Return the values [n, 6] in rad/s and m/s²; NaN for a quantity that a message does not provide."""
    raw = np.frombuffer(b"".join(m.body for m in messages), "<f8").reshape(-1, DOUBLES).astype(np.float64)
    big = np.array([not m.little for m in messages], bool)
    raw[big] = raw[big].byteswap()
    values = np.concatenate((raw[:, GYRO], raw[:, ACCEL]), axis=1)
    values[raw[:, GYRO_COVARIANCE] == NOT_PROVIDED, :3] = np.nan
    values[raw[:, ACCEL_COVARIANCE] == NOT_PROVIDED, 3:] = np.nan
    return values


def _encode_payload(t_ns: int, values: Floats) -> bytes:
    body = np.zeros(DOUBLES)
    body[3] = 1.0  # orientation w
    body[4] = NOT_PROVIDED
    for part, covariance, axes in ((GYRO, GYRO_COVARIANCE, values[:3]), (ACCEL, ACCEL_COVARIANCE, values[3:])):
        if np.isnan(axes).all():
            body[covariance] = NOT_PROVIDED
        else:
            body[part] = axes
    sec, nanosec = divmod(t_ns, 1_000_000_000)
    head = struct.pack("<iII", sec, nanosec, len(FRAME_ID)) + FRAME_ID
    head += bytes(-len(head) % 8)
    return b"\x00\x01\x00\x00" + head + body.astype("<f8").tobytes()


def build(settings: Settings) -> Decoder:
    """Return a decoder of sensor_msgs/Imu."""
    return Ros2ImuDecoder()
