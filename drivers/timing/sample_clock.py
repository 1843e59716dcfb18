"""Sample clock: gives each sample its time and detects missing samples.

The wire format carries one of three kinds of timing (``drivers.sample.Timing``). Each kind has a module of its own:

- a device counter (``counter_gaps``), which shows missing samples exactly,
- arrival times only (``arrival_timeline``). Missing samples are the rejected frames that the decoder reports, the pause
  while a link was closed, and delays that are not caught up,
- times given by the sender (``sender_times``), which are kept.

In the first two cases, samples are placed on a line that is fitted to the arrival times. ``lost`` of each returned
block counts all samples that are missing just before the block, rejected frames included.

Repeated rows are left out and reported (``duplicate_rows``). There is at most one event of each kind per second of
sample time (``event_rate_limiter``). The sample clock changes no values, does no I/O and reads no clock. Arrival times
and counters are arguments.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.number_ranges import RATE_HZ
from drivers.sample import NO_TICK, CounterTimedFormat, Event, Ints, SampleBlock, SenderTimedFormat, Timing
from drivers.timing.arrival_regression import MIN_SAMPLES, MIN_SPAN_S, snap_to_standard_rate
from drivers.timing.arrival_timeline import MAX_RATE_HZ, ArrivalTimeline
from drivers.timing.counter_gaps import CounterGaps
from drivers.timing.duplicate_rows import RowFilter
from drivers.timing.event_rate_limiter import EventRateLimiter
from drivers.timing.rate_check import RateCheck
from drivers.timing.sender_times import SenderTimes

MAX_RESUME_DELAY_S: Final = 10.0
"""Assumed maximum read delay of the last sample that was recorded before a restart."""
RATE_CHECK_S: Final = 30.0
RATE_CHECK_SAMPLES: Final = (2 * MIN_SAMPLES, round(MIN_SPAN_S * MAX_RATE_HZ))
"""Numbers of samples without a measured rate after which the check of the rate is given up.

