"""Decoding of ROS 2 messages with rosbags, a codec that shares no code with the program."""

from typing import Any, Final

from rosbags.typesys import Stores, get_typestore

STORES: Final = (Stores.ROS2_JAZZY, Stores.ROS2_KILTED)
"""Releases of ROS 2 whose type hashes rmw_zenoh puts into its keys."""
STORE: Final = get_typestore(STORES[0])
IMU: Final = "sensor_msgs/msg/Imu"
DIAGNOSTIC_ARRAY: Final = "diagnostic_msgs/msg/DiagnosticArray"


def decode(payload: bytes, message_type: str) -> Any:
    """Return a message as an object with the fields of its type."""
    return STORE.deserialize_cdr(payload, message_type)


def stamp_ns(message: Any) -> int:
    """Return the time stamp of a message in nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
