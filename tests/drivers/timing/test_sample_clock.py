"""Sample times and missing samples from counters, arrivals and given times, in scenarios where the truth is known."""

from itertools import pairwise

import numpy as np
import pytest

from drivers.data_types import NO_TICK, ArrivalTimedFormat, CounterTimedFormat, SenderTimedFormat, make_block
from drivers.timing.arrival_regression import FORGET_S, ArrivalRegression, snap_to_standard_rate
from drivers.timing.sample_clock import LastSample, SampleClock
from tests.support.recordings import recordings

NS = 1e9
T0 = 1e5  # s, where the host's clock stands


def burst(t, every_s=0.016):
    """Arrival at the next poll of a USB adapter."""
    return np.ceil(t / every_s) * every_s


def jitter(t, most_s=0.010, seed=0):
    return np.maximum.accumulate(t + np.random.default_rng(seed).uniform(0.0, most_s, t.size))


def varied(n):
    """Values of n rows, none like another."""
    return np.tile(np.arange(float(n))[:, None], 6)


def feed(clock, arrived_s, ticks=None, lost=None, values=None):
    """Blocks of the samples that arrived together; no sample may be kept out unless ``values`` are given."""
    values = varied(len(arrived_s)) if values is None else values
    edges = [0, *(np.flatnonzero(np.diff(arrived_s)) + 1).tolist(), len(arrived_s)]
    out = []
    for a, b in pairwise(edges):
        t_ns = np.rint(arrived_s[a:b] * NS).astype(np.int64)
        counted = None if ticks is None else np.array(ticks[a:b], np.int64)
        out += clock.assign_times(
            make_block(t_ns, values[a:b].copy(), None, counted, 0 if lost is None else int(lost[a]))
        )
    assert sum(len(one) for one in out) + clock.dropped_repeated_rows == len(arrived_s)
    assert (np.diff(times(out)) > 0).all()
    return out


def times(out):
    return np.concatenate([one.t_ns for one in out])


def lost(out):
    return sum(one.lost for one in out)


def kinds(clock):
    return [event.kind for event in clock.take_events()]


# --- counters

STIM300 = (256, 1 / 2000)
SAMPLES_16 = (65536, None)
XSENS = (1 << 32, 1e-4)
VECTORNAV = (1 << 62, 1e-9)
COUNTERS = [
    (STIM300, 125.0),
    (STIM300, 262.0),
    (SAMPLES_16, 100.0),
    ((256, None), 100.0),
    (XSENS, 100.0),
    (VECTORNAV, 40.0),
]


def ticks_of(index, kind, rate):
    modulus, tick_s = kind
    counted = index if tick_s is None else np.rint(index / rate / tick_s).astype(np.int64)
    return (counted + modulus - 1000 % modulus) % modulus  # so that it wraps


