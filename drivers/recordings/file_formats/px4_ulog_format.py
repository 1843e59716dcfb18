"""Read PX4 logs (ULog) with the library pyulog.

The layout of a message is part of the log. These topics contain samples of an IMU (PX4-Autopilot, folder ``msg``):

- ``sensor_combined``: the IMU that the autopilot uses, in rad/s and m/s²
- ``vehicle_imu``: integrals of the angular rate and of the acceleration, which are divided by the integration time;
  ``vehicle_imu_status`` contains the temperature in °C
- ``sensor_gyro`` and ``sensor_accel``: the sensors in rad/s and m/s², with the temperature in °C
- ``sensor_gyro_fifo`` and ``sensor_accel_fifo``: batches of up to 32 unfiltered samples in counts, at the rate of the
  sensor (SDLOG_PROFILE: raw FIFO high-rate IMU)

An autopilot with several IMUs has several instances of a topic, such as ``sensor_gyro:1``.

pyulog reads only the messages of these topics. It needs at most as much memory as the size of the file.
"""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.data_types import AXES, Ints, Times
from drivers.errors import RecordingError, convert_library_errors
from drivers.host.safe_file_reading import open_regular_file
from drivers.recordings import memory_check, table
from drivers.recordings.reading_progress import open_file_and_report_position
from drivers.recordings.topic_selection import JOIN, RecordedTopic, join_topics, select_topics

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
MAX_MESSAGE_BYTES: Final = 0xFFFF
"""Maximum size of a message, because its size is a 16-bit number (ULog file format, section Data)."""
EXPECTED: Final = f"one of the topics {', '.join(one for one in FIELDS if one != 'vehicle_imu_status')}"


def read_ulog(path: Path, topic: str | None) -> table.Table:
    """Read the samples of an IMU from a PX4 log. A log that is cut off is read up to the cut.

    Parameters
    ----------
    path
        File to read.
    topic
        Topic to read, with the number of the instance, such as ``vehicle_imu:1``, or several topics joined by ``+``.
        None selects the only IMU of the log.

    Raises
    ------
    RecordingError
        If the file is no ULog file or contains no IMU.
    ConfigError
        If the topic is unknown, or the samples do not fit into memory.
    """
    notes: list[str] = []
    limit = memory_check.measure_read_limit(path)
    log = _load(path, limit)
    data = _data_by_topic(log)
    names = _select(path, data, topic, notes)
    limit.check_row_count(max(map(_count_rows, map(data.__getitem__, names))))
    if log.file_corruption:
        notes.append("Parts of the log are damaged and were left out.")
    if log.dropouts:
        lost_ms = sum(one.duration for one in log.dropouts)
        notes.append(f"The logger lost messages {len(log.dropouts)} times, for {lost_ms / 1e3:g} s in total.")
    return table.Table(join_topics(path, {name: _read_columns(data[name]) for name in names}), None, notes)


def _load(path: Path, limit: memory_check.RecordingSizeLimits) -> Any:
    """Return the log with the messages of the topics in FIELDS."""
    from pyulog import core

    limit.check_needed_memory(limit.size_bytes)
    vars(core)["print"] = _discard  # pyulog prints warnings about damaged logs to standard output
    with _pyulog_errors(path), open_regular_file(path) as file:
        formats = core.ULog(file, parse_header_only=True).message_formats
        sizes: dict[str, int] = {}
        if any(_message_bytes(formats, name, sizes) > MAX_MESSAGE_BYTES for name in formats):
            raise RecordingError(f"{path}: is damaged: a message has more than {MAX_MESSAGE_BYTES} bytes")
    with _pyulog_errors(path), open_file_and_report_position(path) as file:
        return core.ULog(file, list(FIELDS))


def _discard(*_: object, **__: object) -> None:
    """Ignore text that a library prints."""


def _message_bytes(formats: Mapping[str, Any], name: str, sizes: dict[str, int]) -> int:
    """Return the size of a message with its nested messages.

    If a message contains itself, the returned size exceeds ``MAX_MESSAGE_BYTES``.
    """
    from pyulog.core import ULog

    with suppress(KeyError):  # not a basic type, but a nested message
        return int(ULog.get_field_size(name))
    if name not in sizes:
        sizes[name] = MAX_MESSAGE_BYTES + 1
        fields = formats[name].fields if name in formats else []
        sizes[name] = sum(max(count, 1) * _message_bytes(formats, one, sizes) for one, count, _ in fields)
    return sizes[name]


