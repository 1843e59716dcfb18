"""The steady rate behind arrival times: a line through (sample index, time), and the rates sensors are made with."""

from math import exp, inf, sqrt
from typing import Final

import numpy as np

FORGET_S: Final = 30.0
"""Time constant of the fitted line: long against arrival jitter, short against a crystal's warm-up."""
LEARN_S: Final = 2.0
LEARN_SAMPLES: Final = 20
"""A rate is known from the data after both."""
KEEP_LEAST: Final = 0.9
"""Slow sensors and long blocks: the line rests on ten points or more however far apart they are."""
MIN_POINTS: Final = 5
"""Fewer points about a line do not show how far they scatter."""
SCATTER: Final = 2.0
"""The points scatter by the delays that the line has not followed; those that it has followed are taken to be as large.
Empirical: of simulated stalls, bursts and slowly varying delays, only the latter pass it, in the first seconds."""
SNAP: Final = 0.002
"""A measured rate this near to a rate that sensors are made with is taken to be that rate; crystals and RC
oscillators further off are taken at their word."""
# fmt: off
MADE_RATES_HZ: Final = np.array([
    1, 2, 4, 5, 8, 10, 12.5, 16, 20, 25, 26, 32, 40, 50, 52, 62.5, 64, 80, 100, 104, 120, 125, 128, 200, 208, 238, 240,
    250, 256, 262, 400, 416, 476, 480, 500, 512, 800, 833, 952, 1000, 1024, 1600, 1660, 2000, 3200, 3330, 4000, 6400,
    6660, 8000, 16000, 32000,
])
# fmt: on


class Line:
    """Least squares of time on index with exponential forgetting; sums are kept about the newest point."""

    def __init__(self) -> None:
        self.count = 0
        self._x0 = self._t0 = 0.0  # newest point
        self._first_x = self._first_t = 0.0
        self._w = self._mx = self._mt = self._sxx = self._sxt = self._stt = 0.0

    def add(self, index: float, t_s: float, nominal_hz: float | None = None) -> None:
        """One more (index, arrival) pair; the nominal rate stands in for a slope until there is one."""
        if self.count == 0:
            self._first_x, self._first_t = index, t_s
            self._nominal_s = 1.0 / nominal_hz if nominal_hz else None
        dx, dt = index - self._x0, t_s - self._t0
        keep = max(exp(-max(dt, 0.0) / FORGET_S), KEEP_LEAST) if self.count else 0.0
        # shift the means to the new origin, then update (West 1979)
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

    def move(self, samples: float) -> None:
        """Move all points by a number of samples, as that many are known to be missing before the first."""
        self._x0 += samples
        self._first_x += samples

    def span_s(self) -> float:
        """Seconds from the first pair to the newest."""
        return self._t0 - self._first_t

    def settled(self) -> bool:
        """Whether the slope rests on enough to tell a hole from jitter."""
        return self._x0 - self._first_x >= LEARN_SAMPLES and self.span_s() >= LEARN_S

    def measured(self, final: bool = False) -> tuple[float, float] | None:
        """Return the rate that the points alone show, and how far it may be off.

        Parameters
        ----------
        final : bool
            True if no more points will come: then LEARN_SAMPLES are enough, however short the time.

        Returns
        -------
        tuple of float, or None
            Rate in Hz and the relative error that is plausible. None until the points show a rate. Delays whose
            standard deviation is s change the slope by at most s/S, where S is the standard deviation of the times
            (Cauchy-Schwarz inequality). For the delays that are left about the line, s/S = √(1/r² − 1), r being the
            correlation of time and index.
        """
        enough = self._x0 - self._first_x >= LEARN_SAMPLES - 1 if final else self.settled() and self.count >= MIN_POINTS
        if not enough or not self._sxt > 0.0:
            return None
        r2 = self._sxt * self._sxt / (self._sxx * self._stt) if self._stt > 0.0 else 0.0
        return self._sxx / self._sxt, SCATTER * sqrt(max(1.0 / r2 - 1.0, 0.0)) if r2 > 0.0 else inf

    def period_s(self) -> float | None:
        """Seconds a sample; None until two pairs have come."""
        if self.count >= 2 and self._sxt > 0.0 and (self.settled() or self._nominal_s is None):
            return self._sxt / self._sxx
        return self._nominal_s if self.count else None

    def rate_hz(self) -> float | None:
        """Samples a second; None until known."""
        period = self.period_s()
        return 1.0 / period if period else None

    def at(self, index: float) -> float:
        """The line's time at an index, s."""
        period = self.period_s() or 0.0
        return self._t0 + self._mt + (index - self._x0 - self._mx) * period


def made_rate(measured_hz: float) -> float:
    """The rate that sensors are made with nearest to the measured one, if within SNAP; else the measured, to 5 digits.

    >>> made_rate(99.97), made_rate(99.32)
    (100.0, 99.32)
    """
    nearest = float(MADE_RATES_HZ[np.argmin(np.abs(np.log(MADE_RATES_HZ / measured_hz)))])
    return nearest if abs(measured_hz / nearest - 1.0) < SNAP else float(f"{measured_hz:.5g}")
