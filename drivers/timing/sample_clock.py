"""Sample clock: gives each sample its time and detects missing samples.

The module does no I/O and reads no clock. Arrival times and counters are arguments.

**Sample times.** The wire format carries one of three kinds of timing (``drivers.sample.Timing``): a device counter,
arrival times only, or times given by the sender. In the first two cases, a line is fitted with slow forgetting to the
sample index and the arrival time of the last sample of each chunk. Samples are placed on this line. The jitter of a USB
port or of the scheduler of the host therefore does not become jitter of the samples.

**Missing samples.** A counter shows missing samples exactly. Without a counter there are three sources: rejected frames
that the decoder reports, the pause while a link was closed, and a sudden delay. A delay that is caught up within
CATCH_UP_S was caused by the scheduler. A delay that remains is a gap. The same delay shows how often a short counter
has wrapped unseen. A sample may be read late but never early. A step of the counter is therefore a gap if that many
samples fit between the earliest time at which the last sample can have been taken (``drivers.timing.arrival_bound``)
and the arrival. A longer step is a jump of the counter, and the arrival time decides how many samples are missing.
``lost`` of each returned block counts all samples that are missing just before it, rejected frames included.

**Repeated and reordered rows.** A row that repeats the counter or given time and the values of another row is left out
and reported. A row with the same key and other values is kept and reported. If the given times of one block form a
steady sequence in another order, the rows are sorted. A row that arrives after its place was reported as missing is
left out and reported (``drivers.timing.duplicate_rows``). There is at most one event of each kind per second of sample
time.

The module changes no values. If the times are too coarse for a decision, every row stays in the order of arrival.
"""

from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from drivers.quantities import RATE_HZ
from drivers.sample import NO_TICK, CounterTiming, Event, Floats, Ints, SampleBlock, SenderTiming, Timing, make_block
from drivers.timing.arrival_bound import ArrivalBound
from drivers.timing.arrival_regression import MIN_SAMPLES, MIN_SPAN_S, ArrivalRegression, snap_to_standard_rate
from drivers.timing.duplicate_rows import (
    NS_PER_S,
    SEARCH_ROWS,
    STEP_TOLERANCE,
    DuplicateDetector,
    EventRateLimiter,
    steady_order,
)
from drivers.timing.rate_check import RateCheck

CATCH_UP_S: Final = 3.0
"""Time within which a delay of the host must be caught up. Otherwise samples are missing."""
MIN_GAP_PERIODS: Final = 3.0
MIN_GAP_S: Final = 0.05
"""Samples are missing if a pause of the arrivals exceeds this time and MIN_GAP_PERIODS, and is not caught up within
CATCH_UP_S.
"""
JUMP_S: Final = 1.0
"""A device counter has jumped if one step is ahead of the clock of the host by more than this time."""
PERIOD_TOLERANCE: Final = 0.05
"""Plausible relative error of the sample period when the missing samples of a gap are compared with a time."""
MAX_RESUME_DELAY_S: Final = 10.0
"""Assumed maximum read delay of the last sample that was recorded before a restart."""
FORWARD_JUMP_S: Final = 3600.0
"""A step of given times beyond this time is reported as an event as well."""
MAX_RATE_HZ: Final = 32_000.0
"""No inertial sensor is read faster.

This rate limits the number of missing samples if the rate is unknown or implausible.
"""
RATE_CHECK_S: Final = 30.0
RATE_CHECK_SAMPLES: Final = (2 * MIN_SAMPLES, round(MIN_SPAN_S * MAX_RATE_HZ))
"""Samples without a measured rate after which the check of the rate is given up.

The check is given up after the first number if RATE_CHECK_S has passed as well, and after the second number in any
case.
"""
MAX_GAP_SAMPLES: Final = 10**10
"""Longest gap in samples, 116 days at 1 kHz. If given times advance by more, their clock was set, and the gap is
limited to this number.
"""
MAX_OFFSET_S: Final = 4.6e9
"""Largest time from the first sample: half of the range of int64 nanoseconds."""
MAX_STEP_TICKS: Final = 1 << 62
"""Largest step of the counter."""
MIN_STUCK_SAMPLES: Final = 10
"""Consecutive samples with the same counter value after which the counter is reported as stuck."""
STEP_HISTORY: Final = 255
"""Number of recent steps, of a counter or of given times, from which the typical step is determined."""
CERTAIN_GAP_PERIODS: Final = 4.0
"""A longer step of given times is a gap even if it is not a whole number of periods."""
MAX_LATENESS_RATIO: Final = 8.0
"""A given time is late, with no sample missing, up to this multiple of the upper quartile of the typical deviation."""


