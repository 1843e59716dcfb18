"""The daemon's own files: streams of Arrow IPC, appended to while samples come, read up to the last whole batch.

A folder of a device holds segments ``00000042_2026-11-22T03-00-00Z.arrows``. The number orders them, whatever the
host's clock did; the time is that of the first row, for people. Rows are ``t`` (Unix s), six axes, ``temperature`` and,
for whoever goes on from there, ``ticks`` and ``lost`` (missing just before the row); every batch carries what the
daemon knew with it (``State``). A segment of raw bytes holds chunks as they came: ``t_ns`` (Unix), ``address``,
``data``, ``attachment``.

A segment that grows is not compressed, so that a batch stands alone. One that has ended is written again in large
compressed batches, and takes the other's place whole or not at all.
"""

import errno
import mmap
import os
import re
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import IO, Any, Final, Literal

import msgspec
import numpy as np

from drivers.errors import ImuError, RecordingError
from drivers.quantities import COUNTER_STEP, RATE_HZ
from drivers.recording.arrow_format import BOOKKEEPING, OWN, library
from drivers.recording.arrow_messages import batch_sizes
from drivers.recording.room import ROW_BYTES
from drivers.recording.table import BATCH_ROWS, PART, T_LIMIT_S
from drivers.sample import AXES, Chunk, SampleBlock, block, join, ns_to_seconds, seconds_to_ns
from drivers.small_file import open_regular

SUFFIX: Final = ".arrows"
NAME: Final = re.compile(r"(\d{8})_[0-9TZ-]+\.arrows")
SCHEMA: Final = "imu-monitor/recording/1"
RAW_BATCH_BYTES: Final = 4_000_000
MAX_BATCH_BYTES: Final = 64_000_000
"""Of a batch unpacked, far above what ``SegmentWriter`` and ``pack`` write."""
LARGEST_LOSS: Final = 10**11
"""Samples missing at one place; above what any clock tells."""

Kind = Literal["samples", "raw"]


class Origin(msgspec.Struct, frozen=True):
    """What a segment is of."""

    device: str
    kind: Kind
    axes: str = ""  # how the sensor is mounted; samples of another mounting do not go on from these
    carrier: str = ""  # of raw bytes: what their decoder reads
    decoder: str = ""
    packed: bool = False  # written again, compressed
    schema: str = SCHEMA


class State(msgspec.Struct, frozen=True):
    """What the daemon knew with a batch, for the one that goes on from it."""

    rate: float | None = None  # Hz
    since: tuple[float | None, ...] = (None,) * 6
    """Unix s from which on the samples of an axis count, where its noise has changed or the window was emptied."""
    tick_step: float | None = None  # of the device's counter, a sample
    theta: tuple[float | None, ...] = ()
    entered: tuple[bool, ...] = ()
    """Sizes of the terms of the newest fit, and which it has, [5, 6] row by row."""


@dataclass(frozen=True, slots=True)
class Piece:
    """One batch of a segment of samples."""

    samples: SampleBlock  # t_ns are Unix times
    state: State


