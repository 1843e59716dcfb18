"""Header line and separator of a table in text.

Fields are separated by commas, semicolons, tabs or blanks. Numbers in a file with semicolons or tabs may have decimal
commas. The header is the first line that names an axis. Lines before it are skipped, whether or not they are marked as
comments. If no line names an axis, the header is the line before the first samples. If a comment with the same number
of fields precedes the first samples, this comment is the header, as ``numpy.savetxt`` writes it. A file without a
header can be read if the user gives the numbers of its columns.

A row of units may follow the header. Its units are appended to the column names, as in ``gyro_x [deg/s]``.
"""

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, zip_longest
from pathlib import Path
from typing import Final

from drivers.errors import RecordingError
from drivers.host.safe_file_reading import open_regular_file
from drivers.recordings import table
from drivers.recordings.column_names import ACCELEROMETER, GYRO, KINDS, TIME, names_sensor_kind, split_unit
from drivers.recordings.file_formats.text_times import is_text_time
from drivers.recordings.reading_options import NOT_READ, ReadingOptions
from drivers.recordings.table_layout import names_an_axis

MAX_PREAMBLE_BYTES: Final = 1 << 20
"""Maximum total size of the blank lines and comments before the header."""
COMMENT_MARKS: Final = ("#", "%")
MAX_TABLE_START_BYTES: Final = 1 << 16
SENSOR_FIELDS: Final = ("time", "x", "y", "z")
"""Columns of a file without a header line that is named after a sensor, as RIDI and ADVIO write them."""
MAX_PREAMBLE_LINES: Final = 500
"""Number of lines that are searched for column names of an axis."""
NO_UNITS: Final = ("", "-", "--", "n/a", "none", "None", "1", "bool", "count", "counts", "#", "unix time", "utc")
"""Fields in a row of units for columns without a unit."""
BOM: Final = "\N{ZERO WIDTH NO-BREAK SPACE}"
BLANKS: Final = ""
"""Separator of files whose fields are separated by any number of blanks."""
SEPARATORS: Final = {";": "semicolons", "\t": "tabs", ",": "commas", BLANKS: "blanks"}
"""Separators with their names. Commas follow semicolons and tabs, because they may also be decimal commas."""
DECIMAL_COMMA_SEPARATORS: Final = (";", "\t")
_NO_ROW: Final = re.compile("[#%]|sep=.?$", re.IGNORECASE)
"""Start of a comment, and the line that tells Excel the separator."""
MAX_METADATA_CHARACTERS: Final = 200
"""Length of the lines before the header that are searched for units and for the sample rate."""
MIN_NUMBER_ROWS: Final = 10
MIN_NUMBERS: Final = 4
"""Number of lines, and of numbers in each line, of a table without a header line."""
_RATE_LINE: Final = re.compile(
    r"(?:sampl(?:e|ing)|update|data|output)[ _]?(?:rate|frequency)\W*(\d+(?:\.\d*)?) ?Hz", re.IGNORECASE
)
_SCALE_LINE: Final = re.compile(r"[\W_]*([tga]scale)\s*[,;:=\s]\s*([-+.\deE]+)[\s,;]*", re.IGNORECASE)
_SCALED_UNITS: Final = {"tscale": (TIME, "s"), "gscale": (GYRO, "rad/s"), "ascale": (ACCELEROMETER, "g")}
"""Units of the scales of Gyroflow files."""
_UNIT_LINE: Final = re.compile(
    r"[\W_]*(gyro|gyroscope|acc|accel|accelerometer|time|timestamp|temperature)[ _]units?\s*[,;:=]\s*(.*?)[\s,;]*",
    re.IGNORECASE,
)
_ENCLOSED: Final = re.compile(r"\s*[\[(]\s*(.*?)\s*[\])]\s*")
"""Unit in brackets."""
_QUOTED: Final = re.compile('"[^"]*"')


