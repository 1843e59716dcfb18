"""Tests of the live drift compensation of blocks: times, updates and events."""

import numpy as np
import pytest
from scipy.stats import chi2

from drivers.data_types import make_block
from monitor.drift.compensation.arma import ArmaModel
from monitor.drift.compensation.live_compensation import (
    EVENT_KIND,
    FALSE_ALARM_PROBABILITY,
    INTERVALS,
    LIMIT,
    InnovationTest,
    LiveDriftCompensation,
)

RATE_HZ = 100.0
SIGMA = 1e-3


def compensate_noise(
    live: LiveDriftCompensation, seconds: float, start_s: float = 0.0, scale: float = 1.0, lost: int = 0, seed: int = 0
):
    n = round(seconds * RATE_HZ)
    t_ns = np.round((start_s + np.arange(n) / RATE_HZ) * 1e9).astype(np.int64)
    values = 0.01 + scale * SIGMA * np.random.default_rng(seed).standard_normal((n, 6))
    return live.compensate_block(make_block(t_ns, values, np.full(n, 21.0), np.arange(n), lost))


def test_other_columns_and_lost_count_are_preserved():
    live = LiveDriftCompensation(RATE_HZ)
    first, second = compensate_noise(live, 30.0), compensate_noise(live, 10.0, 31.0, lost=100)
    assert (second.lost, len(second)) == (100, 1000)
    assert (first.temperature_c == 21.0).all()
    np.testing.assert_array_equal(first.ticks, np.arange(3000))
    updates = live.take_drift_updates()
    assert [update.t_ns for update in updates[:3]] == [990_000_000, 1_990_000_000, 2_990_000_000]
    assert updates[-1].t_ns == 39_990_000_000
    assert not live.take_drift_updates()
    np.testing.assert_allclose(updates[-1].expected, 0.01, atol=3e-4)


def test_growing_noise_is_reported_as_an_event():
    live = LiveDriftCompensation(RATE_HZ)
    compensate_noise(live, 100.0)
    for axis in range(3):
        live.apply_identification_result(
            axis, ArmaModel((0.0, 0.0), 0.0, 0.0, mean=0.01, white_variance=SIGMA**2 / 100.0, order=(0, 0), count=100)
        )
    compensate_noise(live, 100.0, 100.0)
    assert not live.take_events()
    compensate_noise(live, 300.0, 200.0, scale=1.9)
    events = live.take_events()
    assert {event.kind for event in events} == {EVENT_KIND}
    assert {event.axis for event in events} == {"gx", "gy", "gz"}
    event = events[0]
    assert 200.0 < event.t_ns / 1e9 < 350.0
    assert event.since_ns is not None
    assert "times as large as expected" in event.text
    assert event.values["innovation"]["mean_square"] == pytest.approx(event.sigma**2)


def test_only_a_clearly_different_rate_starts_a_new_compensator():
    live = LiveDriftCompensation(RATE_HZ)
    compensate_noise(live, 20.0)
    compensator = live.compensator
    live.set_rate(101.0)
    assert live.compensator is compensator
    live.set_rate(200.0)
    assert live.compensator is not compensator
    assert live.compensator.rate_hz == 200.0


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
