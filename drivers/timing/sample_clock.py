"""Sample clock, which assigns a time to each sample and detects missing and repeated samples.

The wire format (``drivers.data_types.Timing``) determines which of three sources gives the sample times:

- Device counter: counter values give the number of missing samples, and arrival times give the sample times
  (``counter_gaps``).
- Arrival times only: arrival times give the sample times and the number of missing samples (``arrival_timeline``).
- Sender times: the times from the sender are used unchanged (``sender_time_gaps``).

Repeated rows are removed (``duplicate_rows``). Measured values are never changed.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import (
    NO_TICK,
    ArrivalTimedFormat,
    CounterTimedFormat,
    Event,
    Ints,
    SampleBlock,
    SenderTimedFormat,
    Timing,
)
from drivers.timing.arrival_regression import MIN_SAMPLES, MIN_SPAN_S, snap_to_standard_rate
from drivers.timing.arrival_timeline import (
    MAX_RATE_HZ,
    ArrivalTimeline,
    retime_and_split_at_gaps,
    split_by_arrival_time,
)
from drivers.timing.counter_gaps import CounterGaps
from drivers.timing.duplicate_rows import RowFilter
from drivers.timing.event_rate_limiter import EventRateLimiter
from drivers.timing.rate_check import AGREEMENT_LIMIT, RateCheck
from drivers.timing.sender_time_gaps import SenderTimeGapDetector
from drivers.validation.number_ranges import RATE_HZ

MAX_RESUME_DELAY_S: Final = 10.0
"""Assumed maximum delay in s of the last sample before a restart."""
RATE_CHECK_S: Final = 30.0
RATE_CHECK_SAMPLES: Final = (2 * MIN_SAMPLES, round(MIN_SPAN_S * MAX_RATE_HZ))
"""Number of samples after which the rate check is abandoned if no rate has been measured.

