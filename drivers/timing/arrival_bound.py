"""Lower bound of the arrival times: when the newest sample of a device can have been taken at the earliest.

A sample can be read late but never early. It waits in the buffers of the system while the reading process gets no
processor time, and then arrives in one burst with the samples after it. Its arrival time is therefore only an upper
bound of the time at which it was taken. The earliest arrivals, compared with a clock that counts samples, bound the
time from below (Moon, Skelly and Towsley, "Estimation and removal of clock skew from network delay measurements",
1999). The bound is the minimum over the last WINDOW_S to twice WINDOW_S of steady reading, so that an error of the
assumed sample period is forgotten. It holds as long as the reader was not late throughout that time.
No I/O, no clock.
"""

from math import inf
from typing import Final

WINDOW_S: Final = 60.0
"""Length of each of the two windows of the minimum, in s."""
LONGEST_STEP_S: Final = 1.0
"""One arrival makes a window at most this much longer: a reader that slept for a minute has seen one delay only."""
SETTLED_S: Final = 10.0
"""Arrivals of a shorter time show no sample period: one late arrival among them changes it too much."""
PROMPT_S: Final = 0.05
"""A sample that arrives within this time of the bound has not waited. Only then is a new sample period adopted."""


class ArrivalBound:
    """Earliest host time at which the newest sample can have been taken.

    Examples
    --------
    >>> bound = ArrivalBound()
    >>> bound.update(1, arrived_s=0.0, period_s=0.01)
    >>> bound.update(100, arrived_s=1.001, period_s=0.01)
    >>> bound.update(100, arrived_s=9.0, period_s=0.04)  # read 7 s late: neither the bound nor the period follows
    >>> bound.newest_s, bound.period_s
    (2.0, 0.01)
    """

    def __init__(self) -> None:
        self.period_s: float | None = None
        """Sample period in s of the host's clock, as of the last samples that were read without delay."""
        self._clock_s: float | None = None  # goes on by one period a sample; newest sample = this + least delay
        self._uncounted = 0.0  # samples that came before a period was known
        self._start_delay_s = inf  # of the start, where it is older than the first arrival
        self._delay_s = self._previous_delay_s = inf  # least delay of an arrival after the clock, in two windows
        self._window_s = self._total_s = 0.0  # length of the current window so far, and of all
        self._arrived_s = 0.0  # newest arrival

    @property
    def newest_s(self) -> float | None:
        """Earliest time at which the newest sample can have been taken, in s; None before the first sample."""
        if self._clock_s is None:
            return None
        return self._clock_s + min(self._start_delay_s, self._delay_s, self._previous_delay_s)

    @property
    def settled(self) -> bool:
        """True if samples have arrived for SETTLED_S, pauses of the reader not counted."""
        return self._total_s >= SETTLED_S

    def start(self, taken_s: float) -> None:
        """Begin with a sample, read before, that was not taken before ``taken_s``, in s."""
        self._clock_s = self._arrived_s = taken_s
        self._start_delay_s = 0.0

    def update(self, samples: float, arrived_s: float, period_s: float | None) -> None:
        """Go on to a newer sample.

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
            self.start(arrived_s - step_s)
        assert self._clock_s is not None
        self._clock_s += step_s
        delay_s = arrived_s - self._clock_s
        # without a period the clock stands still, and earlier delays say nothing
        self._delay_s = delay_s if self.period_s is None else min(self._delay_s, delay_s)
        passed_s = max(min(arrived_s - self._arrived_s, LONGEST_STEP_S), 0.0)
        self._window_s += passed_s
        self._total_s += passed_s
        self._arrived_s = arrived_s
        ended = self._window_s >= WINDOW_S
        if ended:
            self._previous_delay_s, self._delay_s, self._start_delay_s = self._delay_s, delay_s, inf
            self._window_s = 0.0
        prompt = delay_s < min(self._delay_s, self._previous_delay_s) + PROMPT_S
        if period_s is not None and (prompt or ended):
            self.period_s = period_s
