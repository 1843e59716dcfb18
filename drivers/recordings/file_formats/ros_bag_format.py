"""Read ROS 1 bags, ROS 2 bags (SQLite and MCAP) and MCAP files with ROS messages with the library rosbags.

Topics of type ``sensor_msgs/Imu`` contain values in rad/s and m/s². If the first covariance of a quantity is -1, the
message does not provide the quantity (sensor_msgs/Imu.msg). Topics of type ``sensor_msgs/Temperature`` contain values
in °C and can be joined to an IMU. Topics of PX4 (``px4_messages``) are decoded by the definitions in the bag, because
their fields depend on the version of PX4.

Messages are decoded block by block (``ros_message_arrays``). The times are the header stamps. If most messages have no
header stamp, the times of the log are used instead.
"""

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.data_types import AXES, Floats, Ints, Times
from drivers.errors import RecordingError, convert_library_errors
from drivers.host.safe_file_reading import check_regular_file, open_regular_file
from drivers.recordings import memory_check, table
from drivers.recordings.file_formats.px4_messages import (
    FIELDS,
    TIMES,
    count_samples,
    list_columns,
    list_imus,
    read_columns,
)
from drivers.recordings.file_formats.ros_message_arrays import (
    IMU_TYPE,
    TEMPERATURE_TYPE,
    decode_fixed_messages,
    decode_messages,
    iter_message_blocks,
)
from drivers.recordings.reading_progress import report_read_share
from drivers.recordings.topic_selection import JOIN, RecordedTopic, join_topics, pair_triads, select_topics

METADATA: Final = "metadata.yaml"
"""File that identifies a folder as a ROS 2 bag."""
STORAGE_SUFFIXES: Final = (".db3", ".mcap", ".zstd")
PX4_TYPES: Final = {f"px4_msgs/msg/{kind.title().replace('_', '')}": kind for kind in FIELDS}
"""Kind of the messages of PX4 for each type."""
COLUMNS_OF_TYPES: Final[Mapping[str, tuple[str, ...]]] = {
    IMU_TYPE: AXES,
    TEMPERATURE_TYPE: ("temperature",),
    **{message_type: tuple(FIELDS[kind]) for message_type, kind in PX4_TYPES.items()},
}
TRIAD: Final = re.compile("gyro|accel")
"""Part of a name that differs between the topics of a gyroscope and of an accelerometer of the same sensor."""
MIN_LOG_NS: Final = 1_000_000_000
"""Log time in ns at and after which a stamp of 0 counts as missing. The times of a simulation begin at 0."""
MAX_METADATA_BYTES: Final = 4_000_000
EXPECTED: Final = "messages of type sensor_msgs/Imu or px4_msgs/SensorCombined"
REPAIRS: Final[Mapping[str, str]] = {
    ".bag": "if it is cut off or was not closed, `rosbag reindex {}` writes its index",
    ".mcap": "`mcap recover {} -o recovered.mcap` copies the intact messages",
    ".db3": "if it is cut off, `sqlite3 {} .recover | sqlite3 recovered.db3` copies the intact messages",
}
REINDEX: Final = "`ros2 bag reindex` writes the metadata again"


def is_bag_folder(path: Path) -> bool:
    """Return True if a folder contains the metadata of a ROS 2 bag."""
    return (path / METADATA).is_file()


def read_ros_bag(path: Path, topic: str | None) -> table.Table:
    """Read the samples of an IMU from a bag.

    Parameters
    ----------
    path
        Folder with a ROS 2 bag, or a file of type .bag, .db3 or .mcap.
    topic
        Topic to read, or several topics joined by ``+``. None selects the only topic of type ``sensor_msgs/Imu``.

    Raises
    ------
    RecordingError
        If the bag is damaged or contains no IMU.
    ConfigError
        If the topic is unknown, or the samples do not fit into memory.
    """
    notes: list[str] = []
    with _bag_errors(path), _open_bag(path) as (bag, limit):
        names = bag.select(path, topic, notes)
        limit.check_row_count(sum(one.rows for one in bag.topics if one.name in names))
        tables: dict[str, table.Columns] = {name: _read_topic(bag, name, limit, notes) for name in names}
    return table.Table(join_topics(path, tables, notes), None, notes)


