"""Table of the recording formats: the reader and the writer for each file suffix."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from drivers.errors import ConfigError
from drivers.recordings import csv_format, npz_format
from drivers.recordings import parquet_and_arrow_format as arrow_format
from drivers.recordings.table import OpenWriter, Table, describe_suffix_mismatch


@dataclass(frozen=True, slots=True)
class Format:
    """Functions that read and write one recording format."""

    read: Callable[[Path], Table]
    open_writer: OpenWriter
    count_rows: Callable[[Path], int]
    """Function that returns the number of rows without reading the samples."""


FORMATS: Final[Mapping[str, Format]] = {
    ".csv": Format(csv_format.read_csv, csv_format.open_csv_writer, csv_format.count_csv_rows),
    ".csv.gz": Format(
        csv_format.read_csv, partial(csv_format.open_csv_writer, use_gzip=True), csv_format.count_csv_rows
    ),
    ".npz": Format(npz_format.read_npz, npz_format.open_npz_writer, npz_format.count_npz_rows),
    ".parquet": Format(arrow_format.read_parquet, arrow_format.open_parquet_writer, arrow_format.count_parquet_rows),
    ".arrow": Format(arrow_format.read_ipc, arrow_format.open_ipc_writer, arrow_format.count_ipc_rows),
    ".feather": Format(arrow_format.read_ipc, arrow_format.open_ipc_writer, arrow_format.count_ipc_rows),
    ".arrows": Format(
        arrow_format.read_ipc, partial(arrow_format.open_ipc_writer, stream=True), arrow_format.count_ipc_rows
    ),
}
"""Recording format for each file suffix."""


def find_format(path: Path) -> Format:
    """Return the recording format for a file suffix. Raise ConfigError if the suffix is unknown."""
    suffix = _suffix(path)
    if not suffix:
        raise ConfigError(
            f"{path}: the suffix is not that of a recording; known are {' '.join(FORMATS)}"
            f"{describe_suffix_mismatch(path)}"
        )
    return FORMATS[suffix]


def is_recording(path: Path) -> bool:
    """Return True if the file name has the suffix of a recording format."""
    return _suffix(path) in FORMATS


def _suffix(path: Path) -> str:
    name = path.name.lower()
    return next((suffix for suffix in FORMATS if name.endswith(suffix)), "")
