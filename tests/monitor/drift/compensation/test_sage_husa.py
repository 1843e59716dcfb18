"""Tests of the adaptive drift filter: textbook filter, outliers, steps and positive covariances."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from monitor.drift.compensation import sage_husa
from monitor.drift.compensation.arma import ArmaModel

MODEL = ArmaModel((1.5, -0.53), -0.7, 0.2, mean=3.0, white_variance=1.0, count=900)


def make_filter_without_model(adapts: bool) -> np.void:
    rows = np.zeros(1, sage_husa.DRIFT_FILTER)
    rows["adaptive"] = adapts
    return rows[0]


def make_filter_with_model(adapts: bool, model: ArmaModel = MODEL) -> np.void:
    row = make_filter_without_model(adapts)
    sage_husa.restart_with_model(row, model)
    return row


def test_without_adaptation_the_filter_is_a_kalman_filter():
    row = make_filter_with_model(False)
    phi1, phi2 = MODEL.phi
    a = np.array([[0.0, 1.0, 0.0], [phi2, phi1, 0.0], [0.0, 0.0, 1.0]])
    b, h = np.array([1.0, phi1 + MODEL.theta, 0.0]), np.array([1.0, 0.0, 1.0])
    x, p = row["state"].copy(), row["covariance"].copy()
    for z in 3.0 + np.random.default_rng(0).standard_normal(50):
        s = h @ p @ h + MODEL.white_variance
        gain = p @ h / s
        x, p = x + gain * (z - h @ x), p - np.outer(gain, h @ p)
        x, p = a @ x, a @ p @ a.T + MODEL.variance * np.outer(b, b) + np.diag([0.0, 0.0, row["level_variance"]])
        total, outcome = sage_husa.update_with_interval(row, z, np.nan, 1e-12)
        sage_husa.predict_next_interval(row)
        assert outcome == sage_husa.USED
        assert total == pytest.approx(s)
    np.testing.assert_allclose(row["state"], x, rtol=1e-9)
    np.testing.assert_allclose(row["covariance"], p, rtol=1e-9, atol=1e-15)


def test_only_the_adaptive_filter_notices_increased_noise():
    rng = np.random.default_rng(1)
    adaptive, fixed = make_filter_with_model(True), make_filter_with_model(False)
    for _ in range(3000):
        z = 3.0 + 2.0 * rng.standard_normal()
        for row in (adaptive, fixed):
            sage_husa.update_with_interval(row, z, 4.0 * rng.chisquare(3) / 3.0, 1e-12)
            sage_husa.predict_next_interval(row)
    assert adaptive["white_variance"] == pytest.approx(4.0, rel=0.25)
    assert fixed["white_variance"] == 1.0


def test_outlier_is_rejected_and_a_lasting_step_is_accepted():
    row = make_filter_with_model(True)
    row["rest_count"] = 40.0
    for k in range(60):
        outcome = sage_husa.update_with_interval(row, 3.0 + (100.0 if k == 5 else 0.0), 1.0, 1e-12)[1]
        sage_husa.predict_next_interval(row)
        assert outcome == (sage_husa.REJECTED if 5 <= k <= 11 else sage_husa.USED), k
    outcomes = []
    for _ in range(120):
        outcomes.append(sage_husa.update_with_interval(row, 103.0, 1.0, 1e-12)[1])
        sage_husa.predict_next_interval(row)
    assert outcomes.index(sage_husa.STEPPED) == 92  # the previous level was confirmed for 40 + 60 − 7 intervals
    assert outcomes[93:] == [sage_husa.USED] * 27
    assert sage_husa.expected_bias_and_variance(row)[0] == pytest.approx(103.0, abs=1.0)


def test_diverging_values_are_not_accepted_as_a_step():
    row = make_filter_with_model(True)
    for k in range(400):
        _, outcome = sage_husa.update_with_interval(row, 3.0 + 100.0 + 20.0 * k, 1.0, 1e-12)
        sage_husa.predict_next_interval(row)
        assert outcome == sage_husa.REJECTED


def test_first_level_must_be_confirmed():
    row = make_filter_without_model(True)
    for k in range(sage_husa.MIN_CONFIRMED_INTERVALS - 1):
        sage_husa.update_with_interval(row, 50.0, 1.0, 1e-12)
        assert row["rest_count"] == k + 1
    sage_husa.discard_unconfirmed_level_in_motion(row)
    assert row["rest_count"] == 0.0
    for _ in range(sage_husa.MIN_CONFIRMED_INTERVALS):
        sage_husa.update_with_interval(row, 2.0, 1.0, 1e-12)
    assert sage_husa.expected_bias_and_variance(row)[0] == pytest.approx(2.0)


@given(
    st.lists(
        st.tuples(st.sampled_from(["used", "missing", "outlier", "same"]), st.floats(-3, 3), st.floats(0.0, 100.0)),
        max_size=200,
    ),
    st.sampled_from(
        [
            MODEL,
            ArmaModel((0.99999, 0.0), 0.0, 1e-9, white_variance=1e-12, count=30),
            ArmaModel((0.0, 0.0), 0.0, 0.0, white_variance=1.0, count=60),
        ]
    ),
)
def test_covariances_stay_positive_for_any_input(inputs, model):
    row = make_filter_with_model(True, model)
    for kind, z, scatter in inputs:
        if kind != "missing":
            value = {"used": z, "outlier": 1e6 * z, "same": model.mean}[kind]
            total, _ = sage_husa.update_with_interval(row, value, scatter, 1e-30)
            assert total > 0.0
        sage_husa.predict_next_interval(row)
        p = row["covariance"]
        assert all(np.isfinite(row[name]).all() for name in row.dtype.names)
        np.testing.assert_allclose(p, p.T, atol=1e-9 * np.trace(p))
        assert np.linalg.eigvalsh(p)[0] >= -1e-9 * np.trace(p)
        assert row["white_variance"] > 0.0
        assert row["variance"] >= sage_husa.MIN_VARIANCE_SHARE * model.variance
