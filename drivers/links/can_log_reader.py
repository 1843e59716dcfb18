"""Reader of CAN log files in the formats .asc, .blf, .log, .trc and CSV.

A damaged log can make python-can read text endlessly or allocate too much memory. The readers in this module limit the
length of lines, the size of objects, and the amount of data between two frames. A reader raises ValueError if a limit
is exceeded.
"""

import csv
import io
import re
import zlib
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import IO, Any, BinaryIO, Final, cast

import can
from can.io import blf

from drivers.data_types import EXTENDED_ID, Chunk
from drivers.links.can_link import identifier_mask
from drivers.recordings.table import T_LIMIT_S

_SCREEN_LINE: Final = re.compile(
    r"\s*(?P<t>\(\S+\))\s+(?P<channel>\S+)\s+(?:[RT]X\s+\S\s+\S\s+)?(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})\s+"
    r"\[(?P<size>\d+)\] +(?P<data>[0-9A-Fa-f]{2}(?: [0-9A-Fa-f]{2})*|)"
)


class _CandumpReader(can.CanutilsLogReader):
    """Reader of the log files of ``candump -l``, and of the lines that ``candump -t a`` prints on the screen."""

    def __iter__(self) -> Generator[can.Message, None, None]:
        """Yield the frames."""
        self.file = cast(Any, _LogLines(self.file))
        yield from super().__iter__()


class _LogLines:
    """Text file whose lines are those of a log file of ``candump -l``."""

    def __init__(self, text: IO[str]) -> None:
        self._text = text
        self.close = text.close

    def __iter__(self) -> Iterator[str]:
        return map(_to_log_line, self._text)


def _to_log_line(line: str) -> str:
    """Return a line of a log file for a line such as `` (1.5)  can0  100   [2]  3F 00``. Keep other lines."""
    found = _SCREEN_LINE.match(line)
    if found is None or "remote" in line:
        return line
    data = found["data"].replace(" ", "")
    mark = "##0" if len(found["size"]) > 1 else "#"  # two digits mean CAN FD
    return f"{found['t']} {found['channel']} {found['id']}{mark}{data}"


TEXT_READERS: Final[dict[str, type[can.io.generic.TextIOMessageReader]]] = {
    ".asc": can.ASCReader, ".log": _CandumpReader, ".trc": can.TRCReader, ".csv": can.CSVReader,
}  # fmt: skip
MAX_STANDARD_ID: Final = 0x7FF
MAX_EXTENDED_ID: Final = 0x1FFF_FFFF
MAX_FRAME_BYTES: Final = 64  # maximum payload of CAN FD
MAX_NAMED_CHANNELS: Final = 16
MAX_ADDRESSES: Final = 4096
"""Maximum number of addresses whose channel is remembered."""
READ_BYTES: Final = 4096
MAX_LINE_BYTES: Final = 1 << 20
MAX_BYTES_WITHOUT_FRAME: Final = 8_000_000
"""Maximum number of bytes, such as comments, between two frames. python-can needs seconds to read this much text."""
MAX_OBJECT_BYTES: Final = 64_000_000
"""Maximum compressed or uncompressed size of an object in a BLF log. Typical objects have a few hundred kilobytes."""
MAX_OBJECTS_WITHOUT_FRAME_BYTES: Final = 256_000_000
BLF_OBJECT: Final = b"LOBJ"
BLF_HEADER_BYTES: Final = blf.OBJ_HEADER_BASE_STRUCT.size


class ChannelChoiceError(ValueError):
    """The channel has to be chosen, or the chosen channel does not occur."""