@pytest.mark.parametrize("nominal", [True, False])
@pytest.mark.parametrize(("kind", "rate"), COUNTERS)
class TestCounter:
    @pytest.mark.long
    @pytest.mark.parametrize("holes", [[], [(5, 3)], [(300, 1), (400, 10), (402, 1)], [(900, 300)]])
    @pytest.mark.parametrize("arrive", [burst, jitter])
    def test_missing_samples_are_exact(self, kind, rate, nominal, holes, arrive):
        index = np.arange(int(24 * rate))
        kept = np.ones(index.size, bool)
        for at, n in holes:
            # a short counter needs the settled line to see a whole turn
            first = at if n < 256 else int(12 * rate)
            kept[first : first + n] = False
        clock = SampleClock(CounterTimedFormat(*kind), rate if nominal else None)
        out = feed(clock, arrive(T0 + index / rate)[kept], ticks_of(index, kind, rate)[kept])
        assert lost(out) == (~kept).sum()
        assert clock.configured_or_measured_rate_hz == pytest.approx(rate, rel=1e-3)
        assert kinds(clock) == []

    def test_duplicates_lose_nothing_and_are_kept_out(self, kind, rate, nominal):
        index = np.arange(int(10 * rate))
        twice = np.sort(np.concatenate([index, index[200:203]]))
        clock = SampleClock(CounterTimedFormat(*kind), rate if nominal else None)
        values = varied(index.size)[twice]
        out = feed(clock, burst(T0 + index / rate)[twice], ticks_of(index, kind, rate)[twice], values=values)
        assert lost(out) == 0
        assert clock.dropped_repeated_rows == 3
        assert np.array_equal(np.concatenate([one.values for one in out]), varied(index.size))
        assert set(kinds(clock)) == {"samples_repeated"}

    def test_the_same_count_with_other_values_is_kept(self, kind, rate, nominal):
        index = np.arange(int(10 * rate))
        twice = np.sort(np.concatenate([index, index[200:203]]))
        clock = SampleClock(CounterTimedFormat(*kind), rate if nominal else None)
        assert lost(feed(clock, burst(T0 + index / rate)[twice], ticks_of(index, kind, rate)[twice])) == 0
        assert clock.dropped_repeated_rows == 0
        assert "other values" in clock.take_events()[0].text

    def test_a_counter_that_sticks_is_told_once(self, kind, rate, nominal):
        index = np.arange(int(12 * rate))
        ticks = ticks_of(index, kind, rate)
        ticks[300:] = ticks[300]
        clock = SampleClock(CounterTimedFormat(*kind), rate if nominal else None)
        assert lost(feed(clock, burst(T0 + index / rate), ticks)) == 0
        assert [kind for kind in kinds(clock) if kind != "samples_repeated"] == ["clock_jumped"]

    def test_what_came_while_it_stood_still_is_not_missing(self, kind, rate, nominal):
        index = np.arange(int(12 * rate))
        ticks = ticks_of(index, kind, rate)
        ticks[300:350] = ticks[300]
        clock = SampleClock(CounterTimedFormat(*kind), rate if nominal else None)
        assert lost(feed(clock, burst(T0 + index / rate), ticks)) <= 1
        assert [kind for kind in kinds(clock) if kind != "samples_repeated"] == ["clock_jumped"]

    def test_a_cable_out_for_five_seconds(self, kind, rate, nominal):
        index, at, n = np.arange(int(28 * rate)), int(12 * rate), int(5 * rate)
        ticks, arrived = ticks_of(index, kind, rate), jitter(T0 + index / rate)
        clock = SampleClock(CounterTimedFormat(*kind), rate if nominal else None)
        out = feed(clock, arrived[:at], ticks[:at])
        clock.count_next_gap_by_arrival()
        later = feed(clock, arrived[at + n :], ticks[at + n :])
        assert lost(out + later) == n
        assert times(out)[-1] < times(later)[0]
        assert kinds(clock) == []

    @pytest.mark.parametrize("at_s", [1.0, 12.0])
    def test_a_cable_out_and_the_device_begins_anew(self, kind, rate, nominal, at_s):
        index, at, n = np.arange(int(28 * rate)), int(at_s * rate), int(5 * rate)
        ticks, arrived = ticks_of(index + 7000, kind, rate), jitter(T0 + index / rate)
        fresh = ticks_of(index, kind, rate) if kind[0] == 256 else np.rint(index / rate / kind[1] if kind[1] else index)
        clock = SampleClock(CounterTimedFormat(*kind), rate if nominal else None)
        out = feed(clock, arrived[:at], ticks[:at])
        clock.count_next_gap_by_arrival()
        out += feed(clock, arrived[at + n :], fresh[: index.size - at - n])
        turn = kind[0] / (rate and 1) * (kind[1] or 1 / rate) * rate  # samples
        if nominal or at_s > 5.0:
            # by arrival; what a short counter shows stands, and may be off by half a turn
            assert lost(out) == pytest.approx(n, abs=turn / 2 + 5 if kind[0] == 256 else 5)
        else:  # nothing is known of the rate: nothing is invented
            assert lost(out) <= n + turn
        assert kinds(clock) == ([] if kind[0] == 256 else ["clock_jumped"])

    def test_a_late_scheduler_loses_nothing(self, kind, rate, nominal):
        index = np.arange(int(28 * rate))
        arrived = burst(T0 + index / rate)
        asleep = np.flatnonzero((arrived > T0 + 12) & (arrived < T0 + 13))
        arrived[asleep] = T0 + 13 + np.arange(asleep.size) // 60 * 3e-4
        clock = SampleClock(CounterTimedFormat(*kind), rate if nominal else None)
        out = feed(clock, np.maximum.accumulate(arrived), ticks_of(index, kind, rate))
        assert lost(out) == 0
        assert kinds(clock) == []


