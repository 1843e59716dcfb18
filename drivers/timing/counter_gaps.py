"""Detect missing samples from the values of a device counter.

Counter values give the exact number of missing samples. If a counter may have wrapped several times, the number of
wraps is estimated from arrival times (``drivers.timing.arrival_timeline``).

A counter step that is larger than the elapsed time allows is a counter jump
(``drivers.timing.newest_sample_time_lower_bound``). After a counter jump, the number of missing samples is estimated
from arrival times.
"""

from collections import deque
from typing import Final

import numpy as np

from drivers.data_types import NS_PER_S, CounterTimedFormat, Ints, SampleBlock
from drivers.timing.arrival_regression import ArrivalRegression
from drivers.timing.arrival_timeline import JUMP_S, MAX_GAP_SAMPLES, MAX_RATE_HZ, PERIOD_TOLERANCE, ArrivalTimeline
from drivers.timing.event_rate_limiter import EventRateLimiter
from drivers.timing.rate_change import RateChangeDetector, count_false_losses

MAX_STEP_TICKS: Final = 1 << 62
"""Largest possible step of a device counter."""
MIN_STUCK_SAMPLES: Final = 10
"""Number of consecutive samples with the same counter value after which a stuck counter is reported."""
STEP_HISTORY: Final = 16
"""Number of recent counter steps from which the typical step is determined."""
MIN_NEW_STEPS: Final = 12
"""Number of recent counter steps that differ from the typical step after a change of the sample rate.

If 5 % of the samples are lost independently, the probability of 12 such steps of 16 is 4e-13.
"""
STEP_TOLERANCE: Final = 0.25
"""Maximum relative difference between a counter step and the typical step."""
RATE_TOLERANCE: Final = 0.1
"""Relative difference between the nominal and the typical step up to which a step near the typical one counts as one
sample."""


