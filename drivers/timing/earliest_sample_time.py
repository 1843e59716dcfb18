"""Earliest time at which the newest sample of a device can have been taken.

A sample can be read late but never early. While the reading process gets no processor time, samples wait in the buffers
of the system and then arrive in one burst. The arrival time is therefore only an upper bound of the sample time. A
lower bound follows from a clock that advances by one sample period per sample: the sample time is the clock plus the
minimum delay of the arrivals after this clock (Moon, Skelly and Towsley, "Estimation and removal of clock skew from
network delay measurements", 1999).

The minimum delay is taken over the current window of WINDOW_S and the window before it, so that an error of the assumed
sample period has a limited effect. The bound is valid if at least one sample in the two windows was read without delay.
The module does no I/O and reads no clock.
"""

from math import inf
from typing import Final

WINDOW_S: Final = 60.0
"""Length of each of the two windows over which the minimum delay is taken."""
MAX_STEP_S: Final = 1.0
"""Maximum time that one arrival adds to a window. After a long pause, a single arrival measures only one delay."""
SETTLED_S: Final = 10.0
"""Minimum duration of the arrivals from which the sample period is determined.

In a shorter time, a single late arrival has a large effect on the period.
"""
MAX_PROMPT_DELAY_S: Final = 0.05
"""Maximum delay, relative to the minimum delay, of an arrival at which a new sample period is adopted."""


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
        """Sample period in s by the clock of the host, determined when a sample was read without delay."""
        self._clock_s: float | None = None  # clock that advances by one period per sample
        self._uncounted = 0.0  # number of samples that arrived before a period was known
        self._start_delay_s = inf  # delay of the start, if the clock was started before the first arrival
        self._delay_s = self._previous_delay_s = inf  # minimum delay of the arrivals after the clock, by window
        self._window_s = self._total_s = 0.0  # duration of the current window so far, and of all windows
        self._arrived_s = 0.0  # newest arrival time

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
        """Start the clock at the time ``not_before_s`` in s, before which the previous sample was not taken."""
        self._clock_s = self._arrived_s = not_before_s
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
            Sample period in s according to the arrivals so far; None if the period is unknown.
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
        # without a known period the clock does not advance, so earlier delays cannot be compared
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