def choose_frames(
    frames: Iterator[tuple[str, Chunk]], channel: str | None, addresses: Sequence[int]
) -> Iterator[Chunk]:
    """Yield the frames of one channel that the decoder accepts.

    Parameters
    ----------
    frames
        Channel and frame.
    channel
        Channel to read. None reads all channels, which must have different addresses.
    addresses
        Addresses that the decoder accepts. An empty sequence accepts all.

    Raises
    ------
    ChannelChoiceError
        If frames with one of the addresses come from several channels, such as those of two sensors of the same type,
        or if no frame comes from the chosen channel.
    """
    wanted = [(one & (identifier_mask(one) | EXTENDED_ID), identifier_mask(one) | EXTENDED_ID) for one in addresses]
    channels: dict[int, str] = {}
    others: set[str] = set()
    found = False
    for name, chunk in frames:
        if channel is not None and name != channel:
            if len(others) < MAX_NAMED_CHANNELS:
                others.add(name)
            continue
        found = True
        kind = next(
            (value for value, mask in wanted if chunk.address & mask == value), None if wanted else chunk.address
        )
        if kind is None:
            continue
        if channel is None and (len(channels) < MAX_ADDRESSES or kind in channels):
            first = channels.setdefault(kind, name)
            if name != first:
                raise ChannelChoiceError(
                    f"frames 0x{chunk.address & ~EXTENDED_ID:X} of several channels, {first} and {name}, which may be "
                    f'several sensors; choose a channel: channel = "{first}" (--option channel={first})'
                )
        yield chunk
    if channel is not None and not found:
        raise ChannelChoiceError(
            f"no frame of the channel {channel}; the channels are {', '.join(sorted(others)) or 'none'}"
        )


def read_can_log(stream: IO[bytes], suffix: str) -> Iterator[tuple[str, Chunk]]:
    """Yield the channel and the content of the CAN data frames of a log file in a format of python-can.

    Parameters
    ----------
    stream
        Decompressed content of the log.
    suffix
        File suffix of the format: ".blf" or a key of TEXT_READERS.

    Raises
    ------
    ValueError
        If the log is damaged or exceeds a limit.
    """
    try:
        if suffix == ".blf":
            reader = _ValidatingBlfReader(cast("BinaryIO", _BoundedReader(stream)))
            yield from _data_frames(iter(reader), lambda: None)
        else:
            lines = _BoundedLineReader(stream)
            yield from _data_frames(iter(TEXT_READERS[suffix](lines.open_as_text(None))), lines.reset_bytes_since_frame)
    except blf.BLFParseError as error:
        raise ValueError(f"no BLF log: {error}") from error


def read_hex_csv(stream: IO[bytes]) -> Iterator[tuple[str, Chunk]]:
    """Yield the channel and the content of the CAN data frames of a CSV file with the columns t, id_hex and data_hex.

    The times t are in s. The columns ``channel`` (or ``bus``) and ``extended`` (0 or 1) are optional.

    Parameters
    ----------
    stream
        Decompressed content of the file.

    Raises
    ------
    ValueError
        If the file is damaged or exceeds a limit.
    """
    lines = _BoundedLineReader(stream)
    rows = csv.reader(lines.open_as_text(""))
    columns = {name: i for i, name in enumerate(next(rows))}
    t, identifier, data = columns["t"], columns["id_hex"], columns["data_hex"]
    channel_column = columns.get("channel", columns.get("bus"))
    extended = columns.get("extended")
    for row in rows:
        if len(row) != len(columns):
            raise ValueError(f"line {rows.line_num} has {len(row)} fields, not {len(columns)}")
        lines.reset_bytes_since_frame()
        address = int(row[identifier], 16)
        is_extended = address > MAX_STANDARD_ID if extended is None else row[extended] == "1"
        chunk = _frame_chunk(bytes.fromhex(row[data]), float(row[t]), address | (EXTENDED_ID if is_extended else 0))
        yield "" if channel_column is None else row[channel_column], chunk


def _data_frames(
    messages: Iterator[can.Message], reset_bytes_since_frame: Callable[[], None]
) -> Iterator[tuple[str, Chunk]]:
    """Yield the channel and the content of the data frames, and call ``reset_bytes_since_frame`` for each message."""
    for message in messages:
        reset_bytes_since_frame()
        if message.is_error_frame or message.is_remote_frame:
            continue
        address = message.arbitration_id | (EXTENDED_ID if message.is_extended_id else 0)
        yield str(message.channel), _frame_chunk(bytes(message.data), message.timestamp, address)


def _frame_chunk(data: bytes, t_s: float, address: int) -> Chunk:
    """Return a frame as a chunk. Raise ValueError if the identifier, the length or the time is invalid."""
    if not abs(t_s) < T_LIMIT_S:
        raise ValueError(f"{t_s:g} s is no time")
    if not 0 <= address & ~EXTENDED_ID <= MAX_EXTENDED_ID or address < 0 or len(data) > MAX_FRAME_BYTES:
        raise ValueError(f"no CAN frame: identifier 0x{address & ~EXTENDED_ID:X}, {len(data)} bytes")
    return Chunk(data, round(t_s * 1e9), address)


