"""Reading and writing of Parquet and Arrow IPC. pyarrow is optional and imported when a file needs it.

An Arrow file is read batch by batch up to a truncation. A truncated Parquet file cannot be read, since its index is at
the end. Before data are read, the stated numbers of rows and the types of the columns are checked against the limits
of ``drivers.recordings.memory_check``.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.errors import ConfigError, RecordingError
from drivers.file_access import open_regular
from drivers.recordings import memory_check
from drivers.recordings.arrow_messages import batch_sizes, buffer_count, check_buffers
from drivers.recordings.table import (
    BATCH_ROWS,
    PARTIAL_SUFFIX,
    Append,
    Table,
    check_width,
    choose_columns,
    describe_content,
)
from drivers.sample import Floats

METADATA_KEY: Final = b"imu-monitor"
"""Key of the schema metadata that identifies a segment recorded by the daemon."""
SEGMENT_COLUMNS: Final = ("ticks", "lost")
"""Columns of such a segment that are not measurements. A reader does not report them as unused."""
SLACK_BYTES: Final = 1 << 20
"""Allowed size of a compressed buffer in addition to the size that its rows need."""
MAX_DICTIONARY_BYTES: Final = 64_000_000
MAX_INDEX_BYTES: Final = 10_000_000
"""Maximum size of the index of a Parquet file. pyarrow needs about ten times as much memory for it."""
PARQUET_FOOTER: Final = b"\0\0\0\0PAR1"  # after the index; the zeros are replaced by its length
ARROW_MAGIC: Final = b"ARROW1\0\0"
ARROW_END: Final = b"\xff\xff\xff\xff\0\0\0\0"  # end-of-stream mark of Arrow IPC


def import_pyarrow(path: Path) -> Any:
    """Import pyarrow.

    Raises
    ------
    ConfigError
        pyarrow is not installed. The text names ``path`` as the file that cannot be read or written.
    """
    try:
        import pyarrow as pa
    except ImportError as error:
        whole = Path(str(path).removesuffix(PARTIAL_SUFFIX))
        raise ConfigError(f'{whole}: {whole.suffix} needs pyarrow: pip install "imu-monitor[arrow]"') from error
    return pa


def count_rows_parquet(path: Path) -> int:
    """Return the number of rows that the index states.

    Raises
    ------
    RecordingError, ConfigError
        As for ``read_parquet``.
    """
    with _parquet(path) as file:
        return _checked_parquet(path, file, [])[1]


def read_parquet(path: Path) -> Table:
    """Read the known columns of a Parquet file.

    Raises
    ------
    RecordingError
        The file is not complete, is not Parquet, or exceeds a limit.
    ConfigError
        pyarrow is not installed, or the samples do not fit into the memory.
    """
    notes: list[str] = []
    with _parquet(path) as file:
        chosen, _ = _checked_parquet(path, file, notes)
        return _table(path, file.read(columns=list(chosen.values())), chosen, notes)


@contextmanager
def _parquet(path: Path) -> Iterator[Any]:
    """Open a Parquet file. Within the context, pyarrow's errors are raised as RecordingError."""
    pa = import_pyarrow(path)
    from pyarrow import parquet

    with open_regular(path) as file:
        size_bytes = os.fstat(file.fileno()).st_size
        file.seek(max(size_bytes - len(PARQUET_FOOTER), 0))
        index_bytes = int.from_bytes(file.read()[:4], "little")
        if MAX_INDEX_BYTES < index_bytes < size_bytes:
            raise RecordingError(
                f"{path}: its index of row groups and columns has {index_bytes} bytes, expected at most "
                f"{MAX_INDEX_BYTES}; write it again with fewer columns or larger row groups"
            )
        file.seek(0)
        try:
            with parquet.ParquetFile(file) as opened:
                yield opened
        except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
            raise RecordingError(
                f"{path}: is no whole Parquet file ({_first_line(error)}); its index stands at the end, "
                f"so one that is cut off cannot be read{describe_content(path)}"
            ) from error


def _checked_parquet(path: Path, file: Any, notes: list[str]) -> tuple[dict[str, str], int]:
    """Return the columns to read and the number of rows, after checking both against the limits."""
    check_width(path, file.metadata.num_columns)
    schema = file.schema_arrow
    chosen = choose_columns(path, schema.names, notes)
    _check_types(path, schema, chosen)
    rows = int(file.metadata.num_rows)
    stated = sum(file.metadata.row_group(i).num_rows for i in range(file.metadata.num_row_groups))
    memory_check.read_limit(path).check_rows(max(rows, stated))
    return chosen, rows


def count_rows_ipc(path: Path) -> int:
    """Return the number of rows of all batches up to a truncation.

    Raises
    ------
    RecordingError, ConfigError
        As for ``read_ipc``.
    """
    with open_regular(path) as file:
        return _checked_ipc(path, _ipc_start(path), _ipc_schema(path, file), {})[1]


def read_ipc(path: Path) -> Table:
    """Read Arrow IPC up to a truncation. A file is a stream after a magic word, so both are read as streams.

    Raises
    ------
    RecordingError
        The file is not Arrow IPC, or it exceeds a limit.
    ConfigError
        pyarrow is not installed, or the samples do not fit into the memory.
    """
    pa = import_pyarrow(path)
    notes: list[str] = []
    start = _ipc_start(path)
    with open_regular(path) as file:
        schema = _ipc_schema(path, file)
        own = METADATA_KEY in (schema.metadata or {})
        chosen = choose_columns(path, [name for name in schema.names if not (own and name in SEGMENT_COLUMNS)], notes)
        count, _ = _checked_ipc(path, start, schema, chosen)
        if not _has_end_mark(path, start > 0):
            notes.append("The end mark is missing: the file is cut off and was read up to the cut.")
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
            pass  # the regular end
        except (pa.ArrowException, OSError) as error:
            notes.append(f"Only {len(batches)} whole batches could be read: {_first_line(error)}.")
    schema = batches[0].schema if batches else schema
    return _table(path, pa.Table.from_batches(batches, schema), chosen, notes)


