"""What a reader of one format gives (known columns by name, the file's own rate, notes), and what a writer takes."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from drivers.errors import RecordingError
from drivers.file_access import open_regular
from drivers.recordings import memory_check
from drivers.sample import AXES, Floats

COLUMNS: Final = ("t", *AXES, "temperature")
"""Columns that mean something, under the names they are written with."""

ALIASES: Final = {"temp": "temperature"}

EXAMPLE_HEADER: Final = "t,gx,gy,gz,ax,ay,az"

BATCH_ROWS: Final = 1 << 16  # rows written at a time; a cut Arrow file loses at most so many

T_LIMIT_S: Final = 4.6e9
"""The difference of two is within int64 nanoseconds, 9.22e9 s; what is beyond is not in seconds."""

PART: Final = ".part"
"""End of a file's name while it is being written."""

Columns = Mapping[str, Floats]
"""Columns as float64 [n], all equally long, under their names in COLUMNS."""

Append = Callable[[Columns], None]
"""Takes the next rows of a file that is being written."""

Writer = Callable[[Path, Sequence[str]], AbstractContextManager[Append]]
"""Begins a file with columns of these names; it is whole once the context has been left."""


@dataclass(frozen=True, slots=True)
class Table:
    """Columns as float64 [n], under their names in COLUMNS, missing values as NaN."""

    columns: dict[str, Floats]
    fs: float | None  # Hz, where the file states it
    notes: list[str]


def check_width(path: Path, columns: int) -> None:
    """Raise RecordingError if a file has more columns than any recording."""
    if columns > memory_check.MAX_COLUMNS:
        raise RecordingError(
            f"{path}: has {columns} columns, expected at most {memory_check.MAX_COLUMNS}; keep those of the recording: "
            f"{' '.join(COLUMNS)}"
        )


def chosen_columns(path: Path, names: Sequence[str], notes: list[str], where: str = "") -> dict[str, str]:
    """Known column -> its name in the file. The rest goes into a note; no axis at all is an error.

    ``where`` says where the names stand, such as " in line 3".
    """
    check_width(path, len(names))
    known = {*COLUMNS, *ALIASES}
    twice = sorted(name for name, count in Counter(names).items() if count > 1 and name in known)
    if twice:
        raise RecordingError(f"{path}: column {twice[0]} occurs twice; each may occur once")
    chosen = {name: name for name in COLUMNS if name in names}
    for alias, name in ALIASES.items():
        if alias in names:
            chosen.setdefault(name, alias)
    if not any(axis in chosen for axis in AXES):
        raise RecordingError(
            f"{path}: no axis among its columns ({listed(names)}){where}; "
            f"a recording has some of {' '.join(AXES)}, in rad/s and m/s²{looks_like(path)}"
        )
    used = {*chosen.values(), "fs"}
    others = [name for name in names if name not in used]
    if others:
        notes.append(f"Other columns were left aside: {listed(others)}.")
    return chosen


CONTENTS: Final = (
    (b"PK\3\4", "a zip archive", (".npz",)),
    (b"PK\5\6", "an empty zip archive", (".npz",)),
    (b"PAR1", "Parquet", (".parquet",)),
    (b"ARROW1\0\0", "an Arrow file", (".arrow", ".feather")),
    (b"\xff\xff\xff\xff", "an Arrow stream", (".arrows",)),
    (b"\x1f\x8b", "gzip data", (".csv.gz", ".csv")),
    (b"LOGG", "a CAN log", (".blf",)),
    (b"\x89HDF", "HDF5", ()),
    (b"MATLAB", "a MATLAB file", ()),
    (b"\x89PNG", "a picture", ()),
    (b"%PDF", "a PDF document", ()),
)
"""First bytes of files, what they are, and the suffixes under which a reader expects them."""


def looks_like(path: Path) -> str:
    """Return what the content of a file looks like and what to do, as the end of a message.

    Empty where the content is of the kind that the suffix says, or of no known kind.
    """
    try:
        with open_regular(path) as file:
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


def listed(names: Sequence[str], most: int = 12) -> str:
    """Names for a message: not too many, not too long, nothing that a terminal would obey."""
    shown = [name[:40] if name.isprintable() else ascii(name[:40]) for name in names[:most]]
    more = [f"and {len(names) - most} more"] if len(names) > most else []
    return ", ".join(shown + more)
