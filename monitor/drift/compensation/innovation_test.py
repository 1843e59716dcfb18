"""Test of the innovations of a drift model: detection of a model that no longer fits.

If the model fits, the mean of ε²/S over the last intervals follows a χ² distribution divided by the degrees of freedom.
If the mean exceeds LIMIT, the model does not fit, even with adapted noise. The test reports the misfit once. After the
mean has fallen below RESET_LIMIT, a new misfit is reported again.
"""

from collections import deque
from typing import Final

INTERVALS: Final = 64
"""Intervals over which the squared innovations are averaged."""
FALSE_ALARM_PROBABILITY: Final = 1e-8
"""Probability that noise alone exceeds the limit in one evaluation. Successive evaluations overlap."""
LIMIT: Final = 2.327393746165351
"""Quantile of χ² with INTERVALS degrees of freedom, divided by INTERVALS, for the probability 1 −
FALSE_ALARM_PROBABILITY."""
RESET_LIMIT: Final = 1.3
"""Mean square below which the model fits again."""


class InnovationTest:
    """Innovation test of one axis."""

    def __init__(self) -> None:
        self._squares: deque[float] = deque(maxlen=INTERVALS)
        self._exceeded = False

    @property
    def mean_square_innovation(self) -> float:
        """Return the mean of ε²/S over the last INTERVALS intervals; NaN if there are fewer."""
        return sum(self._squares) / INTERVALS if len(self._squares) == INTERVALS else float("nan")

    def detect_new_misfit(self, innovation: float) -> bool:
        """Add a normalised innovation ε/√S, and return True if the model has just ceased to fit."""
        self._squares.append(innovation**2)
        now = self.mean_square_innovation
        if self._exceeded and now < RESET_LIMIT:
            self._exceeded = False
        if self._exceeded or not now > LIMIT:
            return False
        self._exceeded = True
        return True

    def forget_innovations(self) -> None:
        """Discard all innovations, after a change of the model or of the level."""
        self._squares.clear()
        self._exceeded = False