@dataclass(frozen=True, slots=True)
class LastSample:
    """Last sample before a restart of the program."""

    t_ns: int  # in the epoch of the device's times
    tick: int  # counter of the device; NO_TICK = none
    rate_hz: float | None
    tick_step: float | None  # ticks per sample


class SampleClock:
    """Sample times and missing samples of one device.

    Parameters
    ----------
    timing
        Timing that the wire format carries.
    rate_hz
        Nominal sample rate in Hz. None if it is to be found from the data.
    arrivals_are_timed
        False if arrival times do not depend on the rate of the device: bytes are read from a file, or a simulated
        sensor runs at another speed.
    """

    def __init__(self, timing: Timing, rate_hz: float | None, arrivals_are_timed: bool = True) -> None:
        self._timing = timing
        self._nominal_hz = rate_hz
        self._check = None if rate_hz is None else RateCheck(rate_hz)
        self._arrivals_are_timed = arrivals_are_timed
        self._stamped = 0  # samples
        self._stamped_s = 0.0  # from the first sample to the newest, by their original times
        self._ended = self._resumed = False
        self.repeated_rows = 0
        """Rows left out because they repeat earlier rows."""
        self.late_rows = 0
        """Rows left out because their places had been reported as missing."""
        self._telling = EventRateLimiter()
        self._repeats = DuplicateDetector(ordered=isinstance(timing, SenderTiming))
        self._missing_t_ns: deque[int] = deque(
            maxlen=SEARCH_ROWS
        )  # times in ns of samples that were reported as missing
        self._carried_lost = 0  # missing samples before rows that were left out
        self._line = ArrivalRegression()
        self._origin_ns: int | None = None  # origin of seconds, as a float64 of Unix time resolves only 240 ns
        self._last_t_ns = -(1 << 62)
        self._index = 0.0  # samples since the line's start, missing ones included
        self._arrived_ns = 0  # time of the newest arrival
        self._delay: _Delay | None = None
        self._tick: int | None = None  # last counter value
        self._tick_step = _CounterStep()
        self._device_line = ArrivalRegression()  # device clock against sample index, if the length of a tick is known
        self._device_s = self._device_index = 0.0
        self._went_back = False
        self._given_steps: deque[float] = deque(maxlen=STEP_HISTORY)  # s
        self._stuck = 0
        self._paused = False
        self._bound = ArrivalBound()
        self._idle_ns: int | None = None  # the link held no data at this time
        self._earlier_hz: float | None = None  # rate before a restart of the program, used until the line shows one

    def resume(self, before: LastSample) -> None:
        """Continue from the last sample that was recorded before a restart. The samples since then are missing."""
        self._resumed = True
        self._earlier_hz = self._nominal_hz or before.rate_hz
        self._last_t_ns = self._arrived_ns = before.t_ns
        self._origin_ns = before.t_ns
        self._bound.start(-MAX_RESUME_DELAY_S)
        if isinstance(self._timing, SenderTiming):
            self._line.add(self._index, 0.0, self._earlier_hz)
        if before.tick != NO_TICK and before.tick_step is not None:
            self._tick = before.tick
            self._tick_step.see(np.array([round(before.tick_step)]))
        self._paused = True

    @property
    def tick_step(self) -> float | None:
        """Ticks of the device counter per sample; None until the counter has advanced."""
        return self._tick_step.usual()

    @property
    def rate_hz(self) -> float | None:
        """Sample rate in Hz: the nominal rate if there is one, otherwise the rate found from the data.

        None at first, and while the data give a rate outside the supported range. If the sample times contradict the
        nominal rate, the measured rate replaces it (see ``drivers.timing.rate_check``).
        """
        if self._check is not None:
            return self._check.rate_hz
        if self._nominal_hz or not self._line.settled():
            return self._nominal_hz or self._earlier_hz
        measured = self._line.rate_hz()
        return snap_to_standard_rate(measured) if measured and RATE_HZ.supports(measured) else None

    @property
    def measured_hz(self) -> float | None:
        """Sample rate in Hz by the clock of the host, without rounding; None until it is known."""
        return self._line.rate_hz() if self._line.settled() else None

    @property
    def contradicted_hz(self) -> float | None:
        """Measured rate in Hz that contradicts the nominal rate. None if the rates agree or one of them is unknown."""
        return self._check.measured_hz if self._check is not None and self._check.contradicted else None

    @property
    def rate_check_pending(self) -> bool:
        """True if samples have arrived but the check of the nominal rate has not been made yet."""
        if self._check is None or self._check.measured_hz is not None or self._ended:
            return False
        if not self._stamped:
            return self._resumed
        few, many = RATE_CHECK_SAMPLES
        if self._stamped > many or (self._stamped > few and self._stamped_s > RATE_CHECK_S):
            return False
        return self._arrivals_are_timed or isinstance(self._timing, SenderTiming) or self._device_line.count > 0

    def end(self) -> None:
        """Compare the rates with the available samples, since no more samples will arrive."""
        if self._check is None or self._ended:
            return
        self._ended = True
        line = self._line if isinstance(self._timing, SenderTiming) else self._device_line
        found = line.measured(final=True) if self._check.measured_hz is None else None
        if found is not None:
            self._check.update(*found)

    def take_events(self, ended: bool = False) -> list[Event]:
        """Return the events since the last call. If ``ended`` is True, return the events that are held back, too."""
        return self._telling.take(ended)

    def pause(self) -> None:
        """Note that the link was closed. The arrival of the next sample shows how many samples are missing."""
        self._paused = True

    def link_idle(self, t_ns: int) -> None:
        """Note that the link held no unread data at the host time ``t_ns``. Data that arrive later were sent later.

        Only the time before the first sample is used. It limits how long the first samples may have waited.
        """
        self._idle_ns = t_ns

    def assign_times(self, samples: SampleBlock) -> list[SampleBlock]:
        """Give samples their times.

        Parameters
        ----------
        samples
            Decoded samples whose ``t_ns`` are arrival times or given times.

        Returns
        -------
        list of SampleBlock
            The samples with their times. A new block begins where samples are missing.
        """
        if self._origin_ns is None:
            self._origin_ns = int(samples.t_ns[0])
            if self._idle_ns is not None:
                # one period before the first sample, which was not taken before the link was idle
                self._bound.start(min(self._seconds(self._idle_ns), 0.0) - 1.0 / (self._nominal_hz or MAX_RATE_HZ))
        self._telling.tell_due(int(samples.t_ns[-1]))
        kept = self._sort_given_times(self._remove_repeats(samples))
        stamped = self._stamp(kept) if kept is not None else []
        self._stamped += sum(len(one) for one in stamped)
        self._stamped_s = self._seconds(int(samples.t_ns[-1]))
        if self._check is not None and (found := self._rate_line().measured()) is not None:
            self._check.update(*found)
        return stamped

    def _rate_line(self) -> ArrivalRegression:
        """Return the line that shows the rate of the device, preferably by the clock of the device. It may be empty."""
        timed = self._arrivals_are_timed or isinstance(self._timing, SenderTiming)
        return self._line if timed and not self._device_line.count else self._device_line

    def _stamp(self, samples: SampleBlock) -> list[SampleBlock]:
        """Determine missing samples and times according to the timing of the wire format."""
        if isinstance(self._timing, SenderTiming):
            return self._use_given_times(samples)
        if self._paused and self.rate_hz is None:
            self._line = (
                ArrivalRegression()
            )  # the number of missing samples is unknown, so a line cannot span the pause
        if isinstance(self._timing, CounterTiming) and (samples.ticks != NO_TICK).all():
            return self._place_on_line(samples, self._counted_gaps(samples, self._timing))
        self._tick = None  # samples without a counter value interrupt the count
        return self._place_on_line(samples, self._arrival_gaps(samples))

    def _seconds(self, t_ns: int) -> float:
        """Return the seconds since the first sample."""
        return (t_ns - (self._origin_ns or 0)) / NS_PER_S

    # --- repeated and late rows

    def _remove_repeats(self, samples: SampleBlock) -> SampleBlock | None:
        """Remove rows that repeat an earlier row; None if no row remains."""
        given = isinstance(self._timing, SenderTiming)
        if not given and (not isinstance(self._timing, CounterTiming) or (samples.ticks == NO_TICK).any()):
            return samples
        keys, word = (samples.t_ns, "time") if given else (samples.ticks, "count")
        repeats, shared = self._repeats.find(keys, samples.values)
        t_ns = int(samples.t_ns[-1])
        if shared:
            text = f"{{n}} rows have the {word} of another row and other values; all are kept"
            self._event("samples_repeated", t_ns, text, shared)
        if repeats is None:
            return samples
        n = int(repeats.sum())
        self.repeated_rows += n
        self._event("samples_repeated", t_ns, f"{{n}} rows repeat others, {word} and values; left out", n)
        return self._select_rows(samples, np.flatnonzero(~repeats))

    def _sort_given_times(self, samples: SampleBlock | None) -> SampleBlock | None:
        """Sort rows of one block by their given times, and remove rows whose places were reported as missing."""
        if samples is None or not isinstance(self._timing, SenderTiming):
            return samples
        t = samples.t_ns
        if not self._line.count or (t[0] >= self._last_t_ns and (len(t) == 1 or (np.diff(t) >= 0).all())):
            return samples
        period_s = self._given_period_s(np.diff(t))
        if not period_s:
            return samples
        if self._missing_t_ns:
            samples = self._remove_late_rows(samples, period_s)
            if samples is None:
                return None
            t = samples.t_ns
        steps = np.diff(t)
        order = None if (steps < -JUMP_S * NS_PER_S).any() else steady_order(t, period_s)
        if order is None:
            return samples
        n = int((steps < 0).sum())
        self._event("clock_jumped", int(t[-1]), "rows that came out of order: {n}; put in order", n)
        return self._select_rows(samples, order)

    def _remove_late_rows(self, samples: SampleBlock, period_s: float) -> SampleBlock | None:
        """Remove rows whose places were reported as missing; None if no row remains."""
        holes = np.array(self._missing_t_ns)
        far = np.abs(samples.t_ns[:, None] - holes)
        late = (samples.t_ns < self._last_t_ns) & (far.min(axis=1) < STEP_TOLERANCE * period_s * NS_PER_S)
        if not late.any():
            return samples
        filled = set(far[late].argmin(axis=1).tolist())
        self._missing_t_ns = deque((t for i, t in enumerate(self._missing_t_ns) if i not in filled), maxlen=SEARCH_ROWS)
        n = int(late.sum())
        self.late_rows += n
        text = "{n} samples came after later ones, their places passed on as missing; left out"
        self._event("clock_jumped", int(samples.t_ns[-1]), text, n)
        return self._select_rows(samples, np.flatnonzero(~late))

    def _select_rows(self, samples: SampleBlock, rows: Ints) -> SampleBlock | None:
        """Return these rows in this order. Samples missing before a removed row are missing before the next row."""
        if not rows.size:
            self._carried_lost += samples.lost
            return None
        lost, self._carried_lost = samples.lost + self._carried_lost, 0
        return make_block(
            samples.t_ns[rows], samples.values[rows], samples.temperature_c[rows], samples.ticks[rows], lost
        )

    # --- times given by the sender

    def _use_given_times(self, samples: SampleBlock) -> list[SampleBlock]:
        """Keep the given times, and find the gaps in them."""
        t = samples.t_ns
        steps = np.empty(len(samples), np.int64)
        steps[0] = t[0] - self._last_t_ns if self._line.count else 0
        np.subtract(t[1:], t[:-1], out=steps[1:])
        shortest, longest = int(steps.min()), int(steps.max())
        jumps = np.zeros(0, np.int64)
        if shortest < 0 or longest > FORWARD_JUMP_S * NS_PER_S:
            self._report_jumps(t, steps)
            jumps = np.flatnonzero((steps < -JUMP_S * NS_PER_S) | (steps > FORWARD_JUMP_S * NS_PER_S))
        period_s = self._given_period_s(steps)
        missing = np.zeros(len(samples), np.int64)
        if period_s:
            missing = self._given_gaps(steps / NS_PER_S, period_s)
        missing[0] = max(int(missing[0]), samples.lost)
        index = self._index + np.cumsum(missing + 1)
        # a line must not contain a jump
        at = int(jumps[-1]) if jumps.size else 0
        if jumps.size:
            self._line = ArrivalRegression()
        for row in (at, len(samples) - 1):
            self._line.add(float(index[row]), self._seconds(int(t[row])))
        self._index, self._last_t_ns = float(index[-1]), int(t[-1])
        if period_s and missing.any():
            for row in np.flatnonzero((missing > 0) & (missing <= SEARCH_ROWS)).tolist():
                places = np.arange(1, missing[row] + 1) * min(
                    period_s * NS_PER_S, float(1 << 54)
                )  # 2 years: within int64
                self._missing_t_ns.extend((t[row] - np.rint(places)).astype(np.int64).tolist())
        return _split_at_gaps(samples, t, missing)

    def _given_period_s(self, steps: Ints) -> float | None:
        """Return the period for the search of gaps; None as long as all samples may be one burst of a late sender."""
        if self._line.settled():
            return self._line.period_s()
        if rate := self._nominal_hz or self._earlier_hz:
            return 1.0 / rate
        return _typical_period_s(steps) if steps.sum() > MIN_SPAN_S * NS_PER_S else None

    def _report_jumps(self, t: Ints, steps: Ints) -> None:
        """Report times that went back or jumped ahead."""
        back = steps < (-JUMP_S * NS_PER_S if self._went_back else 0.0)  # jitter back and forth is reported once
        if back.any():
            at = int(np.argmax(back))
            self._event("clock_jumped", int(t[at]), f"time went back by {-steps[at] / NS_PER_S:.6g} s")
            self._went_back = True
        if (steps > FORWARD_JUMP_S * NS_PER_S).any():
            at = int(np.argmax(steps))
            self._event("clock_jumped", int(t[at]), f"time went on by {steps[at] / NS_PER_S:.6g} s at one step")

    def _given_gaps(self, steps_s: Floats, period_s: float) -> Ints:
        """Return the missing samples [n] before each row; all zero unless most steps are one period long.

        Times that a host has stamped are early or late by whole periods although no sample is missing. A short gap must
        therefore be a whole number of periods and longer than the typical deviation. No neighbouring step may
        compensate it.
        """
        last_s = self._given_steps[-1] if self._given_steps else period_s
        self._given_steps.extend(steps_s[-STEP_HISTORY:].tolist())
        periods = steps_s / period_s
        if periods.max() < 1.5:
            return np.zeros(steps_s.size, np.int64)
        before = np.concatenate([[last_s], steps_s[:-1]])
        after = np.concatenate([steps_s[1:], [period_s]])
        off = np.abs(np.array(self._given_steps) / period_s - 1.0)
        if np.median(off) > STEP_TOLERANCE:
            return np.zeros(steps_s.size, np.int64)
        gap = np.rint(np.clip(periods, 0.0, MAX_GAP_SAMPLES)).astype(np.int64) - 1
        late = (periods < CERTAIN_GAP_PERIODS) & (np.abs(periods - np.rint(periods)) > STEP_TOLERANCE)
        late |= periods < 1.0 + max(0.5, MAX_LATENESS_RATIO * float(np.quantile(off, 0.75)))
        late |= steps_s + np.minimum(before, after) < 2.5 * period_s
        gap[late] = 0
        return gap

    # --- missing samples

    def _counted_gaps(self, samples: SampleBlock, counter: CounterTiming) -> Ints:
        """Return the missing samples [n] before each row according to the counter of the device."""
        arrived_ns = int(samples.t_ns[-1])
        elapsed_s = (arrived_ns - self._arrived_ns) / NS_PER_S
        first = self._tick is None
        previous = int(samples.ticks[0]) if self._tick is None else self._tick
        steps = np.empty(len(samples), np.int64)
        steps[0] = samples.ticks[0] - previous % counter.modulus
        np.subtract(samples.ticks[1:], samples.ticks[:-1], out=steps[1:])
        steps %= counter.modulus
        self._tick_step.see(steps)
        size = self._ticks_a_sample(counter)
        if not first:
            steps[0] += counter.modulus * self._hidden_wraps(steps, size, counter, arrived_ns)
        self._tick = int(samples.ticks[-1])
        waited = self._find_stuck_counter(samples, steps[1:] if first else steps)
        missing = np.zeros(len(samples), np.int64)
        if size is not None:
            missing = np.maximum(np.rint(np.minimum(steps / size, MAX_GAP_SAMPLES)).astype(np.int64) - 1 - waited, 0)
        unseen = self._missing_samples_in(elapsed_s, len(samples)) if first and self._paused else 0
        if not steps.any():  # a stuck counter shows nothing
            missing[0] = max(samples.lost, unseen)
        elif self._has_jumped(missing, steps, counter, arrived_ns):
            ahead = int(steps.max())
            moved = f"back by {counter.modulus - ahead}" if 2 * ahead > counter.modulus else f"on by {ahead}"
            self._device_line = ArrivalRegression()
            text = f"counter went {moved} ticks within {elapsed_s:.3f} s"
            self._event("clock_jumped", int(samples.t_ns[0]), text)
            at = int(np.argmax(steps))
            missing[at] = steps[at] = 0
            if self._has_jumped(missing, steps, counter, arrived_ns):  # more than one jump: no step is reliable
                missing[:] = 0
            missing[at] = 0 if first else self._missing_samples_in(elapsed_s, len(samples) + int(missing.sum()))
        if first:
            missing[0] = max(samples.lost, unseen)
        self._paused = False
        if counter.tick_s is not None:
            self._advance_device_line(float(steps.sum()) * counter.tick_s, len(samples) + int(missing.sum()))
        return missing

    def _advance_device_line(self, seconds: float, samples: int) -> None:
        """Advance the line of the device clock by a time in seconds and a number of samples, missing ones included."""
        self._device_s += seconds
        self._device_index += samples
        self._device_line.add(self._device_index, self._device_s)

    def _hidden_wraps(self, steps: Ints, size: float | None, counter: CounterTiming, arrived_ns: int) -> int:
        """Return how often a short counter wrapped unseen during a pause of the link or a delay not caught up."""
        if size is None:
            return 0
        rate = self._line.rate_hz() or (1.0 / (size * counter.tick_s) if counter.tick_s else self._earlier_hz)
        if rate is None:
            return 0
        turn = counter.modulus / size  # samples
        counted = int(np.rint(steps / size).sum())
        if self._paused:
            self._delay = None
            elapsed_s = (arrived_ns - self._arrived_ns) / NS_PER_S
            turns = max(0, round((elapsed_s * rate - counted) / turn))
        else:
            turns = round(self._gap_from_delay(arrived_ns, counted, turn / 2.0) / turn)
        return turns if turns * counter.modulus < MAX_STEP_TICKS else 0

    def _ticks_a_sample(self, counter: CounterTiming) -> float | None:
        """Return the ticks per sample; None if they are unknown."""
        seen = self._tick_step.usual()
        if counter.tick_s is None or self._nominal_hz is None:
            return seen
        nominal = 1.0 / (self._nominal_hz * counter.tick_s)
        # the counter overrides a nominal rate that is far off
        return nominal if seen is None or abs(seen - nominal) < 0.5 * nominal else seen

    def _find_stuck_counter(self, samples: SampleBlock, steps: Ints) -> Ints:
        """Return the number of samples [n] that arrived with a stuck counter, at the row where it advances again."""
        before = self._stuck
        if not before and steps.all():
            return np.zeros(len(samples), np.int64)
        moved = np.flatnonzero(steps)
        self._stuck = before + len(steps) if moved.size == 0 else len(steps) - 1 - int(moved[-1])
        if before < MIN_STUCK_SAMPLES <= self._stuck:
            self._event("clock_jumped", int(samples.t_ns[-1]), f"counter stands still at {samples.ticks[-1]}")
        waited = np.zeros(len(samples), np.int64)
        if moved.size:
            at = moved + len(samples) - len(steps)
            waited[at] = np.diff(moved, prepend=-1 - before) - 1
        return np.where(waited >= MIN_STUCK_SAMPLES, waited, 0)

    def _has_jumped(self, missing: Ints, steps: Ints, counter: CounterTiming, arrived_ns: int) -> bool:
        """Return True if more samples are missing than can have been sent in the elapsed time of the host.

        The time begins at the earliest time at which the last sample can have been taken. Its arrival time is not used,
        as the sample may have waited in a buffer until the reading process got processor time.
        """
        period_s = self._bound.period_s or self._certain_period_s()
        lost = float(missing.sum(dtype=np.float64))
        if period_s is not None:
            lasted_s = lost * max((1.0 - PERIOD_TOLERANCE) * period_s, 1.0 / MAX_RATE_HZ)
        elif counter.tick_s is not None:
            lasted_s = max(float(steps.sum(dtype=np.float64)) * counter.tick_s, lost / MAX_RATE_HZ)
        elif 2 * int(steps.max()) > counter.modulus:  # a step of more than half the modulus is more likely a step back
            return True
        else:
            lasted_s = lost / MAX_RATE_HZ
        arrived_s = self._seconds(arrived_ns)
        taken_s = self._bound.newest_s
        return lasted_s > max(arrived_s - (arrived_s if taken_s is None else taken_s), 0.0) + JUMP_S

    def _certain_period_s(self) -> float | None:
        """Return the sample period in s without the effect of late readings.

        The configured period is used until the arrivals show one.
        """
        found = self._line.measured() if self._bound.settled else None
        if found is not None and found[1] < PERIOD_TOLERANCE:
            return 1.0 / found[0]
        rate_hz = None if self._bound.period_s else self._nominal_hz or self._earlier_hz
        return 1.0 / rate_hz if rate_hz else None

    def _arrival_gaps(self, samples: SampleBlock) -> Ints:
        """Return the missing samples [n] before each row, from rejected frames, pauses of the link and delays not
        caught up.
        """
        missing = np.zeros(len(samples), np.int64)
        missing[0] = samples.lost
        arrived_ns = int(samples.t_ns[-1])
        if self._paused:
            elapsed_s = (arrived_ns - self._arrived_ns) / NS_PER_S
            missing[0] = max(samples.lost, self._missing_samples_in(elapsed_s, len(samples)))
            self._paused, self._delay = False, None
            return missing
        missing[0] += self._gap_from_delay(arrived_ns, len(samples) + samples.lost)
        return missing

    def _missing_samples_in(self, elapsed_s: float, arrived: int) -> int:
        """Return the number of samples missing in an elapsed time in which ``arrived`` samples have arrived."""
        rate = self._line.rate_hz() or self._nominal_hz or self._earlier_hz
        if not rate or not self._arrived_ns:
            return 0
        return min(max(0, round(elapsed_s * min(rate, MAX_RATE_HZ)) - arrived), MAX_GAP_SAMPLES)

    def _gap_from_delay(self, arrived_ns: int, counted: int, least: float = MIN_GAP_PERIODS) -> int:
        """Return the samples missing because of a sudden delay that was not caught up within CATCH_UP_S.

        Parameters
        ----------
        arrived_ns
            Arrival time of the newest sample in ns.
        counted
            Samples that have arrived or are known to be missing since the last call.
        least
            Smallest number of missing samples that counts as a gap.
        """
        period_s = self._line.period_s()
        if period_s is None or not self._line.settled():
            return 0
        least_s = max(least * period_s, MIN_GAP_S)
        index, arrived_s = self._index + counted, self._seconds(arrived_ns)
        behind_s = arrived_s - self._line.at(index)
        if self._delay is None:
            pause_s = (arrived_ns - self._arrived_ns) / NS_PER_S - counted * period_s
            if pause_s > least_s and behind_s > least_s:
                self._delay = _Delay(arrived_ns, behind_s, ArrivalRegression())
                self._delay.line.add(index, arrived_s, self._nominal_hz)
            return 0
        delay = self._delay
        delay.least_s = min(delay.least_s, behind_s)
        delay.line.add(index, arrived_s, self._nominal_hz)
        if delay.least_s < least_s:  # caught up: the host was late
            self._delay = None
            return 0
        if arrived_ns - delay.since_ns < CATCH_UP_S * NS_PER_S:
            return 0
        hole = min(round(delay.least_s / max(period_s, 1.0 / MAX_RATE_HZ)), MAX_GAP_SAMPLES)
        delay.line.move(hole)
        rest_s = behind_s - hole * period_s
        if _is_slower(delay.line, period_s):  # the delay grows since the period is wrong
            self._line, self._delay = delay.line, None
        elif rest_s > least_s:  # another delay may have begun in the meantime
            delay.since_ns, delay.least_s = arrived_ns, rest_s
        else:
            self._delay = None
        return hole

    # --- times on the line

    def _place_on_line(self, samples: SampleBlock, missing: Ints) -> list[SampleBlock]:
        """Add the newest arrival to the line, and give the samples their times on it."""
        index = self._index + np.cumsum(missing + 1)
        passed = float(index[-1]) - self._index
        self._index = float(index[-1])
        self._arrived_ns = int(samples.t_ns[-1])
        arrived_s = self._seconds(self._arrived_ns)
        if self._delay is None:  # a possible gap must not bend the line
            # the last sample of a chunk has waited for the shortest time
            self._line.add(self._index, arrived_s, self._nominal_hz)
        self._bound.update(passed, arrived_s, self._certain_period_s())
        period_s = self._line.period_s() or 1.0 / NS_PER_S  # the first samples of an unknown rate are at least in order
        # no sample is newer than its arrival, apart from the scatter of the line
        newest_s = min(self._line.at(self._index), arrived_s + JUMP_S)
        t_s = newest_s - (self._index - index) * period_s
        if t_s[0] < -MAX_OFFSET_S or t_s[-1] > MAX_OFFSET_S:  # arrivals decades apart must stay within int64
            t_s = np.clip(t_s, -MAX_OFFSET_S, MAX_OFFSET_S)
        t_ns = np.rint(t_s * NS_PER_S).astype(np.int64) + (self._origin_ns or 0)
        if t_ns[0] <= self._last_t_ns or (t_ns[1:] <= t_ns[:-1]).any():
            # the line was corrected backwards, or is coarser than a period far from its origin: keep the order
            order = np.arange(len(samples))
            t_ns = np.maximum.accumulate(np.maximum(t_ns - order, self._last_t_ns + 1)) + order
        self._last_t_ns = int(t_ns[-1])
        return _split_at_gaps(samples, t_ns, missing)

    def _event(self, kind: str, t_ns: int, text: str, n: int = 0) -> None:
        """Report an event through the rate limiter."""
        self._telling.tell(kind, t_ns, text, n)


