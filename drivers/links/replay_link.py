"""Link that replays a recorded file at an adjustable speed, as if a device sent the data.

The chunks depend on the type of the file:

- A recording (``drivers.recordings``: CSV, .npz, Parquet, Arrow, ROS bag, log of an autopilot, or a folder) becomes
  messages for the decoder ``samples``.
- A CAN log (``drivers.links.can_log_reader``) becomes CAN frames.
- A file of captured bytes (.bin, .raw or .txt, also with .gz) becomes bytes. A .bin file that begins like an ArduPilot
  log is a recording.
- Raw data that the daemon has recorded (a segment or a folder of segments) become bytes, frames or messages,
  depending on the original link.

The chunks of recordings, logs and raw data have the recorded Unix times. Captured bytes have no times. Each chunk is
therefore assigned the time at which a device with the byte rate ``bytes_per_second`` would have sent it. Without
``bytes_per_second``, each chunk is assigned the time of the read.

``wait_for_chunks_or_timeout`` raises ``LinkEnded`` after all data have been returned. If a file is truncated, the
intact part is replayed, and the final message mentions the truncation. ``build`` reads the header of a CSV file to
choose the decoder.
"""

import binascii
import csv
import gzip
import io
import struct
import time
import zlib
from collections.abc import Generator, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import IO, Annotated, Any, Final, Literal, cast

from pydantic import Field

from drivers.data_types import Chunk
from drivers.errors import ConfigError, LinkEnded, LinkUnavailable, RecordingError, describe_error
from drivers.host import safe_file_reading
from drivers.host.extras import require_extra
from drivers.links.base import Carrier, Link, LinkSettings, PolledLink
from drivers.recordings import FORMATS, Recording, iter_blocks, load_samples, require_packages_of_format, segment_file
from drivers.recordings.file_formats.ardupilot_log_format import is_ardupilot_log
from drivers.recordings.reading_options import ReadingOptions
from drivers.recordings.reading_progress import open_file_and_report_position
from drivers.validation.module_lookup import format_choices_by_similarity
from drivers.validation.number_ranges import BYTE_RATE, RATE_HZ, REPLAY_SPEED
from drivers.validation.settings_model import FilePath, KeywordOrType
from drivers.zenoh.sample_message import encode_samples

DEFAULT_DECODER: Final = "samples"
CAN_LOGS: Final = (".asc", ".blf", ".log", ".trc")
CAPTURES: Final = (".bin", ".raw", ".txt")
FRAMES_READ_AHEAD: Final = 2000
"""Number of frames of a CAN log that are examined before the first of them is replayed."""
BATCH_CHUNKS: Final = 1000
BATCH_BYTES: Final = 1_000_000
"""Total number of bytes after which a read ends. A read also ends after BATCH_CHUNKS chunks.

Without these limits, one read could return hours of a recording.
"""
MAX_MESSAGE_ROWS: Final = 4096
STEP_S: Final = 0.02
"""Duration in s of one chunk if data are replayed at a limited speed, as from a device with a small buffer."""
CHUNK_BYTES: Final = 4096
PYTHON_CAN_HEADER: Final = "timestamp,arbitration_id"
DAMAGE_ERRORS: Final = (
    EOFError, LookupError, OverflowError, zlib.error, gzip.BadGzipFile, struct.error, binascii.Error, csv.Error,
)  # fmt: skip
"""Exceptions besides ValueError that readers raise if a file is truncated or damaged."""

PACES: Final = {"recorded": 1.0, "max": float("inf")}
"""Speed factor for each word that the key ``speed`` accepts."""

Kind = Literal["recording", "log", "capture", "raw"]
TimedChunk = tuple[float, Chunk]
"""Chunk, and the time at which it is due, in s since the start of the file."""
CARRIERS: Final[dict[Kind, Carrier]] = {"recording": "messages", "log": "frames", "capture": "bytes"}
"""Type of chunk that each kind of file contains. For raw data, the segment file contains the type."""

DEFAULT_DECODERS: Final[dict[Kind, str]] = {"recording": DEFAULT_DECODER, "log": "dbc", "capture": "", "raw": ""}
"""Default decoder of each kind of file; "" if the settings must name the decoder."""


class Settings(LinkSettings, ReadingOptions):
    """Configuration keys of a replay."""

    path: FilePath = Field(
        examples=["recording.csv"], description="recording, CAN log, file of captured bytes, or folder of segments"
    )
    speed: Annotated[float, KeywordOrType(PACES, Annotated[float, REPLAY_SPEED])] = Field(
        1.0, examples=["recorded"], description="recorded, max, or a factor: 10 = ten times as fast as recorded"
    )
    rate: Annotated[float, RATE_HZ] | None = Field(
        None, examples=[100.0], description="sample rate in Hz for a recording without times"
    )
    bytes_per_second: Annotated[float, BYTE_RATE] | None = Field(
        None,
        examples=[11_520.0],
        description="captured bytes per second, a tenth of the baud rate; absent: as fast as they are read",
    )
    channel: str | None = Field(
        None,
        examples=["1"],
        description="channel of a CAN log that is replayed; absent: all, if they have different addresses",
    )


