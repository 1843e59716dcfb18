"""Header line and separator of a CSV file.

Fields are separated by commas, semicolons, tabs or blanks. Numbers in a file with semicolons or tabs may have decimal
commas. The header is the first line that is not a comment. If this line consists of numbers, the header is the last
comment with the same number of fields, as ``numpy.savetxt`` writes it. A file without a header can be read if the user
gives the numbers of its columns.
"""

import csv
import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from drivers.errors import RecordingError
from drivers.recordings import table
from drivers.recordings.reading_options import NOT_READ, ReadingOptions
from drivers.recordings.table_layout import names_an_axis

MAX_PREAMBLE_BYTES: Final = 1 << 20
"""Maximum total size of the blank lines and comments before the header."""
COMMENT_MARKS: Final = ("#", "%")
UNKNOWN_COMMENT_MARKS: Final = ("//", ";", "--", "!", "*")
"""Comment markers used by other programs; the error message about a missing header mentions them."""
BOM: Final = "\N{ZERO WIDTH NO-BREAK SPACE}"
BLANKS: Final = ""
"""Separator of files whose fields are separated by any number of blanks."""
SEPARATORS: Final = {";": "semicolons", "\t": "tabs", ",": "commas", BLANKS: "blanks"}
"""Separators with their names. Commas follow semicolons and tabs, because they may also be decimal commas."""
DECIMAL_COMMA_SEPARATORS: Final = (";", "\t")
EXCEL_SEPARATOR: Final = re.compile("sep=.?", re.IGNORECASE)
"""First line that tells Excel the separator."""
_QUOTED: Final = re.compile('"[^"]*"')


@dataclass(frozen=True, slots=True)
class CsvHeader:
    """Column names and separator of a CSV file, and the text that was read together with the header."""

    names: list[str]
    separator: str  # a key of SEPARATORS
    number: int  # number of the header line; 0 if the file has no header
    rest: bytes  # text after the header
    rest_number: int  # line number of the first line of ``rest``


@dataclass(frozen=True, slots=True)
class _Line:
    text: str
    number: int
    begin: int  # offset of the line in its piece of text
    end: int  # offset of the next line


def find_header(path: Path, label: Path, texts: Iterator[bytes], options: ReadingOptions) -> CsvHeader | None:
    """Find the header of a CSV file. Return None if the text contains no complete line.

    Parameters
    ----------
    path
        File on disk.
    label
        Name of the source in messages.
    texts
        Pieces of text that end at line ends. The function reads the pieces up to the first line of samples.
    options
        Columns that the user names.

    Raises
    ------
    RecordingError
        If the file has no header and the user does not give the numbers of the columns, or if the separators of header
        and samples differ.
    """
    number = size = 0
    comment: _Line | None = None
    for text in texts:
        for line in _iter_lines(text, number):
            number, size = line.number, size + line.end - line.begin
            if line.text.startswith(COMMENT_MARKS):
                comment = line
            elif line.text and not EXCEL_SEPARATOR.fullmatch(line.text):
                return _header_at_first_line(path, label, comment, line, text, texts, options)
            if size > MAX_PREAMBLE_BYTES:
                raise RecordingError(
                    f"{label}: has no header line within its first {number} lines, only comments and blank lines; "
                    f"expected {table.EXAMPLE_HEADER} within {MAX_PREAMBLE_BYTES} bytes"
                )
    if not number:
        return None
    if comment is None or not names_an_axis(split_header(comment.text)):
        raise RecordingError(
            f"{label}: contains only comments and blank lines, expected a header such as {table.EXAMPLE_HEADER}"
        )
    return _build_header(path, label, comment, None, b"", number + 1)


def _header_at_first_line(
    path: Path,
    label: Path,
    comment: _Line | None,
    line: _Line,
    text: bytes,
    later_texts: Iterator[bytes],
    options: ReadingOptions,
) -> CsvHeader:
    """Return the header, given the first line of ``text`` that is no comment, and the last comment before this line."""
    if comment is not None and _is_header_comment(comment.text, line.text):
        return _build_header(path, label, comment, line.text, text[line.begin :], line.number)
    if _consists_of_numbers(line.text):
        return _build_numbered(label, line, options, text[line.begin :])
    number = line.number + 1
    for rest in itertools.chain([text[line.end :]], later_texts):
        sample = _first_sample(rest)
        if sample is not None:
            return _build_header(path, label, line, sample, rest, number)
        number += rest.count(b"\n")
    return _build_header(path, label, line, None, b"", number)


def split_fields(line: str, separator: str) -> list[str]:
    """Split a line into fields. Quotes are removed. Return no fields if the quotes are damaged."""
    if separator == BLANKS:
        return line.replace('"', "").split()
    if '"' not in line:
        return line.split(separator)
    try:
        return next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    except csv.Error:
        return []


def parse_number(field: str, separator: str) -> float | None:
    """Return the number in a CSV field, NaN for an empty field, or None for text.

    Unlike ``float``, 1_000 is rejected.
    """
    if not field or field.isspace():
        return float("nan")
    if separator in DECIMAL_COMMA_SEPARATORS:
        field = field.replace(",", ".")
    try:
        return None if "_" in field else float(field)
    except ValueError:
        return None


