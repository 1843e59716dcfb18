"""A file in place of a device: recordings, CAN logs and captured bytes, at their own pace or another.

What the file is decides what the link carries:

- recordings (``drivers.recordings``: CSV, .npz, Parquet, Arrow, a folder) travel as messages for the decoder
  ``samples``;
- CAN logs (.asc .blf .log .trc, CSV of python-can, CSV with ``t``, ``id_hex``, ``data_hex``) travel as frames;
- captured bytes (.bin .raw .txt, also with .gz) travel as bytes;
- the raw bytes that the daemon kept (a folder of segments, or one of them) travel as what they came in as: bytes,
  frames or messages.

Recordings, logs and raw bytes keep their own times (``epoch`` unix). Bytes have none: with ``bytes_per_second`` each
chunk gets the time at which that rate brings it, without it the time it was read.

``read`` raises ``LinkEnded`` once all was given. A file cut off in the middle is given up to the cut, and
the ending says so. ``build`` looks at a CSV's header, since the decoder must fit; all else waits for ``open``.
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

from drivers import file_access
from drivers.discovery import FilePath, possible
from drivers.errors import ConfigError, LinkEnded, LinkLost, LinkUnavailable, RecordingError
from drivers.extras import check_extra
from drivers.links.base import Carrier, Link, LinkSettings
from drivers.quantities import BYTE_RATE, RATE_HZ, REPLAY_SPEED, range_problems
from drivers.recordings import FORMATS, Recording, iter_blocks, load_samples, segment
from drivers.recordings.table import T_LIMIT_S
from drivers.sample import EXTENDED_ID, Chunk
from drivers.zenoh.sample_message import pack

if TYPE_CHECKING:
    import can

DEFAULT_DECODER: Final = "samples"
CAN_LOGS: Final = (".asc", ".blf", ".log", ".trc")
CAPTURES: Final = (".bin", ".raw", ".txt")
BATCH: Final = 1000
BATCH_BYTES: Final = 1_000_000
"""What a read gives at most, and a chunk more: so that none is without end, and none holds hours of a recording."""
ROWS_AT_ONCE: Final = 4096
STEP_S: Final = 0.02
"""Paced recordings and bytes come in pieces of this length, as from a device with a small buffer."""
CHUNK_BYTES: Final = 4096
PYTHON_CAN_HEADER: Final = "timestamp,arbitration_id"
LARGEST_STANDARD_ID: Final = 0x7FF
LARGEST_ID: Final = 0x1FFF_FFFF
LONGEST_FRAME: Final = 64  # bytes, of CAN FD
READ_BYTES: Final = 1 << 20
MAX_LINE_BYTES: Final = 1 << 20
MAX_BYTES_WITHOUT_FRAME: Final = 8_000_000
"""Text of a log that is read without finding a frame, such as comments; a reader needs seconds for it."""
MAX_OBJECT_BYTES: Final = 64_000_000
"""Of an object of a BLF log, packed or unpacked; Vector's tools write containers of some hundred kilobytes."""
MAX_OBJECTS_WITHOUT_FRAME_BYTES: Final = 256_000_000
BLF_OBJECT: Final = b"LOBJ"
BLF_SIZE: Final = slice(8, 12)  # of the object, little-endian, in its header
BLF_HEADER: Final = 16
DAMAGE: Final = (
    EOFError, LookupError, OverflowError, zlib.error, gzip.BadGzipFile, struct.error, binascii.Error, csv.Error,
)  # fmt: skip
"""What readers raise at a place where a file is cut or damaged, beside ValueError."""

PACES: Final = {"recorded": 1.0, "max": float("inf")}
"""Words for ``speed``: file seconds a second."""

Kind = Literal["recording", "log", "capture", "raw"]
Timed = tuple[float, Chunk]
"""Seconds from the start of the file, and what comes then."""
CARRIERS: Final[dict[Kind, Carrier]] = {"recording": "messages", "log": "frames", "capture": "bytes"}
"""What each kind carries; raw bytes say it themselves."""

DEFAULT_DECODERS: Final[dict[Kind, str]] = {"recording": DEFAULT_DECODER, "log": "dbc", "capture": "", "raw": ""}
"""Decoder of each kind, where the settings name none; "" = they must."""


