"""Tests of the slewed clock, which follows a change of the host clock at a limited rate."""

import numpy as np
import pytest

from monitor.daemon.slewed_clock import MAX_KNOTS, MAX_SLEW_RATE, SlewedClock

NS_PER_S = 1_000_000_000
START_NS, UNIX_NS = 5 * NS_PER_S, 1_763_700_000 * NS_PER_S


@pytest.fixture
def clock() -> SlewedClock:
    return SlewedClock(START_NS, UNIX_NS)


def test_clock_advances_with_the_monotonic_clock_exactly(clock: SlewedClock) -> None:
    assert [clock.to_unix_ns(START_NS + d) - UNIX_NS for d in (-7, 0, 1, 86_400 * NS_PER_S)] == [
        -7,
        0,
        1,
        86_400 * NS_PER_S,
    ]


def test_agreeing_host_clock_changes_nothing(clock: SlewedClock) -> None:
    for i in range(1, 100):
        clock.slew_and_return_host_step(START_NS + i * NS_PER_S, UNIX_NS + i * NS_PER_S)
    assert clock.to_unix_ns(START_NS) == UNIX_NS


@pytest.mark.parametrize("step_ns", [3600 * NS_PER_S, -3600 * NS_PER_S])
def test_host_clock_change_is_followed_at_the_maximum_slew_rate(clock: SlewedClock, step_ns: int) -> None:
    clock.slew_and_return_host_step(START_NS, UNIX_NS + step_ns)
    before = UNIX_NS
    for i in range(1, 11):
        clock.slew_and_return_host_step(START_NS + i * NS_PER_S, UNIX_NS + i * NS_PER_S + step_ns)
        now = clock.to_unix_ns(START_NS + i * NS_PER_S) - i * NS_PER_S
        assert abs(now - before) == int(MAX_SLEW_RATE * NS_PER_S)
        assert (now - before) * step_ns > 0
        before = now


@pytest.mark.parametrize("step_ns", [2_000_000, -2_000_000])
def test_correction_ends_without_overshoot(clock: SlewedClock, step_ns: int) -> None:
    for i in range(1, 21):
        clock.slew_and_return_host_step(START_NS + i * NS_PER_S, UNIX_NS + i * NS_PER_S + step_ns)
    assert clock.to_unix_ns(START_NS + 20 * NS_PER_S) - UNIX_NS - 20 * NS_PER_S == step_ns
    assert clock.to_unix_ns(START_NS + 9000 * NS_PER_S) - UNIX_NS - 9000 * NS_PER_S == step_ns


def test_sample_times_increase_for_late_requests_and_any_host_clock(
    clock: SlewedClock,
) -> None:
    rng = np.random.default_rng(0)
    samples = START_NS + np.arange(0, 200 * NS_PER_S, NS_PER_S // 100)
    at_once = np.zeros(samples.size, np.int64)
    done = 0
    for i in range(1, 201):
        clock.slew_and_return_host_step(
            START_NS + i * NS_PER_S, UNIX_NS + i * NS_PER_S + int(rng.integers(-20, 20)) * 10_000_000
        )
        end = (
            samples.size if i == 200 else int(rng.integers(done, max(done, 100 * i - 500) + 1))
        )  # the reader lags behind
        at_once[done:end] = (samples + clock.unix_offsets_ns(samples))[done:end]
        done = end
    steps = np.diff(at_once)
    assert steps.min() >= (1.0 - MAX_SLEW_RATE) * NS_PER_S / 100 - 1
    assert steps.max() <= (1.0 + MAX_SLEW_RATE) * NS_PER_S / 100 + 1
    recent = samples[-6000:]
    assert np.array_equal(
        recent + clock.unix_offsets_ns(recent), at_once[-6000:]
    )  # a later request gives the same times
    assert clock._knots.shape[0] <= MAX_KNOTS


def test_one_host_clock_change_needs_one_correction(clock: SlewedClock) -> None:
    for i in range(1, 1000):
        clock.slew_and_return_host_step(START_NS + i * NS_PER_S, UNIX_NS + (i + 3600) * NS_PER_S)
    assert clock._knots.shape[0] == 2


def test_repeated_update_at_the_same_time_corrects_once(clock: SlewedClock) -> None:
    clock.slew_and_return_host_step(START_NS + NS_PER_S, UNIX_NS + 10 * NS_PER_S)
    corrected = clock.to_unix_ns(START_NS + 3 * NS_PER_S)
    clock.slew_and_return_host_step(START_NS + NS_PER_S, UNIX_NS + 10 * NS_PER_S)
    clock.slew_and_return_host_step(START_NS, UNIX_NS + 9 * NS_PER_S)
    assert clock.to_unix_ns(START_NS + 3 * NS_PER_S) == corrected


def test_host_clock_step_and_remaining_lag_are_returned(clock: SlewedClock) -> None:
    assert clock.slew_and_return_host_step(START_NS + NS_PER_S, UNIX_NS + NS_PER_S) == 0
    assert clock.slew_and_return_host_step(START_NS + 2 * NS_PER_S, UNIX_NS - 3598 * NS_PER_S) == -3600 * NS_PER_S
    assert clock.slew_and_return_host_step(START_NS + 3 * NS_PER_S, UNIX_NS - 3597 * NS_PER_S) == 0
    assert clock.lag_behind_host_ns == -3600 * NS_PER_S + int(MAX_SLEW_RATE * NS_PER_S)