@pytest.mark.parametrize(("kind", "rate"), COUNTERS)
def test_a_replay_fifty_times_as_fast_as_configured(kind, rate):
    index = np.arange(int(200 * rate))
    clock = SampleClock(CounterTimedFormat(*kind), rate)
    out = feed(clock, burst(T0 + index / rate / 50, 0.01), ticks_of(index, kind, rate))
    assert lost(out) == 0
    assert kinds(clock) == []
    assert times(out)[-1] / NS == pytest.approx(T0 + 4.0, abs=0.1)


@pytest.mark.parametrize(("kind", "rate"), [c for c in COUNTERS if c[0][0] > 256])
def test_a_device_that_starts_anew_unseen(kind, rate):
    index, at = np.arange(int(28 * rate)), int(12 * rate)
    ticks = ticks_of(index + 7000, kind, rate)
    ticks[at:] = np.rint(np.arange(index.size - at) / rate / kind[1] if kind[1] else np.arange(index.size - at))
    arrived = jitter(T0 + index / rate + 0.7 * (index >= at))
    clock = SampleClock(CounterTimedFormat(*kind), rate)
    assert lost(feed(clock, arrived, ticks)) == pytest.approx(0.7 * rate, abs=0.011 * rate + 1)
    assert kinds(clock) == ["clock_jumped"]


def test_samples_without_their_counter_go_by_arrival_and_leave_no_false_gap():
    index = np.arange(4000)
    ticks = index.copy()
    ticks[1000:1200] = -1
    clock = SampleClock(CounterTimedFormat(65536), 100.0)
    assert lost(feed(clock, burst(T0 + index / 100), ticks)) == 0
    assert kinds(clock) == []


def test_time_stamps_of_the_device_may_jitter():
    """Each step is another: what is usual is their middle, not the one that happened to come first."""
    rng = np.random.default_rng(0)
    index = np.arange(4000)
    ticks = np.rint((index / 400 + rng.uniform(-2e-4, 2e-4, index.size)) * 1e9).astype(np.int64) + 10**9
    kept = np.ones(index.size, bool)
    kept[[1, 2, 700, 2000, 2001]] = False
    clock = SampleClock(CounterTimedFormat(*VECTORNAV), None)
    assert lost(feed(clock, burst(T0 + index / 400)[kept], ticks[kept])) == 5


def test_a_device_set_to_another_rate_is_believed():
    index = np.arange(8000)
    ticks = np.where(index < 4000, 4 * index, 16000 + 8 * (index - 4000)) % 256
    taken = np.where(index < 4000, index / 500, 8 + (index - 4000) / 250)
    clock = SampleClock(CounterTimedFormat(*STIM300), None)
    # until half of the last steps are the new ones, each counts as one missing
    assert lost(feed(clock, burst(T0 + taken), ticks)) < 200


# --- arrival alone


@pytest.mark.parametrize("rate", [20.0, 99.32, 100.0, 2000.0])
@pytest.mark.parametrize("arrive", [burst, jitter])
@pytest.mark.parametrize("nominal", [True, False])
def test_arrival_jitter_does_not_become_jitter_of_the_samples(rate, arrive, nominal):
    taken = T0 + np.arange(int(45 * rate)) / rate
    clock = SampleClock(ArrivalTimedFormat(), rate if nominal else None)
    out = feed(clock, arrive(taken))
    assert lost(out) == 0
    assert kinds(clock) == []
    settled = times(out)[int(FORGET_S * rate) :] / NS
    # an arrival's own share in the line is up to 4 of the arrivals in 30 s; a burst is off by up to 8 ms, jitter by 5
    arrivals = FORGET_S * (min(rate, 1 / 0.016) if arrive is burst else rate)
    most = 4 * (0.008 if arrive is burst else 0.005) / arrivals
    assert np.abs(np.diff(settled) - 1 / rate).max() < max(1.5 * most, 5e-6)
    if arrive is jitter and rate >= 99.0:
        assert np.abs(np.diff(settled) - 1 / rate).max() < 10e-6
    assert np.ptp(settled - taken[int(FORGET_S * rate) :]) < 3e-3
    assert clock.configured_or_measured_rate_hz == pytest.approx(rate, rel=2e-5 if rate > 50 else 2e-4)
    assert clock.measured_hz == pytest.approx(rate, rel=2e-4)


