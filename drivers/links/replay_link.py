"""Replay of a file in place of a device: recordings, CAN logs and captured bytes, at their own pace or another.

The link carries different data for each kind of file:

- recordings (``drivers.recordings``: CSV, .npz, Parquet, Arrow, a folder) become messages for the decoder ``samples``;
- CAN logs (.asc .blf .log .trc, CSV of python-can, CSV with ``t``, ``id_hex``, ``data_hex``) become frames;
- captured bytes (.bin .raw .txt, also with .gz) become bytes;
- raw bytes recorded by the daemon (a folder of segments, or one of them) become bytes, frames or messages, according to
  their original link.

Recordings, logs and raw bytes keep their own times (``epoch`` is unix). Captured bytes have no times. With
``bytes_per_second``, each chunk gets the time at which that rate delivers it. Otherwise it gets the time of the read.

``read`` raises ``LinkEnded`` after all data have been returned. A truncated file is replayed up to the cut, and the
message at the end mentions the cut. ``build`` reads the header of a CSV file, since the decoder must match. All other
content is read by ``open``.
"""

import binascii
import csv
import gzip
import io
import struct
import threading
import time
import zlib
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any, BinaryIO, Final, Literal, cast

from pydantic import Field

from drivers import file_access
from drivers.discovery import format_choices
from drivers.errors import ConfigError, LinkEnded, LinkLost, LinkUnavailable, RecordingError
from drivers.extras import check_extra
from drivers.links.base import Carrier, Link, LinkSettings
from drivers.quantities import BYTE_RATE, RATE_HZ, REPLAY_SPEED
from drivers.recordings import FORMATS, Recording, iter_blocks, load_samples, segment
from drivers.recordings.table import T_LIMIT_S
from drivers.sample import EXTENDED_ID, Chunk
from drivers.settings_model import FilePath, WordOr
from drivers.zenoh.sample_message import encode_samples

if TYPE_CHECKING:
    import can

DEFAULT_DECODER: Final = "samples"
CAN_LOGS: Final = (".asc", ".blf", ".log", ".trc")
CAPTURES: Final = (".bin", ".raw", ".txt")
BATCH_CHUNKS: Final = 1000
BATCH_BYTES: Final = 1_000_000
"""A read returns at most BATCH chunks and at most one chunk more than this size. Each read therefore ends, and none
holds hours of a recording.
"""
MAX_MESSAGE_ROWS: Final = 4096
STEP_S: Final = 0.02
"""Paced recordings and bytes are delivered in pieces of this duration, as from a device with a small buffer."""
CHUNK_BYTES: Final = 4096
PYTHON_CAN_HEADER: Final = "timestamp,arbitration_id"
MAX_STANDARD_ID: Final = 0x7FF
MAX_EXTENDED_ID: Final = 0x1FFF_FFFF
MAX_FRAME_BYTES: Final = 64  # of CAN FD
READ_BYTES: Final = 1 << 20
MAX_LINE_BYTES: Final = 1 << 20
MAX_BYTES_WITHOUT_FRAME: Final = 8_000_000
"""Maximum length of text in a log without a frame, such as comments. A reader needs seconds for this much text."""
MAX_OBJECT_BYTES: Final = 64_000_000
"""Maximum size of an object of a BLF log, packed or unpacked.

Vector's tools write containers of some hundred kilobytes.
"""
MAX_OBJECTS_WITHOUT_FRAME_BYTES: Final = 256_000_000
BLF_OBJECT: Final = b"LOBJ"
BLF_SIZE: Final = slice(8, 12)  # position of the object size in its header, little-endian
BLF_HEADER_BYTES: Final = 16
DAMAGE_ERRORS: Final = (
    EOFError, LookupError, OverflowError, zlib.error, gzip.BadGzipFile, struct.error, binascii.Error, csv.Error,
)  # fmt: skip
"""Exceptions, in addition to ValueError, that readers raise where a file is truncated or damaged."""

PACES: Final = {"recorded": 1.0, "max": float("inf")}
"""Values of ``speed`` that are words, with the factor that they stand for."""

