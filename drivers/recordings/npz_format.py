""".npz: one array a column, ``fs`` (Hz) may stand for ``t``.

Arrays of Python objects are refused, never unpickled. The headers of all columns are checked against the limits of
``drivers.recordings.memory_check`` before the data of any are read. A zip archive keeps its index at the end, so
from a cut file the arrays are found again by the header that stands before each.
"""

import io
import math
import re
import shutil
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from io import FileIO
from mmap import ACCESS_READ, mmap
from pathlib import Path
from tempfile import TemporaryFile
from tokenize import TokenError
from typing import IO, Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from drivers.errors import RecordingError
from drivers.file_access import open_regular
from drivers.recordings import memory_check
from drivers.recordings.table import ALIASES, COLUMNS, Append, Columns, Table, check_width, chosen_columns, looks_like
from drivers.sample import Floats

LOCAL_HEADER: Final = struct.Struct("<4s5H3I2H")  # PKWARE APPNOTE 4.3.7
LOCAL_MAGIC: Final = b"PK\3\4"
ITEM: Final = np.dtype("<f8")
UNREADABLE: Final = (
    ValueError, TypeError, SyntaxError, EOFError, MemoryError, OverflowError, RuntimeError, TokenError, zlib.error
)  # fmt: skip
"""What NumPy and zlib raise for an array of rubbish."""
COPY_BYTES: Final = 1 << 18
MAX_INDEX_BYTES: Final = 4_000_000
"""Of the index of an archive: some 50 000 arrays."""
MAX_HEADER_BYTES: Final = 1 << 16
MAX_DEFLATE_RATIO: Final = 1032
"""The most that deflate can pack, https://zlib.net/zlib_tech.html."""
NUMBERS: Final = "fiu"
"""Kinds of NumPy types that a column may have."""
NPY_MAGIC: Final = b"\x93NUMPY"
WANTED: Final = frozenset((*COLUMNS, *ALIASES, "fs"))
NPY: Final = re.compile(
    rb"\x93NUMPY\x01\x00..{'descr': '(?P<kind>[<>|](?:f[248]|[iu][1248]))', 'fortran_order': (?:False|True), "
    rb"'shape': \((?:(?P<n>\d{1,18}),)?\), } *\n",
    re.DOTALL,
)
"""The head of an array of numbers with one dimension or none, as every NumPy writes it: nothing in it is evaluated."""


class _Archive(FileIO):
    """A file that refuses to be read in parts larger than MAX_INDEX_BYTES.

    ``zipfile`` reads the whole index of an archive at once, and makes some 500 bytes of every entry of 50.
    """

    def read(self, size: int | None = -1, /) -> bytes:
        """Read up to ``size`` bytes."""
        if size is not None and size > MAX_INDEX_BYTES:
            raise zipfile.BadZipFile(f"it has {size} bytes, expected at most {MAX_INDEX_BYTES}")
        return super().read(size) or b""


