"""Reading and writing of plain and gzip-compressed CSV recordings.

An empty field or ``nan`` is a missing value. Blank lines and comment lines before the header line are skipped.

NumPy parses text in large pieces. A piece with a damaged line is parsed line by line, so that only the damaged line is
lost. If the last line has no line ending, it is skipped, because its last number may be incomplete.

Lines are counted before parsing, so that ``drivers.recordings.memory_check`` can reject a file that is too large.
"""

import csv
import gzip
import io
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import IO, Final, cast

import numpy as np

from drivers.data_types import AXES, Floats
from drivers.errors import RecordingError
from drivers.file_access import open_regular_file
from drivers.recordings import memory_check, table

READ_BYTES: Final = 1 << 20
MAX_LINE_BYTES: Final = 1 << 20
MAX_PREAMBLE_BYTES: Final = 1 << 20
"""Maximum total size of the blank lines and comments before the header."""
MAX_EMPTY_MEMBERS: Final = 1000
"""Maximum number of consecutive gzip members without content."""
MAX_BAD_LINES: Final = 100_000
"""Number of invalid lines after which reading stops if most lines are invalid."""
COMMENT_MARKS: Final = (b"#", b"%")
BOM: Final = b"\xef\xbb\xbf"
GZIP_BYTES: Final = 1 << 16
"""Number of compressed bytes that are decompressed at once.

Damage to a file loses at most this many compressed bytes.
"""
GZIP_MAGIC: Final = b"\x1f\x8b"
GZIP_LEVEL: Final = 1
"""Level of gzip compression. Level 6 reduces the size of noise data by a further 6 % but takes eight times as long."""


@dataclass(slots=True)
class _BadLines:
    """Count of invalid lines, with a description of the first invalid line."""

    count: int = 0
    first: str = ""

    def record_bad_line(self, line_number: int, reason: str) -> None:
        self.first = self.first or f"line {line_number}: {reason}"
        self.count += 1


def read_csv(path: Path) -> table.Table:
    """Read the known columns of a plain or gzip-compressed CSV file. A truncated last line is skipped.

    Raises
    ------
    RecordingError
        If the file has no header or no samples, or if most lines are invalid.
    ConfigError
        If the samples do not fit into memory.
    """
    notes: list[str] = []
    bad = _BadLines()
    count_csv_rows(path)
    with open_regular_file(path) as file:
        texts = _whole_lines(_decompressed(file, notes), notes)
        head = _find_header(path, texts)
        if head is None:
            what = notes[-1] if notes else "It has no line at all."
            raise RecordingError(f"{path}: has not one complete line, expected {table.EXAMPLE_HEADER}. {what}")
        names = _column_names(path, head)
        chosen = table.select_known_columns(path, names, notes, f" in line {head.number}")
        use = [names.index(name) for name in chosen.values()]
        parts = list(_parse_pieces(path, head, texts, names, use, bad))
    rows = np.concatenate(parts) if parts else np.empty((0, len(use)))
    if 2 * bad.count > len(rows):
        raise _too_many_bad_lines(path, bad, len(rows))
    if bad.count:
        notes.append(f"{bad.count} of {len(rows)} lines are not samples and are read as missing ({bad.first}).")
    if not len(rows):
        what = f". {notes[-1]}" if notes else ""
        raise RecordingError(f"{path}: has a header line but no complete line of samples after it{what}")
    return table.Table({name: rows[:, i] for i, name in enumerate(chosen)}, None, notes)


def count_csv_rows(path: Path) -> int:
    """Return the number of complete lines in a CSV file. Raise an error if the file exceeds a size limit."""
    limit = memory_check.measure_read_limit(path)
    lines = unpacked = 0
    with open_regular_file(path) as file:
        for text in _whole_lines(_decompressed(file, []), []):
            lines += text.count(b"\n")
            unpacked += len(text)
            limit.check_row_count(lines)
            if unpacked > limit.size_bytes:
                limit.check_unpacked_size(unpacked)
    return lines


def _too_many_bad_lines(path: Path, bad: _BadLines, rows: int) -> RecordingError:
    return RecordingError(
        f"{path}: {bad.count} of {rows} lines are not samples ({bad.first}); every field must be a number, empty or nan"
    )


