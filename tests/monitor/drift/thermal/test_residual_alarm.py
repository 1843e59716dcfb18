"""Tests of the alarm that reports when several of the last residuals lie on the same side."""

import numpy as np
import pytest

from monitor.drift.thermal.residual_alarm import (
    MIN_OUTSIDE,
    WINDOW_INTERVALS,
    PredictionInterval,
    UnexplainedBiasChangeDetector,
)

MULTI, ONE = PredictionInterval(0.0, -3.0, 3.0), PredictionInterval(1.0, -1.0, 3.0)


def check_intervals(biases):
    detector = UnexplainedBiasChangeDetector()
    return [detector.check_interval(bias, MULTI, ONE) for bias in biases]


def test_enough_residuals_on_one_side_are_reported_once():
    found = check_intervals([0.0, 5.0, 0.0, 5.0, 7.0, 7.0, 7.0, 7.0, 7.0])
    assert [at for at, change in enumerate(found) if change] == [5]
    change = found[5]
    assert (change.outside, change.of, change.since) == (MIN_OUTSIDE, WINDOW_INTERVALS, 5)
    assert change.size == pytest.approx((5.0 + 0.0 + 5.0 + 7.0 + 7.0) / 5)  # relative to the multi-step prediction
    assert change.sigma == pytest.approx(
        1.959964 / 2.0 * (4 - 1 + 4 + 6 + 6) / 5**0.5
    )  # relative to the one-step prediction


def test_few_or_alternating_or_distant_residuals_are_not_reported():
    assert not any(check_intervals([5.0, -5.0] * 10))
    assert not any(check_intervals([5.0, 5.0, 5.0, 0.0, 0.0, 0.0] * 5))
    assert not any(check_intervals([3.0] * 20))  # a value at the limit counts as inside


def test_missing_interval_is_no_evidence_but_keeps_its_position():
    found = check_intervals([5.0, np.nan, 5.0, np.nan, np.nan, 5.0, 5.0])
    assert found[-1] is not None
    assert (found[-1].since, found[-1].of) == (7, 4)
    assert not any(found[:-1])


def test_residual_outside_now_or_twice_before_does_not_fit():
    detector = UnexplainedBiasChangeDetector()
    for bias, clear in [(5.0, False), (0.0, True), (-5.0, False), (0.0, True), (5.0, False), (0.0, False)]:
        detector.check_interval(bias, MULTI, ONE)
        assert detector.recent_intervals_fit_prediction is clear
    detector.forget_residuals()
    assert detector.recent_intervals_fit_prediction


def test_far_residual_is_detected():
    detector = UnexplainedBiasChangeDetector()
    assert not detector.last_interval_is_far_outside
    for bias, far in [(4.9, False), (5.1, True), (-3.1, True), (1.0, False)]:
        detector.check_interval(bias, MULTI, ONE)  # the prediction is 1 ± 2
        assert detector.last_interval_is_far_outside is far
