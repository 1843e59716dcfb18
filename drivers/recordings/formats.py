"""Table of the recording formats by file suffix, with their readers and writers."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from drivers.errors import ConfigError
from drivers.recordings.arrow_format import (
    count_ipc_rows,
    count_parquet_rows,
    open_ipc_writer,
    open_parquet_writer,
    read_ipc,
    read_parquet,
)
from drivers.recordings.csv_format import count_csv_rows, open_csv_writer, read_csv
from drivers.recordings.npz_format import count_npz_rows, open_npz_writer, read_npz
from drivers.recordings.table import OpenWriter, Table, describe_content


@dataclass(frozen=True, slots=True)
class Format:
    """Functions that read, write and measure files of one format."""

    read: Callable[[Path], Table]
    open_writer: OpenWriter
    count_rows: Callable[[Path], int]
    """Return the number of rows of a file without reading the samples. The exceptions are those of ``read``."""


FORMATS: Final[Mapping[str, Format]] = {
    ".csv": Format(read_csv, open_csv_writer, count_csv_rows),
    ".csv.gz": Format(read_csv, partial(open_csv_writer, packed=True), count_csv_rows),
    ".npz": Format(read_npz, open_npz_writer, count_npz_rows),
    ".parquet": Format(read_parquet, open_parquet_writer, count_parquet_rows),
    ".arrow": Format(read_ipc, open_ipc_writer, count_ipc_rows),
    ".feather": Format(read_ipc, open_ipc_writer, count_ipc_rows),
    ".arrows": Format(read_ipc, partial(open_ipc_writer, stream=True), count_ipc_rows),
}
"""Formats of recordings by suffix."""


def find_format(path: Path) -> Format:
    """Return the format for the suffix of a path. Raise ConfigError if no format of recordings has the suffix."""
    suffix = _suffix(path)
    if not suffix:
        raise ConfigError(
            f"{path}: the suffix is not that of a recording; known are {' '.join(FORMATS)}{describe_content(path)}"
        )
    return FORMATS[suffix]


def is_recording(path: Path) -> bool:
    """Return True if a format of recordings has the suffix of a path. The file itself is not opened."""
    return _suffix(path) in FORMATS


def _suffix(path: Path) -> str:
    """Return the suffix of a path if it is one of FORMATS, otherwise ""."""
    name = path.name.lower()
    return next((suffix for suffix in FORMATS if name.endswith(suffix)), "")
