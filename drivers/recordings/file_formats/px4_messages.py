"""Messages of PX4 that contain samples of an IMU, whose fields have the same names in ULog files and in ROS 2 bags.

- ``sensor_combined``: the IMU that the autopilot uses, in rad/s and m/s²
- ``vehicle_imu``: integrals of the angular rate and of the acceleration, which are divided by the integration time;
  ``vehicle_imu_status`` contains the temperature in °C
- ``sensor_gyro`` and ``sensor_accel``: the sensors in rad/s and m/s², with the temperature in °C
- ``sensor_gyro_fifo`` and ``sensor_accel_fifo``: batches of up to 32 unfiltered samples in counts, at the rate of the
  sensor (SDLOG_PROFILE: raw FIFO high-rate IMU)

Source: PX4-Autopilot, folder ``msg``.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Ints, Times
from drivers.recordings import table
from drivers.recordings.topic_selection import pair_triads

Fields = Mapping[str, NDArray[Any]]
"""Array [n] of each field of n messages. The name of an element of an array ends with its index, as in ``x[0]``."""

_XYZ: Final = ("x", "y", "z")
FIELDS: Final[Mapping[str, Mapping[str, str]]] = {
    "sensor_combined": {
        **{axis: f"gyro_rad[{i}]" for i, axis in enumerate(AXES[:3])},
        **{axis: f"accelerometer_m_s2[{i}]" for i, axis in enumerate(AXES[3:])},
    },
    "vehicle_imu": {
        **{axis: f"delta_angle[{i}]" for i, axis in enumerate(AXES[:3])},
        **{axis: f"delta_velocity[{i}]" for i, axis in enumerate(AXES[3:])},
    },
    "sensor_gyro": {**dict(zip(AXES[:3], _XYZ, strict=True)), "temperature": "temperature"},
    "sensor_accel": {**dict(zip(AXES[3:], _XYZ, strict=True)), "temperature": "temperature"},
    "sensor_gyro_fifo": dict(zip(AXES[:3], _XYZ, strict=True)),
    "sensor_accel_fifo": dict(zip(AXES[3:], _XYZ, strict=True)),
    "vehicle_imu_status": {"temperature": "temperature_gyro"},
}
"""For each topic: the field that contains each column of a recording. The fields of a batch are arrays."""
BATCHES: Final = ("sensor_gyro_fifo", "sensor_accel_fifo")
BATCH_SIZE: Final = 32
"""Maximum number of samples in a batch (SensorGyroFifo.msg)."""
TIMES: Final = ("timestamp_sample", "timestamp")
"""Fields that contain the time since the start of the autopilot in µs. The first field is the time of the sample."""
US_NS: Final = 1000
"""One microsecond in ns."""
MAX_AGE_NS: Final = 1e9
"""Maximum age of a sample in a batch. A higher age is that of a damaged message."""
INTEGRATION_TIMES: Final = {"delta_angle": ("delta_angle_dt", "dt"), "delta_velocity": ("delta_velocity_dt", "dt")}
"""For each integral: the fields that contain the integration time in µs, in new and in old logs."""
ACCEL_TIME: Final = "accelerometer_timestamp_relative"
INVALID_ACCEL_TIME: Final = 0x7FFFFFFF
"""Value of ACCEL_TIME if a message contains no new sample of the accelerometer (sensor_combined.msg)."""


def list_columns(kind: str, names: Collection[str]) -> tuple[str, ...]:
    """Return the columns of a recording that the fields of messages contain. ``kind`` is a key of FIELDS."""
    if kind in BATCHES:
        batch = {"samples", "dt", "scale", *(f"{field}[{i}]" for field in _XYZ for i in range(BATCH_SIZE))}
        return tuple(FIELDS[kind]) if batch <= {*names} else ()
    return tuple(column for column, field in FIELDS[kind].items() if field in names)


def count_samples(kind: str, fields: Fields) -> int:
    """Return the number of samples in messages."""
    if kind in BATCHES and list_columns(kind, fields):
        return int(np.minimum(fields["samples"], BATCH_SIZE).sum())
    return int(fields[TIMES[-1]].size)


def list_imus(topics: Mapping[str, tuple[str, object]]) -> Sequence[Sequence[str]]:
    """Return the IMUs among topics, grouped by kind.

    Parameters
    ----------
    topics
        Kind and instance of each topic. A gyroscope and an accelerometer with the same instance form an IMU.
    """
    groups = [[name for name, (kind, _) in topics.items() if kind == one] for one in FIELDS]
    combined, integrated, *separate = groups[:-1]
    found = [combined, integrated]
    for gyros, accels in zip(separate[::2], separate[1::2], strict=True):
        pairs = pair_triads(gyros, accels, lambda name: topics[name][1])
        found += [pairs] if pairs else [gyros, accels]
    return [group for group in found if group]


def read_columns(kind: str, fields: Fields) -> dict[str, Times]:
    """Return the columns of messages in SI units, with the times in ns."""
    times = next(fields[name] for name in TIMES if name in fields and (name == TIMES[-1] or np.all(fields[name] > 0)))
    if kind in BATCHES:
        return _read_batches(kind, fields, table.integers_to_ns(times, US_NS))
    columns: dict[str, Times] = {table.TIME_NS: table.integers_to_ns(times, US_NS)}
    for column in list_columns(kind, fields):
        field = FIELDS[kind][column]
        with np.errstate(invalid="ignore"):  # a damaged log may contain signalling NaN
            columns[column] = fields[field].astype(np.float64)
        for integral, interval_names in INTEGRATION_TIMES.items():
            if field.startswith(integral):
                interval_us = next((fields[name] for name in interval_names if name in fields), np.zeros(times.size))
                interval_s = np.where(interval_us > 0, interval_us, np.nan) * 1e-6
                columns[column] /= interval_s
    if ACCEL_TIME in fields:
        for axis in set(AXES[3:]) & columns.keys():
            columns[axis][fields[ACCEL_TIME] == INVALID_ACCEL_TIME] = np.nan
    return columns


def _read_batches(kind: str, fields: Fields, t_ns: Ints) -> dict[str, Times]:
    """Return the columns of batches. ``t_ns`` [n] are the times of the newest sample of each batch."""
    counts = np.minimum(fields["samples"].astype(np.int64), BATCH_SIZE)
    used = np.arange(BATCH_SIZE) < counts[:, None]
    with np.errstate(invalid="ignore"):  # a damaged log may contain NaN or infinity
        age_ns = np.rint(1e3 * fields["dt"].astype(np.float64))[:, None] * (counts[:, None] - 1 - np.arange(BATCH_SIZE))
        age_ns = np.where(np.abs(age_ns) < MAX_AGE_NS, age_ns, 0.0).astype(np.int64)
        scale = fields["scale"].astype(np.float64)[:, None]
        columns: dict[str, Times] = {table.TIME_NS: (t_ns[:, None] - age_ns)[used]}
        for column, field in FIELDS[kind].items():
            columns[column] = (np.stack([fields[f"{field}[{i}]"] for i in range(BATCH_SIZE)], axis=1) * scale)[used]
    return columns
