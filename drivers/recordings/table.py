"""Types and functions that all recording formats share."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, NS_PER_S, Floats, Ints, Times, times_to_seconds
from drivers.errors import RecordingError
from drivers.host.safe_file_reading import open_regular_file
from drivers.recordings import memory_check

COLUMNS: Final = ("t", *AXES, "temperature")
"""Names of the columns that the readers recognize."""

SENSOR: Final = "sensor"
"""Column that tells the rows of several sensors apart, if a table has one."""

TIME_NS: Final = "t_ns"
"""Column of the times in ns as int64. It replaces ``t`` if the source contains times in whole ns, µs or ms, because
float64 would round Unix times to 0.24 µs."""

NO_TIME_NS: Final = int(np.iinfo(np.int64).min)
"""Value of a missing time in the column ``t_ns``."""

ALIASES: Final = {"temp": "temperature"}
"""Alternative column names, each mapped to the name in COLUMNS."""

POSSIBLE_TIMES: Final = "A column increases steadily:"
"""Start of the note about a column that contains times or a counter."""

EXAMPLE_HEADER: Final = "t,gx,gy,gz,ax,ay,az"
"""Example of a header line, quoted in error messages."""

BATCH_ROWS: Final = 1 << 16
"""Maximum number of rows that are written at once. A truncated Arrow file loses at most this many complete rows."""

T_LIMIT_S: Final = 4.6e9
"""Largest absolute time in s for which the difference of two times fits into int64 nanoseconds."""

PARTIAL_SUFFIX: Final = ".part"
"""Suffix that is added to a file name while the file is being written."""

T = TypeVar("T", Floats, Ints, Times)

Columns = Mapping[str, Times]
"""Mapping from names in COLUMNS to float64 arrays [n] of equal length, and from TIME_NS to an int64 array."""

AppendColumns = Callable[[Columns], None]
"""Function that appends rows to a file that is being written."""

OpenWriter = Callable[[Path, Sequence[str]], AbstractContextManager[AppendColumns]]
"""Function that creates a file with the given columns. Leaving the context completes the file."""


@dataclass(frozen=True, slots=True)
class Table:
    """Columns and stated sample rate of a recording file, and notes about irregularities."""

    columns: dict[str, Times]  # arrays [n] as in ``Columns``; NaN = missing; ``t`` may be int64 in the unit of the file
    fs: float | None  # sample rate in Hz; None if the file states no rate
    notes: list[str]
    units: Mapping[str, str] = field(default_factory=dict)  # units that the file states
    names: Mapping[str, str] = field(default_factory=dict)  # column name of each quantity whose unit may be inferred
    sensors: Sequence[str] = ()  # name of the sensor for each number in SENSOR; empty if the numbers are names


def column_dtype(name: str) -> np.dtype[Any]:
    """Return the type of the numbers in a column of a file that this program writes."""
    return np.dtype("<i8" if name == TIME_NS else "<f8")


def to_column(quantity: str, numbers: NDArray[Any]) -> Times:
    """Return numbers as float64, or integer times (``t``) as int64, because float64 would round Unix times."""
    if quantity == "t" and numbers.dtype.kind in "iu":
        return integers_to_ns(numbers, 1)
    return numbers.astype(np.float64, copy=False)


def collect_columns(columns: Iterable[tuple[str, Times]]) -> dict[str, Times]:
    """Return columns by name. Axes become columns of one array [n, 6], which ``assemble_recording`` does not copy."""
    found = dict[str, Times]()
    values: Floats | None = None
    for name, column in columns:
        if name in AXES:
            values = np.full((column.size, len(AXES)), np.nan) if values is None else values
            if column.size == len(values):  # other lengths are reported later
                place = values[:, AXES.index(name)]
                place[:] = column
                column = place
        found[name] = column
    return found


def integers_to_ns(numbers: NDArray[Any], ns_per_unit: int) -> Ints:
    """Convert integer times to ns.

    Parameters
    ----------
    numbers
        [n] integers of any type.
    ns_per_unit
        Unit of the numbers in ns.

    Returns
    -------
    Ints
        [n] times in ns, NO_TIME_NS where a time is out of range.
    """
    limit = int(T_LIMIT_S * NS_PER_S) // ns_per_unit
    usable = (numbers > -limit) & (numbers < limit)
    result: Ints = np.where(usable, numbers, 0).astype(np.int64) * ns_per_unit
    result[~usable] = NO_TIME_NS
    return result


def column_seconds(columns: Columns) -> Floats:
    """Return the times of columns in s, from ``t_ns`` or ``t``. NaN means missing."""
    if TIME_NS not in columns:
        return times_to_seconds(columns["t"])
    return np.where(columns[TIME_NS] == NO_TIME_NS, np.nan, times_to_seconds(columns[TIME_NS]))


def name_matrix_columns(name: str, array: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Return the columns of a matrix by name. The longer side of a matrix is the time.

    The columns of an n×3 matrix ``gyro`` are named ``gyro_x``, ``gyro_y`` and ``gyro_z``, and those of any other matrix
    ``data_1``, ``data_2`` and so on.
    """
    columns = array if array.shape[0] >= array.shape[1] else array.T
    width = columns.shape[1]
    if width == 1:
        return {name: columns[:, 0]}
    endings = "xyz" if width == 3 else map(str, range(1, width + 1))
    return {f"{name}_{ending}": column for ending, column in zip(endings, columns.T, strict=True)}