@dataclass(frozen=True, slots=True)
class CsvHeader:
    """Column names and separator of a CSV file, and the text that was read together with the header."""

    names: list[str]
    separator: str  # a key of SEPARATORS
    number: int  # number of the header line; 0 if the file has no header
    rest: bytes  # text after the header
    rest_number: int  # line number of the first line of ``rest``
    sample: str | None  # first line of samples
    has_units: bool = False  # True if a row of units follows the header
    stated_rate_hz: float | None = None  # sample rate that a line before it states
    stated_units: Mapping[str, str] = field(default_factory=dict)  # unit of each quantity that a line before it states


@dataclass(frozen=True, slots=True)
class _Line:
    text: str
    number: int
    begin: int  # offset of the line in its piece of text
    end: int  # offset of the next line


def find_header(
    path: Path, label: Path, texts: Iterator[bytes], options: ReadingOptions, sensor: str = ""
) -> CsvHeader | None:
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
    sensor
        Name of the sensor of a file with the samples of one sensor.

    Raises
    ------
    RecordingError
        If the file has no header and the user does not give the numbers of the columns, or if the separators of header
        and samples differ.
    """
    text = b""
    for part in texts:
        text += part
        lines = list(_iter_lines(text, 0))
        rows = [line for line in lines if line.text.strip() and not _NO_ROW.match(line.text)]
        if len(rows) > 2:
            break
        if len(text) > MAX_PREAMBLE_BYTES:
            searched = lines[-1].number
            raise RecordingError(
                f"{label}: has no header line within its first {searched} lines, only comments and blank lines; "
                f"expected {table.EXAMPLE_HEADER} within {MAX_PREAMBLE_BYTES} bytes"
            )
    if not text:
        return None
    comments = [line for line in lines if line.text.startswith(COMMENT_MARKS)]
    if not rows:
        if not comments or not names_an_axis(split_header(comments[-1].text)):
            raise RecordingError(
                f"{label}: contains only comments and blank lines, expected a header such as {table.EXAMPLE_HEADER}"
            )
        return _build_header(path, label, comments[-1], [], text, len(lines))
    first, header = _find_header_row(rows)
    if header is None or not names_an_axis(split_header(header.text)):
        start = first if header is None else 0
        before = [line for line in comments if line.number < rows[start].number]
        if before and _is_header_comment(before[-1].text, rows[start].text):
            first, header = start, before[-1]
    if header is None:
        return _build_numbered(label, rows[first], options, text[rows[first].begin :], sensor)
    found = _build_header(path, label, header, rows[first:], text, len(lines))
    before = [line for line in lines[: header.number - 1] if len(line.text) <= MAX_METADATA_CHARACTERS]
    rates = {float(rate[1]) for line in before if (rate := _RATE_LINE.search(line.text))}
    rate_hz = rates.pop() if len(rates) == 1 else None
    return replace(found, stated_units=_read_stated_units(before), stated_rate_hz=rate_hz)


def _read_stated_units(lines: Sequence[_Line]) -> dict[str, str]:
    """Return the unit of each quantity that lines before the header state, such as ``gscale,0.001`` of Gyroflow."""
    units: dict[str, str] = {}
    for line in lines[:MAX_PREAMBLE_LINES]:
        if scale := _SCALE_LINE.fullmatch(line.text):
            number = parse_number(scale[2], ",") or 0.0
            if number > 0.0:
                kind, unit = _SCALED_UNITS[scale[1].lower()]
                units |= dict.fromkeys(kind.quantities, f"{unit}/{1.0 / number:.12g}")
        elif stated := _UNIT_LINE.fullmatch(line.text):
            kind = next(kind for kind in KINDS if kind.name[:2] == stated[1][:2].lower())
            units |= dict.fromkeys(kind.quantities, kind.find_unit(stated[2]) or stated[2])
    return units


def _find_header_row(rows: Sequence[_Line]) -> tuple[int, _Line | None]:
    """Return the index of the first row after the header, and the header. It is None if the samples begin at once."""
    for i, row in enumerate(rows[:MAX_PREAMBLE_LINES]):
        if names_an_axis(split_header(row.text)):
            return i + 1, row
        fields = split_fields(row.text, find_separator(row.text))
        if len(fields) > 1 and _consists_of_numbers(row.text):
            alike = i and len(split_header(rows[i - 1].text)) == len(fields)
            return i, rows[i - 1] if alike or i == 1 else None
    return (0, None) if _consists_of_numbers(rows[0].text) else (1, rows[0])


def is_table_text(path: Path) -> bool:
    """Return True if a text file contains a line of column names with an axis, or only lines of numbers."""
    with open_regular_file(path) as file:
        lines = list(_iter_lines(file.read(MAX_TABLE_START_BYTES), 0))
    rows = [line.text for line in lines if line.text.strip()]
    for row, following in pairwise(rows[:MAX_PREAMBLE_LINES]):
        names = split_header(row)
        if len(names) > 1 and names_an_axis(names):
            fields = [field.strip() for field in split_fields(following, find_separator(following))]
            return _is_unit_row(fields, len(names)) or any(parse_number(field, ",") is not None for field in fields)
    rows = [row for row in rows if not _NO_ROW.match(row)]
    widths = {len(split_fields(row, find_separator(row))) for row in rows}
    return (
        len(rows) >= MIN_NUMBER_ROWS
        and min(widths) == max(widths) >= MIN_NUMBERS
        and all(map(_consists_of_numbers, rows))
    )


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
    fields = split_fields(names, find_separator(names) if separator is None else separator)
    return [name.strip(' \t"') for name in fields]


def _iter_lines(text: bytes, number: int) -> Iterator[_Line]:
    begin = 0
    while (end := text.find(b"\n", begin)) >= 0:
        number += 1
        line = _decode(text[begin:end])
        yield _Line((line.removeprefix(BOM) if number == 1 else line).strip(" \r"), number, begin, end + 1)
        begin = end + 1


def _decode(line: bytes) -> str:
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("cp1252", errors="replace")  # the degree sign and the superscript of old programs


def find_separator(line: str) -> str:
    """Return the first of SEPARATORS that a line contains outside of quotes."""
    outside = _QUOTED.sub("", line)
    return next((separator for separator in SEPARATORS if separator and separator in outside), BLANKS)


def _consists_of_numbers(line: str) -> bool:
    separator = find_separator(line)
    fields = split_fields(line, separator)
    if len(fields) > 1:
        fields = [field for field in fields if not is_text_time(field)]
    if separator == ",":  # a decimal comma and blanks also look like commas
        fields = [part for field in fields for part in (field.split() or [""])]
    return any(field.strip() for field in fields) and all(parse_number(one, separator) is not None for one in fields)


def _is_header_comment(comment: str, line: str) -> bool:
    """Return True if a comment, and not the first line after it, is the header."""
    names = split_header(comment)
    if names_an_axis(names):
        return not names_an_axis(split_header(line))
    alike = find_separator(comment.lstrip("#% ")) == find_separator(line)
    return alike and _consists_of_numbers(line) and len(names) == len(split_header(line)) > 1


def _build_header(path: Path, label: Path, header: _Line, rows: Sequence[_Line], text: bytes, lines: int) -> CsvHeader:
    """Return the header with the separator that fits the first line of samples, given the rows after the header."""
    names_text = header.text.lstrip("#% ")
    if "\0" in names_text:
        raise RecordingError(
            f"{label}: is no CSV text, expected a first line such as {table.EXAMPLE_HEADER}"
            f"{table.describe_suffix_mismatch(path)}"
        )
    sample = rows[0].text if rows else None
    separator = find_separator(names_text) if sample is None else _find_common_separator(label, header, sample)
    table.check_column_count(label, names_text.count(separator or " ") + 1)
    names = split_header(names_text, separator)
    units = [] if sample is None else [field.strip() for field in split_fields(sample, separator)]
    has_units = _is_unit_row(units, len(names))
    if has_units:
        pairs = zip_longest(names, units[: len(names)], fillvalue="")
        names = [_append_unit(name, unit) for name, unit in pairs]
        rows = rows[1:]
        while rows and _describes_columns(rows[0].text, separator):
            rows = rows[1:]
        sample = rows[0].text if rows else None
    fields = [] if sample is None else split_fields(sample, separator)
    if len(fields) == len(names) + 1 and not fields[-1].strip():
        names.append("")  # the lines of samples end with a separator
    rest = text[rows[0].begin :] if rows else b""
    return CsvHeader(names, separator, header.number, rest, rows[0].number if rows else lines + 1, sample, has_units)


def _is_unit_row(fields: Sequence[str], columns: int) -> bool:
    """Return True if the line after the header contains units: no numbers, and most of its fields are known units."""
    given = [field for field in fields if field and field not in NO_UNITS]
    if len(fields) not in (columns, columns + 1) or len(given) < min(columns, 2):
        return False
    known = [field for field in given if any(kind.find_unit(field) is not None for kind in KINDS)]
    return 2 * len(known) >= len(given) and all(parse_number(field, ",") is None for field in given)


def _describes_columns(line: str, separator: str) -> bool:
    """Return True if a line after the units contains only text, such as the sources of the columns."""
    given = [field for field in split_fields(line, separator) if field.strip()]
    return len(given) > 1 and all(parse_number(field, separator) is None and not is_text_time(field) for field in given)


def _append_unit(name: str, unit: str) -> str:
    found = _ENCLOSED.fullmatch(unit)
    unit = found[1] if found else unit
    return name if unit in NO_UNITS or split_unit(name)[1] is not None else f"{name} [{unit}]"


def _find_common_separator(label: Path, header: _Line, sample: str) -> str:
    """Return the separator of header and samples.

    Raises
    ------
    RecordingError
        If header and samples have different separators, or if decimal commas cannot be told from separators.
    """
    of_sample = find_separator(sample)
    for separator in (",", *SEPARATORS):  # the names in a header contain no decimal commas
        columns, fields = len(split_header(header.text, separator)), len(split_fields(sample, separator))
        if columns > 1 and fields in (columns, columns + 1) and (separator != BLANKS or of_sample == BLANKS):
            return separator
    separator = find_separator(header.text.lstrip("#% "))
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


def _build_numbered(label: Path, line: _Line, options: ReadingOptions, rest: bytes, sensor: str) -> CsvHeader:
    """Return the header of a file without a header line, whose columns the user selects by number."""
    given = [column for column in options.columns.values() if column != NOT_READ]
    if not all(column.isdecimal() for column in given):
        raise RecordingError(f"{label}: {describe_missing_header(line.number)}, such as --columns t=1,gx=2")
    separator = find_separator(line.text)
    fields = split_fields(line.text, separator)
    if separator == "," and any(len(field.split()) > 1 and not is_text_time(field) for field in fields):
        raise RecordingError(
            f"{label}: line {line.number} has commas and blanks, and either can be the separator or the decimal comma; "
            "export the file with semicolons or tabs"
        )
    names = [f"column {i}" for i in range(1, len(fields) + 1)]
    first = [
        parse_number(split_fields(one.text, separator)[0], separator)
        for one in _iter_lines(rest[:MAX_TABLE_START_BYTES], 0)
    ]
    increases = len(first) > 2 and all(a is not None and b is not None and a < b for a, b in pairwise(first))
    if len(fields) == len(SENSOR_FIELDS) and names_sensor_kind(sensor) and not given and increases:
        names = [*SENSOR_FIELDS]
    return CsvHeader(names, separator, 0, rest, line.number, line.text)


def describe_missing_header(line_number: int) -> str:
    """Return the problem of a file without column names."""
    return (
        f"the header line is missing: line {line_number} consists of numbers; expected a header line such as "
        f"{table.EXAMPLE_HEADER}, or the numbers of the columns"
    )