@pytest.mark.parametrize("rate", [20.0, 99.32, 100.0])
@pytest.mark.parametrize("arrive", [burst, jitter])
@pytest.mark.parametrize("nominal", [True, False])
class TestArrival:
    def clock(self, rate, nominal):
        return SampleClock(ArrivalTimedFormat(), rate if nominal else None)

    @pytest.mark.parametrize("asleep_s", [0.2, 1.0, 2.5])
    def test_a_late_scheduler_loses_nothing(self, rate, arrive, nominal, asleep_s):
        arrived = arrive(T0 + np.arange(int(28 * rate)) / rate)
        asleep = np.flatnonzero((arrived > T0 + 12) & (arrived < T0 + 12 + asleep_s))
        arrived[asleep] = T0 + 12 + asleep_s + np.arange(asleep.size) // 20 * 3e-4
        clock = self.clock(rate, nominal)
        out = feed(clock, np.maximum.accumulate(arrived))
        assert lost(out) == 0
        assert np.diff(times(out)[int(10 * rate) :]).max() < 1.1 * NS / rate + 2e6

    @pytest.mark.parametrize("hole_s", [[0.2], [0.5], [2.0], [0.5, 0.3]])
    def test_holes_are_found(self, rate, arrive, nominal, hole_s):
        index = np.arange(int(30 * rate))
        kept = np.ones(index.size, bool)
        for i, length in enumerate(hole_s):
            at = int((12 + 1.5 * i) * rate)
            kept[at : at + round(length * rate)] = False
        clock = self.clock(rate, nominal)
        out = feed(clock, arrive(T0 + index / rate)[kept])
        assert lost(out) == pytest.approx((~kept).sum(), abs=2)
        assert kinds(clock) == []

    def test_rejected_frames_are_missing_and_nothing_else(self, rate, arrive, nominal):
        index = np.arange(int(28 * rate))
        bad = np.zeros(index.size, int)
        kept = np.ones(index.size, bool)
        for at in range(100, index.size, 97):
            kept[at : at + 2] = False
            bad[at + 2] = 2
        clock = self.clock(rate, nominal)
        assert lost(feed(clock, arrive(T0 + index / rate)[kept])) == 0  # nobody told, too short to be seen
        clock = self.clock(rate, nominal)
        arrived = T0 + index / rate  # one by one, so that each block may carry its loss
        assert lost(feed(clock, arrived[kept], lost=bad[kept])) == bad.sum()

    @pytest.mark.parametrize("at_s", [1.0, 12.0])
    def test_a_cable_out_for_five_seconds(self, rate, arrive, nominal, at_s):
        arrived = arrive(T0 + np.arange(int(30 * rate)) / rate)
        at, n = int(at_s * rate), int(5 * rate)
        clock = self.clock(rate, nominal)
        out = feed(clock, arrived[:at])
        clock.count_next_gap_by_arrival()
        out += feed(clock, arrived[at + n :])
        if nominal or at_s > 5.0:
            assert lost(out) == pytest.approx(n, abs=2)
        assert clock.configured_or_measured_rate_hz == pytest.approx(rate, rel=1e-3)


@pytest.mark.parametrize("rate", [20.0, 100.0, 400.0])
def test_a_fast_replay_by_arrival(rate):
    clock = SampleClock(ArrivalTimedFormat(), rate)
    out = feed(clock, burst(T0 + np.arange(int(200 * rate)) / rate / 50, 0.01))
    assert lost(out) == 0
    assert times(out)[-1] / NS == pytest.approx(T0 + 4.0, abs=0.1)


@pytest.mark.long
def test_a_crystal_that_drifts_is_followed_as_it_warms_up():
    index = np.arange(900 * 100)
    taken = T0 + np.cumsum((1.0 + 50e-6 * np.sin(2 * np.pi * index / index.size)) / 100.0)
    clock = SampleClock(ArrivalTimedFormat(), 100.0)
    out = feed(clock, burst(taken))
    assert lost(out) == 0
    off = times(out)[6000:] / NS - taken[6000:]
    assert np.ptp(off) < 5e-3  # the mean of the wait for the poll drifts by a quarter of it; the line lags 30 s


def test_unix_time_keeps_its_nanoseconds():
    """Frames of a log: a double of Unix time holds no more than 240 ns."""
    t_ns = 1_700_000_000_123_456_789 + np.arange(2000) * 1_000_000
    clock = SampleClock(ArrivalTimedFormat(), 1000.0)
    out = [one for t in t_ns for one in clock.assign_times(make_block(np.array([t]), np.zeros((1, 6))))]
    assert np.abs(times(out) - t_ns).max() <= 5


