"""CSV, plain or gzip: one header line, commas, empty field or ``nan`` = missing.

Blank lines and comment lines (``#`` or ``%``) before the header are skipped. A header may itself be a comment.

Text is parsed in pieces of whole lines: quickly where every line is regular, line by line where one
is not, so that a torn line costs only itself and is named by its number. A last line without its end
may be cut inside a number, so it is left out. More bad lines than good ones: no recording.

The lines are counted before any is parsed, and checked against the limits of ``drivers.recordings.memory_check``. A file is read
up to a line longer than ``MAX_LINE_BYTES``.
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
from drivers.file_access import open_regular
from drivers.recordings import memory_check
from drivers.recordings.table import (
    BATCH_ROWS,
    EXAMPLE_HEADER,
    Append,
    Columns,
    Table,
    check_width,
    chosen_columns,
    looks_like,
)
from drivers.sample import AXES, Floats

READ_BYTES: Final = 1 << 20
MAX_LINE_BYTES: Final = 1 << 20
MAX_PREAMBLE_BYTES: Final = 1 << 20
"""Blank lines and comments before the header."""
MAX_EMPTY_MEMBERS: Final = 1000
"""Members of a gzip file that hold nothing, one after another."""
SURELY_BAD: Final = 100_000
"""Bad lines after which a file with more bad lines than good ones is read no further."""
COMMENTS: Final = (b"#", b"%")
BOM: Final = b"\xef\xbb\xbf"
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


def count_rows(path: Path) -> int:
    """Count the lines of a plain or gzip text up to a cut, without parsing them.

    Raises
    ------
    RecordingError, ConfigError
        The file exceeds a limit of ``drivers.recordings.memory_check``; it is read only so far.
    """
    limit = memory_check.limit_of(path)
    lines = unpacked = 0
    with open_regular(path) as file:
        for text in _whole_lines(_unzipped(file, []), []):
            lines += text.count(b"\n")
            unpacked += len(text)
            limit.check_rows(lines)
            if unpacked > limit.size_bytes:
                limit.check_unpacked(unpacked)
    return lines


def read_csv(path: Path) -> Table:
    """Plain or gzip text up to a cut; RecordingError when most lines are no samples."""
    notes: list[str] = []
    bad = _BadLines()
    count_rows(path)
    with open_regular(path) as file:
        texts = _whole_lines(_unzipped(file, notes), notes)
        head = _head(path, texts)
        if head is None:
            what = notes[-1] if notes else "It has no line at all."
            raise RecordingError(f"{path}: has not one whole line, expected {EXAMPLE_HEADER}. {what}")
        names = _header(path, head)
        chosen = chosen_columns(path, names, notes, f" in line {head.number}")
        use = [names.index(name) for name in chosen.values()]
        parts = list(_parsed(path, head, texts, names, use, bad))
    rows = np.concatenate(parts) if parts else np.empty((0, len(use)))
    if 2 * bad.count > len(rows):
        raise _mostly_bad(path, bad, len(rows))
    if bad.count:
        notes.append(f"{bad.count} of {len(rows)} lines are no samples: read as missing ({bad.first}).")
    if not len(rows):
        what = f". {notes[-1]}" if notes else ""
        raise RecordingError(f"{path}: has a header line but no whole line of samples after it{what}")
    return Table({name: rows[:, i] for i, name in enumerate(chosen)}, None, notes)


def _mostly_bad(path: Path, bad: _BadLines, rows: int) -> RecordingError:
    return RecordingError(
        f"{path}: {bad.count} of {rows} lines are no samples ({bad.first}); every field must be a number, empty or nan"
    )


def _unzipped(file: IO[bytes], notes: list[str]) -> Iterator[bytes]:
    """The text of a plain or gzip file, by its first bytes and not by its name, up to a cut or damage.

    The pieces have READ_BYTES at most.
    """
    zipped = file.read(2) == GZIP_MAGIC
    file.seek(0)
    if not zipped:
        yield from iter(lambda: file.read(READ_BYTES), b"")
        return
    unzip = zlib.decompressobj(zlib.MAX_WBITS | 16)
    data = file.read(GZIP_BYTES)
    empty, held = 0, False  # members in a row that hold nothing; True if the current member holds text
    while data:
        try:
            text = unzip.decompress(data, READ_BYTES)
        except zlib.error as error:
            notes.append(f"The gzip data are damaged ({error}); read up to the damage.")
            return
        if text:
            held = True
            yield text
        if unzip.eof:  # another member may follow: files of gzip can be strung together
            empty = 0 if held else empty + 1
            if empty > MAX_EMPTY_MEMBERS:
                notes.append(f"{empty} gzip members in a row are empty; read up to there.")
                return
            data = (unzip.unused_data or file.read(GZIP_BYTES)).lstrip(b"\0")  # and be padded with zeros
            unzip, held = zlib.decompressobj(zlib.MAX_WBITS | 16), False
            if not data:
                return
        else:
            data = unzip.unconsumed_tail or file.read(GZIP_BYTES)
    notes.append("The gzip data end in the middle: the file is cut off and was read up to the cut.")


def _whole_lines(texts: Iterable[bytes], notes: list[str]) -> Iterator[bytes]:
    """The same text in pieces that end with a line. A last line without an end may be cut: left out.

    Reading ends at a line that is longer than MAX_LINE_BYTES.
    """
    rest: list[bytes] = []  # the beginning of a line, in parts
    size = lines = 0
    for text in texts:
        whole, end, tail = text.rpartition(b"\n")
        if end:
            piece = b"".join((*rest, whole, end))
            lines += piece.count(b"\n")
            yield piece
            rest, size = [], 0
        rest.append(tail)
        size += len(tail)
        if size > MAX_LINE_BYTES:
            notes.append(f"Line {lines + 1} is longer than {MAX_LINE_BYTES} bytes; the file was read up to there.")
            return
    if any(part.strip() for part in rest):
        notes.append("The last line has no end: the file may be cut off there, and the line was left out.")


@dataclass(frozen=True, slots=True)
class _Head:
    """The header line of a text, and the whole lines that were read with it."""

    line: bytes
    number: int
    rest: bytes
    rest_number: int  # line number of the first line of ``rest``


def _head(path: Path, texts: Iterator[bytes]) -> _Head | None:
    """Find the header line behind blank lines and comments; None where the text has no whole line.

    The header is the first line that is no comment. If it names no axis and the last comment before it does, the
    comment is the header, as ``numpy.savetxt`` writes it.
    """
    number = size = 0
    comment: _Head | None = None
    for text in texts:
        start = 0
        while (end := text.find(b"\n", start)) >= 0:
            line = text[start:end].removeprefix(BOM if number == 0 else b"").strip()
            number, begin, start = number + 1, start, end + 1
            if line.startswith(COMMENTS):
                comment = _Head(line.lstrip(b"#% "), number, text[start:], number + 1) if _has_axis(line) else None
            elif line:
                if comment is not None and not _has_axis(line):
                    return _Head(comment.line, comment.number, text[begin:], number)
                return _Head(line, number, text[start:], number + 1)
            size += end + 1 - begin
            if size > MAX_PREAMBLE_BYTES:
                raise RecordingError(
                    f"{path}: has no header line within its first {number} lines, only comments and blank lines; "
                    f"expected {EXAMPLE_HEADER} within {MAX_PREAMBLE_BYTES} bytes"
                )
    if comment is None and number:
        return _Head(b"", number, b"", number + 1)
    return comment


def _has_axis(line: bytes) -> bool:
    """Return True if a field of this line, without its mark of a comment, is the name of an axis."""
    fields = line.lstrip(b"#% ").decode("utf-8", errors="replace").split(",")
    return any(field.strip(' \t"') in AXES for field in fields)


def _header(path: Path, head: _Head) -> list[str]:
    """Column names of the header line; says what is wrong when it is none."""
    if b"\0" in head.line or not head.line:
        raise RecordingError(f"{path}: is no CSV text; the first line would be {EXAMPLE_HEADER}{looks_like(path)}")
    text = head.line.decode("utf-8", errors="replace")
    for separator, word in ((";", "semicolons"), ("\t", "tabs")):
        if separator in text and "," not in text:
            raise RecordingError(
                f"{path}: the columns of line {head.number} are separated by {word}; a recording has commas"
            )
    check_width(path, text.count(",") + 1)
    names = [name.strip(' \t"') for name in _fields(text)]
    if all(_number(name) is not None for name in names):
        raise RecordingError(
            f"{path}: the header line is missing, line {head.number} is all numbers; "
            f"it would read like {EXAMPLE_HEADER}"
        )
    return names


def _parsed(
    path: Path, head: _Head, texts: Iterable[bytes], names: Sequence[str], use: Sequence[int], bad: _BadLines
) -> Iterator[Floats]:
    """Arrays [lines, used columns] of each piece of text: quickly where it is regular, else line by line."""
    number, rows = head.rest_number, 0
    for text in chain((head.rest,), texts):
        text = text.replace(b"\r\n", b"\n")
        lines = text.decode("utf-8", errors="replace").split("\n")[:-1]
        if text.strip():
            quick = _parse_quickly(text, lines, len(names), use)
            part = _parse_slowly(lines, number, names, use, bad) if quick is None else quick
            rows += len(part)
            if bad.count > SURELY_BAD and 2 * bad.count > rows:
                raise _mostly_bad(path, bad, rows)
            yield part
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
