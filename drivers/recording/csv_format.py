"""CSV, plain or gzip: one header line, commas, empty field or ``nan`` = missing.

Text is parsed in pieces of whole lines: quickly where every line is regular, line by line where one
is not, so that a torn line costs only itself and is named by its number. A last line without its end
may be cut inside a number, so it is left out. More bad lines than good ones: no recording.
"""

import csv
import gzip
import io
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import IO, Final, TextIO

import numpy as np

from drivers.errors import RecordingError
from drivers.recording.table import BATCH_ROWS, EXAMPLE_HEADER, Append, Columns, Table, chosen_columns
from drivers.sample import Floats
from drivers.small_file import open_regular

READ_BYTES: Final = 1 << 22
GZIP_BYTES: Final = 1 << 16  # what a damaged gzip file may lose before the damage
GZIP_MAGIC: Final = b"\x1f\x8b"
GZIP_LEVEL: Final = 1  # digits of noise hardly compress: level 6 saves another 6 % in eight times the time


@dataclass(slots=True)
class _BadLines:
    """Lines that are no samples: how many, and the first of them in words."""

    count: int = 0
    first: str = ""

    def add(self, number: int, why: str) -> None:
        self.first = self.first or f"line {number}: {why}"
        self.count += 1


def read_csv(path: Path) -> Table:
    """Plain or gzip text up to a cut; RecordingError when most lines are no samples."""
    notes: list[str] = []
    bad = _BadLines()
    with open_regular(path) as file:
        texts = _whole_lines(_unzipped(file, notes), notes)
        text = next(texts, None)
        if text is None:
            raise RecordingError(f"{path}: has not one whole line; the first would be {EXAMPLE_HEADER}")
        head, _, rest = text.partition(b"\n")
        names = _header(path, head)
        chosen = chosen_columns(path, names, notes)
        use = [names.index(name) for name in chosen.values()]
        parts = list(_parsed(rest, texts, names, use, bad))
    rows = np.concatenate(parts) if parts else np.empty((0, len(use)))
    if 2 * bad.count > len(rows):
        raise RecordingError(
            f"{path}: {bad.count} of {len(rows)} lines are no samples ({bad.first}); "
            "every field must be a number, empty or nan"
        )
    if bad.count:
        notes.append(f"{bad.count} of {len(rows)} lines are no samples: read as missing ({bad.first}).")
    if not len(rows):
        raise RecordingError(f"{path}: has a header line but no whole line of samples after it")
    return Table({name: rows[:, i] for i, name in enumerate(chosen)}, None, notes)


def _unzipped(file: IO[bytes], notes: list[str]) -> Iterator[bytes]:
    """The text of a plain or gzip file, by its first bytes and not by its name, up to a cut or damage."""
    zipped = file.read(2) == GZIP_MAGIC
    file.seek(0)
    if not zipped:
        yield from iter(lambda: file.read(READ_BYTES), b"")
        return
    unzip = zlib.decompressobj(zlib.MAX_WBITS | 16)
    data = file.read(GZIP_BYTES)
    while data:
        try:
            text = unzip.decompress(data)
        except zlib.error as error:
            notes.append(f"The gzip data are damaged ({error}); read up to the damage.")
            return
        if text:
            yield text
        data = unzip.unused_data
        if unzip.eof:  # another member may follow: files of gzip can be strung together
            unzip = zlib.decompressobj(zlib.MAX_WBITS | 16)
            data = (data or file.read(GZIP_BYTES)).lstrip(b"\0")  # and be padded with zeros
            if not data:
                return
        else:
            data = file.read(GZIP_BYTES)
    notes.append("The gzip data end in the middle: the file is cut off and was read up to the cut.")


def _whole_lines(texts: Iterable[bytes], notes: list[str]) -> Iterator[bytes]:
    """The same text in pieces that end with a line. A last line without an end may be cut: left out."""
    rest = b""
    for text in texts:
        lines, end, tail = text.rpartition(b"\n")
        if end:
            yield rest + lines + end
            rest = b""
        rest += tail
    if rest.strip():
        notes.append("The last line has no end: the file may be cut off there, and the line was left out.")