def test_the_first_samples_of_an_unknown_rate_are_in_order():
    clock = SampleClock(ArrivalTimedFormat(), None)
    out = clock.assign_times(make_block(np.full(50, 10**9), np.zeros((50, 6))))
    assert clock.configured_or_measured_rate_hz is None
    assert (np.diff(times(out)) > 0).all()


# --- given times


@pytest.mark.parametrize("rows", [1, 20, 4096])
@pytest.mark.parametrize("nominal", [True, False])
@pytest.mark.parametrize("scatter", ["exact", "ms", "normal", "uniform", "bursts"])
def test_given_times_are_kept_and_holes_told_where_they_can_be(rows, nominal, scatter):
    rng = np.random.default_rng(3)
    index = np.arange(3000)
    kept = ~((index > 1000) & (index <= 1050) | (index == 2000))
    exact = 1.7e9 + index / 100
    t = {
        "exact": exact,
        "ms": np.round(exact, 3),
        "normal": exact + 0.0015 * rng.standard_normal(index.size),
        "uniform": np.sort(exact + rng.uniform(-0.005, 0.005, index.size)),
        "bursts": np.sort(burst(exact, 0.043) + rng.uniform(0.0, 0.002, index.size)),
    }[scatter][kept]
    t_ns = np.rint(t * NS).astype(np.int64)
    clock = SampleClock(SenderTimedFormat(), 100.0 if nominal else None)
    out = []
    for at in range(0, len(t_ns), rows):
        out += clock.assign_times(make_block(t_ns[at : at + rows].copy(), varied(len(t_ns))[at : at + rows].copy()))
    assert np.array_equal(times(out), t_ns)
    if scatter in ("exact", "ms", "normal"):
        assert lost(out) in ((51,) if scatter != "normal" else (49, 50, 51, 52))
        assert clock.configured_or_measured_rate_hz == pytest.approx(100.0, rel=5e-3)
    else:  # late and early by whole periods: nothing is invented
        assert lost(out) <= 1
    shared = len(np.unique(t_ns)) < len(t_ns)  # Unix time as a double
    assert set(kinds(clock)) <= ({"samples_repeated"} if shared else set())


def test_given_times_that_jump_are_told_and_the_rate_survives():
    t = np.concatenate([np.arange(1000) / 100, 5.0 + np.arange(1000) / 100, 9000.0 + np.arange(1000) / 100])
    clock = SampleClock(SenderTimedFormat(), None)
    out = []
    for at in range(0, 3000, 100):
        out += clock.assign_times(make_block(np.rint(t[at : at + 100] * NS).astype(np.int64), np.zeros((100, 6))))
    texts = [event.text for event in clock.take_events()]
    assert [text.split(" by ")[0] for text in texts] == ["time went back", "time jumped ahead"]
    assert clock.configured_or_measured_rate_hz == 100.0
    assert lost(out) == round((9000.0 - 14.99) * 100) - 1


def test_times_that_stand_still_or_jitter_back_lose_nothing():
    t = np.arange(2000) / 100
    t[500:503] = t[500]
    t[700:1500:2] -= 0.012
    clock = SampleClock(SenderTimedFormat(), 100.0)
    out = clock.assign_times(make_block(np.rint(t * NS).astype(np.int64), varied(2000)))
    assert lost(out) <= 2
    assert sum(len(one) for one in out) == 2000
    assert sorted(kinds(clock)) == ["clock_jumped", "samples_repeated"]


def test_loss_told_by_the_sender_is_kept():
    clock = SampleClock(SenderTimedFormat(), 100.0)
    first = make_block(np.arange(100) * 10**7, np.zeros((100, 6)))
    second = make_block(np.arange(107, 207) * 10**7, np.zeros((100, 6)), lost=7)
    assert lost(clock.assign_times(first) + clock.assign_times(second)) == 7


def stamp_given(clock, t_s, values, rows):
    t_ns = np.rint(np.asarray(t_s) * NS).astype(np.int64)
    return [
        one
        for at in range(0, len(t_ns), rows)
        for one in clock.assign_times(make_block(t_ns[at : at + rows].copy(), values[at : at + rows].copy()))
    ]