@dataclass(frozen=True, slots=True)
class _Bag:
    """An open bag."""

    connections: Sequence[Any]
    topics: Sequence[RecordedTopic]
    messages: Callable[[Sequence[Any]], Iterable[tuple[Any, int, bytes]]]
    cdr: bool  # True for messages of ROS 2, False for messages of ROS 1

    def select(self, path: Path, topic: str | None, notes: list[str]) -> list[str]:
        """Return the names of the topics to read."""
        readable = {one.name: one.message_type for one in self.topics if one.rows}
        imus = [name for name, kind in readable.items() if kind == IMU_TYPE]
        gyros, accels = ([name for name in imus if triad in name] for triad in ("gyro", "accel"))
        pairs = pair_triads(gyros, accels, lambda name: TRIAD.sub("", name))
        imus = [*pairs, *(name for name in imus if not any(name in pair.split(JOIN) for pair in pairs))]
        of_px4 = {name: (PX4_TYPES[kind], TRIAD.sub("", name)) for name, kind in readable.items() if kind in PX4_TYPES}
        return select_topics(path, self.topics, [*([imus] if imus else []), *list_imus(of_px4)], topic, EXPECTED, notes)


@contextmanager
def _open_bag(path: Path) -> Iterator[tuple[_Bag, memory_check.RecordingSizeLimits]]:
    """Check the files of a bag and open the bag."""
    from drivers.recordings.file_formats import ros_bag_readers as readers

    limit = _check_files(path)
    # The definitions of sensor_msgs are not used, since both types are the same in all versions of ROS 1 and of ROS 2.
    if path.suffix.lower() == ".bag":
        with readers.Ros1Reader(path) as bag1:
            topics = _list_topics(bag1.connections, bag1.count_messages())
            yield _Bag(bag1.connections, topics, bag1.messages, cdr=False), limit
    else:
        with readers.Ros2Reader(path) as bag2:
            topics = _list_topics(bag2.connections, {one.id: one.msgcount for one in bag2.connections})
            yield _Bag(bag2.connections, topics, bag2.messages, bag2.is_cdr), limit


def _bag_errors(path: Path) -> AbstractContextManager[None]:
    def describe(cause: str) -> str:
        text = cause.partition(": (")[0]  # rosbags appends the arguments of the first exception
        return f"{path}: is no complete bag ({text}){_describe_remedy(path, cause)}"

    return convert_library_errors(describe)


def _describe_remedy(path: Path, cause: str) -> str:
    if path.is_file() and is_bag_folder(path.parent) and "malformed" not in cause:
        return f"; read the folder {path.parent}, whose {METADATA} states how the messages are compressed"
    mismatch = table.describe_suffix_mismatch(path) if path.is_file() else ""
    damaged = [path]
    if path.is_dir() and "malformed" in cause:  # of several files, the cause names the damaged one
        damaged = sorted(path.glob("*.db3"), key=lambda one: str(one) not in cause)[:1]
    return mismatch or "; " + REPAIRS.get("".join(one.suffix.lower() for one in damaged), REINDEX).format(
        *(one.name for one in damaged)
    )


def _list_topics(connections: Iterable[Any], counts: Mapping[int, int]) -> list[RecordedTopic]:
    """Return the topics of a bag. Several connections may publish on the same topic."""
    rows: dict[tuple[str, str], int] = defaultdict(int)
    for connection in connections:
        rows[connection.topic, connection.msgtype] += counts.get(connection.id, 0)
    return [
        RecordedTopic(name, kind, COLUMNS_OF_TYPES.get(kind, ()), count) for (name, kind), count in sorted(rows.items())
    ]


def _check_files(path: Path) -> memory_check.RecordingSizeLimits:
    """Return the size limits of a bag. Raise an error if a file is not a regular file or too large."""
    from drivers.recordings.file_formats.ros_bag_readers import iter_unpacked

    files = [path]
    if path.is_dir():
        files = [path / METADATA, *sorted(one for one in path.iterdir() if one.suffix in STORAGE_SUFFIXES)]
    for file in files:
        check_regular_file(file)
    if path.is_dir() and files[0].stat().st_size > MAX_METADATA_BYTES:
        raise RecordingError(f"{files[0]}: has more than {MAX_METADATA_BYTES} bytes; {REINDEX}")
    size_bytes = sum(file.stat().st_size for file in files)
    limit = memory_check.RecordingSizeLimits(path, size_bytes, memory_check.available_bytes())
    unpacked = 0
    for file in files:
        if file.suffix == ".zstd":  # rosbags unpacks the file to the folder for temporary files
            with open_regular_file(file) as packed:
                for piece in iter_unpacked(packed, "zstd"):
                    unpacked += len(piece)
                    limit.check_unpacked_size(unpacked)
    return limit


# --- messages ------------------------------------------------------------------------------------


