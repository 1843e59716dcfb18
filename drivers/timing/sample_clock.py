"""Gives each sample its time, and finds what is missing. Pure: arrival times and counters are arguments.

Three kinds of evidence, by what the wire format carries (``drivers.sample.Timing``): a device counter, arrival times
alone, or times given by the sender. In the first two a line is fitted, with slow forgetting, to (sample index,
arrival time of the chunk's last sample), and samples are placed on the line: the jitter of a USB port or of the
host's scheduler does not become jitter of the samples.

Missing samples are known from a counter exactly; without one from rejected frames (the decoder says so), from
the pause while a link was closed, and from a sudden delay: one that is caught up within CATCH_UP_S was a late
scheduler, one that stays is a hole. The same delay tells the whole turns that a short counter hides. A sample may be
read late but never early. A step of the counter is therefore a hole if that many samples fit between the earliest time
at which the last sample can have been taken (``drivers.timing.arrival_bound``) and the arrival. A longer step is a jump of the
counter: then arrival decides. ``lost`` of each block that goes out counts
all samples missing just before it, rejected frames included.

A row that repeats another, with the same counter or given time and the same values, is kept out and told; with other
values it stays, and that is told. Rows of one block whose given times are a steady sequence in another order are put in
order; one that comes after its place was passed on as missing is kept out and told (``drivers.timing.duplicate_rows``). Events of one
kind are at most one a second of sample time.

Not done here: no value is changed, and where times are too rough to tell, every row stays in the order it came.
"""

from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from drivers.quantities import RATE_HZ
from drivers.sample import NO_TICK, Counter, Event, Floats, Given, Ints, SampleBlock, Timing, block
from drivers.timing.arrival_bound import ArrivalBound
from drivers.timing.arrival_regression import LEARN_S, LEARN_SAMPLES, Line, made_rate
from drivers.timing.duplicate_rows import BACK, NEAR, NS, Repeats, Telling, steady_order
from drivers.timing.rate_check import RateCheck

CATCH_UP_S: Final = 3.0
HOLE_PERIODS: Final = 3.0
HOLE_MIN_S: Final = 0.05
"""One pause in the arrivals longer than both, and not made good within CATCH_UP_S: samples are missing."""
JUMP_S: Final = 1.0
"""A device counter that runs ahead of the host's clock by more than this at one step has jumped."""
PERIOD_TOLERANCE: Final = 0.05
"""Relative error of the sample period that is plausible when the missing samples of a hole are compared with a time."""
RESUME_LATE_S: Final = 10.0
"""The last sample recorded before a restart was read at most this late: an assumption."""
LONG_S: Final = 3600.0
"""Given times that go on by more than this at one step are told as an event too."""
FASTEST_HZ: Final = 32_000.0
"""No inertial sensor is read faster: where a rate is not known or cannot be, no more samples are missing."""
UNCHECKED_S: Final = 30.0
UNCHECKED_SAMPLES: Final = (2 * LEARN_SAMPLES, round(LEARN_S * FASTEST_HZ))
"""Times that show no rate after so long and the first number of samples, or after the second, will never show one."""
LONGEST_GAP: Final = 10**10
"""Samples, 116 days at 1 kHz: given times that go on by more were set anew, and count as so many missing."""
FAR_S: Final = 4.6e9
"""From the first sample: half of what int64 nanoseconds hold."""
LARGEST_STEP: Final = 1 << 62
"""Ticks."""
STUCK_SAMPLES: Final = 10
STEPS_KEPT: Final = 255
"""The last steps of a counter, or of given times, that tell what is usual."""
SURELY_MISSING: Final = 4.0
"""Periods: a longer given step is a gap though it is not one of whole periods."""
LATE: Final = 8.0
"""A given time is late, and no sample missing, up to so many times the upper quartile of what is usual."""


@dataclass(frozen=True, slots=True)
class Before:
    """The last sample before a restart of the program."""

    t_ns: int  # in the epoch of the device's times
    tick: int  # of the device's counter; NO_TICK = none
    rate_hz: float | None
    tick_step: float | None  # ticks a sample


