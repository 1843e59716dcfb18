"""History rows, which contain statistics of the results of a device over a period (time bucket).

A history row has columns such as ``gz.N``, ``gz.sigma.0.1`` and ``temperature`` (see ``minute_aggregation``). For each
column, the row contains the number of values, the minimum, the maximum and the last value. Merging rows preserves the
minimum and maximum exactly, because values are rounded to float32 before they are compared. The numbers of received,
lost, bad and overflowed samples are added when rows are merged.

To save space, the maximum and the last value are stored as bitwise differences (XOR) from the minimum. Most bytes of
the differences are zero, because values within a minute differ little. The bytes are grouped by significance and
compressed.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats, Ints
from drivers.errors import RecordingError

Singles = NDArray[np.float32]

STATES: Final = ("ended", "running", "waiting", "lost")
"""Device states, ordered from best to worst. A row contains the worst state that occurred."""
COUNTS: Final = ("received", "lost", "bad", "overflowed")
MAX_COLUMNS: Final = 4096
"""Maximum number of columns in a row. A typical device has about two hundred columns."""
_MAX_N: Final = 2**32 - 1


@dataclass(frozen=True, slots=True)
class HistoryRow:
    """Statistics of k columns over the time from ``start_s`` to ``start_s + width_s``."""

    start_s: int  # Unix time of the start, a multiple of ``width_s``
    width_s: int
    newest_s: float  # Unix time of the newest result in the row
    names: tuple[str, ...]  # [k]
    n: Ints  # [k] number of values
    low: Singles  # [k] minimum, SI units; NaN if there is no value
    high: Singles
    last: Singles
    counts: tuple[int, int, int, int] = (0, 0, 0, 0)  # increments of the counters in COUNTS
    state: int = 0  # index of the worst state in STATES

    @property
    def end_s(self) -> int:
        """Unix time at which the time bucket ends [s]."""
        return self.start_s + self.width_s


class RunningMinMaxLast:
    """Running statistics of each column: number of values, minimum, maximum and last value.

    >>> seen = RunningMinMaxLast(("a", "b"))
    >>> for numbers in ([1.0, 5.0], [3.0, np.nan], [2.0, 4.0]):
    ...     seen.add_value_per_column(np.array(numbers))
    >>> seen.count.tolist(), seen.minimum.tolist(), seen.maximum.tolist(), seen.last.tolist()
    ([3, 2], [1.0, 4.0], [3.0, 5.0], [2.0, 4.0])
    """

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names = names
        self.count: Ints = np.zeros(len(names), np.int64)
        self.minimum: Singles = np.full(len(names), np.nan, np.float32)
        self.maximum: Singles = self.minimum.copy()
        self.last: Singles = self.minimum.copy()

    def add_value_per_column(self, values: Floats) -> None:
        """Add one value per column ([k], SI units) to the statistics. NaN means a missing value."""
        with np.errstate(over="ignore"):
            single = values.astype(np.float32)
        there = ~np.isnan(single)
        self.count += there
        np.fmin(self.minimum, single, out=self.minimum)
        np.fmax(self.maximum, single, out=self.maximum)
        np.copyto(self.last, single, where=there)


def select_columns(row: HistoryRow, names: tuple[str, ...]) -> HistoryRow:
    """Return a copy of a row with selected columns.

    Parameters
    ----------
    row
        Row from which columns are selected.
    names
        Names of the selected columns, in the order of the result. Columns that the row does not have are filled with
        NaN.
    """
    if names == row.names:
        return row
    index = _column_indices(row.names, names)
    n = np.append(row.n, 0)[index]
    low, high, last = (np.append(part, np.float32(np.nan))[index] for part in (row.low, row.high, row.last))
    return HistoryRow(row.start_s, row.width_s, row.newest_s, names, n, low, high, last, row.counts, row.state)


@lru_cache(maxsize=64)
def _column_indices(names: tuple[str, ...], wanted: tuple[str, ...]) -> NDArray[np.int64]:
    at = {name: i for i, name in enumerate(names)}
    return np.array([at.get(name, -1) for name in wanted], np.int64)


def merge_rows(rows: Sequence[HistoryRow], start_s: int, width_s: int) -> HistoryRow:
    """Merge rows of successive periods into one row.

    Parameters
    ----------
    rows
        At least one row. The last value of a column is taken from the newest row that has a value.
    start_s
        Unix time at which the merged row begins [s].
    width_s
        Duration that the merged row covers [s].
    """
    rows = sorted(rows, key=lambda row: row.newest_s)
    names = rows[0].names
    if any(row.names is not names and row.names != names for row in rows):
        names = tuple(dict.fromkeys(name for row in rows for name in row.names))
        rows = [select_columns(row, names) for row in rows]
    n = np.stack([row.n for row in rows])
    newest = len(rows) - 1 - np.argmax(n[::-1] > 0, axis=0)  # without any value, every row contains NaN
    counts = tuple(sum(each) for each in zip(*(row.counts for row in rows), strict=True))
    return HistoryRow(
        start_s,
        width_s,
        rows[-1].newest_s,
        names,
        n.sum(axis=0),
        np.fmin.reduce([row.low for row in rows]),
        np.fmax.reduce([row.high for row in rows]),
        np.stack([row.last for row in rows])[newest, np.arange(len(names))],
        counts,
        max(row.state for row in rows),
    )


def pack_count_min_max_last(row: HistoryRow) -> bytes:
    """Return the statistics of a row as compressed bytes. The column names are not included."""
    low = row.low.view(np.uint32)
    n = np.minimum(row.n, _MAX_N).astype(np.uint32)
    words = np.stack([n, low, row.high.view(np.uint32) ^ low, row.last.view(np.uint32) ^ low]).astype("<u4")
    return zlib.compress(words.view(np.uint8).reshape(-1, 4).T.tobytes(), 6)


def unpack_count_min_max_last(data: bytes, column_count: int) -> tuple[Ints, Singles, Singles, Singles]:
    """Return the count, minimum, maximum and last value of each column from compressed bytes.

    Parameters
    ----------
    data
        Result of ``pack_count_min_max_last``.
    column_count
        Number of columns.

    Raises
    ------
    RecordingError
        If the bytes cannot be decompressed or do not contain ``column_count`` columns.
    """
    size = 16 * column_count
    try:
        raw = zlib.decompressobj().decompress(data, size + 1)
    except zlib.error as error:
        raise RecordingError(f"a row cannot be read: {error}") from error
    if len(raw) != size or column_count > MAX_COLUMNS:
        raise RecordingError(f"a row of {column_count} numbers has {len(raw)} bytes, not {size}")
    bytes_of = np.frombuffer(raw, np.uint8).reshape(4, -1).T
    words = np.ascontiguousarray(bytes_of).view("<u4").reshape(4, column_count).astype(np.uint32)
    low = words[1]
    return (
        words[0].astype(np.int64),
        low.view(np.float32),
        (words[2] ^ low).view(np.float32),
        (words[3] ^ low).view(np.float32),
    )
