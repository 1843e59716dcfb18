"""Decoder of ROS 2 ``sensor_msgs/msg/Imu`` messages over zenoh (rmw_zenoh, zenoh-bridge-ros2dds).

Each message contains one sample. ``drivers.zenoh.ros2_imu_message`` describes the payload. The message contains no
temperature. The attachment of an rmw_zenoh message contains the identifier of the publisher and a sequence number,
which reveals lost messages (``drivers.zenoh.rmw_attachment``). The attachment is optional.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from drivers.data_types import NO_TICK, Chunk, Floats, SampleBlock, SenderTimedFormat, Timing
from drivers.decoders.base import Decoder, RejectingDecoder
from drivers.errors import DecodeError
from drivers.live_stream_check import configure_si_messages
from drivers.validation.settings_model import SettingsModel
from drivers.zenoh.rmw_attachment import GID_BYTES, SEQUENCE_OFFSETS, encode_attachment
from drivers.zenoh.ros2_imu_message import (
    ACCEL,
    ACCEL_COVARIANCE,
    DOUBLES,
    GYRO,
    GYRO_COVARIANCE,
    HEADER_BYTES,
    NOT_PROVIDED,
    S_TO_NS,
    encode_imu_messages,
)

BODY_BYTES: Final = 8 * DOUBLES
MAX_FRAME_ID_BYTES: Final = 1024
MAX_GAP_MESSAGES: Final = 1_000_000_000
"""Maximum number of lost messages (eleven days at 1 kHz). A larger step of the sequence number indicates a restart."""
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
        super().__init__(configure_si_messages("subscribe to the key of one sensor"))
        self.timing: Timing = SenderTimedFormat()
        self._rejected = 0  # number of rejected messages
        self._lost_in_builder = 0  # number of lost messages that ``BlockBuilder`` has counted as bad
        self._lost = 0  # number of messages lost before the next message
        self._sequence: int | None = None
        self._publisher = b""
        self._encoded = 0

    @property
    def bad(self) -> int:
        """Number of rejected messages and implausible samples."""
        return self._rejected + self._builder.bad - self._lost_in_builder

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
        for chunk in chunks:
            try:
                messages.append(_parse_message(chunk.data))
            except DecodeError as error:
                self._rejection.note_rejection(str(error))
                self._rejected += 1
                continue
            self._rejection.add_good_frames()
            ticks.append(self._read_sequence(chunk.attachment))
            missing.append(self._lost)
            self._lost_in_builder += self._lost
            self._lost = 0
        return self._builder.build_plausible_blocks(
            np.array([m.t_ns for m in messages], np.int64),
            _read_values(messages),
            ticks=np.array(ticks, np.int64),
            bad_before=np.array(missing, np.int64),
        )

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Return little-endian messages with the bare attachment. The sequence number is ``ticks`` if available."""
        chunks = []
        payloads = encode_imu_messages(samples.t_ns, samples.values)
        for t_ns, tick, payload in zip(samples.t_ns.tolist(), samples.ticks, payloads, strict=True):
            self._encoded = self._encoded + 1 if tick == NO_TICK else int(tick)
            chunks.append(Chunk(payload, t_ns, attachment=encode_attachment(self._encoded, t_ns, b"imu-monitor")))
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
    if nanosec >= S_TO_NS or length > MAX_FRAME_ID_BYTES:
        raise DecodeError("the header is not that of sensor_msgs/Imu; check the type of the topic")
    start = HEADER_BYTES + (12 + length + 7) // 8 * 8
    if len(data) - start - BODY_BYTES not in range(4):  # up to 3 bytes of padding may follow
        raise DecodeError(f"{len(data)} bytes are not the length of sensor_msgs/Imu")
    return _Message(sec * S_TO_NS + nanosec, data[start : start + BODY_BYTES], end == "<")


def _read_values(messages: Sequence[_Message]) -> Floats:
    """Return the values [n, 6] in rad/s and m/s²; NaN for a quantity that a message does not provide."""
    raw = np.frombuffer(b"".join(m.body for m in messages), "<f8").reshape(-1, DOUBLES).astype(np.float64)
    big = np.array([not m.little for m in messages], bool)
    raw[big] = raw[big].byteswap()
    values = np.concatenate((raw[:, GYRO], raw[:, ACCEL]), axis=1)
    values[raw[:, GYRO_COVARIANCE] == NOT_PROVIDED, :3] = np.nan
    values[raw[:, ACCEL_COVARIANCE] == NOT_PROVIDED, 3:] = np.nan
    return values


def build(settings: Settings) -> Decoder:
    """Return a decoder of sensor_msgs/Imu."""
    return Ros2ImuDecoder()
