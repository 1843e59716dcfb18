"""Tests of sample times and missing samples from counters, arrival times and times of the sender.

The true times and missing samples of each simulated stream are known.
"""

from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from drivers.data_types import NO_TICK, ArrivalTimedFormat, CounterTimedFormat, SenderTimedFormat, make_block
from drivers.timing.arrival_regression import FORGET_S, ArrivalRegression, snap_to_standard_rate
from drivers.timing.arrival_timeline import CATCH_UP_S
from drivers.timing.sample_clock import LastSample, SampleClock
from tests.support.recordings import recordings

NS_PER_S = 1e9
START_S = 1e5  # s, host time of the first sample


def delay_to_next_poll(t, every_s=0.016):
    """Return the arrival times through a USB adapter, which is polled every ``every_s`` seconds."""
    return np.ceil(t / every_s) * every_s


def delay_randomly(t, max_delay_s=0.010, seed=0):
    """Return the arrival times with a uniform random delay of up to ``max_delay_s``."""
    return np.maximum.accumulate(t + np.random.default_rng(seed).uniform(0.0, max_delay_s, t.size))


def make_values(n):
    """Return n different rows of values."""
    return np.tile(np.arange(float(n))[:, None], 6)


def feed(clock, arrived_s, ticks=None, lost=None, values=None):
    """Pass samples to the clock in blocks that arrived together. Return the blocks with their times.

    Without ``values``, all rows differ, and the clock must not drop any of them.
    """
    values = make_values(len(arrived_s)) if values is None else values
    edges = [0, *(np.flatnonzero(np.diff(arrived_s)) + 1).tolist(), len(arrived_s)]
    blocks = []
    for a, b in pairwise(edges):
        t_ns = np.rint(arrived_s[a:b] * NS_PER_S).astype(np.int64)
        counted = None if ticks is None else np.array(ticks[a:b], np.int64)
        blocks += clock.assign_times(
            make_block(t_ns, values[a:b].copy(), None, counted, 0 if lost is None else int(lost[a]))
        )
    assert sum(len(block) for block in blocks) + clock.dropped_repeated_rows == len(arrived_s)
    assert (np.diff(join_times(blocks)) > 0).all()
    return blocks


def join_times(blocks):
    return np.concatenate([block.t_ns for block in blocks])


def count_lost(blocks):
    return sum(block.lost for block in blocks)


def take_event_kinds(clock):
    return [event.kind for event in clock.take_events()]


# --- counters

STIM300 = (256, 1 / 2000)
SAMPLES_16 = (65536, None)
XSENS = (1 << 32, 1e-4)
VECTORNAV = (1 << 62, 1e-9)
COUNTERS = [
    (STIM300, 125.0),
    (SAMPLES_16, 100.0),
    ((256, None), 100.0),
    (XSENS, 100.0),
    (VECTORNAV, 40.0),
]


def compute_ticks(index, kind, rate):
    modulus, tick_s = kind
    counted = index if tick_s is None else np.rint(index / rate / tick_s).astype(np.int64)
    return (counted + modulus - 1000 % modulus) % modulus  # starts at -1000, so that the counter wraps around


