"""Read PX4 logs (ULog) with the library pyulog.

The layout of a message is part of the log. ``px4_messages`` describes the topics that contain samples of an IMU. An
autopilot with several IMUs has several instances of a topic, such as ``sensor_gyro:1``.

pyulog reads only the messages of these topics. It needs at most as much memory as the size of the file.
"""

from collections.abc import Mapping
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any, Final

from drivers.errors import RecordingError, convert_library_errors
from drivers.host.safe_file_reading import open_regular_file
from drivers.recordings import memory_check, table
from drivers.recordings.file_formats.px4_messages import (
    FIELDS,
    TIMES,
    count_samples,
    list_columns,
    list_imus,
    read_columns,
)
from drivers.recordings.reading_progress import open_file_and_report_position
from drivers.recordings.topic_selection import RecordedTopic, join_topics, select_topics

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
    limit.check_row_count(max(count_samples(data[name].name, data[name].data) for name in names))
    if log.file_corruption:
        notes.append("Parts of the log are damaged and were left out.")
    if log.dropouts:
        lost_ms = sum(one.duration for one in log.dropouts)
        notes.append(f"The logger lost messages {len(log.dropouts)} times, for {lost_ms / 1e3:g} s in total.")
    tables = {name: read_columns(data[name].name, data[name].data) for name in names}
    return table.Table(join_topics(path, tables, notes), None, notes)


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
    topics = [
        RecordedTopic(name, one.name, list_columns(one.name, one.data), count_samples(one.name, one.data))
        for name, one in data.items()
    ]
    imus = list_imus({name: (one.name, one.multi_id) for name, one in data.items()})
    names = select_topics(path, topics, imus, topic, EXPECTED, notes)
    status = names[0].replace("vehicle_imu", "vehicle_imu_status")
    if len(names) == 1 and data[names[0]].name == "vehicle_imu" and status in data:
        return [*names, status]
    return names
