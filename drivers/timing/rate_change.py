"""Detect a change of the sample rate from two consecutive windows of sample times.

The rates of both windows have to differ from the rate before the windows, and to agree with each other. A window lasts
until its rate can be measured, which takes at least 2 s and 20 samples. Samples that are lost without being counted
change the rate of a window at random. The limit of such formats therefore depends on the number of samples and on the
measured scatter of the windows, and is at least four standard deviations for losses of 5 % with a mean burst length of
3 samples. If a fifth of the samples is suddenly lost without being counted, this is a change of the rate.
"""

from math import log, sqrt
from typing import Final

import numpy as np

from drivers.data_types import Floats
from drivers.timing.arrival_regression import ArrivalRegression

MIN_CHANGE: Final = 0.05
"""Minimum relative change of the rate. Slowly varying delays of the arrivals cause smaller changes."""
SCATTER_FACTOR: Final = 5.0
"""Limit of the relative change divided by the standard deviation of the windows, if losses are not counted."""
MIN_SCATTER: Final = 0.09
"""Minimum scatter, so that losses that begin after days without losses are no change of the rate."""
SCATTER_WEIGHT: Final = 0.05
"""Weight of the newest window in the measured scatter."""
MAX_SQUARE: Final = 4.0
"""Maximum square of a deviation, divided by the scatter. A single stall must not hide a later change of the rate."""


class RateChangeDetector:
    """Detector of a change of the sample rate.

    Parameters
    ----------
    losses_are_counted : bool
        True if lost samples are included in the sample index.

    Examples
    --------
    >>> detector = RateChangeDetector(losses_are_counted=True)
    >>> times_s = [min(i, 1000) * 0.01 + max(i - 1000, 0) * 0.02 for i in range(1500)]
    >>> found = [detector.add_point(i, t, (100.0, 0.001)) for i, t in enumerate(times_s)]
    >>> [round(line.measure_rate()[0], 3) for line in found if line is not None][0]
    50.0
    """

    def __init__(self, losses_are_counted: bool) -> None:
        self.losses_are_counted = losses_are_counted
        self._scatter = MIN_SCATTER  # mean square of the relative deviation of a window, times its number of samples
        self.restart()

    @property
    def steady_rate_hz(self) -> float | None:
        """Sample rate in Hz before the present windows, which a change that is not yet detected does not affect."""
        return None if self._before is None else self._before[0]

    def restart(self) -> None:
        """Discard both windows."""
        self._line: ArrivalRegression | None = None  # regression of the newest window
        self._first_index = 0.0
        self._before: tuple[float, float] | None = None  # rate in Hz before the windows, and its uncertainty
        self._candidate: tuple[float, float] | None = None  # rate of the last window, if the rate differs from _before

    def add_point(self, index: float, t_s: float, rate: tuple[float, float] | None) -> ArrivalRegression | None:
        """Add a point, and return the regression line of the newest window if the sample rate has changed.

        Parameters
        ----------
        index : float
            Sample index.
        t_s : float
            Time of the sample in s.
        rate : tuple of float, or None
            Present sample rate in Hz and its relative uncertainty; None if unknown.
        """
        if self._line is None:
            self._line, self._first_index = ArrivalRegression(), index
            if self._candidate is None:
                self._before = rate
        line = self._line
        line.add_point(index, t_s)
        found = line.measure_rate()
        if found is None:
            return None
        self._line = None
        if self._before is None:
            return None
        samples = index - self._first_index
        differs = self._differ(found, self._before, samples)
        if differs and self._candidate is not None and not self._differ(found, self._candidate, samples):
            return line
        square = log(found[0] / self._before[0]) ** 2 * samples
        change = min(square, MAX_SQUARE * self._scatter) - self._scatter
        self._scatter = max(self._scatter + SCATTER_WEIGHT * change, MIN_SCATTER)
        self._candidate = found if differs else None
        return None

    def min_change(self, samples: float) -> float:
        """Return the minimum relative change of the rate that is significant in a number of samples."""
        if self.losses_are_counted:
            return MIN_CHANGE
        return max(MIN_CHANGE, SCATTER_FACTOR * sqrt(self._scatter / samples))

    def _differ(self, a: tuple[float, float], b: tuple[float, float], samples: float) -> bool:
        return abs(log(a[0] / b[0])) > max(self.min_change(samples), a[1] + b[1])


def count_false_losses(old_periods: Floats, new_periods: Floats) -> int:
    """Return the number of samples that were counted as missing only because the sample rate had changed.

    Parameters
    ----------
    old_periods
        Time steps [n] in sample periods before the change.
    new_periods
        The same time steps in sample periods after the change.
    """
    return int(np.maximum(np.rint(old_periods) - np.maximum(np.rint(new_periods), 1.0), 0.0).sum())