@pytest.mark.parametrize("configured", [True, False])
@pytest.mark.parametrize(("kind", "rate"), COUNTERS)
class TestCounter:
    @pytest.mark.long
    @pytest.mark.parametrize(
        ("gaps", "delay"),
        [
            ([(300, 1), (400, 10), (402, 1)], delay_randomly),
            ([(5, 3), (900, 300)], delay_to_next_poll),
        ],
    )
    def test_missing_samples_are_counted_exactly(self, kind, rate, configured, gaps, delay):
        index = np.arange(int(24 * rate))
        kept = np.ones(index.size, bool)
        for at, n in gaps:
            # a short counter needs the settled regression to detect a complete wrap-around
            first = at if n < 256 else int(12 * rate)
            kept[first : first + n] = False
        clock = SampleClock(CounterTimedFormat(*kind), rate if configured else None)
        out = feed(clock, delay(START_S + index / rate)[kept], compute_ticks(index, kind, rate)[kept])
        assert count_lost(out) == (~kept).sum()
        assert clock.configured_or_measured_rate_hz == pytest.approx(rate, rel=1e-3)
        assert take_event_kinds(clock) == []

    def test_duplicates_are_dropped_and_not_counted_as_lost(self, kind, rate, configured):
        index = np.arange(int(10 * rate))
        with_duplicates = np.sort(np.concatenate([index, index[200:203]]))
        clock = SampleClock(CounterTimedFormat(*kind), rate if configured else None)
        values = make_values(index.size)[with_duplicates]
        out = feed(
            clock,
            delay_to_next_poll(START_S + index / rate)[with_duplicates],
            compute_ticks(index, kind, rate)[with_duplicates],
            values=values,
        )
        assert count_lost(out) == 0
        assert clock.dropped_repeated_rows == 3
        assert np.array_equal(np.concatenate([block.values for block in out]), make_values(index.size))
        assert set(take_event_kinds(clock)) == {"samples_repeated"}

    def test_row_with_a_repeated_counter_and_other_values_is_kept(self, kind, rate, configured):
        index = np.arange(int(10 * rate))
        with_duplicates = np.sort(np.concatenate([index, index[200:203]]))
        clock = SampleClock(CounterTimedFormat(*kind), rate if configured else None)
        assert (
            count_lost(
                feed(
                    clock,
                    delay_to_next_poll(START_S + index / rate)[with_duplicates],
                    compute_ticks(index, kind, rate)[with_duplicates],
                )
            )
            == 0
        )
        assert clock.dropped_repeated_rows == 0
        assert "other values" in clock.take_events()[0].text

    def test_stuck_counter_is_reported_once(self, kind, rate, configured):
        index = np.arange(int(12 * rate))
        ticks = compute_ticks(index, kind, rate)
        ticks[300:] = ticks[300]
        clock = SampleClock(CounterTimedFormat(*kind), rate if configured else None)
        assert count_lost(feed(clock, delay_to_next_poll(START_S + index / rate), ticks)) == 0
        assert [kind for kind in take_event_kinds(clock) if kind != "samples_repeated"] == ["clock_jumped"]

    def test_samples_during_a_stuck_counter_are_not_missing(self, kind, rate, configured):
        index = np.arange(int(12 * rate))
        ticks = compute_ticks(index, kind, rate)
        ticks[300:350] = ticks[300]
        clock = SampleClock(CounterTimedFormat(*kind), rate if configured else None)
        assert count_lost(feed(clock, delay_to_next_poll(START_S + index / rate), ticks)) <= 1
        assert [kind for kind in take_event_kinds(clock) if kind != "samples_repeated"] == ["clock_jumped"]

    def test_samples_during_a_disconnection_of_five_seconds_are_lost(self, kind, rate, configured):
        index, at, n = np.arange(int(21 * rate)), int(12 * rate), int(5 * rate)
        ticks, arrived = compute_ticks(index, kind, rate), delay_randomly(START_S + index / rate)
        clock = SampleClock(CounterTimedFormat(*kind), rate if configured else None)
        out = feed(clock, arrived[:at], ticks[:at])
        clock.count_next_gap_by_arrival()
        later = feed(clock, arrived[at + n :], ticks[at + n :])
        assert count_lost(out + later) == n
        assert join_times(out)[-1] < join_times(later)[0]
        assert take_event_kinds(clock) == []

    @pytest.mark.parametrize("at_s", [1.0, 12.0])
    def test_loss_is_counted_if_the_device_restarts_during_a_disconnection(self, kind, rate, configured, at_s):
        index, at, n = np.arange(int((at_s + 9) * rate)), int(at_s * rate), int(5 * rate)
        ticks, arrived = compute_ticks(index + 7000, kind, rate), delay_randomly(START_S + index / rate)
        fresh = (
            compute_ticks(index, kind, rate)
            if kind[0] == 256
            else np.rint(index / rate / kind[1] if kind[1] else index)
        )
        clock = SampleClock(CounterTimedFormat(*kind), rate if configured else None)
        out = feed(clock, arrived[:at], ticks[:at])
        clock.count_next_gap_by_arrival()
        out += feed(clock, arrived[at + n :], fresh[: index.size - at - n])
        turn = kind[0] / (rate and 1) * (kind[1] or 1 / rate) * rate  # samples
        if configured or at_s > 5.0:
            # counted by arrival times; a short counter decides by itself and may be wrong by half a turn
            assert count_lost(out) == pytest.approx(n, abs=turn / 2 + 5 if kind[0] == 256 else 5)
        else:  # the rate is unknown, so no losses are assumed
            assert count_lost(out) <= n + turn
        assert take_event_kinds(clock) == ([] if kind[0] == 256 else ["clock_jumped"])

    def test_late_scheduler_loses_no_samples(self, kind, rate, configured):
        index = np.arange(int(18 * rate))
        arrived = delay_to_next_poll(START_S + index / rate)
        asleep = np.flatnonzero((arrived > START_S + 12) & (arrived < START_S + 13))
        arrived[asleep] = START_S + 13 + np.arange(asleep.size) // 60 * 3e-4
        clock = SampleClock(CounterTimedFormat(*kind), rate if configured else None)
        out = feed(clock, np.maximum.accumulate(arrived), compute_ticks(index, kind, rate))
        assert count_lost(out) == 0
        assert take_event_kinds(clock) == []


