"""ROS 2 ``sensor_msgs/msg/Imu`` as it travels over zenoh (rmw_zenoh, zenoh-bridge-ros2dds): one message a sample.

Payload, XCDR1 (OMG DDSI-RTPS 10.5): 4 bytes of encapsulation (``00 01`` little-endian, ``00 00`` big-endian,
two of options), then, aligned from byte 4: stamp.sec i32, stamp.nanosec u32, frame_id (u32 length with its
NUL, bytes), pad to 8, then 37 float64: orientation x y z w, its covariance 9; angular velocity x y z rad/s,
covariance 9; linear acceleration x y z m/s², covariance 9. covariance[0] = -1 says that the quantity is not
provided (sensor_msgs/Imu.msg). The stamp is the sample's time; there is no temperature.

Attachment of rmw_zenoh, two layouts in the field: labelled, 77 bytes, and bare, 33 bytes; in both a
sequence number i64 by which lost messages are counted, and the publisher's id. It is optional.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from drivers.decoders.base import QUIET_FRAMES, Decoder, DecoderSettings, Given, Rows, Timing
from drivers.errors import DecodeError
from drivers.sample import NO_TICK, Chunk, SampleBlock

HEADER: Final = 4
DOUBLES: Final = 37
BODY: Final = 8 * DOUBLES
GYRO: Final = slice(13, 16)
GYRO_COVARIANCE: Final = 16
ACCEL: Final = slice(25, 28)
ACCEL_COVARIANCE: Final = 28
NOT_PROVIDED: Final = -1.0
LONGEST_FRAME_ID: Final = 1024
FRAME_ID: Final = b"imu_link\0"
"""REP 145."""
LABELLED: Final = 77
LABELLED_SEQUENCE: Final = 16  # behind the string "sequence_number" with its length byte
BARE: Final = 33
BARE_SEQUENCE: Final = 0
LONGEST_GAP: Final = 1_000_000_000
"""Messages; a larger jump, eleven days at 1 kHz, is another count, not a loss."""
GID: Final = 16  # the last bytes of both layouts
ENDS: Final = {b"\x00\x00": ">", b"\x00\x01": "<"}


class Settings(DecoderSettings, frozen=True):
    """The message says all there is to know: no keys."""


@dataclass(frozen=True, slots=True)
class _Message:
    """One payload, cut but not yet turned into numbers."""

    t_ns: int
    body: bytes  # 37 float64
    little: bool


class Ros2ImuDecoder:
    """CDR messages -> samples."""

    carrier: ClassVar[str] = "messages"

    def __init__(self) -> None:
        self.timing: Timing = Given()
        self.bad = 0  # messages rejected
        self.hint = ""
        self._quiet = 0  # messages since the last rejected one
        self._rows = Rows()
        self._counted_apart = 0  # in Rows' tally, but never received
        self._lost = 0  # places empty before the next message
        self._sequence: int | None = None
        self._publisher = b""
        self._encoded = 0

    def reset(self) -> None:
        """Messages are whole: only the count of lost ones is begun anew."""
        self._sequence = None
        self._lost = 0
        self._rows.reset()

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """One sample a message, at its own stamp; ``ticks`` is the publisher's sequence number."""
        messages: list[_Message] = []
        ticks: list[int] = []
        missing: list[int] = []
        rejected = 0
        for chunk in chunks:
            sequence = self._numbered(chunk.attachment)
            try:
                messages.append(_cut(chunk.data))
            except DecodeError as error:
                self.hint = str(error)
                self._quiet = 0
                rejected += 1
                continue
            self._quiet += 1
            ticks.append(sequence)
            missing.append(self._lost + rejected)
            self._counted_apart += self._lost
            self._lost = rejected = 0
        values = _values(messages)
        n = len(messages)
        blocks = self._rows.blocks(
            np.array([m.t_ns for m in messages], np.int64),
            values,
            np.full(n, np.nan),
            np.array(ticks, np.int64),
            np.array(missing, np.int64),
            rejected,
        )
        if self._quiet >= QUIET_FRAMES:
            self.hint = ""
        self.bad = self._rows.bad - self._counted_apart
        return blocks

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Little-endian messages with the bare attachment; the sequence from ``ticks`` where there are any."""
        chunks = []
        for t_ns, values, tick in zip(samples.t_ns, samples.values, samples.ticks, strict=True):
            self._encoded = self._encoded + 1 if tick == NO_TICK else int(tick)
            attachment = struct.pack("<qqB16s", self._encoded, int(t_ns), GID, b"imu-monitor")
            chunks.append(Chunk(_payload(int(t_ns), values), int(t_ns), attachment=attachment))
        return chunks

    def _numbered(self, attachment: bytes) -> int:
        """The message's sequence number; what is missing before it is noted."""
        at = {LABELLED: LABELLED_SEQUENCE, BARE: BARE_SEQUENCE}.get(len(attachment))
        if at is None:
            return NO_TICK
        sequence: int = struct.unpack_from("<q", attachment, at)[0]
        publisher = attachment[-GID:]
        before = self._sequence if publisher == self._publisher else None
        self._sequence, self._publisher = sequence, publisher
        if before is not None and 0 < sequence - before <= LONGEST_GAP:
            self._lost = min(self._lost + sequence - before - 1, LONGEST_GAP)
        return sequence


def _cut(data: bytes) -> _Message:
    """Find the doubles. Raises ``DecodeError`` for anything but an Imu message."""
    end = ENDS.get(data[:2])
    if end is None:
        raise DecodeError("no XCDR1 message: its encapsulation is not 00 00 or 00 01")
    if len(data) < HEADER + 12 + BODY:
        raise DecodeError(f"{len(data)} bytes are too few for sensor_msgs/Imu")
    sec, nanosec, length = struct.unpack_from(f"{end}iII", data, HEADER)
    if nanosec >= 1_000_000_000 or length > LONGEST_FRAME_ID:
        raise DecodeError("its header is none of sensor_msgs/Imu; is the type of this topic another?")
    start = HEADER + (12 + length + 7) // 8 * 8
    if len(data) - start - BODY not in range(4):  # up to 3 bytes of padding may follow
        raise DecodeError(f"{len(data)} bytes are not the length of a sensor_msgs/Imu")
    return _Message(sec * 1_000_000_000 + nanosec, data[start : start + BODY], end == "<")


def _values(messages: Sequence[_Message]) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """[n, 6] rad/s and m/s²; NaN where the message says that a quantity is not provided."""
    raw = np.frombuffer(b"".join(m.body for m in messages), "<f8").reshape(-1, DOUBLES).astype(np.float64)
    big = np.array([not m.little for m in messages], bool)
    raw[big] = raw[big].byteswap()
    values = np.concatenate((raw[:, GYRO], raw[:, ACCEL]), axis=1)
    values[raw[:, GYRO_COVARIANCE] == NOT_PROVIDED, :3] = np.nan
    values[raw[:, ACCEL_COVARIANCE] == NOT_PROVIDED, 3:] = np.nan
    return values


def _payload(t_ns: int, values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> bytes:
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
    """A decoder of sensor_msgs/Imu."""
    return Ros2ImuDecoder()
