"""Gives each sample its time, and finds what is missing. Pure: arrival times and counters are arguments.

Three kinds of evidence, by what the wire format carries (``drivers.sample.Timing``): a device counter, arrival times
alone, or times given by the sender. In the first two a line is fitted, with slow forgetting, to (sample index,
arrival time of the chunk's last sample), and samples are placed on the line: the jitter of a USB port or of the
host's scheduler does not become jitter of the samples.

Missing samples are known from a counter exactly; without one from rejected frames (the decoder says so), from
the pause while a link was closed, and from a sudden delay: one that is caught up within CATCH_UP_S was a late
scheduler, one that stays is a hole. ``lost`` of each block that goes out counts all samples
missing just before it, rejected frames included.

Not done here: no sample is dropped, repeated or moved to another place in the order.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import exp
from typing import Final

import numpy as np

from drivers.sample import NO_TICK, Counter, Event, Floats, Given, Ints, SampleBlock, Timing, block

NS: Final = 1e9
FORGET_S: Final = 30.0
"""Time constant of the fitted line: long against arrival jitter, short against a crystal's warm-up."""
LEARN_S: Final = 2.0
LEARN_SAMPLES: Final = 20
"""A rate is known from the data after both."""
KEEP_LEAST: Final = 0.9
"""Slow sensors and long blocks: the line rests on ten points or more however far apart they are."""
CATCH_UP_S: Final = 3.0
HOLE_PERIODS: Final = 3.0
HOLE_MIN_S: Final = 0.05
"""One pause in the arrivals longer than both, and not made good within CATCH_UP_S: samples are missing."""
JUMP_S: Final = 1.0
"""A device counter that runs ahead of the host's clock by more than this at one step has jumped."""
LONG_S: Final = 3600.0
"""Given times that go on by more than this at one step are told as an event too."""
STUCK_SAMPLES: Final = 10
SNAP: Final = 0.002
"""A measured rate this near to a rate that sensors are made with is taken to be that rate; crystals and RC
oscillators further off are taken at their word."""
# fmt: off
MADE_RATES_HZ: Final = np.array([
    1, 2, 4, 5, 8, 10, 12.5, 16, 20, 25, 26, 32, 40, 50, 52, 62.5, 64, 80, 100, 104, 120, 125, 128, 200, 208, 238, 240,
    250, 256, 262, 400, 416, 476, 480, 500, 512, 800, 833, 952, 1000, 1024, 1600, 1660, 2000, 3200, 3330, 4000, 6400,
    6660, 8000, 16000, 32000,
])
# fmt: on


