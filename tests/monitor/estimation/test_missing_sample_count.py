"""Which holes are holes: what is missing shifts times for good; what comes late does not."""

import time

import numpy as np
import pytest

from monitor.estimation.missing_sample_count import count_missing_before_gaps

NONE = np.array([], np.int64)


def late_sender(n, lost, seed, jitter=0.03):
    """Times ns, rows of the holes that a clock would see, samples they claim, and samples lost before each.

    One in a hundred rows begins a burst of up to twenty that are late by as much as three periods; ``lost``: rows and
    how many are lost before them.
    """
    rng = np.random.default_rng(seed)
    gone = np.zeros(n, np.int64)
    gone[lost[0]] = lost[1]
    t = np.arange(n) + np.cumsum(gone) + jitter * rng.standard_normal(n)
    for row in np.flatnonzero(rng.random(n) < 0.01).tolist():
        t[row : row + rng.integers(1, 21)] += rng.uniform(0.8, 3.0)
    t = np.maximum.accumulate(t)
    claimed = np.rint(np.diff(t, prepend=t[0] - 1)).astype(np.int64) - 1
    rows = np.flatnonzero((claimed > 0) | (gone > 0))
    return np.rint(t * 1e7).astype(np.int64), rows, np.maximum(claimed[rows], gone[rows]), gone[rows]


@pytest.mark.parametrize("seed", range(5))
def test_known_losses_under_bursts_of_late_samples(seed):
    rng = np.random.default_rng(100 + seed)
    lost = np.sort(rng.choice(np.arange(200, 59_800), 60, replace=False)), rng.integers(1, 5, 60)
    t_ns, rows, claimed, gone = late_sender(60_000, lost, seed)
    assert claimed.sum() > 5 * gone.sum()
    missing = count_missing_before_gaps(t_ns, rows, claimed, NONE)
    assert missing.sum() == pytest.approx(gone.sum(), abs=4)  # of 150, where 1300 seem to be missing
    assert (missing == gone).mean() > 0.94
    assert np.abs(np.cumsum(missing - gone)).max() <= 8  # no sample is off by more anywhere


@pytest.mark.parametrize("seed", range(5))
def test_none_lost(seed):
    t_ns, rows, claimed, _ = late_sender(60_000, (NONE, NONE), seed)
    assert claimed.sum() > 500
    assert count_missing_before_gaps(t_ns, rows, claimed, NONE).sum() <= 0.01 * claimed.sum()


@pytest.mark.parametrize("share", [0.01, 0.05, 0.2])
def test_many_lost_and_none_late(share):
    rng = np.random.default_rng(7)
    gone = np.where(rng.random(50_000) < share, rng.integers(1, 4, 50_000), 0)
    gone[0] = 0
    t = np.arange(50_000) + np.cumsum(gone) + 0.03 * rng.standard_normal(50_000)
    rows = np.flatnonzero(gone)
    missing = count_missing_before_gaps(np.rint(t * 1e7).astype(np.int64), rows, gone[rows], NONE)
    assert (missing == gone[rows]).all()


@pytest.mark.parametrize("apart", [1, 3, 10, 25])
def test_holes_close_together(apart):
    """One is missing, and then a few come late; and the other way round, and two missing."""
    for shifts in ((1, 0), (0, 1), (1, 1), (0, 0)):
        t = np.arange(600, dtype=float)
        rows = np.array([300, 300 + apart])
        for row, missing in zip(rows.tolist(), shifts, strict=True):
            if missing:
                t[row:] += 1.0
            else:
                t[row : row + apart] += 1.0
        found = count_missing_before_gaps(np.rint(t * 1e7).astype(np.int64), rows, np.array([1, 1]), NONE)
        assert found.sum() == sum(shifts), shifts


@pytest.mark.parametrize("seconds", [0.5, 3.0, 9.0])
def test_a_sender_that_stops_and_catches_up_lost_nothing(seconds):
    rows = int(100 * seconds)
    t = np.arange(6000) / 100
    t[3000 : 3000 + rows] = 30.0 + seconds + np.linspace(0.0, 1e-3, rows)
    t_ns = np.rint(t * 1e9).astype(np.int64)
    assert count_missing_before_gaps(t_ns, np.array([3000]), np.array([rows]), NONE).tolist() == [0]
    t_ns = 10_000_000 * np.arange(6000)
    t_ns[3000:] += rows * 10_000_000
    assert count_missing_before_gaps(t_ns, np.array([3000]), np.array([rows]), NONE).tolist() == [rows]


def test_a_rate_that_wanders_is_no_loss():
    t = np.cumsum(0.01 * (1.0 + 0.005 * np.sin(np.arange(60_000) / 3000.0)))
    rows = np.arange(100, 59_900, 100)
    for row in rows.tolist():
        t[row : row + 10] += 0.009
    t_ns = np.rint(t * 1e9).astype(np.int64)
    assert count_missing_before_gaps(t_ns, rows, np.ones_like(rows), NONE).sum() == 0


def test_a_jump_of_the_times_says_nothing_of_a_hole():
    t_ns = 10_000_000 * np.arange(3000)
    t_ns[1500:] += 10_000_000
    t_ns[1520:] += 5 * 3600 * 10**9
    assert count_missing_before_gaps(t_ns, np.array([1500]), np.array([1]), np.array([1520])).tolist() == [1]


@pytest.mark.parametrize("row", [1, 2, 297, 298, 299])
def test_a_hole_at_either_end(row):
    t_ns = 10_000_000 * np.arange(300)
    t_ns[row:] += 20_000_000
    assert count_missing_before_gaps(t_ns, np.array([row]), np.array([2]), NONE).tolist() == [2]


def test_times_that_stand_still_leave_what_the_clock_said():
    assert count_missing_before_gaps(np.zeros(100, np.int64), np.array([50]), np.array([3]), NONE).tolist() == [3]


def test_a_hundred_thousand_holes_take_less_than_two_seconds():
    t_ns = 10_000_000 * np.arange(1_000_000)
    rows = np.arange(5, 1_000_000, 10)
    t_ns[rows] += 15_000_000
    claimed = np.ones(rows.size, np.int64)
    count_missing_before_gaps(t_ns[:100], rows[:5], claimed[:5], NONE)  # compiles
    begin = time.process_time()
    missing = count_missing_before_gaps(t_ns, rows, claimed, NONE)
    assert time.process_time() - begin < 2.0
    assert missing.sum() == 0