class CounterGaps:
    """Detector of missing samples from the counter values of one device.

    Parameters
    ----------
    counter : CounterTimedFormat
        Modulus and tick duration of the counter.
    timeline : ArrivalTimeline
        Arrival times of the samples.
    events : EventRateLimiter
        Queue for events about counter jumps and a stuck counter.
    """

    def __init__(self, counter: CounterTimedFormat, timeline: ArrivalTimeline, events: EventRateLimiter) -> None:
        self.typical_step = _TypicalStep()
        self.clock_line = ArrivalRegression()
        """Regression of device time on sample index. The regression is empty if the tick duration is unknown."""
        self._counter = counter
        self._timeline = timeline
        self._events = events
        self._tick: int | None = None  # last counter value
        self._rate_changes = RateChangeDetector(losses_are_counted=True)  # on the clock of the device
        self._clock_s = self._clock_index = 0.0
        self._stuck = 0  # number of samples since the counter last advanced

    def resume_at_tick(self, tick: int, ticks_per_sample: float) -> None:
        """Continue from the last counter value before a program restart.

        Parameters
        ----------
        tick : int
            Last counter value.
        ticks_per_sample : float
            Number of ticks per sample.
        """
        self._tick = tick
        self.typical_step.add_steps(np.array([round(ticks_per_sample)]))

    def restart_device_clock(self) -> None:
        """Discard the regression of device time after a change of the sample rate."""
        self.clock_line = ArrivalRegression()
        self._rate_changes.restart()

    def forget_last_tick(self) -> None:
        """Discard the last counter value after samples without a counter value."""
        self._tick = None

    def count_missing(self, samples: SampleBlock, link_was_closed: bool) -> Ints:
        """Return the number of missing samples before each sample [n].

        Parameters
        ----------
        samples : SampleBlock
            Samples with arrival times and counter values.
        link_was_closed : bool
            True if the link was closed before these samples.
        """
        counter, arrived_ns = self._counter, int(samples.t_ns[-1])
        first = self._tick is None
        previous = int(samples.ticks[0]) if self._tick is None else self._tick
        steps = np.empty(len(samples), np.int64)
        steps[0] = samples.ticks[0] - previous % counter.modulus
        np.subtract(samples.ticks[1:], samples.ticks[:-1], out=steps[1:])
        steps %= counter.modulus
        before = self.typical_step.mean_ticks_per_sample
        near_typical = self.typical_step.add_steps(steps)
        if before is not None and self.typical_step.changed:
            self._adopt_new_step(before, len(steps))
        ticks_per_sample = self._ticks_per_sample()
        regular = near_typical and not first and self._counts_single_samples(ticks_per_sample)
        if not first and ticks_per_sample is not None:
            samples_by_ticks = len(samples) if regular else int(np.rint(steps / ticks_per_sample).sum())
            wraps = self._hidden_wraps(len(samples), samples_by_ticks, ticks_per_sample, arrived_ns, link_was_closed)
            steps[0] += counter.modulus * wraps
            regular = regular and not wraps
        self._tick = int(samples.ticks[-1])
        if regular:
            return self._advance_device_clock(steps, np.zeros(len(samples), np.int64))
        waited = self._find_stuck_counter(samples, steps[1:] if first else steps)
        missing = np.zeros(len(samples), np.int64)
        if ticks_per_sample is not None:
            counted = np.rint(np.minimum(steps / ticks_per_sample, MAX_GAP_SAMPLES)).astype(np.int64)
            missing = np.maximum(counted - 1 - waited, 0)
        unseen = (
            self._timeline.count_missing_since_arrival(arrived_ns, len(samples)) if first and link_was_closed else 0
        )
        if not steps.any():  # a stuck counter says nothing about missing samples
            missing[0] = unseen
        elif missing.any() and self._has_jumped(missing, steps, arrived_ns):
            self._discard_jump(samples, missing, steps, first)
        if first:
            missing[0] = unseen
        return self._advance_device_clock(steps, missing)

    def _advance_device_clock(self, steps: Ints, missing: Ints) -> Ints:
        """Add the newest sample to the regression of device time, and return ``missing``."""
        if self._counter.tick_s is not None:
            self._clock_s += float(steps.sum()) * self._counter.tick_s
            self._clock_index += len(steps) + int(missing.sum())
            self.clock_line.add_point(self._clock_index, self._clock_s)
            changed = self._rate_changes.add_point(self._clock_index, self._clock_s, self.clock_line)
            found = changed.measure_rate() if changed is not None else None
            if found is not None:
                self._timeline.change_rate(found.rate_hz)
        return missing

    def _adopt_new_step(self, before: float, newest: int) -> None:
        """Adopt the new sample rate after most of the recent steps differ from the step ``before``.

        The ``newest`` steps have not been counted yet.
        """
        after, rate_hz = self.typical_step.mean_ticks_per_sample, self._timeline.line.rate_hz()
        if after is None or self._counter.tick_s is None:
            return
        counted = self.typical_step.recent[: max(len(self.typical_step.recent) - newest, 0)]
        self._timeline.false_losses += count_false_losses(counted / before, counted / after)
        if self._timeline.line.has_enough_points_for_gaps and rate_hz is not None:
            self._timeline.change_rate(1.0 / (after * self._counter.tick_s))

    def _counts_single_samples(self, ticks_per_sample: float | None) -> bool:
        """Return True if steps near the typical step mean that no sample is missing and that the counter works."""
        typical = self.typical_step.mean_ticks_per_sample
        if self._stuck or not typical or ticks_per_sample is None or self._sample_period_s() is None:
            return False
        return abs(ticks_per_sample / typical - 1.0) < RATE_TOLERANCE

    def _discard_jump(self, samples: SampleBlock, missing: Ints, steps: Ints, first: bool) -> None:
        """Report a counter jump, and correct ``missing`` and ``steps`` in place from arrival times."""
        arrived_ns, ahead = int(samples.t_ns[-1]), int(steps.max())
        modulus = self._counter.modulus
        elapsed_s = (arrived_ns - self._timeline.arrived_ns) / NS_PER_S
        moved = f"back by {modulus - ahead}" if 2 * ahead > modulus else f"ahead by {ahead}"
        text = f"the counter jumped {moved} ticks within {elapsed_s:.3f} s"
        self._events.report_event("clock_jumped", int(samples.t_ns[0]), text)
        self.clock_line = ArrivalRegression()
        at = int(np.argmax(steps))
        missing[at] = steps[at] = 0
        if self._has_jumped(missing, steps, arrived_ns):  # a second jump makes every step unreliable
            missing[:] = 0
        if not first:
            missing[at] = self._timeline.count_missing_since_arrival(arrived_ns, len(samples) + int(missing.sum()))

    def _ticks_per_sample(self) -> float | None:
        seen, rate_hz = self.typical_step.mean_ticks_per_sample, self._timeline.nominal_hz
        if self._counter.tick_s is None or rate_hz is None:
            return seen
        nominal = 1.0 / (rate_hz * self._counter.tick_s)
        # If the nominal rate does not match the typical step, the typical step is used.
        return nominal if seen is None or abs(seen - nominal) < 0.5 * nominal else seen

    def _sample_period_s(self) -> float | None:
        return self._timeline.earliest_time.period_s or self._timeline.undelayed_period_s()

    def _hidden_wraps(
        self, arrived: int, counted: int, ticks_per_sample: float, arrived_ns: int, link_was_closed: bool
    ) -> int:
        """Estimate how many additional times the counter has wrapped during a pause of the data.

        ``arrived`` is the number of samples that have arrived, and ``counted`` is the number according to the counter.
        """
        counter, timeline = self._counter, self._timeline
        by_ticks_hz = 1.0 / (ticks_per_sample * counter.tick_s) if counter.tick_s else timeline.assumed_hz
        rate_hz = timeline.line.rate_hz() or by_ticks_hz
        if rate_hz is None:
            return 0
        turn = counter.modulus / ticks_per_sample  # number of samples per wrap of the counter
        if link_was_closed:
            timeline.forget_delay()
            elapsed_s = (arrived_ns - timeline.arrived_ns) / NS_PER_S
            turns = max(0, round((elapsed_s * rate_hz - counted) / turn))
        else:
            turns = round(timeline.estimate_missing_from_delay(arrived_ns, arrived, counted, turn) / turn)
        return turns if turns * counter.modulus < MAX_STEP_TICKS else 0

    def _find_stuck_counter(self, samples: SampleBlock, steps: Ints) -> Ints:
        """Report a stuck counter. Return the number of samples with a stuck counter before each sample [n]."""
        before = self._stuck
        if not before and steps.all():
            return np.zeros(len(samples), np.int64)
        moved = np.flatnonzero(steps)
        self._stuck = before + len(steps) if moved.size == 0 else len(steps) - 1 - int(moved[-1])
        if before < MIN_STUCK_SAMPLES <= self._stuck:
            text = f"the counter stopped at {samples.ticks[-1]}"
            self._events.report_event("clock_jumped", int(samples.t_ns[-1]), text)
        waited = np.zeros(len(samples), np.int64)
        if moved.size:
            at = moved + len(samples) - len(steps)
            waited[at] = np.diff(moved, prepend=-1 - before) - 1
        return np.where(waited >= MIN_STUCK_SAMPLES, waited, 0)

    def _has_jumped(self, missing: Ints, steps: Ints, arrived_ns: int) -> bool:
        """Return True if the elapsed time is too short for the number of missing samples.

        The elapsed time starts at the earliest possible time of the previous sample, because the previous sample may
        have arrived late.
        """
        counter, timeline = self._counter, self._timeline
        period_s = self._sample_period_s()
        lost = float(missing.sum(dtype=np.float64))
        lasted_s = lost / MAX_RATE_HZ
        if period_s is not None:
            lasted_s = max(lost * (1.0 - PERIOD_TOLERANCE) * period_s, lasted_s)
        elif counter.tick_s is not None:
            lasted_s = max(float(steps.sum(dtype=np.float64)) * counter.tick_s, lasted_s)
        elif 2 * int(steps.max()) > counter.modulus:  # a step above half the modulus is probably a step back
            return True
        arrived_s = timeline.seconds_since_origin(arrived_ns)
        taken_s = timeline.earliest_time.newest_sample_not_before_s
        return lasted_s > max(arrived_s - (arrived_s if taken_s is None else taken_s), 0.0) + JUMP_S