The first value applies after RATE_CHECK_S has elapsed, and the second value applies before.
"""


@dataclass(frozen=True, slots=True)
class LastSample:
    """Time, counter value and rates of the last sample before a restart."""

    t_ns: int  # on the same clock as the sample times of the device
    tick: int  # counter value; NO_TICK = none
    rate_hz: float | None
    ticks_per_sample: float | None  # number of counter ticks per sample


class SampleClock:
    """Clock of one device, which assigns sample times and detects missing samples.

    Parameters
    ----------
    timing : Timing
        Timing of the wire format.
    rate_hz : float or None
        Configured sample rate in Hz, or None to measure the sample rate.
    arrivals_are_timed : bool
        False if arrival times are unrelated to the sample rate, as for bytes that are read from a file.
    """

    def __init__(self, timing: Timing, rate_hz: float | None, arrivals_are_timed: bool = True) -> None:
        self._check = None if rate_hz is None else RateCheck(rate_hz)
        self._arrivals_are_timed = arrivals_are_timed
        self._events = EventRateLimiter()
        self._rows = RowFilter(timing, self._events)
        self._timeline = ArrivalTimeline(rate_hz, isinstance(timing, CounterTimedFormat))
        self._answers_requests = isinstance(timing, ArrivalTimedFormat) and timing.answers_requests
        self._counter: CounterGaps | None = None
        self._sender: SenderTimeGapDetector | None = None
        if isinstance(timing, CounterTimedFormat):
            self._counter = CounterGaps(timing, self._timeline, self._events)
        elif isinstance(timing, SenderTimedFormat):
            self._sender = SenderTimeGapDetector(self._timeline, self._rows, self._events)
        self._stamped = 0  # number of time-stamped samples
        self._stamped_s = 0.0  # arrival or sender time from first to newest sample in s
        self._dropped = 0  # number of times that the link has dropped data
        self._ended = self._resumed = self._paused = False
        self._idle_ns: int | None = None  # last time at which the link held no unread data

    def resume_after_restart(self, last_sample: LastSample) -> None:
        """Continue from the last recorded sample before a restart."""
        timeline = self._timeline
        self._resumed = self._paused = True
        timeline.assumed_hz = timeline.nominal_hz or last_sample.rate_hz
        timeline.last_t_ns = timeline.arrived_ns = timeline.origin_ns = last_sample.t_ns
        timeline.earliest_time.start_clock(-MAX_RESUME_DELAY_S)
        if self._sender is not None:
            timeline.line.add_point(timeline.index, 0.0, timeline.assumed_hz)
        if self._counter is not None and last_sample.tick != NO_TICK and last_sample.ticks_per_sample is not None:
            self._counter.resume_at_tick(last_sample.tick, last_sample.ticks_per_sample)

    @property
    def dropped_repeated_rows(self) -> int:
        """Number of samples that were dropped because they repeat an earlier sample."""
        return self._rows.dropped_repeated_rows

    @property
    def dropped_late_rows(self) -> int:
        """Number of samples that were dropped because they arrived after having been counted as missing."""
        return 0 if self._sender is None else self._sender.dropped_late_rows

    @property
    def ticks_per_sample(self) -> float | None:
        """Number of ticks of the device counter per sample, or None before the counter has advanced."""
        return None if self._counter is None else self._counter.typical_step.mean_ticks_per_sample

    @property
    def configured_or_measured_rate_hz(self) -> float | None:
        """Configured or measured sample rate in Hz, or None if the rate is unknown or unsupported.

        A measured rate that contradicts the configured rate replaces it (``drivers.timing.rate_check``).
        """
        if self._check is not None:
            return self._check.rate_hz
        if not self._timeline.line.has_enough_points_for_gaps:
            return self._timeline.assumed_hz
        measured = self._timeline.rate_changes.steady_rate_hz or self._timeline.line.rate_hz()
        return snap_to_standard_rate(measured) if measured and RATE_HZ.supports(measured) else None

    @property
    def measured_hz(self) -> float | None:
        """Sample rate in Hz measured with the clock of the host, or None if unknown."""
        return self._timeline.line.rate_hz() if self._timeline.line.has_enough_points_for_gaps else None

    @property
    def contradicting_rate_hz(self) -> float | None:
        """Measured sample rate in Hz if it contradicts the configured rate; otherwise None."""
        return self._check.measured_hz if self._check is not None and self._check.contradicted else None

    @property
    def rate_check_pending(self) -> bool:
        """True if samples have arrived but the configured sample rate has not been checked yet."""
        if self._check is None or self._check.measured_hz is not None or self._ended:
            return False
        if not self._stamped:
            return self._resumed
        few, many = RATE_CHECK_SAMPLES
        if self._stamped > many or (self._stamped > few and self._stamped_s > RATE_CHECK_S):
            return False
        return self._arrivals_are_timed or self._sender is not None or self._has_device_clock

    def compare_rates_at_end(self) -> None:
        """Check the configured sample rate after the end of the data."""
        if not self._ended and self._check is not None and self._check.measured_hz is None:
            self._check_rate(final=True)
        self._ended = True

    def take_events(self, ended: bool = False) -> list[Event]:
        """Remove and return the queued events. If ``ended`` is True, include all held events."""
        return self._events.take_events(ended)

    def take_false_losses(self) -> int:
        """Return how many samples were counted as missing since the last call only because the rate had changed."""
        count, self._timeline.false_losses = self._timeline.false_losses, 0
        return count

    def count_next_gap_by_arrival(self) -> None:
        """Record that the link was closed. The number of missing samples then follows from the next arrival time."""
        self._paused = True

    def note_stall(self, stall_end_ns: int) -> None:
        """Record that the reader has not run for some time, for example because the process was stopped.

        Until the unread data of this time have been read, arrival times are only upper bounds of the sample times.

        Parameters
        ----------
        stall_end_ns : int
            End of the stall on the host clock in ns.
        """
        self._timeline.note_stall(stall_end_ns)

    def note_end_of_backlog(self, host_t_ns: int) -> None:
        """Record that the samples of all data that had arrived until a time on the host clock have been passed on.

        If a stall ended before this time, samples that should have been taken until this time are missing.
        """
        self._timeline.note_end_of_backlog(host_t_ns)

    def note_dropped_data(self, dropped: int) -> None:
        """Record how often the link has dropped data before the next samples, so that gaps are counted at once."""
        self._timeline.data_were_dropped = dropped > self._dropped
        self._dropped = dropped

    def note_no_unread_data(self, host_t_ns: int) -> None:
        """Record a time on the host clock at which the link contained no unread data.

        The last such time before the first sample limits the possible delay of the first sample.
        """
        self._idle_ns = host_t_ns

    def assign_times(self, samples: SampleBlock) -> list[SampleBlock]:
        """Assign times to samples.

        Parameters
        ----------
        samples : SampleBlock
            Decoded samples. ``t_ns`` contains arrival times or sender times.

        Returns
        -------
        list of SampleBlock
            Blocks of samples with assigned times, split where samples are missing. ``lost`` is the number of missing
            samples before a block.
        """
        timeline = self._timeline
        if timeline.origin_ns is None:
            timeline.origin_ns = int(samples.t_ns[0])
            if self._idle_ns is not None:
                # The first sample was taken after the link was empty, so the sample before it is at most one period
                # older.
                period_s = 1.0 / (timeline.nominal_hz or MAX_RATE_HZ)
                timeline.earliest_time.start_clock(min(timeline.seconds_since_origin(self._idle_ns), 0.0) - period_s)
        self._events.release_held_events(int(samples.t_ns[-1]))
        kept = self._rows.remove_repeats(samples)
        if kept is not None and self._sender is not None:
            kept = self._sender.sort_rows(kept)
        stamped = [] if kept is None else self._stamp(kept)
        self._stamped += sum(len(one) for one in stamped)
        self._stamped_s = timeline.seconds_since_origin(int(samples.t_ns[-1]))
        if timeline.rate_change is not None:
            self._report_rate_change(*timeline.rate_change, int(samples.t_ns[-1]))
            timeline.rate_change = None
        self._check_rate()
        return stamped

    def _report_rate_change(self, old_hz: float | None, new_hz: float, t_ns: int) -> None:
        """Report a change of the sample rate, and compare the new rate with the configured rate at once."""
        if self._counter is not None:
            self._counter.restart_device_clock()
        if self._check is not None:
            self._check.compare_with_measured_rate(new_hz, AGREEMENT_LIMIT)
        old = "" if old_hz is None else f"from {old_hz:.4g} Hz "
        text = f"the sample rate changed {old}to {new_hz:.4g} Hz; the window starts again"
        self._events.report_event("rate_changed", t_ns, text)

    @property
    def _has_device_clock(self) -> bool:
        """True if the device counter measures time."""
        return self._counter is not None and self._counter.clock_line.count > 0

    def _check_rate(self, final: bool = False) -> None:
        """Compare the configured sample rate with the rate measured by the device clock or from arrival times.

        If ``final`` is True, arrival times are not used, because a short series of arrival times is inaccurate.
        """
        line = None
        if self._counter is not None and self._has_device_clock:
            line = self._counter.clock_line
        elif self._sender is not None or (self._arrivals_are_timed and not final):
            line = self._timeline.line
        found = line.measure_rate(final) if self._check is not None and line is not None else None
        if self._check is not None and found is not None:
            self._check.compare_with_measured_rate(found.rate_hz, found.uncertainty)

    def _stamp(self, samples: SampleBlock) -> list[SampleBlock]:
        """Assign sample times and count missing samples according to the timing of the wire format."""
        if self._sender is not None:
            return self._sender.split_at_missing_samples(samples)
        timeline = self._timeline
        # A counter needs the whole block, which shows its typical step.
        by_arrival = self._arrivals_are_timed and samples.ticks[0] == NO_TICK
        by_arrival = by_arrival and (len(samples) == 1 or (samples.ticks == NO_TICK).all())
        batches: Iterable[SampleBlock] = [samples]
        if by_arrival:
            batches = split_by_arrival_time(samples, timeline.origin_ns or 0)
        elif timeline.data_were_dropped:  # before the longest pause, a counter may have wrapped unseen
            at = int(np.argmax(np.diff(samples.t_ns, prepend=timeline.arrived_ns)))
            batches = [samples[:at], samples[at:]] if at else [samples]
        t_ns, missing = [], []
        for batch in batches:
            missing.append(self._count_missing(batch))
            t_ns.append(timeline.add_arrival_and_assign_times(batch, missing[-1]))
        if len(t_ns) == 1:
            return retime_and_split_at_gaps(samples, t_ns[0], missing[0])
        return retime_and_split_at_gaps(samples, np.concatenate(t_ns), np.concatenate(missing))

    def _count_missing(self, samples: SampleBlock) -> Ints:
        """Return the number of missing samples before each sample [n], from the counter or from arrival times."""
        if self._paused and not self._timeline.line.has_enough_points_for_gaps:
            self._timeline.restart_line()  # without a measured rate, the number of missing samples is uncertain
        if self._counter is not None and (samples.ticks != NO_TICK).all():
            missing = self._counter.count_missing(samples, self._paused)
        else:
            if self._counter is not None:
                self._counter.forget_last_tick()
            missing = self._missing_by_arrival(samples)
        self._paused = False
        return missing

    def _missing_by_arrival(self, samples: SampleBlock) -> Ints:
        """Estimate the number of missing samples before each sample [n] from arrival times."""
        timeline, n = self._timeline, len(samples)
        missing = np.zeros(n, np.int64)
        arrived_ns = int(samples.t_ns[-1])
        rejected = samples.lost
        if not self._answers_requests:
            rejected = timeline.count_rejected_samples(arrived_ns, n, rejected)
        if self._paused:
            missing[0] = timeline.count_missing_since_arrival(arrived_ns, n)
            timeline.forget_delay()
        else:
            missing[0] = rejected + timeline.estimate_missing_from_delay(arrived_ns, n, n + rejected)
        return missing
