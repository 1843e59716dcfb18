"""The wall clock: exact from the start, eased towards a host clock that is set."""

import itertools

import pytest

from monitor.daemon.slewed_clock import EASE, WallClock

S = 1_000_000_000
START, UNIX = 5 * S, 1_763_700_000 * S


@pytest.fixture
def wall() -> WallClock:
    return WallClock(START, UNIX)


def test_carried_on_by_the_monotonic_clock_to_the_nanosecond(wall: WallClock) -> None:
    assert [wall.unix_ns(START + d) - UNIX for d in (-7, 0, 1, 86_400 * S)] == [-7, 0, 1, 86_400 * S]


def test_a_host_clock_that_agrees_changes_nothing(wall: WallClock) -> None:
    for i in range(1, 100):
        wall.follow(START + i * S, UNIX + i * S)
    assert wall.unix_ns(START) == UNIX


@pytest.mark.parametrize("step_ns", [3600 * S, -3600 * S])
def test_a_clock_that_is_set_is_followed_at_the_stated_pace_at_most(wall: WallClock, step_ns: int) -> None:
    before = wall.unix_ns(START)
    for i in range(1, 11):
        wall.follow(START + i * S, UNIX + i * S + step_ns)
        now = wall.unix_ns(START)
        assert abs(now - before) == int(EASE * S)
        assert (now - before) * step_ns > 0
        before = now


@pytest.mark.parametrize("step_ns", [2_000_000, -2_000_000])
def test_it_arrives_and_does_not_go_beyond(wall: WallClock, step_ns: int) -> None:
    for i in range(1, 21):
        wall.follow(START + i * S, UNIX + i * S + step_ns)
    assert wall.unix_ns(START) - UNIX == step_ns


def test_time_never_runs_back_while_the_host_goes_back(wall: WallClock) -> None:
    times = []
    for i in range(1, 200):
        wall.follow(START + i * S // 10, UNIX + i * S // 10 - 3600 * S)
        times.append(wall.unix_ns(START + i * S // 10))
    assert all(later > earlier for earlier, later in itertools.pairwise(times))


def test_following_twice_at_one_moment_corrects_once(wall: WallClock) -> None:
    wall.follow(START + S, UNIX + 10 * S)
    once = wall.offset_ns
    wall.follow(START + S, UNIX + 10 * S)
    wall.follow(START, UNIX + 10 * S)
    assert wall.offset_ns == once


def test_says_by_how_much_the_host_was_set_and_how_far_it_is_off(wall: WallClock) -> None:
    assert wall.follow(START + S, UNIX + S) == 0
    assert wall.follow(START + 2 * S, UNIX - 3598 * S) == -3600 * S
    assert wall.follow(START + 3 * S, UNIX - 3597 * S) == 0
    assert wall.behind_ns == -3600 * S + 2 * int(EASE * S)
