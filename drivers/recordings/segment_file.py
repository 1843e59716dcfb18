"""Segment files, in which the daemon records samples or raw data. A segment is a growing Arrow IPC stream.

A file name such as ``00000042_2026-11-22T03-00-00Z.arrows`` consists of the segment number and the time of the first
sample. Each batch of samples includes the state of the daemon (``DaemonState``), so that the daemon can continue after
a restart.

The daemon appends small uncompressed batches, so that an unfinished segment can be read. The daemon atomically replaces
each finished segment with a compressed copy.
"""

import errno
import mmap
import os
import re
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import IO, Any, Final, Literal

import msgspec
import numpy as np

from drivers.data_types import AXES, Chunk, SampleBlock, concatenate_blocks, make_block, seconds_to_ns
from drivers.errors import ImuError, RecordingError
from drivers.host.safe_file_reading import open_regular_file
from drivers.recordings.file_formats.arrow_message_sizes import iter_batch_sizes
from drivers.recordings.file_formats.parquet_and_arrow_format import (
    METADATA_KEY,
    SEGMENT_COLUMNS,
    first_message_line,
    import_pyarrow,
)
from drivers.recordings.memory_check import ROW_BYTES
from drivers.recordings.table import BATCH_ROWS, PARTIAL_SUFFIX, T_LIMIT_S
from drivers.validation.number_ranges import COEFFICIENT, COUNTER_STEP, RATE_HZ

SUFFIX: Final = ".arrows"
NAME: Final = re.compile(r"(\d{8})_[0-9TZ-]+\.arrows")
SCHEMA: Final = "imu-monitor/recording/1"
RAW_BATCH_BYTES: Final = 4_000_000
T_LIMIT_NS: Final = round(T_LIMIT_S * 1e9)
MAX_BATCH_BYTES: Final = 64_000_000
"""Maximum unpacked size of a batch in bytes. The batches that the daemon writes are much smaller."""
MAX_LOST_SAMPLES: Final = 10**11
"""Maximum number of consecutive missing samples in a valid segment."""

Kind = Literal["samples", "raw"]


class SegmentMetadata(msgspec.Struct, frozen=True):
    """Metadata that describe the device and the type of data in a segment."""

    device: str
    kind: Kind
    axes: str = ""  # mounting of the sensor; a new mounting starts a new recording
    carrier: str = ""  # type of chunk that the link delivers, for raw data
    decoder: str = ""
    packed: bool = False  # True if the segment has been compressed
    schema: str = SCHEMA


class DaemonState(msgspec.Struct, frozen=True):
    """State of the daemon at the end of a batch, used to continue after a restart."""

    rate: float | None = None  # sample rate in Hz
    since: tuple[float | None, ...] = (None,) * 6
    """Unix time in s of the oldest sample in use for each axis.

    The time is set when a noise change restarts the axis or the window is cleared. Otherwise, it is None.
    """
    tick_step: float | None = None  # ticks of the device counter per sample
    theta: tuple[float | None, ...] = ()
    """Noise coefficients [5, 6] of the newest fit, in row-major order."""
    entered: tuple[bool, ...] = ()
    """Flags [5, 6] in row-major order, True for each noise term that the newest fit includes."""


@dataclass(frozen=True, slots=True)
class GapFreeSegmentPart:
    """Consecutive samples of a segment without missing samples in between."""

    samples: SampleBlock  # t_ns are Unix times
    state: DaemonState
    state_error: str = ""
    """Description of the damage if the recorded state is damaged, in which case ``state`` is empty."""


