"""Table of the recording formats: the reader and the writer for each file suffix."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

from drivers.errors import ConfigError
from drivers.recordings import (
    ardupilot_log_format,
    csv_format,
    mcap_writer,
    npz_format,
    px4_ulog_format,
    ros_bag_format,
)
from drivers.recordings import parquet_and_arrow_format as arrow_format
from drivers.recordings.table import OpenWriter, Table, describe_suffix_mismatch


@dataclass(frozen=True, slots=True)
class Format:
    """Functions that read and write one recording format."""

    read: Callable[[Path, str | None], Table]
    """Function that reads a file. The second argument is the topic to read, or None."""
    count_rows: Callable[[Path, str | None], int]
    """Function that returns the number of rows without keeping the samples."""
    open_writer: OpenWriter | None = None
    """Function that writes a file; None if the program does not write the format."""
    any_columns: bool = False
    """True if the writer accepts columns of any names, and not only those of a recording."""
    extra: str = ""
    """Extra whose packages read the format; "" if no extra is needed or if the functions check it."""


def _table_format(read: Callable[[Path], Table], open_writer: OpenWriter, count_rows: Callable[[Path], int]) -> Format:
    """Return the format of a table, which has no topics."""

    def refuse_topic(path: Path, topic: str | None) -> None:
        if topic is not None:
            raise ConfigError(f"{path}: contains a single table and no topics; leave out the topic {topic}")

    def read_table(path: Path, topic: str | None) -> Table:
        refuse_topic(path, topic)
        return read(path)

    def count_table_rows(path: Path, topic: str | None) -> int:
        refuse_topic(path, topic)
        return count_rows(path)

    return Format(read_table, count_table_rows, open_writer, any_columns=True)


_ROS_BAG: Final = Format(ros_bag_format.read_ros_bag, ros_bag_format.count_ros_bag_rows, extra="ros")

FORMATS: Final[Mapping[str, Format]] = {
    ".csv": _table_format(csv_format.read_csv, csv_format.open_csv_writer, csv_format.count_csv_rows),
    ".csv.gz": _table_format(
        csv_format.read_csv, partial(csv_format.open_csv_writer, use_gzip=True), csv_format.count_csv_rows
    ),
    ".npz": _table_format(npz_format.read_npz, npz_format.open_npz_writer, npz_format.count_npz_rows),
    ".parquet": _table_format(
        arrow_format.read_parquet, arrow_format.open_parquet_writer, arrow_format.count_parquet_rows
    ),
    ".arrow": _table_format(arrow_format.read_ipc, arrow_format.open_ipc_writer, arrow_format.count_ipc_rows),
    ".feather": _table_format(arrow_format.read_ipc, arrow_format.open_ipc_writer, arrow_format.count_ipc_rows),
    ".arrows": _table_format(
        arrow_format.read_ipc, partial(arrow_format.open_ipc_writer, stream=True), arrow_format.count_ipc_rows
    ),
    ".bag": _ROS_BAG,
    ".db3": _ROS_BAG,
    ".mcap": replace(_ROS_BAG, open_writer=mcap_writer.open_mcap_writer),
    ".ulg": Format(px4_ulog_format.read_ulog, px4_ulog_format.count_ulog_rows, extra="px4"),
    ".bin": Format(
        ardupilot_log_format.read_ardupilot_log, ardupilot_log_format.count_ardupilot_rows, extra="ardupilot"
    ),
}
"""Recording format for each file suffix."""

WRITABLE: Final = tuple(suffix for suffix, one in FORMATS.items() if one.open_writer is not None)
"""Suffixes of the recordings that the program writes."""
WRITABLE_TABLES: Final = tuple(suffix for suffix in WRITABLE if FORMATS[suffix].any_columns)
"""Suffixes of the tables with any columns that the program writes."""


def find_format(path: Path) -> Format:
    """Return the recording format of a file, or of the folder of a ROS 2 bag.

    Raises
    ------
    ConfigError
        If the suffix is unknown.
    """
    if ros_bag_format.is_bag_folder(path):
        return _ROS_BAG
    suffix = _suffix(path)
    if not suffix:
        raise ConfigError(
            f"{path}: the suffix is not that of a recording; known are {' '.join(FORMATS)}"
            f"{describe_suffix_mismatch(path)}"
        )
    return FORMATS[suffix]


def find_writer(path: Path, any_columns: bool = False) -> OpenWriter:
    """Return the function that writes files with a suffix.

    Parameters
    ----------
    path
        File to write.
    any_columns
        True if the columns are not those of a recording.

    Raises
    ------
    ConfigError
        If such files are not written.
    """
    found = find_format(path)
    if any_columns and not found.any_columns:
        raise ConfigError(f"{path}: tables are written as {' '.join(WRITABLE_TABLES)}")
    if found.open_writer is None:
        raise ConfigError(f"{path}: this format is only read; recordings are written as {' '.join(WRITABLE)}")
    return found.open_writer


def is_recording(path: Path) -> bool:
    """Return True if the name has the suffix of a recording format, or if the path is the folder of a ROS 2 bag."""
    return _suffix(path) in FORMATS or ros_bag_format.is_bag_folder(path)


def _suffix(path: Path) -> str:
    name = path.name.lower()
    return next((suffix for suffix in FORMATS if name.endswith(suffix)), "")
