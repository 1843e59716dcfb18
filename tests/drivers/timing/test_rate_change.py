"""Tests of a sample rate that changes while the samples arrive, for each source of the sample times."""

import numpy as np
import pytest

from drivers.data_types import NS_PER_S, ArrivalTimedFormat, CounterTimedFormat, SenderTimedFormat, Timing, make_block
from drivers.timing.sample_clock import SampleClock

START_S = 1e5
CHANGE_S = 30.0
SENSORS = {
    "no counter": ArrivalTimedFormat(),
    "device clock": CounterTimedFormat(1 << 62, 1e-9),
    "16-bit counter": CounterTimedFormat(1 << 16),
    "sender times": SenderTimedFormat(),
}


def run(timing: Timing, configured: bool, new_hz: float) -> tuple[SampleClock, list, set, int]:
    """Return the clock, the events with their delays in s, the rates in use after 10 s, and the lost samples."""
    rng = np.random.default_rng(3)
    taken_s = np.concatenate([np.arange(0.0, CHANGE_S, 0.01), CHANGE_S + np.arange(round(20.0 * new_hz)) / new_hz])
    arrived_s = np.maximum.accumulate(np.ceil((taken_s + rng.uniform(0.0, 0.005, taken_s.size)) / 0.02) * 0.02)
    clock = SampleClock(timing, 100.0 if configured else None)
    events, rates, lost = [], set(), 0
    for index in np.split(np.arange(taken_s.size), np.flatnonzero(np.diff(arrived_s)) + 1):
        ticks = None
        if isinstance(timing, CounterTimedFormat):
            ticks = np.rint(taken_s[index] * 1e9).astype(np.int64) if timing.tick_s else index % timing.modulus
        t_s = taken_s[index] if isinstance(timing, SenderTimedFormat) else arrived_s[index]
        t_ns = np.rint((START_S + t_s) * NS_PER_S).astype(np.int64)
        blocks = clock.assign_times(make_block(t_ns, np.repeat(index[:, None] * 1e-3, 6, axis=1), None, ticks))
        lost += sum(block.lost for block in blocks) - clock.take_false_losses()
        now_s = float(arrived_s[index[-1]])
        events += [(event.kind, now_s - CHANGE_S) for event in clock.take_events()]
        if now_s > 10.0:
            rates.add((clock.configured_or_measured_rate_hz, clock.contradicting_rate_hz is not None))
    return clock, events, rates, lost


@pytest.mark.parametrize("new_hz", [10.0, 50.0, 200.0])
@pytest.mark.parametrize("configured", [True, False])
@pytest.mark.parametrize("timing", SENSORS.values(), ids=SENSORS)
def test_changed_rate_is_reported_once_within_seconds(timing: Timing, configured: bool, new_hz: float) -> None:
    _, events, rates, lost = run(timing, configured, new_hz)
    assert [kind for kind, _ in events] == ["rate_changed"]
    assert 0.0 < events[0][1] < 6.5
    assert rates == {(100.0, False), (new_hz, configured)}  # no rate in between
    assert lost == 0


@pytest.mark.parametrize("new_hz", [91.0, 97.0, 103.0])
@pytest.mark.parametrize("timing", [ArrivalTimedFormat(), SenderTimedFormat(), CounterTimedFormat(1 << 62, 1e-9)])
def test_change_by_more_than_the_tolerance_of_an_oscillator_is_reported_once(timing: Timing, new_hz: float) -> None:
    _, events, rates, lost = run(timing, True, new_hz)
    assert [kind for kind, _ in events] == ["rate_changed"]
    assert 0.0 < events[0][1] < 18.5
    assert {contradicted for _, contradicted in rates} == {False, True}
    assert [rate for rate, contradicted in rates if not contradicted] == [100.0]
    assert [rate for rate, contradicted in rates if contradicted] == pytest.approx([new_hz], rel=3e-3)
    assert lost == 0


@pytest.mark.parametrize("configured", [True, False])
@pytest.mark.parametrize("timing", SENSORS.values(), ids=SENSORS)
def test_rate_within_the_tolerance_of_an_oscillator_has_not_changed(timing: Timing, configured: bool) -> None:
    clock, events, _, lost = run(timing, configured, 98.5)
    assert events == []
    assert lost == 0
    assert clock.contradicting_rate_hz is None


