"""What a reader of one format gives (known columns by name, the file's own rate, notes), and what a writer takes."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from drivers.errors import RecordingError
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


def chosen_columns(path: Path, names: Sequence[str], notes: list[str]) -> dict[str, str]:
    """Known column -> its name in the file. The rest goes into a note; no axis at all is an error."""
    twice = sorted({name for name in names if names.count(name) > 1} & {*COLUMNS, *ALIASES})
    if twice:
        raise RecordingError(f"{path}: column {twice[0]} occurs twice; each may occur once")
    chosen = {name: name for name in COLUMNS if name in names}
    for alias, name in ALIASES.items():
        if alias in names:
            chosen.setdefault(name, alias)
    if not any(axis in chosen for axis in AXES):
        raise RecordingError(
            f"{path}: no axis among its columns ({listed(names)}); "
            f"a recording has some of {' '.join(AXES)}, in rad/s and m/s²"
        )
    others = [name for name in names if name not in chosen.values() and name != "fs"]
    if others:
        notes.append(f"Other columns were left aside: {listed(others)}.")
    return chosen


def listed(names: Sequence[str], most: int = 12) -> str:
    """Names for a message: not too many, not too long, nothing that a terminal would obey."""
    shown = [name[:40] if name.isprintable() else ascii(name[:40]) for name in names[:most]]
    more = [f"and {len(names) - most} more"] if len(names) > most else []
    return ", ".join(shown + more)
