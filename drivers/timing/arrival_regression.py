"""Sample rate from arrival times: regression of time on sample index, and the standard rates of sensors."""

from math import exp, inf, sqrt
from typing import Final

import numpy as np

FORGET_S: Final = 30.0
"""Time constant of the fitted line. It is long compared with arrival jitter and short compared with crystal warm-up."""
MIN_SPAN_S: Final = 2.0
MIN_SAMPLES: Final = 20
"""The rate is known from the data after both the time MIN_SPAN_S and this number of samples."""
MIN_FORGETTING_FACTOR: Final = 0.9
"""Smallest weight of the earlier points per new point. With slow sensors or long blocks, the line still rests on ten
points or more.
"""
MIN_POINTS: Final = 5
"""Minimum number of points that show the scatter about the line."""
UNCERTAINTY_FACTOR: Final = 2.0
"""Factor from the scatter about the line to the plausible error of the rate.

The points scatter by the delays that the line has not followed. The delays that it has followed are assumed to be as
large. The factor is empirical: of simulated stalls, bursts and slowly varying delays, only the last exceed it, in the
first seconds.
"""
STANDARD_RATE_TOLERANCE: Final = 0.002
"""Relative difference up to which a measured rate is replaced by the nearest standard rate.

Crystals and RC oscillators with a larger difference keep their measured rate.
"""
# fmt: off
STANDARD_RATES_HZ: Final = np.array([
    1, 2, 4, 5, 8, 10, 12.5, 16, 20, 25, 26, 32, 40, 50, 52, 62.5, 64, 80, 100, 104, 120, 125, 128, 200, 208, 238, 240,
    250, 256, 262, 400, 416, 476, 480, 500, 512, 800, 833, 952, 1000, 1024, 1600, 1660, 2000, 3200, 3330, 4000, 6400,
    6660, 8000, 16000, 32000,
])
# fmt: on


class ArrivalRegression:
    """Least-squares line of time on sample index with exponential forgetting.

    The sums are kept relative to the newest point.
    """

    def __init__(self) -> None:
        self.count = 0
        self._x0 = self._t0 = 0.0  # newest point
        self._first_x = self._first_t = 0.0
        self._w = self._mx = self._mt = self._sxx = self._sxt = self._stt = 0.0

    def add_point(self, index: float, t_s: float, nominal_hz: float | None = None) -> None:
        """Add one point.

        Parameters
        ----------
        index
            Sample index. Missing samples count.
        t_s
            Time of the sample in s.
        nominal_hz
            Nominal rate in Hz, used for the slope until the points show one. None if it is unknown.
        """
        if self.count == 0:
            self._first_x, self._first_t = index, t_s
            self._nominal_s = 1.0 / nominal_hz if nominal_hz else None
        dx, dt = index - self._x0, t_s - self._t0
        keep = max(exp(-max(dt, 0.0) / FORGET_S), MIN_FORGETTING_FACTOR) if self.count else 0.0
        # shift the means to the new origin, then update them (West 1979)
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

    def shift_points(self, samples: float) -> None:
        """Shift all points by a number of samples that are known to be missing before the first point."""
        self._x0 += samples
        self._first_x += samples

    def elapsed_s(self) -> float:
        """Return the time from the first point to the newest one in seconds."""
        return self._t0 - self._first_t

    def can_tell_gap_from_jitter(self) -> bool:
        """Return True if there are enough points to tell a gap from jitter."""
        return self._x0 - self._first_x >= MIN_SAMPLES and self.elapsed_s() >= MIN_SPAN_S

    def measure_rate(self, final: bool = False) -> tuple[float, float] | None:
        """Return the rate that the points alone show, and its uncertainty.

        Parameters
        ----------
        final : bool
            True if no more points will be added. MIN_SAMPLES are then enough, however short the time.

        Returns
        -------
        tuple of float, or None
            Rate in Hz and its plausible relative error. None until the points show a rate. Delays whose standard
            deviation is s change the slope by at most s/S, where S is the standard deviation of the times
            (Cauchy-Schwarz inequality). For the remaining delays about the line, s/S = √(1/r² − 1), where r is the
            correlation of time and index.
        """
        enough = (
            self._x0 - self._first_x >= MIN_SAMPLES - 1
            if final
            else self.can_tell_gap_from_jitter() and self.count >= MIN_POINTS
        )
        if not enough or not self._sxt > 0.0:
            return None
        r2 = self._sxt * self._sxt / (self._sxx * self._stt) if self._stt > 0.0 else 0.0
        return self._sxx / self._sxt, UNCERTAINTY_FACTOR * sqrt(max(1.0 / r2 - 1.0, 0.0)) if r2 > 0.0 else inf

    def is_slower_than(self, period_s: float) -> bool:
        """Return True if the points show with certainty a longer period than ``period_s``."""
        found = self.measure_rate()
        return found is not None and found[0] * period_s < 1.0 - found[1]

    def period_s(self) -> float | None:
        """Return the sample period in seconds; None before the second point if there is no nominal rate."""
        if self.count >= 2 and self._sxt > 0.0 and (self.can_tell_gap_from_jitter() or self._nominal_s is None):
            return self._sxt / self._sxx
        return self._nominal_s if self.count else None

    def rate_hz(self) -> float | None:
        """Return the sample rate in Hz; None until it is known."""
        period = self.period_s()
        return 1.0 / period if period else None

    def time_at_index_s(self, index: float) -> float:
        """Return the time of the line at a sample index in seconds."""
        period = self.period_s() or 0.0
        return self._t0 + self._mt + (index - self._x0 - self._mx) * period


def snap_to_standard_rate(measured_hz: float) -> float:
    """Return the nearest standard rate in Hz if it is within STANDARD_RATE_TOLERANCE of the measured rate.

    Otherwise return the measured rate rounded to 5 digits.

    >>> snap_to_standard_rate(99.97), snap_to_standard_rate(99.32)
    (100.0, 99.32)
    """
    nearest = float(STANDARD_RATES_HZ[np.argmin(np.abs(np.log(STANDARD_RATES_HZ / measured_hz)))])
    return nearest if abs(measured_hz / nearest - 1.0) < STANDARD_RATE_TOLERANCE else float(f"{measured_hz:.5g}")
