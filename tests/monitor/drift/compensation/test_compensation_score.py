"""The judge: what is known of a rate beside what it says of it."""

import numpy as np
import pytest

from monitor.drift.compensation.compensation_score import score_at_rest


def test_at_rest_white_noise_and_a_drift():
    rng = np.random.default_rng(0)
    rate = 1e-3 * rng.standard_normal(600_000)
    one = score_at_rest(rate, 100.0)
    assert one.rms == pytest.approx(1e-3, rel=0.01)
    assert 1e-3 < one.worst_minute < 1.05e-3
    assert one.drift[0] == pytest.approx(1e-3 / np.sqrt(6000.0), rel=0.15)
    assert one.drift[1] == pytest.approx(1e-3 / np.sqrt(60_000.0), rel=0.5)
    np.testing.assert_allclose(one.allan[:8] * np.sqrt(one.tau_s[:8] * 100.0), 1e-3, rtol=0.05)
    moved = score_at_rest(rate + 5e-4, 100.0)
    assert moved.drift[2] == pytest.approx(5e-4, rel=0.01)


def test_holes_and_short_records():
    rate = np.full(9000, 2.0)
    rate[3000:5999] = np.nan
    one = score_at_rest(rate, 100.0)
    assert one.rms == 2.0
    assert one.drift[0] == 2.0
    assert np.isnan(one.drift[2])
    rate[:] = np.nan
    assert np.isnan(score_at_rest(rate, 100.0).rms)