class ReplayLink(PolledLink):
    """Link that replays one file. Each call of ``open`` starts the replay from the beginning."""

    def __init__(self, settings: Settings, kind: Kind) -> None:
        super().__init__(f"replay of {Path(settings.path).name}")
        self._settings = settings
        self._path = safe_file_reading.expand_user(settings.path)
        self._kind: Kind = kind
        self._pace = settings.speed  # seconds of recorded time per second; inf = as fast as possible
        self.carrier: Carrier = _raw_carrier(self._path) if kind == "raw" else CARRIERS[kind]
        self.epoch: Literal["monotonic", "unix"] = "monotonic" if kind == "capture" else "unix"
        self.default_decoder = DEFAULT_DECODERS[kind]
        self.notes: tuple[str, ...] = ()
        self._items: Generator[TimedChunk] | None = None  # remaining chunks; closing the generator closes the file
        self._next: TimedChunk | None = None
        self._started_s = 0.0
        self._addresses: Sequence[int] = ()

    def set_address_filter(self, addresses: Sequence[int]) -> None:
        """Replay only the frames of a CAN log with these addresses. An empty sequence means all frames."""
        self._addresses = addresses

    def _is_open(self) -> bool:
        return self._items is not None

    def _open_source(self) -> None:
        self.notes = ()
        try:
            self._items = self._read_items()
            self._next = next(self._items, None)
        except (OSError, ValueError, *DAMAGE_ERRORS) as error:
            self._close_source()
            raise LinkUnavailable(f"{self._path}: cannot be replayed: {describe_error(error)}") from error
        self._started_s = time.monotonic()

    def _poll_source(self, deadline: float) -> list[Chunk]:
        if self._next is None:
            raise LinkEnded(" ".join((f"{self._path}: the end of the file.", *self.notes)))
        now_s = time.monotonic()
        due_s = self._due_s(self._next)
        if due_s > now_s:
            self._closing.wait(max(min(due_s, deadline) - now_s, 0.0))
            return []
        chunks: list[Chunk] = []
        size = 0
        while self._next is not None and self._due_s(self._next) <= now_s:
            if len(chunks) >= BATCH_CHUNKS or size >= BATCH_BYTES:
                break
            chunks.append(self._next[1])
            size += len(self._next[1].data)
            self._fetch_next()
        return chunks

    def _due_s(self, item: TimedChunk) -> float:
        return self._started_s + item[0] / self._pace

    def _fetch_next(self) -> None:
        """Fetch the next chunk. If the file is damaged, end the replay and add a note."""
        assert self._items is not None
        try:
            self._next = next(self._items, None)
        except (ValueError, *DAMAGE_ERRORS) as error:
            self._next = None
            self.notes += (f"The file is cut off or damaged at this point: {describe_error(error)}.",)

    def _close_source(self) -> None:
        items, self._items, self._next = self._items, None, None
        if items is not None:
            items.close()

    def _read_items(self) -> Generator[TimedChunk]:
        if self._kind == "recording":
            recording = load_samples(self._path, self._settings.rate, options=self._settings)
            self.notes = recording.notes
            return _read_messages(recording, self._message_rows(recording))
        if self._kind == "raw":
            chunks = (chunk for path in _raw_segments(self._path) for chunk in segment_file.read_chunks(path))
            return _relative_times(chunks)
        if self._kind == "log":
            return _relative_times(_read_log(self._path, self._settings.channel, self._addresses))
        return _read_capture(self._path, self._settings.bytes_per_second)

    def _message_rows(self, recording: Recording) -> int:
        """Return the number of samples per message. If the speed is not limited, the number is MAX_MESSAGE_ROWS."""
        t, n = recording.t_s, len(recording)
        if self._pace == float("inf") or n < 2:
            return MAX_MESSAGE_ROWS
        rate = recording.rate_hz if t is None else (n - 1) / max(float(t[-1] - t[0]), 1e-9)
        return min(max(1, round((rate or 1.0) * STEP_S * self._pace)), MAX_MESSAGE_ROWS)


def _read_messages(recording: Recording, rows: int) -> Generator[TimedChunk]:
    """Yield messages of up to ``rows`` samples. A message is due at the time of its newest sample."""
    given = 0
    start_ns: int | None = None
    for samples in iter_blocks(recording, rows):
        given += len(samples)
        start_ns = int(samples.t_ns[0]) if start_ns is None else start_ns
        newest_ns = int(samples.t_ns[-1])
        yield (newest_ns - start_ns) * 1e-9, Chunk(encode_samples("replay", given, samples), newest_ns)


def _relative_times(chunks: Iterator[Chunk]) -> Generator[TimedChunk]:
    start_ns: int | None = None
    for chunk in chunks:
        start_ns = chunk.t_ns if start_ns is None else start_ns
        yield (chunk.t_ns - start_ns) * 1e-9, chunk


