"""Table of the recording formats: the reader and the writer for each file suffix."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

from drivers.errors import ConfigError
from drivers.recordings.file_formats import (
    ardupilot_log_format,
    csv_format,
    csv_per_sensor_format,
    matlab_format,
    mcap_writer,
    npz_format,
    px4_ulog_format,
    ros_bag_format,
)
from drivers.recordings.file_formats import parquet_and_arrow_format as arrow_format
from drivers.recordings.file_formats.csv_header import is_table_text
from drivers.recordings.file_formats.csv_row_kinds import contains_row_kinds
from drivers.recordings.reading_options import ReadingOptions
from drivers.recordings.table import OpenWriter, Table, describe_suffix_mismatch
from drivers.recordings.table_layout import convert_to_si


@dataclass(frozen=True, slots=True)
class Format:
    """Functions that read and write one recording format."""

    read: Callable[[Path, ReadingOptions], Table]
    """Function that reads a file."""
    open_writer: OpenWriter | None = None
    """Function that writes a file, or None if the program does not write the format."""
    any_columns: bool = False
    """True if the writer accepts columns of any names, and not only those of a recording."""
    extra: str = ""
    """Extra with the packages for the format, or "" if none is needed or if the functions check for it."""


def _table_format(read: Callable[[Path, ReadingOptions], Table], open_writer: OpenWriter | None) -> Format:
    """Return the format of a file that contains a single table and no topics."""

    def read_table(path: Path, options: ReadingOptions) -> Table:
        return convert_to_si(path, read(path, options), options)

    return Format(read_table, open_writer, any_columns=True)


def _log_format(read: Callable[[Path, str | None], Table], extra: str) -> Format:
    """Return the format of a log that contains topics. The messages of the log determine the columns."""

    def read_log(path: Path, options: ReadingOptions) -> Table:
        for option, given in (("--columns", options.columns), ("--time-unit", options.time_unit)):
            if given:
                raise ConfigError(f"{path}: the messages of this log determine columns and times; leave out {option}")
        return convert_to_si(path, read(path, options.topic), options)

    return Format(read_log, extra=extra)


_SENSOR_FILES: Final = Format(csv_per_sensor_format.read_sensor_files)
_ROS_BAG: Final = _log_format(ros_bag_format.read_ros_bag, "ros")


FORMATS: Final[Mapping[str, Format]] = {
    ".csv": _table_format(csv_format.read_csv, csv_format.open_csv_writer),
    ".csv.gz": _table_format(csv_format.read_csv, partial(csv_format.open_csv_writer, use_gzip=True)),
    ".npz": _table_format(npz_format.read_npz, npz_format.open_npz_writer),
    ".parquet": _table_format(arrow_format.read_parquet, arrow_format.open_parquet_writer),
    ".arrow": _table_format(arrow_format.read_ipc, arrow_format.open_ipc_writer),
    ".feather": _table_format(arrow_format.read_ipc, arrow_format.open_ipc_writer),
    ".arrows": _table_format(arrow_format.read_ipc, partial(arrow_format.open_ipc_writer, stream=True)),
    ".mat": _table_format(matlab_format.read_matlab, None),
    ".zip": _SENSOR_FILES,
    ".bag": _ROS_BAG,
    ".db3": _ROS_BAG,
    ".mcap": replace(_ROS_BAG, open_writer=mcap_writer.open_mcap_writer),
    ".ulg": _log_format(px4_ulog_format.read_ulog, "px4"),
    ".bin": _log_format(ardupilot_log_format.read_ardupilot_log, "ardupilot"),
}
"""Recording format for each file suffix."""

WRITABLE: Final = tuple(suffix for suffix, one in FORMATS.items() if one.open_writer is not None)
"""Suffixes of the recordings that the program writes."""
WRITABLE_TABLES: Final = tuple(suffix for suffix in WRITABLE if FORMATS[suffix].any_columns)
"""Suffixes of the formats in which the program writes tables with columns of any names."""


def find_format(path: Path) -> Format:
    """Return the recording format of a file, or of a folder that contains a single recording.

    Raises
    ------
    ConfigError
        If the suffix is unknown.
    """
    if ros_bag_format.is_bag_folder(path):
        return _ROS_BAG
    if csv_per_sensor_format.is_sensor_folder(path):
        return _SENSOR_FILES
    suffix = _suffix(path)
    if suffix in ("", ".csv") and path.is_file():
        if contains_row_kinds(path):
            return _SENSOR_FILES
        suffix = suffix or (".csv" if is_table_text(path) else "")
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
        If the program does not write this format.
    """
    found = FORMATS.get(_suffix(path))
    if found is None or found.open_writer is None or (any_columns and not found.any_columns):
        what = "the suffix is unknown" if found is None else "this format is not written"
        content, suffixes = ("tables", WRITABLE_TABLES) if any_columns else ("recordings", WRITABLE)
        raise ConfigError(f"{path}: {what}; {content} are written as {' '.join(suffixes)}")
    return found.open_writer


def is_recording(path: Path) -> bool:
    """Return True if the name has the suffix of a recording format, or if the folder contains a single recording."""
    return _suffix(path) in FORMATS or is_recording_folder(path)


def is_recording_folder(path: Path) -> bool:
    """Return True if a folder contains a single recording: a ROS 2 bag, or one CSV file per sensor."""
    return ros_bag_format.is_bag_folder(path) or csv_per_sensor_format.is_sensor_folder(path)


def _suffix(path: Path) -> str:
    name = path.name.lower()
    return next((suffix for suffix in FORMATS if name.endswith(suffix)), "")
