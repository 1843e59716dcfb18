"""Estimate the sample rate by a linear regression of arrival time on sample index."""

from math import exp, sqrt
from typing import Final, NamedTuple

import numpy as np

FORGET_S: Final = 30.0
"""Time constant of the exponential forgetting in s.

Arrival jitter is faster, and the warm-up of a crystal is slower.
"""
MIN_SPAN_S: Final = 2.0
"""Minimum time in s between the first and the last point for a rate estimate."""
MIN_SAMPLES: Final = 20
"""Minimum number of samples for a rate estimate."""
MIN_FORGETTING_FACTOR: Final = 0.9
"""Lower limit of the factor by which a new point reduces the weight of the earlier points.

Because of this limit, the effective number of points is at least ten even for slow sensors.
"""
MIN_POINTS: Final = 5
"""Minimum number of points for an estimate of the scatter about the regression line."""
UNCERTAINTY_FACTOR: Final = 2.0
"""Ratio of the stated uncertainty of the rate to the error that the residuals indicate.

This safety factor is empirical, because slowly varying delays shift the regression line without appearing in the
residuals. In simulations with stalls, bursts and slowly varying delays, the error exceeded the stated uncertainty only
for slowly varying delays in the first seconds.
"""
STANDARD_RATE_TOLERANCE: Final = 0.002
"""Maximum relative difference at which a measured rate is replaced with the nearest standard rate."""
# fmt: off
STANDARD_RATES_HZ: Final = np.array([
    1, 2, 4, 5, 8, 10, 12.5, 16, 20, 25, 26, 32, 40, 50, 52, 62.5, 64, 80, 100, 104, 120, 125, 128, 200, 208, 238, 240,
    250, 256, 262, 400, 416, 476, 480, 500, 512, 800, 833, 952, 1000, 1024, 1600, 1660, 2000, 3200, 3330, 4000, 6400,
    6660, 8000, 16000, 32000,
])
# fmt: on


class RateEstimate(NamedTuple):
    """Sample rate that was measured by a regression."""

    rate_hz: float
    uncertainty: float  # relative
    residual_s: float  # standard deviation of the times about the regression line in s
    spread_s: float  # standard deviation of the times in s


class ArrivalRegression:
    """Recursive linear regression of time on sample index, with exponential forgetting."""

    def __init__(self) -> None:
        self.count = 0
        self.has_enough_points_for_gaps = False
        """True if the regression has enough points to distinguish a gap from jitter."""
        self._x0 = self._t0 = 0.0  # index and time of the newest point
        self._first_x = self.first_t_s = 0.0
        self._w = self._mx = self._mt = self._sxx = self._sxt = self._stt = 0.0

    def add_point(self, index: float, t_s: float, nominal_hz: float | None = None) -> None:
        """Add one point to the regression.

        Parameters
        ----------
        index
            Sample index, which also counts missing samples.
        t_s
            Time of the sample in s.
        nominal_hz
            Nominal sample rate in Hz, which is used until there are enough points for an estimate. None if unknown.
        """
        if self.count == 0:
            self._first_x, self.first_t_s = index, t_s
            self._nominal_s = 1.0 / nominal_hz if nominal_hz else None
        dx, dt = index - self._x0, t_s - self._t0
        keep = max(exp(-max(dt, 0.0) / FORGET_S), MIN_FORGETTING_FACTOR) if self.count else 0.0
        # Shift the means to the new origin, then add the new point (West 1979).
        self._mx -= dx
        self._mt -= dt
        self._x0, self._t0 = index, t_s
        self._w, self._sxx, self._sxt = self._w * keep + 1.0, self._sxx * keep, self._sxt * keep
        self._stt *= keep
        gain = 1.0 / self._w
        ex, et = -self._mx, -self._mt
        self._mx += gain * ex
        self._mt += gain * et
        self._sxx += (1.0 - gain) * ex * ex
        self._sxt += (1.0 - gain) * ex * et
        self._stt += (1.0 - gain) * et * et
        self.count += 1
        self.has_enough_points_for_gaps = (
            self._x0 - self._first_x >= MIN_SAMPLES and self._t0 - self.first_t_s >= MIN_SPAN_S
        )

    def shift_points(self, samples: float) -> None:
        """Increase the index of all points after samples were found to be missing before the first point."""
        self._x0 += samples
        self._first_x += samples

    def measure_rate(self, final: bool = False) -> RateEstimate | None:
        """Return the measured sample rate and its uncertainty, or None if there are too few points.

        Delays with standard deviation s cause a relative error of at most s/S in the slope of the line, where S is the
        standard deviation of the times (Cauchy-Schwarz inequality). For the residuals of the regression, s/S = √(1/r² −
        1), where r is the correlation of time and index.

        Parameters
        ----------
        final : bool
            True if no more points will be added. The minimum duration MIN_SPAN_S is then ignored.
        """
        enough = (
            self._x0 - self._first_x >= MIN_SAMPLES - 1
            if final
            else self.has_enough_points_for_gaps and self.count >= MIN_POINTS
        )
        if not enough or not self._sxt > 0.0:
            return None
        explained = self._sxt * self._sxt / self._sxx  # part of _stt on the line
        residual_s, spread_s = sqrt(max(self._stt - explained, 0.0) / self._w), sqrt(explained / self._w)
        return RateEstimate(self._sxx / self._sxt, UNCERTAINTY_FACTOR * residual_s / spread_s, residual_s, spread_s)

    def period_s(self) -> float | None:
        """Return the sample period in seconds. None if there is no nominal rate and there are too few points."""
        if self.count >= 2 and self._sxt > 0.0 and (self.has_enough_points_for_gaps or self._nominal_s is None):
            return self._sxt / self._sxx
        return self._nominal_s if self.count else None

    def rate_hz(self) -> float | None:
        """Return the sample rate in Hz, or None if the sample rate is unknown."""
        period = self.period_s()
        return 1.0 / period if period else None

    def time_at_index_s(self, index: float) -> float:
        """Return the time on the regression line at a sample index, in seconds."""
        period = self.period_s() or 0.0
        return self._t0 + self._mt + (index - self._x0 - self._mx) * period


def snap_to_standard_rate(measured_hz: float) -> float:
    """Replace a measured sample rate with the nearest standard rate within STANDARD_RATE_TOLERANCE.

    A rate that is not near any standard rate is rounded to 5 digits.

    >>> snap_to_standard_rate(99.97), snap_to_standard_rate(99.32)
    (100.0, 99.32)
    """
    nearest = float(STANDARD_RATES_HZ[np.argmin(np.abs(np.log(STANDARD_RATES_HZ / measured_hz)))])
    return nearest if abs(measured_hz / nearest - 1.0) < STANDARD_RATE_TOLERANCE else float(f"{measured_hz:.5g}")
