"""Detect drift models that no longer fit, based on the innovations.

If the drift model fits, the mean of the squared normalised innovations ε²/S over n intervals has the distribution
χ²_n/n. When the mean exceeds LIMIT, a misfit is reported. The next misfit is reported only after the mean has fallen
below RESET_LIMIT.
"""

from collections import deque
from typing import Final

INTERVALS: Final = 64
"""Number of intervals over which the squared normalised innovations are averaged."""
FALSE_ALARM_PROBABILITY: Final = 1e-8
"""Probability that a correct model exceeds LIMIT in a single test."""
LIMIT: Final = 2.327393746165351
"""Quantile of χ²/n with n = INTERVALS degrees of freedom, for the probability 1 − FALSE_ALARM_PROBABILITY."""
RESET_LIMIT: Final = 1.3
"""Mean squared normalised innovation below which a drift model counts as fitting again."""


class InnovationTest:
    """Test of the innovations of a drift model for one axis."""

    def __init__(self) -> None:
        self._squares: deque[float] = deque(maxlen=INTERVALS)
        self._exceeded = False

    @property
    def mean_square_innovation(self) -> float:
        """Return the mean of ε²/S over the last INTERVALS intervals, or NaN if there are fewer intervals."""
        return sum(self._squares) / INTERVALS if len(self._squares) == INTERVALS else float("nan")

    def detect_new_misfit(self, innovation: float) -> bool:
        """Add a normalised innovation ε/√S, and return True if the drift model has ceased to fit.

        The function returns True only once for each misfit.
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
        """Discard all innovations, for example after a change of the drift model or a bias step."""
        self._squares.clear()
        self._exceeded = False
