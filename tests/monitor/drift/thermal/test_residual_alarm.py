"""The rule: so many of the last intervals on one side, and what is said then."""

import numpy as np
import pytest

from monitor.drift.thermal.recursive_thermal_fit import PredictionInterval
from monitor.drift.thermal.residual_alarm import MIN_OUTSIDE, WINDOW_INTERVALS, UnexplainedBiasChangeDetector

MULTI, ONE = PredictionInterval(0.0, -3.0, 3.0), PredictionInterval(1.0, -1.0, 3.0)


def told(biases):
    suspicion = UnexplainedBiasChangeDetector()
    return [suspicion.check_interval(bias, MULTI, ONE) for bias in biases]


def test_enough_on_one_side_are_told_once():
    found = told([0.0, 5.0, 0.0, 5.0, 7.0, 7.0, 7.0, 7.0, 7.0])
    assert [at for at, one in enumerate(found) if one] == [5]
    one = found[5]
    assert (one.outside, one.of, one.since) == (MIN_OUTSIDE, WINDOW_INTERVALS, 5)
    assert one.size == pytest.approx((5.0 + 0.0 + 5.0 + 7.0 + 7.0) / 5)  # off the multi-step estimate
    assert one.sigma == pytest.approx(1.959964 / 2.0 * (4 - 1 + 4 + 6 + 6) / 5**0.5)  # off the one-step estimate


def test_fewer_on_both_sides_or_too_far_apart_are_not():
    assert not any(told([5.0, -5.0] * 10))
    assert not any(told([5.0, 5.0, 5.0, 0.0, 0.0, 0.0] * 5))
    assert not any(told([3.0] * 20))  # on the edge is inside


def test_what_was_not_measured_is_no_witness_and_keeps_its_place():
    found = told([5.0, np.nan, 5.0, np.nan, np.nan, 5.0, 5.0])
    assert found[-1] is not None
    assert (found[-1].since, found[-1].of) == (7, 4)
    assert not any(found[:-1])


def test_outside_now_or_twice_before_is_not_clear():
    suspicion = UnexplainedBiasChangeDetector()
    for bias, clear in [(5.0, False), (0.0, True), (-5.0, False), (0.0, True), (5.0, False), (0.0, False)]:
        suspicion.check_interval(bias, MULTI, ONE)
        assert suspicion.recent_intervals_fit_prediction is clear
    suspicion.forget_residuals()
    assert suspicion.recent_intervals_fit_prediction


def test_far_outside_is_no_chance():
    suspicion = UnexplainedBiasChangeDetector()
    assert not suspicion.last_interval_is_far_outside
    for bias, far in [(4.9, False), (5.1, True), (-3.1, True), (1.0, False)]:
        suspicion.check_interval(bias, MULTI, ONE)  # half a width of 2 about 1
        assert suspicion.last_interval_is_far_outside is far