class _BoundedLineReader(io.RawIOBase):
    """Reader that raises ValueError if a line or the text between two frames is too long."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._line_bytes = 0  # number of bytes since the last line end
        self._bytes_without_frame = 0

    def open_as_text(self, newline: str | None) -> io.TextIOWrapper:
        """Return a text file. ``newline`` has the same meaning as in the function ``open``."""
        return io.TextIOWrapper(io.BufferedReader(self), "utf-8", newline=newline)

    def reset_bytes_since_frame(self) -> None:
        """Reset the number of bytes since the last frame."""
        self._bytes_without_frame = 0

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any, /) -> int:
        """Read bytes into the buffer, and return the number of bytes read."""
        data = self._stream.read(min(len(buffer), READ_BYTES))
        end = max(data.rfind(b"\n"), data.rfind(b"\r"))
        self._line_bytes = len(data) - end - 1 if end >= 0 else self._line_bytes + len(data)
        self._bytes_without_frame += len(data)
        if self._line_bytes > MAX_LINE_BYTES:
            raise ValueError(f"a line is longer than {MAX_LINE_BYTES} bytes")
        if self._bytes_without_frame > MAX_BYTES_WITHOUT_FRAME:
            raise ValueError(f"{MAX_BYTES_WITHOUT_FRAME} bytes hold no CAN frame")
        buffer[: len(data)] = data
        return len(data)


class _BoundedReader:
    """Binary file that raises ValueError if a damaged BLF log asks for a negative or excessive number of bytes."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream

    def read(self, size: int) -> bytes:
        """Read ``size`` bytes, or fewer at the end of the file."""
        if not 0 <= size <= MAX_OBJECT_BYTES:
            stated = size + BLF_HEADER_BYTES
            raise ValueError(f"an object has {stated} bytes, expected {BLF_HEADER_BYTES} to {MAX_OBJECT_BYTES}")
        return self._stream.read(size)


class _ValidatingBlfReader(can.BLFReader):
    """BLF reader that rejects large objects and empty objects. python-can would read empty objects forever."""

    def __iter__(self) -> Generator[can.Message, None, None]:
        bytes_without_frame = 0
        while (container := self._read_container()) is not None:
            bytes_without_frame += len(container)
            for message in self._parse_container(container):
                bytes_without_frame = 0
                yield message
            if bytes_without_frame > MAX_OBJECTS_WITHOUT_FRAME_BYTES:
                raise blf.BLFParseError(f"{MAX_OBJECTS_WITHOUT_FRAME_BYTES} bytes hold no CAN frame")

    def _read_container(self) -> bytes | None:
        while header := self.file.read(BLF_HEADER_BYTES):
            mark, _, _, size, kind = blf.OBJ_HEADER_BASE_STRUCT.unpack(header)
            if mark != BLF_OBJECT:
                raise blf.BLFParseError("no object begins where the previous object ends")
            body = self.file.read(size - BLF_HEADER_BYTES)
            self.file.read(size % 4)  # padding
            if kind == blf.LOG_CONTAINER:
                return _unpack_container(body)
        return None

    def _parse_container(self, data: bytes) -> Iterator[can.Message]:
        """Yield the CAN messages of a BLF container after checking the object sizes."""
        at = data.find(BLF_OBJECT)
        while at >= 0:
            size = data[at + 8 : at + 12]
            if len(size) == 4 and int.from_bytes(size, "little") < BLF_HEADER_BYTES:
                raise blf.BLFParseError("an object is shorter than its header")
            at = data.find(BLF_OBJECT, at + 1)
        if len(self._tail) > MAX_OBJECT_BYTES:
            raise blf.BLFParseError(f"an object has more than {MAX_OBJECT_BYTES} bytes")
        yield from super()._parse_container(data)


def _unpack_container(container: bytes) -> bytes:
    """Return the uncompressed data of a BLF container; b"" if the compression method is unknown."""
    method, _ = blf.LOG_CONTAINER_STRUCT.unpack_from(container)
    data = container[blf.LOG_CONTAINER_STRUCT.size :]
    if method == blf.NO_COMPRESSION:
        return data
    if method != blf.ZLIB_DEFLATE:
        return b""
    unzip = zlib.decompressobj()
    data = unzip.decompress(data, MAX_OBJECT_BYTES)
    if unzip.unconsumed_tail:
        raise blf.BLFParseError(f"a container unpacks to more than {MAX_OBJECT_BYTES} bytes")
    return data