@pytest.mark.parametrize(("kind", "rate"), COUNTERS)
def test_replay_at_fifty_times_the_configured_rate_loses_no_samples(kind, rate):
    index = np.arange(int(200 * rate))
    clock = SampleClock(CounterTimedFormat(*kind), rate)
    out = feed(clock, delay_to_next_poll(START_S + index / rate / 50, 0.01), compute_ticks(index, kind, rate))
    assert count_lost(out) == 0
    assert take_event_kinds(clock) == []
    assert join_times(out)[-1] / NS_PER_S == pytest.approx(START_S + 4.0, abs=0.1)


@pytest.mark.parametrize(("kind", "rate"), [c for c in COUNTERS if c[0][0] > 256])
def test_unnoticed_restart_of_the_device_is_reported_as_clock_jump(kind, rate):
    index, at = np.arange(int(28 * rate)), int(12 * rate)
    ticks = compute_ticks(index + 7000, kind, rate)
    ticks[at:] = np.rint(np.arange(index.size - at) / rate / kind[1] if kind[1] else np.arange(index.size - at))
    arrived = delay_randomly(START_S + index / rate + 0.7 * (index >= at))
    clock = SampleClock(CounterTimedFormat(*kind), rate)
    assert count_lost(feed(clock, arrived, ticks)) == pytest.approx(0.7 * rate, abs=0.011 * rate + 1)
    assert take_event_kinds(clock) == ["clock_jumped"]


def test_samples_without_a_counter_cause_no_gap():
    index = np.arange(4000)
    ticks = index.copy()
    ticks[1000:1200] = -1
    clock = SampleClock(CounterTimedFormat(65536), 100.0)
    assert count_lost(feed(clock, delay_to_next_poll(START_S + index / 100), ticks)) == 0
    assert take_event_kinds(clock) == []


def test_missing_samples_are_counted_with_jittering_device_times():
    """All steps differ. The clock has to use their median and not the first step."""
    rng = np.random.default_rng(0)
    index = np.arange(4000)
    ticks = np.rint((index / 400 + rng.uniform(-2e-4, 2e-4, index.size)) * 1e9).astype(np.int64) + 10**9
    kept = np.ones(index.size, bool)
    kept[[1, 2, 700, 2000, 2001]] = False
    clock = SampleClock(CounterTimedFormat(*VECTORNAV), None)
    assert count_lost(feed(clock, delay_to_next_poll(START_S + index / 400)[kept], ticks[kept])) == 5


def test_clock_adapts_to_a_new_rate_of_the_device():
    index = np.arange(8000)
    ticks = np.where(index < 4000, 4 * index, 16000 + 8 * (index - 4000)) % 256
    taken = np.where(index < 4000, index / 500, 8 + (index - 4000) / 250)
    clock = SampleClock(CounterTimedFormat(*STIM300), None)
    # until half of the recent steps are new, each step counts as one missing sample
    assert count_lost(feed(clock, delay_to_next_poll(START_S + taken), ticks)) < 200


# --- arrival times alone


@pytest.mark.parametrize("rate", [20.0, 99.32, 500.0])
@pytest.mark.parametrize("delay", [delay_to_next_poll, delay_randomly])
@pytest.mark.parametrize("configured", [True, False])
def test_sample_times_do_not_contain_the_arrival_jitter(rate, delay, configured):
    taken = START_S + np.arange(int(45 * rate)) / rate
    clock = SampleClock(ArrivalTimedFormat(), rate if configured else None)
    out = feed(clock, delay(taken))
    assert count_lost(out) == 0
    assert take_event_kinds(clock) == []
    settled = join_times(out)[int(FORGET_S * rate) :] / NS_PER_S
    # the weight of one arrival in the regression is up to 4 / (arrivals in 30 s); its error is up to 8 ms or 5 ms
    arrivals = FORGET_S * (min(rate, 1 / 0.016) if delay is delay_to_next_poll else rate)
    max_deviation_s = 4 * (0.008 if delay is delay_to_next_poll else 0.005) / arrivals
    assert np.abs(np.diff(settled) - 1 / rate).max() < max(1.5 * max_deviation_s, 5e-6)
    if delay is delay_randomly and rate >= 99.0:
        assert np.abs(np.diff(settled) - 1 / rate).max() < 10e-6
    assert np.ptp(settled - taken[int(FORGET_S * rate) :]) < 3e-3
    assert clock.configured_or_measured_rate_hz == pytest.approx(rate, rel=2e-5 if rate > 50 else 2e-4)
    assert clock.measured_hz == pytest.approx(rate, rel=2e-4)


