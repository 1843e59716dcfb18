"""Reading and writing of Parquet and Arrow IPC files with pyarrow, which is an optional dependency.

The reader returns the complete batches of a truncated Arrow file. A truncated Parquet file cannot be read, because the
index is at the end of the file.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.data_types import Times
from drivers.errors import ConfigError, RecordingError
from drivers.host.extras import install_command
from drivers.host.safe_file_reading import open_regular_file
from drivers.recordings import memory_check, table
from drivers.recordings.file_formats.arrow_message_sizes import (
    check_batch_buffer_sizes,
    count_column_buffers,
    iter_batch_sizes,
)
from drivers.recordings.reading_options import ReadingOptions
from drivers.recordings.table_layout import find_layout

METADATA_KEY: Final = b"imu-monitor"
"""Key of the metadata that the daemon writes to the schema of a segment."""
SEGMENT_COLUMNS: Final = ("ticks", "lost")
"""Columns of a segment that are not measurements. The reader does not report these columns as unused."""
SLACK_BYTES: Final = 1 << 20
"""Number of bytes by which an unpacked buffer may exceed the size that its rows need."""
MAX_DICTIONARY_BYTES: Final = 64_000_000
MAX_INDEX_BYTES: Final = 10_000_000
"""Maximum size in bytes of the index of a Parquet file.

