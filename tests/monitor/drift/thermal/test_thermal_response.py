"""Tests of the regressors for delayed responses to temperature against recursions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from monitor.drift.thermal.thermal_response import (
    ThermalModelForm,
    apply_first_order_lag,
    build_regressors,
    compute_lag_roots,
    difference_equation_coefficients,
)

TEMPERATURE_SERIES = np.random.default_rng(3).standard_normal(200).cumsum()


def test_first_order_lag_equals_scipys_filter():
    p = 0.8
    want, _ = lfilter([1.0 - p], [1.0, -p], TEMPERATURE_SERIES, zi=[p * TEMPERATURE_SERIES[0]])
    np.testing.assert_allclose(apply_first_order_lag(TEMPERATURE_SERIES, p), want, rtol=1e-12)


@given(
    powers=st.integers(0, 1),
    constants=st.lists(st.floats(0.3, 30.0), min_size=1, max_size=3, unique=True),
    seed=st.integers(0, 1000),
)
def test_difference_equation_reproduces_the_sum_of_lags(powers, constants, seed):
    """Running Y_n + a_1 Y_{n−1} + … = b_0 x_n + … + c forward gives the same values as the lags."""
    shape = ThermalModelForm(powers, tuple(constants))
    sizes = np.random.default_rng(seed).standard_normal(1 + powers + len(constants))
    y = build_regressors(shape, TEMPERATURE_SERIES, 1.0) @ sizes
    a, b, c = difference_equation_coefficients(shape, sizes, 1.0)
    assert (a.size, b.size) == (len(constants), len(constants) + powers)
    assert np.all(np.abs(np.roots(np.concatenate([[1.0], a]))) < 1.0)
    k = len(constants)
    for n in range(k, 60):
        predicted = c + b @ TEMPERATURE_SERIES[n - np.arange(b.size)] - a @ y[n - 1 - np.arange(k)]
        assert predicted == pytest.approx(y[n], rel=1e-7, abs=1e-7)


def test_initial_states_decay_with_the_lag_roots():
    shape = ThermalModelForm(0, (2.0, 9.0))
    columns = build_regressors(shape, TEMPERATURE_SERIES, 1.0, with_initial_state=True)
    assert columns.shape == (200, 5)
    np.testing.assert_allclose(columns[1, -2:], compute_lag_roots(shape, 1.0))
