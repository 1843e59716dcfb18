"""Reading of MATLAB files of versions 5 to 7 (``save -v6`` and ``save -v7``), also as written by Octave and SciPy.

A vector is a column with the name of the variable. The columns of an n×3 matrix ``gyro`` are named ``gyro_x``,
``gyro_y`` and ``gyro_z``, and those of any other matrix ``data_1``, ``data_2`` and so on. The fields of a structure are
named ``imu.gyro``. A scalar ``fs`` is the sample rate. Text, cell arrays, objects and complex numbers are ignored.

The format is described in "MAT-File Format" (MathWorks), chapter 1. The function ``scipy.io.loadmat`` is not used,
because some damaged files end the process with a segmentation fault (SciPy 1.17.1).
"""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

from drivers.data_types import Floats
from drivers.errors import ImuError, RecordingError
from drivers.host.safe_file_reading import open_regular_file
from drivers.recordings import memory_check, table
from drivers.recordings.column_guess import EXAMINED_ROWS
from drivers.recordings.reading_options import ReadingOptions
from drivers.recordings.table_layout import find_layout

HEADER_BYTES: Final = 128
VERSION_5: Final = b"MATLAB 5.0 MAT-file"
VERSION_7_3: Final = (b"MATLAB 7.3 MAT-file", b"\x89HDF")
MATRIX: Final = 14
"""Type of a data element that contains a variable."""
COMPRESSED: Final = 15
"""Type of a data element that contains a compressed variable."""
NUMBER_TYPES: Final = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"
}  # fmt: skip
"""NumPy type of each type of numeric data element."""
STRUCTURE_CLASS: Final = 2
NUMBER_CLASSES: Final = range(6, 16)
COMPLEX_FLAG: Final = 0x0800
READ_BYTES: Final = 1 << 16
RATE_NAMES: Final = ("fs", "Fs")
MAX_DEPTH: Final = 5
"""Maximum nesting of structures that are searched for columns."""


def read_matlab(path: Path, options: ReadingOptions) -> table.Table:
    """Read the columns of a MATLAB file. If the file is truncated, only the complete variables are read.

    Raises
    ------
    RecordingError
        If the file has another version, is damaged, or contains no axis.
    ConfigError
        If the samples do not fit into memory, or if a column in the options does not exist.
    """
    notes: list[str] = []
    columns, fs = _load_columns(path, notes)
    names = list(columns)
    layout = find_layout(path, names, options, notes, read_column=lambda i: columns[names[i]][:EXAMINED_ROWS])
    found = {quantity: table.to_column(quantity, columns[names[i]]) for quantity, i in layout.columns.items()}
    return table.Table(found, fs, notes, layout.units, layout.names)


def _load_columns(path: Path, notes: list[str]) -> tuple[dict[str, Floats], float | None]:
    """Return all numeric columns of a MATLAB file by name, and the sample rate in Hz or None."""
    columns: dict[str, Floats] = {}
    fs = None
    limit = memory_check.measure_read_limit(path)
    with open_regular_file(path) as file:
        order = _read_byte_order(path, file)
        try:
            for name, array in _iter_variables(file, order, limit):
                if name in RATE_NAMES and array.size == 1:
                    fs = float(array.item())
                elif array.ndim == 2 and array.size:
                    columns |= table.name_matrix_columns(name, array)
                    limit.check_row_count(max(array.shape))
                table.check_column_count(path, len(columns))
        except ImuError:
            raise
        except EOFError:
            notes.append("The file is cut off; the variables after the cut are missing.")
        except (ValueError, OverflowError, struct.error, zlib.error) as error:
            raise RecordingError(f"{path}: is damaged: {error}") from error
    if not columns:
        why = f" ({notes[0].rstrip('.')})" if notes else ""
        raise RecordingError(f"{path}: contains no vector and no matrix of numbers{why}; save the samples as variables")
    return columns, fs


def _read_byte_order(path: Path, file: IO[bytes]) -> str:
    """Return the byte order in the notation of ``struct``. Raise RecordingError for files of other versions."""
    start = file.read(HEADER_BYTES)
    if start.startswith(VERSION_7_3):
        raise RecordingError(
            f"{path}: is a MATLAB file of version 7.3 (HDF5), which is not read; save it with save(FILE, …, '-v7')"
        )
    if not start.startswith(VERSION_5) or len(start) < HEADER_BYTES:
        raise RecordingError(
            f"{path}: is no MATLAB file of version 5 to 7; save it with save(FILE, …, '-v7')"
            f"{table.describe_suffix_mismatch(path)}"
        )
    return "<" if start.endswith(b"IM") else ">"