def feed_without_counter(taken_s: np.ndarray, arrived_s: np.ndarray, timing: Timing) -> list[str]:
    """Return the kinds of the events of samples without a counter."""
    clock = SampleClock(timing, None)
    for part in np.split(np.arange(taken_s.size), np.flatnonzero(np.diff(arrived_s)) + 1):
        t_s = taken_s[part] if isinstance(timing, SenderTimedFormat) else arrived_s[part]
        values = np.repeat(part[:, None] * 1e-3, 6, axis=1)
        clock.assign_times(make_block(np.rint((START_S + t_s) * NS_PER_S).astype(np.int64), values))
    return [event.kind for event in clock.take_events()]


def test_losses_that_begin_and_end_are_no_change_of_the_rate() -> None:
    """During every second minute of twenty minutes, 5 % of the samples are lost without being counted."""
    rng = np.random.default_rng(1)
    taken_s = np.arange(120_000) / 100.0
    taken_s = taken_s[(rng.random(taken_s.size) > 0.05) | (taken_s % 120.0 < 60.0)]
    arrived_s = np.ceil((taken_s + rng.uniform(0.0, 0.005, taken_s.size)) / 0.1) * 0.1
    assert feed_without_counter(taken_s, arrived_s, ArrivalTimedFormat()) == []


def test_slowly_varying_delays_are_no_change_of_the_rate() -> None:
    """The delays vary by up to 100 ms within 6 s, which is a slope of up to 5 %."""
    taken_s = np.arange(20_000) / 100.0
    delay_s = 0.05 * (1.0 - np.cos(2.0 * np.pi * taken_s / 6.0)) * (taken_s > 20.0)
    arrived_s = np.maximum.accumulate(np.ceil((taken_s + delay_s) / 0.05) * 0.05)
    assert feed_without_counter(taken_s, arrived_s, ArrivalTimedFormat()) == []


def test_sender_times_in_bursts_are_no_change_of_the_rate() -> None:
    """A sender stamps the samples when it reads them, 20 samples every 200 ms, 2 ms apart."""
    index = np.arange(20_000)
    begun_s = index // 20 * 0.2
    assert feed_without_counter(begun_s + index % 20 * 0.002, begun_s, SenderTimedFormat()) == []


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_losses_jitter_and_stalls_are_no_change_of_the_rate(seed: int) -> None:
    """Two hours of samples of which 5 % are lost, read every 200 ms, with 36 stalls of up to 1 s per hour."""
    rng = np.random.default_rng(seed)
    taken_s = np.arange(720_000) / 100.0
    taken_s = taken_s[rng.random(taken_s.size) > 0.05]
    arrived_s = taken_s + rng.uniform(0.0, 0.01, taken_s.size)
    for begun_s in rng.uniform(0.0, taken_s[-1], 72):
        ended_s = begun_s + rng.uniform(0.0, 1.0)
        arrived_s[(arrived_s > begun_s) & (arrived_s < ended_s)] = ended_s
    arrived_s = np.maximum.accumulate(np.ceil(arrived_s / 0.2) * 0.2)
    clock = SampleClock(ArrivalTimedFormat(), None)
    for t_s in np.split(arrived_s, np.flatnonzero(np.diff(arrived_s)) + 1):
        clock.assign_times(make_block(np.rint((START_S + t_s) * NS_PER_S).astype(np.int64), np.zeros((t_s.size, 6))))
    assert clock.take_events() == []


@pytest.mark.long
@pytest.mark.parametrize(
    ("rate_hz", "share", "burst", "read_s"),
    [(100.0, 0.2, 3.0, 0.1), (100.0, 0.05, 5.0, 0.2), (25.0, 0.05, 5.0, 0.2)],
)
def test_uncounted_losses_in_bursts_are_no_change_of_the_rate(
    rate_hz: float, share: float, burst: float, read_s: float
) -> None:
    """An hour and a half of samples that are lost in bursts of geometrically distributed length."""
    rng = np.random.default_rng(7)
    n = round(5400 * rate_hz)
    kept = rng.geometric(share / burst / (1.0 - share), n)
    runs = np.column_stack([kept, rng.geometric(1.0 / burst, n)]).ravel().cumsum()
    taken_s = np.flatnonzero(np.searchsorted(runs, np.arange(n), side="right") % 2 == 0) / rate_hz
    arrived_s = np.ceil((taken_s + rng.exponential(0.002, taken_s.size)) / read_s) * read_s
    clock = SampleClock(ArrivalTimedFormat(), None)
    for t_s in np.split(arrived_s, np.flatnonzero(np.diff(arrived_s)) + 1):
        clock.assign_times(make_block(np.rint((START_S + t_s) * NS_PER_S).astype(np.int64), np.zeros((t_s.size, 6))))
    assert clock.take_events() == []