@pytest.mark.parametrize("rate", [20.0, 99.32])
@pytest.mark.parametrize("delay", [delay_to_next_poll, delay_randomly])
@pytest.mark.parametrize("configured", [True, False])
class TestArrival:
    def clock(self, rate, configured):
        return SampleClock(ArrivalTimedFormat(), rate if configured else None)

    @pytest.mark.parametrize("asleep_s", [0.2, 1.0, 2.5])
    def test_late_scheduler_loses_no_samples(self, rate, delay, configured, asleep_s):
        arrived = delay(START_S + np.arange(int(20 * rate)) / rate)
        asleep = np.flatnonzero((arrived > START_S + 12) & (arrived < START_S + 12 + asleep_s))
        arrived[asleep] = START_S + 12 + asleep_s + np.arange(asleep.size) // 20 * 3e-4
        clock = self.clock(rate, configured)
        out = feed(clock, np.maximum.accumulate(arrived))
        assert count_lost(out) == 0
        assert np.diff(join_times(out)[int(10 * rate) :]).max() < 1.1 * NS_PER_S / rate + 2e6

    @pytest.mark.parametrize("gap_s", [[0.2], [0.5], [2.0], [0.5, 0.3]])
    def test_gaps_are_counted(self, rate, delay, configured, gap_s):
        index = np.arange(int(20 * rate))
        kept = np.ones(index.size, bool)
        for i, length in enumerate(gap_s):
            at = int((12 + 1.5 * i) * rate)
            kept[at : at + round(length * rate)] = False
        clock = self.clock(rate, configured)
        out = feed(clock, delay(START_S + index / rate)[kept])
        assert count_lost(out) == pytest.approx((~kept).sum(), abs=2)
        assert take_event_kinds(clock) == []

    def test_only_reported_rejected_frames_are_lost(self, rate, delay, configured):
        index = np.arange(int(28 * rate))
        bad = np.zeros(index.size, int)
        kept = np.ones(index.size, bool)
        for at in range(100, index.size, 97):
            kept[at : at + 2] = False
            bad[at + 2] = 2
        clock = self.clock(rate, configured)
        # the decoder does not report these gaps, and they are too short to be detected
        assert count_lost(feed(clock, delay(START_S + index / rate)[kept])) == 0
        clock = self.clock(rate, configured)
        arrived = START_S + index / rate  # separate arrivals, so that each block can have its lost samples
        assert count_lost(feed(clock, arrived[kept], lost=bad[kept])) == bad.sum()

    @pytest.mark.parametrize("at_s", [1.0, 12.0])
    def test_samples_during_a_disconnection_of_five_seconds_are_lost(self, rate, delay, configured, at_s):
        arrived = delay(START_S + np.arange(int((at_s + 12) * rate)) / rate)
        at, n = int(at_s * rate), int(5 * rate)
        clock = self.clock(rate, configured)
        out = feed(clock, arrived[:at])
        clock.count_next_gap_by_arrival()
        out += feed(clock, arrived[at + n :])
        if configured or at_s > 5.0:
            assert count_lost(out) == pytest.approx(n, abs=2)
        assert clock.configured_or_measured_rate_hz == pytest.approx(rate, rel=1e-3)


@pytest.mark.parametrize("rows", [1, 500])
@pytest.mark.parametrize("configured", [True, False])
def test_gap_is_counted_if_one_block_contains_many_arrivals(rows, configured):
    index = np.delete(np.arange(3000), np.s_[300:500])
    t_ns = np.rint((START_S + index / 100.0) * NS_PER_S).astype(np.int64)
    clock = SampleClock(ArrivalTimedFormat(), 100.0 if configured else None)
    out = []
    for a in range(0, index.size, rows):
        out += clock.assign_times(make_block(t_ns[a : a + rows], make_values(index.size)[a : a + rows], None))
    assert count_lost(out) == 200
    assert join_times(out)[-1] == pytest.approx(t_ns[-1], abs=1e6)
    at_ns = next(block.t_ns[0] for block in out if block.lost)
    assert 0 <= at_ns - t_ns[300] < (CATCH_UP_S + 0.2) * NS_PER_S


@pytest.mark.parametrize("rate", [20.0, 100.0, 400.0])
def test_fast_replay_without_counter_loses_no_samples(rate):
    clock = SampleClock(ArrivalTimedFormat(), rate)
    out = feed(clock, delay_to_next_poll(START_S + np.arange(int(200 * rate)) / rate / 50, 0.01))
    assert count_lost(out) == 0
    assert join_times(out)[-1] / NS_PER_S == pytest.approx(START_S + 4.0, abs=0.1)


@pytest.mark.long
def test_sample_times_follow_a_drifting_oscillator():
    rate = 24.7  # no multiple of the period is close to a multiple of the polling interval
    index = np.arange(int(900 * rate))
    taken = START_S + np.cumsum((1.0 + 50e-6 * np.sin(2 * np.pi * index / index.size)) / rate)
    clock = SampleClock(ArrivalTimedFormat(), rate)
    out = feed(clock, delay_to_next_poll(taken))
    assert count_lost(out) == 0
    off = join_times(out)[1500:] / NS_PER_S - taken[1500:]
    # the mean delay of the polling drifts by a quarter of its interval, and the regression lags by 30 s
    assert np.ptp(off) < 5e-3


