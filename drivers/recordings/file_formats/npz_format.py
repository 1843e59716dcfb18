"""Reading and writing of .npz recordings with one array per column, or with matrices such as ``gyro`` of shape n×3.

The sample rate ``fs`` in Hz can replace the times ``t``.

The reader rejects arrays of Python objects, because unpickling can execute code. A truncated zip archive has no index,
so the reader finds each array by its local header.
"""

import math
import re
import shutil
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from mmap import ACCESS_READ, mmap
from pathlib import Path
from tempfile import TemporaryFile
from tokenize import TokenError
from typing import IO, Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from drivers.errors import ImuError, RecordingError
from drivers.host.safe_file_reading import open_regular_file
from drivers.recordings import memory_check, table
from drivers.recordings.column_guess import EXAMINED_ROWS
from drivers.recordings.file_formats.zip_index import IndexSizeLimitedFile
from drivers.recordings.reading_options import ReadingOptions
from drivers.recordings.table_layout import find_layout, is_known_column

LOCAL_HEADER: Final = struct.Struct("<4s5H3I2H")  # local file header, PKWARE APPNOTE 4.3.7
LOCAL_MAGIC: Final = b"PK\3\4"
NPY_ERRORS: Final = (
    ValueError, TypeError, SyntaxError, EOFError, MemoryError, OverflowError, RuntimeError, TokenError, zlib.error
)  # fmt: skip
"""Exceptions that NumPy and zlib raise when an array is damaged."""
COPY_BYTES: Final = 1 << 18
MAX_HEADER_BYTES: Final = 1 << 16
MAX_DEFLATE_RATIO: Final = 1032
"""Highest compression ratio of deflate, https://zlib.net/zlib_tech.html."""
MAX_MATRIX_COLUMNS: Final = 64
"""Largest number of columns of a matrix that is read."""
NUMERIC_KINDS: Final = "fiu"
"""Values of ``numpy.dtype.kind`` that a column may have: float, signed integer and unsigned integer."""
NPY_HEADER: Final = re.compile(
    rb"\x93NUMPY\x01\x00..{'descr': '(?P<kind>[<>|](?:f[248]|[iu][1248]))', 'fortran_order': (?P<fortran>False|True), "
    rb"'shape': \((?:(?P<n>\d{1,18}),(?: (?P<m>[1-9]\d?))?)?\), } *\n",
    re.DOTALL,
)
"""Pattern of the .npy header of a numeric array with at most two dimensions, as all versions of NumPy write it.

The header is matched by a regular expression and never evaluated as Python code.
"""


