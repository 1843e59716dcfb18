"""The wall clock: exact from the start, eased towards a host clock that is set."""

import numpy as np
import pytest

from monitor.daemon.slewed_clock import MAX_KNOTS, MAX_SLEW_RATE, SlewedClock

S = 1_000_000_000
START, UNIX = 5 * S, 1_763_700_000 * S


@pytest.fixture
def wall() -> SlewedClock:
    return SlewedClock(START, UNIX)


def test_carried_on_by_the_monotonic_clock_to_the_nanosecond(wall: SlewedClock) -> None:
    assert [wall.to_unix_ns(START + d) - UNIX for d in (-7, 0, 1, 86_400 * S)] == [-7, 0, 1, 86_400 * S]


def test_a_host_clock_that_agrees_changes_nothing(wall: SlewedClock) -> None:
    for i in range(1, 100):
        wall.slew_and_return_host_step(START + i * S, UNIX + i * S)
    assert wall.to_unix_ns(START) == UNIX


@pytest.mark.parametrize("step_ns", [3600 * S, -3600 * S])
def test_a_clock_that_is_set_is_followed_at_the_stated_pace_at_most(wall: SlewedClock, step_ns: int) -> None:
    wall.slew_and_return_host_step(START, UNIX + step_ns)
    before = UNIX
    for i in range(1, 11):
        wall.slew_and_return_host_step(START + i * S, UNIX + i * S + step_ns)
        now = wall.to_unix_ns(START + i * S) - i * S
        assert abs(now - before) == int(MAX_SLEW_RATE * S)
        assert (now - before) * step_ns > 0
        before = now


@pytest.mark.parametrize("step_ns", [2_000_000, -2_000_000])
def test_it_arrives_and_does_not_go_beyond(wall: SlewedClock, step_ns: int) -> None:
    for i in range(1, 21):
        wall.slew_and_return_host_step(START + i * S, UNIX + i * S + step_ns)
    assert wall.to_unix_ns(START + 20 * S) - UNIX - 20 * S == step_ns
    assert wall.to_unix_ns(START + 9000 * S) - UNIX - 9000 * S == step_ns


def test_times_of_samples_increase_however_late_they_are_asked_for_and_wherever_the_host_goes(
    wall: SlewedClock,
) -> None:
    rng = np.random.default_rng(0)
    samples = START + np.arange(0, 200 * S, S // 100)
    at_once = np.zeros(samples.size, np.int64)
    done = 0
    for i in range(1, 201):
        wall.slew_and_return_host_step(START + i * S, UNIX + i * S + int(rng.integers(-20, 20)) * 10_000_000)
        end = samples.size if i == 200 else int(rng.integers(done, max(done, 100 * i - 500) + 1))  # a reader that lags
        at_once[done:end] = (samples + wall.unix_offsets_ns(samples))[done:end]
        done = end
    steps = np.diff(at_once)
    assert steps.min() >= (1.0 - MAX_SLEW_RATE) * S / 100 - 1
    assert steps.max() <= (1.0 + MAX_SLEW_RATE) * S / 100 + 1
    recent = samples[-6000:]
    assert np.array_equal(recent + wall.unix_offsets_ns(recent), at_once[-6000:])  # the same whenever it is asked
    assert wall._knots.shape[0] <= MAX_KNOTS


def test_a_host_that_is_set_once_needs_one_correction(wall: SlewedClock) -> None:
    for i in range(1, 1000):
        wall.slew_and_return_host_step(START + i * S, UNIX + (i + 3600) * S)
    assert wall._knots.shape[0] == 2


def test_following_twice_at_one_moment_corrects_once(wall: SlewedClock) -> None:
    wall.slew_and_return_host_step(START + S, UNIX + 10 * S)
    once = wall.to_unix_ns(START + 3 * S)
    wall.slew_and_return_host_step(START + S, UNIX + 10 * S)
    wall.slew_and_return_host_step(START, UNIX + 9 * S)
    assert wall.to_unix_ns(START + 3 * S) == once


def test_says_by_how_much_the_host_was_set_and_how_far_it_is_off(wall: SlewedClock) -> None:
    assert wall.slew_and_return_host_step(START + S, UNIX + S) == 0
    assert wall.slew_and_return_host_step(START + 2 * S, UNIX - 3598 * S) == -3600 * S
    assert wall.slew_and_return_host_step(START + 3 * S, UNIX - 3597 * S) == 0
    assert wall.lag_behind_host_ns == -3600 * S + int(MAX_SLEW_RATE * S)