def _ipc_start(path: Path) -> int:
    """Return the offset of the stream, which is after the magic word of a file."""
    with open_regular(path) as file:
        return len(ARROW_MAGIC) if file.read(len(ARROW_MAGIC)) == ARROW_MAGIC else 0


def _has_end_mark(path: Path, is_file: bool) -> bool:
    """Return True if the file ends with the end mark of its format."""
    mark = ARROW_MAGIC.rstrip(b"\0") if is_file else ARROW_END
    with open_regular(path) as file:
        file.seek(max(path.stat().st_size - len(mark), 0))
        return file.read() == mark


def _ipc_schema(path: Path, file: Any) -> Any:
    """Return the schema of the stream in an open file. Raise RecordingError if there is none."""
    pa = import_pyarrow(path)
    try:
        file.seek(_ipc_start(path))
        schema = pa.ipc.open_stream(file).schema
        check_width(path, len(schema))
        schema.names, schema.metadata  # noqa: B018 - raises for names that are not UTF-8
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise RecordingError(
            f"{path}: is no Arrow IPC file or stream ({_first_line(error)}){describe_content(path)}"
        ) from error
    return schema


def _checked_ipc(path: Path, start: int, schema: Any, chosen: Mapping[str, str]) -> tuple[int, int]:
    """Return the number of record batches and of rows, after checking them and the column types against the limits."""
    pa = import_pyarrow(path)
    _check_types(path, schema, chosen)
    counts = [
        count if count is None or field.name in chosen.values() else -count
        for field in schema
        for count in (buffer_count(pa, field.type),)
    ]
    limit = memory_check.read_limit(path)
    batches = rows = dictionaries = 0
    with open_regular(path) as file:
        for size in batch_sizes(file, start):
            if size.dictionary:
                dictionaries += sum(size.buffers)
                if dictionaries > MAX_DICTIONARY_BYTES:
                    raise RecordingError(
                        f"{path}: its dictionaries unpack to {dictionaries} bytes, expected at most "
                        f"{MAX_DICTIONARY_BYTES}; leave out the columns that are no numbers"
                    )
                continue
            batches, rows = batches + 1, rows + size.rows
            limit.check_rows(rows)
            if wrong := check_buffers(size, counts, SLACK_BYTES):
                raise RecordingError(f"{path}: batch {batches} is no regular one: {wrong}")
    return batches, rows


def _check_types(path: Path, schema: Any, chosen: Mapping[str, str]) -> None:
    """Raise RecordingError if a column is not numeric."""
    pa = import_pyarrow(path)
    numeric = (pa.types.is_floating, pa.types.is_integer, pa.types.is_null)
    for key in chosen.values():
        type_ = schema.field(key).type
        if not any(is_type(type_) for is_type in numeric):
            unit = "; t is in seconds" if key == "t" else ""
            raise RecordingError(f"{path}: {key} holds {type_}, not numbers{unit}")


def _table(path: Path, table: Any, chosen: Mapping[str, str], notes: list[str]) -> Table:
    """Return the chosen columns as a ``Table``."""
    columns = {name: _column(path, table.column(key)) for name, key in chosen.items()}
    return Table(columns, None, notes)


def _column(path: Path, column: Any) -> Floats:
    """Return one column as float64, with null as NaN."""
    pa = import_pyarrow(path)
    return np.asarray(column.cast(pa.float64(), safe=False).to_numpy(), dtype=np.float64)


def _first_line(error: Exception) -> str:
    """Return the first line of the text of an error."""
    return str(error).strip().partition("\n")[0].rstrip(".")


@contextmanager
def parquet_writer(path: Path, names: Sequence[str]) -> Iterator[Append]:
    """Write Parquet with its default compression.

    Parameters
    ----------
    path
        File to write.
    names
        Names of the columns.

    Yields
    ------
    Append
        Function that appends rows. Each call writes one row group.
    """
    pa = import_pyarrow(path)
    from pyarrow import parquet

    schema = _schema(pa, names)
    with parquet.ParquetWriter(path, schema) as file:
        yield lambda columns: file.write_table(pa.table(dict(columns), schema))


def ipc_file_writer(path: Path, names: Sequence[str]) -> AbstractContextManager[Append]:
    """Write an Arrow file (Feather version 2).

    Parameters
    ----------
    path
        File to write.
    names
        Names of the columns.
    """
    return _ipc_writer(import_pyarrow(path).ipc.new_file, path, names)


def ipc_stream_writer(path: Path, names: Sequence[str]) -> AbstractContextManager[Append]:
    """Write an Arrow stream.

    Parameters
    ----------
    path
        File to write.
    names
        Names of the columns.
    """
    return _ipc_writer(import_pyarrow(path).ipc.new_stream, path, names)


@contextmanager
def _ipc_writer(new: Any, path: Path, names: Sequence[str]) -> Iterator[Append]:
    """Write Arrow IPC with the pyarrow writer that ``new`` opens."""
    pa = import_pyarrow(path)
    schema = _schema(pa, names)
    with new(str(path), schema) as file:
        yield lambda columns: file.write_table(pa.table(dict(columns), schema), max_chunksize=BATCH_ROWS)


def _schema(pa: Any, names: Sequence[str]) -> Any:
    """Return a schema of float64 columns."""
    return pa.schema([(name, pa.float64()) for name in names])