def test_unix_times_keep_their_nanoseconds():
    """A double would round Unix times to 240 ns."""
    t_ns = 1_700_000_000_123_456_789 + np.arange(2000) * 1_000_000
    clock = SampleClock(ArrivalTimedFormat(), 1000.0)
    out = [block for t in t_ns for block in clock.assign_times(make_block(np.array([t]), np.zeros((1, 6))))]
    assert np.abs(join_times(out) - t_ns).max() <= 5


def test_first_samples_of_an_unknown_rate_have_increasing_times():
    clock = SampleClock(ArrivalTimedFormat(), None)
    out = clock.assign_times(make_block(np.full(50, 10**9), np.zeros((50, 6))))
    assert clock.configured_or_measured_rate_hz is None
    assert (np.diff(join_times(out)) > 0).all()


# --- times of the sender


@pytest.mark.parametrize("rows", [1, 20, 4096])
@pytest.mark.parametrize("configured", [True, False])
@pytest.mark.parametrize("scatter", ["exact", "ms", "normal", "uniform", "bursts"])
def test_sender_times_are_kept_and_gaps_are_counted(rows, configured, scatter):
    rng = np.random.default_rng(3)
    index = np.arange(3000)
    kept = ~((index > 1000) & (index <= 1050) | (index == 2000))
    exact = 1.7e9 + index / 100
    t = {
        "exact": exact,
        "ms": np.round(exact, 3),
        "normal": exact + 0.0015 * rng.standard_normal(index.size),
        "uniform": np.sort(exact + rng.uniform(-0.005, 0.005, index.size)),
        "bursts": np.sort(delay_to_next_poll(exact, 0.043) + rng.uniform(0.0, 0.002, index.size)),
    }[scatter][kept]
    t_ns = np.rint(t * NS_PER_S).astype(np.int64)
    clock = SampleClock(SenderTimedFormat(), 100.0 if configured else None)
    out = []
    for at in range(0, len(t_ns), rows):
        out += clock.assign_times(
            make_block(t_ns[at : at + rows].copy(), make_values(len(t_ns))[at : at + rows].copy())
        )
    assert np.array_equal(join_times(out), t_ns)
    if scatter in ("exact", "ms", "normal"):
        assert count_lost(out) in ((51,) if scatter != "normal" else (49, 50, 51, 52))
        assert clock.configured_or_measured_rate_hz == pytest.approx(100.0, rel=5e-3)
    else:  # errors of whole periods, so no losses are assumed
        assert count_lost(out) <= 1
    shared = len(np.unique(t_ns)) < len(t_ns)  # rounding of Unix times to doubles makes times equal
    assert set(take_event_kinds(clock)) <= ({"samples_repeated"} if shared else set())


def test_jumps_of_sender_times_are_reported_and_do_not_change_the_rate():
    t = np.concatenate([np.arange(1000) / 100, 5.0 + np.arange(1000) / 100, 9000.0 + np.arange(1000) / 100])
    clock = SampleClock(SenderTimedFormat(), None)
    out = []
    for at in range(0, 3000, 100):
        out += clock.assign_times(make_block(np.rint(t[at : at + 100] * NS_PER_S).astype(np.int64), np.zeros((100, 6))))
    texts = [event.text for event in clock.take_events()]
    assert [text.split(" by ")[0] for text in texts] == ["time went back", "time jumped ahead"]
    assert clock.configured_or_measured_rate_hz == 100.0
    assert count_lost(out) == round((9000.0 - 14.99) * 100) - 1


def test_repeated_or_decreasing_sender_times_lose_no_samples():
    t = np.arange(2000) / 100
    t[500:503] = t[500]
    t[700:1500:2] -= 0.012
    clock = SampleClock(SenderTimedFormat(), 100.0)
    out = clock.assign_times(make_block(np.rint(t * NS_PER_S).astype(np.int64), make_values(2000)))
    assert count_lost(out) <= 2
    assert sum(len(block) for block in out) == 2000
    assert sorted(take_event_kinds(clock)) == ["clock_jumped", "samples_repeated"]


def test_losses_reported_by_the_sender_are_kept():
    clock = SampleClock(SenderTimedFormat(), 100.0)
    first = make_block(np.arange(100) * 10**7, np.zeros((100, 6)))
    second = make_block(np.arange(107, 207) * 10**7, np.zeros((100, 6)), lost=7)
    assert count_lost(clock.assign_times(first) + clock.assign_times(second)) == 7


