"""Whether innovations are as large as they should be: the test that a drift's model still holds.

A mean of ε²/S over the last intervals is about χ² over its freedom while the model holds. Beyond a limit that chance
passes next to never the model does not, whatever the noise was estimated as since; told once, until it holds again.
"""

from collections import deque
from typing import Final

INTERVALS: Final = 64
CHANCE: Final = 1e-8
"""Of a look that chance passes the limit; looks overlap."""
LIMIT: Final = 2.327393746165351
"""The quantile of χ² with INTERVALS degrees of freedom that CHANCE exceeds, over INTERVALS."""
AGAIN: Final = 1.3
"""Below this the model holds again."""


class Innovations:
    """Of one axis."""

    def __init__(self) -> None:
        self._squares: deque[float] = deque(maxlen=INTERVALS)
        self._told = False

    @property
    def mean_square(self) -> float:
        """Of ε²/S over the last intervals; NaN before there are so many."""
        return sum(self._squares) / INTERVALS if len(self._squares) == INTERVALS else float("nan")

    def update(self, innovation: float) -> bool:
        """One more ε/√S; whether the model has just ceased to hold."""
        self._squares.append(innovation**2)
        now = self.mean_square
        if self._told and now < AGAIN:
            self._told = False
        if self._told or not now > LIMIT:
            return False
        self._told = True
        return True

    def forget(self) -> None:
        """A new model, or a new level."""
        self._squares.clear()
        self._told = False
