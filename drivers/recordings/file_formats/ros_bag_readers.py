"""Readers of ROS bags that use a bounded amount of memory.

The readers of rosbags unpack chunks of any size. For a ROS 1 bag, they keep the index of all messages in memory, about
150 bytes per message. The classes in this module check the sizes before rosbags unpacks data, and read the index of a
ROS 1 bag chunk by chunk.

This module imports rosbags, so only ``ros_bag_format`` imports this module, and only when a bag is read.
"""

import os
import re
import struct
import sys
from bz2 import BZ2Decompressor
from collections import defaultdict
from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final, cast

import apsw
from lz4.frame import LZ4FrameDecompressor
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinitionFormat, Nodetype
from rosbags.rosbag1.reader import Chunk, IndexData, decompressors
from rosbags.rosbag2 import storage_mcap
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader, read_string
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import get_types_from_idl, get_types_from_msg
from rosbags.typesys.msg import normalize_msgtype

from drivers.errors import RecordingError
from drivers.host.safe_file_reading import open_regular_file

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

if TYPE_CHECKING:
    from rosbags.interfaces.typing import RPath

Message = tuple[Connection, int, bytes]
"""Connection, time of the log in ns, and bytes of a message."""

MAX_CHUNK_BYTES: Final = 256_000_000
"""Maximum unpacked size of the chunks that are in memory at the same time. The default in ROS is 1 to 4 MB."""
MAX_MESSAGE_BYTES: Final = 64_000_000
MAX_INDEX_BYTES: Final = 64_000_000
"""Maximum size of the index of a chunk in a ROS 1 bag, and of the summary section of an MCAP file."""
READ_BYTES: Final = 1 << 18
DECOMPRESSORS: Final[Mapping[str, Callable[[], Any]]] = {
    "bz2": BZ2Decompressor,
    "lz4": LZ4FrameDecompressor,
    "zstd": zstd.ZstdDecompressor,
}

INDEX_SIZE_OFFSET: Final = 51
"""Offset of the data size in an index record of a ROS 1 bag (bag format 2.0: header of 47 bytes)."""
MCAP_FOOTER: Final = struct.Struct("<BQQQI8s")  # mcap.dev/spec: opcode, length, summary, summary offsets, CRC, magic
MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
MCAP_RECORD: Final = struct.Struct("<BQ")  # opcode, length
ROS2_NAMES: Final = {"ros1": "ros2", "ros1msg": "ros2msg"}
"""Name of the profile and of the schema encoding of ROS 2, for those of ROS 1 (mcap.dev/spec/registry)."""
MCAP_SCHEMA: Final = 0x03
MCAP_CHUNK_INDEX: Final = 0x08
MCAP_CHUNK_HEADER_BYTES: Final = 9 + 40
"""Bytes of a chunk record that precede the name of the compression and the messages."""
IDL_HEADER: Final = re.compile(r"={80}\nIDL: .*\n")
"""Lines before each definition of a schema with several definitions."""


def iter_unpacked(file: IO[bytes], compression: str) -> Iterator[bytes]:
    """Yield the unpacked content of compressed data in pieces of up to READ_BYTES.

    Parameters
    ----------
    file
        Compressed data. Several frames may follow each other.
    compression
        Key of DECOMPRESSORS.
    """
    data = file.read(READ_BYTES)
    while data:
        unpacker = DECOMPRESSORS[compression]()
        while True:
            piece = unpacker.decompress(data, READ_BYTES)
            if piece:
                yield piece
            if unpacker.eof:
                break
            data = file.read(READ_BYTES) if unpacker.needs_input else b""
            if unpacker.needs_input and not data:
                return
        data = unpacker.unused_data or file.read(READ_BYTES)


def unpack(path: "RPath", packed: bytes, compression: str, max_bytes: int) -> bytes:
    """Unpack compressed data. Raise RecordingError if the result has more than ``max_bytes`` bytes."""
    pieces: list[bytes] = []
    size = 0
    for piece in iter_unpacked(BytesIO(packed), compression):
        size += len(piece)
        check_unpacked_size(path, size, max_bytes)
        pieces.append(piece)
    return b"".join(pieces)


def check_unpacked_size(path: "RPath", size: int, max_bytes: int) -> None:
    """Raise RecordingError if messages are larger than ``max_bytes``."""
    if size > max_bytes:
        raise RecordingError(
            f"{path}: messages unpack to more than {max_bytes / 1e6:g} MB at a time; "
            "write the bag again with smaller chunks, and with the topic of the IMU alone"
        )


