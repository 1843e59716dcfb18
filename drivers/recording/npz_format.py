""".npz: one array a column, ``fs`` (Hz) may stand for ``t``.

Arrays of Python objects are refused, never unpickled. A zip archive keeps its index at the end, so
from a cut file the arrays are found again by the header that stands before each.
"""

import re
import shutil
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from tokenize import TokenError
from typing import IO, Any, Final, cast

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from drivers.errors import RecordingError
from drivers.recording.table import Append, Columns, Table, chosen_columns
from drivers.sample import Floats
from drivers.small_file import open_regular

LOCAL_HEADER: Final = struct.Struct("<4s5H3I2H")  # PKWARE APPNOTE 4.3.7
LOCAL_MAGIC: Final = b"PK\3\4"
ITEM: Final = np.dtype("<f8")
UNREADABLE: Final = (
    ValueError, TypeError, SyntaxError, EOFError, MemoryError, OverflowError, RuntimeError, TokenError, zlib.error
)  # fmt: skip
"""What NumPy and zlib raise for an array of rubbish."""
COPY_BYTES: Final = 1 << 18
NPY: Final = re.compile(
    rb"\x93NUMPY\x01\x00..{'descr': '(?P<kind>[<>|](?:f[248]|[iu][1248]))', 'fortran_order': (?:False|True), "
    rb"'shape': \((?:(?P<n>\d{1,18}),)?\), } *\n",
    re.DOTALL,
)
"""The head of an array of numbers with one dimension or none, as every NumPy writes it: nothing in it is evaluated."""


def read_npz(path: Path) -> Table:
    """Only the arrays that mean something are read, the whole ones and up to a cut."""
    notes: list[str] = []
    with open_regular(path) as file:
        if file.read(len(LOCAL_MAGIC)) != LOCAL_MAGIC:
            raise RecordingError(f"{path}: is no .npz file (a zip archive with one array a column)")
        file.seek(0)
        if zipfile.is_zipfile(file):
            file.seek(0)
            with _opened(path, file) as archive:
                return _npz_table(path, archive, None, notes)
        file.seek(0)
        arrays, cut = _recovered(file.read())
    if not arrays:
        raise RecordingError(f"{path}: is damaged or cut off before its first number")
    at = f" inside {cut}" if cut else ""
    notes.append(f"The file is cut off{at} and was read up to the cut; later columns are missing.")
    return _npz_table(path, arrays, cut, notes)


def _opened(path: Path, file: IO[bytes]) -> NpzFile:
    try:
        return cast(NpzFile, np.load(cast(Any, file), allow_pickle=False))
    except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
        raise RecordingError(f"{path}: its index of arrays is damaged: {error}") from error


def _npz_table(path: Path, archive: Mapping[str, Any], cut: str | None, notes: list[str]) -> Table:
    chosen = chosen_columns(path, list(archive), notes)
    columns = {name: _npz_column(path, archive, key) for name, key in chosen.items()}
    short = next((name for name, key in chosen.items() if key == cut), None)
    if short is not None:
        column = columns[short]
        n = max(other.size for other in columns.values())
        columns[short] = np.concatenate([column, np.full(n - column.size, np.nan)])
    return Table(columns, _npz_rate(path, archive, notes), notes)


def _npz_column(path: Path, archive: Mapping[str, Any], key: str) -> Floats:
    """One column as float64; an array of objects is refused, since reading it would run code."""
    array = _npz_array(path, archive, key)
    if array.dtype.kind not in "fiu":
        raise RecordingError(f"{path}: {key} holds {array.dtype}, not numbers")
    if array.ndim != 1:
        raise RecordingError(f"{path}: {key} has shape {array.shape}; a column has one dimension")
    return array.astype(np.float64)


def _npz_array(path: Path, archive: Mapping[str, Any], key: str) -> NDArray[Any]:
    try:
        with warnings.catch_warnings():  # of how old a file is, which is no matter here
            warnings.simplefilter("ignore")
            return np.asarray(archive[key])
    except zipfile.BadZipFile as error:
        raise RecordingError(f"{path}: {key} is damaged: {error}") from error
    except UNREADABLE as error:
        why = "holds Python objects, not numbers" if "bject array" in str(error) else f"is unreadable: {error}"
        raise RecordingError(f"{path}: {key} {why}") from error


def _npz_rate(path: Path, archive: Mapping[str, Any], notes: list[str]) -> float | None:
    if "fs" not in archive:
        return None
    fs = _npz_array(path, archive, "fs")
    if fs.size == 1 and fs.dtype.kind in "fiu" and np.isfinite(fs).all() and fs.item() > 0:
        return float(fs.item())
    notes.append("fs is not one positive number of Hz and was left aside.")
    return None


def _recovered(data: bytes) -> tuple[dict[str, NDArray[Any]], str | None]:
    """The arrays of a cut .npz by the headers before each (a zip keeps its index at the end).

    Gives them in order, and the name of the one that the cut goes through, if it goes through one.
    """
    arrays: dict[str, NDArray[Any]] = {}
    at = data.find(LOCAL_MAGIC)
    while 0 <= at <= len(data) - LOCAL_HEADER.size:
        _, _, flags, method, _, _, _, packed, _, name_size, extra_size = LOCAL_HEADER.unpack_from(data, at)
        start = at + LOCAL_HEADER.size + name_size
        key = data[start - name_size : start].decode("utf-8", errors="replace").removesuffix(".npy")
        extra = data[start : start + extra_size]
        if packed == 0xFFFFFFFF and extra[:2] == b"\1\0" and len(extra) >= 20:  # ZIP64, APPNOTE 4.5.3
            packed = int.from_bytes(extra[12:20], "little")
        raw, end = _unpacked(data[start + extra_size :], method, packed, sized=not flags & 8)
        array = _array_up_to_cut(raw)
        if array is not None:
            arrays[key] = array
        if end is None:
            return arrays, key if array is not None else None
        at = data.find(LOCAL_MAGIC, start + extra_size + end)
    return arrays, None


def _unpacked(data: bytes, method: int, size: int, *, sized: bool) -> tuple[bytes, int | None]:
    """A member's content and where it ends in ``data``; None where the cut comes before its end."""
    if method == zipfile.ZIP_STORED and sized:
        return data[:size], size if size <= len(data) else None
    if method != zipfile.ZIP_DEFLATED:
        return b"", None
    unzip = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        raw = unzip.decompress(data)
    except zlib.error:
        return b"", None
    return raw, len(data) - len(unzip.unused_data) if unzip.eof else None


def _array_up_to_cut(raw: bytes) -> NDArray[Any] | None:
    """The numbers of .npy bytes, fewer than the header says where the bytes end early."""
    header = NPY.match(raw)
    if header is None:
        return None
    dtype, n = np.dtype(header["kind"].decode()), int(header["n"] or 1)
    whole = (len(raw) - header.end()) // dtype.itemsize
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
