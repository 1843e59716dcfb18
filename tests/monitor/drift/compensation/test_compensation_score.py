"""Tests of the scores of a rate at rest against known noise and drift."""

import numpy as np
import pytest

from monitor.drift.compensation.compensation_score import score_at_rest


def test_white_noise_and_offset_are_scored():
    rng = np.random.default_rng(0)
    rate = 1e-3 * rng.standard_normal(600_000)
    score = score_at_rest(rate, 100.0)
    assert score.rms == pytest.approx(1e-3, rel=0.01)
    assert 1e-3 < score.worst_minute < 1.05e-3
    assert score.drift[0] == pytest.approx(1e-3 / np.sqrt(6000.0), rel=0.15)
    assert score.drift[1] == pytest.approx(1e-3 / np.sqrt(60_000.0), rel=0.5)
    np.testing.assert_allclose(score.allan[:8] * np.sqrt(score.tau_s[:8] * 100.0), 1e-3, rtol=0.05)
    moved = score_at_rest(rate + 5e-4, 100.0)
    assert moved.drift[2] == pytest.approx(5e-4, rel=0.01)


def test_missing_values_and_short_recordings_are_scored():
    rate = np.full(9000, 2.0)
    rate[3000:5999] = np.nan
    score = score_at_rest(rate, 100.0)
    assert score.rms == 2.0
    assert score.drift[0] == 2.0
    assert np.isnan(score.drift[2])
    rate[:] = np.nan
    assert np.isnan(score_at_rest(rate, 100.0).rms)
