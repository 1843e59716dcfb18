"""One row of history: what a device's results were within one bucket of time, and how several become one.

Of each number (``gz.N``, ``gz.sigma.0.1``, ``temperature``: see ``numbers``) a row has how often it was there, its
lowest, highest and last value. Lowest of lowests is the lowest of all: extremes survive any number of merges exactly.
Counts (samples received, lost, bad, overflowed) are increments and add up. Values are kept to seven digits (float32),
rounded once, before anything is compared; rounding keeps the order, so nothing is lost by merging later. Pure.

Packed, a row's extremes are kept as differences of their bits from the lowest, bytes of one significance together,
compressed: values of a minute differ little, and most of it is zeros.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import RecordingError
from drivers.sample import Floats, Ints

Singles = NDArray[np.float32]

STATES: Final = ("ended", "running", "waiting", "lost")
"""From good to bad: a row has the worst of its bucket."""
COUNTS: Final = ("received", "lost", "bad", "overflowed")
NUMBERS_AT_MOST: Final = 4096
"""In a row; a device has about two hundred."""
_N_LIMIT: Final = 2**32 - 1


@dataclass(frozen=True, slots=True)
class Row:
    """A bucket of ``width_s`` from ``start_s`` on; k numbers."""

    start_s: int  # Unix time, a multiple of width_s
    width_s: int
    newest_s: float  # Unix time of the newest result in it
    names: tuple[str, ...]  # [k]
    n: Ints  # [k] how often each was there
    low: Singles  # [k] SI; NaN where it never was
    high: Singles
    last: Singles
    counts: tuple[int, int, int, int] = (0, 0, 0, 0)  # of COUNTS, within the bucket
    state: int = 0  # index of the worst of STATES

    @property
    def end_s(self) -> int:
        """Where the next bucket begins."""
        return self.start_s + self.width_s


class Extremes:
    """How often, lowest, highest and last of k numbers that come again and again.

    >>> seen = Extremes(("a", "b"))
    >>> for numbers in ([1.0, 5.0], [3.0, np.nan], [2.0, 4.0]):
    ...     seen.add(np.array(numbers))
    >>> seen.n.tolist(), seen.low.tolist(), seen.high.tolist(), seen.last.tolist()
    ([3, 2], [1.0, 4.0], [3.0, 5.0], [2.0, 4.0])
    """

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names = names
        self.n: Ints = np.zeros(len(names), np.int64)
        self.low: Singles = np.full(len(names), np.nan, np.float32)
        self.high: Singles = self.low.copy()
        self.last: Singles = self.low.copy()

    def add(self, numbers: Floats) -> None:
        """One look, [k]; NaN = not there."""
        with np.errstate(over="ignore"):
            single = numbers.astype(np.float32)
        there = ~np.isnan(single)
        self.n += there
        np.fmin(self.low, single, out=self.low)
        np.fmax(self.high, single, out=self.high)
        np.copyto(self.last, single, where=there)


def joined(
    start_s: int,
    width_s: int,
    newest_s: float,
    parts: Sequence[Extremes],
    counts: tuple[int, int, int, int],
    state: int,
) -> Row:
    """One row of several sources of numbers."""
    return Row(
        start_s,
        width_s,
        newest_s,
        tuple(name for part in parts for name in part.names),
        np.concatenate([part.n for part in parts]),
        np.concatenate([part.low for part in parts]),
        np.concatenate([part.high for part in parts]),
        np.concatenate([part.last for part in parts]),
        counts,
        state,
    )


def chosen(row: Row, names: tuple[str, ...]) -> Row:
    """The same with these numbers, in this order; those that it has not are missing."""
    if names == row.names:
        return row
    index = _places(row.names, names)
    n = np.append(row.n, 0)[index]
    low, high, last = (np.append(part, np.float32(np.nan))[index] for part in (row.low, row.high, row.last))
    return Row(row.start_s, row.width_s, row.newest_s, names, n, low, high, last, row.counts, row.state)


@lru_cache(maxsize=64)
def _places(names: tuple[str, ...], wanted: tuple[str, ...]) -> NDArray[np.int64]:
    """Where each wanted name stands; -1 = nowhere."""
    at = {name: i for i, name in enumerate(names)}
    return np.array([at.get(name, -1) for name in wanted], np.int64)


def merged(rows: Sequence[Row], start_s: int, width_s: int) -> Row:
    """One row of several, one at least; the last value of a number is that of the newest row that has it."""
    rows = sorted(rows, key=lambda row: row.newest_s)
    names = rows[0].names
    if any(row.names is not names and row.names != names for row in rows):
        names = tuple(dict.fromkeys(name for row in rows for name in row.names))
        rows = [chosen(row, names) for row in rows]
    n = np.stack([row.n for row in rows])
    newest = len(rows) - 1 - np.argmax(n[::-1] > 0, axis=0)  # never there: any row, its NaN
    counts = tuple(sum(each) for each in zip(*(row.counts for row in rows), strict=True))
    return Row(
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


def pack(row: Row) -> bytes:
    """The numbers of a row, without their names."""
    low = row.low.view(np.uint32)
    n = np.minimum(row.n, _N_LIMIT).astype(np.uint32)
    words = np.stack([n, low, row.high.view(np.uint32) ^ low, row.last.view(np.uint32) ^ low]).astype("<u4")
    return zlib.compress(words.view(np.uint8).reshape(-1, 4).T.tobytes(), 6)


def unpack(data: bytes, count: int) -> tuple[Ints, Singles, Singles, Singles]:
    """n, low, high and last of ``count`` numbers.

    Raises:
        RecordingError: what was read is not what was packed
    """
    size = 16 * count
    try:
        raw = zlib.decompressobj().decompress(data, size + 1)
    except zlib.error as error:
        raise RecordingError(f"a row cannot be read: {error}") from error
    if len(raw) != size or count > NUMBERS_AT_MOST:
        raise RecordingError(f"a row of {count} numbers has {len(raw)} bytes, not {size}")
    bytes_of = np.frombuffer(raw, np.uint8).reshape(4, -1).T
    words = np.ascontiguousarray(bytes_of).view("<u4").reshape(4, count).astype(np.uint32)
    low = words[1]
    return (
        words[0].astype(np.int64),
        low.view(np.float32),
        (words[2] ^ low).view(np.float32),
        (words[3] ^ low).view(np.float32),
    )
