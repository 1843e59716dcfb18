"""Types and functions that all recording formats share."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from drivers.data_types import AXES, Floats
from drivers.errors import RecordingError
from drivers.file_access import open_regular_file
from drivers.recordings import memory_check

COLUMNS: Final = ("t", *AXES, "temperature")
"""Names of the columns that the readers recognize."""

ALIASES: Final = {"temp": "temperature"}
"""Alternative column names, each mapped to the name in COLUMNS."""

EXAMPLE_HEADER: Final = "t,gx,gy,gz,ax,ay,az"
"""Example of a header line, quoted in error messages."""

BATCH_ROWS: Final = 1 << 16
"""Maximum number of rows that are written at once. A truncated Arrow file loses at most this many complete rows."""

T_LIMIT_S: Final = 4.6e9
"""Largest absolute time in s for which the difference of two times fits into int64 nanoseconds."""

PARTIAL_SUFFIX: Final = ".part"
"""Suffix that is added to a file name while the file is being written."""

Columns = Mapping[str, Floats]
"""Mapping from names in COLUMNS to float64 arrays [n] of equal length."""

AppendColumns = Callable[[Columns], None]
"""Function that appends rows to a file that is being written."""

OpenWriter = Callable[[Path, Sequence[str]], AbstractContextManager[AppendColumns]]
"""Function that creates a file with the given columns. Leaving the context completes the file."""


@dataclass(frozen=True, slots=True)
class Table:
    """Columns and stated sample rate of a recording file, and notes about irregularities."""

    columns: dict[str, Floats]  # float64 arrays [n]; the keys are names in COLUMNS; NaN = missing
    fs: float | None  # sample rate in Hz; None if the file states no rate
    notes: list[str]
    units: Mapping[str, str] = field(default_factory=dict)  # units that the file states


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


def describe_suffix_mismatch(path: Path) -> str:
    """Return an error text about a file whose content does not match its suffix.

    The text states the detected type of file and a remedy. If the type is unknown, the text is empty.
    """
    try:
        with open_regular_file(path) as file:
            start = file.read(256)
    except OSError:
        return ""
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
