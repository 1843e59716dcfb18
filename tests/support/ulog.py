"""PX4 logs, written by the published layout of the ULog file format (docs.px4.io, "ULog File Format")."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

MAGIC: Final = b"ULog\x01\x12\x35\x01"
TYPES: Final = {
    "f4": "float",
    "u8": "uint64_t",
    "u4": "uint32_t",
    "u2": "uint16_t",
    "u1": "uint8_t",
    "i4": "int32_t",
    "i2": "int16_t",
}


@dataclass(frozen=True, slots=True)
class UlogTopic:
    """A topic of a log, with one row of a structured array per message. The first field is ``timestamp`` in µs."""

    name: str
    rows: np.ndarray[Any, np.dtype[np.void]]
    instance: int = 0


def message(kind: str, data: bytes) -> bytes:
    return struct.pack("<HB", len(data), ord(kind)) + data


def field_text(name: str, dtype: np.dtype[Any]) -> str:
    kind = TYPES[dtype.base.str[1:]]
    return f"{kind}[{dtype.shape[0]}] {name};" if dtype.shape else f"{kind} {name};"


def ulog_bytes(topics: Sequence[UlogTopic], dropouts_ms: Sequence[int] = ()) -> bytes:
    """Return a log with the messages of all topics in the order of their times."""
    parts = [MAGIC + struct.pack("<Q", 0), message("B", bytes(40))]
    formats = {}
    for topic in topics:
        dtype = topic.rows.dtype
        assert dtype.names
        formats[topic.name] = "".join(field_text(name, dtype[name]) for name in dtype.names)
    parts += [message("F", f"{name}:{text}".encode()) for name, text in formats.items()]
    parts += [message("A", struct.pack("<BH", one.instance, i) + one.name.encode()) for i, one in enumerate(topics)]
    rows = sorted((int(row["timestamp"]), i, row.tobytes()) for i, one in enumerate(topics) for row in one.rows)
    parts += [message("D", struct.pack("<H", i) + data) for _, i, data in rows]
    parts += [message("O", struct.pack("<H", one)) for one in dropouts_ms]
    return b"".join(parts)


def write_ulog(path: Path, *topics: UlogTopic, dropouts_ms: Sequence[int] = ()) -> Path:
    path.write_bytes(ulog_bytes(topics, dropouts_ms))
    return path


def rows_of(t_us: np.ndarray[Any, Any], **fields: np.ndarray[Any, Any]) -> np.ndarray[Any, np.dtype[np.void]]:
    """Return messages with a time stamp and the given fields of shape [n] or [n, k]."""
    dtype = [("timestamp", "<u8"), *((name, one.dtype.str, one.shape[1:]) for name, one in fields.items())]
    rows = np.zeros(len(t_us), np.dtype(dtype))
    rows["timestamp"] = t_us
    for name, one in fields.items():
        rows[name] = one
    return rows


def sensor_combined(t_us: np.ndarray[Any, Any], values: np.ndarray[Any, Any]) -> UlogTopic:
    """Return the topic ``sensor_combined`` of the values [n, 6] in rad/s and m/s²."""
    values = values.astype("<f4")
    relative = np.zeros(len(t_us), "<i4")
    return UlogTopic(
        "sensor_combined",
        rows_of(
            t_us,
            gyro_rad=values[:, :3],
            accelerometer_timestamp_relative=relative,
            accelerometer_m_s2=values[:, 3:],
        ),
    )


def vehicle_imu(t_us: np.ndarray[Any, Any], values: np.ndarray[Any, Any], dt_us: int, instance: int = 0) -> UlogTopic:
    """Return the topic ``vehicle_imu``: the integrals of the values over ``dt_us``."""
    integrals = (values * dt_us * 1e-6).astype("<f4")
    interval = np.full(len(t_us), dt_us, "<u4")
    return UlogTopic(
        "vehicle_imu",
        rows_of(
            t_us + 500,  # the message is published after the sample
            timestamp_sample=t_us.astype("<u8"),
            delta_angle=integrals[:, :3],
            delta_velocity=integrals[:, 3:],
            delta_angle_dt=interval,
            delta_velocity_dt=interval,
        ),
        instance,
    )


def one_sensor(
    name: str, t_us: np.ndarray[Any, Any], values: np.ndarray[Any, Any], temperature_c: float, instance: int = 0
) -> UlogTopic:
    """Return the topic ``sensor_gyro`` or ``sensor_accel`` of the values [n, 3]."""
    x, y, z = values.astype("<f4").T
    warm = np.full(len(t_us), temperature_c, "<f4")
    return UlogTopic(
        name, rows_of(t_us, timestamp_sample=t_us.astype("<u8"), x=x, y=y, z=z, temperature=warm), instance
    )


def batches(name: str, t_us: np.ndarray[Any, Any], counts: np.ndarray[Any, Any], scale: float) -> UlogTopic:
    """Return the topic ``sensor_gyro_fifo`` or ``sensor_accel_fifo`` of counts [n, 3] in batches of 7 and 8 samples.

    The bytes after the last sample of a batch are those of an earlier batch.
    """
    sizes = np.resize([7, 8], len(counts) // 7)
    ends = np.cumsum(sizes)
    ends = ends[ends <= len(counts)]
    sizes = sizes[: len(ends)]
    xyz = np.full((len(ends), 3, 32), 12_345, "<i2")
    for batch, (end, size) in enumerate(zip(ends, sizes, strict=True)):
        xyz[batch, :, :size] = counts[end - size : end].T
    newest = t_us[ends - 1]
    return UlogTopic(
        name,
        rows_of(
            newest + 200,
            timestamp_sample=newest.astype("<u8"),
            dt=np.full(len(ends), t_us[1] - t_us[0], "<f4"),
            scale=np.full(len(ends), scale, "<f4"),
            samples=sizes.astype("u1"),
            x=xyz[:, 0],
            y=xyz[:, 1],
            z=xyz[:, 2],
        ),
    )