class SampleClock:
    """Sample times and missing samples of one device.

    Args:
        timing: what the wire format carries
        rate_hz: nominal rate; None = find it from the data
        arrivals_are_timed: False if arrival times say nothing about the device's rate: bytes are read from a file, or a
            simulated sensor runs at another speed
    """

    def __init__(self, timing: Timing, rate_hz: float | None, arrivals_are_timed: bool = True) -> None:
        self._timing = timing
        self._nominal_hz = rate_hz
        self._check = None if rate_hz is None else RateCheck(rate_hz)
        self._arrivals_are_timed = arrivals_are_timed
        self._stamped = 0  # samples
        self._stamped_s = 0.0  # from the first to the newest, by the times they came with
        self._ended = self._resumed = False
        self.repeated = 0
        """Rows kept out, as they had come before."""
        self.late = 0
        """Rows kept out, as their places had been passed on as missing."""
        self._telling = Telling()
        self._repeats = Repeats(ordered=isinstance(timing, Given))
        self._holes: deque[int] = deque(maxlen=BACK)  # given times that samples told as missing would have
        self._owed = 0  # missing samples told with a row that was kept out
        self._line = Line()
        self._origin_ns: int | None = None  # seconds count from here: a double of Unix time holds no more than 240 ns
        self._last_t_ns = -(1 << 62)
        self._index = 0.0  # samples since the line's start, missing ones included
        self._arrived_ns = 0  # newest arrival
        self._delay: _Delay | None = None
        self._tick: int | None = None  # last counter value, unwrapped
        self._tick_step = _Step()
        self._device_line = Line()  # device clock on index, where a tick is a known time
        self._device_s = self._device_index = 0.0
        self._went_back = False
        self._given_steps: deque[float] = deque(maxlen=STEPS_KEPT)  # s
        self._stuck = 0
        self._paused = False
        self._bound = ArrivalBound()
        self._idle_ns: int | None = None  # the link held no data at this time
        self._earlier_hz: float | None = None  # rate before a restart of the program, until the line knows better

    def resume(self, before: Before) -> None:
        """Go on from the last sample that was recorded before a restart of the program: what came since is missing."""
        self._resumed = True
        self._earlier_hz = self._nominal_hz or before.rate_hz
        self._last_t_ns = self._arrived_ns = before.t_ns
        self._origin_ns = before.t_ns
        self._bound.start(-RESUME_LATE_S)
        if isinstance(self._timing, Given):
            self._line.add(self._index, 0.0, self._earlier_hz)
        if before.tick != NO_TICK and before.tick_step is not None:
            self._tick = before.tick
            self._tick_step.see(np.array([round(before.tick_step)]))
        self._paused = True

    @property
    def tick_step(self) -> float | None:
        """Ticks of the device's counter a sample; None until it has moved."""
        return self._tick_step.usual()

    @property
    def rate_hz(self) -> float | None:
        """Samples a second: nominal where stated, else found from the data and made better with them.

        None at first, and while the data give a rate outside the supported range. A nominal rate that the sample times
        contradict gives way to the measured one, see ``drivers.timing.rate_check``.
        """
        if self._check is not None:
            return self._check.rate_hz
        if self._nominal_hz or not self._line.settled():
            return self._nominal_hz or self._earlier_hz
        measured = self._line.rate_hz()
        return made_rate(measured) if measured and RATE_HZ.supports(measured) else None

    @property
    def measured_hz(self) -> float | None:
        """Samples a second by the host's clock, without rounding; None until known."""
        return self._line.rate_hz() if self._line.settled() else None

    @property
    def contradicted_hz(self) -> float | None:
        """Measured rate in Hz that contradicts the nominal one; None if they agree, or there is none to compare."""
        return self._check.measured_hz if self._check is not None and self._check.contradicted else None

    @property
    def unchecked(self) -> bool:
        """True if samples have come, and the nominal rate has not been compared with theirs yet but will be."""
        if self._check is None or self._check.measured_hz is not None or self._ended:
            return False
        if not self._stamped:
            return self._resumed
        few, many = UNCHECKED_SAMPLES
        if self._stamped > many or (self._stamped > few and self._stamped_s > UNCHECKED_S):
            return False
        return self._arrivals_are_timed or isinstance(self._timing, Given) or self._device_line.count > 0

    def end(self) -> None:
        """Compare the rates with what there is, as no more samples will come."""
        if self._check is None or self._ended:
            return
        self._ended = True
        line = self._line if isinstance(self._timing, Given) else self._device_line
        found = line.measured(final=True) if self._check.measured_hz is None else None
        if found is not None:
            self._check.update(*found)

    def take_events(self, ended: bool = False) -> list[Event]:
        """What the clock found since the last call; all of it if no more samples will come."""
        return self._telling.take(ended)

    def pause(self) -> None:
        """The link was closed: what the next sample's arrival shows to be missing is a hole."""
        self._paused = True

    def link_idle(self, t_ns: int) -> None:
        """Note that the link held no unread data at a host time: what arrives later was sent later.

        Only the time before the first sample is used. It tells how long the first samples may have waited.
        """
        self._idle_ns = t_ns

    def stamp(self, samples: SampleBlock) -> list[SampleBlock]:
        """The samples with their times, cut where some are missing."""
        if self._origin_ns is None:
            self._origin_ns = int(samples.t_ns[0])
            if self._idle_ns is not None:
                # one period before the first sample, which was not taken earlier than the link was idle
                self._bound.start(min(self._seconds(self._idle_ns), 0.0) - 1.0 / (self._nominal_hz or FASTEST_HZ))
        self._telling.tell_due(int(samples.t_ns[-1]))
        kept = self._in_order(self._without_repeats(samples))
        stamped = self._stamp(kept) if kept is not None else []
        self._stamped += sum(len(one) for one in stamped)
        self._stamped_s = self._seconds(int(samples.t_ns[-1]))
        if self._check is not None and (found := self._rate_line().measured()) is not None:
            self._check.update(*found)
        return stamped

    def _rate_line(self) -> Line:
        """The line that shows the device's rate: on its own clock where there is one; an empty one where none does."""
        timed = self._arrivals_are_timed or isinstance(self._timing, Given)
        return self._line if timed and not self._device_line.count else self._device_line

    def _stamp(self, samples: SampleBlock) -> list[SampleBlock]:
        if isinstance(self._timing, Given):
            return self._keep_given(samples)
        if self._paused and self.rate_hz is None:
            self._line = Line()  # how many are missing is unknown, so that two ends of a pause make no line
        if isinstance(self._timing, Counter) and (samples.ticks != NO_TICK).all():
            return self._place(samples, self._counted_gaps(samples, self._timing))
        self._tick = None  # samples pass that the counter does not tell
        return self._place(samples, self._arrival_gaps(samples))

    def _seconds(self, t_ns: int) -> float:
        return (t_ns - (self._origin_ns or 0)) / NS

    # --- rows that came twice, or late

    def _without_repeats(self, samples: SampleBlock) -> SampleBlock | None:
        given = isinstance(self._timing, Given)
        if not given and (not isinstance(self._timing, Counter) or (samples.ticks == NO_TICK).any()):
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
        self.repeated += n
        self._event("samples_repeated", t_ns, f"{{n}} rows repeat others, {word} and values; left out", n)
        return self._rows(samples, np.flatnonzero(~repeats))

    def _in_order(self, samples: SampleBlock | None) -> SampleBlock | None:
        """Given times in their order, as far as the rows came together; a row whose place has passed is kept out."""
        if samples is None or not isinstance(self._timing, Given):
            return samples
        t = samples.t_ns
        if not self._line.count or (t[0] >= self._last_t_ns and (len(t) == 1 or (np.diff(t) >= 0).all())):
            return samples
        period_s = self._given_period_s(np.diff(t))
        if not period_s:
            return samples
        if self._holes:
            samples = self._without_late(samples, period_s)
            if samples is None:
                return None
            t = samples.t_ns
        steps = np.diff(t)
        order = None if (steps < -JUMP_S * NS).any() else steady_order(t, period_s)
        if order is None:
            return samples
        n = int((steps < 0).sum())
        self._event("clock_jumped", int(t[-1]), "rows that came out of order: {n}; put in order", n)
        return self._rows(samples, order)

    def _without_late(self, samples: SampleBlock, period_s: float) -> SampleBlock | None:
        holes = np.array(self._holes)
        far = np.abs(samples.t_ns[:, None] - holes)
        late = (samples.t_ns < self._last_t_ns) & (far.min(axis=1) < NEAR * period_s * NS)
        if not late.any():
            return samples
        filled = set(far[late].argmin(axis=1).tolist())
        self._holes = deque((t for i, t in enumerate(self._holes) if i not in filled), maxlen=BACK)
        n = int(late.sum())
        self.late += n
        text = "{n} samples came after later ones, their places passed on as missing; left out"
        self._event("clock_jumped", int(samples.t_ns[-1]), text, n)
        return self._rows(samples, np.flatnonzero(~late))

    def _rows(self, samples: SampleBlock, rows: Ints) -> SampleBlock | None:
        """These rows in this order; what was missing before a row that is gone is missing before the next."""
        if not rows.size:
            self._owed += samples.lost
            return None
        lost, self._owed = samples.lost + self._owed, 0
        return block(samples.t_ns[rows], samples.values[rows], samples.temperature_c[rows], samples.ticks[rows], lost)

    # --- times given by the sender

    def _keep_given(self, samples: SampleBlock) -> list[SampleBlock]:
        t = samples.t_ns
        steps = np.empty(len(samples), np.int64)
        steps[0] = t[0] - self._last_t_ns if self._line.count else 0
        np.subtract(t[1:], t[:-1], out=steps[1:])
        shortest, longest = int(steps.min()), int(steps.max())
        jumps = np.zeros(0, np.int64)
        if shortest < 0 or longest > LONG_S * NS:
            self._tell_jumps(t, steps)
            jumps = np.flatnonzero((steps < -JUMP_S * NS) | (steps > LONG_S * NS))
        period_s = self._given_period_s(steps)
        missing = np.zeros(len(samples), np.int64)
        if period_s:
            missing = self._given_gaps(steps / NS, period_s)
        missing[0] = max(int(missing[0]), samples.lost)
        index = self._index + np.cumsum(missing + 1)
        # a line does not go through a jump
        at = int(jumps[-1]) if jumps.size else 0
        if jumps.size:
            self._line = Line()
        for row in (at, len(samples) - 1):
            self._line.add(float(index[row]), self._seconds(int(t[row])))
        self._index, self._last_t_ns = float(index[-1]), int(t[-1])
        if period_s and missing.any():
            for row in np.flatnonzero((missing > 0) & (missing <= BACK)).tolist():
                places = np.arange(1, missing[row] + 1) * min(period_s * NS, float(1 << 54))  # 2 years: all in int64
                self._holes.extend((t[row] - np.rint(places)).astype(np.int64).tolist())
        return _cut(samples, t, missing)

    def _given_period_s(self, steps: Ints) -> float | None:
        """What a gap is measured by; None as long as all that came may be one burst of a late sender."""
        if self._line.settled():
            return self._line.period_s()
        if rate := self._nominal_hz or self._earlier_hz:
            return 1.0 / rate
        return _usual(steps) if steps.sum() > LEARN_S * NS else None

    def _tell_jumps(self, t: Ints, steps: Ints) -> None:
        back = steps < (-JUMP_S * NS if self._went_back else 0.0)  # what jitters back and forth is told once
        if back.any():
            at = int(np.argmax(back))
            self._event("clock_jumped", int(t[at]), f"time went back by {-steps[at] / NS:.6g} s")
            self._went_back = True
        if (steps > LONG_S * NS).any():
            at = int(np.argmax(steps))
            self._event("clock_jumped", int(t[at]), f"time went on by {steps[at] / NS:.6g} s at one step")

    def _given_gaps(self, steps_s: Floats, period_s: float) -> Ints:
        """Missing samples before each row [n]: told only where most steps are one period.

        Times that a host stamped are late and early by whole periods, and nothing is missing. So a short gap must
        be one of whole periods, longer than what is usual, and no neighbour may make good for it.
        """
        last_s = self._given_steps[-1] if self._given_steps else period_s
        self._given_steps.extend(steps_s[-STEPS_KEPT:].tolist())
        periods = steps_s / period_s
        if periods.max() < 1.5:
            return np.zeros(steps_s.size, np.int64)
        before = np.concatenate([[last_s], steps_s[:-1]])
        after = np.concatenate([steps_s[1:], [period_s]])
        off = np.abs(np.array(self._given_steps) / period_s - 1.0)
        if np.median(off) > NEAR:
            return np.zeros(steps_s.size, np.int64)
        gap = np.rint(np.clip(periods, 0.0, LONGEST_GAP)).astype(np.int64) - 1
        late = (periods < SURELY_MISSING) & (np.abs(periods - np.rint(periods)) > NEAR)
        late |= periods < 1.0 + max(0.5, LATE * float(np.quantile(off, 0.75)))
        late |= steps_s + np.minimum(before, after) < 2.5 * period_s
        gap[late] = 0
        return gap

    # --- missing samples

    def _counted_gaps(self, samples: SampleBlock, counter: Counter) -> Ints:
        """Missing samples before each row by the device's counter [n]."""
        arrived_ns = int(samples.t_ns[-1])
        elapsed_s = (arrived_ns - self._arrived_ns) / NS
        first = self._tick is None
        previous = int(samples.ticks[0]) if self._tick is None else self._tick
        steps = np.empty(len(samples), np.int64)
        steps[0] = samples.ticks[0] - previous % counter.modulus
        np.subtract(samples.ticks[1:], samples.ticks[:-1], out=steps[1:])
        steps %= counter.modulus
        self._tick_step.see(steps)
        size = self._ticks_a_sample(counter)
        if not first:
            steps[0] += counter.modulus * self._hidden_turns(steps, size, counter, arrived_ns)
        self._tick = int(samples.ticks[-1])
        waited = self._watch_stuck(samples, steps[1:] if first else steps)
        missing = np.zeros(len(samples), np.int64)
        if size is not None:
            missing = np.maximum(np.rint(np.minimum(steps / size, LONGEST_GAP)).astype(np.int64) - 1 - waited, 0)
        unseen = self._missing_in(elapsed_s, len(samples)) if first and self._paused else 0
        if not steps.any():  # a counter that stands still says nothing
            missing[0] = max(samples.lost, unseen)
        elif self._ran_ahead(missing, steps, counter, arrived_ns):
            ahead = int(steps.max())
            moved = f"back by {counter.modulus - ahead}" if 2 * ahead > counter.modulus else f"on by {ahead}"
            self._device_line = Line()
            text = f"counter went {moved} ticks within {elapsed_s:.3f} s"
            self._event("clock_jumped", int(samples.t_ns[0]), text)
            at = int(np.argmax(steps))
            missing[at] = steps[at] = 0
            if self._ran_ahead(missing, steps, counter, arrived_ns):  # not one jump alone: no step tells anything
                missing[:] = 0
            missing[at] = 0 if first else self._missing_in(elapsed_s, len(samples) + int(missing.sum()))
        if first:
            missing[0] = max(samples.lost, unseen)
        self._paused = False
        if counter.tick_s is not None:
            self._follow_device(float(steps.sum()) * counter.tick_s, len(samples) + int(missing.sum()))
        return missing

    def _follow_device(self, seconds: float, samples: int) -> None:
        """Go on by so many seconds of the device's clock and so many samples, missing ones included."""
        self._device_s += seconds
        self._device_index += samples
        self._device_line.add(self._device_index, self._device_s)

    def _hidden_turns(self, steps: Ints, size: float | None, counter: Counter, arrived_ns: int) -> int:
        """Whole turns of a short counter, hidden in a pause of the link or in a delay that was never made good."""
        if size is None:
            return 0
        rate = self._line.rate_hz() or (1.0 / (size * counter.tick_s) if counter.tick_s else self._earlier_hz)
        if rate is None:
            return 0
        turn = counter.modulus / size  # samples
        counted = int(np.rint(steps / size).sum())
        if self._paused:
            self._delay = None
            elapsed_s = (arrived_ns - self._arrived_ns) / NS
            turns = max(0, round((elapsed_s * rate - counted) / turn))
        else:
            turns = round(self._never_caught_up(arrived_ns, counted, turn / 2.0) / turn)
        return turns if turns * counter.modulus < LARGEST_STEP else 0

    def _ticks_a_sample(self, counter: Counter) -> float | None:
        seen = self._tick_step.usual()
        if counter.tick_s is None or self._nominal_hz is None:
            return seen
        nominal = 1.0 / (self._nominal_hz * counter.tick_s)
        # a device set to another rate than the file says is believed
        return nominal if seen is None or abs(seen - nominal) < 0.5 * nominal else seen

    def _watch_stuck(self, samples: SampleBlock, steps: Ints) -> Ints:
        """Samples [n] that came with the counter standing still, at the row where it goes on."""
        before = self._stuck
        if not before and steps.all():
            return np.zeros(len(samples), np.int64)
        moved = np.flatnonzero(steps)
        self._stuck = before + len(steps) if moved.size == 0 else len(steps) - 1 - int(moved[-1])
        if before < STUCK_SAMPLES <= self._stuck:
            self._event("clock_jumped", int(samples.t_ns[-1]), f"counter stands still at {samples.ticks[-1]}")
        waited = np.zeros(len(samples), np.int64)
        if moved.size:
            at = moved + len(samples) - len(steps)
            waited[at] = np.diff(moved, prepend=-1 - before) - 1
        return np.where(waited >= STUCK_SAMPLES, waited, 0)

    def _ran_ahead(self, missing: Ints, steps: Ints, counter: Counter, arrived_ns: int) -> bool:
        """Return True if more samples are missing than can have been sent in the time that passed on the host.

        The time begins when the last sample was taken at the earliest. Its arrival does not count, as it may have
        waited in a buffer until the reading process got processor time.
        """
        period_s = self._bound.period_s or self._certain_period_s()
        lost = float(missing.sum(dtype=np.float64))
        if period_s is not None:
            lasted_s = lost * max((1.0 - PERIOD_TOLERANCE) * period_s, 1.0 / FASTEST_HZ)
        elif counter.tick_s is not None:
            lasted_s = max(float(steps.sum(dtype=np.float64)) * counter.tick_s, lost / FASTEST_HZ)
        elif 2 * int(steps.max()) > counter.modulus:  # half a turn on is more likely a step back
            return True
        else:
            lasted_s = lost / FASTEST_HZ
        arrived_s = self._seconds(arrived_ns)
        taken_s = self._bound.newest_s
        return lasted_s > max(arrived_s - (arrived_s if taken_s is None else taken_s), 0.0) + JUMP_S

    def _certain_period_s(self) -> float | None:
        """Sample period in s that late readings have not distorted; the configured one until the arrivals show it."""
        found = self._line.measured() if self._bound.settled else None
        if found is not None and found[1] < PERIOD_TOLERANCE:
            return 1.0 / found[0]
        rate_hz = None if self._bound.period_s else self._nominal_hz or self._earlier_hz
        return 1.0 / rate_hz if rate_hz else None

    def _arrival_gaps(self, samples: SampleBlock) -> Ints:
        """Missing samples before each row [n]: rejected frames, a pause of the link, a delay never caught up."""
        missing = np.zeros(len(samples), np.int64)
        missing[0] = samples.lost
        arrived_ns = int(samples.t_ns[-1])
        if self._paused:
            elapsed_s = (arrived_ns - self._arrived_ns) / NS
            missing[0] = max(samples.lost, self._missing_in(elapsed_s, len(samples)))
            self._paused, self._delay = False, None
            return missing
        missing[0] += self._never_caught_up(arrived_ns, len(samples) + samples.lost)
        return missing

    def _missing_in(self, elapsed_s: float, arrived: int) -> int:
        rate = self._line.rate_hz() or self._nominal_hz or self._earlier_hz
        if not rate or not self._arrived_ns:
            return 0
        return min(max(0, round(elapsed_s * min(rate, FASTEST_HZ)) - arrived), LONGEST_GAP)

    def _never_caught_up(self, arrived_ns: int, counted: int, least: float = HOLE_PERIODS) -> int:
        """Samples missing by a sudden delay that CATCH_UP_S ago began and was not made good since.

        Args:
            counted: samples that have come or are known to be missing since the last call
            least: fewer missing samples than this are none
        """
        period_s = self._line.period_s()
        if period_s is None or not self._line.settled():
            return 0
        least_s = max(least * period_s, HOLE_MIN_S)
        index, arrived_s = self._index + counted, self._seconds(arrived_ns)
        behind_s = arrived_s - self._line.at(index)
        if self._delay is None:
            pause_s = (arrived_ns - self._arrived_ns) / NS - counted * period_s
            if pause_s > least_s and behind_s > least_s:
                self._delay = _Delay(arrived_ns, behind_s, Line())
                self._delay.line.add(index, arrived_s, self._nominal_hz)
            return 0
        delay = self._delay
        delay.least_s = min(delay.least_s, behind_s)
        delay.line.add(index, arrived_s, self._nominal_hz)
        if delay.least_s < least_s:  # made good: the host was late
            self._delay = None
            return 0
        if arrived_ns - delay.since_ns < CATCH_UP_S * NS:
            return 0
        hole = min(round(delay.least_s / max(period_s, 1.0 / FASTEST_HZ)), LONGEST_GAP)
        delay.line.move(hole)
        rest_s = behind_s - hole * period_s
        if _is_slower(delay.line, period_s):  # the delay grows because the period is wrong
            self._line, self._delay = delay.line, None
        elif rest_s > least_s:  # another delay may have begun meanwhile
            delay.since_ns, delay.least_s = arrived_ns, rest_s
        else:
            self._delay = None
        return hole

    # --- times on the line

    def _place(self, samples: SampleBlock, missing: Ints) -> list[SampleBlock]:
        index = self._index + np.cumsum(missing + 1)
        passed = float(index[-1]) - self._index
        self._index = float(index[-1])
        self._arrived_ns = int(samples.t_ns[-1])
        arrived_s = self._seconds(self._arrived_ns)
        if self._delay is None:  # what may be a hole must not bend the line
            # within a chunk the last sample waited least
            self._line.add(self._index, arrived_s, self._nominal_hz)
        self._bound.update(passed, arrived_s, self._certain_period_s())
        period_s = self._line.period_s() or 1.0 / NS  # the first samples of an unknown rate: in order at least
        # no sample is newer than its arrival, but for the scatter of the line
        newest_s = min(self._line.at(self._index), arrived_s + JUMP_S)
        t_s = newest_s - (self._index - index) * period_s
        if t_s[0] < -FAR_S or t_s[-1] > FAR_S:  # arrivals decades apart: no time beyond int64
            t_s = np.clip(t_s, -FAR_S, FAR_S)
        t_ns = np.rint(t_s * NS).astype(np.int64) + (self._origin_ns or 0)
        if t_ns[0] <= self._last_t_ns or (t_ns[1:] <= t_ns[:-1]).any():
            # the line was corrected backwards, or far from its origin is coarser than a period: never out of order
            order = np.arange(len(samples))
            t_ns = np.maximum.accumulate(np.maximum(t_ns - order, self._last_t_ns + 1)) + order
        self._last_t_ns = int(t_ns[-1])
        return _cut(samples, t_ns, missing)

    def _event(self, kind: str, t_ns: int, text: str, n: int = 0) -> None:
        self._telling.tell(kind, t_ns, text, n)