class Settings(LinkSettings, frozen=True, kw_only=True):
    """Keys of a replay."""

    path: FilePath
    speed: str | Annotated[float, REPLAY_SPEED.meta] = "recorded"
    """"recorded", "max", or a factor: 10 = ten times as fast."""
    rate: Annotated[float, RATE_HZ.meta] | None = None
    """Hz; for a recording with neither t nor fs."""
    bytes_per_second: Annotated[float, BYTE_RATE.meta] | None = None
    """Pace of captured bytes, a tenth of the baud rate; absent: as fast as they are read."""
    channel: str | None = None
    """Only frames of this channel of a CAN log."""


@dataclass(slots=True)
class _Source:
    """An opened file: what it still has to give."""

    items: Iterator[Timed]
    close: Callable[[], object]


class ReplayLink:
    """One file, given once for each time it is opened."""

    def __init__(self, settings: Settings, kind: Kind, pace: float) -> None:
        self._settings = settings
        self._path = file_access.path(settings.path)
        self._kind: Kind = kind
        self._pace = pace  # file seconds a second; inf = no waiting
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
        """Open the file at its start; ``LinkUnavailable`` when it is not there or not what it seemed."""
        with self._in_use:
            if self._source is not None:
                return
            self.notes = ()
            try:
                self._source = self._open_source()
                self._next = next(self._source.items, None)
            except OSError as error:
                self._shut()
                why = error.strerror or " ".join(str(error).split())
                raise LinkUnavailable(f"{self._path}: cannot be replayed: {why}") from error
            except (*DAMAGE, ValueError, ConfigError, RecordingError) as error:
                self._shut()
                raise LinkUnavailable(f"{self._path}: cannot be replayed: {error}") from error
            self._started_s = time.monotonic()
            self._closing.clear()

    def read(self, timeout_s: float) -> list[Chunk] | None:
        """What is due, waiting up to ``timeout_s`` for the first of it."""
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
        """Close the file; ends a waiting ``read``."""
        self._closing.set()
        with self._in_use:
            self._shut()

    def _take(self, now_s: float) -> list[Chunk]:
        """All that is due by now."""
        chunks: list[Chunk] = []
        size = 0
        while self._next is not None and self._due(self._next) <= now_s and len(chunks) < BATCH and size < BATCH_BYTES:
            chunks.append(self._next[1])
            size += len(self._next[1].data)
            self._advance()
        return chunks

    def _due(self, item: Timed) -> float:
        return self._started_s + item[0] / self._pace

    def _advance(self) -> None:
        """Fetch the next item; a file that is damaged from here on ends here."""
        assert self._source is not None
        try:
            self._next = next(self._source.items, None)
        except (*DAMAGE, ValueError) as error:
            self._next = None
            self.notes += (f"It is cut off or damaged there: {' '.join(str(error).split())}.",)

    def _shut(self) -> None:
        source, self._source = self._source, None
        self._next = None
        if source is not None:
            source.close()

    def _open_source(self) -> _Source:
        if self._kind == "recording":
            recording = load_samples(self._path, self._settings.rate)
            self.notes = recording.notes
            return _Source(_messages(recording, self._rows(recording)), lambda: None)
        if self._kind == "raw":
            chunks = (chunk for path in _raw_segments(self._path) for chunk in segment.read_chunks(path))
            return _Source(_from_start(chunks), lambda: None)
        if self._kind == "log":
            return _log(self._path, self._settings.channel)
        return _capture(self._path, self._settings.bytes_per_second)

    def _rows(self, recording: Recording) -> int:
        """Rows a message: few where somebody waits for each, many where nobody does."""
        t, n = recording.t_s, len(recording)
        if self._pace == float("inf") or n < 2:
            return ROWS_AT_ONCE
        rate = recording.rate_hz if t is None else (n - 1) / max(float(t[-1] - t[0]), 1e-9)
        return min(max(1, round((rate or 1.0) * STEP_S * self._pace)), ROWS_AT_ONCE)


def _messages(recording: Recording, rows: int) -> Iterator[Timed]:
    """Messages of ``rows`` samples, each due with its newest sample."""
    given = 0
    start_ns: int | None = None
    for samples in iter_blocks(recording, rows):
        given += len(samples)
        start_ns = int(samples.t_ns[0]) if start_ns is None else start_ns
        newest_ns = int(samples.t_ns[-1])
        yield (newest_ns - start_ns) * 1e-9, Chunk(pack("replay", given, samples), newest_ns)


# --- CAN logs ------------------------------------------------------------------------------------


