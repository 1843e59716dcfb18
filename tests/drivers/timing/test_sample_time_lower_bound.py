"""Holes and jumps of a device's counter while the reading process gets no processor time.

A simulated sensor sends into a buffer of limited size. A simulated reader empties the buffer late and in bursts, as a
starved process does. The samples that find no room are the truth that the clock has to find.
"""

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.data_types import CounterTimedFormat, SampleBlock, make_block
from drivers.timing.sample_clock import LastSample, SampleClock
from drivers.timing.sample_time_lower_bound import SETTLED_S, WINDOW_S, NewestSampleTimeLowerBound

NS = 1e9
BEGUN_S = 5_000.0
"""Host time at which the link is opened."""
POLL_S = 0.01
BURST_S = 2e-4
"""Time between two reads while the buffer is not empty."""
WITH_TIME = CounterTimedFormat(1 << 40, 1e-6)
SAMPLES = CounterTimedFormat(1 << 32)
COUNTERS = st.sampled_from([(WITH_TIME, True), (WITH_TIME, False), (SAMPLES, True), (SAMPLES, False)])
"""What is counted, and whether the rate is configured."""


@dataclass(frozen=True)
class Pause:
    """The reader gets no processor time."""

    at_s: float
    for_s: float


@dataclass
class Reader:
    """Reads a sensor's buffer.

    Parameters
    ----------
    rate_hz : float
        Samples a second that are sent from time 0 on.
    capacity : int
        Samples that find room in the buffer; later ones are lost until there is room.
    most : int
        Samples that one read takes.
    pauses : list of Pause
        When nothing is read.
    """

    rate_hz: float
    capacity: int
    most: int
    pauses: list[Pause]

    def read(self, until_s: float) -> list[tuple[float, list[int]]]:
        """Return the arrival time in s and the samples of each read."""
        taken_s = (np.arange(int(until_s * self.rate_hz)) / self.rate_hz).tolist()
        waiting: list[int] = []
        reads = []
        sent, now_s = 0, 0.0
        while now_s < until_s:
            due = bisect_right(taken_s, now_s)
            waiting += range(sent, min(due, sent + self.capacity - len(waiting)))
            sent = due
            if waiting:
                reads.append((now_s, waiting[: self.most]))
                del waiting[: self.most]
            now_s += BURST_S if waiting else POLL_S
            for pause in self.pauses:
                if pause.at_s <= now_s < pause.at_s + pause.for_s:
                    now_s = pause.at_s + pause.for_s
        return reads


def ticks_of(index: "np.ndarray", counter: CounterTimedFormat, rate_hz: float) -> "np.ndarray":
    counted = index if counter.tick_s is None else np.rint(index / (rate_hz * counter.tick_s))
    return (counted.astype(np.int64) + counter.modulus - 1000) % counter.modulus  # wraps early


def stamp(clock: SampleClock, arrived_s: float, samples: list[int], ticks: "np.ndarray") -> list[SampleBlock]:
    values = np.tile(np.array(samples, float)[:, None], 6)
    t_ns = np.full(len(samples), round((BEGUN_S + arrived_s) * NS))
    return clock.assign_times(make_block(t_ns, values, None, ticks))


def counts(out: list[SampleBlock]) -> tuple[int, int]:
    return sum(len(one) for one in out), sum(one.lost for one in out)


def told(clock: SampleClock) -> list[str]:
    return [event.text for event in clock.take_events(ended=True) if event.kind == "clock_jumped"]


def new_clock(counter: CounterTimedFormat, rate_hz: float, configured: bool) -> SampleClock:
    clock = SampleClock(counter, rate_hz if configured else None)
    clock.note_no_unread_data(round(BEGUN_S * NS))
    return clock


pauses = st.lists(
    st.builds(Pause, st.floats(0.0, 30.0), st.one_of(st.floats(0.02, 4.0), st.floats(4.0, 300.0))), max_size=4
)
readers = st.builds(
    Reader,
    rate_hz=st.sampled_from([10.0, 50.0]),
    capacity=st.integers(20, 800),
    most=st.sampled_from([3, 60, 1000]),
    pauses=pauses,
)


@settings(max_examples=40)
@given(reader=readers, kind=COUNTERS)
def test_every_sample_is_received_or_lost_however_late_it_is_read(
    reader: Reader, kind: tuple[CounterTimedFormat, bool]
) -> None:
    counter, configured = kind
    reads = reader.read(35.0 + sum(pause.for_s for pause in reader.pauses))
    clock = new_clock(counter, reader.rate_hz, configured)
    out: list[SampleBlock] = []
    for arrived_s, samples in reads:
        out += stamp(clock, arrived_s, samples, ticks_of(np.array(samples), counter, reader.rate_hz))
    received, lost = counts(out)
    assert received == sum(len(samples) for _, samples in reads)
    assert received + lost == reads[-1][1][-1] + 1
    assert told(clock) == []