def _decompressed(file: IO[bytes], notes: list[str]) -> Iterator[bytes]:
    """Yield the decompressed text of a plain or gzip file in pieces. Stop where the file is truncated or damaged."""
    zipped = file.read(2) == GZIP_MAGIC
    file.seek(0)
    if not zipped:
        yield from iter(lambda: file.read(READ_BYTES), b"")
        return
    unzip = zlib.decompressobj(zlib.MAX_WBITS | 16)
    data = file.read(GZIP_BYTES)
    empty, has_text = 0, False  # consecutive empty gzip members; True if the current member has text
    while data:
        try:
            text = unzip.decompress(data, READ_BYTES)
        except zlib.error as error:
            notes.append(f"The gzip data are damaged ({error}); the file was read up to the damage.")
            return
        if text:
            has_text = True
            yield text
        if unzip.eof:  # another gzip member may follow, because gzip files can be concatenated
            empty = 0 if has_text else empty + 1
            if empty > MAX_EMPTY_MEMBERS:
                notes.append(f"{empty} consecutive gzip members are empty; the file was read up to these members.")
                return
            data = (unzip.unused_data or file.read(GZIP_BYTES)).lstrip(b"\0")  # zeros may separate gzip members
            unzip, has_text = zlib.decompressobj(zlib.MAX_WBITS | 16), False
            if not data:
                return
        else:
            data = unzip.unconsumed_tail or file.read(GZIP_BYTES)
    notes.append("The gzip data end in the middle: the file is cut off and was read up to the cut.")


def _whole_lines(texts: Iterable[bytes], notes: list[str]) -> Iterator[bytes]:
    """Join and split pieces of text at line ends. Stop at a line that is longer than MAX_LINE_BYTES."""
    rest: list[bytes] = []  # parts of an incomplete line
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
            notes.append(f"Line {lines + 1} is longer than {MAX_LINE_BYTES} bytes; the file was read up to this line.")
            return
    if any(part.strip() for part in rest):
        notes.append("The last line has no end and was left out; the file may be cut off.")


@dataclass(frozen=True, slots=True)
class _Header:
    """Header line of a CSV file, and the text that was read together with the header line."""

    line: bytes
    number: int  # line number of the header
    rest: bytes
    rest_number: int  # line number of the first line of ``rest``


def _find_header(path: Path, texts: Iterator[bytes]) -> _Header | None:
    """Find the header line of a CSV file. Return None if the text contains no complete line.

    The header is the first line that is not a comment. ``numpy.savetxt``, however, writes the header as a comment. If
    the last comment names an axis and the next line does not, the comment is the header.
    """
    number = size = 0
    comment: _Header | None = None
    for text in texts:
        start = 0
        while (end := text.find(b"\n", start)) >= 0:
            line = text[start:end].removeprefix(BOM if number == 0 else b"").strip()
            number, begin, start = number + 1, start, end + 1
            if line.startswith(COMMENT_MARKS):
                comment = _Header(line.lstrip(b"#% "), number, text[start:], number + 1) if _has_axis(line) else None
            elif line:
                if comment is not None and not _has_axis(line):
                    return _Header(comment.line, comment.number, text[begin:], number)
                return _Header(line, number, text[start:], number + 1)
            size += end + 1 - begin
            if size > MAX_PREAMBLE_BYTES:
                raise RecordingError(
                    f"{path}: has no header line within its first {number} lines, only comments and blank lines; "
                    f"expected {table.EXAMPLE_HEADER} within {MAX_PREAMBLE_BYTES} bytes"
                )
    if comment is None and number:
        return _Header(b"", number, b"", number + 1)
    return comment


def _has_axis(line: bytes) -> bool:
    """Return True if a CSV line contains the name of an axis, with or without a comment mark before the first field."""
    fields = line.lstrip(b"#% ").decode("utf-8", errors="replace").split(",")
    return any(field.strip(' \t"') in AXES for field in fields)


def _column_names(path: Path, head: _Header) -> list[str]:
    """Return the column names in a header line. Raise RecordingError if the line is not a header line."""
    if b"\0" in head.line or not head.line:
        raise RecordingError(
            f"{path}: is no CSV text, expected a first line such as {table.EXAMPLE_HEADER}"
            f"{table.describe_suffix_mismatch(path)}"
        )
    text = head.line.decode("utf-8", errors="replace")
    for separator, word in ((";", "semicolons"), ("\t", "tabs")):
        if separator in text and "," not in text:
            raise RecordingError(
                f"{path}: the columns of line {head.number} are separated by {word}; separate them by commas"
            )
    table.check_column_count(path, text.count(",") + 1)
    names = [name.strip(' \t"') for name in _split_fields(text)]
    if all(_parse_number(name) is not None for name in names):
        raise RecordingError(
            f"{path}: the header line is missing: line {head.number} consists of numbers; "
            f"expected a header line such as {table.EXAMPLE_HEADER}"
        )
    return names


