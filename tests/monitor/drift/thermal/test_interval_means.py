"""Tests of interval means and their standard errors."""

import numpy as np
import pytest

from monitor.drift.thermal.interval_means import compute_interval_means


def test_standard_error_is_that_of_white_noise():
    y = 9.81 + 1e-3 * np.random.default_rng(1).standard_normal(400_000)
    means = compute_interval_means(y, np.full(y.size, 25.0), 100.0, 10.0)
    assert means.bias.size == 400
    assert np.std(means.bias) == pytest.approx(1e-3 / 1000**0.5, rel=0.1)
    assert np.sqrt(np.mean(means.error**2)) == pytest.approx(1e-3 / 1000**0.5, rel=0.05)


def test_drift_within_an_interval_does_not_increase_its_error():
    y = np.linspace(0.0, 1.0, 1000)
    means = compute_interval_means(y, y, 1.0, 1000.0)
    assert means.error[0] < 0.05


def test_interval_with_too_few_samples_is_missing():
    y = np.ones(100)
    y[:6], y[10:14] = np.nan, np.nan
    means = compute_interval_means(y, np.full(100, 20.0), 1.0, 10.0)
    assert np.isnan(means.bias[0])
    assert means.bias[1:].tolist() == [1.0] * 9
    assert means.both_known.tolist() == [False] + [True] * 9


def test_incomplete_last_interval_is_omitted():
    assert compute_interval_means(np.ones(25), np.ones(25), 1.0, 10.0).bias.size == 2


def test_recording_without_values_has_no_known_interval():
    assert compute_interval_means(np.full(20, np.nan), np.ones(20), 1.0, 10.0).both_known.tolist() == [False, False]