def _pyulog_errors(path: Path) -> AbstractContextManager[None]:
    return convert_library_errors(
        lambda cause: f"{path}: is no PX4 log ({cause}){table.describe_suffix_mismatch(path)}"
    )


# --- topics --------------------------------------------------------------------------------------


def _data_by_topic(log: Any) -> dict[str, Any]:
    """Return the messages of each topic. Damaged topics without a time are left out."""
    return {
        f"{one.name}:{one.multi_id}" if one.multi_id else str(one.name): one
        for one in log.data_list
        if TIMES[-1] in one.data
    }


def _select(path: Path, data: Mapping[str, Any], topic: str | None, notes: list[str]) -> list[str]:
    """Return the names of the topics to read. The status of ``vehicle_imu`` adds the temperature."""
    topics = [RecordedTopic(name, one.name, _known_columns(one), _count_rows(one)) for name, one in data.items()]
    names = select_topics(path, topics, _list_imus(data), topic, EXPECTED, notes)
    status = names[0].replace("vehicle_imu", "vehicle_imu_status")
    if len(names) == 1 and data[names[0]].name == "vehicle_imu" and status in data:
        return [*names, status]
    return names


def _known_columns(data: Any) -> tuple[str, ...]:
    if data.name in BATCHES:
        batch = {"samples", "dt", "scale", *(f"{field}[{i}]" for field in _XYZ for i in range(BATCH_SIZE))}
        return tuple(FIELDS[data.name]) if batch <= data.data.keys() else ()
    return tuple(column for column, field in FIELDS[data.name].items() if field in data.data)


def _count_rows(data: Any) -> int:
    if data.name in BATCHES and _known_columns(data):
        return int(np.minimum(data.data["samples"], BATCH_SIZE).sum())
    return int(data.data[TIMES[-1]].size)


def _list_imus(data: Mapping[str, Any]) -> Sequence[Sequence[str]]:
    """Return the IMUs of a log, grouped by topic. A gyroscope and an accelerometer with the same number form an IMU."""
    groups = [[name for name, one in data.items() if one.name == kind] for kind in FIELDS]
    combined, integrated, *separate = groups[:-1]
    found = [combined, integrated]
    for gyros, accels in zip(separate[::2], separate[1::2], strict=True):
        pairs = [
            f"{gyro}{JOIN}{accel}" for gyro in gyros for accel in accels if data[gyro].multi_id == data[accel].multi_id
        ]
        found += [pairs] if pairs else [gyros, accels]
    return [group for group in found if group]


# --- messages ------------------------------------------------------------------------------------


def _read_columns(data: Any) -> dict[str, Times]:
    """Return the columns of a topic in SI units, with the times in ns."""
    fields = data.data
    times = next(fields[name] for name in TIMES if name in fields and (name == TIMES[-1] or np.all(fields[name] > 0)))
    if data.name in BATCHES:
        return _read_batches(data, table.integers_to_ns(times, US_NS))
    columns: dict[str, Times] = {table.TIME_NS: table.integers_to_ns(times, US_NS)}
    for column in _known_columns(data):
        field = FIELDS[data.name][column]
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


def _read_batches(data: Any, t_ns: Ints) -> dict[str, Times]:
    """Return the columns of batches. ``t_ns`` [n] are the times of the newest sample of each batch."""
    fields = data.data
    counts = np.minimum(fields["samples"].astype(np.int64), BATCH_SIZE)
    used = np.arange(BATCH_SIZE) < counts[:, None]
    with np.errstate(invalid="ignore"):  # a damaged log may contain NaN or infinity
        age_ns = np.rint(1e3 * fields["dt"].astype(np.float64))[:, None] * (counts[:, None] - 1 - np.arange(BATCH_SIZE))
        age_ns = np.where(np.abs(age_ns) < MAX_AGE_NS, age_ns, 0.0).astype(np.int64)
        scale = fields["scale"].astype(np.float64)[:, None]
        columns: dict[str, Times] = {table.TIME_NS: (t_ns[:, None] - age_ns)[used]}
        for column, field in FIELDS[data.name].items():
            columns[column] = (np.stack([fields[f"{field}[{i}]"] for i in range(BATCH_SIZE)], axis=1) * scale)[used]
    return columns
