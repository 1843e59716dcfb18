"""Random events in a simulation, such as outliers and steps.

Gaps between events and sizes of events are drawn in batches of constant length. The events therefore do not depend on
how the samples are divided into blocks. The times of the first events are stored, so that a simulation can report its
true events.
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from drivers.data_types import Floats, Ints

BATCH_SIZE: Final = 64
MAX_LISTED_EVENTS: Final = 1000
"""Maximum number of events whose time is stored. Later events are only counted."""


class RandomEvents:
    """Random events in chronological order.

    Parameters
    ----------
    gaps : callable
        Function that draws the gaps between events in samples. An infinite gap means that no further event occurs.
    sizes : callable
        Function that draws the sizes of events.
    rate_hz : float
        Sample rate in Hz.
    before : float
        Sample index at which the first gap begins. The value -1 allows an event at sample 0 if gaps are whole numbers
        of at least 1.
    """

    def __init__(
        self,
        gaps: Callable[[int], Floats],
        sizes: Callable[[int], Floats],
        rate_hz: float,
        before: float = 0.0,
    ) -> None:
        self._gaps, self._sizes, self._rate_hz = gaps, sizes, rate_hz
        self._next, self._size = before + gaps(BATCH_SIZE).cumsum(), sizes(BATCH_SIZE)
        self._first_index: int | None = None
        self.count = 0
        self._listed: list[tuple[float, float]] = []

    def take_block_events(self, first_index: int, n: int) -> tuple[Ints, Floats]:
        """Return the events in the next block of samples.

        Parameters
        ----------
        first_index : int
            Index of the first sample in the block.
        n : int
            Number of samples in the block.

        Returns
        -------
        indices : ndarray, int64
            Index of the sample that each event affects, relative to the start of the block.
        sizes : ndarray, float64
            Size of each event.
        """
        if self._first_index is None:
            self._first_index = first_index
        end = first_index - self._first_index + n - 1  # an event between two samples affects the second one
        taken, sizes = [], []
        while True:
            k = int(np.searchsorted(self._next, end, "right"))
            taken.append(self._next[:k])
            sizes.append(self._size[:k])
            self._next, self._size = self._next[k:], self._size[k:]
            if self._next.size:
                break
            self._next = taken[-1][-1] + self._gaps(BATCH_SIZE).cumsum()
            self._size = self._sizes(BATCH_SIZE)
        when, size = np.concatenate(taken), np.concatenate(sizes)
        self.count += when.size
        for one in range(min(when.size, MAX_LISTED_EVENTS - len(self._listed))):
            self._listed.append(((self._first_index + float(when[one])) / self._rate_hz, float(size[one])))
        return np.ceil(when - (first_index - self._first_index)).astype(np.int64), size

    def drawn_random_values(self, size_key: str | None = None) -> dict[str, Any]:
        """Return the number of events so far, and the times of the first events in seconds.

        If ``size_key`` is given, the dictionary also contains the sizes of the first events under this key.
        """
        times: dict[str, Any] = {"count": self.count, "times": [time for time, _ in self._listed]}
        return times if size_key is None else times | {size_key: [height for _, height in self._listed]}
