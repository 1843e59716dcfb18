"""Parquet and Arrow IPC. pyarrow is an optional library: imported when a file asks for it.

An Arrow file is read up to a cut, batch by batch; Parquet cannot be, since its index stands at the end.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.errors import ConfigError, RecordingError
from drivers.recording.table import BATCH_ROWS, PART, Append, Table, chosen_columns
from drivers.sample import Floats
from drivers.small_file import open_regular

OWN: Final = b"imu-monitor"
"""Key of the metadata by which a segment of the daemon's recordings is known."""
BOOKKEEPING: Final = ("ticks", "lost")
"""Columns of such a segment that are no measurement: a reader is not told that they were left aside."""
ROWS_ANYWAY: Final = 1_000_000
ROWS_A_BYTE: Final = 8
"""Of measured values not even one fits in a byte."""
ARROW_MAGIC: Final = b"ARROW1\0\0"
ARROW_END: Final = b"\xff\xff\xff\xff\0\0\0\0"  # end-of-stream mark of Arrow IPC


def library(path: Path) -> Any:
    """pyarrow. ConfigError where it is not installed: ``path`` cannot be read or written."""
    try:
        import pyarrow as pa
    except ImportError as error:
        whole = Path(str(path).removesuffix(PART))
        raise ConfigError(f'{whole}: {whole.suffix} needs pyarrow: pip install "imu-monitor[arrow]"') from error
    return pa


def read_parquet(path: Path) -> Table:
    """Only the columns that mean something are read; RecordingError when the file is not whole."""
    pa = library(path)
    from pyarrow import parquet

    notes: list[str] = []
    opened = open_regular(path)
    try:
        with opened, parquet.ParquetFile(opened) as file:
            chosen = chosen_columns(path, file.schema_arrow.names, notes)
            _check_rows(path, file.metadata.num_rows, os.fstat(opened.fileno()).st_size)
            table = file.read(columns=list(chosen.values()))
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise RecordingError(
            f"{path}: is no whole Parquet file ({_first_line(error)}); its index stands at the end, "
            "so one that is cut off cannot be read"
        ) from error
    return _table(path, table, chosen, notes)


def read_ipc(path: Path) -> Table:
    """Arrow IPC up to a cut. A file is a stream after one magic word, so both are read as streams."""
    pa = library(path)
    notes: list[str] = []
    with open_regular(path) as file:
        data = file.read()
    is_file = data.startswith(ARROW_MAGIC)
    try:
        reader = pa.ipc.open_stream(pa.py_buffer(data).slice(len(ARROW_MAGIC) if is_file else 0))
        own = OWN in (reader.schema.metadata or {})
        names = [name for name in reader.schema.names if not (own and name in BOOKKEEPING)]
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: is no Arrow IPC file or stream ({_first_line(error)})") from error
    chosen = chosen_columns(path, names, notes)
    if not data.endswith(ARROW_MAGIC.rstrip(b"\0") if is_file else ARROW_END):
        notes.append("The end mark is missing: the file is cut off and was read up to the cut.")
    batches: list[Any] = []
    try:
        while True:
            batch = reader.read_next_batch()
            _check_rows(path, batch.num_rows, len(data))
            batch.select(list(chosen.values())).validate()
            batches.append(batch)
    except StopIteration:
        pass  # the regular end
    except (pa.ArrowException, OSError) as error:
        notes.append(f"Only {len(batches)} whole batches could be read: {_first_line(error)}.")
    return _table(path, pa.Table.from_batches(batches, reader.schema), chosen, notes)


def _check_rows(path: Path, rows: int, size: int) -> None:
    """No row costs nothing: a file that says otherwise would fill the memory with what it does not hold."""
    if rows > ROWS_ANYWAY + ROWS_A_BYTE * size:
        raise RecordingError(f"{path}: {rows} rows in {size} bytes: no recording is so small")


def _table(path: Path, table: Any, chosen: Mapping[str, str], notes: list[str]) -> Table:
    columns = {name: _column(path, key, table.column(key)) for name, key in chosen.items()}
    return Table(columns, None, notes)


def _column(path: Path, key: str, column: Any) -> Floats:
    """One column as float64, null as NaN."""
    pa = library(path)
    numeric = (pa.types.is_floating, pa.types.is_integer, pa.types.is_null)
    if not any(is_type(column.type) for is_type in numeric):
        unit = "; t is in seconds" if key == "t" else ""
        raise RecordingError(f"{path}: {key} holds {column.type}, not numbers{unit}")
    return np.asarray(column.cast(pa.float64(), safe=False).to_numpy(), dtype=np.float64)


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0].rstrip(".")


@contextmanager
def parquet_writer(path: Path, names: Sequence[str]) -> Iterator[Append]:
    """Write with Parquet's default compression; what is appended at once is one row group."""
    pa = library(path)
    from pyarrow import parquet

    schema = _schema(pa, names)
    with parquet.ParquetWriter(path, schema) as file:
        yield lambda columns: file.write_table(pa.table(dict(columns), schema))


def ipc_file_writer(path: Path, names: Sequence[str]) -> AbstractContextManager[Append]:
    """Write an Arrow file (Feather version 2)."""
    return _ipc_writer(library(path).ipc.new_file, path, names)


def ipc_stream_writer(path: Path, names: Sequence[str]) -> AbstractContextManager[Append]:
    """Write an Arrow stream."""
    return _ipc_writer(library(path).ipc.new_stream, path, names)


@contextmanager
def _ipc_writer(new: Any, path: Path, names: Sequence[str]) -> Iterator[Append]:
    pa = library(path)
    schema = _schema(pa, names)
    with new(str(path), schema) as file:
        yield lambda columns: file.write_table(pa.table(dict(columns), schema), max_chunksize=BATCH_ROWS)


def _schema(pa: Any, names: Sequence[str]) -> Any:
    return pa.schema([(name, pa.float64()) for name in names])