@dataclass(frozen=True, slots=True)
class _Header:
    """What the header of a .npy array says."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    size_bytes: int  # of the header

    @property
    def values(self) -> int:
        """Number of values."""
        return math.prod(self.shape)


def count_rows(path: Path) -> int:
    """Return the number of rows that the headers of the columns state, without reading the columns.

    Raises
    ------
    RecordingError, ConfigError
        The file is no .npz, or exceeds a limit of ``drivers.recordings.memory_check``.
    """
    with _Archive(path) as file:
        if not _is_whole(path, file):
            return 0  # a cut archive is measured while it is read
        with _opened(path, file) as archive:
            return _checked_rows(path, archive, chosen_columns(path, _keys(archive), []))


def read_npz(path: Path) -> Table:
    """Only the arrays that mean something are read, the whole ones and up to a cut."""
    notes: list[str] = []
    with _Archive(path) as file:
        if _is_whole(path, file):
            with _opened(path, file) as archive:
                chosen = chosen_columns(path, _keys(archive), notes)
                _checked_rows(path, archive, chosen)
                columns = {name: _npz_column(path, archive, key) for name, key in chosen.items()}
                return Table(columns, _npz_rate(path, archive, notes), notes)
    arrays, cut = _recovered(path)
    if not arrays:
        raise RecordingError(f"{path}: is damaged or cut off before its first number")
    at = f" inside {cut}" if cut else ""
    notes.append(f"The file is cut off{at} and was read up to the cut; later columns are missing.")
    return _recovered_table(path, arrays, cut, notes)


def _is_whole(path: Path, file: IO[bytes]) -> bool:
    """Return True for a zip archive with its index, False for one without; RecordingError for anything else."""
    if file.read(len(LOCAL_MAGIC)) != LOCAL_MAGIC:
        raise RecordingError(f"{path}: is no .npz file (a zip archive with one array a column){looks_like(path)}")
    file.seek(0)
    whole = zipfile.is_zipfile(file)
    file.seek(0)
    return whole


def _opened(path: Path, file: IO[bytes]) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(file)
    except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
        raise RecordingError(f"{path}: its index of arrays is damaged: {error}") from error


def _keys(archive: zipfile.ZipFile) -> list[str]:
    return [name.removesuffix(".npy") for name in archive.namelist()]


def _member(archive: zipfile.ZipFile, key: str) -> zipfile.ZipInfo:
    names = archive.NameToInfo
    return names[key] if key in names else names[f"{key}.npy"]


def _checked_rows(path: Path, archive: zipfile.ZipFile, chosen: Mapping[str, str]) -> int:
    """Return the rows of the longest column; raise an error where the file cannot hold them or the memory does not."""
    limit = memory_check.limit_of(path)
    rows = 0
    for key in chosen.values():
        header = _header(path, archive, key)
        if header.dtype.kind not in NUMBERS:
            raise RecordingError(f"{path}: {key} holds {_kind(header.dtype)}, not numbers")
        if len(header.shape) != 1:
            raise RecordingError(f"{path}: {key} has shape {header.shape}; a column has one dimension")
        rows = max(rows, header.values)
        limit.check_rows(rows)
        _check_size(path, limit, _member(archive, key), key, header)
    return rows


def _check_size(path: Path, limit: memory_check.ReadLimit, member: zipfile.ZipInfo, key: str, header: _Header) -> None:
    """Raise RecordingError if the member cannot hold the values that the header of its array states."""
    ratio = 1 if member.compress_type == zipfile.ZIP_STORED else MAX_DEFLATE_RATIO
    packed = min(member.compress_size, limit.size_bytes)
    held = min(member.file_size, ratio * packed) - header.size_bytes
    if header.values * header.dtype.itemsize > held:
        raise RecordingError(
            f"{path}: {key} is unreadable: its header states {header.values} values, "
            f"its data hold {max(held, 0) // max(header.dtype.itemsize, 1)} at most"
        )


def _header(path: Path, archive: zipfile.ZipFile, key: str) -> _Header:
    """Return the header of an array without reading its data."""
    method = _member(archive, key).compress_type
    if method not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # zipfile unpacks others without a bound
        raise RecordingError(
            f"{path}: {key} is packed by method {method} of zip, expected stored or deflated, as NumPy writes them"
        )
    with _errors(path, key), archive.open(_member(archive, key)) as member:
        start = member.read(len(NPY_MAGIC) + 4)
        version, size_bytes = start[len(NPY_MAGIC) : len(NPY_MAGIC) + 2], 2
        if not start.startswith(NPY_MAGIC):
            raise ValueError("it is no array in the format .npy")
        if version == b"\2\0":
            start += member.read(2)
            size_bytes = 4
        elif version != b"\1\0":
            raise ValueError(f"version {'.'.join(map(str, version))} of .npy is no version for numbers")
        size = int.from_bytes(start[-size_bytes:], "little")
        if size > MAX_HEADER_BYTES:
            raise ValueError(f"its header has {size} bytes, expected at most {MAX_HEADER_BYTES}")
        text = io.BytesIO(start[-size_bytes:] + member.read(size))
        if size_bytes == 2:
            shape, _, dtype = np.lib.format.read_array_header_1_0(text)
        else:
            shape, _, dtype = np.lib.format.read_array_header_2_0(text)
        if min(shape, default=0) < 0:
            raise ValueError(f"its shape is {shape}")
        return _Header(shape, dtype, len(start) + size)


def _kind(dtype: np.dtype[Any]) -> str:
    return "Python objects" if dtype.hasobject else str(dtype)


def _npz_column(path: Path, archive: zipfile.ZipFile, key: str) -> Floats:
    """One column as float64, whose header has been checked."""
    with np.errstate(over="ignore"):  # a long double beyond the range of float64 becomes infinite: read as missing
        return _npz_array(path, archive, key).astype(np.float64)


def _npz_array(path: Path, archive: zipfile.ZipFile, key: str) -> NDArray[Any]:
    """An array of numbers; one of objects is refused, since reading it would run code."""
    with _errors(path, key), archive.open(_member(archive, key)) as member:
        return np.asarray(np.lib.format.read_array(member, allow_pickle=False))


@contextmanager
def _errors(path: Path, key: str) -> Iterator[None]:
    """Raise what NumPy and zipfile raise for a damaged member as RecordingError."""
    try:
        with warnings.catch_warnings():  # of how old a file is, which is no matter here
            warnings.simplefilter("ignore")
            yield
    except zipfile.BadZipFile as error:
        raise RecordingError(f"{path}: {key} is damaged: {error}") from error
    except UNREADABLE as error:
        raise RecordingError(f"{path}: {key} is unreadable: {error}") from error


def _npz_rate(path: Path, archive: zipfile.ZipFile, notes: list[str]) -> float | None:
    if "fs" not in _keys(archive):
        return None
    header = _header(path, archive, "fs")
    if header.dtype.hasobject:
        raise RecordingError(f"{path}: fs holds Python objects, not numbers")
    single = header.values == 1 and header.dtype.kind in NUMBERS
    return _rate(_npz_array(path, archive, "fs") if single else np.empty(0), notes)


def _rate(fs: NDArray[Any], notes: list[str]) -> float | None:
    if fs.size == 1 and fs.dtype.kind in NUMBERS:
        return float(fs.item())
    notes.append("fs is not one number of Hz and was left aside.")
    return None


# --- archives without their index ----------------------------------------------------------------


def _recovered_table(path: Path, arrays: Mapping[str, NDArray[Any]], cut: str | None, notes: list[str]) -> Table:
    chosen = chosen_columns(path, list(arrays), notes)
    columns = {}
    for name, key in chosen.items():
        if arrays[key].ndim != 1:
            raise RecordingError(f"{path}: {key} has shape {arrays[key].shape}; a column has one dimension")
        columns[name] = arrays[key].astype(np.float64)
    short = next((name for name, key in chosen.items() if key == cut), None)
    if short is not None:
        column = columns[short]
        n = max(other.size for other in columns.values())
        columns[short] = np.concatenate([column, np.full(n - column.size, np.nan)])
    return Table(columns, _rate(arrays["fs"], notes) if "fs" in arrays else None, notes)


def _recovered(path: Path) -> tuple[dict[str, NDArray[Any]], str | None]:
    """The arrays of a cut .npz by the headers before each (a zip keeps its index at the end).

    Gives them in order, and the name of the one that the cut goes through, if it goes through one. Arrays that mean
    nothing in a recording are empty.
    """
    limit = memory_check.limit_of(path)
    arrays: dict[str, NDArray[Any]] = {}
    unpacked = members = 0
    with open_regular(path) as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        at = data.find(LOCAL_MAGIC)
        while 0 <= at <= len(data) - LOCAL_HEADER.size:
            members += 1
            check_width(path, members)
            _, _, flags, method, _, _, _, packed, _, name_size, extra_size = LOCAL_HEADER.unpack_from(data, at)
            start = at + LOCAL_HEADER.size + name_size
            key = data[start - name_size : start].decode("utf-8", errors="replace").removesuffix(".npy")
            extra = data[start : start + extra_size]
            if packed == 0xFFFFFFFF and extra[:2] == b"\1\0" and len(extra) >= 20:  # ZIP64, APPNOTE 4.5.3
                packed = int.from_bytes(extra[12:20], "little")
            start += extra_size
            pieces = _Unpacked(data, start, method, packed, sized=not flags & 8)
            array = _array_up_to_cut(pieces, limit, unpacked, wanted=key in WANTED)
            unpacked += pieces.unpacked
            if array is not None:
                arrays[key] = array
            if pieces.end is None:
                return arrays, key if array is not None else None
            at = data.find(LOCAL_MAGIC, pieces.end)
    return arrays, None


class _Unpacked:
    """The content of a member that starts at ``start``, in pieces.

    ``end`` is where the member ends, known after all pieces were taken; None if the file is cut before its end.
    """

    def __init__(self, data: mmap, start: int, method: int, size: int, *, sized: bool) -> None:
        self._data, self._at, self._method = data, start, method
        self._size = size if sized else None
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


def _array_up_to_cut(
    pieces: _Unpacked, limit: memory_check.ReadLimit, unpacked: int, *, wanted: bool
) -> NDArray[Any] | None:
    """The numbers of a .npy member, fewer than the header says where the bytes end early; None where it is no array.

    Raises
    ------
    RecordingError, ConfigError
        The array exceeds a limit; ``unpacked`` is what the members before it have unpacked to, in bytes.
    """
    raw = bytearray()
    header: re.Match[bytes] | None = None
    most = MAX_HEADER_BYTES  # bytes of use
    for part in pieces:
        limit.check_unpacked(unpacked + pieces.unpacked)
        if len(raw) >= most:
            continue  # up to the end, to find the next member
        raw += part
        if header is None and (header := NPY.match(raw)) is not None:
            header = NPY.match(bytes(raw[: header.end()]))
            assert header is not None
            dtype, n = np.dtype(header["kind"].decode()), int(header["n"] or 1)
            most = header.end() + (n * dtype.itemsize if wanted else 0)
        if header is not None and wanted:
            limit.check_rows(min(n, (len(raw) - header.end()) // dtype.itemsize))
    if header is None:
        return None
    whole = (len(raw) - header.end()) // dtype.itemsize if wanted else 0
    array = np.frombuffer(raw, dtype, min(n, whole), header.end())
    return array if header["n"] or not array.size else array.reshape(())


@contextmanager
def npz_writer(path: Path, names: Sequence[str]) -> Iterator[Append]:
    """Write compressed. An archive holds one array after the other, so columns gather in files without a name.

    Those need the room of the numbers unpacked (8 bytes each) in the folder of ``path`` while it is written.
    """
    with ExitStack() as stack:
        gathered = {name: stack.enter_context(TemporaryFile(dir=path.parent)) for name in names}

        def append(columns: Columns) -> None:
            for name, file in gathered.items():
                file.write(np.ascontiguousarray(columns[name]).data)

        yield append
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, file in gathered.items():
                _put_array(archive, name, file)


def _put_array(archive: zipfile.ZipFile, name: str, numbers: IO[bytes]) -> None:
    """A member as ``numpy.savez_compressed`` makes it, without the array in memory."""
    shape = (numbers.tell() // ITEM.itemsize,)
    numbers.seek(0)
    member = zipfile.ZipInfo(f"{name}.npy")  # dated 1980: equal columns give equal bytes
    member.compress_type = zipfile.ZIP_DEFLATED
    with archive.open(member, "w", force_zip64=True) as file:
        header = {"descr": ITEM.str, "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(cast(Any, file), header)
        shutil.copyfileobj(numbers, file, COPY_BYTES)