def _log(path: Path, channel: str | None) -> _Source:
    if _plain_suffix(path) == ".csv" and not _header(path).startswith(PYTHON_CAN_HEADER):
        lines = _Lines(_binary(path))
        stream = lines.text("")
        return _Source(_from_start(_csv_frames(stream, channel, lines.found)), stream.close)
    if _plain_suffix(path) == ".blf":
        blf = _blf(path)
        return _Source(_from_start(_log_frames(iter(blf), channel, lambda: None)), blf.stop)
    import can

    readers: dict[str, type[can.io.generic.TextIOMessageReader]] = {
        ".asc": can.ASCReader, ".log": can.CanutilsLogReader, ".trc": can.TRCReader, ".csv": can.CSVReader,
    }  # fmt: skip
    lines = _Lines(_binary(path))
    stream = lines.text(None)
    try:
        reader = readers[_plain_suffix(path)](stream)
    except BaseException:
        stream.close()
        raise
    return _Source(_from_start(_log_frames(iter(reader), channel, lines.found)), stream.close)


class _Lines(io.RawIOBase):
    """A file of lines. ValueError for a line without end, and for text without end that holds no frame."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._line = 0  # bytes since the last end of a line
        self._idle = 0  # bytes since the last frame

    def text(self, newline: str | None) -> io.TextIOWrapper:
        """The text of the file; its end closes the file."""
        return io.TextIOWrapper(io.BufferedReader(self), "utf-8", newline=newline)

    def found(self) -> None:
        """Take note that the text so far held a frame."""
        self._idle = 0

    def readable(self) -> bool:
        """Return True, as this can be read."""
        return True

    def readinto(self, buffer: Any, /) -> int:
        """Read up to the length of ``buffer`` bytes into it, and return how many."""
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
    """python-can's own reader would leave the file open when it is none of its kind."""
    import can
    from can.io import blf
    from can.io.blf import BLFParseError

    class Reader(can.BLFReader):
        """Not for ever at an object that says to end where it begins, and no object of gigabytes."""

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
            """The objects of a container, none of a packing that is unknown."""
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
            at = data.find(BLF_OBJECT)
            while at >= 0:
                size = data[at + BLF_SIZE.start : at + BLF_SIZE.stop]
                if len(size) == 4 and int.from_bytes(size, "little") < BLF_HEADER:
                    raise BLFParseError("an object is shorter than its header")
                at = data.find(BLF_OBJECT, at + 1)
            if len(self._tail) > MAX_OBJECT_BYTES:
                raise BLFParseError(f"an object has more than {MAX_OBJECT_BYTES} bytes")
            yield from super()._parse_container(data)

    stream = _Parts(_binary(path))
    try:
        return Reader(cast("BinaryIO", stream))
    except (BLFParseError, struct.error) as error:
        stream.close()
        raise ValueError(f"no BLF log: {error}") from error


class _Parts:
    """A file read in parts, so that a length of gigabytes that the file only claims makes no room for them."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self.close = stream.close

    def read(self, size: int) -> bytes:
        """So many bytes, fewer at the end."""
        if size < 0:
            raise ValueError("an object is shorter than its header")
        parts = []
        while size > 0 and (part := self._stream.read(min(size, READ_BYTES))):
            parts.append(part)
            size -= len(part)
        return b"".join(parts)


def _log_frames(messages: "Iterator[can.Message]", channel: str | None, found: Callable[[], None]) -> Iterator[Chunk]:
    """Data frames of a log that python-can reads. ``found`` is called for each message, of another channel too."""
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
    """Data frames of a CSV with t (s), id_hex, data_hex and perhaps channel or bus, and extended (0 or 1).

    ``found`` is called for each frame, of another channel too.
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
        wide = address > LARGEST_STANDARD_ID if extended is None else row[extended] == "1"
        flag = EXTENDED_ID if wide else 0
        yield _frame(bytes.fromhex(row[data]), float(row[t]), address | flag)


def _frame(data: bytes, t_s: float, address: int) -> Chunk:
    """A frame of a log; ValueError for one that no bus could carry, or at no time."""
    if not abs(t_s) < T_LIMIT_S:
        raise ValueError(f"{t_s:g} s is no time")
    if not 0 <= address & ~EXTENDED_ID <= LARGEST_ID or address < 0 or len(data) > LONGEST_FRAME:
        raise ValueError(f"no CAN frame: identifier 0x{address & ~EXTENDED_ID:X}, {len(data)} bytes")
    return Chunk(data, round(t_s * 1e9), address)


def _from_start(chunks: Iterator[Chunk]) -> Iterator[Timed]:
    start_ns: int | None = None
    for chunk in chunks:
        start_ns = chunk.t_ns if start_ns is None else start_ns
        yield (chunk.t_ns - start_ns) * 1e-9, chunk


# --- raw bytes -------------------------------------------------------------------------------------