def assign_sender_times(clock, t_s, values, rows):
    t_ns = np.rint(np.asarray(t_s) * NS_PER_S).astype(np.int64)
    return [
        block
        for at in range(0, len(t_ns), rows)
        for block in clock.assign_times(make_block(t_ns[at : at + rows].copy(), values[at : at + rows].copy()))
    ]


@pytest.mark.parametrize("rows", [1, 7, 4096])
@pytest.mark.parametrize("repeated_rows", [[880, 881, 900], list(range(400, 440))])
def test_rows_that_are_sent_twice_are_dropped_once(rows, repeated_rows):
    """Single rows or a whole batch are sent twice."""
    sent = np.insert(np.arange(1000), max(repeated_rows) + 1, repeated_rows)
    clock = SampleClock(SenderTimedFormat(), 100.0)
    out = assign_sender_times(clock, 50.0 + sent / 100, make_values(1000)[sent], rows)
    assert np.array_equal(np.concatenate([block.values for block in out])[:, 0], np.arange(1000))
    assert clock.dropped_repeated_rows == len(repeated_rows)
    assert count_lost(out) == 0
    texts = [event.text for event in clock.take_events(ended=True)]
    assert sum(int(text.split()[0]) for text in texts) == len(repeated_rows)
    assert all(text.endswith("left out") for text in texts)


def test_recording_with_every_row_twice_keeps_each_row_once():
    sent = np.repeat(np.arange(3000), 2)
    clock = SampleClock(SenderTimedFormat(), None)
    out = assign_sender_times(clock, sent / 100, make_values(3000)[sent], 1000)
    assert np.array_equal(np.concatenate([block.values for block in out])[:, 0], np.arange(3000))
    assert clock.configured_or_measured_rate_hz == 100.0


@pytest.mark.parametrize("rows", [1, 50, 4096])
def test_equal_rows_with_coarse_times_are_no_repeats(rows):
    """The times have a resolution of 1 s at 5 Hz, and the values have few levels."""
    values = np.repeat(np.random.default_rng(0).integers(0, 2, (3000, 1)).astype(float), 6, axis=1)
    values[:6, 0] = np.arange(6)
    clock = SampleClock(SenderTimedFormat(), 5.0)
    out = assign_sender_times(clock, np.arange(3000) // 5, values, rows)
    assert sum(len(block) for block in out) == 3000
    assert (clock.dropped_repeated_rows, count_lost(out), take_event_kinds(clock)) == (0, 0, [])


@pytest.mark.parametrize("late_by", [1, 3])
def test_rows_out_of_order_in_one_block_are_sorted(late_by):
    sent = np.arange(2000)
    for at in (300, 1000, 1500):
        sent = np.insert(np.delete(sent, at), at + late_by, at)
    clock = SampleClock(SenderTimedFormat(), 100.0)
    out = assign_sender_times(clock, 7.0 + sent[:200] / 100, make_values(2000)[sent[:200]], 200)
    out += assign_sender_times(clock, 7.0 + sent[200:] / 100, make_values(2000)[sent[200:]], 4096)
    assert np.array_equal(np.concatenate([block.values for block in out])[:, 0], np.arange(2000))
    assert count_lost(out) == 0
    assert "out of order: 3" in clock.take_events()[0].text


@pytest.mark.parametrize("late_by", [1, 3])
def test_rows_that_arrive_after_later_rows_are_dropped(late_by):
    sent = np.arange(2000)
    for at in (300, 1000, 1500):
        sent = np.insert(np.delete(sent, at), at + late_by, at)
    clock = SampleClock(SenderTimedFormat(), 100.0)
    out = assign_sender_times(clock, 7.0 + sent / 100, make_values(2000)[sent], 1)
    kept = np.concatenate([block.values for block in out])[:, 0]
    assert np.array_equal(kept, np.delete(np.arange(2000), [300, 1000, 1500]))
    assert (clock.dropped_late_rows, count_lost(out)) == (3, 3)
    assert {event.kind for event in clock.take_events()} == {"clock_jumped"}


@pytest.mark.parametrize("rows", [1, 100])
def test_clock_set_back_by_half_a_second_drops_no_samples(rows):
    t = np.arange(3000) / 100 + 20.0
    t[1500:] -= 0.503
    clock = SampleClock(SenderTimedFormat(), 100.0)
    assert sum(len(block) for block in assign_sender_times(clock, t, make_values(3000), rows)) == 3000
    assert any(event.text == "time went back by 0.493 s" for event in clock.take_events())


def test_events_of_a_kind_are_limited_to_one_per_second():
    sent = np.sort(np.concatenate([np.arange(6000), np.arange(100, 6000, 10)]))
    clock = SampleClock(SenderTimedFormat(), 100.0)
    assign_sender_times(clock, sent / 100, make_values(6000)[sent], 1)
    events = clock.take_events(ended=True)
    assert 50 <= len(events) <= 61
    assert sum(int(event.text.split()[0]) for event in events) == clock.dropped_repeated_rows == 590


@pytest.mark.data
@pytest.mark.parametrize(
    "name", ["mpu6050-hosttime/static-11min", "phone/gyro-a", "px4-bench/bench-69s", "robot-arm/mpu9150"]
)
def test_recordings_of_real_sensors_contain_no_repeats(name):
    data = np.load(recordings() / f"{name}.npz")
    values = np.stack([data[axis] for axis in ("gx", "gy", "gz") * 2], axis=1).astype(np.float64)
    clock = SampleClock(SenderTimedFormat(), None)
    out = assign_sender_times(clock, data["t"], values, 500)
    assert sum(len(block) for block in out) == len(values)
    assert (clock.dropped_repeated_rows, clock.dropped_late_rows) == (0, 0)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "max_lost"),
    [("mpu6050-hosttime/static-11min", 0), ("phone/gyro-a", 0), ("car-phone-can/minute", 0), ("can-car/drive-a", 120)],
)
def test_recordings_with_host_times_have_no_false_gaps(name, max_lost):
    t = np.load(recordings() / f"{name}.npz")["t"]
    t_ns = np.rint(t * NS_PER_S).astype(np.int64)
    for configured_hz in (None, (len(t) - 1) / (t[-1] - t[0])):
        clock = SampleClock(SenderTimedFormat(), configured_hz)
        out = []
        for at in range(0, len(t), 500):
            out += clock.assign_times(make_block(t_ns[at : at + 500].copy(), np.zeros((len(t_ns[at : at + 500]), 6))))
        assert count_lost(out) <= max_lost  # the device in the car itself skips a sample occasionally


