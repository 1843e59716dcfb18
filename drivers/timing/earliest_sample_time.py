"""Lower bound of sample times: the earliest time at which the newest sample of a device can have been taken.

A sample can be read late but never early. While the reading process gets no processor time, samples wait in the
buffers of the system. They then arrive in one burst. The arrival time of a sample is therefore only an upper bound of
the time at which it was taken. The earliest arrivals, compared with a clock that counts samples, bound the time from
below (Moon, Skelly and Towsley, "Estimation and removal of clock skew from network delay measurements", 1999).

The bound is the minimum over the last WINDOW_S to twice WINDOW_S of steady reading, so that an error of the assumed
sample period is forgotten. The bound holds if at least one sample of that time was read without delay. The module does
no I/O and reads no clock.
"""

from math import inf
from typing import Final

WINDOW_S: Final = 60.0
"""Length of each of the two windows of the minimum."""
MAX_STEP_S: Final = 1.0
"""Maximum time that one arrival adds to a window. A reader that slept for a minute has measured only one delay."""
SETTLED_S: Final = 10.0
"""Minimum time of arrivals that show a sample period.

In a shorter time, one late arrival changes the period too much.
"""
MAX_PROMPT_DELAY_S: Final = 0.05
"""A sample that arrives within this time of the bound has not waited. Only then is a new sample period adopted."""


class EarliestSampleTime:
    """Earliest host time at which the newest sample can have been taken.

    Examples
    --------
    >>> bound = EarliestSampleTime()
    >>> bound.advance_clock(1, arrived_s=0.0, period_s=0.01)
    >>> bound.advance_clock(100, arrived_s=1.001, period_s=0.01)
    >>> bound.advance_clock(100, arrived_s=9.0, period_s=0.04)  # read 7 s late: no effect
    >>> bound.newest_sample_not_before_s, bound.period_s
    (2.0, 0.01)
    """

    def __init__(self) -> None:
        self.period_s: float | None = None
        """Sample period in s by the clock of the host, from the last samples that were read without delay."""
        self._clock_s: float | None = None  # advances by one period per sample; newest sample = this + minimum delay
        self._uncounted = 0.0  # samples that arrived before a period was known
        self._start_delay_s = inf  # delay of the start, if the start is older than the first arrival
        self._delay_s = self._previous_delay_s = inf  # minimum delay of an arrival after the clock, in the two windows
        self._window_s = self._total_s = 0.0  # length of the current window so far, and of all windows
        self._arrived_s = 0.0  # time of the newest arrival

    @property
    def newest_sample_not_before_s(self) -> float | None:
        """Earliest time at which the newest sample can have been taken, in s; None before the first sample."""
        if self._clock_s is None:
            return None
        return self._clock_s + min(self._start_delay_s, self._delay_s, self._previous_delay_s)

    @property
    def has_enough_arrivals(self) -> bool:
        """True if samples have arrived for SETTLED_S. Pauses of the reader do not count."""
        return self._total_s >= SETTLED_S

    def start_clock(self, not_before_s: float) -> None:
        """Start the clock at a sample that was read earlier and was not taken before ``not_before_s`` (in s)."""
        self._clock_s = self._arrived_s = not_before_s
        self._start_delay_s = 0.0

    def advance_clock(self, samples: float, arrived_s: float, period_s: float | None) -> None:
        """Advance the clock to a newer sample.

        Parameters
        ----------
        samples : float
            Number of sample periods since the last call, missing samples included.
        arrived_s : float
            Arrival time of the newest sample on the host in s.
        period_s : float or None
            Sample period in s that the arrivals show now; None if they do not show it.
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
        # without a period the clock does not advance, and earlier delays are not comparable
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
