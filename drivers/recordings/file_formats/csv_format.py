"""Reading and writing of plain and gzip-compressed CSV recordings.

An empty field or ``nan`` is a missing value. Blank lines and comment lines are skipped. ``csv_header`` finds the header
line and the separator, and ``table_layout`` the columns that are read.

Times are read as integers if all of them are integers, because float64 would round Unix times in ns.

NumPy parses text in large pieces. A piece with a damaged line is parsed line by line, so that only the damaged line is
lost. If the last line has no line ending, it is skipped, because its last number may be incomplete.

Lines are counted before parsing, so that ``drivers.recordings.memory_check`` can reject a file that is too large.
"""

import codecs
import gzip
import io
import re
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import IO, Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES
from drivers.errors import RecordingError
from drivers.host.safe_file_reading import open_regular_file
from drivers.recordings import memory_check, table
from drivers.recordings.column_guess import MAX_NUMBER, create_unknown_columns_error
from drivers.recordings.column_names import names_counter, names_sensor_kind, suggests_time
from drivers.recordings.file_formats import csv_header
from drivers.recordings.file_formats.csv_header import (
    BLANKS,
    COMMENT_MARKS,
    DECIMAL_COMMA_SEPARATORS,
    CsvHeader,
    parse_number,
    split_fields,
)
from drivers.recordings.file_formats.text_times import DAY_NS, has_date, is_text_time, parse_text_time
from drivers.recordings.reading_options import ReadingOptions
from drivers.recordings.reading_progress import report_read_share
from drivers.recordings.table import POSSIBLE_TIMES
from drivers.recordings.table_layout import TableLayout, find_layout, names_an_axis

READ_BYTES: Final = 1 << 20
MAX_LINE_BYTES: Final = 1 << 20
MAX_EMPTY_MEMBERS: Final = 1000
"""Maximum number of consecutive gzip members without content."""
MAX_BAD_LINES: Final = 100_000
"""Number of invalid lines after which reading stops if most lines are invalid."""
NOT_SAMPLES: Final = re.compile(rb"^[ \t]*(?:[#%].*)?\n", re.MULTILINE)
"""Pattern of blank lines and comment lines."""
CAN_BYTE: Final = re.compile(r"(?:d|b|data|byte)[ _]?\d+", re.IGNORECASE)
"""Pattern of the names of columns that contain the bytes of a CAN frame, as SavvyCAN writes them."""
MIN_CAN_BYTES: Final = 4
MAX_DURATION_DIFFERENCE: Final = 0.02
"""Largest relative difference of the durations of two sensors in the same rows."""
TIME_SEARCH_BYTES: Final = 1 << 16
MIN_TIME_ROWS: Final = 20
"""Size of the text, and number of rows, in which a column of times without a usual name is searched."""
GZIP_BYTES: Final = 1 << 16
"""Number of compressed bytes that are decompressed at once.

Damage to a file loses at most this many compressed bytes.
"""
GZIP_MAGIC: Final = b"\x1f\x8b"
GZIP_LEVEL: Final = 1
"""Level of gzip compression. Level 6 reduces the size of noise data by a further 6 % but takes eight times as long."""


Rows = NDArray[np.void]
"""Structured array [lines] with a field for each quantity."""
_Converters = dict[int | str, Callable[[str], Any]]
"""For the index of each column that contains text: function that returns the number of a field."""


class _FractionalTimeError(Exception):
    """A time is a number but not an integer."""


@dataclass(slots=True)
class _BadLines:
    """Count of invalid lines, with a description of the first invalid line."""

    count: int = 0
    first: str = ""

    def record_bad_line(self, line_number: int, reason: str) -> None:
        self.first = self.first or f"line {line_number}: {reason}"
        self.count += 1


@dataclass(frozen=True, slots=True)
class CsvSource:
    """A CSV file, or a CSV file in an archive."""

    path: Path  # file on disk, whose size determines the limits
    label: str  # name of the source in messages
    sensor: str  # name of the sensor for columns that are only named x, y and z
    open_stream: Callable[[], AbstractContextManager[IO[bytes]]]