def _parse_pieces(
    path: Path, head: _Header, texts: Iterable[bytes], names: Sequence[str], use: Sequence[int], bad: _BadLines
) -> Iterator[Floats]:
    """Yield a float array [lines, used columns] for each piece of CSV text."""
    number, rows = head.rest_number, 0
    for text in chain((head.rest,), texts):
        text = text.replace(b"\r\n", b"\n")
        lines = text.decode("utf-8", errors="replace").split("\n")[:-1]
        if text.strip():
            part = _parse_regular_lines(text, lines, len(names), use)
            part = _parse_line_by_line(lines, number, names, use, bad) if part is None else part
            rows += len(part)
            if bad.count > MAX_BAD_LINES and 2 * bad.count > rows:
                raise _too_many_bad_lines(path, bad, rows)
            yield part
        number += len(lines)


def _parse_regular_lines(text: bytes, lines: list[str], width: int, use: Sequence[int]) -> Floats | None:
    """Return a float array [lines, used columns], or None if any line is irregular."""
    codes = np.frombuffer(text, np.uint8)
    commas_before = np.searchsorted(np.flatnonzero(codes == ord(",")), np.flatnonzero(codes == ord("\n")))
    if np.any(np.diff(commas_before, prepend=0) != width - 1):
        return None
    try:
        return np.loadtxt(lines, delimiter=",", comments=None, usecols=use, ndmin=2)
    except ValueError:
        return None


def _parse_line_by_line(
    lines: Sequence[str], number: int, names: Sequence[str], use: Sequence[int], bad: _BadLines
) -> Floats:
    """Return a float array [lines, used columns]. Invalid lines become rows of NaN."""
    missing = [np.nan] * len(use)
    rows: list[list[float]] = []
    for offset, line in enumerate(lines):
        if not line.strip():
            continue
        try:
            rows.append(_parse_sample(line, names, use))
        except ValueError as error:
            bad.record_bad_line(number + offset, str(error))
            rows.append(missing)
    return np.array(rows).reshape(len(rows), len(use))


def _parse_sample(line: str, names: Sequence[str], use: Sequence[int]) -> list[float]:
    fields = _split_fields(line)
    if len(fields) != len(names):
        raise ValueError(f"{len(fields)} fields where the header has {len(names)}")
    row = []
    for i in use:
        number = _parse_number(fields[i])
        if number is None:
            raise ValueError(f"{names[i]} is {fields[i].strip()[:20]!a}")
        row.append(number)
    return row


def _split_fields(line: str) -> list[str]:
    if '"' not in line:
        return line.split(",")
    try:
        return next(csv.reader([line]))
    except csv.Error:
        return []


def _parse_number(field: str) -> float | None:
    """Return the number in a CSV field, NaN for an empty field, or None for text.

    Unlike ``float``, 1_000 is rejected.
    """
    if not field or field.isspace():
        return float("nan")
    try:
        return None if "_" in field else float(field)
    except ValueError:
        return None


@contextmanager
def open_csv_writer(path: Path, names: Sequence[str], use_gzip: bool = False) -> Iterator[table.AppendColumns]:
    """Open a CSV file for writing, with one header line and one line per sample. Missing values are written as ``nan``.

    If ``use_gzip`` is True, the file is compressed with gzip. The gzip header contains no time stamp, so that equal
    samples give equal files.
    """
    with ExitStack() as stack:
        raw: IO[bytes] = stack.enter_context(path.open("wb"))
        if use_gzip:
            raw = cast("IO[bytes]", stack.enter_context(gzip.GzipFile("", "wb", GZIP_LEVEL, raw, mtime=0)))
        file = stack.enter_context(io.TextIOWrapper(raw, "ascii", newline=""))
        file.write(",".join(names) + "\n")

        def append_rows(columns: table.Columns) -> None:
            for start in range(0, columns[names[0]].size, table.BATCH_ROWS):
                # repr gives the shortest text that converts back to the same float64.
                fields = [map(repr, columns[name][start : start + table.BATCH_ROWS].tolist()) for name in names]
                file.writelines(",".join(row) + "\n" for row in zip(*fields, strict=True))

        yield append_rows
