"""Detect a change of the sample rate from two consecutive windows of sample times.

The rates of both windows have to differ from the rate before the windows, and to agree with each other. Long windows
detect changes above 2 % within 18 s, and short windows detect changes above 6 % within 6 s.

Samples that are lost without being counted also change the rate. Losses at random times scatter the sample times about
the regression line: the mean square of the residuals of a random walk with variance v per sample is v·n/15 after a
regression over n samples. If losses reduce the rate by the share p, v is at least p. Losses therefore explain the lower
of two rates if its residuals reach a part of this value.
"""

from math import log, sqrt
from typing import Final

import numpy as np

from drivers.data_types import Floats
from drivers.timing.arrival_regression import ArrivalRegression, RateEstimate

WINDOWS_S: Final = (2.0, 6.0)
"""Minimum lengths of the windows in s. A window lasts until its rate can be measured, which takes 20 samples."""
MIN_SHIFT_S: Final = 0.12
"""Minimum time in s by which a change of the rate shifts the samples of one window, equivalent to changes by 6 and 2 %.

The oscillators of sensors are more accurate than 2 %, and slowly varying delays of the arrivals cause smaller shifts.
"""
UNCOUNTED_LOSS_UNCERTAINTIES: Final = 3.0
"""Factor on the uncertainty of a rate if lost samples are not counted. Losses also make the measured rate lower.

In simulations with losses of 5 and 20 % in bursts, a rate was too low by up to 1.7 times its uncertainty.
"""
MIN_LOSS_RESIDUALS: Final = 0.25
"""Minimum mean square of the residuals that losses explain, divided by the expectation for single losses."""


class RateChangeDetector:
    """Detector of a change of the sample rate.

    Parameters
    ----------
    losses_are_counted : bool
        True if lost samples are included in the sample index.

    Examples
    --------
    >>> detector, line = RateChangeDetector(losses_are_counted=True), ArrivalRegression()
    >>> for i in range(1500):
    ...     t_s = min(i, 1000) * 0.01 + max(i - 1000, 0) * 0.02
    ...     line.add_point(i, t_s)
    ...     if changed := detector.add_point(i, t_s, line):
    ...         break
    >>> i, round(changed.measure_rate().rate_hz, 3)
    (1205, 50.0)
    """

    def __init__(self, losses_are_counted: bool) -> None:
        self.uncertainties = 1.0 if losses_are_counted else UNCOUNTED_LOSS_UNCERTAINTIES
        """Factor on the uncertainty of a rate."""
        self._losses_are_counted = losses_are_counted
        self.restart()

    @property
    def steady_rate_hz(self) -> float | None:
        """Sample rate in Hz before the present windows, which a change that is not yet detected does not affect."""
        return next((window.before.rate_hz for window in reversed(self._windows) if window.before), None)

    def restart(self) -> None:
        """Discard all windows."""
        self._windows = [_Window(length_s) for length_s in WINDOWS_S]

    def add_point(self, index: float, t_s: float, line: ArrivalRegression) -> ArrivalRegression | None:
        """Add a point, and return the regression line of the newest window if the sample rate has changed.

        Parameters
        ----------
        index : float
            Sample index.
        t_s : float
            Time of the sample in s.
        line : ArrivalRegression
            Regression line of all samples.
        """
        for window in self._windows:
            if self._add_to_window(window, index, t_s, line):
                return window.line
        return None

    def _add_to_window(self, window: "_Window", index: float, t_s: float, line: ArrivalRegression) -> bool:
        """Add a point to a window, and return True if the window shows a change of the sample rate."""
        if window.ended:
            window.line, window.ended = ArrivalRegression(), False
            if window.candidate is None:
                window.before, window.newest = window.newest, line.measure_rate()
        window.line.add_point(index, t_s)
        if t_s - window.line.first_t_s < window.length_s or (found := window.line.measure_rate()) is None:
            return False
        window.ended = True
        if window.before is None:
            return False
        change, candidate = log(found.rate_hz / window.before.rate_hz), window.candidate
        uncertainty = self.uncertainties * (found.uncertainty + window.before.uncertainty)
        differs = abs(change) > max(MIN_SHIFT_S / window.length_s, uncertainty)
        window.candidate = found if differs and not self._losses_explain(found, window.before) else None
        if window.candidate is None or candidate is None:
            return False
        return abs(log(found.rate_hz / candidate.rate_hz)) < 0.5 * abs(change)

    def _losses_explain(self, a: RateEstimate, b: RateEstimate) -> bool:
        """Return True if the lower of two rates has the residuals of samples that are lost without being counted."""
        if self._losses_are_counted:
            return False
        lower, higher = (a, b) if a.rate_hz < b.rate_hz else (b, a)
        lost = 1.0 - lower.rate_hz / higher.rate_hz
        # The times of n evenly spaced samples have the standard deviation n / (√12 rate).
        expected_s2 = lost * sqrt(12.0) * lower.spread_s / (15.0 * lower.rate_hz)
        return lower.residual_s**2 > MIN_LOSS_RESIDUALS * expected_s2


class _Window:
    """Window of sample times, and the rates before it."""

    def __init__(self, length_s: float) -> None:
        self.length_s = length_s
        self.line = ArrivalRegression()
        self.ended = True
        self.before: RateEstimate | None = None  # rate before the previous window, in which the rate may have changed
        self.newest: RateEstimate | None = None  # rate before this window
        self.candidate: RateEstimate | None = None  # rate of the previous window, if it differs from ``before``


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