# --- parts


def test_regression_of_exact_points_is_exact():
    regression = ArrivalRegression()
    for i in range(100):
        regression.add_point(7.0 * i, 3.0 + 0.07 * i)
    assert regression.rate_hz() == pytest.approx(100.0, rel=1e-12)
    assert regression.time_at_index_s(7000.0) == pytest.approx(73.0, rel=1e-12)


@pytest.mark.parametrize(
    ("measured", "standard"), [(99.97, 100.0), (100.19, 100.0), (100.3, 100.3), (262.1, 262.0), (1e6, 1e6), (0.5, 0.5)]
)
def test_measured_rates_are_snapped_to_standard_rates(measured, standard):
    assert snap_to_standard_rate(measured) == standard


# --- comparison of the configured and the measured rate


def delay_by_stalls(t, seed=0):
    """Return the arrival times on a host that sometimes stalls for up to a second."""
    draw = np.random.default_rng(seed)
    arrived = t + draw.uniform(0.0, 0.005, t.size)
    at = t[0]
    while at < t[-1]:
        at += draw.exponential(5.0)
        until = at + draw.uniform(0.0, 1.0)
        arrived[(arrived > at) & (arrived < until)] = until
    return np.maximum.accumulate(arrived)


@pytest.mark.parametrize("tick_s", [1e-3, 1e-6])
def test_device_clock_contradicts_a_wrong_rate_for_any_arrival_times(tick_s):
    ticks = np.rint(np.arange(600) / 100.0 / tick_s).astype(np.int64)
    for arrived in (START_S + np.arange(600) / 5000.0, delay_randomly(START_S + np.arange(600) / 100.0)):
        wrong, right = (SampleClock(CounterTimedFormat(1 << 32, tick_s), rate) for rate in (200.0, 100.0))
        states = []
        for i in range(0, 600, 5):
            for clock in (wrong, right):
                feed(clock, arrived[i : i + 5], ticks[i : i + 5])
            states.append((wrong.rate_check_pending, wrong.contradicting_rate_hz is not None))
            assert right.contradicting_rate_hz is None
        # the wrong rate is never accepted: first the check is pending, then it contradicts the rate
        assert all(unchecked != contradicted for unchecked, contradicted in states)
        assert wrong.contradicting_rate_hz == pytest.approx(100.0, rel=1e-3)
        assert (wrong.configured_or_measured_rate_hz, right.configured_or_measured_rate_hz) == (100.0, 100.0)
        assert not right.rate_check_pending


def test_coarse_ticks_contradict_no_correct_rate():
    ticks = np.floor(np.arange(4160) / 416.0 / 1e-3).astype(np.int64)  # steps of 2 and 3
    clock = SampleClock(CounterTimedFormat(1 << 16, 1e-3), 416.0)
    feed(clock, delay_randomly(START_S + np.arange(4160) / 416.0), ticks)
    assert not clock.rate_check_pending
    assert (clock.configured_or_measured_rate_hz, clock.contradicting_rate_hz) == (416.0, None)


