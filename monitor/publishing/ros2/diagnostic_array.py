"""Encoding of the ROS 2 message ``diagnostic_msgs/msg/DiagnosticArray`` as XCDR1 (OMG DDSI-RTPS 10.5).

Every integer is aligned to its size, counted from the end of the encapsulation.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from drivers.zenoh.ros2_imu_message import LITTLE_ENDIAN, S_TO_NS


class Level(IntEnum):
    """Level of a diagnostic status."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class DiagnosticStatus:
    """Status of one device, as in ``diagnostic_msgs/msg/DiagnosticStatus``."""

    level: Level
    name: str
    message: str
    hardware_id: str
    values: Sequence[tuple[str, str]]  # keys and values


def encode_diagnostic_array(t_ns: int, statuses: Sequence[DiagnosticStatus]) -> bytes:
    """Return a little-endian message with an empty frame_id.

    Parameters
    ----------
    t_ns
        Time of the status in nanoseconds since 1970.
    statuses
        Status of each device.
    """
    body = bytearray(struct.pack("<iI", *divmod(t_ns, S_TO_NS)))
    _append_text(body, "")
    _append_count(body, len(statuses))
    for one in statuses:
        body.append(one.level)
        for text in (one.name, one.message, one.hardware_id):
            _append_text(body, text)
        _append_count(body, len(one.values))
        for pair in one.values:
            for text in pair:
                _append_text(body, text)
    return LITTLE_ENDIAN + bytes(body)


def _append_count(body: bytearray, count: int) -> None:
    body += bytes(-len(body) % 4) + struct.pack("<I", count)


def _append_text(body: bytearray, text: str) -> None:
    encoded = text.encode("utf-8", "replace") + b"\0"
    _append_count(body, len(encoded))
    body += encoded