Kind = Literal["recording", "log", "capture", "raw"]
Timed = tuple[float, Chunk]
"""Seconds since the start of the file, and the chunk that is due then."""
CARRIERS: Final[dict[Kind, Carrier]] = {"recording": "messages", "log": "frames", "capture": "bytes"}
"""Carrier of each kind of file. Raw bytes state their carrier themselves."""

DEFAULT_DECODERS: Final[dict[Kind, str]] = {"recording": DEFAULT_DECODER, "log": "dbc", "capture": "", "raw": ""}
"""Decoder of each kind of file if the settings name none; "" if the settings must name one."""


class Settings(LinkSettings):
    """Keys of a replay."""

    path: FilePath = Field(
        examples=["recording.csv"], description="recording, CAN log, file of captured bytes, or folder of segments"
    )
    speed: Annotated[float, WordOr(PACES, Annotated[float, REPLAY_SPEED])] = Field(
        1.0, examples=["recorded"], description="recorded, max, or a factor: 10 = ten times as fast as recorded"
    )
    rate: Annotated[float, RATE_HZ] | None = Field(
        None, examples=[100.0], description="sample rate in Hz for a recording without times"
    )
    bytes_per_second: Annotated[float, BYTE_RATE] | None = Field(
        None,
        examples=[11_520.0],
        description="pace of captured bytes, a tenth of the baud rate; absent: as fast as they are read",
    )
    channel: str | None = Field(
        None, examples=["1"], description="channel of a CAN log that is replayed; absent: all channels"
    )


@dataclass(slots=True)
class _Source:
    """Open file with the chunks that remain to be delivered."""

    items: Iterator[Timed]
    close: Callable[[], object]


class ReplayLink:
    """Replay of one file, which starts from the beginning each time it is opened."""

    def __init__(self, settings: Settings, kind: Kind) -> None:
        self._settings = settings
        self._path = file_access.expand_user(settings.path)
        self._kind: Kind = kind
        self._pace = settings.speed  # seconds of the file per second; inf = no waiting
        self.carrier: Carrier = _raw_carrier(self._path) if kind == "raw" else CARRIERS[kind]
        self.epoch: Literal["monotonic", "unix"] = "monotonic" if kind == "capture" else "unix"
        self.default_decoder = DEFAULT_DECODERS[kind]
        self.name = f"replay of {settings.path}"
        self.notes: tuple[str, ...] = ()
        self._source: _Source | None = None
        self._next: Timed | None = None
        self._closing = threading.Event()
        self._in_use = threading.Lock()
        self._started_s = 0.0

    def open(self) -> None:
        """Open the file at its start. Raise ``LinkUnavailable`` if it does not exist or cannot be replayed."""
        with self._in_use:
            if self._source is not None:
                return
            self.notes = ()
            try:
                self._source = self._open_source()
                self._next = next(self._source.items, None)
            except OSError as error:
                self._close_source()
                why = error.strerror or " ".join(str(error).split())
                raise LinkUnavailable(f"{self._path}: cannot be replayed: {why}") from error
            except (*DAMAGE_ERRORS, ValueError, ConfigError, RecordingError) as error:
                self._close_source()
                raise LinkUnavailable(f"{self._path}: cannot be replayed: {error}") from error
            self._started_s = time.monotonic()
            self._closing.clear()

    def read(self, timeout_s: float) -> list[Chunk] | None:
        """Return the chunks that are due, after waiting up to ``timeout_s`` seconds for the first."""
        deadline = time.monotonic() + timeout_s
        with self._in_use:
            while self._source is not None and not self._closing.is_set():
                if self._next is None:
                    raise LinkEnded(" ".join((f"{self._path}: the end of the file.", *self.notes)))
                now = time.monotonic()
                due = self._due(self._next)
                if due <= now:
                    return self._take(now)
                if now >= deadline:
                    return None
                self._closing.wait(min(due, deadline) - now)
        raise LinkLost(f"{self.name}: the link is closed")

    def close(self) -> None:
        """Close the file and end a waiting ``read``."""
        self._closing.set()
        with self._in_use:
            self._close_source()

    def _take(self, now_s: float) -> list[Chunk]:
        """Return all chunks that are due by now."""
        chunks: list[Chunk] = []
        size = 0
        while (
            self._next is not None
            and self._due(self._next) <= now_s
            and len(chunks) < BATCH_CHUNKS
            and size < BATCH_BYTES
        ):
            chunks.append(self._next[1])
            size += len(self._next[1].data)
            self._fetch_next()
        return chunks

    def _due(self, item: Timed) -> float:
        """Return the monotonic time in s at which an item is due."""
        return self._started_s + item[0] / self._pace

    def _fetch_next(self) -> None:
        """Fetch the next item. If the file is damaged from here on, the replay ends here."""
        assert self._source is not None
        try:
            self._next = next(self._source.items, None)
        except (*DAMAGE_ERRORS, ValueError) as error:
            self._next = None
            self.notes += (f"It is cut off or damaged there: {' '.join(str(error).split())}.",)

    def _close_source(self) -> None:
        """Close the file if it is open."""
        source, self._source = self._source, None
        self._next = None
        if source is not None:
            source.close()

    def _open_source(self) -> _Source:
        """Open the file according to its kind."""
        if self._kind == "recording":
            recording = load_samples(self._path, self._settings.rate)
            self.notes = recording.notes
            return _Source(_messages(recording, self._rows(recording)), lambda: None)
        if self._kind == "raw":
            chunks = (chunk for path in _raw_segments(self._path) for chunk in segment.read_chunks(path))
            return _Source(_relative_times(chunks), lambda: None)
        if self._kind == "log":
            return _log(self._path, self._settings.channel)
        return _capture(self._path, self._settings.bytes_per_second)

    def _rows(self, recording: Recording) -> int:
        """Return the number of rows per message: few for a paced replay, many without pacing."""
        t, n = recording.t_s, len(recording)
        if self._pace == float("inf") or n < 2:
            return MAX_MESSAGE_ROWS
        rate = recording.rate_hz if t is None else (n - 1) / max(float(t[-1] - t[0]), 1e-9)
        return min(max(1, round((rate or 1.0) * STEP_S * self._pace)), MAX_MESSAGE_ROWS)