@pytest.mark.parametrize("rows", [1, 7, 4096])
@pytest.mark.parametrize("again", [[880, 881, 900], list(range(400, 440))])
def test_rows_that_are_sent_twice_are_kept_out_once(rows, again):
    """One by one, or a whole batch again."""
    sent = np.insert(np.arange(1000), max(again) + 1, again)
    clock = SampleClock(SenderTimedFormat(), 100.0)
    out = stamp_given(clock, 50.0 + sent / 100, varied(1000)[sent], rows)
    assert np.array_equal(np.concatenate([one.values for one in out])[:, 0], np.arange(1000))
    assert clock.dropped_repeated_rows == len(again)
    assert lost(out) == 0
    texts = [event.text for event in clock.take_events(ended=True)]
    assert sum(int(text.split()[0]) for text in texts) == len(again)
    assert all(text.endswith("left out") for text in texts)


def test_a_recording_in_which_every_row_stands_twice():
    sent = np.repeat(np.arange(3000), 2)
    clock = SampleClock(SenderTimedFormat(), None)
    out = stamp_given(clock, sent / 100, varied(3000)[sent], 1000)
    assert np.array_equal(np.concatenate([one.values for one in out])[:, 0], np.arange(3000))
    assert clock.configured_or_measured_rate_hz == 100.0


@pytest.mark.parametrize("rows", [1, 50, 4096])
def test_times_too_coarse_to_tell_rows_apart_make_no_repeats(rows):
    """Five rows in each second, of few levels: equal rows at one time are no repeats."""
    values = np.repeat(np.random.default_rng(0).integers(0, 2, (3000, 1)).astype(float), 6, axis=1)
    values[:6, 0] = np.arange(6)
    clock = SampleClock(SenderTimedFormat(), 5.0)
    out = stamp_given(clock, np.arange(3000) // 5, values, rows)
    assert sum(len(one) for one in out) == 3000
    assert (clock.dropped_repeated_rows, lost(out), kinds(clock)) == (0, 0, [])


@pytest.mark.parametrize("late_by", [1, 3])
def test_rows_out_of_order_are_put_in_order_where_they_came_together(late_by):
    sent = np.arange(2000)
    for at in (300, 1000, 1500):
        sent = np.insert(np.delete(sent, at), at + late_by, at)
    clock = SampleClock(SenderTimedFormat(), 100.0)
    out = stamp_given(clock, 7.0 + sent[:200] / 100, varied(2000)[sent[:200]], 200)
    out += stamp_given(clock, 7.0 + sent[200:] / 100, varied(2000)[sent[200:]], 4096)
    assert np.array_equal(np.concatenate([one.values for one in out])[:, 0], np.arange(2000))
    assert lost(out) == 0
    assert "out of order: 3" in clock.take_events()[0].text


@pytest.mark.parametrize("late_by", [1, 3])
def test_rows_that_come_after_their_place_has_passed_are_left_out(late_by):
    sent = np.arange(2000)
    for at in (300, 1000, 1500):
        sent = np.insert(np.delete(sent, at), at + late_by, at)
    clock = SampleClock(SenderTimedFormat(), 100.0)
    out = stamp_given(clock, 7.0 + sent / 100, varied(2000)[sent], 1)
    kept = np.concatenate([one.values for one in out])[:, 0]
    assert np.array_equal(kept, np.delete(np.arange(2000), [300, 1000, 1500]))
    assert (clock.dropped_late_rows, lost(out)) == (3, 3)
    assert {event.kind for event in clock.take_events()} == {"clock_jumped"}


@pytest.mark.parametrize("rows", [1, 100])
def test_a_clock_that_is_set_back_a_little_leaves_no_sample_out(rows):
    t = np.arange(3000) / 100 + 20.0
    t[1500:] -= 0.503
    clock = SampleClock(SenderTimedFormat(), 100.0)
    assert sum(len(one) for one in stamp_given(clock, t, varied(3000), rows)) == 3000
    assert any(event.text == "time went back by 0.493 s" for event in clock.take_events())


def test_events_of_a_kind_are_at_most_one_a_second():
    sent = np.sort(np.concatenate([np.arange(6000), np.arange(100, 6000, 10)]))
    clock = SampleClock(SenderTimedFormat(), 100.0)
    stamp_given(clock, sent / 100, varied(6000)[sent], 1)
    told = clock.take_events(ended=True)
    assert 50 <= len(told) <= 61
    assert sum(int(event.text.split()[0]) for event in told) == clock.dropped_repeated_rows == 590


@pytest.mark.data
@pytest.mark.parametrize(
    "name", ["mpu6050-hosttime/static-11min", "phone/gyro-a", "px4-bench/bench-69s", "robot-arm/mpu9150"]
)
def test_recordings_of_real_sensors_hold_no_repeats(name):
    data = np.load(recordings() / f"{name}.npz")
    values = np.stack([data[axis] for axis in ("gx", "gy", "gz") * 2], axis=1).astype(np.float64)
    clock = SampleClock(SenderTimedFormat(), None)
    out = stamp_given(clock, data["t"], values, 500)
    assert sum(len(one) for one in out) == len(values)
    assert (clock.dropped_repeated_rows, clock.dropped_late_rows) == (0, 0)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "most"),
    [("mpu6050-hosttime/static-11min", 0), ("phone/gyro-a", 0), ("car-phone-can/minute", 0), ("can-car/drive-a", 120)],
)
def test_recordings_with_host_times_have_no_invented_holes(name, most):
    t = np.load(recordings() / f"{name}.npz")["t"]
    t_ns = np.rint(t * NS).astype(np.int64)
    for nominal in (None, (len(t) - 1) / (t[-1] - t[0])):
        clock = SampleClock(SenderTimedFormat(), nominal)
        out = []
        for at in range(0, len(t), 500):
            out += clock.assign_times(make_block(t_ns[at : at + 500].copy(), np.zeros((len(t_ns[at : at + 500]), 6))))
        assert lost(out) <= most  # the car's device itself leaves out a slot now and then


