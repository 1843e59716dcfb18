"""Reader of the sizes that are stated in the message headers of an Arrow IPC stream.

pyarrow allocates the stated sizes without a limit, so a damaged file could exhaust the memory. ``iter_batch_sizes``
reads the stated sizes without unpacking data, so that a file can be rejected before pyarrow reads it.

Sources: Arrow columnar format, https://arrow.apache.org/docs/format ("Encapsulated message format", "Compression",
Message.fbs), and FlatBuffers internals.
"""

import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import IO, Any, Final

CONTINUATION: Final = 0xFFFFFFFF
MAX_METADATA_BYTES: Final = 64_000_000
"""Maximum size of the metadata of one message. A schema with 10 000 columns takes about 2 MB."""
SCHEMA: Final = 1  # values of the Arrow enumeration MessageHeader
DICTIONARY_BATCH: Final = 2
RECORD_BATCH: Final = 3
MESSAGE_HEADER_TYPE: Final = 1  # field numbers of the Arrow table Message
MESSAGE_HEADER: Final = 2
MESSAGE_BODY_LENGTH: Final = 3
BATCH_LENGTH: Final = 0  # field numbers of the Arrow table RecordBatch
BATCH_BUFFERS: Final = 2
BATCH_COMPRESSION: Final = 3
DICTIONARY_DATA: Final = 1  # field number of the Arrow table DictionaryBatch
BUFFER: Final = struct.Struct("<qq")  # offset in the message body, and length


@dataclass(frozen=True, slots=True)
class StatedBatchSize:
    """Size of one record batch or dictionary batch according to the message header."""

    rows: int
    body_bytes: int  # size in the file in bytes
    buffers: tuple[int, ...]  # unpacked size of each buffer in bytes
    dictionary: bool  # True for a dictionary batch


def iter_batch_sizes(file: IO[bytes], start: int = 0) -> Iterator[StatedBatchSize]:
    """Yield the stated size of each batch in an Arrow stream. Stop at a truncated or damaged message.

    Parameters
    ----------
    file
        Seekable binary file.
    start
        Offset of the stream in the file, in bytes.
    """
    end = file.seek(0, os.SEEK_END)
    at = start
    while at + 8 <= end:
        file.seek(at)
        mark, size = struct.unpack("<II", file.read(8))
        at += 8
        if mark != CONTINUATION:  # versions before Arrow 0.15 do not write the continuation mark
            size, at = mark, at - 4
        if not 0 < size <= MAX_METADATA_BYTES or at + size > end:
            return
        file.seek(at)
        metadata = file.read(size)
        body = at + size
        try:
            message = _FlatbufferTable.parse_root(metadata)
            kind = message.read_number(MESSAGE_HEADER_TYPE, "B")
            body_bytes = message.read_number(MESSAGE_BODY_LENGTH, "q")
            if body_bytes < 0:
                return
            if kind in (RECORD_BATCH, DICTIONARY_BATCH):
                batch = message.read_subtable(MESSAGE_HEADER)
                batch = batch.read_subtable(DICTIONARY_DATA) if kind == DICTIONARY_BATCH else batch
                yield _read_batch_size(file, batch, body, body_bytes, kind == DICTIONARY_BATCH)
            elif kind != SCHEMA:
                return
        except (struct.error, LookupError):
            return
        at = body + body_bytes


def check_batch_buffer_sizes(size: StatedBatchSize, buffer_counts: Sequence[int | None], slack_bytes: int) -> str:
    """Check that no numeric column unpacks to more bytes than the rows of a batch require.

    Parameters
    ----------
    size
        Stated size of the batch.
    buffer_counts
        Number of buffers of each column in schema order. The number is negative for a column that is not read. If the
        number is unknown (None), all remaining buffers of the batch are checked.
    slack_bytes
        Allowed size in addition to eight bytes per row.

    Returns
    -------
    str
        Description of the problem, or an empty string if all buffers are small enough.
    """
    most = 8 * size.rows + slack_bytes
    at = 0
    for count in buffer_counts:
        n = len(size.buffers) - at if count is None else abs(count)
        used = count is None or count > 0
        large = max(size.buffers[at : at + n], default=0) if used else 0
        if large > most:
            return f"a buffer of {size.rows} rows unpacks to {large} bytes, expected at most {most}"
        at += n
        if count is None:
            break
    return ""