def _messages(recording: Recording, rows: int) -> Iterator[Timed]:
    """Yield messages of ``rows`` samples. Each message is due at the time of its newest sample."""
    given = 0
    start_ns: int | None = None
    for samples in iter_blocks(recording, rows):
        given += len(samples)
        start_ns = int(samples.t_ns[0]) if start_ns is None else start_ns
        newest_ns = int(samples.t_ns[-1])
        yield (newest_ns - start_ns) * 1e-9, Chunk(encode_samples("replay", given, samples), newest_ns)


# --- CAN logs ------------------------------------------------------------------------------------


def _log(path: Path, channel: str | None) -> _Source:
    """Open a CAN log."""
    if _plain_suffix(path) == ".csv" and not _header(path).startswith(PYTHON_CAN_HEADER):
        lines = _LineReader(_binary(path))
        stream = lines.text("")
        return _Source(_relative_times(_csv_frames(stream, channel, lines.found)), stream.close)
    if _plain_suffix(path) == ".blf":
        blf = _blf(path)
        return _Source(_relative_times(_log_frames(iter(blf), channel, lambda: None)), blf.stop)
    import can

    readers: dict[str, type[can.io.generic.TextIOMessageReader]] = {
        ".asc": can.ASCReader, ".log": can.CanutilsLogReader, ".trc": can.TRCReader, ".csv": can.CSVReader,
    }  # fmt: skip
    lines = _LineReader(_binary(path))
    stream = lines.text(None)
    try:
        reader = readers[_plain_suffix(path)](stream)
    except BaseException:
        stream.close()
        raise
    return _Source(_relative_times(_log_frames(iter(reader), channel, lines.found)), stream.close)