def split_header(line: str, separator: str | None = None) -> list[str]:
    """Return the column names of a header line, which may be a comment.

    By default, the separator is the first of SEPARATORS that the line contains.
    """
    names = line.lstrip("#% ")
    fields = split_fields(names, _first_separator(names) if separator is None else separator)
    return [name.strip(' \t"') for name in fields]


def _first_sample(text: bytes) -> str | None:
    """Return the first line that is neither blank nor a comment, or None."""
    lines = (line.text for line in _iter_lines(text, 1))
    return next((line for line in lines if line and not line.startswith(COMMENT_MARKS)), None)


def _iter_lines(text: bytes, number: int) -> Iterator[_Line]:
    begin = 0
    while (end := text.find(b"\n", begin)) >= 0:
        number += 1
        line = _decode(text[begin:end])
        yield _Line((line.removeprefix(BOM) if number == 1 else line).strip(), number, begin, end + 1)
        begin = end + 1


def _decode(line: bytes) -> str:
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("cp1252", errors="replace")  # the degree sign and the superscript of old programs


def _first_separator(line: str) -> str:
    outside = _QUOTED.sub("", line)
    return next((separator for separator in SEPARATORS if separator and separator in outside), BLANKS)


def _consists_of_numbers(line: str) -> bool:
    separator = _first_separator(line)
    fields = split_fields(line, separator)
    if separator == ",":  # a decimal comma and blanks also look like commas
        fields = [part for field in fields for part in (field.split() or [""])]
    return any(field.strip() for field in fields) and all(parse_number(one, separator) is not None for one in fields)


def _is_header_comment(comment: str, line: str) -> bool:
    """Return True if a comment, and not the first line after it, is the header."""
    names = split_header(comment)
    if names_an_axis(names):
        return not names_an_axis(split_header(line))
    alike = _first_separator(comment.lstrip("#% ")) == _first_separator(line)
    return alike and _consists_of_numbers(line) and len(names) == len(split_header(line)) > 1


def _build_header(
    path: Path, label: Path, header: _Line, sample: str | None, rest: bytes, rest_number: int
) -> CsvHeader:
    """Return the header with the separator that fits the first line of samples."""
    text = header.text.lstrip("#% ")
    if "\0" in text:
        raise RecordingError(
            f"{label}: is no CSV text, expected a first line such as {table.EXAMPLE_HEADER}"
            f"{table.describe_suffix_mismatch(path)}"
        )
    separator = _first_separator(text) if sample is None else _find_separator(label, header, sample)
    table.check_column_count(label, text.count(separator or " ") + 1)
    names = split_header(text, separator)
    fields = [] if sample is None else split_fields(sample, separator)
    if len(fields) == len(names) + 1 and not fields[-1].strip():
        names.append("")  # the lines of samples end with a separator
    mark = next((mark for mark in UNKNOWN_COMMENT_MARKS if text.startswith(mark)), None)
    if mark is not None and len(fields) not in (0, len(names)):
        raise RecordingError(
            f'{label}: line {header.number} begins with "{mark}" like a comment, but comments begin with # or %; '
            "change the mark, or delete the line"
        )
    return CsvHeader(names, separator, header.number, rest, rest_number)


def _find_separator(label: Path, header: _Line, sample: str) -> str:
    """Return the separator of header and samples.

    Raises
    ------
    RecordingError
        If header and samples have different separators, or if decimal commas cannot be told from separators.
    """
    of_sample = _first_separator(sample)
    for separator in (",", *SEPARATORS):  # the names in a header contain no decimal commas
        columns, fields = len(split_header(header.text, separator)), len(split_fields(sample, separator))
        if columns > 1 and fields in (columns, columns + 1) and (separator != BLANKS or of_sample == BLANKS):
            return separator
    separator = _first_separator(header.text.lstrip("#% "))
    columns, fields = len(split_header(header.text)), len(split_fields(sample, of_sample))
    if columns == 1:
        return ","
    if separator == of_sample == "," and columns < fields <= 2 * columns and "." not in sample:
        raise RecordingError(
            f"{label}: the header has {columns} columns, but the first line of samples has {fields} fields: decimal "
            "commas cannot be told from the commas between the fields; export the file with semicolons or tabs"
        )
    if fields > 1 and separator != of_sample and _consists_of_numbers(sample):
        raise RecordingError(
            f"{label}: mixed separators: the fields of line {header.number} are separated by {SEPARATORS[separator]}, "
            f"those of the samples by {SEPARATORS[of_sample]}; use the same separator in all lines"
        )
    return separator or ","


def _build_numbered(label: Path, line: _Line, options: ReadingOptions, rest: bytes) -> CsvHeader:
    """Return the header of a file without a header line, whose columns the user selects by number."""
    given = [column for column in options.columns.values() if column != NOT_READ]
    if not given or not all(column.isdecimal() for column in given):
        raise RecordingError(
            f"{label}: the header line is missing: line {line.number} consists of numbers; expected a header line "
            f"such as {table.EXAMPLE_HEADER}, or the numbers of the columns, such as --columns t=1,gx=2"
        )
    separator = _first_separator(line.text)
    fields = split_fields(line.text, separator)
    if separator == "," and any(len(field.split()) > 1 for field in fields):
        raise RecordingError(
            f"{label}: line {line.number} has commas and blanks, and either can be the separator or the decimal comma; "
            "export the file with semicolons or tabs"
        )
    return CsvHeader([f"column {i}" for i in range(1, len(fields) + 1)], separator, 0, rest, line.number)