class SegmentFileWriter:
    """Writer that appends batches to one segment file.

    Parameters
    ----------
    path
        Segment file to create. The file appears when the first batch is written.
    origin
        Metadata of the segment.

    Raises
    ------
    OSError
        If writing to the disk fails. Complete batches remain readable.
    """

    def __init__(self, path: Path, origin: SegmentMetadata) -> None:
        self.path = path
        self._pa = import_pyarrow(path)
        self._schema = _schema(self._pa, origin)
        self._state = DaemonState()
        self._temporary_path = path.with_name(path.name + PARTIAL_SUFFIX)
        self._temporary_path.unlink(missing_ok=True)  # remove the file of a program that was killed
        self._file: IO[bytes] = self._temporary_path.open("xb", buffering=0)
        self._writer = self._pa.ipc.new_stream(self._file, self._schema)
        self._valid_bytes = 0  # total size of all complete batches

    def write_samples(self, blocks: Sequence[SampleBlock], state: DaemonState) -> None:
        """Write one batch of samples.

        Parameters
        ----------
        blocks
            Sample blocks whose ``t_ns`` are Unix times.
        state
            State of the daemon after the last sample.
        """
        self._write_batch(_sample_batch(self._pa, self._schema, blocks), {b"state": msgspec.json.encode(state)})

    def write_chunks(self, chunks: Sequence[Chunk]) -> None:
        """Write one batch of raw chunks whose ``t_ns`` are Unix times."""
        self._write_batch(_chunk_batch(self._pa, self._schema, chunks), None)

    def flush_to_disk(self) -> None:
        """Flush written batches to the disk, so that they survive a power failure."""
        os.fdatasync(self._file.fileno())

    def describe_external_change(self) -> str:
        """Describe how another program has changed the open file. The text is empty if the file is unchanged."""
        try:
            named = os.stat(self.path if self._valid_bytes else self._temporary_path, follow_symlinks=False)
        except OSError:
            return "was deleted or renamed"
        own = os.fstat(self._file.fileno())
        if not os.path.samestat(named, own):
            return "was replaced by another file"
        return "was cut or written by another program" if self._valid_bytes and own.st_size != self._valid_bytes else ""

    def close_changed_file(self) -> None:
        """Close a segment file that another program has changed.

        The end mark is written only if the file length is unchanged.
        """
        try:
            if os.fstat(self._file.fileno()).st_size == self._valid_bytes:
                self._writer.close()
        finally:
            self._file.close()

    def close(self) -> None:
        """Write the end mark of the Arrow stream, and close the segment file."""
        try:
            self._writer.close()
        finally:
            self._file.close()
            if not self._valid_bytes:
                self._temporary_path.unlink(missing_ok=True)

    def _write_batch(self, batch: Any, meta: dict[bytes, bytes] | None) -> None:
        """Write one batch. If writing fails, truncate the file after the last complete batch."""
        try:
            self._writer.write_batch(batch, custom_metadata=meta)
        except OSError:
            # An incomplete batch would make all later batches unreadable.
            self._file.truncate(self._valid_bytes)
            self._file.seek(self._valid_bytes)
            raise
        if not self._valid_bytes:
            if os.path.lexists(self.path):
                raise FileExistsError(errno.EEXIST, f"{self.path.name} exists already", str(self.path))
            os.rename(self._temporary_path, self.path)
            _sync_folder(self.path.parent)
        self._valid_bytes = self._file.tell()


def format_segment_name(number: int, unix_s: float) -> str:
    """Return the file name of a segment.

    Parameters
    ----------
    number
        Number of the segment in its folder.
    unix_s
        Unix time of the first sample in s.

    >>> format_segment_name(42, 1_700_000_000.0)
    '00000042_2023-11-14T22-13-20Z.arrows'
    """
    try:
        when = f"{datetime.fromtimestamp(unix_s, UTC):%Y-%m-%dT%H-%M-%SZ}"
    except (ValueError, OverflowError, OSError):  # a sender may send a time that is not a valid date
        when = "0000-00-00T00-00-00Z"
    return f"{number:08d}_{when}{SUFFIX}"


def parse_segment_start_s(path: Path) -> float:
    """Return the Unix time in s in the file name of a segment, or 0 if the name contains no time.

    >>> parse_segment_start_s(Path("00000042_2023-11-14T22-13-20Z.arrows"))
    1700000000.0
    """
    try:
        return datetime.strptime(path.stem.partition("_")[2], "%Y-%m-%dT%H-%M-%S%z").timestamp()
    except ValueError:
        return 0.0