class _TypicalStep:
    """Typical step of a counter: the mean of all steps near the median of recent steps."""

    def __init__(self) -> None:
        self._recent: deque[int] = deque(maxlen=STEP_HISTORY)
        self._sum = self._count = 0
        self.changed = False
        """True if the newest steps have changed the typical step."""

    @property
    def recent(self) -> Ints:
        """Recent steps [n], oldest first."""
        return np.array(self._recent, np.int64)

    @property
    def mean_ticks_per_sample(self) -> float | None:
        """Mean number of ticks per sample, or None before the counter has advanced."""
        return self._sum / self._count if self._count else None

    def add_steps(self, steps: Ints) -> bool:
        """Add counter steps to the mean, and return True if all of them are near it. Steps of zero are ignored."""
        mean, self.changed = self.mean_ticks_per_sample, False
        if mean is not None and (np.abs(steps / mean - 1.0) < STEP_TOLERANCE).all():
            self._recent.extend(steps[-STEP_HISTORY:].tolist())
            self._add_to_mean(steps)
            return True
        moved = steps[steps > 0]
        self._recent.extend(moved[-STEP_HISTORY:].tolist())
        near = self._near(moved)
        self._add_to_mean(near)
        if near.size < moved.size:
            recent = np.array(self._recent)
            new = recent.size - self._near(recent).size
            if new >= MIN_NEW_STEPS or (mean is None and 2 * new > recent.size):  # start again
                self.changed = True
                self._sum = self._count = 0
                self._add_to_mean(recent[np.abs(recent / np.median(recent) - 1.0) < STEP_TOLERANCE])
        return False

    def _add_to_mean(self, steps: Ints) -> None:
        self._sum += int(steps.sum())
        self._count += int(steps.size)

    def _near(self, steps: Ints) -> Ints:
        mean = self.mean_ticks_per_sample
        return steps[:0] if mean is None else steps[np.abs(steps / mean - 1.0) < STEP_TOLERANCE]
