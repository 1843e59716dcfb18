"""Lower bound of the time at which the newest sample of a device was taken.

The arrival time is only an upper bound of the sample time, because samples may wait in buffers. A clock advances by one
sample period per sample. The lower bound is the time of this clock plus the minimum delay of the arrivals relative to
the clock. Source: Moon, Skelly and Towsley, "Estimation and removal of clock skew from network delay measurements",
1999.

The minimum delay is computed over two consecutive windows of length WINDOW_S, which limits the effect of an incorrect
sample period. The bound is valid if at least one sample in the two windows was read without delay.
"""

from math import inf
from typing import Final

WINDOW_S: Final = 60.0
"""Length in s of each of the two windows over which the minimum delay is computed."""
MAX_STEP_S: Final = 1.0
"""Maximum time in s that one arrival adds to the duration of a window.

Without this limit, a single long pause between arrivals could fill a window.
"""
SETTLED_S: Final = 10.0
"""Minimum time in s over which samples must arrive before the sample period is estimated.

Over a shorter time, a single late arrival would distort the estimated period.
"""
MAX_PROMPT_DELAY_S: Final = 0.05
"""Maximum delay of an arrival, in s above the minimum delay, for a new sample period to be adopted."""


class NewestSampleTimeLowerBound:
    """Estimator of the earliest time at which the newest sample may have been taken.

    Examples
    --------
    >>> bound = NewestSampleTimeLowerBound()
    >>> bound.advance_clock(1, arrived_s=0.0, period_s=0.01)
    >>> bound.advance_clock(100, arrived_s=1.001, period_s=0.01)
    >>> bound.advance_clock(100, arrived_s=9.0, period_s=0.04)  # read 7 s late: no effect
    >>> bound.newest_sample_not_before_s, bound.period_s
    (2.0, 0.01)
    """

    def __init__(self) -> None:
        self.period_s: float | None = None
        """Sample period in s of the host clock, which is updated when a sample is read without delay."""
        self._clock_s: float | None = None  # clock that advances by one period per sample
        self._uncounted = 0.0  # number of samples that arrived before a period was known
        self._start_delay_s = inf  # delay of the start, if the clock was started before the first arrival
        self._delay_s = self._previous_delay_s = inf  # minimum delay of the arrivals in each of two windows
        self._window_s = self._total_s = 0.0  # duration of the current window and of all windows
        self._arrived_s = 0.0  # newest arrival time

    @property
    def newest_sample_not_before_s(self) -> float | None:
        """Earliest possible time of the newest sample in s, or None before the first sample."""
        if self._clock_s is None:
            return None
        return self._clock_s + min(self._start_delay_s, self._delay_s, self._previous_delay_s)

    @property
    def has_enough_arrivals(self) -> bool:
        """True if samples have arrived for at least SETTLED_S, excluding pauses."""
        return self._total_s >= SETTLED_S

    def start_clock(self, previous_sample_not_before_s: float) -> None:
        """Start the clock at the earliest possible time of the previous sample, in s."""
        self._clock_s = self._arrived_s = previous_sample_not_before_s
        self._start_delay_s = 0.0

    def advance_clock(self, samples: float, arrived_s: float, period_s: float | None) -> None:
        """Advance the clock to the newest sample.

        Parameters
        ----------
        samples : float
            Number of sample periods since the last call, including missing samples.
        arrived_s : float
            Arrival time of the newest sample in s.
        period_s : float or None
            Sample period in s estimated from the arrivals so far, or None if unknown.
        """
        self._uncounted += samples
        step_s = 0.0
        if period := self.period_s or period_s:
            step_s, self._uncounted = self._uncounted * period, 0.0
        if self._clock_s is None:
            self.start_clock(arrived_s - step_s)
        assert self._clock_s is not None
        self._clock_s += step_s
        delay_s = arrived_s - self._clock_s
        # The clock does not advance before a period is known, so earlier delays cannot be compared with this delay.
        self._delay_s = delay_s if self.period_s is None else min(self._delay_s, delay_s)
        passed_s = max(min(arrived_s - self._arrived_s, MAX_STEP_S), 0.0)
        self._window_s += passed_s
        self._total_s += passed_s
        self._arrived_s = arrived_s
        ended = self._window_s >= WINDOW_S
        if ended:
            self._previous_delay_s, self._delay_s, self._start_delay_s = self._delay_s, delay_s, inf
            self._window_s = 0.0
        prompt = delay_s < min(self._delay_s, self._previous_delay_s) + MAX_PROMPT_DELAY_S
        if period_s is not None and (prompt or ended):
            self.period_s = period_s