def _raw_segments(path: Path) -> list[Path]:
    """Segments of raw bytes, oldest first: of a folder, or the one that is named."""
    return segment.segments(path) if path.is_dir() else [path]


def _is_raw(path: Path) -> bool:
    """Whether the newest segment holds raw bytes; one that cannot be read says so when it is opened."""
    found = _raw_segments(path)
    if not found or not segment.NAME.fullmatch(found[-1].name):
        return False
    try:
        return segment.origin(found[-1]).kind == "raw"
    except (OSError, RecordingError):
        return False


def _raw_carrier(path: Path) -> Carrier:
    carrier = segment.origin(_raw_segments(path)[-1]).carrier
    known: tuple[Carrier, ...] = ("bytes", "frames", "messages")
    for one in known:
        if one == carrier:
            return one
    raise ConfigError(f'path: "{path}" carries "{carrier}", where {", ".join(known)} are known')


# --- captured bytes ------------------------------------------------------------------------------


def _capture(path: Path, bytes_per_second: float | None) -> _Source:
    stream = _binary(path)
    if bytes_per_second is None:
        return _Source(_bytes_now(stream), stream.close)
    return _Source(_bytes_paced(stream, bytes_per_second), stream.close)


def _bytes_now(stream: IO[bytes]) -> Iterator[Timed]:
    while data := stream.read(CHUNK_BYTES):
        yield 0.0, Chunk(data, time.monotonic_ns())


def _bytes_paced(stream: IO[bytes], bytes_per_second: float) -> Iterator[Timed]:
    start_ns = time.monotonic_ns()
    size = min(max(1, round(bytes_per_second * STEP_S)), CHUNK_BYTES)
    given = 0
    while data := stream.read(size):
        given += len(data)
        at_s = given / bytes_per_second
        yield at_s, Chunk(data, start_ns + round(at_s * 1e9))


# --- what kind of file ---------------------------------------------------------------------------


def _kind(path: Path) -> Kind:
    """What the path holds, by its suffix and, for CSV, its header. Raises ConfigError for neither."""
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
    raise ConfigError(f'path: "{path}" is nothing to replay by its suffix{possible(suffix, known)}')


def _plain_suffix(path: Path) -> str:
    """The last suffix, or the one before .gz."""
    suffixes = [s.lower() for s in path.suffixes]
    if suffixes and suffixes[-1] == ".gz":
        suffixes.pop()
    return suffixes[-1] if suffixes else ""


def _header(path: Path) -> str:
    """First line of a text file; "" while there is none to read."""
    try:
        with _text(path) as stream:
            return stream.readline(1000).strip()
    except (OSError, UnicodeDecodeError, *DAMAGE):
        return ""  # open, or the recording's reader, says what is wrong with it


def _binary(path: Path) -> IO[bytes]:
    file = file_access.open_regular(path)
    if path.suffix.lower() != ".gz":
        return file
    unzipped: Any = gzip.GzipFile(fileobj=file, mode="rb")
    unzipped.myfileobj = file  # closed with it
    return cast("IO[bytes]", unzipped)


def _text(path: Path) -> IO[str]:
    return io.TextIOWrapper(_binary(path), "utf-8", newline="")


def build(settings: Settings) -> Link:
    """The link of these settings.

    Raises ``ConfigError`` for a speed that is none, and for a file that is nothing to replay.
    """
    path = file_access.path(settings.path)
    wrong = list(_problems(settings))
    try:
        _check_path(path)
        kind = _kind(path)
        if kind == "log":
            check_extra("can", "a CAN log")
    except ConfigError as error:
        wrong = [*error.lines, *wrong]
    if wrong:
        raise ConfigError(*wrong)
    return ReplayLink(settings, kind, _pace(settings.speed))


def _check_path(path: Path) -> None:
    """Raise ConfigError for something that is neither a file nor a folder; one that is not there may come."""
    if path.is_dir():
        return
    try:
        file_access.check_regular(path)
    except FileNotFoundError:
        return
    except OSError as error:
        raise ConfigError(f'path "{path}": {error.strerror or error}') from error


def _problems(settings: Settings) -> Iterator[str]:
    yield from range_problems(settings)
    if isinstance(settings.speed, str) and settings.speed not in PACES:
        yield f'speed: "{settings.speed}"; possible are recorded, max, or a factor without quotes'


def _pace(speed: str | float) -> float:
    """Return the seconds of the file that pass in a second; 0 for an unknown word."""
    return PACES.get(speed, 0.0) if isinstance(speed, str) else speed
