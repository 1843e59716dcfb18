"""Tests of the count of missing samples, which must not count late samples."""

import time

import numpy as np
import pytest

from monitor.estimation.missing_sample_count import count_missing_before_gaps

NO_JUMPS = np.array([], np.int64)


def simulate_late_sender(n, lost, seed, jitter=0.03):
    """Return times [ns], rows of apparent gaps, their apparent numbers of missing samples, and the true numbers.

    One in a hundred rows starts a burst of up to twenty samples that are late by up to three periods.
    ``lost`` has the rows of true gaps and the numbers of samples lost before them.
    """
    rng = np.random.default_rng(seed)
    lost_before = np.zeros(n, np.int64)
    lost_before[lost[0]] = lost[1]
    t = np.arange(n) + np.cumsum(lost_before) + jitter * rng.standard_normal(n)
    for row in np.flatnonzero(rng.random(n) < 0.01).tolist():
        t[row : row + rng.integers(1, 21)] += rng.uniform(0.8, 3.0)
    t = np.maximum.accumulate(t)
    claimed = np.rint(np.diff(t, prepend=t[0] - 1)).astype(np.int64) - 1
    rows = np.flatnonzero((claimed > 0) | (lost_before > 0))
    return np.rint(t * 1e7).astype(np.int64), rows, np.maximum(claimed[rows], lost_before[rows]), lost_before[rows]


@pytest.mark.parametrize("seed", range(5))
def test_losses_are_counted_in_spite_of_late_bursts(seed):
    rng = np.random.default_rng(100 + seed)
    lost = np.sort(rng.choice(np.arange(200, 59_800), 60, replace=False)), rng.integers(1, 5, 60)
    t_ns, rows, claimed, lost_before = simulate_late_sender(60_000, lost, seed)
    assert claimed.sum() > 5 * lost_before.sum()
    missing = count_missing_before_gaps(t_ns, rows, claimed, NO_JUMPS)
    assert missing.sum() == pytest.approx(lost_before.sum(), abs=4)  # 150 are missing, 1300 seem to be
    assert (missing == lost_before).mean() > 0.94
    assert np.abs(np.cumsum(missing - lost_before)).max() <= 8  # no position is wrong by more


@pytest.mark.parametrize("seed", range(5))
def test_late_samples_without_loss_are_not_counted(seed):
    t_ns, rows, claimed, _ = simulate_late_sender(60_000, (NO_JUMPS, NO_JUMPS), seed)
    assert claimed.sum() > 500
    assert count_missing_before_gaps(t_ns, rows, claimed, NO_JUMPS).sum() <= 0.01 * claimed.sum()


@pytest.mark.parametrize("share", [0.01, 0.05, 0.2])
def test_losses_without_late_samples_are_counted_exactly(share):
    rng = np.random.default_rng(7)
    lost_before = np.where(rng.random(50_000) < share, rng.integers(1, 4, 50_000), 0)
    lost_before[0] = 0
    t = np.arange(50_000) + np.cumsum(lost_before) + 0.03 * rng.standard_normal(50_000)
    rows = np.flatnonzero(lost_before)
    missing = count_missing_before_gaps(np.rint(t * 1e7).astype(np.int64), rows, lost_before[rows], NO_JUMPS)
    assert (missing == lost_before[rows]).all()


@pytest.mark.parametrize("distance", [1, 3, 10, 25])
def test_close_gaps_are_distinguished_from_late_samples(distance):
    """Each of two gaps is either a missing sample or a few late samples."""
    for shifts in ((1, 0), (0, 1), (1, 1), (0, 0)):
        t = np.arange(600, dtype=float)
        rows = np.array([300, 300 + distance])
        for row, missing in zip(rows.tolist(), shifts, strict=True):
            if missing:
                t[row:] += 1.0
            else:
                t[row : row + distance] += 1.0
        found = count_missing_before_gaps(np.rint(t * 1e7).astype(np.int64), rows, np.array([1, 1]), NO_JUMPS)
        assert found.sum() == sum(shifts), shifts


@pytest.mark.parametrize("seconds", [0.5, 3.0, 9.0])
def test_pause_of_the_sender_is_not_a_loss(seconds):
    rows = int(100 * seconds)
    t = np.arange(6000) / 100
    t[3000 : 3000 + rows] = 30.0 + seconds + np.linspace(0.0, 1e-3, rows)
    t_ns = np.rint(t * 1e9).astype(np.int64)
    assert count_missing_before_gaps(t_ns, np.array([3000]), np.array([rows]), NO_JUMPS).tolist() == [0]
    t_ns = 10_000_000 * np.arange(6000)
    t_ns[3000:] += rows * 10_000_000
    assert count_missing_before_gaps(t_ns, np.array([3000]), np.array([rows]), NO_JUMPS).tolist() == [rows]


def test_varying_rate_is_not_a_loss():
    t = np.cumsum(0.01 * (1.0 + 0.005 * np.sin(np.arange(60_000) / 3000.0)))
    rows = np.arange(100, 59_900, 100)
    for row in rows.tolist():
        t[row : row + 10] += 0.009
    t_ns = np.rint(t * 1e9).astype(np.int64)
    assert count_missing_before_gaps(t_ns, rows, np.ones_like(rows), NO_JUMPS).sum() == 0


def test_jump_of_the_times_does_not_affect_a_gap():
    t_ns = 10_000_000 * np.arange(3000)
    t_ns[1500:] += 10_000_000
    t_ns[1520:] += 5 * 3600 * 10**9
    assert count_missing_before_gaps(t_ns, np.array([1500]), np.array([1]), np.array([1520])).tolist() == [1]


@pytest.mark.parametrize("row", [1, 2, 297, 298, 299])
def test_gap_near_either_end_is_counted(row):
    t_ns = 10_000_000 * np.arange(300)
    t_ns[row:] += 20_000_000
    assert count_missing_before_gaps(t_ns, np.array([row]), np.array([2]), NO_JUMPS).tolist() == [2]


def test_constant_times_keep_the_apparent_count():
    assert count_missing_before_gaps(np.zeros(100, np.int64), np.array([50]), np.array([3]), NO_JUMPS).tolist() == [3]


def test_many_gaps_are_processed_quickly():
    t_ns = 10_000_000 * np.arange(1_000_000)
    rows = np.arange(5, 1_000_000, 10)
    t_ns[rows] += 15_000_000
    claimed = np.ones(rows.size, np.int64)
    count_missing_before_gaps(t_ns[:100], rows[:5], claimed[:5], NO_JUMPS)  # compile first
    begin = time.process_time()
    missing = count_missing_before_gaps(t_ns, rows, claimed, NO_JUMPS)
    assert time.process_time() - begin < 2.0
    assert missing.sum() == 0
