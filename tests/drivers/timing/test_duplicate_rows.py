"""Unit tests of duplicate detection, row order and event rate limiting.

``test_sample_clock`` tests them as parts of the sample clock.
"""

import numpy as np
import pytest

from drivers.timing.duplicate_rows import MIN_NEW_KEYS, DuplicateDetector
from drivers.timing.event_rate_limiter import MIN_EVENT_INTERVAL_S, EventRateLimiter
from drivers.timing.sender_time_gaps import find_evenly_spaced_order

MS = 10**6


def feed_keys(detector, keys, first=0.0):
    """Pass rows with these keys and distinct values to the detector."""
    values = np.tile(first + np.arange(len(keys), dtype=float)[:, None], 6)
    return detector.find_repeats_and_count_shared_keys(np.array(keys, np.int64), values)


def test_no_row_is_a_repeat_before_enough_new_keys():
    detector = DuplicateDetector(ordered=True)
    assert detector.find_repeats_and_count_shared_keys(np.zeros(5, np.int64), np.zeros((5, 6))) == (None, 0)
    assert feed_keys(detector, range(1, MIN_NEW_KEYS + 1)) == (None, 0)
    mask, shared = detector.find_repeats_and_count_shared_keys(np.array([99, 99]), np.ones((2, 6)))
    assert (mask.tolist(), shared) == ([False, True], 0)


def test_missing_axes_are_equal():
    detector = DuplicateDetector(ordered=True)
    feed_keys(detector, range(100))
    values = np.full((2, 6), np.nan)
    values[:, 0] = 1.0
    assert detector.find_repeats_and_count_shared_keys(np.array([100, 100]), values)[0].tolist() == [False, True]


def test_row_is_compared_only_with_the_previous_row_if_the_counter_wraps():
    detector = DuplicateDetector(ordered=False)
    for _ in range(3):
        assert detector.find_repeats_and_count_shared_keys(np.arange(50), np.zeros((50, 6)))[0] is None
    assert detector.find_repeats_and_count_shared_keys(np.array([50, 50, 7]), np.zeros((3, 6)))[0].tolist() == [
        False,
        True,
        False,
    ]


def test_detector_continues_after_the_clock_was_set_back():
    detector = DuplicateDetector(ordered=True)
    feed_keys(detector, np.arange(100) * MS + 10**13)
    feed_keys(detector, np.arange(100) * MS)
    assert detector._last == 99 * MS


@pytest.mark.parametrize(
    ("t", "order"),
    [
        ([0, 10, 20, 30], None),
        ([0, 20, 10, 30], [0, 2, 1, 3]),
        ([0, 10, 40, 50, 20, 30, 60], [0, 1, 4, 5, 2, 3, 6]),
        ([0, 10, 30, 20, 50, 60], [0, 1, 3, 2, 4, 5]),  # one row is missing
        ([0, 10, 8, 20, 18], None),  # jitter
        ([0, 10, 20, 10, 20, 30], None),  # the clock is set back
    ],
)
def test_only_evenly_spaced_rows_are_sorted(t, order):
    result = find_evenly_spaced_order(np.array(t) * MS, 0.01)
    assert (result if result is None else result.tolist()) == order


def test_events_are_limited_to_one_per_interval_and_all_rows_are_counted():
    limiter = EventRateLimiter()
    for i in range(100):
        limiter.report_event("a", i * 100 * MS, "{n} rows", 2)
    limiter.report_event("b", 9900 * MS, "once")
    events = limiter.take_events()
    assert [event.text for event in events if event.kind == "b"] == ["once"]
    events_a = [event for event in events if event.kind == "a"]
    assert len(events_a) == 10
    assert np.diff([event.t_ns for event in events_a]).min() >= MIN_EVENT_INTERVAL_S * 1e9
    last = limiter.take_events(ended=True)
    assert sum(int(event.text.split()[0]) for event in events_a + last) == 200
    assert limiter.take_events(ended=True) == []


def test_event_that_follows_delayed_events_contains_their_number():
    limiter = EventRateLimiter()
    for text in ("first", "second", "third", "fourth"):
        limiter.report_event("a", 5 * MS, text)
    assert [event.text for event in limiter.take_events()] == ["first"]
    limiter.release_held_events(2000 * MS)
    assert [event.text for event in limiter.take_events()] == [
        "second, and 2 more events of this kind within one second"
    ]