def read_csv(path: Path, options: ReadingOptions) -> table.Table:
    """Read the columns of a plain or gzip-compressed CSV file. A truncated last line is skipped.

    Raises
    ------
    RecordingError
        If the file has no header or no samples, or if most lines are invalid.
    ConfigError
        If the samples do not fit into memory, or if a column in the options does not exist.
    """
    return read_csv_source(_file_source(path), options)


def _file_source(path: Path) -> CsvSource:
    return CsvSource(path, str(path), path.name.partition(".")[0], lambda: open_regular_file(path))


def read_csv_source(source: CsvSource, options: ReadingOptions) -> table.Table:
    """Read the columns of a CSV file on disk or in an archive. See ``read_csv``."""
    lines = _count_rows(source)
    try:
        return _read_columns(source, options, "i8", lines)
    except _FractionalTimeError:
        return _read_columns(source, options, "f8", lines)


def _read_columns(source: CsvSource, options: ReadingOptions, time_type: str, lines: int) -> table.Table:
    """Read the columns of a CSV file. Raise _FractionalTimeError if a time does not have the type ``time_type``."""
    notes: list[str] = []
    bad = _BadLines()
    label = Path(source.label)
    with source.open_stream() as file:
        texts = _whole_lines(_decompressed(file, notes), notes)
        header = csv_header.find_header(source.path, label, texts, options, source.sensor)
        if header is None:
            what = notes[-1] if notes else "It has no line at all."
            raise RecordingError(f"{label}: has not one complete line, expected {table.EXAMPLE_HEADER}. {what}")
        layout = _find_csv_layout(source, header, options, notes)
        text_time = _find_text_time(header, layout)
        converters: _Converters = {}
        if text_time:
            time_type = "i8"
            layout.units["t"] = "ns"
            converters[layout.columns["t"]] = parse_text_time
        sensors: dict[str, int] = {}
        if table.SENSOR in layout.columns:
            converters[layout.columns[table.SENSOR]] = lambda field: sensors.setdefault(field.strip(' "'), len(sensors))
        use = list(layout.columns.values())
        dtype = np.dtype([(name, time_type if name == "t" else "f8") for name in layout.columns])
        values = np.full((lines, len(AXES)), np.nan)  # one array, which ``assemble_recording`` does not copy
        columns: dict[str, Any] = {
            name: values[:, AXES.index(name)] if name in AXES else np.empty(lines, dtype[name])
            for name in layout.columns
        }
        read = 0
        for part in _parse_pieces(label, header, texts, use, dtype, bad, converters):
            kept = part[: lines - read]  # a logger may have appended rows since the lines were counted
            for name, column in columns.items():
                column[read : read + len(kept)] = kept[name]
            read += len(kept)
            report_read_share(read, lines)
    if 2 * bad.count > read:
        raise _too_many_bad_lines(label, bad, read)
    if bad.count:
        notes.append(f"{bad.count} of {read} lines are not samples and are read as missing ({bad.first}).")
    if not read:
        what = f". {notes[-1]}" if notes else ""
        raise RecordingError(f"{label}: has a header line but no complete line of samples after it{what}")
    columns = {name: column[:read] for name, column in columns.items()}
    if text_time and not has_date(text_time):
        columns["t"] = table.unwrap_times(columns["t"], DAY_NS)
    rate_hz = None if "t" in columns else header.stated_rate_hz
    return table.Table(columns, rate_hz, notes, layout.units, layout.names, tuple(sensors))