class SegmentWriter:
    """Appends to one segment.

    Args:
        path: the new file; it appears with its first batch
        origin: what it is of
    Raises:
        OSError: whatever the disk says, from every method; what was whole before stays readable
    """

    def __init__(self, path: Path, origin: Origin) -> None:
        self.path = path
        self._pa = library(path)
        self._schema = _schema(self._pa, origin)
        self._state = State()
        self._part = path.with_name(path.name + PART)
        self._part.unlink(missing_ok=True)  # of a program that was killed
        self._file: IO[bytes] = self._part.open("xb", buffering=0)
        self._writer = self._pa.ipc.new_stream(self._file, self._schema)
        self._whole = 0  # bytes that hold whole batches

    def samples(self, blocks: Sequence[SampleBlock], state: State) -> None:
        """One batch of blocks whose ``t_ns`` are Unix times."""
        self._write(_sample_batch(self._pa, self._schema, blocks), {b"state": msgspec.json.encode(state)})

    def chunks(self, chunks: Sequence[Chunk]) -> None:
        """One batch of chunks whose ``t_ns`` are Unix times."""
        self._write(_chunk_batch(self._pa, self._schema, chunks), None)

    def sync(self) -> None:
        """Have the disk keep what was written, through a power cut too."""
        os.fdatasync(self._file.fileno())

    def change(self) -> str:
        """Say what another program has done to the file that is written; "" if nothing."""
        try:
            named = os.stat(self.path if self._whole else self._part, follow_symlinks=False)
        except OSError:
            return "was deleted or renamed"
        own = os.fstat(self._file.fileno())
        if not os.path.samestat(named, own):
            return "was replaced by another file"
        return "was cut or written by another program" if self._whole and own.st_size != self._whole else ""

    def abandon(self) -> None:
        """Close a file that another program has changed: one that is whole is ended, another stays as it is."""
        try:
            if os.fstat(self._file.fileno()).st_size == self._whole:
                self._writer.close()
        finally:
            self._file.close()

    def close(self) -> None:
        """End the stream; what was written stays where even that fails."""
        try:
            self._writer.close()
        finally:
            self._file.close()
            if not self._whole:
                self._part.unlink(missing_ok=True)

    def _write(self, batch: Any, meta: dict[bytes, bytes] | None) -> None:
        try:
            self._writer.write_batch(batch, custom_metadata=meta)
        except OSError:
            # half a batch would hide all that follow it
            self._file.truncate(self._whole)
            self._file.seek(self._whole)
            raise
        if not self._whole:
            if os.path.lexists(self.path):
                raise FileExistsError(errno.EEXIST, f"{self.path.name} is there already", str(self.path))
            os.rename(self._part, self.path)
            _keep_names(self.path.parent)
        self._whole = self._file.tell()


def segment_name(number: int, unix_s: float) -> str:
    """The file of a segment.

    >>> segment_name(42, 1_700_000_000.0)
    '00000042_2023-11-14T22-13-20Z.arrows'
    """
    try:
        when = f"{datetime.fromtimestamp(unix_s, UTC):%Y-%m-%dT%H-%M-%SZ}"
    except (ValueError, OverflowError, OSError):  # a sender's own times may be no date at all
        when = "0000-00-00T00-00-00Z"
    return f"{number:08d}_{when}{SUFFIX}"


def began_s(path: Path) -> float:
    """Unix time in the name of a segment, whole seconds; 0 where there is none.

    >>> began_s(Path("00000042_2023-11-14T22-13-20Z.arrows"))
    1700000000.0
    """
    try:
        return datetime.strptime(path.stem.partition("_")[2], "%Y-%m-%dT%H-%M-%S%z").timestamp()
    except ValueError:
        return 0.0


