"""Attachment of the messages of rmw_zenoh: sequence number, time of publication and identifier of the publisher.

Two layouts exist, both with little-endian integers (``attachment_helpers.cpp`` of ros2/rmw_zenoh):

- bare, 33 bytes: sequence number (i64), time in ns (i64), length 16 (u8), identifier (16 bytes);
- labelled, 77 bytes: the same values, each after its name. rmw_zenoh has not written this layout since June 2025
  (version 0.2.5 in Jazzy).
"""

import struct
from typing import Final

GID_BYTES: Final = 16
"""Length of the publisher identifier, which ends both layouts."""
SEQUENCE_OFFSETS: Final = {77: 16, 33: 0}
"""Offset of the sequence number, by the length of the attachment in bytes.

In the labelled layout, the string "sequence_number" with its length byte precedes the number.
"""


def encode_attachment(sequence: int, t_ns: int, gid: bytes) -> bytes:
    """Return an attachment in the bare layout.

    Parameters
    ----------
    sequence
        Number of the message. The first message of a publisher has the number 1.
    t_ns
        Time of publication in nanoseconds since 1970.
    gid
        Identifier of the publisher, at most 16 bytes.
    """
    return struct.pack("<qqB16s", sequence, t_ns, GID_BYTES, gid)
