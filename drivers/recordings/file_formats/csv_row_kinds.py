"""Text files whose rows belong to several sensors, told apart by a word in each row.

Three layouts are known:

- The first field is the name of the sensor. Lines such as ``$COL,IMU,time,wx`` and ``$UNIT,IMU,s,deg/s`` name the
  columns of each sensor (FlySight 2, flysight/flysight-2-firmware, ``log.c``).
- The first field is the name of the sensor, and comments such as ``# UncalGyro,utcTimeMillis,…`` name the columns
  (GnssLogger, google/gps-measurement-tools, ``LOGGING_FORMAT.md``).
- All sensors share the columns ``x``, ``y`` and ``z``, and a further column contains words such as ``gyro``. Without a
  header line, the columns are those of UNNAMED_COLUMNS.

The rows of each sensor are copied to a temporary file, which is then read like any table.
"""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Final

from drivers.host.safe_file_reading import open_regular_file
from drivers.recordings.column_names import names_sensor_kind, parse_column_name
from drivers.recordings.file_formats.csv_format import MAX_LINE_BYTES, CsvSource
from drivers.recordings.file_formats.csv_header import find_separator, split_header

SEARCH_BYTES: Final = 1 << 16
MIN_ROWS: Final = 3
UNNAMED_COLUMNS: Final = ("", "time", "x", "y", "z")
"""Columns of rows such as ``GYR,0.01,0.1,0.2,0.3`` in a file without column names."""
_COLUMNS_LINE: Final = re.compile(r"(?:\$COL,|#\s*)(\w+),(.*)")
_UNITS_LINE: Final = re.compile(r"\$UNIT,(\w+),(.*)")


@dataclass(frozen=True, slots=True)
class _RowKind:
    """Rows of one sensor."""

    header: str  # names of the columns
    column: int  # index of the field that names the sensor
    words: tuple[bytes, ...]  # contents of this field
    units: str = ""  # row of units
    separator: str = ","


def contains_row_kinds(path: Path) -> bool:
    """Return True if the rows of a text file belong to several sensors that a word in each row tells apart."""
    return bool(_find_row_kinds(path))


def find_row_sources(path: Path) -> dict[str, CsvSource]:
    """Return the rows of each sensor with known columns as a CSV file."""
    return {
        name: CsvSource(path, f"{path}: rows of {name}", name, partial(_open_rows, path, kind))
        for name, kind in _find_row_kinds(path).items()
    }


def _find_row_kinds(path: Path) -> dict[str, _RowKind]:
    with open_regular_file(path) as file:
        lines = file.read(SEARCH_BYTES).decode("utf-8", errors="replace").splitlines()
    kinds: dict[str, _RowKind] = {}
    for line in lines:
        if found := _COLUMNS_LINE.fullmatch(line.strip()):
            kinds.setdefault(found[1], _RowKind(found[2], 0, (found[1].encode(), b"$" + found[1].encode())))
    units = {found[1]: found[2] for line in lines if (found := _UNITS_LINE.fullmatch(line.strip()))}
    rows = (line for line in lines if not line.startswith(("#", "$COL", "$UNIT")))
    first_words = Counter(line.partition(",")[0].lstrip("$") for line in rows)
    kinds = {
        name: _RowKind(f",{kind.header}", 0, kind.words, f",{units[name]}" if name in units else "")
        for name, kind in kinds.items()
        if first_words[name] >= MIN_ROWS and _names_axes(name, kind.header.split(","))
    }
    return kinds or _find_kinds_in_column(lines)


def _find_kinds_in_column(lines: Sequence[str]) -> dict[str, _RowKind]:
    """Return the sensors whose rows share columns that are only named x, y and z, or have no names."""
    start = next((i for i, line in enumerate(lines) if {"x", "y", "z"} <= {*map(str.lower, split_header(line))}), None)
    if any(line.strip().startswith(("$", "#")) for line in lines[0 if start is None else start + 1 :]):
        return {}
    separator = find_separator(lines[-2]) if len(lines) > 1 else ""
    if not separator:
        return {}
    rows = [line.split(separator) for line in lines[0 if start is None else start + 1 : -1]]
    header = UNNAMED_COLUMNS if start is None else tuple(split_header(lines[start], separator))
    rows = [fields for fields in rows if len(fields) == len(header)]
    for column in range(len(header) if start is not None else 1):
        words = {row[column].strip(): None for row in rows}
        sensors = [word for word in words if names_sensor_kind(word)]
        if len(words) > 1 and "g" in map(names_sensor_kind, sensors):
            names = separator.join(header)
            return {word: _RowKind(names, column, (word.encode(),), separator=separator) for word in sensors}
    return {}


def _names_axes(sensor: str, names: Sequence[str]) -> bool:
    return any(
        (meaning := parse_column_name(name, sensor)) is not None and meaning.quantity[0] in "ga" for name in names
    )


@contextmanager
def _open_rows(path: Path, kind: _RowKind) -> Iterator[IO[bytes]]:
    """Open a temporary file with the column names and the rows of one sensor."""
    with open_regular_file(path) as file, TemporaryFile() as rows:
        rows.write(f"{kind.header}\n{kind.units}\n".encode() if kind.units else f"{kind.header}\n".encode())
        for line in iter(lambda: file.readline(MAX_LINE_BYTES), b""):
            fields = line.split(kind.separator.encode(), kind.column + 1)
            if len(fields) > kind.column + 1 and fields[kind.column].strip() in kind.words and line.endswith(b"\n"):
                rows.write(line)
        rows.seek(0)
        yield rows
