"""Test of the innovations of a drift model, which detects a model that no longer fits.

If the drift model fits, the mean of ε²/S over the last intervals follows a χ² distribution divided by the degrees of
freedom. A mean above LIMIT is reported once. The next report is possible after the mean has fallen below RESET_LIMIT.
"""

from collections import deque
from typing import Final

INTERVALS: Final = 64
"""Number of intervals over which the squared innovations are averaged."""
FALSE_ALARM_PROBABILITY: Final = 1e-8
"""Probability that the mean square innovation of a correct model exceeds LIMIT in one evaluation."""
LIMIT: Final = 2.327393746165351
"""Quantile of χ² with INTERVALS degrees of freedom, divided by INTERVALS, for the probability 1 −
FALSE_ALARM_PROBABILITY."""
RESET_LIMIT: Final = 1.3
"""Mean square innovation below which a drift model is considered to fit again."""


class InnovationTest:
    """Innovation test for the drift model of an axis."""

    def __init__(self) -> None:
        self._squares: deque[float] = deque(maxlen=INTERVALS)
        self._exceeded = False

    @property
    def mean_square_innovation(self) -> float:
        """Return the mean of ε²/S over the last INTERVALS intervals, or NaN if there are fewer intervals."""
        return sum(self._squares) / INTERVALS if len(self._squares) == INTERVALS else float("nan")

    def detect_new_misfit(self, innovation: float) -> bool:
        """Add a normalised innovation ε/√S, and return True if the drift model no longer fits.

        Each misfit is reported only once.
        """
        self._squares.append(innovation**2)
        now = self.mean_square_innovation
        if self._exceeded and now < RESET_LIMIT:
            self._exceeded = False
        if self._exceeded or not now > LIMIT:
            return False
        self._exceeded = True
        return True

    def forget_innovations(self) -> None:
        """Discard all innovations after the drift model or the bias level has changed."""
        self._squares.clear()
        self._exceeded = False