class Ros1Reader(rosbag1.Reader):
    """Reader of a ROS 1 bag that reads the index of one chunk at a time."""

    def read_chunk(self) -> Chunk:
        """Return the description of a chunk, with a decompressor that limits the unpacked size."""
        chunk = super().read_chunk()
        check_unpacked_size(self.path, chunk.datasize, MAX_CHUNK_BYTES)
        name = next(name for name, function in decompressors.items() if function is chunk.decompressor)
        if name not in DECOMPRESSORS:
            return chunk
        return chunk._replace(decompressor=partial(unpack, self.path, compression=name, max_bytes=MAX_CHUNK_BYTES))

    def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
        """Skip the index of a chunk while the bag is opened."""

    def count_messages(self) -> dict[int, int]:
        """Return the number of messages of each connection."""
        counts: dict[int, int] = defaultdict(int)
        for chunk in self.chunk_infos:
            for connection, count in chunk.connection_counts.items():
                counts[connection] += count
        return counts

    def messages(
        self, connections: Collection[Connection] = (), start: int | None = None, stop: int | None = None
    ) -> Generator[Message]:
        """Yield messages, chunk by chunk."""
        wanted = {connection.id for connection in connections}
        for info in sorted(self.chunk_infos, key=lambda one: one.start_time):
            if not wanted & info.connection_counts.keys():
                continue
            assert self.bio is not None
            chunk = self.chunks[info.pos]
            self.bio.seek(chunk.datapos + chunk.datasize)
            indexes: dict[int, list[IndexData]] = defaultdict(list)
            for _ in info.connection_counts:
                self._check_index_size()
                super().read_index_data(info.pos, indexes)
            self.indexes = {one.id: sorted(indexes[one.id]) for one in self.connections}
            yield from super().messages(connections, start, stop)

    def _check_index_size(self) -> None:
        assert self.bio is not None
        at = self.bio.tell()
        self.bio.seek(at + INDEX_SIZE_OFFSET)
        size = int.from_bytes(self.bio.read(4), "little")
        self.bio.seek(at)
        if size > MAX_INDEX_BYTES:
            raise RecordingError(f"{self.path}: the index of a chunk has {size} bytes, expected {MAX_INDEX_BYTES}")


def _read_string(bio: Any) -> str:
    """Return the text in a record of an MCAP file, with the names of ROS 2 in place of those of ROS 1.

    The records of both are equal, but rosbags refuses those of ROS 1. The encoding of their messages is ``ros2``.
    """
    text = read_string(bio)
    return ROS2_NAMES.get(text, text)


class BoundedMcapReader(McapReader):
    """Reader of an MCAP file that refuses files without an index and large chunks."""

    def open(self) -> None:
        """Open the file."""
        check_mcap_index(Path(str(self.path)))
        vars(storage_mcap)["read_string"] = _read_string
        super().open()

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Generator[Message]:
        """Yield messages in the order of the log times."""
        assert self.bio is not None
        wanted = {connection.id for connection in connections}
        bounds: list[tuple[int, int]] = []
        for chunk in self.chunks:
            if wanted & {cid for cid, count in chunk.channel_count.items() if count}:
                bounds.append((chunk.message_start_time, chunk.uncompressed_size))
                bounds.append((chunk.message_end_time + 1, -chunk.uncompressed_size))
                self.bio.seek(chunk.chunk_start_offset + MCAP_CHUNK_HEADER_BYTES + len(chunk.compression))
                packed = self.bio.read(min(chunk.compressed_size, MAX_CHUNK_BYTES + 1))
                check_unpacked_size(self.path, len(packed), MAX_CHUNK_BYTES)
                if chunk.compression in DECOMPRESSORS:
                    size = 0
                    for piece in iter_unpacked(BytesIO(packed), chunk.compression):
                        size += len(piece)
                        check_unpacked_size(self.path, size, MAX_CHUNK_BYTES)
        open_bytes = 0  # chunks whose times overlap are in memory at the same time
        for _, size in sorted(bounds):
            open_bytes += size
            check_unpacked_size(self.path, open_bytes, MAX_CHUNK_BYTES)
        yield from super().messages(connections, start, stop)