# --- parts


def test_the_line_of_exact_points_is_exact():
    line = ArrivalRegression()
    for i in range(100):
        line.add_point(7.0 * i, 3.0 + 0.07 * i)
    assert line.rate_hz() == pytest.approx(100.0, rel=1e-12)
    assert line.time_at_index_s(7000.0) == pytest.approx(73.0, rel=1e-12)


@pytest.mark.parametrize(
    ("measured", "made"), [(99.97, 100.0), (100.19, 100.0), (100.3, 100.3), (262.1, 262.0), (1e6, 1e6), (0.5, 0.5)]
)
def test_rates_that_sensors_are_made_with(measured, made):
    assert snap_to_standard_rate(measured) == made


# --- a configured rate beside the measured one


def stall(t, seed=0):
    """Arrival through a host that now and then does nothing for up to a second."""
    draw = np.random.default_rng(seed)
    arrived = t + draw.uniform(0.0, 0.005, t.size)
    at = t[0]
    while at < t[-1]:
        at += draw.exponential(5.0)
        until = at + draw.uniform(0.0, 1.0)
        arrived[(arrived > at) & (arrived < until)] = until
    return np.maximum.accumulate(arrived)


@pytest.mark.parametrize("tick_s", [1e-3, 1e-6])
def test_a_device_clock_contradicts_the_rate_however_its_samples_arrive(tick_s):
    ticks = np.rint(np.arange(600) / 100.0 / tick_s).astype(np.int64)
    for arrived in (T0 + np.arange(600) / 5000.0, jitter(T0 + np.arange(600) / 100.0)):
        wrong, right = (SampleClock(CounterTimedFormat(1 << 32, tick_s), rate) for rate in (200.0, 100.0))
        seen = []
        for i in range(0, 600, 5):
            for clock in (wrong, right):
                feed(clock, arrived[i : i + 5], ticks[i : i + 5])
            seen.append((wrong.rate_check_pending, wrong.contradicting_rate_hz is not None))
            assert right.contradicting_rate_hz is None
        # at no sample is the rate believed: not checked yet, then contradicted
        assert all(unchecked != contradicted for unchecked, contradicted in seen)
        assert wrong.contradicting_rate_hz == pytest.approx(100.0, rel=1e-3)
        assert (wrong.configured_or_measured_rate_hz, right.configured_or_measured_rate_hz) == (100.0, 100.0)
        assert not right.rate_check_pending


def test_a_tick_too_coarse_for_single_steps_contradicts_nothing():
    ticks = np.floor(np.arange(4160) / 416.0 / 1e-3).astype(np.int64)  # steps of 2 and 3
    clock = SampleClock(CounterTimedFormat(1 << 16, 1e-3), 416.0)
    feed(clock, jitter(T0 + np.arange(4160) / 416.0), ticks)
    assert not clock.rate_check_pending
    assert (clock.configured_or_measured_rate_hz, clock.contradicting_rate_hz) == (416.0, None)


