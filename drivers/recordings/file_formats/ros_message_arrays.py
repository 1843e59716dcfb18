"""Decoding and encoding of many ROS messages at once.

The types ``sensor_msgs/Imu`` and ``sensor_msgs/Temperature`` begin with a header: the time stamp, and the text
``frame_id`` with its length. All other fields are float64 at fixed offsets after the text. Consecutive messages of a
topic usually contain the same text, so their bytes can be read as a structured array. Other types can be decoded if
each of their fields has a fixed size, as in ``px4_msgs``.

ROS 2 messages are XCDR1 (OMG DDSI-RTPS 10.5): 4 bytes of encapsulation, whose second byte is 1 for little-endian, then
fields that are aligned from byte 4. ROS 1 messages are little-endian without alignment and begin with a sequence
number.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

import numpy as np

from drivers.data_types import Floats, Ints

IMU_TYPE: Final = "sensor_msgs/msg/Imu"
TEMPERATURE_TYPE: Final = "sensor_msgs/msg/Temperature"
NUMBERS: Final = {IMU_TYPE: 37, TEMPERATURE_TYPE: 2}
"""Number of float64 after the header."""
GYRO: Final = slice(13, 16)
GYRO_COVARIANCE: Final = 16
ACCEL: Final = slice(25, 28)
ACCEL_COVARIANCE: Final = 28
NOT_PROVIDED: Final = -1.0
"""First covariance of a quantity that a message does not provide (sensor_msgs/Imu.msg)."""
SECOND_NS: Final = 1_000_000_000
CDR_HEADER_BYTES: Final = 4
MAX_PADDING_BYTES: Final = 7
"""Maximum number of bytes after the last field of a message."""
TEXT_OFFSET: Final = 16
"""Offset of the text ``frame_id``, whose length precedes it."""
BLOCK_BYTES: Final = 1 << 20
"""Total size of the messages that are decoded at once."""


def iter_message_blocks(messages: Iterable[tuple[Any, int, bytes]]) -> Iterator[tuple[list[int], list[bytes]]]:
    """Yield the log times in ns and the bytes of consecutive messages of equal size, up to BLOCK_BYTES."""
    times: list[int] = []
    block: list[bytes] = []
    size = most = 0
    for _, log_ns, data in messages:
        if len(data) != size or len(block) >= most:
            if block:
                yield times, block
            times, block, size = [], [], len(data)
            most = BLOCK_BYTES // (size + 1) + 1
        times.append(log_ns)
        block.append(data)
    if block:
        yield times, block


def decode_messages(block: Sequence[bytes], message_type: str, cdr: bool) -> tuple[Ints, Floats]:
    """Decode messages of equal size.

    Parameters
    ----------
    block
        Bytes of each message.
    message_type
        Key of NUMBERS.
    cdr
        True for messages of ROS 2, False for messages of ROS 1.

    Returns
    -------
    Ints
        [n] header stamps in ns.
    Floats
        [n, 6] angular rates in rad/s and accelerations in m/s², or [n, 1] temperatures in °C. NaN marks values that are
        not provided.

    Raises
    ------
    ValueError
        If a message is too short.
    """
    rows = np.frombuffer(b"".join(block), _message_layout(block[0], message_type, cdr))
    layout_fields = ("byte_order", "text_bytes") if cdr else ("text_bytes",)
    if len(block) > 1 and any((rows[name] != rows[name][0]).any() for name in layout_fields):
        single = [decode_messages([one], message_type, cdr) for one in block]
        return np.concatenate([one[0] for one in single]), np.concatenate([one[1] for one in single])
    stamps_ns = rows["sec"].astype(np.int64) * SECOND_NS + rows["nanosec"]
    if message_type == TEMPERATURE_TYPE:
        return stamps_ns, rows["numbers"][:, :1]
    numbers = rows["numbers"]
    values = np.concatenate((numbers[:, GYRO], numbers[:, ACCEL]), axis=1)
    values[numbers[:, GYRO_COVARIANCE] == NOT_PROVIDED, :3] = np.nan
    values[numbers[:, ACCEL_COVARIANCE] == NOT_PROVIDED, 3:] = np.nan
    return stamps_ns, values


def decode_fixed_messages(block: Sequence[bytes], fields: Sequence[tuple[str, str, int]]) -> np.ndarray[Any, Any]:
    """Decode ROS 2 messages of equal size whose fields have a fixed size.

    Parameters
    ----------
    block
        Bytes of each message.
    fields
        Name, NumPy type and number of elements of each field. The number is 0 for a field that is no array.

    Returns
    -------
    numpy.ndarray
        [n] structured array.

    Raises
    ------
    ValueError
        If the size of the messages does not fit the fields.
    """
    offsets, end = [], CDR_HEADER_BYTES
    for _, kind, count in fields:
        size = np.dtype(kind).itemsize
        offsets.append(end + (CDR_HEADER_BYTES - end) % size)
        end = offsets[-1] + size * max(count, 1)
    if not end <= len(block[0]) <= end + MAX_PADDING_BYTES:
        raise ValueError(f"a message has {len(block[0])} bytes, expected {end} according to the definition in the bag")
    layout = np.dtype(
        {
            "names": [name for name, *_ in fields],
            "formats": [(f"<{np.dtype(kind).str[1:]}", (count,) if count else ()) for _, kind, count in fields],
            "offsets": offsets,
            "itemsize": len(block[0]),
        }
    )
    data = np.frombuffer(b"".join(block), np.uint8).reshape(len(block), -1)
    rows, big_endian = data.view(layout)[:, 0].copy(), data[:, 1] == 0
    rows[big_endian] = data[big_endian].view(layout.newbyteorder(">"))[:, 0]
    return rows


def encode_messages(template: bytes, message_type: str, stamps: Ints, values: Floats) -> list[bytes]:
    """Encode ROS 2 messages.

    A quantity of which all values are NaN is marked as not provided.

    Parameters
    ----------
    template
        Message that contains all fields except the stamp and the values.
    message_type
        Key of NUMBERS.
    stamps
        [n, 2] header stamps as seconds and nanoseconds.
    values
        [n, 6] angular rates in rad/s and accelerations in m/s², or [n, 1] temperatures in °C.
    """
    rows = np.frombuffer(bytearray(template * len(stamps)), _message_layout(template, message_type, cdr=True))
    rows["sec"], rows["nanosec"] = stamps.T
    numbers = rows["numbers"]
    if message_type == TEMPERATURE_TYPE:
        numbers[:, :1] = values
    else:
        numbers[:, GYRO], numbers[:, ACCEL] = values[:, :3], values[:, 3:]
        for first, columns in ((GYRO_COVARIANCE, values[:, :3]), (ACCEL_COVARIANCE, values[:, 3:])):
            numbers[np.isnan(columns).all(axis=1), first] = NOT_PROVIDED
    data = rows.tobytes()
    return [data[at : at + len(template)] for at in range(0, len(data), len(template))]


def _message_layout(data: bytes, message_type: str, cdr: bool) -> np.dtype[Any]:
    """Return the layout of a message. It also applies to messages with the same ``byte_order`` and ``text_bytes``."""
    order = ">" if cdr and data[1:2] == b"\0" else "<"
    text_bytes = int.from_bytes(data[TEXT_OFFSET - 4 : TEXT_OFFSET], "little" if order == "<" else "big")
    start = TEXT_OFFSET + text_bytes
    if cdr:
        start += (4 - start) % 8
    needed = start + 8 * NUMBERS[message_type]
    if len(data) < needed:
        raise ValueError(f"a message of {message_type} has {len(data)} bytes, expected {needed}")
    numbers = (f"{order}f8", (NUMBERS[message_type],))
    return np.dtype(
        {
            "names": ["byte_order", "sec", "nanosec", "text_bytes", "numbers"],
            "formats": ["u1", *(f"{order}{kind}" for kind in ("i4" if cdr else "u4", "u4", "u4")), numbers],
            "offsets": [1, 4, 8, 12, start],
            "itemsize": len(data),
        }
    )
