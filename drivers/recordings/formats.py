"""The formats of recordings by suffix: how each is read and written."""

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
from drivers.recordings.table import Table, Writer, looks_like


@dataclass(frozen=True, slots=True)
class Format:
    """One format."""

    read: Callable[[Path], Table]
    writer: Writer
    count_rows: Callable[[Path], int]
    """Rows of a file, without reading its samples; raises what ``read`` raises."""


FORMATS: Final[Mapping[str, Format]] = {
    ".csv": Format(read_csv, csv_writer, csv_format.count_rows),
    ".csv.gz": Format(read_csv, csv_gz_writer, csv_format.count_rows),
    ".npz": Format(read_npz, npz_writer, npz_format.count_rows),
    ".parquet": Format(read_parquet, parquet_writer, count_rows_parquet),
    ".arrow": Format(read_ipc, ipc_file_writer, count_rows_ipc),
    ".feather": Format(read_ipc, ipc_file_writer, count_rows_ipc),
    ".arrows": Format(read_ipc, ipc_stream_writer, count_rows_ipc),
}
"""Suffixes of recordings, how each is read and written."""


def format_of(path: Path) -> Format:
    """The format of the path's suffix; ConfigError for one that is none."""
    suffix = _suffix(path)
    if not suffix:
        raise ConfigError(f"{path}: not the suffix of a recording; known are {' '.join(FORMATS)}{looks_like(path)}")
    return FORMATS[suffix]


def is_recording(path: Path) -> bool:
    """Whether the path's suffix is that of a recording; the file itself is not looked at."""
    return _suffix(path) in FORMATS


def _suffix(path: Path) -> str:
    name = path.name.lower()
    return next((suffix for suffix in FORMATS if name.endswith(suffix)), "")