class _LineReader(io.RawIOBase):
    """Reader of a text file that limits the length of lines and of text without a frame.

    It raises ValueError above a limit.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._line = 0  # bytes since the last line end
        self._idle = 0  # bytes since the last frame

    def text(self, newline: str | None) -> io.TextIOWrapper:
        """Return the decoded text of the file. Closing it closes the file."""
        return io.TextIOWrapper(io.BufferedReader(self), "utf-8", newline=newline)

    def found(self) -> None:
        """Note that the text so far contained a frame."""
        self._idle = 0

    def readable(self) -> bool:
        """Return True, since the stream can be read."""
        return True

    def readinto(self, buffer: Any, /) -> int:
        """Read at most the length of ``buffer`` bytes into it, and return their number."""
        data = self._stream.read(min(len(buffer), CHUNK_BYTES))
        end = max(data.rfind(b"\n"), data.rfind(b"\r"))
        self._line = len(data) - end - 1 if end >= 0 else self._line + len(data)
        self._idle += len(data)
        if self._line > MAX_LINE_BYTES:
            raise ValueError(f"a line is longer than {MAX_LINE_BYTES} bytes")
        if self._idle > MAX_BYTES_WITHOUT_FRAME:
            raise ValueError(f"{MAX_BYTES_WITHOUT_FRAME} bytes hold no CAN frame")
        buffer[: len(data)] = data
        return len(data)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()
        super().close()


def _blf(path: Path) -> "can.BLFReader":
    """Open a BLF log. python-can's own reader would leave the file open if it is not a BLF log."""
    import can
    from can.io import blf
    from can.io.blf import BLFParseError

    class Reader(can.BLFReader):
        """BLF reader that rejects objects of size zero, which python-can would read forever, and oversized objects."""

        def __iter__(self) -> "Generator[can.Message, None, None]":
            idle = 0  # bytes since the last frame
            while header := self.file.read(blf.OBJ_HEADER_BASE_STRUCT.size):
                mark, _, _, size, kind = blf.OBJ_HEADER_BASE_STRUCT.unpack(header)
                if mark != BLF_OBJECT:
                    raise BLFParseError("no object begins where one ends")
                if size > MAX_OBJECT_BYTES:
                    raise BLFParseError(f"an object has {size} bytes, expected at most {MAX_OBJECT_BYTES}")
                body = self.file.read(size - blf.OBJ_HEADER_BASE_STRUCT.size)
                self.file.read(size % 4)  # padding
                if kind != blf.LOG_CONTAINER:
                    continue
                data = self._unpacked(body)
                idle += len(data)
                for message in self._parse_container(data):
                    idle = 0
                    yield message
                if idle > MAX_OBJECTS_WITHOUT_FRAME_BYTES:
                    raise BLFParseError(f"{MAX_OBJECTS_WITHOUT_FRAME_BYTES} bytes hold no CAN frame")
            self.stop()

        def _unpacked(self, container: bytes) -> bytes:
            """Return the objects of a container; none if the compression method is unknown."""
            method, _ = blf.LOG_CONTAINER_STRUCT.unpack_from(container)
            data = container[blf.LOG_CONTAINER_STRUCT.size :]
            if method == blf.NO_COMPRESSION:
                return data
            if method != blf.ZLIB_DEFLATE:
                return b""
            unzip = zlib.decompressobj()
            data = unzip.decompress(data, MAX_OBJECT_BYTES)
            if unzip.unconsumed_tail:
                raise BLFParseError(f"a container unpacks to more than {MAX_OBJECT_BYTES} bytes")
            return data

        def _parse_container(self, data: bytes) -> "Iterator[can.Message]":
            """Yield the messages of a container after checking the sizes of its objects."""
            at = data.find(BLF_OBJECT)
            while at >= 0:
                size = data[at + BLF_SIZE.start : at + BLF_SIZE.stop]
                if len(size) == 4 and int.from_bytes(size, "little") < BLF_HEADER_BYTES:
                    raise BLFParseError("an object is shorter than its header")
                at = data.find(BLF_OBJECT, at + 1)
            if len(self._tail) > MAX_OBJECT_BYTES:
                raise BLFParseError(f"an object has more than {MAX_OBJECT_BYTES} bytes")
            yield from super()._parse_container(data)

    stream = _ChunkedReader(_binary(path))
    try:
        return Reader(cast("BinaryIO", stream))
    except (BLFParseError, struct.error) as error:
        stream.close()
        raise ValueError(f"no BLF log: {error}") from error