@dataclass(slots=True)
class _Delay:
    """Sudden delay of the arrivals that may turn out to be a gap."""

    since_ns: int  # first late arrival, or the arrival at which a gap was last reported
    least_s: float  # minimum lag of all arrivals since then relative to the line
    line: ArrivalRegression  # fitted to all arrivals since the first late one


class _CounterStep:
    """Typical step of a counter: the mean of all steps near the median of the recent ones."""

    def __init__(self) -> None:
        self._recent: deque[int] = deque(maxlen=STEP_HISTORY)
        self._sum = self._count = 0

    def see(self, steps: Ints) -> None:
        """Update the typical step with the steps that are not zero."""
        moved = steps[steps > 0]
        self._recent.extend(moved[-STEP_HISTORY:].tolist())
        near = self._near(moved)
        self._add(near)
        if near.size < moved.size:
            recent = np.array(self._recent)
            if 2 * self._near(recent).size < recent.size:  # most recent steps differ: start again
                self._sum = self._count = 0
                self._add(recent[np.abs(recent / np.median(recent) - 1.0) < STEP_TOLERANCE])

    def usual(self) -> float | None:
        """Return the ticks per sample; None until the counter has advanced."""
        return self._sum / self._count if self._count else None

    def _add(self, steps: Ints) -> None:
        """Add steps to the mean."""
        self._sum += int(steps.sum())
        self._count += int(steps.size)

    def _near(self, steps: Ints) -> Ints:
        """Return the steps that are near the typical step."""
        usual = self.usual()
        return steps[:0] if usual is None else steps[np.abs(steps / usual - 1.0) < STEP_TOLERANCE]


def _is_slower(line: ArrivalRegression, period_s: float) -> bool:
    """Return True if the points of a line show with certainty a longer period than ``period_s``."""
    found = line.measured()
    return found is not None and found[0] * period_s < 1.0 - found[1]


def _typical_period_s(steps: Ints) -> float | None:
    """Estimate the period in s from the steps while it is unknown; None without a step forward.

    The estimate is the median of steady steps, or the mean of other steps.
    """
    forward = steps[steps > 0] / NS_PER_S
    if not forward.size:
        return None
    low, middle, high = np.quantile(forward, [0.1, 0.5, 0.9])
    return float(middle if high - low < 2.0 * STEP_TOLERANCE * middle else forward.mean())


def _split_at_gaps(samples: SampleBlock, t_ns: Ints, missing: Ints) -> list[SampleBlock]:
    """Return blocks with the given times. A new block begins wherever samples are missing."""
    cuts = np.flatnonzero(missing[1:]) + 1
    edges = [0, *cuts.tolist(), len(samples)]
    return [
        make_block(
            t_ns[a:b].copy(), samples.values[a:b], samples.temperature_c[a:b], samples.ticks[a:b], int(missing[a])
        )
        for a, b in pairwise(edges)
    ]
