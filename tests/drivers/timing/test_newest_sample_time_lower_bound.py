"""Tests of gaps and jumps of a device's counter while the reading process gets no processor time.

A simulated sensor sends into a buffer of limited size. A simulated reader empties the buffer late and in bursts, as a
process without processor time does. The clock has to count exactly the samples that did not fit into the buffer.
"""

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.data_types import CounterTimedFormat, SampleBlock, make_block
from drivers.timing.newest_sample_time_lower_bound import SETTLED_S, WINDOW_S, NewestSampleTimeLowerBound
from drivers.timing.sample_clock import LastSample, SampleClock

NS_PER_S = 1e9
START_S = 5_000.0
"""Host time at which the link is opened."""
POLL_S = 0.01
BURST_S = 2e-4
"""Time between two reads while the buffer is not empty."""
TIME_COUNTER = CounterTimedFormat(1 << 40, 1e-6)
SAMPLE_COUNTER = CounterTimedFormat(1 << 32)
COUNTERS = st.sampled_from(
    [(TIME_COUNTER, True), (TIME_COUNTER, False), (SAMPLE_COUNTER, True), (SAMPLE_COUNTER, False)]
)
"""Format of the counter, and True if the rate is configured."""


@dataclass(frozen=True)
class Pause:
    """Period in which the reader gets no processor time."""

    start_s: float
    duration_s: float


@dataclass
class Reader:
    """Simulated reader of a sensor's buffer.

    Parameters
    ----------
    rate_hz : float
        Number of samples that the sensor sends per second, from time 0 on.
    capacity : int
        Number of samples that fit into the buffer. Samples are lost while the buffer is full.
    max_read : int
        Maximum number of samples of one read.
    pauses : list of Pause
        Periods in which nothing is read.
    """

    rate_hz: float
    capacity: int
    max_read: int
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
                reads.append((now_s, waiting[: self.max_read]))
                del waiting[: self.max_read]
            now_s += BURST_S if waiting else POLL_S
            for pause in self.pauses:
                if pause.start_s <= now_s < pause.start_s + pause.duration_s:
                    now_s = pause.start_s + pause.duration_s
        return reads


def compute_ticks(index: "np.ndarray", counter: CounterTimedFormat, rate_hz: float) -> "np.ndarray":
    counted = index if counter.tick_s is None else np.rint(index / (rate_hz * counter.tick_s))
    return (counted.astype(np.int64) + counter.modulus - 1000) % counter.modulus  # wraps early


def assign_times(clock: SampleClock, arrived_s: float, samples: list[int], ticks: "np.ndarray") -> list[SampleBlock]:
    values = np.tile(np.array(samples, float)[:, None], 6)
    t_ns = np.full(len(samples), round((START_S + arrived_s) * NS_PER_S))
    return clock.assign_times(make_block(t_ns, values, None, ticks))


def count_received_and_lost(blocks: list[SampleBlock]) -> tuple[int, int]:
    return sum(len(block) for block in blocks), sum(block.lost for block in blocks)


def get_jump_events(clock: SampleClock) -> list[str]:
    return [event.text for event in clock.take_events(ended=True) if event.kind == "clock_jumped"]


def open_clock(counter: CounterTimedFormat, rate_hz: float, configured: bool) -> SampleClock:
    """Return a clock for a link that is opened at ``START_S``."""
    clock = SampleClock(counter, rate_hz if configured else None)
    clock.note_no_unread_data(round(START_S * NS_PER_S))
    return clock


pauses = st.lists(
    st.builds(Pause, st.floats(0.0, 30.0), st.one_of(st.floats(0.02, 4.0), st.floats(4.0, 300.0))), max_size=4
)
readers = st.builds(
    Reader,
    rate_hz=st.sampled_from([10.0, 25.0]),
    capacity=st.integers(20, 800),
    max_read=st.sampled_from([3, 60, 1000]),
    pauses=pauses,
)


@settings(max_examples=15)
@given(reader=readers, kind=COUNTERS)
def test_every_sample_counts_as_received_or_lost(reader: Reader, kind: tuple[CounterTimedFormat, bool]) -> None:
    counter, configured = kind
    reads = reader.read(35.0 + sum(pause.duration_s for pause in reader.pauses))
    clock = open_clock(counter, reader.rate_hz, configured)
    blocks: list[SampleBlock] = []
    for arrived_s, samples in reads:
        blocks += assign_times(clock, arrived_s, samples, compute_ticks(np.array(samples), counter, reader.rate_hz))
    received, lost = count_received_and_lost(blocks)
    assert received == sum(len(samples) for _, samples in reads)
    assert received + lost == reads[-1][1][-1] + 1
    assert get_jump_events(clock) == []