def _find_csv_layout(source: CsvSource, header: CsvHeader, options: ReadingOptions, notes: list[str]) -> TableLayout:
    """Find the columns, and the units that names, a row of units or lines before the header state."""
    label = Path(source.label)
    where = f" in line {header.number}" if header.number else ""
    rows = _first_rows(header)

    def read_column(i: int) -> Sequence[Any]:
        numbers = [parse_number(row[i], header.separator) for row in rows]
        return [row[i] if number is None else number for row, number in zip(rows, numbers, strict=True)]

    if not header.number and not options.columns and not names_an_axis(header.names, source.sensor):
        what = f"{label}: {csv_header.describe_missing_header(header.rest_number)}"
        raise create_unknown_columns_error(label, header.names, what, read_column)
    if sum(CAN_BYTE.fullmatch(name) is not None for name in header.names) >= MIN_CAN_BYTES and not options.columns:
        raise RecordingError(
            f"{label}: contains CAN frames and no samples; save them as a candump log (in SavvyCAN: Can-Dump), and read"
            " the log with --decoder dbc --option file=NAME.dbc"
        )
    found: list[str] = []
    layout = find_layout(label, header.names, options, found, where, source.sensor, read_column)
    steady = [] if "t" in (*layout.columns, *options.columns) else _find_steady_columns(header, layout, rows)
    certain = [i for i, is_certain in steady if is_certain]
    if certain:
        chosen = options.model_copy(update={"columns": {**options.columns, "t": str(certain[0] + 1)}})
        found = [
            f"Column {header.names[certain[0]]} increases steadily and is read as the time; to leave it out, give "
            "--columns t=- --rate HZ."
        ]
        layout = find_layout(label, header.names, chosen, found, where, source.sensor)
    elif steady:
        i = steady[0][0]
        found.append(f"{POSSIBLE_TIMES} {header.names[i]}; if it contains the time, give --columns t={i + 1}.")
    else:
        _check_times_of_sensors(label, header, layout, rows)
    notes += found
    if header.has_units:
        notes.append("The line after the header states the units.")
    if stated := {quantity: unit for quantity, unit in header.stated_units.items() if quantity in layout.columns}:
        layout.units.update({**stated, **layout.units})
        notes.append(f"Lines before the header state the units {', '.join(dict.fromkeys(stated.values()))}.")
    if header.stated_rate_hz is not None and "t" not in layout.columns:
        notes.append(f"Lines before the header state a sample rate of {header.stated_rate_hz:g} Hz.")
    return layout


def _check_times_of_sensors(label: Path, header: CsvHeader, layout: TableLayout, rows: Sequence[Sequence[str]]) -> None:
    """Raise RecordingError if the two sensors have times of their own that advance at different rates."""
    times = {
        kind: i
        for i, name in enumerate(header.names)
        if suggests_time(name) and (kind := names_sensor_kind(name)) and all(row[i] for row in rows)
    }
    durations = {}
    for kind, i in times.items():
        numbers = [parse_number(row[i], header.separator) for row in rows]
        first, last = (numbers[0], numbers[-1]) if len(rows) > 1 else (None, None)
        durations[kind] = None if first is None or last is None else last - first
    gyro_s, accel_s = durations.get("g"), durations.get("a")
    both = {quantity[0] for quantity in layout.columns if quantity in AXES} == {"g", "a"}
    if both and gyro_s and accel_s and abs(gyro_s - accel_s) > MAX_DURATION_DIFFERENCE * gyro_s:
        raise RecordingError(
            f"{label}: the times of the gyroscope and of the accelerometer advance at different rates; read one of "
            f"them, such as --columns t={times['g'] + 1},ax=-,ay=-,az=- or "
            f"--columns t={times['a'] + 1},gx=-,gy=-,gz=-"
        )


def _first_rows(header: CsvHeader) -> list[list[str]]:
    """Return the fields of the first rows that have as many fields as the header."""
    lines = header.rest[:TIME_SEARCH_BYTES].decode("utf-8", errors="replace").splitlines()[:-1]
    return [fields for line in lines if len(fields := split_fields(line, header.separator)) == len(header.names)]