def unwrap_times(times: T, period: int) -> T:
    """Return times that continue where they start again at 0 after a period, such as a day or a week.

    The period has the unit of the times.
    """
    present = np.flatnonzero(np.isfinite(times) if times.dtype.kind == "f" else times != NO_TIME_NS)
    steps = np.diff(times[present])
    result = times.copy()
    result[present[1:]] += period * np.cumsum((steps < -period // 2).astype(np.int64) - (steps > period // 2))
    return result


def check_column_count(path: Path, columns: int) -> None:
    """Raise RecordingError if a file has too many columns."""
    if columns > memory_check.MAX_COLUMNS:
        raise RecordingError(
            f"{path}: has {columns} columns, expected at most {memory_check.MAX_COLUMNS}; keep only {' '.join(COLUMNS)}"
        )


CONTENTS: Final = (
    (b"PK\3\4", "a zip archive", (".npz", ".zip")),
    (b"PK\5\6", "an empty zip archive", (".npz", ".zip")),
    (b"PAR1", "Parquet", (".parquet",)),
    (b"ARROW1\0\0", "an Arrow file", (".arrow", ".feather")),
    (b"\xff\xff\xff\xff", "an Arrow stream", (".arrows",)),
    (b"\x1f\x8b", "gzip data", (".csv.gz", ".csv")),
    (b"LOGG", "a CAN log", (".blf",)),
    (b"#ROSBAG", "a ROS 1 bag", (".bag",)),
    (b"SQLite format 3", "an SQLite database", (".db3",)),
    (b"\x89MCAP", "MCAP", (".mcap",)),
    (b"ULog\x01\x12\x35", "a PX4 log", (".ulg",)),
    (b"\xa3\x95\x80", "an ArduPilot log", (".bin",)),
    (b"\x89HDF", "HDF5", ()),
    (b"MATLAB", "a MATLAB file", (".mat",)),
    (b"\x89PNG", "a picture", ()),
    (b"%PDF", "a PDF document", ()),
)
"""For each type of file: the first bytes, the name of the type, and the suffixes of recordings of this type."""


NO_RECORDINGS: Final = (
    (re.compile(rb"version https://git-lfs"), "a pointer of Git LFS: fetch the file with `git lfs pull`"),
    (re.compile(rb"\s*<(?:!doctype html|html)", re.IGNORECASE), "an HTML page: download the file itself"),
    (re.compile(rb"PK\x03\x04.{26}\[Content_Types\]", re.DOTALL), "an Excel workbook: save the sheet as CSV"),
    (re.compile(rb"\x93NUMPY"), "a single NumPy array: save it with numpy.savez in a file that ends in .npz"),
    (re.compile(rb"\s*(?:\{|\[\s*[\[{])"), "JSON: convert it to CSV"),
    (
        re.compile(rb"\s*(?:\(\d+\.\d+\)\s+)?\w+\s+[0-9A-Fa-f]{3,8}(?:#|\s+\[\d+\]\s)"),
        "CAN frames as candump prints them: rename it to end in .log, and give --decoder dbc --option file=NAME.dbc",
    ),
)
"""Start and description of files in place of a recording, with the remedy."""


def describe_no_recording(path: Path) -> str:
    """Return an error text about a file that contains no samples, with a remedy, or an empty text."""
    start = _read_start(path)
    return next((f"; its content is {what}" for pattern, what in NO_RECORDINGS if pattern.match(start)), "")


def _read_start(path: Path) -> bytes:
    try:
        with open_regular_file(path) as file:
            return file.read(256)
    except OSError:
        return b""


def describe_suffix_mismatch(path: Path) -> str:
    """Return an error text about a file whose content does not match its suffix.

    The text states the detected type of file and a remedy. If the type is unknown, the text is empty.
    """
    if other := describe_no_recording(path):
        return other
    start = _read_start(path)
    for magic, what, suffixes in CONTENTS:
        if start.startswith(magic):
            if path.name.lower().endswith(suffixes or ("",)) and suffixes:
                return ""
            todo = f"rename it to end in {suffixes[0]}" if suffixes else "convert it to CSV"
            return f"; its content is {what}: {todo}"
    text = b"," in start and start.isascii() and b"\0" not in start
    if text and not path.name.lower().endswith((".csv", ".csv.gz")):
        return "; its content looks like CSV text: rename it to end in .csv"
    return ""


def format_name_list(names: Sequence[str], max_names: int = 12) -> str:
    """Format a list of names for a message.

    Long lists and long names are shortened, and control characters are escaped.

    Parameters
    ----------
    names
        Names to list.
    max_names
        Maximum number of names to show.
    """
    shown = [name[:40] if name.isprintable() else ascii(name[:40]) for name in names[:max_names]]
    more = [f"and {len(names) - max_names} more"] if len(names) > max_names else []
    return ", ".join(shown + more)
