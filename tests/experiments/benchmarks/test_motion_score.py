"""Tests of the score of a compensated rate in motion."""

import numpy as np
import pytest

from tests.experiments.benchmarks.motion_score import score_in_motion


def test_score_of_a_delayed_rate() -> None:
    t = np.arange(10_000) / 100.0
    truth = np.sin(2.0 * np.pi * 0.5 * t)
    late = np.sin(2.0 * np.pi * 0.5 * (t - 0.03)) + 0.01
    score = score_in_motion(late, truth, 100.0)
    assert score.delay_s == pytest.approx(0.03, rel=0.01)
    assert score.rms_error == pytest.approx(np.sqrt(np.mean((late - truth) ** 2)))
    assert score.angle_error_rad == pytest.approx(0.01 * 100.0 / np.sqrt(3.0), rel=0.05)
    assert np.isnan(score_in_motion(late, np.zeros_like(t), 100.0).delay_s)