class SampleClock:
    """Sample times and missing samples of one device.

    Args:
        timing: what the wire format carries
        rate_hz: nominal rate; None = find it from the data
    """

    def __init__(self, timing: Timing, rate_hz: float | None) -> None:
        self._timing = timing
        self._nominal_hz = rate_hz
        self._events: list[Event] = []
        self._line = Line()
        self._last_t_ns = -(1 << 62)
        self._index = 0.0  # samples since the line's start, missing ones included
        self._arrived_ns = 0  # newest arrival
        self._delay: _Delay | None = None
        self._tick: int | None = None  # last counter value, unwrapped
        self._tick_step = _Step()
        self._stuck = 0
        self._paused = False

    @property
    def rate_hz(self) -> float | None:
        """Samples a second: nominal where stated, else found from the data and made better with them; None at first."""
        if self._nominal_hz or not self._line.settled():
            return self._nominal_hz
        measured = self._line.rate_hz()
        return made_rate(measured) if measured else None

    @property
    def measured_hz(self) -> float | None:
        """Samples a second by the host's clock, without rounding; None until known."""
        return self._line.rate_hz()

    def take_events(self) -> list[Event]:
        """What the clock found since the last call."""
        events, self._events = self._events, []
        return events

    def pause(self) -> None:
        """The link was closed: what the next sample's arrival shows to be missing is a hole."""
        self._paused = True

    def stamp(self, samples: SampleBlock) -> list[SampleBlock]:
        """The samples with their times, cut where some are missing."""
        if isinstance(self._timing, Given):
            return self._keep_given(samples)
        if isinstance(self._timing, Counter) and (samples.ticks != NO_TICK).all():
            return self._place(samples, self._counted_gaps(samples, self._timing))
        return self._place(samples, self._arrival_gaps(samples))

    # --- times given by the sender

    def _keep_given(self, samples: SampleBlock) -> list[SampleBlock]:
        t = samples.t_ns
        steps = np.diff(t, prepend=self._last_t_ns if self._line.count else t[0])
        if (steps < 0).any():
            at = int(np.argmax(steps < 0))
            self._event("clock_jumped", int(t[at]), f"time went back by {-steps[at] / NS:.6g} s")
        if (steps > LONG_S * NS).any():
            at = int(np.argmax(steps))
            self._event("clock_jumped", int(t[at]), f"time went on by {steps[at] / NS:.6g} s at one step")
        self._last_t_ns = int(t[-1])
        period_s = self._line.period_s() or (1.0 / self._nominal_hz if self._nominal_hz else _usual(steps))
        missing = np.zeros(len(samples), np.int64)
        missing[0] = samples.lost
        # Host-stamped recordings are late and early by whole periods; a hole is told only where steps are steady.
        if period_s and _steady(steps, period_s):
            gap = np.rint(steps / NS / period_s).astype(np.int64) - 1
            gap[(steps <= 0) | (steps / NS < 1.5 * period_s)] = 0
            missing = np.maximum(missing, gap)
        self._line.add(self._index + int(missing[0]) + 1, float(t[0]) / NS)
        self._index += len(samples) + int(missing.sum())
        self._line.add(self._index, float(t[-1]) / NS)
        return _cut(samples, t, missing)

    # --- missing samples

    def _counted_gaps(self, samples: SampleBlock, counter: Counter) -> Ints:
        """Missing samples before each row by the device's counter [n]."""
        elapsed_s = (int(samples.t_ns[-1]) - self._arrived_ns) / NS
        previous = self._tick if self._tick is not None else int(samples.ticks[0])
        first = self._tick is None
        raw = np.diff(samples.ticks, prepend=previous % counter.modulus) % counter.modulus
        steps = raw.astype(np.int64)
        if not first:
            steps[0] = self._with_turns(int(steps[0]), counter, elapsed_s)
        self._tick = previous + int(steps.sum())
        moving = steps[1:] if first else steps
        self._watch_stuck(samples, moving)
        self._tick_step.see(moving)
        size = self._ticks_a_sample(counter)
        if size is None:
            missing = np.zeros(len(samples), np.int64)
        else:
            missing = np.maximum(np.rint(steps / size).astype(np.int64) - 1, 0)
        if first:
            missing[0] = 0
        elif self._ran_ahead(int(steps.max()), size, int(samples.t_ns[-1])):
            text = f"counter moved by {steps.max()} ticks within {elapsed_s:.3f} s"
            self._event("clock_jumped", int(samples.t_ns[0]), text)
            missing[np.argmax(steps)] = self._missing_in(elapsed_s, len(samples))
        if steps.sum() == 0:  # a counter that stands still says nothing
            missing[0] = samples.lost
        self._paused = False
        return missing

    def _with_turns(self, step: int, counter: Counter, elapsed_s: float) -> int:
        """Adds whole turns of a short counter that a pause of the host's length must have hidden."""
        size = self._ticks_a_sample(counter)
        rate = self._line.rate_hz() or self._nominal_hz
        if size is None or rate is None or not self._paused:
            return step
        return step + max(0, round((elapsed_s * rate * size - step) / counter.modulus)) * counter.modulus

    def _ticks_a_sample(self, counter: Counter) -> float | None:
        if counter.tick_s is not None and self._nominal_hz is not None:
            nominal = 1.0 / (self._nominal_hz * counter.tick_s)
            seen = self._tick_step.usual()
            # a device set to another rate than the file says is believed
            return nominal if seen is None or abs(seen - nominal) < 0.5 * nominal else float(seen)
        seen = self._tick_step.usual()
        return None if seen is None else float(seen)

    def _watch_stuck(self, samples: SampleBlock, steps: Ints) -> None:
        before = self._stuck
        moved = np.flatnonzero(steps)
        self._stuck = before + len(steps) if moved.size == 0 else len(steps) - 1 - int(moved[-1])
        if before < STUCK_SAMPLES <= self._stuck:
            self._event("clock_jumped", int(samples.t_ns[-1]), f"counter stands still at {samples.ticks[-1]}")

    def _ran_ahead(self, step: int, size: float | None, arrived_ns: int) -> bool:
        period_s = self._line.period_s()
        if size is None or period_s is None:
            return False
        # samples may wait in buffers before the host sees them, but none arrives before it was taken
        return step / size * period_s > arrived_ns / NS - self._line.at(self._index) + JUMP_S

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
        missing[0] += self._never_caught_up(arrived_ns, len(samples))
        return missing

    def _missing_in(self, elapsed_s: float, arrived: int) -> int:
        rate = self._line.rate_hz() or self._nominal_hz
        return max(0, round(elapsed_s * rate) - arrived) if rate and self._arrived_ns else 0

    def _never_caught_up(self, arrived_ns: int, arrived: int) -> int:
        """Samples missing by a sudden delay that CATCH_UP_S ago began and was not made good since."""
        period_s = self._line.period_s()
        if period_s is None or not self._line.settled():
            return 0
        least_s = max(HOLE_PERIODS * period_s, HOLE_MIN_S)
        behind_s = arrived_ns / NS - self._line.at(self._index + arrived)
        if self._delay is None:
            pause_s = (arrived_ns - self._arrived_ns) / NS - arrived * period_s
            if pause_s > least_s and behind_s > least_s:
                self._delay = _Delay(arrived_ns, behind_s)
            return 0
        self._delay = _Delay(self._delay.since_ns, min(self._delay.least_s, behind_s))
        if self._delay.least_s < least_s:  # made good: the host was late
            self._delay = None
            return 0
        if arrived_ns - self._delay.since_ns < CATCH_UP_S * NS:
            return 0
        hole = round(self._delay.least_s / period_s)
        self._delay = None
        return hole

    # --- times on the line

    def _place(self, samples: SampleBlock, missing: Ints) -> list[SampleBlock]:
        index = self._index + np.cumsum(missing + 1)
        self._index = float(index[-1])
        self._arrived_ns = int(samples.t_ns[-1])
        # within a chunk the last sample waited least
        self._line.add(self._index, self._arrived_ns / NS, self._nominal_hz)
        period_s = self._line.period_s() or 0.0
        newest_s = self._line.at(self._index)
        t_ns = np.rint((newest_s - (self._index - index) * period_s) * NS).astype(np.int64)
        if t_ns[0] <= self._last_t_ns:  # the line was corrected backwards: never out of order
            t_ns = np.maximum(t_ns, self._last_t_ns + np.arange(1, len(samples) + 1))
        self._last_t_ns = int(t_ns[-1])
        return _cut(samples, t_ns, missing)

    def _event(self, kind: str, t_ns: int, text: str) -> None:
        self._events.append(Event(kind, t_ns, text))


