"""Layout and encoding of the ROS 2 message ``sensor_msgs/msg/Imu`` (sensor_msgs/Imu.msg, REP 145).

The payload is XCDR1 (OMG DDSI-RTPS 10.5). The first 4 bytes are the encapsulation: ``00 01`` for little-endian or
``00 00`` for big-endian, and two bytes of options. The following fields are aligned from byte 4:

- stamp.sec (i32) and stamp.nanosec (u32), the time of the sample;
- frame_id (u32 length including the final NUL, then the characters), and padding to 8 bytes;
- 37 float64: orientation x y z w, angular velocity x y z in rad/s and linear acceleration x y z in m/s², each followed
  by 9 covariances.

If the first covariance of a quantity is -1, the message does not provide the quantity. If all covariances of a quantity
are 0, they are unknown.
"""

from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints

LITTLE_ENDIAN: Final = b"\x00\x01\x00\x00"
"""Encapsulation of a little-endian XCDR1 payload."""
HEADER_BYTES: Final = len(LITTLE_ENDIAN)
DOUBLES: Final = 37
ORIENTATION_W: Final = 3
ORIENTATION_COVARIANCE: Final = 4
GYRO: Final = slice(13, 16)
GYRO_COVARIANCE: Final = 16
ACCEL: Final = slice(25, 28)
ACCEL_COVARIANCE: Final = 28
DIAGONAL: Final = np.array([0, 4, 8])
"""Positions of the variances of x, y and z in a covariance matrix of 9 numbers."""
NOT_PROVIDED: Final = -1.0
FRAME_ID: Final = "imu_link"
"""Default frame_id (REP 145)."""
S_TO_NS: Final = 1_000_000_000
UNKNOWN_VARIANCES: Final = np.zeros(6)


def encode_imu_messages(
    t_ns: Ints, values: Floats, frame_id: str = FRAME_ID, variances: Floats = UNKNOWN_VARIANCES
) -> list[bytes]:
    """Return one little-endian message without orientation for each sample.

    Parameters
    ----------
    t_ns
        [n] times of the samples in nanoseconds since 1970.
    values
        [n, 6] samples in rad/s and m/s². A sensor that is NaN on all its axes is marked as not provided.
    frame_id
        Name of the coordinate frame of the sensor.
    variances
        [6] variances of the samples in rad²/s² and m²/s⁴; 0 if unknown.

    Raises
    ------
    ValueError
        If a time does not fit into the 32-bit seconds of a ROS message, which end in 2038.
    """
    seconds, nanoseconds = np.divmod(t_ns, S_TO_NS)
    if np.any(seconds != seconds.astype(np.int32)):
        raise ValueError("the time of a sample does not fit into a ROS message (years 1901 to 2038)")
    name = frame_id.encode() + b"\0"
    padded = name + bytes(-(12 + len(name)) % 8)
    layout = [("encapsulation", "V4"), ("sec", "<i4"), ("nanosec", "<u4"), ("name_bytes", "<u4")]
    messages = np.zeros(len(t_ns), [*layout, ("name", f"V{len(padded)}"), ("body", "<f8", DOUBLES)])
    messages["encapsulation"], messages["name"] = np.void(LITTLE_ENDIAN), np.void(padded)
    messages["sec"], messages["nanosec"], messages["name_bytes"] = seconds, nanoseconds, len(name)
    body = messages["body"]
    body[:, ORIENTATION_W], body[:, ORIENTATION_COVARIANCE] = 1.0, NOT_PROVIDED
    for part, covariance, columns in (
        (GYRO, GYRO_COVARIANCE, slice(0, 3)),
        (ACCEL, ACCEL_COVARIANCE, slice(3, 6)),
    ):
        absent = np.isnan(values[:, columns]).all(axis=1, keepdims=True)
        body[:, part] = np.where(absent, 0.0, values[:, columns])
        body[:, covariance + DIAGONAL] = np.where(absent, (NOT_PROVIDED, 0.0, 0.0), variances[columns])
    data, size = messages.tobytes(), messages.itemsize
    return [data[at : at + size] for at in range(0, len(data), size)]