pyarrow needs about ten times as much memory to read the index.
"""
PARQUET_FOOTER: Final = b"\0\0\0\0PAR1"  # end of a file, with zeros as the length of the index
ARROW_MAGIC: Final = b"ARROW1\0\0"
ARROW_END: Final = b"\xff\xff\xff\xff\0\0\0\0"  # end-of-stream mark of an Arrow IPC stream


def import_pyarrow(path: Path) -> Any:
    """Import pyarrow.

    Raises
    ------
    ConfigError
        If pyarrow is not installed.
    """
    try:
        import pyarrow as pa
    except ImportError as error:
        whole = Path(str(path).removesuffix(table.PARTIAL_SUFFIX))
        raise ConfigError(f"{whole}: {whole.suffix} needs pyarrow: {install_command('imu-monitor[arrow]')}") from error
    return pa


def read_parquet(path: Path, options: ReadingOptions) -> table.Table:
    """Read the known columns of a Parquet file.

    Raises
    ------
    RecordingError
        If the file is truncated, is not a Parquet file, or exceeds a size limit.
    ConfigError
        If pyarrow is not installed, or the samples do not fit into memory.
    """
    notes: list[str] = []
    with _open_parquet(path) as file:
        chosen, units = _check_parquet(path, file, options, notes)
        return _build_table(path, file.read(columns=list(chosen.values())), chosen, units, notes)


def _check_parquet(
    path: Path, file: Any, options: ReadingOptions, notes: list[str]
) -> tuple[dict[str, str], dict[str, str]]:
    """Check the index of a Parquet file, and return the column name and the unit of each quantity."""
    metadata = file.metadata
    table.check_column_count(path, metadata.num_columns)
    chosen, units = _select_columns(path, file.schema_arrow.names, options, notes)
    _check_types(path, file.schema_arrow, chosen)
    stated = sum(metadata.row_group(i).num_rows for i in range(metadata.num_row_groups))
    memory_check.measure_read_limit(path).check_row_count(max(int(metadata.num_rows), stated))
    return chosen, units


def _select_columns(
    path: Path, names: Sequence[str], options: ReadingOptions, notes: list[str]
) -> tuple[dict[str, str], dict[str, str]]:
    """Return the column name and the unit of each quantity."""
    layout = find_layout(path, names, options, notes)
    return {quantity: names[i] for quantity, i in layout.columns.items()}, layout.units


@contextmanager
def _open_parquet(path: Path) -> Iterator[Any]:
    """Open a Parquet file, and convert errors of pyarrow to RecordingError."""
    pa = import_pyarrow(path)
    from pyarrow import parquet

    with open_regular_file(path) as file:
        size_bytes = os.fstat(file.fileno()).st_size
        file.seek(max(size_bytes - len(PARQUET_FOOTER), 0))
        index_bytes = int.from_bytes(file.read()[:4], "little")
        if MAX_INDEX_BYTES < index_bytes < size_bytes:
            raise RecordingError(
                f"{path}: the index of row groups and columns has {index_bytes} bytes, expected at most "
                f"{MAX_INDEX_BYTES}; write the file again with fewer columns or larger row groups"
            )
        file.seek(0)
        try:
            with parquet.ParquetFile(file) as opened:
                yield opened
        except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
            raise RecordingError(
                f"{path}: is no complete Parquet file ({first_message_line(error)}); its index is at the end, "
                f"so a file that is cut off cannot be read{table.describe_suffix_mismatch(path)}"
            ) from error


def read_ipc(path: Path, options: ReadingOptions) -> table.Table:
    """Read the known columns of an Arrow file or stream. If the file is truncated, only the complete batches are read.

    An Arrow file is read as a stream, because it consists of an Arrow stream between two magic strings.

    Raises
    ------
    RecordingError
        If the file is not an Arrow IPC file, or exceeds a size limit.
    ConfigError
        If pyarrow is not installed, or the samples do not fit into memory.
    """
    pa = import_pyarrow(path)
    notes: list[str] = []
    start = _ipc_start(path)
    with open_regular_file(path) as file:
        schema = _ipc_schema(path, file)
        own = METADATA_KEY in (schema.metadata or {})
        names = [name for name in schema.names if not (own and name in SEGMENT_COLUMNS)]
        chosen, units = _select_columns(path, names, options, notes)
        count = _check_ipc(path, start, schema, chosen)
        if not _has_end_mark(path, start > 0):
            notes.append("The file has no end mark; it is cut off and was read up to the cut.")
        file.seek(start)
        batches: list[Any] = []
        try:
            used = [schema.get_field_index(key) for key in chosen.values()]
            reader = pa.ipc.open_stream(file, options=pa.ipc.IpcReadOptions(included_fields=sorted(used)))
            while len(batches) < count:
                batch = reader.read_next_batch()
                batch.validate()
                batches.append(batch)
        except StopIteration:
            notes.append(f"Only {len(batches)} of {count} batches could be read: the stream ends before them.")
        except (pa.ArrowException, OSError) as error:
            notes.append(f"Only {len(batches)} complete batches could be read: {first_message_line(error)}.")
    schema = batches[0].schema if batches else schema
    return _build_table(path, pa.Table.from_batches(batches, schema), chosen, units, notes)


def _ipc_start(path: Path) -> int:
    """Return the offset in bytes of the Arrow stream in a file."""
    with open_regular_file(path) as file:
        return len(ARROW_MAGIC) if file.read(len(ARROW_MAGIC)) == ARROW_MAGIC else 0


def _has_end_mark(path: Path, is_file: bool) -> bool:
    """Return True if an Arrow file or stream ends with an end mark and is therefore complete."""
    mark = ARROW_MAGIC.rstrip(b"\0") if is_file else ARROW_END
    with open_regular_file(path) as file:
        file.seek(max(path.stat().st_size - len(mark), 0))
        return file.read() == mark


def _ipc_schema(path: Path, file: Any) -> Any:
    """Return the Arrow schema of an open file. Raise RecordingError if the file is not an Arrow IPC file."""
    pa = import_pyarrow(path)
    try:
        file.seek(_ipc_start(path))
        schema = pa.ipc.open_stream(file).schema
        table.check_column_count(path, len(schema))
        schema.names, schema.metadata  # noqa: B018 - raises an exception for names that are not UTF-8
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise RecordingError(
            f"{path}: is no Arrow IPC file or stream ({first_message_line(error)})"
            f"{table.describe_suffix_mismatch(path)}"
        ) from error
    return schema


def _check_ipc(path: Path, start: int, schema: Any, chosen: Mapping[str, str]) -> int:
    """Check the sizes of the batches of an Arrow file or stream, and return the number of complete batches."""
    pa = import_pyarrow(path)
    _check_types(path, schema, chosen)
    counts = [
        count if count is None or field.name in chosen.values() else -count
        for field in schema
        for count in (count_column_buffers(pa, field.type),)
    ]
    limit = memory_check.measure_read_limit(path)
    batches = rows = dictionaries = 0
    with open_regular_file(path) as file:
        for size in iter_batch_sizes(file, start):
            if size.dictionary:
                dictionaries += sum(size.buffers)
                if dictionaries > MAX_DICTIONARY_BYTES:
                    raise RecordingError(
                        f"{path}: its dictionaries unpack to {dictionaries} bytes, expected at most "
                        f"{MAX_DICTIONARY_BYTES}; leave out the columns that are not numeric"
                    )
                continue
            batches, rows = batches + 1, rows + size.rows
            limit.check_row_count(rows)
            if wrong := check_batch_buffer_sizes(size, counts, SLACK_BYTES):
                raise RecordingError(f"{path}: batch {batches} is damaged: {wrong}")
    return batches


def _check_types(path: Path, schema: Any, chosen: Mapping[str, str]) -> None:
    pa = import_pyarrow(path)
    numeric = (pa.types.is_floating, pa.types.is_integer, pa.types.is_null)
    for key in chosen.values():
        type_ = schema.field(key).type
        if not any(is_type(type_) for is_type in numeric):
            unit = "; t is in seconds" if key == "t" else ""
            raise RecordingError(f"{path}: {key} contains {type_}, expected numbers{unit}")


def _build_table(
    path: Path, data: Any, chosen: Mapping[str, str], units: Mapping[str, str], notes: list[str]
) -> table.Table:
    """Return the chosen columns of a pyarrow table. Null values become NaN, or NO_TIME_NS in integer times."""
    pa = import_pyarrow(path)
    columns: dict[str, Times] = {}
    for name, key in chosen.items():
        column = data.column(key)
        if name == "t" and pa.types.is_integer(column.type):
            # The largest int64 or uint64 number is not a possible time and is treated as a missing time.
            whole = column if pa.types.is_uint64(column.type) else column.cast(pa.int64())
            missing = int(np.iinfo(whole.type.to_pandas_dtype()).max)
            columns[name] = table.to_column(name, whole.fill_null(missing).to_numpy())
        else:
            columns[name] = np.asarray(column.cast(pa.float64(), safe=False).to_numpy(), np.float64)
    return table.Table(columns, None, notes, units, chosen)


def first_message_line(error: Exception) -> str:
    """Return the first line of an exception's message without the final full stop."""
    return str(error).strip().partition("\n")[0].rstrip(".")


@contextmanager
def open_parquet_writer(path: Path, names: Sequence[str]) -> Iterator[table.AppendColumns]:
    """Open a Parquet file for writing. Each call of the yielded function appends one row group."""
    pa = import_pyarrow(path)
    from pyarrow import parquet

    schema = _column_schema(pa, names)
    with parquet.ParquetWriter(path, schema) as file:
        yield lambda columns: file.write_table(pa.table(dict(columns), schema))


@contextmanager
def open_ipc_writer(path: Path, names: Sequence[str], stream: bool = False) -> Iterator[table.AppendColumns]:
    """Open an Arrow file (Feather version 2) for writing, or an Arrow stream if ``stream`` is True."""
    pa = import_pyarrow(path)
    schema = _column_schema(pa, names)
    with (pa.ipc.new_stream if stream else pa.ipc.new_file)(str(path), schema) as file:
        yield lambda columns: file.write_table(pa.table(dict(columns), schema), max_chunksize=table.BATCH_ROWS)


def _column_schema(pa: Any, names: Sequence[str]) -> Any:
    return pa.schema([(name, pa.from_numpy_dtype(table.column_dtype(name))) for name in names])