def _find_steady_columns(
    header: CsvHeader, layout: TableLayout, rows: Sequence[Sequence[str]]
) -> list[tuple[int, bool]]:
    """Return the columns that may contain times, and for each True if its name or its text shows that it does.

    Times increase in nearly equal steps, but so do counters and the angle of a rate table.
    """
    unused = [i for i in range(len(header.names)) if i not in layout.columns.values()]
    if len(rows) < MIN_TIME_ROWS:
        return []
    found = []
    for i in unused:
        numbers = np.array([np.nan if (x := parse_number(row[i], header.separator)) is None else x for row in rows])
        steps = np.diff(np.where(np.abs(numbers) < MAX_NUMBER, numbers, np.nan))
        low, typical, high = np.quantile(steps, (0.0, 0.5, 0.9))
        if low > 0.0 and high < 2.0 * typical and typical != 1.0 and not names_counter(header.names[i]):
            found.append((i, suggests_time(header.names[i])))
    texts = [i for i in unused if all(is_text_time(row[i]) for row in rows) and len({row[i] for row in rows}) > 1]
    return found + [(i, True) for i in texts]


def _find_text_time(header: CsvHeader, layout: TableLayout) -> str:
    """Return the first time if the times are text such as ``2024-03-01 23:59:00.010``, or an empty text."""
    fields = split_fields(header.sample or "", header.separator)
    column = layout.columns.get("t", len(fields))
    return fields[column] if column < len(fields) and is_text_time(fields[column]) else ""


def _count_rows(source: CsvSource) -> int:
    """Return the number of complete lines in a CSV file. Raise an error if the file exceeds a size limit."""
    limit = memory_check.measure_read_limit(source.path)
    lines = unpacked = 0
    with source.open_stream() as file:
        for text in _whole_lines(_decompressed(file, []), []):
            lines += text.count(b"\n")
            unpacked += len(text)
            limit.check_row_count(lines)
            if unpacked > limit.size_bytes:
                limit.check_unpacked_size(unpacked)
    return lines


def read_csv_column_names(source: CsvSource, options: ReadingOptions) -> list[str]:
    """Return the column names of a CSV file, without reading the samples. Return no names if there is no header."""
    with source.open_stream() as file:
        texts = _whole_lines(_decompressed(file, []), [])
        header = csv_header.find_header(source.path, Path(source.label), texts, options, source.sensor)
        return header.names if header is not None else []


def _too_many_bad_lines(path: Path, bad: _BadLines, rows: int) -> RecordingError:
    return RecordingError(
        f"{path}: {bad.count} of {rows} lines are not samples ({bad.first}); every field must be a number, empty or nan"
    )


def _decompressed(file: IO[bytes], notes: list[str]) -> Iterator[bytes]:
    """Yield the decompressed text of a plain or gzip file in pieces. Stop where the file is truncated or damaged."""
    start = file.read(2)
    file.seek(0)
    if start != GZIP_MAGIC:
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
    decoder: codecs.IncrementalDecoder | None = None
    for text in texts:
        if decoder is None and not lines and text.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            decoder = codecs.getincrementaldecoder("utf-16")("replace")
        text = text if decoder is None else decoder.decode(text).encode()
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


def _parse_pieces(
    path: Path,
    header: CsvHeader,
    texts: Iterable[bytes],
    use: Sequence[int],
    dtype: np.dtype[Any],
    bad: _BadLines,
    converters: _Converters,
) -> Iterator[Rows]:
    """Yield the rows of each piece of CSV text. ``converters`` contains the columns that are text."""
    number, rows = header.rest_number, 0
    for text in chain((header.rest,), texts):
        text = text.replace(b"\r\n", b"\n")
        if text.strip():
            part = _parse_regular_lines(text, header, use, dtype, converters)
            if part is None and (samples := NOT_SAMPLES.sub(b"", text)) != text and samples:
                part = _parse_regular_lines(samples, header, use, dtype, converters)
            part = _parse_line_by_line(text, number, header, use, dtype, bad, converters) if part is None else part
            rows += len(part)
            if bad.count > MAX_BAD_LINES and 2 * bad.count > rows:
                raise _too_many_bad_lines(path, bad, rows)
            yield part
        number += text.count(b"\n")