def count_column_buffers(pa: Any, type_: Any) -> int | None:
    """Return the number of Arrow buffers of a column.

    Parameters
    ----------
    pa
        The module pyarrow.
    type_
        pyarrow type of the column.

    Returns
    -------
    int or None
        Number of buffers. None for nested types and view types, which have a variable number of buffers.
    """
    types = pa.types
    if types.is_null(type_):
        return 0
    if types.is_nested(type_) or types.is_run_end_encoded(type_) or isinstance(type_, pa.BaseExtensionType):
        return None
    if types.is_string_view(type_) or types.is_binary_view(type_):
        return None
    variable = (types.is_string, types.is_large_string, types.is_binary, types.is_large_binary)
    return 3 if any(is_type(type_) for is_type in variable) else 2


def _read_batch_size(
    file: IO[bytes], batch: "_FlatbufferTable", body: int, body_bytes: int, dictionary: bool
) -> StatedBatchSize:
    """Return the stated size of a batch. ``body`` is the offset of the message body in the file."""
    rows = batch.read_number(BATCH_LENGTH, "q")
    packed = batch.has_field(BATCH_COMPRESSION)
    sizes = []
    for offset, length in batch.read_struct_vector(BATCH_BUFFERS, BUFFER):
        unpacked = length
        if packed and length >= 8 and 0 <= offset <= body_bytes - 8:
            file.seek(body + offset)
            (stated,) = struct.unpack("<q", file.read(8))
            unpacked = length if stated == -1 else stated  # -1: stored without compression
        sizes.append(max(unpacked, 0))
    return StatedBatchSize(max(rows, 0), body_bytes, tuple(sizes), dictionary)


@dataclass(frozen=True, slots=True)
class _FlatbufferTable:
    """FlatBuffers table. The methods raise struct.error or LookupError if an offset points outside the buffer."""

    data: bytes
    at: int

    @classmethod
    def parse_root(cls, data: bytes) -> "_FlatbufferTable":
        return cls(data, struct.unpack_from("<I", data)[0])

    def has_field(self, field: int) -> bool:
        return self._field(field) != 0

    def read_number(self, field: int, number_format: str) -> int:
        """Return a number of the ``struct`` format ``number_format``, or 0 if the field is absent."""
        at = self._field(field)
        return int(_unpack_number(f"<{number_format}", self.data, at)) if at else 0

    def read_subtable(self, field: int) -> "_FlatbufferTable":
        """Return the nested table in a field."""
        at = self._field(field)
        if not at:
            raise LookupError(field)
        return _FlatbufferTable(self.data, at + _unpack_number("<I", self.data, at))

    def read_struct_vector(self, field: int, layout: struct.Struct) -> Iterator[tuple[Any, ...]]:
        """Iterate over the structs in a vector field. An absent field counts as an empty vector."""
        at = self._field(field)
        if not at:
            return iter(())
        at += _unpack_number("<I", self.data, at)
        count = _unpack_number("<I", self.data, at)
        if count * layout.size > len(self.data):
            raise LookupError(field)
        return layout.iter_unpack(self.data[at + 4 : at + 4 + count * layout.size])

    def _field(self, field: int) -> int:
        """Return the offset of a field in the buffer, or 0 if the field is absent."""
        entries = self.at - _unpack_number("<i", self.data, self.at)
        entry = 4 + 2 * field
        if entries < 0 or entry >= _unpack_number("<H", self.data, entries):
            return 0
        offset = _unpack_number("<H", self.data, entries + entry)
        return self.at + offset if offset else 0


def _unpack_number(number_format: str, data: bytes, at: int) -> int:
    if at < 0:
        raise LookupError(at)
    return int(struct.unpack_from(number_format, data, at)[0])