def _header(path: Path, line: bytes) -> list[str]:
    """Column names of the first line; says what is wrong when it is none."""
    if b"\0" in line or not line.strip():
        raise RecordingError(f"{path}: is no CSV text; the first line would be {EXAMPLE_HEADER}")
    text = line.decode("utf-8-sig", errors="replace").strip().lstrip("# ")
    for separator, word in ((";", "semicolons"), ("\t", "tabs")):
        if separator in text and "," not in text:
            raise RecordingError(f"{path}: columns are separated by {word}; a recording has commas")
    names = [name.strip(' \t"') for name in _fields(text)]
    if all(_number(name) is not None for name in names):
        raise RecordingError(
            f"{path}: the header line is missing, line 1 is all numbers; it would read like {EXAMPLE_HEADER}"
        )
    return names


def _parsed(
    first: bytes, texts: Iterable[bytes], names: Sequence[str], use: Sequence[int], bad: _BadLines
) -> Iterator[Floats]:
    """Arrays [lines, used columns] of each piece of text: quickly where it is regular, else line by line."""
    number = 2
    for text in chain((first,), texts):
        text = text.replace(b"\r\n", b"\n")
        lines = text.decode("utf-8", errors="replace").split("\n")[:-1]
        if text.strip():
            quick = _parse_quickly(text, lines, len(names), use)
            yield _parse_slowly(lines, number, names, use, bad) if quick is None else quick
        number += len(lines)


def _parse_quickly(text: bytes, lines: list[str], width: int, use: Sequence[int]) -> Floats | None:
    """[lines, used columns] when every line has all its fields and all are numbers, else None."""
    codes = np.frombuffer(text, np.uint8)
    commas_before = np.searchsorted(np.flatnonzero(codes == ord(",")), np.flatnonzero(codes == ord("\n")))
    if np.any(np.diff(commas_before, prepend=0) != width - 1):
        return None
    try:
        return np.loadtxt(lines, delimiter=",", comments=None, usecols=use, ndmin=2)
    except ValueError:
        return None


def _parse_slowly(
    lines: Sequence[str], number: int, names: Sequence[str], use: Sequence[int], bad: _BadLines
) -> Floats:
    """The same, line by line: an empty field is missing, a line that is no sample is missing as a whole."""
    missing = [np.nan] * len(use)
    rows: list[list[float]] = []
    for offset, line in enumerate(lines):
        if not line.strip():
            continue
        try:
            rows.append(_sample(line, names, use))
        except ValueError as error:
            bad.add(number + offset, str(error))
            rows.append(missing)
    return np.array(rows).reshape(len(rows), len(use))


def _sample(line: str, names: Sequence[str], use: Sequence[int]) -> list[float]:
    """The used fields of one line; ValueError says why it is no sample."""
    fields = _fields(line)
    if len(fields) != len(names):
        raise ValueError(f"{len(fields)} fields where the header has {len(names)}")
    row = []
    for i in use:
        number = _number(fields[i])
        if number is None:
            raise ValueError(f"{names[i]} reads {fields[i].strip()[:20]!a}")
        row.append(number)
    return row


def _fields(line: str) -> list[str]:
    if '"' not in line:
        return line.split(",")
    try:
        return next(csv.reader([line]))
    except csv.Error:
        return []


def _number(field: str) -> float | None:
    """NaN for an empty field, None for what is no number; float() alone would take 1_000."""
    if not field or field.isspace():
        return float("nan")
    try:
        return None if "_" in field else float(field)
    except ValueError:
        return None


@contextmanager
def csv_writer(path: Path, names: Sequence[str]) -> Iterator[Append]:
    """One header line, then one line a sample; missing is ``nan``."""
    with path.open("w", encoding="ascii", newline="") as file:
        yield _lines_to(file, names)


@contextmanager
def csv_gz_writer(path: Path, names: Sequence[str]) -> Iterator[Append]:
    """The same, compressed; equal columns give equal bytes, so no time stamp goes into the gzip header."""
    with (
        path.open("wb") as raw,
        gzip.GzipFile("", "wb", GZIP_LEVEL, raw, mtime=0) as packed,
        io.TextIOWrapper(packed, "ascii", newline="") as file,
    ):
        yield _lines_to(file, names)


def _lines_to(file: TextIO, names: Sequence[str]) -> Append:
    """repr() is the shortest text that reads back as the same float64."""
    file.write(",".join(names) + "\n")

    def append(columns: Columns) -> None:
        for start in range(0, columns[names[0]].size, BATCH_ROWS):
            fields = [map(repr, columns[name][start : start + BATCH_ROWS].tolist()) for name in names]
            file.writelines(",".join(row) + "\n" for row in zip(*fields, strict=True))

    return append
