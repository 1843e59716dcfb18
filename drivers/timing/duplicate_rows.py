"""Detection and removal of repeated samples. A row of a sample block contains one sample.

A row is a repeat if an earlier row has the same key (sender time or counter value) and the same values. If many rows
have the same key but different values, the keys are too coarse, and no row is treated as a repeat.
"""

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import (
    NO_TICK,
    NS_PER_S,
    CounterTimedFormat,
    Floats,
    Ints,
    SampleBlock,
    SenderTimedFormat,
    Timing,
    make_block,
)
from drivers.timing.event_rate_limiter import EventRateLimiter

Mask = NDArray[np.bool_]

MIN_NEW_KEYS: Final = 20
"""Minimum number of rows with different keys before repeats are detected."""
MAX_SHARED_FRACTION: Final = 0.05
"""Fraction of rows with equal keys but different values above which no row is treated as a repeat."""
SHARED_FRACTION_ROWS: Final = 2000
"""Number of recent rows over which the fraction of shared keys is computed."""
SEARCH_ROWS: Final = 256
"""Number of earlier rows that are compared with a new row."""


class DuplicateDetector:
    """Detector of rows that repeat an earlier row.

    Parameters
    ----------
    ordered : bool
        True if the keys increase, as sender times do. False for a counter that wraps; only consecutive rows are then
        compared.
    """

    def __init__(self, ordered: bool) -> None:
        self._ordered = ordered
        self._last = -(1 << 62)
        self._tail: deque[tuple[Ints, Floats]] = deque()
        self._kept = 0  # number of rows kept for comparison
        self._fresh = self._shared = 0.0

    def find_repeats_and_count_shared_keys(self, keys: Ints, values: Floats) -> tuple[Mask | None, int]:
        """Find the rows that repeat an earlier row.

        Parameters
        ----------
        keys : array of int64, shape (n,)
            Sender times in ns or counter values.
        values : array of float64, shape (n, 6)
            Values of the samples. NaN equals NaN.

        Returns
        -------
        repeats : array of bool, shape (n,), or None
            True for each repeated row. None if no row is a repeat.
        shared : int
            Number of rows with the key of an earlier row but different values.
        """
        n = len(keys)
        fresh = int(keys[0]) > self._last if self._ordered else int(keys[0]) != self._last
        if n > 1 and fresh:
            later, earlier = keys[1:], keys[:-1]
            fresh = bool((later > earlier).all() if self._ordered else (later != earlier).all())
        newest = int(keys[-1])
        if self._ordered and newest > self._last - NS_PER_S:  # otherwise the sender clock was set back
            newest = max(self._last, newest if n == 1 else int(keys.max()))
        self._last = newest
        if fresh:
            self._update_shared_fraction(n, 0)
            self._remember(keys, values)
            return None, 0
        before_keys = [k for k, _ in self._tail]
        at = sum(len(k) for k in before_keys)
        of, row = self._same_key(np.concatenate([*before_keys, keys]), at)
        all_values = np.concatenate([*(v for _, v in self._tail), values])
        first, second = all_values[of], all_values[row]
        same = ((first == second) | (np.isnan(first) & np.isnan(second))).all(axis=1)
        self._update_shared_fraction(n - len(row), int((~same).sum()))
        self._remember(keys, values)
        if self._fresh < MIN_NEW_KEYS or self._shared > MAX_SHARED_FRACTION * (self._fresh + self._shared):
            return None, 0
        repeats = np.zeros(n, np.bool_)
        repeats[row[same] - at] = True
        return (repeats if repeats.any() else None), int((~same).sum())

    def _same_key(self, keys: Ints, at: int) -> tuple[Ints, Ints]:
        """Return the row indices of pairs with the same key.

        The later row of each pair has an index of at least ``at``.
        """
        order = np.argsort(keys, kind="stable") if self._ordered else np.arange(len(keys))
        pairs = np.flatnonzero(np.diff(keys[order]) == 0)
        of, row = order[pairs], order[pairs + 1]
        known = (row >= at) & (row - of <= SEARCH_ROWS)
        return of[known], row[known]

    def _update_shared_fraction(self, fresh: int, shared: int) -> None:
        """Update the fraction of rows with shared keys, which is computed over about SHARED_FRACTION_ROWS rows."""
        self._fresh += fresh
        self._shared += shared
        if self._fresh + self._shared > SHARED_FRACTION_ROWS:
            scale = SHARED_FRACTION_ROWS / (self._fresh + self._shared)
            self._fresh, self._shared = self._fresh * scale, self._shared * scale

    def _remember(self, keys: Ints, values: Floats) -> None:
        """Store the last SEARCH_ROWS rows for comparison with later rows."""
        self._tail.append((keys[-SEARCH_ROWS:], values[-SEARCH_ROWS:]))
        self._kept += len(self._tail[-1][0])
        while self._kept - len(self._tail[0][0]) >= SEARCH_ROWS:
            self._kept -= len(self._tail.popleft()[0])


class RowFilter:
    """Filter that removes rows from sample blocks and preserves the number of missing samples.

    Parameters
    ----------
    timing : Timing
        Timing of the wire format, which determines the key of a row.
    events : EventRateLimiter
        Queue for events about repeated rows.
    """

    def __init__(self, timing: Timing, events: EventRateLimiter) -> None:
        self.dropped_repeated_rows = 0
        """Number of removed rows that repeat an earlier row."""
        self._timing = timing
        self._events = events
        self._detector = DuplicateDetector(ordered=isinstance(timing, SenderTimedFormat))
        self._carried_lost = 0  # number of missing samples before removed rows

    def remove_repeats(self, samples: SampleBlock) -> SampleBlock | None:
        """Remove the rows that repeat an earlier row. Return None if no row remains."""
        if isinstance(self._timing, SenderTimedFormat):
            keys, key_name = samples.t_ns, "time"
        elif isinstance(self._timing, CounterTimedFormat) and (samples.ticks != NO_TICK).all():
            keys, key_name = samples.ticks, "count"
        else:
            return samples
        repeats, shared = self._detector.find_repeats_and_count_shared_keys(keys, samples.values)
        t_ns = int(samples.t_ns[-1])
        if shared:
            text = f"{{n}} rows have the same {key_name} as another row and other values; all rows are kept"
            self._events.report_event("samples_repeated", t_ns, text, shared)
        if repeats is None:
            return samples
        n = int(repeats.sum())
        self.dropped_repeated_rows += n
        text = f"{{n}} rows repeat an earlier row with the same {key_name} and values, and are left out"
        self._events.report_event("samples_repeated", t_ns, text, n)
        return self.select_rows(samples, np.flatnonzero(~repeats))

    def select_rows(self, samples: SampleBlock, rows: Ints) -> SampleBlock | None:
        """Return the selected rows of a block, or None if the selection is empty.

        Samples that are missing before a removed row are counted as missing before the next remaining row.

        Parameters
        ----------
        samples : SampleBlock
            Block of samples.
        rows : array of int64, shape (n,)
            Indices of the rows to keep, in the new order.
        """
        if not rows.size:
            self._carried_lost += samples.lost
            return None
        lost, self._carried_lost = samples.lost + self._carried_lost, 0
        return make_block(
            samples.t_ns[rows], samples.values[rows], samples.temperature_c[rows], samples.ticks[rows], lost
        )