@pytest.mark.parametrize(
    "delay",
    [
        delay_to_next_poll,
        *(partial(delay, seed=seed) for delay in (delay_randomly, delay_by_stalls) for seed in range(5)),
    ],
)
def test_arrival_jitter_contradicts_no_rate_that_is_nearly_right(delay):
    clock = SampleClock(ArrivalTimedFormat(), 100.2)
    arrived = delay(START_S + np.arange(3000) / 100.0)
    for a in range(0, 3000, 10):
        feed(clock, arrived[a : a + 10])
        assert clock.contradicting_rate_hz is None
    assert not clock.rate_check_pending
    assert clock.configured_or_measured_rate_hz == 100.2


@pytest.mark.parametrize("delay", [delay_randomly, delay_to_next_poll, delay_by_stalls])
def test_arrival_times_contradict_a_rate_that_is_far_off(delay):
    clock = SampleClock(ArrivalTimedFormat(), 200.0)
    feed(clock, delay(START_S + np.arange(3000) / 100.0))
    assert clock.contradicting_rate_hz == pytest.approx(100.0, rel=0.02)


def test_reading_speed_of_a_file_contradicts_no_rate():
    clock = SampleClock(ArrivalTimedFormat(), 100.0, arrivals_are_timed=False)
    feed(clock, START_S + np.arange(6000) / 2000.0)
    assert not clock.rate_check_pending
    assert (clock.configured_or_measured_rate_hz, clock.contradicting_rate_hz) == (100.0, None)


def test_few_sender_times_contradict_a_wrong_rate_at_the_end():
    times_ns = np.arange(150) * 10_000_000
    clock = SampleClock(SenderTimedFormat(), 200.0)
    clock.assign_times(make_block(times_ns, make_values(150)))
    assert clock.rate_check_pending
    assert clock.contradicting_rate_hz is None
    clock.compare_rates_at_end()
    assert not clock.rate_check_pending
    assert clock.contradicting_rate_hz == pytest.approx(100.0)


def test_configured_rate_is_kept_if_the_times_show_no_rate():
    clock = SampleClock(SenderTimedFormat(), 100.0)
    for i in range(17):
        assert clock.rate_check_pending == (i > 0)
        clock.assign_times(make_block(np.zeros(4000, np.int64), make_values(4000) + i))
    assert not clock.rate_check_pending
    assert (clock.configured_or_measured_rate_hz, clock.contradicting_rate_hz) == (100.0, None)


def test_jump_of_sender_times_does_not_restart_the_rate_check():
    clock = SampleClock(SenderTimedFormat(), 200.0)
    times_ns = np.arange(600) * 10_000_000
    for a in range(0, 600, 20):
        clock.assign_times(make_block(times_ns[a : a + 20].copy(), make_values(20) + a))
    assert clock.contradicting_rate_hz == pytest.approx(100.0)
    clock.assign_times(make_block(times_ns[:20] - 10**12, make_values(20)))
    assert not clock.rate_check_pending
    assert clock.contradicting_rate_hz == pytest.approx(100.0)


def test_rate_check_is_pending_after_a_restart():
    clock = SampleClock(ArrivalTimedFormat(), 200.0)
    assert not clock.rate_check_pending
    clock.resume_after_restart(LastSample(round(START_S * NS_PER_S), NO_TICK, 200.0, None))
    assert clock.rate_check_pending


@pytest.mark.parametrize("longest_stall_s", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_wrong_period_after_rejected_lines_does_not_cause_endless_losses(seed, longest_stall_s):
    """More lines are rejected than the device can have sent samples. Then good samples arrive irregularly."""
    rng = np.random.default_rng(seed)
    clock = SampleClock(ArrivalTimedFormat(), 100.0)
    total_lost = 0

    def feed_at(arrived_s, n, rejected=0):
        t_ns = np.full(n, round((START_S + arrived_s) * NS_PER_S), np.int64)
        return count_lost(clock.assign_times(make_block(t_ns, make_values(n), lost=rejected)))

    def stream(begun_s, ended_s):
        arrived_s, sent, missing = begun_s, 0, 0
        while arrived_s < ended_s:
            arrived_s += rng.uniform(0.1, 1.0) * longest_stall_s
            due = int((arrived_s - begun_s) * 100.0)
            missing += feed_at(arrived_s, due - sent) if due > sent else 0
            sent = due
        return missing

    total_lost += feed_at(0.0, 50)
    total_lost += stream(0.3, 2.8)
    total_lost += feed_at(3.8, 50, rejected=446)
    assert total_lost == 0
    settling = stream(3.8, 20.0)
    assert settling < 1.5 * 100.0 * longest_stall_s  # caused by the delays of the first seconds
    assert stream(20.0, 120.0) < 3 * 100.0 * longest_stall_s
    assert clock.measured_hz == pytest.approx(100.0, rel=0.01)