def _iter_variables(file: IO[bytes], order: str, limit: memory_check.RecordingSizeLimits) -> Iterator[tuple[str, Any]]:
    """Yield the numeric arrays of a file with their names. Raise EOFError if the file is truncated."""
    unpacked = 0
    while tag := file.read(8):
        if len(tag) < 8:
            raise EOFError
        kind, size = struct.unpack(f"{order}II", tag)
        if kind == COMPRESSED:
            pieces = []
            for piece in _iter_unpacked(file, size):
                unpacked += len(piece)
                limit.check_held_size(unpacked)
                pieces.append(piece)
            content = _Content(memoryview(b"".join(pieces)), order)
            kind, data = content.read_element()
        else:
            limit.check_needed_memory(memory_check.COPIES * min(size, limit.size_bytes))
            data = memoryview(file.read(min(size, limit.size_bytes)))
            if len(data) < size:
                raise EOFError
        if kind == MATRIX:
            yield from _iter_arrays("", _Content(data, order), 0)


def _iter_unpacked(file: IO[bytes], size: int) -> Iterator[bytes]:
    """Yield the unpacked pieces of a compressed element."""
    unzip = zlib.decompressobj()
    while not unzip.eof:
        packed = unzip.unconsumed_tail
        if not packed:
            packed = file.read(min(size, READ_BYTES))
            size -= len(packed)
            if not packed:
                raise EOFError
        yield unzip.decompress(packed, READ_BYTES)
    file.seek(size, 1)


@dataclass(slots=True)
class _Content:
    """Reader of the data elements inside another data element."""

    data: memoryview
    order: str
    at: int = 0

    def read_element(self) -> tuple[int, memoryview]:
        """Return the type and the data of the next element. Raise ValueError if the element is longer than the data."""
        kind, size = struct.unpack_from(f"{self.order}II", self.data, self.at)
        start = self.at + 8
        if kind >> 16:  # a small element, whose data are in the tag
            kind, size, start = kind & 0xFFFF, kind >> 16, self.at + 4
            self.at += 8
        else:
            self.at = start + size + -size % 8
        if start + size > len(self.data):
            raise ValueError("a data element is longer than the variable that contains it")
        return kind, self.data[start : start + size]

    def read_numbers(self) -> Any:
        """Return the numbers of the next element as a NumPy array [n]."""
        kind, data = self.read_element()
        if kind not in NUMBER_TYPES:
            raise ValueError(f"a data element has the type {kind}, expected numbers")
        return np.frombuffer(data, f"{self.order}{NUMBER_TYPES[kind]}")

    def read_first_number(self) -> int:
        """Return the first number of the next element."""
        numbers = self.read_numbers()
        if not numbers.size:
            raise ValueError("a data element is empty, expected a number")
        return int(numbers[0])

    def read_text(self) -> str:
        """Return the characters of the next element."""
        return bytes(self.read_element()[1]).decode("ascii")


def _iter_arrays(prefix: str, content: _Content, depth: int, field: str | None = None) -> Iterator[tuple[str, Any]]:
    """Yield the numeric arrays of a variable and of the fields of a structure, with their names."""
    if not len(content.data):
        return  # an empty field
    flags = content.read_first_number()
    shape = tuple(int(n) for n in content.read_numbers())
    stated_name = content.read_text()
    name = f"{prefix}{stated_name if field is None else field}"  # the array of a field has no name
    kind = flags & 0xFF
    if kind in NUMBER_CLASSES and not flags & COMPLEX_FLAG:
        numbers = content.read_numbers()
        if min(shape, default=-1) < 0 or math.prod(shape) != numbers.size:
            raise ValueError(f"{name} has {numbers.size} numbers and the shape {shape}")
        yield name, numbers.reshape(shape, order="F")
    elif kind == STRUCTURE_CLASS and math.prod(shape) == 1 and depth < MAX_DEPTH:
        length = content.read_first_number()
        text = content.read_text()
        if length < 1:
            raise ValueError(f"the field names of {name} have {length} characters")
        for start in range(0, len(text), length):
            _, data = content.read_element()
            one = text[start : start + length].rstrip("\0")
            yield from _iter_arrays(f"{name}.", _Content(data, content.order), depth + 1, one)