def list_segments(folder: Path) -> list[Path]:
    """Return the paths of all segments in a folder, oldest first. Return an empty list if the folder does not exist."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if NAME.fullmatch(path.name))


def parse_segment_number(path: Path) -> int:
    """Return the segment number in a file name, or 0 if the file is not a segment."""
    found = NAME.fullmatch(path.name)
    return int(found[1]) if found else 0


def read_metadata(path: Path) -> SegmentMetadata:
    """Return the metadata of a segment. Raise RecordingError if the file is not a segment."""
    pa = import_pyarrow(path)
    with _arrow_errors(path), open_regular_file(path) as file:
        return _check_schema(path, pa.ipc.open_stream(file).schema)


def read_last_piece(path: Path) -> GapFreeSegmentPart | None:
    """Return the last samples of a finished segment, or None if the segment is empty.

    Raise RecordingError if the file is not a segment, or if the last batch contains implausible values. The file is
    memory-mapped, so that only the last batch is read from the disk.
    """
    last = deque(_read_batches(path, "samples", mapped=True), maxlen=1)
    pieces = [piece for batch in last for piece in _split_batch(*batch)]
    if last and not pieces:
        raise RecordingError(f"{path}: the newest rows contain impossible times, counts or values")
    return pieces[-1] if pieces else None


def read_samples(path: Path) -> Iterator[GapFreeSegmentPart]:
    """Yield the samples in all complete batches of a segment.

    Raise RecordingError if the file is not a segment of samples.
    """
    for batch, meta in _read_batches(path, "samples"):
        yield from _split_batch(batch, meta)


def _split_batch(batch: Any, meta: Any) -> Iterator[GapFreeSegmentPart]:
    """Split the samples of a batch where samples are missing. Skip a batch with implausible values."""
    columns = {name: batch.column(name).to_numpy(zero_copy_only=False) for name in batch.schema.names}
    columns = _with_times_in_ns(columns)
    values = np.column_stack([columns[axis] for axis in AXES])
    if not _is_plausible(columns) or np.isinf(values).any():
        return
    state, state_error = _decode_state(meta)
    rows = make_block(columns["t_ns"].copy(), values, columns["temperature"].copy(), columns["ticks"].copy())
    lost = columns["lost"]
    edges = [0, *(np.flatnonzero(lost[1:]) + 1).tolist(), len(rows)]
    for a, b in pairwise(edges):
        part = rows[a:b]
        yield GapFreeSegmentPart(
            make_block(part.t_ns, part.values, part.temperature_c, part.ticks, int(lost[a])), state, state_error
        )


def _is_plausible(columns: Mapping[str, Any]) -> bool:
    """Return True if all times and all numbers of missing samples are in the supported ranges."""
    # A null value would convert a column of integers to floats.
    t_ns, lost, ticks = columns["t_ns"], columns["lost"], columns["ticks"]
    if not t_ns.dtype == lost.dtype == ticks.dtype == np.int64:
        return False
    in_range = (t_ns > -T_LIMIT_NS) & (t_ns < T_LIMIT_NS) & (lost >= 0) & (lost <= MAX_LOST_SAMPLES)
    return bool(in_range.all())


def _with_times_in_ns(columns: dict[str, Any]) -> dict[str, Any]:
    """Return the columns of a batch with times in ns. Earlier revisions wrote the column ``t`` in s."""
    if "t" not in columns:
        return columns
    t_s = columns["t"]
    t_ns = seconds_to_ns(np.where(np.abs(t_s) < T_LIMIT_S, t_s, T_LIMIT_S))
    return {"t_ns": t_ns, **{name: column for name, column in columns.items() if name != "t"}}


def _decode_state(meta: Any) -> tuple[DaemonState, str]:
    """Decode the state of the daemon from the metadata of a batch.

    Return an empty state and a description of the damage if the metadata are invalid.
    """
    try:
        found = msgspec.json.decode(meta.get(b"state", b"{}"), type=DaemonState) if meta else DaemonState()
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        return DaemonState(), f"the recorded state cannot be decoded ({first_message_line(error)})"
    terms = len(found.theta) == len(found.entered) and len(found.theta) in (0, 5 * len(AXES))
    valid = {
        "rate": found.rate is None or RATE_HZ.supports(found.rate),
        "since": len(found.since) == len(AXES) and all(one is None or abs(one) < T_LIMIT_S for one in found.since),
        "tick_step": found.tick_step is None or COUNTER_STEP.supports(found.tick_step),
        "theta": terms and all(one is None or 0.0 <= one <= COEFFICIENT.high for one in found.theta),
    }
    wrong = ", ".join(name for name, is_valid in valid.items() if not is_valid)
    return (DaemonState(), f"the recorded state is damaged ({wrong})") if wrong else (found, "")


def read_chunks(path: Path) -> Iterator[Chunk]:
    """Yield the chunks in all complete batches of a raw-data segment, with Unix times.

    Raise RecordingError if the file is not a raw-data segment.
    """
    for batch, _ in _read_batches(path, "raw"):
        for start in range(0, batch.num_rows, BATCH_ROWS):
            part = batch.slice(start, BATCH_ROWS)
            columns = (part.column(name).to_pylist() for name in ("t_ns", "address", "data", "attachment"))
            for t_ns, address, data, attachment in zip(*columns, strict=True):
                if None not in (t_ns, address, data, attachment) and abs(t_ns) < T_LIMIT_S * 1e9:
                    yield Chunk(data, t_ns, address, attachment)


def compress_segment_stepwise(path: Path) -> Iterator[None]:
    """Replace a finished segment with a compressed copy.

    The generator yields after each batch, so that the caller can do other work during the compression.

    Raises
    ------
    RecordingError
        If the file is not a segment.
    OSError
        If the disk is full. The original segment remains unchanged.
    """
    pa = import_pyarrow(path)
    own = read_metadata(path)
    if own.packed:
        return
    schema = _schema(pa, msgspec.structs.replace(own, packed=True))
    part = path.with_name(path.name + PARTIAL_SUFFIX)
    options = pa.ipc.IpcWriteOptions(compression="zstd")
    try:
        part.unlink(missing_ok=True)
        with part.open("xb") as file, pa.ipc.new_stream(file, schema, options=options) as writer:
            for batch, meta in _merged_batches(pa, schema, path, own.kind):
                writer.write_batch(batch, custom_metadata=meta)
                yield
        with open_regular_file(part) as written:
            os.fsync(written.fileno())
        os.replace(part, path)
        _sync_folder(path.parent)
    finally:
        part.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Flush a folder to the disk, so that new files survive a power failure."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _merged_batches(pa: Any, schema: Any, path: Path, kind: Kind) -> Iterator[tuple[Any, dict[bytes, bytes] | None]]:
    """Combine small batches into large batches. Each large batch contains the daemon state after its last row."""
    waiting: list[Any] = []
    rows = size = 0
    meta: dict[bytes, bytes] | None = None
    for batch, found in _read_batches(path, kind):
        waiting.append(batch)
        rows, size = rows + batch.num_rows, size + batch.nbytes
        meta = {b"state": found[b"state"]} if found and b"state" in found else meta
        if rows >= BATCH_ROWS or size >= RAW_BATCH_BYTES:
            yield _combine_batches(pa, schema, waiting), meta
            waiting, rows, size = [], 0, 0
    if waiting:
        yield _combine_batches(pa, schema, waiting), meta


def _combine_batches(pa: Any, schema: Any, batches: list[Any]) -> Any:
    table = pa.Table.from_batches(batches).combine_chunks()
    columns = {name: column.chunk(0) for name, column in zip(table.column_names, table.columns, strict=True)}
    if "t" in columns:
        columns = _with_times_in_ns({**columns, "t": columns["t"].to_numpy(zero_copy_only=False)})
    return pa.RecordBatch.from_arrays([pa.array(columns[name]) for name in schema.names], schema=schema)


def _read_batches(path: Path, kind: Kind, mapped: bool = False) -> Iterator[tuple[Any, Any]]:
    """Yield the complete batches of a segment and their metadata. Stop before a batch with an implausible size.

    If ``mapped`` is True, the file is memory-mapped, so that unused rows are not read from the disk.
    """
    pa = import_pyarrow(path)
    # The file is opened only once, because the daemon may replace it with a compressed file at any time.
    with _arrow_errors(path), open_regular_file(path) as file:
        count = _count_regular_batches(file)
        file.seek(0)
        reader = pa.ipc.open_stream(_memory_map(pa, file) if mapped else file)
        found = _check_schema(path, reader.schema)
        if found.kind != kind:
            raise RecordingError(f"{path}: is a segment of {found.kind}, expected a segment of {kind}")
        for _ in range(count):
            try:
                batch, meta = reader.read_next_batch_with_custom_metadata()
                batch.validate(full=not mapped)
            except (StopIteration, pa.ArrowException, OSError):
                return  # the end of the stream, or a truncated batch
            if batch.num_rows:
                yield batch, meta


def _count_regular_batches(file: IO[bytes]) -> int:
    """Count the batches before the first batch with an implausible size."""
    count = 0
    for size in iter_batch_sizes(file):
        large = max(size.rows * ROW_BYTES, sum(size.buffers), size.body_bytes) > MAX_BATCH_BYTES
        if large or size.dictionary:  # the daemon never writes dictionaries
            break
        count += 1
    return count


def _memory_map(pa: Any, file: IO[bytes]) -> Any:
    """Map a file into memory. An empty file is returned unchanged, because it cannot be mapped."""
    if not os.fstat(file.fileno()).st_size:
        return file
    return pa.BufferReader(pa.py_buffer(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)))


@contextmanager
def _arrow_errors(path: Path) -> Iterator[None]:
    """Convert errors of pyarrow and msgspec to RecordingError."""
    try:
        yield
    except ImuError:
        raise
    except OSError as error:
        if error.errno in (errno.EINVAL, errno.EISDIR):  # not a regular file
            raise RecordingError(f"{path}: {error.strerror}") from error
        if error.errno is not None:
            raise
        raise RecordingError(f"{path}: is no segment of a recording ({first_message_line(error)})") from error
    except (import_pyarrow(path).ArrowException, UnicodeDecodeError, RecursionError, msgspec.DecodeError) as error:
        raise RecordingError(f"{path}: is no segment of a recording ({first_message_line(error)})") from error
    except MemoryError as error:  # the first bytes of another file type may look like a huge length
        raise RecordingError(
            f"{path}: is no segment of a recording (it claims more bytes than the memory holds)"
        ) from error


def _check_schema(path: Path, schema: Any) -> SegmentMetadata:
    """Return the metadata in an Arrow schema. Raise RecordingError if the schema does not belong to a segment."""
    meta = (schema.metadata or {}).get(METADATA_KEY)
    if meta is None:
        raise RecordingError(f"{path}: is no segment of a recording: it does not state its device")
    found = msgspec.json.decode(meta, type=SegmentMetadata)
    if found.schema != SCHEMA:
        raise RecordingError(f'{path}: schema "{found.schema[:64]}" is not {SCHEMA}')
    pa = import_pyarrow(path)
    if not any(schema.equals(_schema(pa, found, times), check_metadata=False) for times in ("t_ns", "t")):
        raise RecordingError(f"{path}: is no segment of a recording: its columns differ")
    return found


def _schema(pa: Any, of: SegmentMetadata, times: str = "t_ns") -> Any:
    """Return the Arrow schema of a segment. ``times`` is "t" for the times in s of earlier revisions."""
    if of.kind == "samples":
        fields = [(times, pa.int64() if times == "t_ns" else pa.float64())]
        fields += [(name, pa.float64()) for name in (*AXES, "temperature")]
        fields += [(name, pa.int64()) for name in SEGMENT_COLUMNS]
    else:
        fields = [("t_ns", pa.int64()), ("address", pa.uint32()), ("data", pa.binary()), ("attachment", pa.binary())]
    return pa.schema(fields, metadata={METADATA_KEY: msgspec.json.encode(of)})


def _sample_batch(pa: Any, schema: Any, blocks: Sequence[SampleBlock]) -> Any:
    rows = concatenate_blocks(blocks)
    lost = np.zeros(len(rows), np.int64)
    at = 0
    for one in blocks:
        lost[at] = one.lost
        at += len(one)
    columns = [rows.t_ns, *rows.values.T, rows.temperature_c, rows.ticks, lost]
    return pa.record_batch([pa.array(np.ascontiguousarray(column)) for column in columns], schema=schema)


def _chunk_batch(pa: Any, schema: Any, chunks: Sequence[Chunk]) -> Any:
    columns = (
        [one.t_ns for one in chunks], [one.address for one in chunks],
        [one.data for one in chunks], [one.attachment for one in chunks],
    )  # fmt: skip
    arrays = [pa.array(column, field.type) for column, field in zip(columns, schema, strict=True)]
    return pa.record_batch(arrays, schema=schema)