@pytest.mark.parametrize("arrive", [jitter, burst, stall])
@pytest.mark.parametrize("seed", range(5))
def test_jitter_of_arrivals_contradicts_no_rate_that_is_nearly_right(arrive, seed):
    taken = T0 + np.arange(3000) / 100.0
    clock = SampleClock(ArrivalTimedFormat(), 100.2)
    arrived = arrive(taken) if arrive is burst else arrive(taken, seed=seed)
    for a in range(0, 3000, 10):
        feed(clock, arrived[a : a + 10])
        assert clock.contradicting_rate_hz is None
    assert not clock.rate_check_pending
    assert clock.configured_or_measured_rate_hz == 100.2


@pytest.mark.parametrize("arrive", [jitter, burst, stall])
def test_arrivals_contradict_a_rate_that_is_far_off(arrive):
    clock = SampleClock(ArrivalTimedFormat(), 200.0)
    feed(clock, arrive(T0 + np.arange(3000) / 100.0))
    assert clock.contradicting_rate_hz == pytest.approx(100.0, rel=0.02)


def test_how_fast_a_file_is_read_contradicts_nothing():
    clock = SampleClock(ArrivalTimedFormat(), 100.0, arrivals_are_timed=False)
    feed(clock, T0 + np.arange(6000) / 2000.0)
    assert not clock.rate_check_pending
    assert (clock.configured_or_measured_rate_hz, clock.contradicting_rate_hz) == (100.0, None)


def test_given_times_contradict_a_rate_also_where_there_are_few():
    times_ns = np.arange(150) * 10_000_000
    clock = SampleClock(SenderTimedFormat(), 200.0)
    clock.assign_times(make_block(times_ns, varied(150)))
    assert clock.rate_check_pending
    assert clock.contradicting_rate_hz is None
    clock.compare_rates_at_end()
    assert not clock.rate_check_pending
    assert clock.contradicting_rate_hz == pytest.approx(100.0)


def test_times_that_never_show_a_rate_leave_the_configured_one():
    clock = SampleClock(SenderTimedFormat(), 100.0)
    for i in range(17):
        assert clock.rate_check_pending == (i > 0)
        clock.assign_times(make_block(np.zeros(4000, np.int64), varied(4000) + i))
    assert not clock.rate_check_pending
    assert (clock.configured_or_measured_rate_hz, clock.contradicting_rate_hz) == (100.0, None)


def test_a_jump_of_given_times_does_not_begin_the_check_anew():
    clock = SampleClock(SenderTimedFormat(), 200.0)
    times_ns = np.arange(600) * 10_000_000
    for a in range(0, 600, 20):
        clock.assign_times(make_block(times_ns[a : a + 20].copy(), varied(20) + a))
    assert clock.contradicting_rate_hz == pytest.approx(100.0)
    clock.assign_times(make_block(times_ns[:20] - 10**12, varied(20)))
    assert not clock.rate_check_pending
    assert clock.contradicting_rate_hz == pytest.approx(100.0)


def test_after_a_restart_the_rate_is_checked_before_it_is_believed():
    clock = SampleClock(ArrivalTimedFormat(), 200.0)
    assert not clock.rate_check_pending
    clock.resume_after_restart(LastSample(round(T0 * NS), NO_TICK, 200.0, None))
    assert clock.rate_check_pending


@pytest.mark.parametrize("longest_stall_s", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_wrong_period_after_garbage_makes_no_losses_without_end(seed, longest_stall_s):
    """Rejected lines count as samples, more than the device can have sent; then good ones come in fits and starts."""
    rng = np.random.default_rng(seed)
    clock = SampleClock(ArrivalTimedFormat(), 100.0)
    told = 0

    def feed_at(arrived_s, n, rejected=0):
        t_ns = np.full(n, round((T0 + arrived_s) * NS), np.int64)
        return lost(clock.assign_times(make_block(t_ns, varied(n), lost=rejected)))

    def stream(begun_s, ended_s):
        arrived_s, sent, missing = begun_s, 0, 0
        while arrived_s < ended_s:
            arrived_s += rng.uniform(0.1, 1.0) * longest_stall_s
            due = int((arrived_s - begun_s) * 100.0)
            missing += feed_at(arrived_s, due - sent) if due > sent else 0
            sent = due
        return missing

    told += feed_at(0.0, 50)
    told += stream(0.3, 2.8)
    told += feed_at(3.8, 50, rejected=446)
    assert told == 446
    settling = stream(3.8, 20.0)
    assert settling < 1.5 * 100.0 * longest_stall_s  # the delays of the first seconds
    assert stream(20.0, 120.0) < 3 * 100.0 * longest_stall_s
    assert clock.measured_hz == pytest.approx(100.0, rel=0.01)
