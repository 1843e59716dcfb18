"""Writing of recordings to MCAP files with ROS 2 messages of type ``sensor_msgs/Imu``, by the library rosbags.

The header stamps are the times of the samples. Times in s are rounded to 1 ns. The log times increase strictly, because
readers return messages in the order of the log times, and a recording may contain equal times and backward steps.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from drivers.data_types import AXES, Ints, times_to_ns
from drivers.errors import RecordingError
from drivers.host.extras import require_extra
from drivers.recordings import table
from drivers.recordings.file_formats.ros_message_arrays import (
    IMU_TYPE,
    NOT_PROVIDED,
    SECOND_NS,
    TEMPERATURE_TYPE,
    encode_messages,
)

IMU_TOPIC: Final = "/imu/data"
TEMPERATURE_TOPIC: Final = "/imu/temperature"
FRAME: Final = "imu"
MAX_TIME_S: Final = (1 << 31) - 1
"""Largest time in s of ``builtin_interfaces/Time``, whose seconds are int32."""


@contextmanager
def open_mcap_writer(path: Path, names: Sequence[str]) -> Iterator[table.AppendColumns]:
    """Open an MCAP file for writing. Temperatures are written to the topic ``/imu/temperature``.

    A quantity that is missing from a sample has the covariance -1 (sensor_msgs/Imu.msg). The other covariances are 0,
    which means that they are unknown.

    Raises
    ------
    ConfigError
        If the packages of the extra ``ros`` are not installed.
    RecordingError
        If a time is out of the range of ROS.
    """
    whole = Path(str(path).removesuffix(table.PARTIAL_SUFFIX))
    require_extra("ros", f"{whole}: .mcap")
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with TemporaryDirectory(dir=path.parent, prefix=f".{whole.name}-") as folder:
        bag = Path(folder) / "bag"  # rosbags writes a folder with the MCAP file and its metadata
        writer = Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            topics: list[tuple[str, str, tuple[str, ...]]] = [(IMU_TOPIC, IMU_TYPE, AXES)]
            if "temperature" in names:
                topics.append((TEMPERATURE_TOPIC, TEMPERATURE_TYPE, ("temperature",)))
            connections = [writer.add_connection(topic, kind, typestore=store) for topic, kind, _ in topics]
            templates = [bytes(store.serialize_cdr(_empty_message(store.types, kind), kind)) for _, kind, _ in topics]
            newest_ns = -1

            def append_rows(columns: table.Columns) -> None:
                nonlocal newest_ns
                t_ns = times_to_ns(columns[table.TIME_NS if table.TIME_NS in columns else "t"])
                stamps = split_times(whole, t_ns)
                log_ns = _increasing_times(t_ns, newest_ns)
                newest_ns = int(log_ns[-1])
                absent = np.full(len(stamps), np.nan)
                for (_, kind, fields), connection, template in zip(topics, connections, templates, strict=True):
                    values = np.column_stack([columns.get(name, absent) for name in fields])
                    messages = encode_messages(template, kind, stamps, values)
                    for time_ns, message in zip(log_ns.tolist(), messages, strict=True):
                        writer.write(connection, time_ns, message)

            yield append_rows
        os.replace(bag / f"{bag.name}.mcap", path)


def split_times(path: Path, t_ns: Ints) -> Ints:
    """Return times as seconds and nanoseconds of ``builtin_interfaces/Time``, shape [n, 2].

    Parameters
    ----------
    path
        Path of the file, used in error messages.
    t_ns
        [n] times in ns.

    Raises
    ------
    RecordingError
        If a time is negative or too large.
    """
    stamps = np.column_stack(np.divmod(t_ns, SECOND_NS))
    outside = t_ns[(stamps[:, 0] < 0) | (stamps[:, 0] > MAX_TIME_S)]
    if outside.size:
        raise RecordingError(
            f"{path}: t = {outside[0] / SECOND_NS:.9g} s cannot be stored in a ROS 2 message, whose times are 0 to "
            f"{MAX_TIME_S} s; write another format"
        )
    return stamps


def _increasing_times(t_ns: Ints, newest_ns: int) -> Ints:
    """Return strictly increasing times in ns that are at least ``t_ns`` and later than ``newest_ns``."""
    index = np.arange(len(t_ns))
    times_ns = t_ns.copy()
    times_ns[0] = max(int(times_ns[0]), newest_ns + 1)
    result: Ints = np.maximum.accumulate(times_ns - index) + index
    return result


def _empty_message(types: Any, kind: str) -> Any:
    """Return a message without a stamp and without values. Its covariances are unknown."""
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), FRAME)
    if kind == TEMPERATURE_TYPE:
        return types[kind](header, 0.0, 0.0)
    orientation = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    zero, unknown = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0), np.zeros(9)
    return types[kind](header, orientation, np.array([NOT_PROVIDED, *[0.0] * 8]), zero, unknown, zero, unknown)
