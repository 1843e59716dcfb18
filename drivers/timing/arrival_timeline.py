"""Estimate sample times and missing samples from arrival times.

Sample times lie on a line fitted to arrival time against sample index, so that transport jitter has little effect.

The arrival time is an upper bound of the sample time, because samples may wait in a buffer. Only prompt arrivals change
the line. A short delay of the arrivals is attributed to the scheduler of the host. A delay that lasts for CATCH_UP_S
means that samples are missing. After the reader itself has stalled, the arrivals count as late until they come no
faster than the device measures, or until the link is known to have held no unread data. If the samples are behind the
line at that time, the buffer of the kernel has overflowed, and the samples in between are missing.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from drivers.data_types import NS_PER_S, Ints, SampleBlock
from drivers.timing.arrival_regression import ArrivalRegression
from drivers.timing.newest_sample_time_lower_bound import NewestSampleTimeLowerBound
from drivers.timing.rate_change import RateChangeDetector
from drivers.timing.rejected_frames import RejectedFrameTest

CATCH_UP_S: Final = 3.0
"""Time in s after which a persistent delay of the arrivals means that samples are missing."""
MIN_SUDDEN_CHANGE: Final = 0.05
"""Minimum relative decrease of the sample rate that begins with a pause of the samples."""
MIN_GAP_PERIODS: Final = 3.0
"""Shortest pause between arrivals that can indicate missing samples, in sample periods."""
MIN_GAP_S: Final = 0.05
"""Shortest pause between arrivals that can indicate missing samples, in seconds."""
BURST_PERIODS: Final = 2.0
"""Number of sample periods by which samples may arrive faster than the device measures without being a backlog."""
JUMP_S: Final = 1.0
"""Maximum time in s by which a device clock may get ahead of the host clock. A larger step is a clock jump."""
PERIOD_TOLERANCE: Final = 0.05
"""Assumed relative error of the sample period."""
MAX_RATE_HZ: Final = 32_000.0
"""Highest plausible sample rate of an inertial sensor, which limits the number of missing samples."""
MAX_GAP_SAMPLES: Final = 10**10
"""Maximum number of consecutive missing samples (116 days at 1 kHz)."""
UNKNOWN_BACKLOG_NS: Final = 500_000_000
"""Time in ns after a stall in which samples count as a backlog if no earlier sample shows the rate."""
BATCH_NS: Final = 100_000_000
"""Duration in ns of the arrivals that become one point of the regression."""
SINGLE_NS: Final = 2_000_000_000
"""Time in ns after the first sample during which each arrival becomes a point, because the rate is not known yet."""
MAX_OFFSET_S: Final = 4.6e9
"""Largest time in s since the first sample. The value is half of the range of int64 nanoseconds."""


class ArrivalTimeline:
    """Estimator of the sample times and missing samples of one device.

    The estimator fits a line to the arrival time as a function of the sample index.

    Parameters
    ----------
    nominal_hz : float or None
        Configured sample rate in Hz, until the rate has changed.
    losses_are_counted : bool
        True if a counter shows how many samples are missing.
    """

    def __init__(self, nominal_hz: float | None, losses_are_counted: bool) -> None:
        self.nominal_hz = nominal_hz
        self.assumed_hz = nominal_hz
        """Sample rate in Hz before a rate has been measured: the configured rate, or the rate before a restart."""
        self.line = ArrivalRegression()
        self.earliest_time = NewestSampleTimeLowerBound()
        self.index = 0.0
        """Number of received and missing samples so far."""
        self.arrived_ns = 0
        """Newest arrival time in ns."""
        self.last_t_ns = -(1 << 62)
        """Time of the newest sample in ns."""
        self.origin_ns: int | None = None
        """Origin of times in seconds.

        Without an origin, Unix times in float64 would have a resolution of only 240 ns.
        """
        self.false_losses = 0
        """Number of samples that were counted as missing before a change of the sample rate was detected."""
        self.rate_change: tuple[float | None, float] | None = None
        """Old and new sample rate in Hz after a change of the rate, until ``SampleClock`` has reported the change."""
        self.data_were_dropped = False
        """True if the link has dropped data between the newest samples."""
        self.rate_changes = RateChangeDetector(losses_are_counted)
        self._rejected_frames = RejectedFrameTest()
        self._delay: _Delay | None = None
        self._stall_end_ns: int | None = None  # end of a stall of the reader, until its backlog has been read
        self._backlog_end_s: float | None = None  # time until which the newest backlog reached, if the rate is known

    def seconds_since_origin(self, t_ns: int) -> float:
        """Return the time since the first sample in seconds."""
        return (t_ns - (self.origin_ns or 0)) / NS_PER_S

    def restart_line(self) -> None:
        """Discard the regression line after a clock jump or an unknown number of missing samples."""
        self.line = ArrivalRegression()
        self.rate_changes.restart()

    def change_rate(self, rate_hz: float, line: ArrivalRegression | None = None) -> None:
        """Continue with another sample rate.

        Parameters
        ----------
        rate_hz : float
            New sample rate in Hz.
        line : ArrivalRegression, optional
            Regression line of the samples since the change. Without a line, the regression starts again.
        """
        old_hz = self.rate_changes.steady_rate_hz or self.line.rate_hz() or self.assumed_hz
        self.rate_change = (old_hz, rate_hz)
        self.restart_line()
        self.line = line or self.line
        self.nominal_hz = self.assumed_hz = rate_hz
        self._delay = None

    def find_rate_change(self, index: float, t_s: float) -> None:
        """Add a prompt sample to the detector of rate changes, and adopt a new sample rate."""
        changed = self.rate_changes.add_point(index, t_s, self.line)
        found = changed.measure_rate() if changed is not None else None
        if found is not None:
            self.change_rate(found.rate_hz, changed)

    def undelayed_period_s(self) -> float | None:
        """Return the sample period in s, estimated without delayed arrivals.

        Until a period has been measured, the configured period is returned.
        """
        found = self.line.measure_rate() if self.earliest_time.has_enough_arrivals else None
        if found is not None and found.uncertainty < PERIOD_TOLERANCE:
            return 1.0 / found.rate_hz
        return None if self.earliest_time.period_s or not self.assumed_hz else 1.0 / self.assumed_hz

    def add_arrival_and_assign_times(self, samples: SampleBlock, missing: Ints) -> Ints:
        """Add the newest arrival to the regression, and return the times [n] in ns of the samples on the fitted line.

        Parameters
        ----------
        samples : SampleBlock
            Samples with arrival times.
        missing : array of int64, shape (n,)
            Number of missing samples before each sample.
        """
        index = self.index + np.cumsum(missing + 1)
        passed = float(index[-1]) - self.index
        previous_index, previous_ns = self.index, self.arrived_ns
        self.index = float(index[-1])
        self.arrived_ns = int(samples.t_ns[-1])
        arrived_s = self.seconds_since_origin(self.arrived_ns)
        if self._arrivals_are_prompt:
            # The last sample of a chunk has the shortest delay.
            self.line.add_point(self.index, arrived_s, self.nominal_hz)
            self.find_rate_change(self.index, arrived_s)
        elif self._line_is_backlog:
            self.restart_line()
            if previous_ns and not self.nominal_hz:  # the rate between two reads is better than none
                self.line.add_point(previous_index, self.seconds_since_origin(previous_ns))
            self.line.add_point(self.index, arrived_s, self.nominal_hz)
        self.earliest_time.advance_clock(passed, arrived_s, self.undelayed_period_s())
        period_s = self.line.period_s() or 2.0 / NS_PER_S  # without a rate, only the order is known
        # A sample cannot have been taken after it arrived. JUMP_S allows for the jitter of the arrival times.
        newest_s = min(self.line.time_at_index_s(self.index), arrived_s + JUMP_S)
        t_s = newest_s - (self.index - index) * period_s
        if t_s[0] < -MAX_OFFSET_S or t_s[-1] > MAX_OFFSET_S:  # the times must fit into int64 nanoseconds
            t_s = np.clip(t_s, -MAX_OFFSET_S, MAX_OFFSET_S)
        t_ns: Ints = np.rint(t_s * NS_PER_S).astype(np.int64) + (self.origin_ns or 0)
        if t_ns[0] < self.last_t_ns + 2 or (t_ns.size > 1 and (t_ns[1:] < t_ns[:-1] + 2).any()):
            # The line has moved backwards, or float64 is too coarse. Keep the sample times increasing by at least 2 ns,
            # so that they also increase after rounding on a clock that is slewed.
            order = 2 * np.arange(len(samples))
            t_ns = np.maximum.accumulate(np.maximum(t_ns - order, self.last_t_ns + 2)) + order
        self.last_t_ns = int(t_ns[-1])
        return t_ns

    def count_rejected_samples(self, arrived_ns: int, arrived: int, rejected: int) -> int:
        """Return how many of the frames that were rejected before the newest samples were samples.

        Parameters
        ----------
        arrived_ns : int
            Arrival time of the newest sample in ns.
        arrived : int
            Number of samples that have arrived since the last call.
        rejected : int
            Number of frames that were rejected before these samples.
        """
        arrived_s = self.seconds_since_origin(arrived_ns)
        return self._rejected_frames.count_missing(arrived_s, arrived, rejected, self.line.period_s())

    def count_missing_since_arrival(self, arrived_ns: int, arrived: int) -> int:
        """Estimate the number of missing samples from the time since the previous arrival.

        Parameters
        ----------
        arrived_ns : int
            Arrival time of the newest sample in ns.
        arrived : int
            Number of samples that have arrived since the previous arrival time.
        """
        rate_hz = self.line.rate_hz() or self.assumed_hz
        if not rate_hz or not self.arrived_ns:
            return 0
        elapsed_s = (arrived_ns - self.arrived_ns) / NS_PER_S
        return min(max(0, round(elapsed_s * min(rate_hz, MAX_RATE_HZ)) - arrived), MAX_GAP_SAMPLES)

    @property
    def _arrivals_are_prompt(self) -> bool:
        """True unless the newest samples may have waited in a buffer, or samples before them may be missing."""
        return self._delay is None and (self._stall_end_ns is None or self.arrived_ns < self._stall_end_ns)

    @property
    def _line_is_backlog(self) -> bool:
        """True if the line gives no period, or consists of samples that may have waited during a stall."""
        if self._stall_end_ns is None or self._delay is not None:
            return False
        return self.line.period_s() is None or self.line.first_t_s >= self.seconds_since_origin(self._stall_end_ns)

    def note_stall(self, stall_end_ns: int) -> None:
        """Record that the reader has not run for some time before ``stall_end_ns``, so that unread data have waited."""
        if self._line_is_backlog:
            self.restart_line()
        self._stall_end_ns = stall_end_ns

    def note_end_of_backlog(self, host_t_ns: int) -> None:
        """Record that all samples that had arrived until ``host_t_ns`` have been added."""
        if self._stall_end_ns is None or host_t_ns < self._stall_end_ns - BATCH_NS or self._line_is_backlog:
            return
        self._delay = self._stall_end_ns = None
        self._backlog_end_s = self.seconds_since_origin(host_t_ns)

    def forget_delay(self) -> None:
        """Discard the current delay of the arrivals, because the link was closed."""
        self._delay = self._stall_end_ns = self._backlog_end_s = None

    def estimate_missing_from_delay(self, arrived_ns: int, arrived: int, counted: int, unit: float = 1.0) -> int:
        """Estimate the number of missing samples from a sudden delay of the arrivals.

        The delay has to last for CATCH_UP_S, unless the link has dropped data. After a stall of the reader, the delay
        is evaluated as soon as the backlog has been read.

        Parameters
        ----------
        arrived_ns : int
            Arrival time of the newest sample in ns.
        arrived : int
            Number of samples that have arrived since the last call.
        counted : int
            Number of samples since the last call that have arrived or are known to be missing.
        unit : float
            Number of samples of which the result is a multiple.
        """
        period_s = self.line.period_s()
        if period_s is None:
            return 0
        least_s = max(MIN_GAP_PERIODS * period_s, MIN_GAP_S)
        if gap := self._count_missing_after_backlog(counted - arrived, least_s, period_s, unit):
            return gap
        index, arrived_s = self.index + counted, self.seconds_since_origin(arrived_ns)
        behind_s = arrived_s - self.line.time_at_index_s(index)
        elapsed_s = (arrived_ns - max(self.arrived_ns, self._stall_end_ns or 0)) / NS_PER_S
        is_backlog = (arrived - BURST_PERIODS) * period_s > elapsed_s
        if self._stall_end_ns is not None and arrived_ns >= self._stall_end_ns:
            if self._line_is_backlog and not self.nominal_hz:  # the line gives the rate at which the backlog was read
                is_backlog = arrived_ns - self._stall_end_ns < UNKNOWN_BACKLOG_NS
            if is_backlog:
                return 0
            self._delay = self._stall_end_ns = None
            gap = _count_samples(behind_s, period_s, unit) if behind_s > least_s else 0
            if gap:
                return gap
        if not self.line.has_enough_points_for_gaps:
            return 0
        pause_s = (arrived_ns - self.arrived_ns) / NS_PER_S - counted * period_s
        if self.data_were_dropped and min(pause_s, behind_s) > period_s:
            self._delay = None
            return _count_samples(behind_s, period_s, unit)
        if self._delay is None:
            if pause_s > least_s and behind_s > least_s:
                self._delay = _Delay(arrived_ns, behind_s, ArrivalRegression())
                self._delay.line.add_point(index, arrived_s, self.nominal_hz)
            return 0
        if not is_backlog:
            self._delay.line.add_point(index, arrived_s, self.nominal_hz)
        return self._update_delay(self._delay, arrived_ns, behind_s, unit)

    def _count_missing_after_backlog(self, known: int, least_s: float, period_s: float, unit: float) -> int:
        """Return the number of samples that should have been taken before the end of the backlog, and are missing.

        ``known`` samples after the backlog are known to be missing. A gap shorter than ``least_s`` seconds is jitter.
        """
        if self._backlog_end_s is None:
            return 0
        missing_s = self._backlog_end_s - self.line.time_at_index_s(self.index + known)
        self._backlog_end_s = None
        return _count_samples(missing_s, period_s, unit) if missing_s > least_s else 0

    def _update_delay(self, delay: "_Delay", arrived_ns: int, behind_s: float, unit: float) -> int:
        """Return the number of missing samples once a delay has lasted for CATCH_UP_S, and 0 otherwise."""
        period_s = self.line.period_s()
        assert period_s is not None
        least_s = max(MIN_GAP_PERIODS * period_s, MIN_GAP_S)
        delay.least_s = min(delay.least_s, behind_s)
        if delay.least_s < least_s:  # the arrivals have caught up, so only the host was delayed
            self._delay = None
            return 0
        if arrived_ns - delay.since_ns < CATCH_UP_S * NS_PER_S:
            return 0
        found, is_slower = delay.line.measure_rate(), False
        if found is not None:
            slower, uncertainty = 1.0 - found.rate_hz * period_s, self.rate_changes.uncertainties * found.uncertainty
            if slower > MIN_SUDDEN_CHANGE + uncertainty:
                self.change_rate(found.rate_hz, delay.line)
                return 0
            is_slower = slower > uncertainty
        gap = _count_samples(delay.least_s, period_s, unit)
        delay.line.shift_points(gap)
        rest_s = behind_s - gap * period_s
        # If the delay grows, the assumed period is wrong. Without missing samples, the arrivals have become later.
        if not gap or is_slower:
            self.line, self._delay = delay.line, None
        elif rest_s > least_s:  # another delay may have begun since
            delay.since_ns, delay.least_s = arrived_ns, rest_s
        else:
            self._delay = None
        return gap


@dataclass(slots=True)
class _Delay:
    """Sudden delay of the arrivals, possibly caused by missing samples."""

    since_ns: int  # time of the first delayed arrival, or of the last reported gap
    least_s: float  # minimum delay of the arrivals since ``since_ns`` relative to the fitted line
    line: ArrivalRegression  # line fitted to the arrivals since the first delayed arrival


def _count_samples(duration_s: float, period_s: float, unit: float) -> int:
    """Return the number of samples in a duration as a multiple of ``unit``, limited to MAX_GAP_SAMPLES."""
    units = round(duration_s / max(period_s, 1.0 / MAX_RATE_HZ) / unit)
    return min(round(units * unit), MAX_GAP_SAMPLES) if units else 0


def split_by_arrival_time(samples: SampleBlock, origin_ns: int) -> Iterator[SampleBlock]:
    """Yield the samples in batches of up to BATCH_NS, because only the newest arrival of a batch is used.

    Parameters
    ----------
    samples : SampleBlock
        Samples with arrival times.
    origin_ns : int
        Arrival time of the first sample of the device in ns.
    """
    t_ns = samples.t_ns
    if t_ns.size == 1 or (t_ns == t_ns[0]).all():  # usually, the samples of a chunk arrive together
        yield samples
        return
    batch = np.where(t_ns - origin_ns < SINGLE_NS, t_ns, t_ns // BATCH_NS)
    edges = [0, *(np.flatnonzero(np.diff(batch)) + 1).tolist(), len(samples)]
    for first, last in pairwise(edges):
        yield samples[first:last]


def retime_and_split_at_gaps(samples: SampleBlock, t_ns: Ints, missing: Ints) -> list[SampleBlock]:
    """Split a sample block where samples are missing, and assign new times to the samples.

    Parameters
    ----------
    samples : SampleBlock
        Samples to split.
    t_ns : array of int64, shape (n,)
        Time of each sample in ns.
    missing : array of int64, shape (n,)
        Number of missing samples before each sample.
    """
    if missing.size == 1 or not missing[1:].any():
        return [samples.with_times(t_ns, int(missing[0]))]
    edges = [0, *(np.flatnonzero(missing[1:]) + 1).tolist(), len(samples)]
    parts = ((a, samples[a:b]) for a, b in pairwise(edges))
    return [one.with_times(t_ns[a : a + len(one)].copy(), int(missing[a])) for a, one in parts]
