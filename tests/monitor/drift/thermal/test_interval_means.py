"""Means of intervals, and what they are uncertain by."""

import numpy as np
import pytest

from monitor.drift.thermal.interval_means import compute_interval_means


def test_the_standard_error_is_that_of_white_noise():
    y = 9.81 + 1e-3 * np.random.default_rng(1).standard_normal(400_000)
    means = compute_interval_means(y, np.full(y.size, 25.0), 100.0, 10.0)
    assert means.bias.size == 400
    assert np.std(means.bias) == pytest.approx(1e-3 / 1000**0.5, rel=0.1)
    assert np.sqrt(np.mean(means.error**2)) == pytest.approx(1e-3 / 1000**0.5, rel=0.05)


def test_a_drift_across_the_interval_is_no_error():
    y = np.linspace(0.0, 1.0, 1000)
    means = compute_interval_means(y, y, 1.0, 1000.0)
    assert means.error[0] < 0.05


def test_intervals_with_too_little_are_missing_and_others_are_not():
    y = np.ones(100)
    y[:6], y[10:14] = np.nan, np.nan
    means = compute_interval_means(y, np.full(100, 20.0), 1.0, 10.0)
    assert np.isnan(means.bias[0])
    assert means.bias[1:].tolist() == [1.0] * 9
    assert means.both_known.tolist() == [False] + [True] * 9


def test_what_is_left_at_the_end_is_no_interval():
    assert compute_interval_means(np.ones(25), np.ones(25), 1.0, 10.0).bias.size == 2


def test_nothing_at_all():
    assert compute_interval_means(np.full(20, np.nan), np.ones(20), 1.0, 10.0).both_known.tolist() == [False, False]