def _read_log(path: Path, channel: str | None, addresses: Sequence[int]) -> Iterator[Chunk]:
    from drivers.links import can_log_reader

    suffix = _plain_suffix(path)
    with _open_binary(path) as stream:
        if suffix == ".csv" and not _read_header(path).startswith(PYTHON_CAN_HEADER):
            frames = can_log_reader.read_hex_csv(stream)
        else:
            frames = can_log_reader.read_can_log(stream, suffix)
        chosen = can_log_reader.choose_frames(frames, channel, addresses)
        head: list[Chunk] = []  # frames of two sensors are found before any of them is passed on
        damage: Exception | None = None
        try:
            head.extend(islice(chosen, FRAMES_READ_AHEAD))
        except can_log_reader.ChannelChoiceError:
            raise
        except (ValueError, *DAMAGE_ERRORS) as error:
            damage = error
        yield from head
        if damage is not None:
            raise damage
        yield from chosen


# --- raw bytes -------------------------------------------------------------------------------------


def _raw_segments(path: Path) -> list[Path]:
    """Return the segment files of a folder, oldest first. For a file, return only the file."""
    return segment_file.list_segments(path) if path.is_dir() else [path]


def _is_raw(path: Path) -> bool:
    found = _raw_segments(path)
    if not found or not segment_file.NAME.fullmatch(found[-1].name):
        return False
    try:
        return segment_file.read_metadata(found[-1]).kind == "raw"
    except (OSError, RecordingError):
        return False


def _raw_carrier(path: Path) -> Carrier:
    carrier = segment_file.read_metadata(_raw_segments(path)[-1]).carrier
    known: tuple[Carrier, ...] = ("bytes", "frames", "messages")
    for one in known:
        if one == carrier:
            return one
    raise ConfigError(f'path: "{path}" carries "{carrier}"; possible are {", ".join(known)}')


# --- captured bytes ------------------------------------------------------------------------------


def _read_capture(path: Path, bytes_per_second: float | None) -> Generator[TimedChunk]:
    """Yield captured bytes with the times at which they are due. Without a byte rate, all due times are 0."""
    start_ns = time.monotonic_ns()
    size = CHUNK_BYTES if bytes_per_second is None else min(max(1, round(bytes_per_second * STEP_S)), CHUNK_BYTES)
    given = 0
    with _open_binary(path) as stream:
        while data := stream.read(size):
            given += len(data)
            due_s = 0.0 if bytes_per_second is None else given / bytes_per_second
            t_ns = time.monotonic_ns() if bytes_per_second is None else start_ns + round(due_s * 1e9)
            yield due_s, Chunk(data, t_ns)


# --- kind of file --------------------------------------------------------------------------------


def detect_file_kind(path: Path) -> Kind:
    """Detect the type of a file from its suffix and content. Raise ConfigError if the type is unknown."""
    suffix = _plain_suffix(path)
    if path == Path():
        raise ConfigError("path: empty; it is a recording, a CAN log, captured bytes, or a folder of segments")
    if suffix in CAN_LOGS:
        return "log"
    if suffix in CAPTURES and not (suffix in FORMATS and is_ardupilot_log(path)):
        return "capture"
    if _is_raw(path):
        return "raw"
    if path.is_dir():
        return "recording"
    if suffix == ".csv":
        header = _read_header(path)
        is_log = header.startswith(PYTHON_CAN_HEADER) or {"t", "id_hex", "data_hex"} <= {*header.split(",")}
        return "log" if is_log else "recording"
    if suffix in FORMATS:
        return "recording"
    known = (*FORMATS, *CAN_LOGS, *CAPTURES)
    raise ConfigError(f'path: "{path}" has no suffix of a file to replay{format_choices_by_similarity(suffix, known)}')


def _plain_suffix(path: Path) -> str:
    suffixes = [s.lower() for s in path.suffixes]
    if suffixes and suffixes[-1] == ".gz":
        suffixes.pop()
    return suffixes[-1] if suffixes else ""


def _read_header(path: Path) -> str:
    try:
        with _open_text(path) as stream:
            return stream.readline(1000).strip()
    except (OSError, UnicodeDecodeError, *DAMAGE_ERRORS):
        return ""  # the error is reported when the file is replayed


def _open_binary(path: Path) -> IO[bytes]:
    file = open_file_and_report_position(path)
    if path.suffix.lower() != ".gz":
        return file
    unzipped: Any = gzip.GzipFile(fileobj=file, mode="rb")
    unzipped.myfileobj = file  # closing the GzipFile also closes this file
    return cast("IO[bytes]", unzipped)


def _open_text(path: Path) -> IO[str]:
    return io.TextIOWrapper(_open_binary(path), "utf-8", newline="")


def build(settings: Settings) -> Link:
    """Return a link that replays the file, without opening the file.

    Raises
    ------
    ConfigError
        If the file cannot be replayed.
    """
    path = safe_file_reading.expand_user(settings.path)
    _check_path(path)
    kind = detect_file_kind(path)
    if kind == "log":
        require_extra("can", "a CAN log")
    if kind == "recording":
        require_packages_of_format(path)
    return ReplayLink(settings, kind)


def _check_path(path: Path) -> None:
    if path.is_dir():
        return
    try:
        safe_file_reading.check_regular_file(path)
    except FileNotFoundError:
        return
    except OSError as error:
        raise ConfigError(f'path "{path}": {error.strerror or error}') from error
