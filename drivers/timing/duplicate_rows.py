"""Rows that came twice, came late or came in another order, by their key (given time or device counter) and values.

A repeat has the key and all values of a row that came before. Where keys are too coarse to tell rows apart (many rows
share one and differ), nothing is called a repeat. Rows whose given times are a steady sequence in another order are put
in order; times that only jitter are not, as then the order of coming is the true one.

``Telling`` keeps the events about all this apart in time. Of a sample only its key and
values are known here.
"""

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Event, Floats, Ints

Mask = NDArray[np.bool_]

NS: Final = 1e9
FRESH: Final = 20
"""Keys that went on, by which equal ones are judged: with fewer nothing is called a repeat."""
SHARED: Final = 0.05
"""Share of rows with the key of another row and other values: above, keys are too coarse to tell a repeat."""
REMEMBERED: Final = 2000
"""Rows that this share is of."""
BACK: Final = 256
"""Rows among which a repeat is looked for."""
NEAR: Final = 0.25
"""Of a period: times this near to a whole number of them are a steady sequence."""
EVENT_S: Final = 1.0
"""Least distance of two events of a kind."""


class Repeats:
    """Finds rows that came before.

    Args:
        ordered: keys only grow, so that a repeat may follow after other rows; else (a counter that wraps) it
            follows at once
    """

    def __init__(self, ordered: bool) -> None:
        self._ordered = ordered
        self._last = -(1 << 62)
        self._tail: deque[tuple[Ints, Floats]] = deque()
        self._kept = 0  # rows in the tail
        self._fresh = self._shared = 0.0

    def find(self, keys: Ints, values: Floats) -> tuple[Mask | None, int]:
        """Which rows repeat (None = none), and how many others have the key of another row and are kept.

        Args:
            keys: [n] given time or counter
            values: [n, 6], NaN equals NaN
        """
        n = len(keys)
        fresh = int(keys[0]) > self._last if self._ordered else int(keys[0]) != self._last
        if n > 1 and fresh:
            steps = np.diff(keys)
            fresh = bool((steps > 0).all() if self._ordered else (steps != 0).all())
        newest = int(keys[-1])
        if self._ordered and newest > self._last - NS:  # a clock set back by more than a second begins anew
            newest = max(self._last, newest if n == 1 else int(keys.max()))
        self._last = newest
        if fresh:
            self._weigh(n, 0)
            self._remember(keys, values)
            return None, 0
        before_keys = [k for k, _ in self._tail]
        at = sum(len(k) for k in before_keys)
        of, row = self._same_key(np.concatenate([*before_keys, keys]), at)
        all_values = np.concatenate([*(v for _, v in self._tail), values])
        first, second = all_values[of], all_values[row]
        same = ((first == second) | (np.isnan(first) & np.isnan(second))).all(axis=1)
        self._weigh(n - len(row), int((~same).sum()))
        self._remember(keys, values)
        if self._fresh < FRESH or self._shared > SHARED * (self._fresh + self._shared):
            return None, 0
        repeats = np.zeros(n, np.bool_)
        repeats[row[same] - at] = True
        return (repeats if repeats.any() else None), int((~same).sum())

    def _same_key(self, keys: Ints, at: int) -> tuple[Ints, Ints]:
        """Pairs of rows with the same key, the later one at ``at`` or after."""
        order = np.argsort(keys, kind="stable") if self._ordered else np.arange(len(keys))
        pairs = np.flatnonzero(np.diff(keys[order]) == 0)
        of, row = order[pairs], order[pairs + 1]
        known = (row >= at) & (row - of <= BACK)
        return of[known], row[known]

    def _weigh(self, fresh: int, shared: int) -> None:
        self._fresh += fresh
        self._shared += shared
        if self._fresh + self._shared > REMEMBERED:
            scale = REMEMBERED / (self._fresh + self._shared)
            self._fresh, self._shared = self._fresh * scale, self._shared * scale

    def _remember(self, keys: Ints, values: Floats) -> None:
        self._tail.append((keys[-BACK:], values[-BACK:]))
        self._kept += len(self._tail[-1][0])
        while self._kept - len(self._tail[0][0]) >= BACK:
            self._kept -= len(self._tail.popleft()[0])


def steady_order(t_ns: Ints, period_s: float) -> Ints | None:
    """The order [n] in which given times are a steady sequence; None where they are none, or in order already.

    >>> steady_order(np.array([0, 10, 30, 20, 40]) * 10**6, 0.01).tolist()
    [0, 1, 3, 2, 4]
    >>> steady_order(np.array([0, 10, 8, 20, 18]) * 10**6, 0.01) is None
    True
    """
    if (np.diff(t_ns) >= 0).all():
        return None
    order = np.argsort(t_ns, kind="stable")
    moved = np.flatnonzero(order != np.arange(len(order)))
    steps = np.diff(t_ns[order]) / (NS * period_s)
    touched = np.unique(np.clip(np.concatenate([moved - 1, moved]), 0, len(steps) - 1))
    whole = np.rint(steps[touched])
    steady = (whole >= 1.0) & (np.abs(steps[touched] - whole) < NEAR)
    return order if bool(steady.all()) else None


class Telling:
    """Events of one kind, at most one in EVENT_S of sample time; what is held back meanwhile is summed up."""

    def __init__(self) -> None:
        self._events: list[Event] = []
        self._last: dict[str, int] = {}
        self._untold: dict[tuple[str, str], tuple[int, str, int]] = {}

    def tell(self, kind: str, t_ns: int, text: str, n: int = 0) -> None:
        """Something happened; ``{n}`` in the text stands for how often, and is summed up over what is held back."""
        key = (kind, text if "{n}" in text else "")
        held = self._untold.pop(key, None)
        if "{n}" in text:
            n += held[2] if held else 0
        else:  # the first is told, the others are counted
            n = held[2] + 1 if held else 0
            text = held[1] if held else text
        self._untold[key] = (t_ns, text, n)
        self.tell_due(t_ns)

    def tell_due(self, t_ns: int) -> None:
        """Tell what has been held back for long enough."""
        for (kind, what), (at_ns, text, n) in [*self._untold.items()] if self._untold else ():
            if kind not in self._last or abs(t_ns - self._last[kind]) >= EVENT_S * NS:
                del self._untold[(kind, what)]
                self._last[kind] = t_ns
                more = f", and {n} more of the kind within a second" if n and "{n}" not in text else ""
                self._events.append(Event(kind, at_ns, text.replace("{n}", str(n)) + more))

    def take(self, ended: bool = False) -> list[Event]:
        """Events since the last call; all that is held back too if no more samples will come."""
        if ended:
            self._last.clear()
            while self._untold:
                self.tell_due(0)
                self._last.clear()
        events, self._events = self._events, []
        return events
