"""The test of innovations: how often chance passes it, and what does."""

import numpy as np
import pytest
from scipy.stats import chi2

from monitor.drift.compensation.innovation_test import FALSE_ALARM_PROBABILITY, INTERVALS, LIMIT, InnovationTest


def test_chance_passes_next_to_never():
    """150 000 looks, 1.7 days of an axis."""
    one = InnovationTest()
    assert not any(one.detect_new_misfit(x) for x in np.random.default_rng(0).standard_normal(150_000).tolist())


def test_twice_the_noise_is_told_once_and_again_when_it_comes_back():
    one = InnovationTest()
    rng = np.random.default_rng(1)

    def alarms(scale: float, n: int) -> int:
        return sum(one.detect_new_misfit(x) for x in (scale * rng.standard_normal(n)).tolist())

    assert np.isnan(one.mean_square_innovation)
    assert alarms(1.0, 200) == 0
    assert alarms(2.0, 400) == 1
    assert one.mean_square_innovation > LIMIT
    assert alarms(1.0, 400) == 0
    assert alarms(2.0, 400) == 1
    one.forget_innovations()
    assert alarms(1.0, INTERVALS - 1) == 0


def test_the_limit_is_a_quantile_of_chi2():
    assert pytest.approx(chi2.isf(FALSE_ALARM_PROBABILITY, INTERVALS) / INTERVALS, rel=1e-12) == LIMIT