STARVED = [Pause(12.0, 0.4), Pause(15.0, 8.0), Pause(30.0, 1.5)]


@pytest.mark.parametrize("configured", [True, False])
@pytest.mark.parametrize("counter", [WITH_TIME, SAMPLES])
@pytest.mark.parametrize("ahead_s", [-3600.0, -45.0, 30.0, 3600.0, 86400.0])
@pytest.mark.parametrize("starved", [False, True])
def test_a_jump_is_told_and_counted_as_no_loss(
    counter: CounterTimedFormat, configured: bool, ahead_s: float, starved: bool
) -> None:
    """The counter goes on or back, or begins anew, at 40 s."""
    rate_hz = 100.0
    reads = Reader(rate_hz, 300, 60, STARVED if starved else []).read(60.0)
    clock = new_clock(counter, rate_hz, configured)
    out: list[SampleBlock] = []
    for arrived_s, samples in reads:
        index = np.array(samples)
        index = np.where(index < 4000, index, index + round(ahead_s * rate_hz))
        out += stamp(clock, arrived_s, samples, ticks_of(index, counter, rate_hz))
    received, lost = counts(out)
    assert received + lost == pytest.approx(6000, abs=2)
    assert len(told(clock)) == 1


@settings(max_examples=25)
@given(
    at_s=st.floats(SETTLED_S + 1.0, 50.0),
    for_s=st.floats(0.0, 20.0),
    ahead_s=st.one_of(st.floats(25.0, 1e5), st.floats(-1e5, -25.0)),
    kind=COUNTERS,
)
def test_a_jump_longer_than_the_reader_was_late_is_told(
    at_s: float, for_s: float, ahead_s: float, kind: tuple[CounterTimedFormat, bool]
) -> None:
    """The counter jumps while the reader is late: a longer step than that cannot be a hole."""
    counter, configured = kind
    rate_hz = 20.0
    reads = Reader(rate_hz, 1000, 60, [Pause(at_s, for_s)]).read(80.0)
    clock = new_clock(counter, rate_hz, configured)
    jump_at = round((at_s + 0.5) * rate_hz)
    for arrived_s, samples in reads:
        index = np.array(samples)
        index = np.where(index < jump_at, index, index + round(ahead_s * rate_hz))
        stamp(clock, arrived_s, samples, ticks_of(index, counter, rate_hz))
    assert len(told(clock)) == 1


def test_a_device_that_begins_late_has_jumps_told_from_its_first_samples_on() -> None:
    """The link is idle until the device is switched on."""
    clock = new_clock(WITH_TIME, 100.0, configured=True)
    clock.note_no_unread_data(round((BEGUN_S + 60.0) * NS))
    for i in range(100):
        stamp(clock, 60.05 + i / 100, [i], ticks_of(np.array([i + 1000 * (i >= 50)]), WITH_TIME, 100.0))
    assert len(told(clock)) == 1


@pytest.mark.parametrize("counter", [WITH_TIME, SAMPLES])
@pytest.mark.parametrize(("away", "jumps"), [(800, 0), (10_000, 1)])
def test_the_last_sample_before_a_restart_may_have_been_read_late(
    counter: CounterTimedFormat, away: int, jumps: int
) -> None:
    """It was taken at 2.5 s and read at 6 s; after the restart the first sample comes at 10.5 s."""
    last = np.array([250])
    step = 1.0 if counter.tick_s is None else 1e4
    clock = SampleClock(counter, 100.0)
    clock.resume_after_restart(
        LastSample(round((BEGUN_S + 6.0) * NS), int(ticks_of(last, counter, 100.0)[0]), 100.0, step)
    )
    out = stamp(clock, 10.5, [1], ticks_of(last + away, counter, 100.0))
    assert len(told(clock)) == jumps
    if not jumps:
        assert counts(out) == (1, away - 1)


def test_the_bound_forgets_a_period_that_was_wrong() -> None:
    bound = NewestSampleTimeLowerBound()
    bound.start_clock(0.0)
    for i in range(1, round(5 * WINDOW_S)):
        bound.advance_clock(1, float(i), 0.5 if i < 10 else 1.0)  # half of it at first: the bound falls behind
        assert bound.newest_sample_not_before_s is not None
        assert bound.newest_sample_not_before_s <= i
    assert bound.newest_sample_not_before_s == pytest.approx(i, abs=1e-9)