@dataclass(frozen=True, slots=True)
class _Delay:
    since_ns: int  # arrival that was suddenly late
    least_s: float  # the least any arrival since was behind the line


class Line:
    """Least squares of time on index with exponential forgetting; sums are kept about the newest point."""

    def __init__(self) -> None:
        self.count = 0
        self._x0 = self._t0 = 0.0  # newest point
        self._first_x = self._first_t = 0.0
        self._w = self._mx = self._mt = self._sxx = self._sxt = 0.0

    def add(self, index: float, t_s: float, nominal_hz: float | None = None) -> None:
        """One more (index, arrival) pair; the nominal rate stands in for a slope until there is one."""
        if self.count == 0:
            self._first_x, self._first_t = index, t_s
            self._nominal_s = 1.0 / nominal_hz if nominal_hz else None
        dx, dt = index - self._x0, t_s - self._t0
        keep = max(exp(-max(dt, 0.0) / FORGET_S), KEEP_LEAST) if self.count else 0.0
        # shift the means to the new origin, then update (West 1979)
        self._mx -= dx
        self._mt -= dt
        self._x0, self._t0 = index, t_s
        self._w, self._sxx, self._sxt = self._w * keep + 1.0, self._sxx * keep, self._sxt * keep
        gain = 1.0 / self._w
        ex, et = -self._mx, -self._mt
        self._mx += gain * ex
        self._mt += gain * et
        self._sxx += (1.0 - gain) * ex * ex
        self._sxt += (1.0 - gain) * ex * et
        self.count += 1

    def span_s(self) -> float:
        """Seconds from the first pair to the newest."""
        return self._t0 - self._first_t

    def settled(self) -> bool:
        """Whether the slope rests on enough to tell a hole from jitter."""
        return self._x0 - self._first_x >= LEARN_SAMPLES and self.span_s() >= LEARN_S

    def period_s(self) -> float | None:
        """Seconds a sample; None until two pairs have come."""
        if self.count >= 2 and self._sxt > 0.0 and (self.settled() or self._nominal_s is None):
            return self._sxt / self._sxx
        return self._nominal_s if self.count else None

    def rate_hz(self) -> float | None:
        """Samples a second; None until known."""
        period = self.period_s()
        return 1.0 / period if period else None

    def at(self, index: float) -> float:
        """The line's time at an index, s."""
        period = self.period_s() or 0.0
        return self._t0 + self._mt + (index - self._x0 - self._mx) * period


