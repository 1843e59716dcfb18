"""Placement of samples on a line of arrival times, and gaps that the arrival times alone show.

A line is fitted with slow forgetting to the sample index and the arrival time of the last sample of each chunk. Samples
are placed on this line. The jitter of a USB port or of the scheduler of the host therefore does not become jitter of
the samples.

A delay that is caught up within CATCH_UP_S was caused by the scheduler of the host. A delay that remains is a gap.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from drivers.sample import NS_PER_S, Ints, SampleBlock, make_block
from drivers.timing.arrival_regression import ArrivalRegression
from drivers.timing.earliest_sample_time import EarliestSampleTime

CATCH_UP_S: Final = 3.0
"""Time within which a delay of the host must be caught up. Otherwise samples are missing."""
MIN_GAP_PERIODS: Final = 3.0
"""Shortest pause of the arrivals, in sample periods, that can be a gap."""
MIN_GAP_S: Final = 0.05
"""Shortest pause of the arrivals, in seconds, that can be a gap."""
JUMP_S: Final = 1.0
"""A device counter has jumped if one step is ahead of the clock of the host by more than this time."""
PERIOD_TOLERANCE: Final = 0.05
"""Plausible relative error of the sample period when the missing samples of a gap are compared with a time."""
MAX_RATE_HZ: Final = 32_000.0
"""Highest sample rate of an inertial sensor. It limits the number of missing samples if the rate is implausible."""
MAX_GAP_SAMPLES: Final = 10**10
"""Longest gap in samples, 116 days at 1 kHz. Sender times that advance by more were set, and the gap is limited."""
MAX_OFFSET_S: Final = 4.6e9
"""Largest time from the first sample: half of the range of int64 nanoseconds."""


class ArrivalTimeline:
    """Sample index, and line of arrival time against sample index.

    Parameters
    ----------
    nominal_hz : float or None
        Configured sample rate in Hz.
    """

    def __init__(self, nominal_hz: float | None) -> None:
        self.nominal_hz = nominal_hz
        self.assumed_hz = nominal_hz
        """Rate in Hz until the line shows one: the configured rate, or the rate before a restart of the program."""
        self.line = ArrivalRegression()
        self.earliest_time = EarliestSampleTime()
        self.index = 0.0
        """Number of samples since the start, missing samples included."""
        self.arrived_ns = 0
        """Time of the newest arrival."""
        self.last_t_ns = -(1 << 62)
        """Time of the newest sample."""
        self.origin_ns: int | None = None
        """Origin of the times in seconds. A float64 of Unix time would resolve only 240 ns."""
        self._delay: _Delay | None = None

    def seconds_since_origin(self, t_ns: int) -> float:
        """Return the seconds since the first sample."""
        return (t_ns - (self.origin_ns or 0)) / NS_PER_S

    def restart_line(self) -> None:
        """Begin a new line, because the number of missing samples is unknown or the clock has jumped."""
        self.line = ArrivalRegression()

    def undelayed_period_s(self) -> float | None:
        """Return the sample period in s without the effect of late readings.

        The configured period is used until the arrivals show one.
        """
        found = self.line.measure_rate() if self.earliest_time.has_enough_arrivals else None
        if found is not None and found[1] < PERIOD_TOLERANCE:
            return 1.0 / found[0]
        return None if self.earliest_time.period_s or not self.assumed_hz else 1.0 / self.assumed_hz

    def assign_line_times(self, samples: SampleBlock, missing: Ints) -> list[SampleBlock]:
        """Add the newest arrival to the line, and give the samples their times on it.

        Parameters
        ----------
        samples : SampleBlock
            Samples with their arrival times.
        missing : array of int64, shape (n,)
            Number of missing samples before each row.
        """
        index = self.index + np.cumsum(missing + 1)
        passed = float(index[-1]) - self.index
        self.index = float(index[-1])
        self.arrived_ns = int(samples.t_ns[-1])
        arrived_s = self.seconds_since_origin(self.arrived_ns)
        if self._delay is None:  # a possible gap must not bend the line
            # the last sample of a chunk has waited for the shortest time
            self.line.add_point(self.index, arrived_s, self.nominal_hz)
        self.earliest_time.advance_clock(passed, arrived_s, self.undelayed_period_s())
        period_s = self.line.period_s() or 1.0 / NS_PER_S  # the first samples of an unknown rate are at least in order
        # no sample is newer than its arrival, apart from the scatter of the line
        newest_s = min(self.line.time_at_index_s(self.index), arrived_s + JUMP_S)
        t_s = newest_s - (self.index - index) * period_s
        if t_s[0] < -MAX_OFFSET_S or t_s[-1] > MAX_OFFSET_S:  # arrivals decades apart must stay within int64
            t_s = np.clip(t_s, -MAX_OFFSET_S, MAX_OFFSET_S)
        t_ns = np.rint(t_s * NS_PER_S).astype(np.int64) + (self.origin_ns or 0)
        if t_ns[0] <= self.last_t_ns or (t_ns[1:] <= t_ns[:-1]).any():
            # the line was corrected backwards, or is coarser than a period far from its origin: keep the order
            order = np.arange(len(samples))
            t_ns = np.maximum.accumulate(np.maximum(t_ns - order, self.last_t_ns + 1)) + order
        self.last_t_ns = int(t_ns[-1])
        return split_at_gaps(samples, t_ns, missing)

    def count_missing_since_arrival(self, arrived_ns: int, arrived: int) -> int:
        """Return the number of samples missing since the last arrival if ``arrived`` samples arrive at ``arrived_ns``.

        Parameters
        ----------
        arrived_ns : int
            Arrival time of the newest sample in ns.
        arrived : int
            Number of samples that have arrived since the last arrival.
        """
        rate_hz = self.line.rate_hz() or self.assumed_hz
        if not rate_hz or not self.arrived_ns:
            return 0
        elapsed_s = (arrived_ns - self.arrived_ns) / NS_PER_S
        return min(max(0, round(elapsed_s * min(rate_hz, MAX_RATE_HZ)) - arrived), MAX_GAP_SAMPLES)

    def forget_delay(self) -> None:
        """Discard a delay that was not decided yet, because the link was closed in the meantime."""
        self._delay = None

    def count_missing_after_delay(self, arrived_ns: int, counted: int, least: float = MIN_GAP_PERIODS) -> int:
        """Return the number of samples missing because of a sudden delay that was not caught up within CATCH_UP_S.

        Parameters
        ----------
        arrived_ns : int
            Arrival time of the newest sample in ns.
        counted : int
            Samples that have arrived or are known to be missing since the last call.
        least : float
            Smallest number of missing samples that counts as a gap.
        """
        period_s = self.line.period_s()
        if period_s is None or not self.line.can_tell_gap_from_jitter():
            return 0
        least_s = max(least * period_s, MIN_GAP_S)
        index, arrived_s = self.index + counted, self.seconds_since_origin(arrived_ns)
        behind_s = arrived_s - self.line.time_at_index_s(index)
        if self._delay is None:
            pause_s = (arrived_ns - self.arrived_ns) / NS_PER_S - counted * period_s
            if pause_s > least_s and behind_s > least_s:
                self._delay = _Delay(arrived_ns, behind_s, ArrivalRegression())
                self._delay.line.add_point(index, arrived_s, self.nominal_hz)
            return 0
        delay = self._delay
        delay.least_s = min(delay.least_s, behind_s)
        delay.line.add_point(index, arrived_s, self.nominal_hz)
        if delay.least_s < least_s:  # caught up: the host was late
            self._delay = None
            return 0
        if arrived_ns - delay.since_ns < CATCH_UP_S * NS_PER_S:
            return 0
        gap = min(round(delay.least_s / max(period_s, 1.0 / MAX_RATE_HZ)), MAX_GAP_SAMPLES)
        delay.line.shift_points(gap)
        rest_s = behind_s - gap * period_s
        if delay.line.is_slower_than(period_s):  # the delay grows since the period is wrong
            self.line, self._delay = delay.line, None
        elif rest_s > least_s:  # another delay may have begun in the meantime
            delay.since_ns, delay.least_s = arrived_ns, rest_s
        else:
            self._delay = None
        return gap


@dataclass(slots=True)
class _Delay:
    """Sudden delay of the arrivals that may turn out to be a gap."""

    since_ns: int  # first late arrival, or the arrival at which a gap was last reported
    least_s: float  # minimum lag of all arrivals since then relative to the line
    line: ArrivalRegression  # fitted to all arrivals since the first late one


def split_at_gaps(samples: SampleBlock, t_ns: Ints, missing: Ints) -> list[SampleBlock]:
    """Return blocks with new sample times. A new block begins wherever samples are missing.

    Parameters
    ----------
    samples : SampleBlock
        Samples to split.
    t_ns : array of int64, shape (n,)
        Time of each sample in ns.
    missing : array of int64, shape (n,)
        Number of missing samples before each row.
    """
    edges = [0, *(np.flatnonzero(missing[1:]) + 1).tolist(), len(samples)]
    return [
        make_block(
            t_ns[a:b].copy(), samples.values[a:b], samples.temperature_c[a:b], samples.ticks[a:b], int(missing[a])
        )
        for a, b in pairwise(edges)
    ]