The check is given up after the first number if RATE_CHECK_S has passed as well, and after the second number in any
case.
"""


@dataclass(frozen=True, slots=True)
class LastSample:
    """Last sample before a restart of the program."""

    t_ns: int  # in the epoch of the device's times
    tick: int  # counter of the device; NO_TICK = none
    rate_hz: float | None
    ticks_per_sample: float | None  # ticks per sample


class SampleClock:
    """Sample times and missing samples of one device.

    Parameters
    ----------
    timing : Timing
        Timing that the wire format carries.
    rate_hz : float or None
        Configured sample rate in Hz. None if it is to be found from the data.
    arrivals_are_timed : bool
        False if arrival times do not depend on the rate of the device: bytes are read from a file, or a simulated
        sensor runs at another speed.
    """

    def __init__(self, timing: Timing, rate_hz: float | None, arrivals_are_timed: bool = True) -> None:
        self._check = None if rate_hz is None else RateCheck(rate_hz)
        self._arrivals_are_timed = arrivals_are_timed
        self._events = EventRateLimiter()
        self._rows = RowFilter(timing, self._events)
        self._timeline = ArrivalTimeline(rate_hz)
        self._counter: CounterGaps | None = None
        self._sender: SenderTimes | None = None
        if isinstance(timing, CounterTimedFormat):
            self._counter = CounterGaps(timing, self._timeline, self._events)
        elif isinstance(timing, SenderTimedFormat):
            self._sender = SenderTimes(self._timeline, self._rows, self._events)
        self._stamped = 0  # samples
        self._stamped_s = 0.0  # from the first sample to the newest, by their original times
        self._ended = self._resumed = self._paused = False
        self._idle_ns: int | None = None  # the link held no data at this time

    def resume(self, before: LastSample) -> None:
        """Continue from the last sample that was recorded before a restart. The samples since then are missing."""
        timeline = self._timeline
        self._resumed = self._paused = True
        timeline.assumed_hz = timeline.nominal_hz or before.rate_hz
        timeline.last_t_ns = timeline.arrived_ns = timeline.origin_ns = before.t_ns
        timeline.earliest_time.start_clock(-MAX_RESUME_DELAY_S)
        if self._sender is not None:
            timeline.line.add_point(timeline.index, 0.0, timeline.assumed_hz)
        if self._counter is not None and before.tick != NO_TICK and before.ticks_per_sample is not None:
            self._counter.resume(before.tick, before.ticks_per_sample)

    @property
    def dropped_repeated_rows(self) -> int:
        """Number of rows left out because they repeat earlier rows."""
        return self._rows.dropped_repeated_rows

    @property
    def dropped_late_rows(self) -> int:
        """Number of rows left out because they had been counted as missing."""
        return 0 if self._sender is None else self._sender.dropped_late_rows

    @property
    def ticks_per_sample(self) -> float | None:
        """Ticks of the device counter per sample; None until the counter has advanced."""
        return None if self._counter is None else self._counter.typical_step.mean

    @property
    def rate_hz(self) -> float | None:
        """Sample rate in Hz: the configured rate if there is one, otherwise the rate found from the data.

        None at first, and while the data give a rate outside the supported range. If the sample times contradict the
        configured rate, the measured rate replaces it (see ``drivers.timing.rate_check``).
        """
        if self._check is not None:
            return self._check.rate_hz
        if not self._timeline.line.can_tell_gap_from_jitter():
            return self._timeline.assumed_hz
        measured = self._timeline.line.rate_hz()
        return snap_to_standard_rate(measured) if measured and RATE_HZ.supports(measured) else None

    @property
    def measured_hz(self) -> float | None:
        """Sample rate in Hz by the clock of the host, without rounding; None until it is known."""
        return self._timeline.line.rate_hz() if self._timeline.line.can_tell_gap_from_jitter() else None

    @property
    def contradicted_hz(self) -> float | None:
        """Measured rate in Hz that contradicts the configured rate. None if they agree or one of them is unknown."""
        return self._check.measured_hz if self._check is not None and self._check.contradicted else None

    @property
    def rate_check_pending(self) -> bool:
        """True if samples have arrived but the configured rate has not been checked yet."""
        if self._check is None or self._check.measured_hz is not None or self._ended:
            return False
        if not self._stamped:
            return self._resumed
        few, many = RATE_CHECK_SAMPLES
        if self._stamped > many or (self._stamped > few and self._stamped_s > RATE_CHECK_S):
            return False
        return self._arrivals_are_timed or self._sender is not None or self._has_device_clock

    def compare_rates_at_end(self) -> None:
        """Compare the rates with the available samples, since no more samples will arrive."""
        if not self._ended and self._check is not None and self._check.measured_hz is None:
            self._check_rate(final=True)
        self._ended = True

    def take_events(self, ended: bool = False) -> list[Event]:
        """Return the events since the last call. If ``ended`` is True, return the events that are held back, too."""
        return self._events.take_events(ended)

    def note_link_closed(self) -> None:
        """Note that the link was closed. The arrival of the next sample shows how many samples are missing."""
        self._paused = True

    def note_no_unread_data(self, t_ns: int) -> None:
        """Note that the link held no unread data at the host time ``t_ns``. Data that arrive later were sent later.

        Only the time before the first sample is used. It limits how long the first samples may have waited.
        """
        self._idle_ns = t_ns

    def assign_times(self, samples: SampleBlock) -> list[SampleBlock]:
        """Give samples their times.

        Parameters
        ----------
        samples : SampleBlock
            Decoded samples whose ``t_ns`` are arrival times or sender times.

        Returns
        -------
        list of SampleBlock
            The samples with their times. A new block begins where samples are missing.
        """
        timeline = self._timeline
        if timeline.origin_ns is None:
            timeline.origin_ns = int(samples.t_ns[0])
            if self._idle_ns is not None:
                # one period before the first sample, which was not taken before the link was idle
                period_s = 1.0 / (timeline.nominal_hz or MAX_RATE_HZ)
                timeline.earliest_time.start_clock(min(timeline.seconds_since_origin(self._idle_ns), 0.0) - period_s)
        self._events.release_held_events(int(samples.t_ns[-1]))
        kept = self._rows.remove_repeats(samples)
        if kept is not None and self._sender is not None:
            kept = self._sender.sort_rows(kept)
        stamped = [] if kept is None else self._stamp(kept)
        self._stamped += sum(len(one) for one in stamped)
        self._stamped_s = timeline.seconds_since_origin(int(samples.t_ns[-1]))
        self._check_rate()
        return stamped

    @property
    def _has_device_clock(self) -> bool:
        """True if the counter of the device shows the rate by the clock of the device."""
        return self._counter is not None and self._counter.clock_line.count > 0

    def _check_rate(self, final: bool = False) -> None:
        """Compare the configured rate with the rate that the data show, preferably by the clock of the device.

        At the end of a short recording, arrival times show the rate too inaccurately.
        """
        line = None
        if self._counter is not None and self._has_device_clock:
            line = self._counter.clock_line
        elif self._sender is not None or (self._arrivals_are_timed and not final):
            line = self._timeline.line
        found = line.measure_rate(final) if self._check is not None and line is not None else None
        if self._check is not None and found is not None:
            self._check.update(*found)

    def _stamp(self, samples: SampleBlock) -> list[SampleBlock]:
        """Determine missing samples and times according to the timing of the wire format."""
        if self._sender is not None:
            return self._sender.split_at_missing_samples(samples)
        if self._paused and self.rate_hz is None:
            self._timeline.restart_line()  # the number of missing samples is unknown: a line cannot span the pause
        if self._counter is not None and (samples.ticks != NO_TICK).all():
            missing = self._counter.count_missing(samples, self._paused)
        else:
            if self._counter is not None:
                self._counter.forget_last_tick()
            missing = self._missing_by_arrival(samples)
        self._paused = False
        return self._timeline.assign_line_times(samples, missing)

    def _missing_by_arrival(self, samples: SampleBlock) -> Ints:
        """Return the missing samples [n] before each row of samples without a counter."""
        missing = np.zeros(len(samples), np.int64)
        arrived_ns = int(samples.t_ns[-1])
        if self._paused:
            missing[0] = max(samples.lost, self._timeline.count_missing_since_arrival(arrived_ns, len(samples)))
            self._timeline.forget_delay()
        else:
            missing[0] = samples.lost + self._timeline.count_missing_after_delay(
                arrived_ns, len(samples) + samples.lost
            )
        return missing
