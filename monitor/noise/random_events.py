"""Things that happen at random samples: gaps and sizes drawn a batch at a time, told by the sample they fall on.

Batches have one length, so the events do not depend on the blocks in which they are asked for. The first few are
kept for the truth beside the data; all are counted.
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from drivers.sample import Floats, Ints

BATCH: Final = 64
LISTED: Final = 1000
"""Events whose times the truth lists; later ones are counted only."""


class Events:
    """Events in order.

    Args:
        gaps: draws the gaps of a batch, in samples; inf = never
        sizes: draws the sizes of a batch
        rate_hz: for the times in ``truth``
        before: where the first gap begins; -1 where gaps are whole and the first sample may be an event
    """

    def __init__(
        self,
        gaps: Callable[[int], Floats],
        sizes: Callable[[int], Floats],
        rate_hz: float,
        before: float = 0.0,
    ) -> None:
        self._gaps, self._sizes, self._rate_hz = gaps, sizes, rate_hz
        self._next, self._size = before + gaps(BATCH).cumsum(), sizes(BATCH)
        self._begun: int | None = None
        self.count = 0
        self._listed: list[tuple[float, float]] = []

    def take(self, first: int, n: int) -> tuple[Ints, Floats]:
        """Sample, counted from ``first``, and size of each event before sample ``first + n``; in order of time."""
        if self._begun is None:
            self._begun = first
        end = first - self._begun + n - 1  # an event between two samples shows at the later one
        taken, sizes = [], []
        while True:
            k = int(np.searchsorted(self._next, end, "right"))
            taken.append(self._next[:k])
            sizes.append(self._size[:k])
            self._next, self._size = self._next[k:], self._size[k:]
            if self._next.size:
                break
            self._next = taken[-1][-1] + self._gaps(BATCH).cumsum()
            self._size = self._sizes(BATCH)
        when, size = np.concatenate(taken), np.concatenate(sizes)
        self.count += when.size
        for one in range(min(when.size, LISTED - len(self._listed))):
            self._listed.append(((self._begun + float(when[one])) / self._rate_hz, float(size[one])))
        return np.ceil(when - (first - self._begun)).astype(np.int64), size

    def truth(self, size: str | None = None) -> dict[str, Any]:
        """Count, and times in seconds since the stream began of the first LISTED; with ``size``, their sizes too."""
        times: dict[str, Any] = {"count": self.count, "times": [time for time, _ in self._listed]}
        return times if size is None else times | {size: [height for _, height in self._listed]}
