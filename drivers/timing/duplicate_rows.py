"""Detection of repeated, late and reordered rows by their keys (given times or device counters) and values.

A row is a repeat if an earlier row has the same key and the same values. If keys are too coarse to distinguish rows
(many rows share a key but differ in their values), no row is called a repeat. Rows whose given times form a steady
sequence in another order are sorted. Times that only jitter are not sorted, since the order of arrival is then correct.

``EventRateLimiter`` limits the rate of the events about these rows. This module uses only the key and the values of a
sample.
"""

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Event, Floats, Ints

Mask = NDArray[np.bool_]

NS_PER_S: Final = 1e9
"""Nanoseconds per second."""
MIN_NEW_KEYS: Final = 20
"""Minimum number of rows with a new key. With fewer rows, no row is called a repeat."""
MAX_SHARED_FRACTION: Final = 0.05
"""Maximum fraction of rows that share a key with another row but differ in values. Above it, keys are too coarse."""
SHARED_FRACTION_ROWS: Final = 2000
"""Number of recent rows over which the fraction of shared keys is computed."""
SEARCH_ROWS: Final = 256
"""Number of earlier rows that are searched for a repeat."""
STEP_TOLERANCE: Final = 0.25
"""Tolerance as a fraction of a period. Times this close to a whole number of periods form a steady sequence."""
MIN_EVENT_INTERVAL_S: Final = 1.0
"""Shortest time between two events of one kind."""


class DuplicateDetector:
    """Detector of rows that repeat an earlier row.

    Parameters
    ----------
    ordered
        True if keys only increase, so that a repeat may follow after other rows. False for a counter that wraps, where
        a repeat follows its original at once.
    """

    def __init__(self, ordered: bool) -> None:
        self._ordered = ordered
        self._last = -(1 << 62)
        self._tail: deque[tuple[Ints, Floats]] = deque()
        self._kept = 0  # number of rows in the tail
        self._fresh = self._shared = 0.0

    def find(self, keys: Ints, values: Floats) -> tuple[Mask | None, int]:
        """Find the rows that repeat an earlier row.

        Parameters
        ----------
        keys
            [n] int64, given times in ns or counter values.
        values
            [n, 6] float64. NaN equals NaN.

        Returns
        -------
        tuple
            A bool array [n] that is True for repeats (None if there are none), and the number of other rows that share
            a key with an earlier row. Those rows are kept.
        """
        n = len(keys)
        fresh = int(keys[0]) > self._last if self._ordered else int(keys[0]) != self._last
        if n > 1 and fresh:
            steps = np.diff(keys)
            fresh = bool((steps > 0).all() if self._ordered else (steps != 0).all())
        newest = int(keys[-1])
        if self._ordered and newest > self._last - NS_PER_S:  # a clock set back by more than a second restarts
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
        """Return pairs of rows with the same key whose later row is at ``at`` or after."""
        order = np.argsort(keys, kind="stable") if self._ordered else np.arange(len(keys))
        pairs = np.flatnonzero(np.diff(keys[order]) == 0)
        of, row = order[pairs], order[pairs + 1]
        known = (row >= at) & (row - of <= SEARCH_ROWS)
        return of[known], row[known]

    def _update_shared_fraction(self, fresh: int, shared: int) -> None:
        """Add rows to the counts of new and shared keys, and scale both down to the last SHARED_FRACTION_ROWS."""
        self._fresh += fresh
        self._shared += shared
        if self._fresh + self._shared > SHARED_FRACTION_ROWS:
            scale = SHARED_FRACTION_ROWS / (self._fresh + self._shared)
            self._fresh, self._shared = self._fresh * scale, self._shared * scale

    def _remember(self, keys: Ints, values: Floats) -> None:
        """Keep the last SEARCH_ROWS rows for the next search."""
        self._tail.append((keys[-SEARCH_ROWS:], values[-SEARCH_ROWS:]))
        self._kept += len(self._tail[-1][0])
        while self._kept - len(self._tail[0][0]) >= SEARCH_ROWS:
            self._kept -= len(self._tail.popleft()[0])


def steady_order(t_ns: Ints, period_s: float) -> Ints | None:
    """Return the order in which given times form a steady sequence.

    Parameters
    ----------
    t_ns
        [n] int64, times in ns in order of arrival.
    period_s
        Sample period in s.

    Returns
    -------
    ndarray or None
        [n] int64, the row of each position. None if the times are in order already or form no steady sequence.

    Examples
    --------
    >>> steady_order(np.array([0, 10, 30, 20, 40]) * 10**6, 0.01).tolist()
    [0, 1, 3, 2, 4]
    >>> steady_order(np.array([0, 10, 8, 20, 18]) * 10**6, 0.01) is None
    True
    """
    if (np.diff(t_ns) >= 0).all():
        return None
    order = np.argsort(t_ns, kind="stable")
    moved = np.flatnonzero(order != np.arange(len(order)))
    steps = np.diff(t_ns[order]) / (NS_PER_S * period_s)
    touched = np.unique(np.clip(np.concatenate([moved - 1, moved]), 0, len(steps) - 1))
    whole = np.rint(steps[touched])
    steady = (whole >= 1.0) & (np.abs(steps[touched] - whole) < STEP_TOLERANCE)
    return order if bool(steady.all()) else None


class EventRateLimiter:
    """Rate limiter for events: passes at most one event of each kind in EVENT_S of sample time.

    Events that are held back are summed up in the next one.
    """

    def __init__(self) -> None:
        self._events: list[Event] = []
        self._last: dict[str, int] = {}
        self._held_back: dict[tuple[str, str], tuple[int, str, int]] = {}

    def tell(self, kind: str, t_ns: int, text: str, n: int = 0) -> None:
        """Report an event.

        Parameters
        ----------
        kind
            Kind of the event.
        t_ns
            Time of the event in ns.
        text
            Text of the event. ``{n}`` is replaced by the sum of the counts of all events that were held back.
        n
            Count of this event.
        """
        key = (kind, text if "{n}" in text else "")
        held = self._held_back.pop(key, None)
        if "{n}" in text:
            n += held[2] if held else 0
        else:  # the first event is reported, and the others are counted
            n = held[2] + 1 if held else 0
            text = held[1] if held else text
        self._held_back[key] = (t_ns, text, n)
        self.tell_due(t_ns)

    def tell_due(self, t_ns: int) -> None:
        """Report the events that have been held back for EVENT_S at the time ``t_ns``."""
        for (kind, what), (at_ns, text, n) in [*self._held_back.items()] if self._held_back else ():
            if kind not in self._last or abs(t_ns - self._last[kind]) >= MIN_EVENT_INTERVAL_S * NS_PER_S:
                del self._held_back[(kind, what)]
                self._last[kind] = t_ns
                more = f", and {n} more of the kind within a second" if n and "{n}" not in text else ""
                self._events.append(Event(kind, at_ns, text.replace("{n}", str(n)) + more))

    def take(self, ended: bool = False) -> list[Event]:
        """Return the events since the last call. If ``ended`` is True, return the events that are held back, too."""
        if ended:
            self._last.clear()
            while self._held_back:
                self.tell_due(0)
                self._last.clear()
        events, self._events = self._events, []
        return events