def check_mcap_index(path: Path) -> None:
    """Raise RecordingError if an MCAP file is incomplete or has no index of its chunks."""
    with open_regular_file(path) as file:
        end = file.seek(0, os.SEEK_END)
        file.seek(0)
        if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            return  # rosbags describes the error
        file.seek(max(end - MCAP_FOOTER.size, 0))
        footer = file.read()
        if len(footer) < MCAP_FOOTER.size or not footer.endswith(MCAP_MAGIC):
            raise RecordingError(
                f"{path}: is cut off: the end of the MCAP file is missing; {_recover(path)} copies the intact messages"
            )
        _, _, at, *_ = MCAP_FOOTER.unpack(footer)
        opcodes = set()
        if 0 < at < end:
            if end - at > MAX_INDEX_BYTES:
                raise RecordingError(f"{path}: the index has {end - at} bytes, expected at most {MAX_INDEX_BYTES}")
            file.seek(at)
            while len(head := file.read(MCAP_RECORD.size)) == MCAP_RECORD.size:
                opcode, size = MCAP_RECORD.unpack(head)
                opcodes.add(opcode)
                file.seek(min(file.tell() + size, end))
    if not {MCAP_SCHEMA, MCAP_CHUNK_INDEX} <= opcodes:
        raise RecordingError(
            f"{path}: is not indexed; expected an MCAP file with a summary section that lists schemas and chunks; "
            f"{_recover(path)} writes an indexed copy"
        )


def _recover(path: Path) -> str:
    return f"`mcap recover {path.name} -o indexed.mcap`"


class BoundedSqlite3Reader(Sqlite3Reader):
    """Reader of an SQLite file with a limit on the size of a message."""

    def open(self) -> None:
        """Open the file."""
        super().open()
        assert self.dbconn is not None
        self.dbconn.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)


class BoundedFolderReader(DirectoryReader):
    """Reader of a folder with a ROS 2 bag."""

    STORAGE_PLUGINS: Mapping[str, Any] = {"mcap": BoundedMcapReader, "sqlite3": BoundedSqlite3Reader}

    def open(self) -> None:
        """Open the bag."""
        try:
            super().open()
        except RecordingError as error:
            if str(error).startswith(str(self.path)):
                raise
            raise RecordingError(f"{self.path}: the unpacked file {error}") from error
        self._packed = self.metadata.compression_mode == "message"
        if self._packed:  # this class unpacks the messages
            self.metadata = self.metadata._replace(compression_mode=None)

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Generator[Message]:
        """Yield messages, file by file."""
        for connection, log_ns, data in super().messages(connections, start, stop):
            yield connection, log_ns, unpack(self.path, data, "zstd", MAX_MESSAGE_BYTES) if self._packed else data


class Ros2Reader(rosbag2.Reader):
    """Reader of a ROS 2 bag, or of an MCAP file with messages of ROS 1."""

    STORAGE_PLUGINS: Mapping[str, Any] = {
        "dir": BoundedFolderReader, ".mcap": BoundedMcapReader, ".db3": BoundedSqlite3Reader
    }  # fmt: skip

    @property
    def connections(self) -> list[Connection]:
        """Connections with the names of types of ROS 2."""
        return [one._replace(msgtype=normalize_msgtype(one.msgtype)) for one in super().connections]

    @property
    def is_cdr(self) -> bool:
        """False for messages of ROS 1."""
        formats = [cast(ConnectionExtRosbag2, one.ext).serialization_format for one in self.connections]
        return ROS2_NAMES["ros1"] not in formats


def list_fixed_fields(connection: Connection) -> tuple[tuple[str, str, int], ...]:
    """Return the name, the type and the number of elements of each field of a message, or nothing if undefined.

    Raises
    ------
    ValueError
        If a field has no fixed size.
    """
    definition = connection.msgdef
    if definition.format == MessageDefinitionFormat.NONE or not definition.data:
        return ()
    if definition.format == MessageDefinitionFormat.MSG:
        types = get_types_from_msg(definition.data, connection.msgtype)
    else:
        types = {}
        for idl in filter(None, IDL_HEADER.split(definition.data)):
            types |= get_types_from_idl(idl)
    fields = []
    for name, described in types[connection.msgtype][1]:
        node, description = cast(tuple[Nodetype, Any], described)
        (element, base), count = description if node == Nodetype.ARRAY else ((node, description), 0)
        if element != Nodetype.BASE or base[0] == "string":
            raise ValueError(f"the field {name} of {connection.msgtype} has no fixed size")
        fields.append((name, str(base[0]), int(count)))
    return tuple(fields)