class _Step:
    """The usual step of a counter: the most frequent one seen so far, of few kinds kept."""

    def __init__(self) -> None:
        self._seen: dict[int, int] = {}

    def see(self, steps: Ints) -> None:
        for step, times in zip(*np.unique(steps[steps > 0], return_counts=True), strict=True):
            if int(step) in self._seen or len(self._seen) < 64:
                self._seen[int(step)] = self._seen.get(int(step), 0) + int(times)

    def usual(self) -> int | None:
        return max(self._seen, key=lambda step: (self._seen[step], -step)) if self._seen else None


def made_rate(measured_hz: float) -> float:
    """The rate that sensors are made with nearest to the measured one, if within SNAP; else the measured, to 5 digits.

    >>> made_rate(99.97), made_rate(99.32)
    (100.0, 99.32)
    """
    nearest = float(MADE_RATES_HZ[np.argmin(np.abs(np.log(MADE_RATES_HZ / measured_hz)))])
    return nearest if abs(measured_hz / nearest - 1.0) < SNAP else float(f"{measured_hz:.5g}")


def _usual(steps: Ints) -> float | None:
    """Median step in s; None where there is none."""
    forward = steps[steps > 0]
    return float(np.median(forward)) / NS if forward.size else None


def _steady(steps: Ints, period_s: float) -> bool:
    """Whether most steps are one period, so that a longer one is a hole and not a late host."""
    inner: Floats = np.abs(steps[1:] / NS / period_s - 1.0)
    return bool(inner.size == 0 or np.median(inner) < 0.25)


def _cut(samples: SampleBlock, t_ns: Ints, missing: Ints) -> list[SampleBlock]:
    """Blocks with the given times, a new one wherever samples are missing."""
    cuts = np.flatnonzero(missing[1:]) + 1
    edges = [0, *cuts.tolist(), len(samples)]
    return [
        block(t_ns[a:b].copy(), samples.values[a:b], samples.temperature_c[a:b], samples.ticks[a:b], int(missing[a]))
        for a, b in pairwise(edges)
    ]
