"""Table of the recording formats by file suffix, with their readers and writers."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from drivers.errors import ConfigError
from drivers.recordings import csv_format, npz_format
from drivers.recordings.arrow_format import (
    count_rows_ipc,
    count_rows_parquet,
    ipc_file_writer,
    ipc_stream_writer,
    parquet_writer,
    read_ipc,
    read_parquet,
)
from drivers.recordings.csv_format import csv_gz_writer, csv_writer, read_csv
from drivers.recordings.npz_format import npz_writer, read_npz
from drivers.recordings.table import Table, Writer, describe_content


@dataclass(frozen=True, slots=True)
class Format:
    """Functions that read, write and measure files of one format."""

    read: Callable[[Path], Table]
    writer: Writer
    count_rows: Callable[[Path], int]
    """Return the number of rows of a file without reading its samples. It raises the same exceptions as ``read``."""


FORMATS: Final[Mapping[str, Format]] = {
    ".csv": Format(read_csv, csv_writer, csv_format.count_rows),
    ".csv.gz": Format(read_csv, csv_gz_writer, csv_format.count_rows),
    ".npz": Format(read_npz, npz_writer, npz_format.count_rows),
    ".parquet": Format(read_parquet, parquet_writer, count_rows_parquet),
    ".arrow": Format(read_ipc, ipc_file_writer, count_rows_ipc),
    ".feather": Format(read_ipc, ipc_file_writer, count_rows_ipc),
    ".arrows": Format(read_ipc, ipc_stream_writer, count_rows_ipc),
}
"""Suffixes of recordings, with the format of each."""


def format_for_path(path: Path) -> Format:
    """Return the format for the suffix of a path.

    Raises
    ------
    ConfigError
        The suffix is not that of a recording.
    """
    suffix = _suffix(path)
    if not suffix:
        raise ConfigError(
            f"{path}: not the suffix of a recording; known are {' '.join(FORMATS)}{describe_content(path)}"
        )
    return FORMATS[suffix]


def is_recording(path: Path) -> bool:
    """Return True if the suffix of a path is that of a recording. The file itself is not opened."""
    return _suffix(path) in FORMATS


def _suffix(path: Path) -> str:
    """Return the suffix of a path if it is one of FORMATS, otherwise ""."""
    name = path.name.lower()
    return next((suffix for suffix in FORMATS if name.endswith(suffix)), "")