def _read_topic(bag: _Bag, name: str, limit: memory_check.RecordingSizeLimits, notes: list[str]) -> dict[str, Times]:
    """Return the columns of a topic, with the times in ns. Quantities that no message provides are absent."""
    kind = next(one.message_type for one in bag.topics if one.name == name and one.columns)
    if kind in PX4_TYPES:
        return _read_px4_topic(bag, name, kind, limit)
    t_ns, numbers, unstamped = _read_messages(bag, name, kind, limit, use_log_times=False)
    if 2 * unstamped > t_ns.size:
        what = f"{unstamped} of {t_ns.size} messages of {name} have no header stamp"
        notes.append(f"{what}; the times of the log are used.")
        t_ns, numbers, _ = _read_messages(bag, name, kind, limit, use_log_times=True)
    columns: dict[str, Times] = {table.TIME_NS: t_ns}
    columns |= {column: numbers[:, i] for i, column in enumerate(COLUMNS_OF_TYPES[kind])}
    if kind == IMU_TYPE:
        # The maximum is NaN only if all values are. A mask of all rows would need more memory.
        absent = [axis for axis in AXES if np.isnan(np.fmax.reduce(columns[axis]))]
        zero = [axis for axis in AXES if axis not in absent and not columns[axis].any()]
        absent += zero if zero in ([*AXES[:3]], [*AXES[3:]]) else []  # a camera publishes 0 for the other triad
        if absent:
            notes.append(f"The messages of {name} do not provide {' '.join(absent)}.")
        for axis in absent:
            del columns[axis]
    return columns


def _read_px4_topic(bag: _Bag, name: str, kind: str, limit: memory_check.RecordingSizeLimits) -> dict[str, Times]:
    """Return the columns of a topic of PX4, with the times in ns."""
    from drivers.recordings.file_formats.ros_bag_readers import list_fixed_fields

    connections = [one for one in bag.connections if one.topic == name and one.msgtype == kind]
    definitions = {list_fixed_fields(one) for one in connections}
    if definitions == {()}:
        raise RecordingError(
            f"{limit.path}: contains no definition of {kind}; in a workspace with px4_msgs, "
            "`ros2 bag convert -i FOLDER -o options.yaml` writes a bag that contains it, if options.yaml is "
            f"{{output_bags: [{{uri: converted, storage_id: mcap, topics: [{name}]}}]}}"
        )
    if len(definitions) > 1:
        raise RecordingError(f"{limit.path}: contains several definitions of {kind}; split the bag by time")
    (definition,) = definitions
    px4_kind = PX4_TYPES[kind]
    parts, end = [], 0
    for _, block in iter_message_blocks(bag.messages(connections)):
        end += len(block)
        limit.check_row_count(end)
        try:
            parts.append(decode_fixed_messages(block, definition))
        except ValueError as error:
            raise RecordingError(
                f"{limit.path}: topic {name}: {error}; record it with the px4_msgs of the PX4 that sends it"
            ) from error
    messages = np.concatenate(parts)
    fields = {one: messages[one] for one, _, count in definition if not count}
    fields |= {f"{one}[{i}]": messages[one][:, i] for one, _, count in definition for i in range(count)}
    if TIMES[-1] not in fields or not list_columns(px4_kind, fields):
        raise RecordingError(f"{limit.path}: the definition of {kind} lacks {TIMES[-1]}, or the fields of an IMU")
    limit.check_row_count(count_samples(px4_kind, fields))
    return read_columns(px4_kind, fields)


def _read_messages(
    bag: _Bag, name: str, kind: str, limit: memory_check.RecordingSizeLimits, use_log_times: bool
) -> tuple[Ints, Floats, int]:
    """Return the times [n] in ns, the numbers [n, columns], and the number of messages without a header stamp.

    The arrays are allocated only once, so the additional memory does not grow with the length of the bag.
    """
    connections = [one for one in bag.connections if one.topic == name and one.msgtype == kind]
    rows = sum(one.rows for one in bag.topics if one.name == name and one.message_type == kind)
    t_ns, numbers = np.empty(rows, np.int64), np.empty((rows, len(COLUMNS_OF_TYPES[kind])))
    end = unstamped = 0
    for log_times, block in iter_message_blocks(bag.messages(connections)):
        start, end = end, end + len(block)
        limit.check_row_count(end)
        report_read_share(end, rows)
        if end > len(t_ns):  # the index states too few messages
            t_ns, numbers = np.resize(t_ns, 2 * end), np.resize(numbers, (2 * end, numbers.shape[1]))
        stamps_ns, numbers[start:end] = decode_messages(block, kind, bag.cdr)
        log_ns = np.array(log_times, np.int64)
        missing = (stamps_ns == 0) & (log_ns >= MIN_LOG_NS)
        unstamped += int(np.count_nonzero(missing))
        t_ns[start:end] = log_ns if use_log_times else np.where(missing, table.NO_TIME_NS, stamps_ns)
    return (t_ns, numbers, unstamped) if end == len(t_ns) else (t_ns[:end], numbers[:end], unstamped)
