"""Events at random samples. Gaps and sizes of the events are drawn in batches.

All batches have the same length, so the events do not depend on the division into blocks. All events are counted. The
times of the first events are stored for the truth file of a simulation.
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from drivers.data_types import Floats, Ints

BATCH_SIZE: Final = 64
MAX_LISTED_EVENTS: Final = 1000
"""Largest number of events whose times are listed. Later events are only counted."""


class RandomEvents:
    """Random events in the order of time.

    Parameters
    ----------
    gaps : callable
        Draws the gaps of a batch, in samples; inf = no event.
    sizes : callable
        Draws the sizes of a batch.
    rate_hz : float
        Sample rate in Hz, for the times in ``truth``.
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
        """Return the events before sample ``first + n`` that have not been returned yet.

        Parameters
        ----------
        first_index : int
            Index of the first sample of the block.
        n : int
            Number of samples of the block.

        Returns
        -------
        indices : ndarray, int64
            Sample of each event, counted from ``first_index``.
        sizes : ndarray, float64
            Size of each event.
        """
        if self._first_index is None:
            self._first_index = first_index
        end = first_index - self._first_index + n - 1  # an event between two samples is visible at the later one
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
        """Return the number of events, and the times of the listed events in seconds since the start of the stream.

        If ``size_key`` is given, the sizes of the listed events are returned under this key.
        """
        times: dict[str, Any] = {"count": self.count, "times": [time for time, _ in self._listed]}
        return times if size_key is None else times | {size_key: [height for _, height in self._listed]}
