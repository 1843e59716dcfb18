"""ROS bags, written by rosbags."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import mcap.writer
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from drivers.data_types import Floats, Ints

IMU: Final = "sensor_msgs/msg/Imu"
TEMPERATURE: Final = "sensor_msgs/msg/Temperature"
ROS1: Final[Mapping[str, rosbag1.Writer.CompressionFormat | None]] = {
    "ros1": None, "ros1-bz2": rosbag1.Writer.CompressionFormat.BZ2, "ros1-lz4": rosbag1.Writer.CompressionFormat.LZ4
}  # fmt: skip
ROS2: Final = {
    "sqlite": (StoragePlugin.SQLITE3, CompressionMode.NONE),
    "sqlite-file": (StoragePlugin.SQLITE3, CompressionMode.FILE),
    "sqlite-message": (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    "mcap": (StoragePlugin.MCAP, CompressionMode.NONE),
    "mcap-chunk": (StoragePlugin.MCAP, CompressionMode.STORAGE),
    "mcap-file": (StoragePlugin.MCAP, CompressionMode.FILE),
    "mcap-message": (StoragePlugin.MCAP, CompressionMode.MESSAGE),
}
PX4: Final = {  # definitions of px4_msgs (release 1.14)
    "SensorCombined": "uint64 timestamp\nint32 RELATIVE_TIMESTAMP_INVALID = 2147483647\nfloat32[3] gyro_rad\n"
    "uint32 gyro_integral_dt\nint32 accelerometer_timestamp_relative\nfloat32[3] accelerometer_m_s2\n"
    "uint32 accelerometer_integral_dt\nuint8 CLIPPING_X = 1\nuint8 accelerometer_clipping\nuint8 gyro_clipping\n"
    "uint8 accel_calibration_count\nuint8 gyro_calibration_count\n",
    "VehicleImu": "uint64 timestamp\nuint64 timestamp_sample\nuint32 accel_device_id\nuint32 gyro_device_id\n"
    "float32[3] delta_angle\nfloat32[3] delta_velocity\nuint32 delta_angle_dt\nuint32 delta_velocity_dt\n"
    "uint8 delta_angle_clipping\nuint8 delta_velocity_clipping\n",
    "SensorGyro": "uint64 timestamp\nuint64 timestamp_sample\nuint32 device_id\nfloat32 x\nfloat32 y\nfloat32 z\n"
    "float32 temperature\nuint32 error_count\nuint8[3] clip_counter\nuint8 samples\n",
    "SensorGyroFifo": "uint64 timestamp\nuint64 timestamp_sample\nuint32 device_id\nfloat32 dt\nfloat32 scale\n"
    "uint8 samples\nint16[32] x\nint16[32] y\nint16[32] z\n",
}
PX4["SensorAccel"] = PX4["SensorGyro"]
ROS1_MCAP: Final = "ros1-profile-mcap"
KINDS: Final = (*ROS1, *ROS2, ROS1_MCAP)
NOT_PROVIDED: Final = np.array([-1.0, *[0.0] * 8])

MakeMessage = Callable[[Any, int], Any]
"""Function that makes a message from the types of ROS and the index of the message."""
Topics = Mapping[str, tuple[str, Ints, MakeMessage]]
"""For each topic: the type, the times of the log in ns, and the function that makes the messages."""


def stamped(types: Any, t_ns: int, seq: int) -> Any:
    """Return a header."""
    time = types["builtin_interfaces/msg/Time"](*divmod(int(t_ns), 1_000_000_000))
    header = types["std_msgs/msg/Header"]
    more = {"seq": seq} if "seq" in header.__dataclass_fields__ else {}
    return header(stamp=time, frame_id="imu_link", **more)


def imu_topic(t_ns: Ints, values: Floats, log_ns: Ints | None = None) -> tuple[str, Ints, MakeMessage]:
    """Return a topic of an IMU. A gyroscope or an accelerometer that is NaN throughout is not provided."""
    covariances = [NOT_PROVIDED if np.isnan(values[:, at : at + 3]).all() else np.zeros(9) for at in (0, 3)]

    def make(types: Any, i: int) -> Any:
        vector = types["geometry_msgs/msg/Vector3"]
        return types[IMU](
            header=stamped(types, t_ns[i], i),
            orientation=types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
            orientation_covariance=NOT_PROVIDED,
            angular_velocity=vector(*values[i, :3]),
            angular_velocity_covariance=covariances[0],
            linear_acceleration=vector(*values[i, 3:]),
            linear_acceleration_covariance=covariances[1],
        )

    return IMU, t_ns if log_ns is None else log_ns, make


def temperature_topic(t_ns: Ints, temperature_c: Floats) -> tuple[str, Ints, MakeMessage]:
    """Return a topic of temperatures."""
    return TEMPERATURE, t_ns, lambda types, i: types[TEMPERATURE](stamped(types, t_ns[i], i), temperature_c[i], 0.0)


def text_topic(t_ns: Ints, text: str = "") -> tuple[str, Ints, MakeMessage]:
    """Return a topic of texts."""
    return "std_msgs/msg/String", t_ns, lambda types, _: types["std_msgs/msg/String"](text)


def px4_topic(kind: str, t_us: Ints, **fields: Any) -> tuple[str, Ints, MakeMessage]:
    """Return a topic of PX4 with the given fields [n] or [n, k]. All other fields are 0."""

    def make(types: Any, i: int) -> Any:
        message = types[f"px4_msgs/msg/{kind}"]
        given = {"timestamp": t_us, **fields}
        arrays = {"clip_counter": np.zeros(3, np.uint8)}
        return message(
            **{
                name: given[name][i] if name in given else arrays.get(name, 0)
                for name in message.__dataclass_fields__
                if name.islower()
            }
        )

    return f"px4_msgs/msg/{kind}", 1000 * t_us, make


def write_bag(folder: Path, kind: str, topics: Topics, name: str = "run") -> Path:
    """Write a bag of one of KINDS, and return the file of a ROS 1 bag or the folder of a ROS 2 bag."""
    if kind == ROS1_MCAP:
        return _write_ros1_mcap(folder / f"{name}.mcap", topics)
    writer: Any
    if kind in ROS1:
        path, store = folder / f"{name}.bag", get_typestore(Stores.ROS1_NOETIC)
        writer = rosbag1.Writer(path)
        if (compression := ROS1[kind]) is not None:
            writer.set_compression(compression)
        serialize = store.serialize_ros1
    else:
        path, store = folder / name, get_typestore(Stores.ROS2_HUMBLE)
        for name, definition in PX4.items():
            store.register(get_types_from_msg(definition, f"px4_msgs/msg/{name}"))
        plugin, mode = ROS2[kind]
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        serialize = store.serialize_cdr
    with writer:
        connections = {one: writer.add_connection(one, topics[one][0], typestore=store) for one in topics}
        for log_ns, topic, i in _in_order(topics):
            type_name, _, make = topics[topic]
            writer.write(connections[topic], log_ns, serialize(make(store.types, i), type_name))
    return path


def _write_ros1_mcap(path: Path, topics: Topics) -> Path:
    """Write messages of ROS 1 to an MCAP file, as ``mcap convert run.bag run.mcap``."""
    store = get_typestore(Stores.ROS1_NOETIC)
    with path.open("wb") as file:
        writer = mcap.writer.Writer(file)
        writer.start(profile="ros1")
        channels = {}
        for topic, (type_name, _, _) in topics.items():
            definition = store.generate_msgdef(type_name, ros_version=1)[0].encode()
            schema = writer.register_schema(type_name.replace("/msg/", "/"), "ros1msg", definition)
            channels[topic] = writer.register_channel(topic, "ros1", schema)
        for log_ns, topic, i in _in_order(topics):
            type_name, _, make = topics[topic]
            data = bytes(store.serialize_ros1(make(store.types, i), type_name))
            writer.add_message(channels[topic], log_ns, data, log_ns)
        writer.finish()
    return path


def storage_file(path: Path) -> Path:
    """Return the file with the messages of a bag."""
    return path if path.is_file() else next(one for one in path.iterdir() if one.name != "metadata.yaml")


def _in_order(topics: Topics) -> Sequence[tuple[int, str, int]]:
    return sorted((int(t_ns), topic, i) for topic, (_, log_ns, _) in topics.items() for i, t_ns in enumerate(log_ns))