class _ChunkedReader:
    """Reader of a file in small parts. A false length of gigabytes in the file therefore allocates no such memory."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self.close = stream.close

    def read(self, size: int) -> bytes:
        """Read ``size`` bytes, or fewer at the end of the file."""
        if size < 0:
            raise ValueError("an object is shorter than its header")
        parts = []
        while size > 0 and (part := self._stream.read(min(size, READ_BYTES))):
            parts.append(part)
            size -= len(part)
        return b"".join(parts)


def _log_frames(messages: "Iterator[can.Message]", channel: str | None, found: Callable[[], None]) -> Iterator[Chunk]:
    """Yield the data frames of a log that python-can reads.

    ``found`` is called for each message, including those of other channels.
    """
    from can.io.blf import BLFParseError

    while True:
        try:
            message = next(messages, None)
        except BLFParseError as error:
            raise ValueError(str(error)) from error
        if message is None:
            return
        found()
        if message.is_error_frame or message.is_remote_frame:
            continue
        if channel is None or str(message.channel) == channel:
            address = message.arbitration_id | (EXTENDED_ID if message.is_extended_id else 0)
            yield _frame(bytes(message.data), message.timestamp, address)


def _csv_frames(stream: IO[str], channel: str | None, found: Callable[[], None]) -> Iterator[Chunk]:
    """Yield the data frames of a CSV file.

    The columns are t (s), id_hex, data_hex, and optionally channel or bus, and extended (0 or 1). ``found`` is called
    for each frame, including those of other channels.
    """
    rows = csv.reader(stream)
    columns = {name: i for i, name in enumerate(next(rows))}
    t, identifier, data = columns["t"], columns["id_hex"], columns["data_hex"]
    lane = columns.get("channel", columns.get("bus"))
    extended = columns.get("extended")
    for row in rows:
        if len(row) != len(columns):
            raise ValueError(f"line {rows.line_num} has {len(row)} fields, not {len(columns)}")
        found()
        if channel is not None and (lane is None or row[lane] != channel):
            continue
        address = int(row[identifier], 16)
        wide = address > MAX_STANDARD_ID if extended is None else row[extended] == "1"
        flag = EXTENDED_ID if wide else 0
        yield _frame(bytes.fromhex(row[data]), float(row[t]), address | flag)


def _frame(data: bytes, t_s: float, address: int) -> Chunk:
    """Return a frame of a log as a chunk. Raise ValueError if its identifier, length or time is invalid."""
    if not abs(t_s) < T_LIMIT_S:
        raise ValueError(f"{t_s:g} s is no time")
    if not 0 <= address & ~EXTENDED_ID <= MAX_EXTENDED_ID or address < 0 or len(data) > MAX_FRAME_BYTES:
        raise ValueError(f"no CAN frame: identifier 0x{address & ~EXTENDED_ID:X}, {len(data)} bytes")
    return Chunk(data, round(t_s * 1e9), address)


def _relative_times(chunks: Iterator[Chunk]) -> Iterator[Timed]:
    """Yield chunks with their time since the first chunk in s."""
    start_ns: int | None = None
    for chunk in chunks:
        start_ns = chunk.t_ns if start_ns is None else start_ns
        yield (chunk.t_ns - start_ns) * 1e-9, chunk


# --- raw bytes -------------------------------------------------------------------------------------


def _raw_segments(path: Path) -> list[Path]:
    """Return the segments of raw bytes in a folder, oldest first, or the one segment that is named."""
    return segment.list_segments(path) if path.is_dir() else [path]


def _is_raw(path: Path) -> bool:
    """Return True if the newest segment holds raw bytes. An unreadable segment is reported when it is opened."""
    found = _raw_segments(path)
    if not found or not segment.NAME.fullmatch(found[-1].name):
        return False
    try:
        return segment.read_metadata(found[-1]).kind == "raw"
    except (OSError, RecordingError):
        return False


def _raw_carrier(path: Path) -> Carrier:
    """Return the carrier of the newest segment. Raise ConfigError if it is unknown."""
    carrier = segment.read_metadata(_raw_segments(path)[-1]).carrier
    known: tuple[Carrier, ...] = ("bytes", "frames", "messages")
    for one in known:
        if one == carrier:
            return one
    raise ConfigError(f'path: "{path}" carries "{carrier}", where {", ".join(known)} are known')


# --- captured bytes ------------------------------------------------------------------------------


def _capture(path: Path, bytes_per_second: float | None) -> _Source:
    """Open a file of captured bytes."""
    stream = _binary(path)
    if bytes_per_second is None:
        return _Source(_unpaced_bytes(stream), stream.close)
    return _Source(_paced_bytes(stream, bytes_per_second), stream.close)


def _unpaced_bytes(stream: IO[bytes]) -> Iterator[Timed]:
    """Yield captured bytes as fast as they are read."""
    while data := stream.read(CHUNK_BYTES):
        yield 0.0, Chunk(data, time.monotonic_ns())


def _paced_bytes(stream: IO[bytes], bytes_per_second: float) -> Iterator[Timed]:
    """Yield captured bytes at a given rate."""
    start_ns = time.monotonic_ns()
    size = min(max(1, round(bytes_per_second * STEP_S)), CHUNK_BYTES)
    given = 0
    while data := stream.read(size):
        given += len(data)
        at_s = given / bytes_per_second
        yield at_s, Chunk(data, start_ns + round(at_s * 1e9))


# --- kind of file --------------------------------------------------------------------------------


def _kind(path: Path) -> Kind:
    """Return the kind of a file by its suffix and, for CSV, its header. Raise ConfigError if it is unknown."""
    suffix = _plain_suffix(path)
    if path == Path():
        raise ConfigError("path: empty; it is a recording, a CAN log, captured bytes, or a folder of segments")
    if suffix in CAN_LOGS:
        return "log"
    if suffix in CAPTURES:
        return "capture"
    if _is_raw(path):
        return "raw"
    if path.is_dir():
        return "recording"
    if suffix == ".csv":
        header = _header(path)
        is_log = header.startswith(PYTHON_CAN_HEADER) or {"t", "id_hex", "data_hex"} <= {*header.split(",")}
        return "log" if is_log else "recording"
    if suffix in FORMATS:
        return "recording"
    known = (*FORMATS, *CAN_LOGS, *CAPTURES)
    raise ConfigError(f'path: "{path}" is nothing to replay by its suffix{format_choices(suffix, known)}')


def _plain_suffix(path: Path) -> str:
    """Return the last suffix, or the suffix before .gz."""
    suffixes = [s.lower() for s in path.suffixes]
    if suffixes and suffixes[-1] == ".gz":
        suffixes.pop()
    return suffixes[-1] if suffixes else ""


def _header(path: Path) -> str:
    """Return the first line of a text file; "" if it cannot be read."""
    try:
        with _text(path) as stream:
            return stream.readline(1000).strip()
    except (OSError, UnicodeDecodeError, *DAMAGE_ERRORS):
        return ""  # opening or reading the file reports the error


def _binary(path: Path) -> IO[bytes]:
    """Open a file for binary reading, decompressed if it ends in .gz."""
    file = file_access.open_regular(path)
    if path.suffix.lower() != ".gz":
        return file
    unzipped: Any = gzip.GzipFile(fileobj=file, mode="rb")
    unzipped.myfileobj = file  # closed together with the reader
    return cast("IO[bytes]", unzipped)


def _text(path: Path) -> IO[str]:
    """Open a file for text reading, decompressed if it ends in .gz."""
    return io.TextIOWrapper(_binary(path), "utf-8", newline="")


def build(settings: Settings) -> Link:
    """Return the link of these settings without opening it.

    Raises
    ------
    ConfigError
        If the file cannot be replayed.
    """
    path = file_access.expand_user(settings.path)
    _check_path(path)
    kind = _kind(path)
    if kind == "log":
        check_extra("can", "a CAN log")
    return ReplayLink(settings, kind)


def _check_path(path: Path) -> None:
    """Raise ConfigError for a path that is neither a file nor a folder. A missing file may be created later."""
    if path.is_dir():
        return
    try:
        file_access.check_regular(path)
    except FileNotFoundError:
        return
    except OSError as error:
        raise ConfigError(f'path "{path}": {error.strerror or error}') from error