@dataclass(slots=True)
class _Delay:
    since_ns: int  # arrival that was suddenly late, or at which a hole was told last
    least_s: float  # the least any arrival since was behind the line
    line: Line  # through all arrivals since the first that was suddenly late


class _Step:
    """The usual step of a counter: the mean of all steps near the median of the last ones."""

    def __init__(self) -> None:
        self._recent: deque[int] = deque(maxlen=STEPS_KEPT)
        self._sum = self._count = 0

    def see(self, steps: Ints) -> None:
        """Learn from the steps that moved."""
        moved = steps[steps > 0]
        self._recent.extend(moved[-STEPS_KEPT:].tolist())
        near = self._near(moved)
        self._add(near)
        if near.size < moved.size:
            recent = np.array(self._recent)
            if 2 * self._near(recent).size < recent.size:  # most are others: begin anew
                self._sum = self._count = 0
                self._add(recent[np.abs(recent / np.median(recent) - 1.0) < NEAR])

    def usual(self) -> float | None:
        """Ticks a sample; None until the counter has moved."""
        return self._sum / self._count if self._count else None

    def _add(self, steps: Ints) -> None:
        self._sum += int(steps.sum())
        self._count += int(steps.size)

    def _near(self, steps: Ints) -> Ints:
        usual = self.usual()
        return steps[:0] if usual is None else steps[np.abs(steps / usual - 1.0) < NEAR]


def _is_slower(line: Line, period_s: float) -> bool:
    """Return True if the points of a line surely show a longer period than ``period_s``."""
    found = line.measured()
    return found is not None and found[0] * period_s < 1.0 - found[1]


def _usual(steps: Ints) -> float | None:
    """Period in s, while it is not known: the middle of steady steps, the mean of others; None where there is none."""
    forward = steps[steps > 0] / NS
    if not forward.size:
        return None
    low, middle, high = np.quantile(forward, [0.1, 0.5, 0.9])
    return float(middle if high - low < 2.0 * NEAR * middle else forward.mean())


def _cut(samples: SampleBlock, t_ns: Ints, missing: Ints) -> list[SampleBlock]:
    """Blocks with the given times, a new one wherever samples are missing."""
    cuts = np.flatnonzero(missing[1:]) + 1
    edges = [0, *cuts.tolist(), len(samples)]
    return [
        block(t_ns[a:b].copy(), samples.values[a:b], samples.temperature_c[a:b], samples.ticks[a:b], int(missing[a]))
        for a, b in pairwise(edges)
    ]