def _parse_regular_lines(
    text: bytes, header: CsvHeader, use: Sequence[int], dtype: np.dtype[Any], converters: _Converters
) -> Rows | None:
    """Return the rows of lines, or None if any line is irregular."""
    if header.separator in DECIMAL_COMMA_SEPARATORS and b"," in text:
        text = text.replace(b",", b".")
    codes = np.frombuffer(text, np.uint8)
    line_ends = np.flatnonzero(codes == ord("\n"))
    if header.separator == BLANKS:
        solid = codes > ord(" ")  # a field begins at each change from white space to text
        separators = np.flatnonzero(solid[1:] & ~solid[:-1]) + 1
        fields_before = np.searchsorted(separators, line_ends) + bool(solid[0])
        width = len(header.names)
    else:
        fields_before = np.searchsorted(np.flatnonzero(codes == ord(header.separator)), line_ends)
        width = len(header.names) - 1
    if np.any(np.diff(fields_before, prepend=0) != width):
        return None
    lines = text.decode("utf-8", errors="replace").split("\n")[:-1]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # some versions of NumPy read 1.5 as the integer 1
            return np.loadtxt(
                lines, dtype, delimiter=header.separator or None, comments=None, usecols=use, ndmin=1,
                converters=converters or None,
            )  # fmt: skip
    except (ValueError, DeprecationWarning):
        return None


def _parse_line_by_line(
    text: bytes,
    number: int,
    header: CsvHeader,
    use: Sequence[int],
    dtype: np.dtype[Any],
    bad: _BadLines,
    converters: _Converters,
) -> Rows:
    """Return the rows of lines. Invalid lines become missing values. Comment lines are skipped."""
    missing = tuple(table.NO_TIME_NS if dtype[i].kind == "i" else np.nan for i in range(len(use)))
    rows: list[tuple[float, ...]] = []
    for offset, line in enumerate(text.decode("utf-8", errors="replace").split("\n")[:-1]):
        if not line.strip() or line.lstrip().startswith(COMMENT_MARKS):
            continue
        try:
            rows.append(_parse_sample(line, header, use, dtype, converters))
        except ValueError as error:
            bad.record_bad_line(number + offset, str(error))
            rows.append(missing)
    return np.array(rows, dtype)


def _parse_sample(
    line: str, header: CsvHeader, use: Sequence[int], dtype: np.dtype[Any], converters: _Converters
) -> tuple[float, ...]:
    fields = split_fields(line, header.separator)
    if len(fields) != len(header.names):
        raise ValueError(f"{len(fields)} fields where the header has {len(header.names)}")
    row: list[float] = []
    for column, i in enumerate(use):
        if i in converters:
            row.append(converters[i](fields[i]))
            continue
        number = parse_number(fields[i], header.separator)
        if number is None:
            raise ValueError(f"{header.names[i]} is {fields[i].strip()[:20]!a}")
        row.append(_whole_time(fields[i], number) if dtype[column].kind == "i" else number)
    return tuple(row)


def _whole_time(field: str, number: float) -> int:
    """Return an integer time, or NO_TIME_NS if the time is missing or out of range.

    Raise _FractionalTimeError for any other number.
    """
    if not abs(number) < -table.NO_TIME_NS:  # also True for NaN
        return table.NO_TIME_NS
    try:
        return int(field)
    except ValueError:
        raise _FractionalTimeError from None


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
                # repr gives the shortest text that converts back to the same number.
                fields = [map(repr, columns[name][start : start + table.BATCH_ROWS].tolist()) for name in names]
                file.writelines(",".join(row) + "\n" for row in zip(*fields, strict=True))

        yield append_rows