def segments(folder: Path) -> list[Path]:
    """The segments of a folder, oldest first; none where there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if NAME.fullmatch(path.name))


def number_of(path: Path) -> int:
    """Where a segment stands among those of its folder."""
    found = NAME.fullmatch(path.name)
    return int(found[1]) if found else 0


def origin(path: Path) -> Origin:
    """What a segment is of. RecordingError when it is none."""
    pa = library(path)
    with _reading(path), open_regular(path) as file:
        return _origin(path, pa.ipc.open_stream(file).schema)


def newest(path: Path) -> Piece | None:
    """The last batch of a segment nobody writes to any more, quickly; None where it has none.

    Raises:
        RecordingError: it is no segment
    """
    last = deque(_batches(path, "samples", mapped=True), maxlen=1)
    pieces = [piece for batch in last for piece in _pieces(*batch)]
    return pieces[-1] if pieces else None


def read_samples(path: Path) -> Iterator[Piece]:
    """The batches of a segment, up to a cut. RecordingError when it is none."""
    for batch, meta in _batches(path, "samples"):
        yield from _pieces(batch, meta)


def _pieces(batch: Any, meta: Any) -> Iterator[Piece]:
    """A batch, cut where samples are missing; none where a disk has spoilt what is in it."""
    columns = {name: batch.column(name).to_numpy(zero_copy_only=False) for name in batch.schema.names}
    values = np.column_stack([columns[axis] for axis in AXES])
    if not _possible(columns) or np.isinf(values).any():
        return
    state = _state(meta)
    rows = block(seconds_to_ns(columns["t"]), values, columns["temperature"].copy(), columns["ticks"].copy())
    lost = columns["lost"]
    edges = [0, *(np.flatnonzero(lost[1:]) + 1).tolist(), len(rows)]
    for a, b in pairwise(edges):
        part = rows[a:b]
        yield Piece(block(part.t_ns, part.values, part.temperature_c, part.ticks, int(lost[a])), state)


def _possible(columns: Mapping[str, Any]) -> bool:
    """Whether times, counts and losses are such as are written; one that is absent has made floats of whole numbers."""
    lost, ticks = columns["lost"], columns["ticks"]
    whole = lost.dtype == ticks.dtype == np.int64
    return bool(whole and (np.abs(columns["t"]) < T_LIMIT_S).all() and ((lost >= 0) & (lost <= LARGEST_LOSS)).all())


def _state(meta: Any) -> State:
    """What the daemon knew; nothing where that cannot be read."""
    try:
        found = msgspec.json.decode(meta.get(b"state", b"{}"), type=State) if meta else State()
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return State()
    sizes = len(found.theta) == len(found.entered) and len(found.theta) in (0, 5 * len(AXES))
    rate = found.rate is None or RATE_HZ.supports(found.rate)
    step = found.tick_step is None or COUNTER_STEP.supports(found.tick_step)
    return found if sizes and len(found.since) == len(AXES) and rate and step else State()


def read_chunks(path: Path) -> Iterator[Chunk]:
    """The chunks of a raw segment, up to a cut; ``t_ns`` are Unix times. RecordingError when it is none."""
    for batch, _ in _batches(path, "raw"):
        for start in range(0, batch.num_rows, BATCH_ROWS):
            part = batch.slice(start, BATCH_ROWS)
            columns = (part.column(name).to_pylist() for name in ("t_ns", "address", "data", "attachment"))
            for t_ns, address, data, attachment in zip(*columns, strict=True):
                if None not in (t_ns, address, data, attachment) and abs(t_ns) < T_LIMIT_S * 1e9:
                    yield Chunk(data, t_ns, address, attachment)


def pack(path: Path) -> Iterator[None]:
    """Write a segment that has ended again, compressed; it is replaced at the end. Yields after every piece of work.

    Raises:
        RecordingError: it is no segment
        OSError: there is no room; the segment stays as it was
    """
    pa = library(path)
    own = origin(path)
    if own.packed:
        return
    schema = _schema(pa, msgspec.structs.replace(own, packed=True))
    part = path.with_name(path.name + PART)
    options = pa.ipc.IpcWriteOptions(compression="zstd")
    try:
        part.unlink(missing_ok=True)
        with part.open("xb") as file, pa.ipc.new_stream(file, schema, options=options) as writer:
            for batch, meta in _joined(pa, schema, path, own.kind):
                writer.write_batch(batch, custom_metadata=meta)
                yield
        with open_regular(part) as written:
            os.fsync(written.fileno())
        os.replace(part, path)
        _keep_names(path.parent)
    finally:
        part.unlink(missing_ok=True)


def _keep_names(folder: Path) -> None:
    """Have the disk keep which files are there: without it a power cut takes a new file away, whatever it held."""
    place = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(place)
    finally:
        os.close(place)


def _joined(pa: Any, schema: Any, path: Path, kind: Kind) -> Iterator[tuple[Any, dict[bytes, bytes] | None]]:
    """Small batches as large ones, each with what was known with its last row."""
    waiting: list[Any] = []
    rows = size = 0
    meta: dict[bytes, bytes] | None = None
    for batch, found in _batches(path, kind):
        waiting.append(batch)
        rows, size = rows + batch.num_rows, size + batch.nbytes
        meta = {b"state": found[b"state"]} if found and b"state" in found else meta
        if rows >= BATCH_ROWS or size >= RAW_BATCH_BYTES:
            yield _one(pa, schema, waiting), meta
            waiting, rows, size = [], 0, 0
    if waiting:
        yield _one(pa, schema, waiting), meta


def _one(pa: Any, schema: Any, batches: list[Any]) -> Any:
    table = pa.Table.from_batches(batches).combine_chunks()
    return pa.RecordBatch.from_arrays([column.chunk(0) for column in table.columns], schema=schema)


def _batches(path: Path, kind: Kind, mapped: bool = False) -> Iterator[tuple[Any, Any]]:
    """Batches with their metadata, up to a cut or a batch that states an impossible size.

    ``mapped`` leaves rows that are not looked at on the disk.
    """
    pa = library(path)
    with _reading(path), open_regular(path) as file:  # once: the daemon may replace it by a packed one meanwhile
        count = _regular_batches(file)
        file.seek(0)
        reader = pa.ipc.open_stream(_mapped(pa, file) if mapped else file)
        found = _origin(path, reader.schema)
        if found.kind != kind:
            raise RecordingError(f"{path}: a segment of {found.kind}, where one of {kind} is read")
        for _ in range(count):
            try:
                batch, meta = reader.read_next_batch_with_custom_metadata()
                batch.validate(full=not mapped)
            except (StopIteration, pa.ArrowException, OSError):
                return  # the regular end, or a cut: what was whole has been given
            if batch.num_rows:
                yield batch, meta


def _regular_batches(file: IO[bytes]) -> int:
    """Number of batches before the first one whose stated size is not that of a batch of the daemon."""
    count = 0
    for size in batch_sizes(file):
        large = max(size.rows * ROW_BYTES, sum(size.buffers), size.body_bytes) > MAX_BATCH_BYTES
        if large or size.dictionary:  # the daemon writes no dictionaries
            break
        count += 1
    return count


def _mapped(pa: Any, file: IO[bytes]) -> Any:
    """The file in memory as far as it is looked at; an empty one cannot be mapped."""
    if not os.fstat(file.fileno()).st_size:
        return file
    return pa.BufferReader(pa.py_buffer(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)))


class _reading:  # noqa: N801 - reads as a word
    """Arrow's errors as ours."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> None: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _trace: object) -> None:
        unread = UnicodeDecodeError | RecursionError | msgspec.DecodeError
        if isinstance(error, OSError) and error.errno in (errno.EINVAL, errno.EISDIR):  # no regular file
            raise RecordingError(f"{self._path}: {error.strerror}") from error
        nonsense = isinstance(error, OSError) and error.errno is None and not isinstance(error, ImuError)
        if nonsense or isinstance(error, library(self._path).ArrowException | unread):
            first = str(error).strip().partition("\n")[0]
            raise RecordingError(f"{self._path}: is no segment of a recording ({first})") from error