PAUSES = [Pause(12.0, 0.4), Pause(15.0, 8.0), Pause(30.0, 1.5)]


@pytest.mark.parametrize(("configured", "with_pauses"), [(True, True), (False, False)])
@pytest.mark.parametrize("counter", [TIME_COUNTER, SAMPLE_COUNTER])
@pytest.mark.parametrize("ahead_s", [-3600.0, -45.0, 30.0, 86400.0])
def test_counter_jump_is_reported_and_counts_as_no_loss(
    counter: CounterTimedFormat, configured: bool, ahead_s: float, with_pauses: bool
) -> None:
    """The counter jumps forward or backward at 40 s."""
    rate_hz = 50.0
    reads = Reader(rate_hz, 150, 60, PAUSES if with_pauses else []).read(60.0)
    clock = open_clock(counter, rate_hz, configured)
    blocks: list[SampleBlock] = []
    for arrived_s, samples in reads:
        index = np.array(samples)
        index = np.where(index < 2000, index, index + round(ahead_s * rate_hz))
        blocks += assign_times(clock, arrived_s, samples, compute_ticks(index, counter, rate_hz))
    received, lost = count_received_and_lost(blocks)
    assert received + lost == pytest.approx(3000, abs=2)
    assert len(get_jump_events(clock)) == 1


@settings(max_examples=10)
@given(
    start_s=st.floats(SETTLED_S + 1.0, 50.0),
    duration_s=st.floats(0.0, 20.0),
    ahead_s=st.one_of(st.floats(25.0, 1e5), st.floats(-1e5, -25.0)),
    kind=COUNTERS,
)
def test_jump_longer_than_the_pause_is_reported(
    start_s: float, duration_s: float, ahead_s: float, kind: tuple[CounterTimedFormat, bool]
) -> None:
    """The counter jumps during a pause of the reader. A step longer than the pause cannot be a gap."""
    counter, configured = kind
    rate_hz = 20.0
    reads = Reader(rate_hz, 1000, 60, [Pause(start_s, duration_s)]).read(80.0)
    clock = open_clock(counter, rate_hz, configured)
    jump_at = round((start_s + 0.5) * rate_hz)
    for arrived_s, samples in reads:
        index = np.array(samples)
        index = np.where(index < jump_at, index, index + round(ahead_s * rate_hz))
        assign_times(clock, arrived_s, samples, compute_ticks(index, counter, rate_hz))
    assert len(get_jump_events(clock)) == 1


def test_jump_is_reported_for_a_device_that_starts_late() -> None:
    """The link is idle until the device is switched on."""
    clock = open_clock(TIME_COUNTER, 100.0, configured=True)
    clock.note_no_unread_data(round((START_S + 60.0) * NS_PER_S))
    for i in range(100):
        assign_times(clock, 60.05 + i / 100, [i], compute_ticks(np.array([i + 1000 * (i >= 50)]), TIME_COUNTER, 100.0))
    assert len(get_jump_events(clock)) == 1


@pytest.mark.parametrize("counter", [TIME_COUNTER, SAMPLE_COUNTER])
@pytest.mark.parametrize(("counter_step", "jumps"), [(800, 0), (10_000, 1)])
def test_gap_across_a_restart_includes_the_delay_of_the_last_read(
    counter: CounterTimedFormat, counter_step: int, jumps: int
) -> None:
    """The last sample was measured at 2.5 s and read at 6 s. The first sample after the restart arrives at 10.5 s."""
    last = np.array([250])
    step = 1.0 if counter.tick_s is None else 1e4
    clock = SampleClock(counter, 100.0)
    clock.resume_after_restart(
        LastSample(round((START_S + 6.0) * NS_PER_S), int(compute_ticks(last, counter, 100.0)[0]), 100.0, step)
    )
    blocks = assign_times(clock, 10.5, [1], compute_ticks(last + counter_step, counter, 100.0))
    assert len(get_jump_events(clock)) == jumps
    if not jumps:
        assert count_received_and_lost(blocks) == (1, counter_step - 1)


def test_bound_recovers_from_a_wrong_period() -> None:
    bound = NewestSampleTimeLowerBound()
    bound.start_clock(0.0)
    for i in range(1, round(5 * WINDOW_S)):
        # the period is half the true one at first, so the bound lags
        bound.advance_clock(1, float(i), 0.5 if i < 10 else 1.0)
        assert bound.newest_sample_not_before_s is not None
        assert bound.newest_sample_not_before_s <= i
    assert bound.newest_sample_not_before_s == pytest.approx(i, abs=1e-9)
