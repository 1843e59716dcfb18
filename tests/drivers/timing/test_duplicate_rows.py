"""Repeats, order and the pace of limiter, each by itself; with the clock around them in ``test_sample_clock``."""

import numpy as np
import pytest

from drivers.timing.duplicate_rows import MIN_NEW_KEYS, DuplicateDetector
from drivers.timing.event_rate_limiter import MIN_EVENT_INTERVAL_S, EventRateLimiter
from drivers.timing.sender_time_gaps import find_evenly_spaced_order

MS = 10**6


def found(repeats, keys, first=0.0):
    values = np.tile(first + np.arange(len(keys), dtype=float)[:, None], 6)
    return repeats.find_repeats_and_count_shared_keys(np.array(keys, np.int64), values)


def test_nothing_is_called_a_repeat_before_enough_is_seen():
    repeats = DuplicateDetector(ordered=True)
    assert repeats.find_repeats_and_count_shared_keys(np.zeros(5, np.int64), np.zeros((5, 6))) == (None, 0)
    assert found(repeats, range(1, MIN_NEW_KEYS + 1)) == (None, 0)
    mask, others = repeats.find_repeats_and_count_shared_keys(np.array([99, 99]), np.ones((2, 6)))
    assert (mask.tolist(), others) == ([False, True], 0)


def test_absent_axes_are_equal():
    repeats = DuplicateDetector(ordered=True)
    found(repeats, range(100))
    values = np.full((2, 6), np.nan)
    values[:, 0] = 1.0
    assert repeats.find_repeats_and_count_shared_keys(np.array([100, 100]), values)[0].tolist() == [False, True]


def test_a_counter_that_wraps_repeats_only_the_row_before():
    repeats = DuplicateDetector(ordered=False)
    for _ in range(3):
        assert repeats.find_repeats_and_count_shared_keys(np.arange(50), np.zeros((50, 6)))[0] is None
    assert repeats.find_repeats_and_count_shared_keys(np.array([50, 50, 7]), np.zeros((3, 6)))[0].tolist() == [
        False,
        True,
        False,
    ]


def test_a_clock_set_back_by_hours_does_not_slow_what_follows():
    repeats = DuplicateDetector(ordered=True)
    found(repeats, np.arange(100) * MS + 10**13)
    found(repeats, np.arange(100) * MS)
    assert repeats._last == 99 * MS


@pytest.mark.parametrize(
    ("t", "order"),
    [
        ([0, 10, 20, 30], None),
        ([0, 20, 10, 30], [0, 2, 1, 3]),
        ([0, 10, 40, 50, 20, 30, 60], [0, 1, 4, 5, 2, 3, 6]),
        ([0, 10, 30, 20, 50, 60], [0, 1, 3, 2, 4, 5]),  # and one is missing
        ([0, 10, 8, 20, 18], None),  # jitter
        ([0, 10, 20, 10, 20, 30], None),  # set back
    ],
)
def test_only_a_steady_sequence_is_put_in_order(t, order):
    result = find_evenly_spaced_order(np.array(t) * MS, 0.01)
    assert (result if result is None else result.tolist()) == order


def test_events_keep_their_distance_and_nothing_is_forgotten():
    limiter = EventRateLimiter()
    for i in range(100):
        limiter.report_event("a", i * 100 * MS, "{n} rows", 2)
    limiter.report_event("b", 9900 * MS, "once")
    told = limiter.take_events()
    assert [event.text for event in told if event.kind == "b"] == ["once"]
    of_a = [event for event in told if event.kind == "a"]
    assert len(of_a) == 10
    assert np.diff([event.t_ns for event in of_a]).min() >= MIN_EVENT_INTERVAL_S * 1e9
    last = limiter.take_events(ended=True)
    assert sum(int(event.text.split()[0]) for event in of_a + last) == 200
    assert limiter.take_events(ended=True) == []


def test_other_texts_of_a_kind_are_counted_while_they_are_held_back():
    limiter = EventRateLimiter()
    for text in ("first", "second", "third", "fourth"):
        limiter.report_event("a", 5 * MS, text)
    assert [event.text for event in limiter.take_events()] == ["first"]
    limiter.release_held_events(2000 * MS)
    assert [event.text for event in limiter.take_events()] == [
        "second, and 2 more events of this kind within one second"
    ]