@dataclass(frozen=True, slots=True)
class _Header:
    """Header of an array in .npy format."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    size_bytes: int  # size of the header in bytes

    @property
    def values(self) -> int:
        """Number of values in the array."""
        return math.prod(self.shape)


def read_npz(path: Path, options: ReadingOptions) -> table.Table:
    """Read the known arrays of a .npz file. If the file is truncated, only the complete values are read.

    Raises
    ------
    RecordingError
        If the file is not a .npz file, contains no readable numbers, or exceeds a size limit.
    ConfigError
        If the samples do not fit into memory.
    """
    notes: list[str] = []
    with IndexSizeLimitedFile(path) as file:
        if _has_index(path, file):
            with _open_archive(path, file) as archive:
                keys = _find_column_keys(path, archive)
                pairs = list(keys.items())

                def read_column(i: int) -> NDArray[Any]:
                    name, key = pairs[i]
                    try:
                        _check_columns(path, archive, [key])
                        return _take_column(_read_array(path, archive, key), name, key)[:EXAMINED_ROWS]
                    except ImuError:  # an array of another type or shape
                        return np.empty(0)

                layout = find_layout(path, list(keys), options, notes, read_column=read_column)
                used = {quantity: pairs[i] for quantity, i in layout.columns.items()}
                _check_columns(path, archive, [key for _, key in used.values()])
                read_newest = lru_cache(1)(partial(_read_array, path, archive))  # a matrix has several columns
                with np.errstate(over="ignore"):  # a long double beyond the range of float64 becomes infinite
                    columns = table.collect_columns(
                        (quantity, table.to_column(quantity, _take_column(read_newest(key), name, key)))
                        for quantity, (name, key) in used.items()
                    )
                return table.Table(columns, _read_fs(path, archive, notes), notes, layout.units, layout.names)
    arrays, cut = _recover_arrays(path, options)
    if not arrays:
        raise RecordingError(f"{path}: is damaged or cut off before its first number")
    where = f" inside {cut}" if cut else ""
    notes.append(f"The file is cut off{where} and was read up to the cut; later columns are missing.")
    return _table_of_recovered(path, arrays, cut, options, notes)


def _has_index(path: Path, file: IO[bytes]) -> bool:
    """Return True if a zip archive is complete, which means that it has an index. Raise an error for other files."""
    if file.read(len(LOCAL_MAGIC)) != LOCAL_MAGIC:
        raise RecordingError(
            f"{path}: is no .npz file, which is a zip archive with one array per column"
            f"{table.describe_suffix_mismatch(path)}"
        )
    file.seek(0)
    complete = zipfile.is_zipfile(file)
    file.seek(0)
    return complete


def _open_archive(path: Path, file: IO[bytes]) -> zipfile.ZipFile:
    """Open a zip archive. Raise RecordingError if the index is damaged."""
    try:
        return zipfile.ZipFile(file)
    except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
        raise RecordingError(f"{path}: its index of arrays is damaged: {error}") from error


def _array_names(archive: zipfile.ZipFile) -> list[str]:
    return [name.removesuffix(".npy") for name in archive.namelist()]


def _find_column_keys(path: Path, archive: zipfile.ZipFile) -> dict[str, str]:
    """Return the name of the array for each column. A matrix has several columns (``table.name_matrix_columns``)."""
    names = _array_names(archive)
    table.check_column_count(path, len(names))
    keys: dict[str, str] = {}
    for key in names:
        shape: tuple[int, ...] = ()
        with suppress(RecordingError):  # an error is reported only if the array is used
            shape = _read_header(path, archive, key).shape
        is_matrix = len(shape) == 2 and 1 <= min(shape) <= MAX_MATRIX_COLUMNS and key not in table.COLUMNS
        columns = table.name_matrix_columns(key, np.broadcast_to(np.uint8(0), shape)) if is_matrix else (key,)
        keys |= dict.fromkeys(columns, key)
    return keys


def _take_column(array: NDArray[Any], name: str, key: str) -> NDArray[Any]:
    return table.name_matrix_columns(key, array)[name] if array.ndim == 2 else array


def _find_member(archive: zipfile.ZipFile, key: str) -> zipfile.ZipInfo:
    names = archive.NameToInfo
    return names[key] if key in names else names[f"{key}.npy"]


def _check_columns(path: Path, archive: zipfile.ZipFile, keys: Sequence[str]) -> None:
    """Check the array headers of all columns."""
    limit = memory_check.measure_read_limit(path)
    for key in keys:
        header = _read_header(path, archive, key)
        if header.dtype.kind not in NUMERIC_KINDS:
            raise RecordingError(f"{path}: {key} contains {_describe_dtype(header.dtype)}, expected numbers")
        if len(header.shape) != 1 and (len(header.shape) != 2 or key in table.COLUMNS):
            raise RecordingError(f"{path}: {key} has shape {header.shape}, expected one dimension")
        limit.check_row_count(header.values if len(header.shape) == 1 else max(header.shape))
        _check_size(path, limit, _find_member(archive, key), key, header)


def _check_size(
    path: Path, limit: memory_check.RecordingSizeLimits, member: zipfile.ZipInfo, key: str, header: _Header
) -> None:
    """Raise RecordingError if a zip member is too small for the number of values stated in the array header."""
    ratio = 1 if member.compress_type == zipfile.ZIP_STORED else MAX_DEFLATE_RATIO
    packed = min(member.compress_size, limit.size_bytes)
    data_bytes = max(min(member.file_size, ratio * packed) - header.size_bytes, 0)
    if header.values * header.dtype.itemsize > data_bytes:
        raise RecordingError(
            f"{path}: {key} is unreadable: its header states {header.values} values, "
            f"its data hold {data_bytes // max(header.dtype.itemsize, 1)} at most"
        )


def _read_header(path: Path, archive: zipfile.ZipFile, key: str) -> _Header:
    """Read the header of an array without reading the data."""
    method = _find_member(archive, key).compress_type
    if method not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # zipfile has no size limit for other methods
        raise RecordingError(
            f"{path}: {key} is packed by method {method} of zip, expected stored or deflated as written by NumPy"
        )
    with _member_errors(path, key), archive.open(_find_member(archive, key)) as member:
        magic = np.lib.format.magic(1, 0)  # other versions are written only for structured arrays
        if member.read(len(magic)) != magic:
            raise ValueError("it is not an array in the format .npy, version 1.0")
        shape, _, dtype = np.lib.format.read_array_header_1_0(member)
        if min(shape, default=0) < 0:
            raise ValueError(f"its shape is {shape}")
        return _Header(shape, dtype, member.tell())


def _describe_dtype(dtype: np.dtype[Any]) -> str:
    return "Python objects" if dtype.hasobject else str(dtype)


def _read_array(path: Path, archive: zipfile.ZipFile, key: str) -> NDArray[Any]:
    """Read a numeric array. Arrays of Python objects are rejected, because unpickling can execute code."""
    with _member_errors(path, key), archive.open(_find_member(archive, key)) as member:
        return np.asarray(np.lib.format.read_array(member, allow_pickle=False))


@contextmanager
def _member_errors(path: Path, key: str) -> Iterator[None]:
    """Convert exceptions of NumPy and zipfile to RecordingError."""
    try:
        with warnings.catch_warnings():  # NumPy warns about headers that old versions wrote
            warnings.simplefilter("ignore")
            yield
    except zipfile.BadZipFile as error:
        raise RecordingError(f"{path}: {key} is damaged: {error}") from error
    except NPY_ERRORS as error:
        raise RecordingError(f"{path}: {key} is unreadable: {error}") from error


def _read_fs(path: Path, archive: zipfile.ZipFile, notes: list[str]) -> float | None:
    """Return the sample rate ``fs`` in Hz, or None if the archive contains no usable rate."""
    if "fs" not in _array_names(archive):
        return None
    header = _read_header(path, archive, "fs")
    if header.dtype.hasobject:
        raise RecordingError(f"{path}: fs contains Python objects, expected a number")
    single = header.values == 1 and header.dtype.kind in NUMERIC_KINDS
    return _single_number(_read_array(path, archive, "fs") if single else np.empty(0), notes)


def _single_number(fs: NDArray[Any], notes: list[str]) -> float | None:
    """Return the sample rate ``fs`` in Hz. If ``fs`` is not a single number, return None and append a note."""
    if fs.size == 1 and fs.dtype.kind in NUMERIC_KINDS:
        return float(fs.item())
    notes.append("fs is not one number in Hz and is not used.")
    return None


# --- archives without an index -------------------------------------------------------------------


def _table_of_recovered(
    path: Path, arrays: Mapping[str, NDArray[Any]], cut: str | None, options: ReadingOptions, notes: list[str]
) -> table.Table:
    """Return the arrays of a truncated archive as a ``Table``. Pad the truncated column with NaN."""
    keys: dict[str, str] = {}
    for key, array in arrays.items():
        keys |= dict.fromkeys(table.name_matrix_columns(key, array) if array.ndim == 2 else (key,), key)
    names = list(keys)
    layout = find_layout(path, names, options, notes)
    columns = {}
    for quantity, name in ((quantity, names[i]) for quantity, i in layout.columns.items()):
        array = _take_column(arrays[keys[name]], name, keys[name])
        if array.ndim != 1:
            raise RecordingError(f"{path}: {name} has shape {array.shape}, expected one dimension")
        columns[quantity] = table.to_column(quantity, array)
    n = max(column.size for column in columns.values())
    for short in [quantity for quantity, i in layout.columns.items() if keys[names[i]] == cut]:
        column = columns[short]
        rest = np.full(n - column.size, np.nan if column.dtype == np.float64 else table.NO_TIME_NS)
        columns[short] = np.concatenate([column, rest])
    fs = _single_number(arrays["fs"], notes) if "fs" in arrays else None
    return table.Table(columns, fs, notes, layout.units, layout.names)


def _recover_arrays(path: Path, options: ReadingOptions) -> tuple[dict[str, NDArray[Any]], str | None]:
    """Recover the arrays of a truncated .npz file by searching for local file headers.

    The result is a dictionary of arrays by name, and the name of the truncated array or None. Arrays with unknown names
    are empty.
    """
    limit = memory_check.measure_read_limit(path)
    arrays: dict[str, NDArray[Any]] = {}
    unpacked = members = 0
    with open_regular_file(path) as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        at = data.find(LOCAL_MAGIC)
        while 0 <= at <= len(data) - LOCAL_HEADER.size:
            members += 1
            table.check_column_count(path, members)
            _, _, flags, method, _, _, _, packed, _, name_size, extra_size = LOCAL_HEADER.unpack_from(data, at)
            start = at + LOCAL_HEADER.size + name_size
            key = data[start - name_size : start].decode("utf-8", errors="replace").removesuffix(".npy")
            extra = data[start : start + extra_size]
            if packed == 0xFFFFFFFF and extra[:2] == b"\1\0" and len(extra) >= 20:  # ZIP64, APPNOTE 4.5.3
                packed = int.from_bytes(extra[12:20], "little")
            start += extra_size
            pieces = _MemberReader(data, start, method, None if flags & 8 else packed)
            wanted = key == "fs" or any(is_known_column(name, options) for name in (key, f"{key}_x"))
            array = _read_up_to_cut(pieces, limit, unpacked, wanted=wanted)
            unpacked += pieces.unpacked
            if array is not None:
                arrays[key] = array
            if pieces.end is None:
                return arrays, key if array is not None else None
            at = data.find(LOCAL_MAGIC, pieces.end)
    return arrays, None


class _MemberReader:
    """Iterator over the unpacked content of a zip member. ``size`` is None if the local file header states no size.

    After the iteration, ``end`` is the offset of the end of the member, or None if the member is truncated.
    """

    def __init__(self, data: mmap, start: int, method: int, size: int | None) -> None:
        self._data, self._at, self._method, self._size = data, start, method, size
        self.unpacked = 0
        self.end: int | None = None

    def __iter__(self) -> Iterator[bytes]:
        if self._method == zipfile.ZIP_STORED and self._size is not None:
            end = self._at + self._size
            while part := self._data[self._at : min(self._at + COPY_BYTES, end)]:
                self._at += len(part)
                self.unpacked += len(part)
                yield part
            self.end = end if self._at == end else None
        elif self._method == zipfile.ZIP_DEFLATED:
            yield from self._inflated()

    def _inflated(self) -> Iterator[bytes]:
        unzip = zlib.decompressobj(-zlib.MAX_WBITS)
        while not unzip.eof:
            packed = self._data[self._at : self._at + COPY_BYTES]
            try:
                part = unzip.decompress(packed, COPY_BYTES)
            except zlib.error:
                return
            rest = len(unzip.unused_data) + len(unzip.unconsumed_tail)
            self._at += len(packed) - rest
            if not packed and not part:
                return
            self.unpacked += len(part)
            if part:
                yield part
        self.end = self._at


def _read_up_to_cut(
    pieces: _MemberReader, limit: memory_check.RecordingSizeLimits, unpacked: int, *, wanted: bool
) -> NDArray[Any] | None:
    """Return the complete numbers in a zip member, or None if the member is not a numeric array.

    ``unpacked`` is the unpacked size of all earlier members in bytes. If ``wanted`` is False, the returned array is
    empty.
    """
    raw = bytearray()
    header: re.Match[bytes] | None = None
    most = MAX_HEADER_BYTES  # number of bytes to keep
    for part in pieces:
        limit.check_unpacked_size(unpacked + pieces.unpacked)
        if len(raw) >= most:
            continue  # continue to the end of the member
        raw += part
        if header is None and (header := NPY_HEADER.match(raw)) is not None:
            header = NPY_HEADER.match(bytes(raw[: header.end()]))
            assert header is not None
            dtype, n, width = np.dtype(header["kind"].decode()), int(header["n"] or 1), int(header["m"] or 1)
            most = header.end() + (n * width * dtype.itemsize if wanted else 0)
        if header is not None and wanted:
            limit.check_row_count(min(n, (len(raw) - header.end()) // (width * dtype.itemsize)))
    if header is None or (header["m"] and (header["fortran"] == b"True" or n < width)):
        return None
    complete = (len(raw) - header.end()) // (width * dtype.itemsize) if wanted else 0
    array = np.frombuffer(raw, dtype, width * min(n, complete), header.end())
    if header["m"]:
        return array.reshape(-1, width) if complete >= width else None
    return array if header["n"] or not array.size else array.reshape(())


@contextmanager
def open_npz_writer(path: Path, names: Sequence[str]) -> Iterator[table.AppendColumns]:
    """Open a compressed .npz file for writing.

    Each column is first written to a temporary file in the folder of ``path``, because zip members can only be written
    one after another.
    """
    with ExitStack() as stack:
        collected = {name: stack.enter_context(TemporaryFile(dir=path.parent)) for name in names}

        def append_rows(columns: table.Columns) -> None:
            for name, file in collected.items():
                file.write(np.ascontiguousarray(columns[name], table.column_dtype(name)).data)

        yield append_rows
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, file in collected.items():
                _write_array(archive, name, file)


def _write_array(archive: zipfile.ZipFile, name: str, numbers: IO[bytes]) -> None:
    """Write an array like ``numpy.savez_compressed``, but copy the numbers from a file instead of from memory."""
    dtype = table.column_dtype(name)
    shape = (numbers.tell() // dtype.itemsize,)
    numbers.seek(0)
    member = zipfile.ZipInfo(f"{name}.npy")  # a constant date, so that equal columns give equal bytes
    member.compress_type = zipfile.ZIP_DEFLATED
    with archive.open(member, "w", force_zip64=True) as file:
        header = {"descr": dtype.str, "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(cast(Any, file), header)
        shutil.copyfileobj(numbers, file, COPY_BYTES)
