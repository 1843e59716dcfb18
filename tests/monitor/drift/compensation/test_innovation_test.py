"""Tests of the innovation test: false alarm rate and detection."""

import numpy as np
import pytest
from scipy.stats import chi2

from monitor.drift.compensation.innovation_test import FALSE_ALARM_PROBABILITY, INTERVALS, LIMIT, InnovationTest


def test_white_innovations_cause_no_alarm():
    """The test uses 150 000 intervals, which are 1.7 days of one axis."""
    test = InnovationTest()
    assert not any(test.detect_new_misfit(x) for x in np.random.default_rng(0).standard_normal(150_000).tolist())


def test_doubled_noise_is_reported_once_per_occurrence():
    test = InnovationTest()
    rng = np.random.default_rng(1)

    def count_alarms(scale: float, n: int) -> int:
        return sum(test.detect_new_misfit(x) for x in (scale * rng.standard_normal(n)).tolist())

    assert np.isnan(test.mean_square_innovation)
    assert count_alarms(1.0, 200) == 0
    assert count_alarms(2.0, 400) == 1
    assert test.mean_square_innovation > LIMIT
    assert count_alarms(1.0, 400) == 0
    assert count_alarms(2.0, 400) == 1
    test.forget_innovations()
    assert count_alarms(1.0, INTERVALS - 1) == 0


def test_limit_is_a_quantile_of_the_chi2_distribution():
    assert pytest.approx(chi2.isf(FALSE_ALARM_PROBABILITY, INTERVALS) / INTERVALS, rel=1e-12) == LIMIT