def _origin(path: Path, schema: Any) -> Origin:
    meta = (schema.metadata or {}).get(OWN)
    if meta is None:
        raise RecordingError(f"{path}: is no segment of a recording: nothing says which device it is of")
    found = msgspec.json.decode(meta, type=Origin)
    if found.schema != SCHEMA:
        raise RecordingError(f'{path}: schema "{found.schema[:64]}" is not {SCHEMA}')
    if not schema.equals(_schema(library(path), found), check_metadata=False):
        raise RecordingError(f"{path}: is no segment of a recording: its columns are others")
    return found


def _schema(pa: Any, of: Origin) -> Any:
    if of.kind == "samples":
        fields = [(name, pa.float64()) for name in ("t", *AXES, "temperature")]
        fields += [(name, pa.int64()) for name in BOOKKEEPING]
    else:
        fields = [("t_ns", pa.int64()), ("address", pa.uint32()), ("data", pa.binary()), ("attachment", pa.binary())]
    return pa.schema(fields, metadata={OWN: msgspec.json.encode(of)})


def _sample_batch(pa: Any, schema: Any, blocks: Sequence[SampleBlock]) -> Any:
    rows = join(blocks)
    lost = np.zeros(len(rows), np.int64)
    at = 0
    for one in blocks:
        lost[at] = one.lost
        at += len(one)
    columns = [ns_to_seconds(rows.t_ns), *rows.values.T, rows.temperature_c, rows.ticks, lost]
    return pa.record_batch([pa.array(np.ascontiguousarray(column)) for column in columns], schema=schema)


def _chunk_batch(pa: Any, schema: Any, chunks: Sequence[Chunk]) -> Any:
    columns = (
        [one.t_ns for one in chunks], [one.address for one in chunks],
        [one.data for one in chunks], [one.attachment for one in chunks],
    )  # fmt: skip
    arrays = [pa.array(column, field.type) for column, field in zip(columns, schema, strict=True)]
    return pa.record_batch(arrays, schema=schema)
