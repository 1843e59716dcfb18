"""Tests of the recursive thermal fit against least squares over the whole recording."""

from dataclasses import astuple, replace

import numpy as np
import pytest
from scipy.stats import t as student

from monitor.common.distributions import Z95
from monitor.drift.thermal.interval_means import IntervalMeans
from monitor.drift.thermal.recursive_thermal_fit import RecursiveThermalFit
from monitor.drift.thermal.thermal_fit import fit_thermal_model
from monitor.drift.thermal.thermal_model import ThermalModel, predict_interval_means
from monitor.drift.thermal.thermal_response import ThermalModelForm
from tests.monitor.drift.thermal_biases import select_first_intervals, simulate_hourly_means


def make_unfitted_model(means: IntervalMeans, shape: ThermalModelForm, phi: float) -> ThermalModel:
    """Return a model of this form whose coefficients are not fitted yet."""
    model = fit_thermal_model(means).model
    return replace(model, shape=shape, phi=phi, coefficients=np.zeros(0), initial_state=np.zeros(0))


@pytest.mark.parametrize(
    "shape",
    [ThermalModelForm(3, ()), ThermalModelForm(0, (7e3,)), ThermalModelForm(1, (3e3, 4e4))],
    ids=lambda shape: shape.name,
)
@pytest.mark.parametrize("phi", [0.0, 0.6])
def test_recursive_fit_equals_the_fit_of_all_intervals(shape, phi):
    means = simulate_hourly_means(2, 2, 0.05)
    bias = means.bias.copy()
    bias[[30, 31, 45]] = np.nan
    means = replace(means, bias=bias)
    model = make_unfitted_model(means, shape, phi)
    recursive, whole = RecursiveThermalFit(model, select_first_intervals(means, 20)), RecursiveThermalFit(model, means)
    for k in range(20, 72):
        recursive.add_interval(float(means.temperature_c[k]), float(means.bias[k]))
    for name in ("coefficients", "initial_state", "sigma", "lowest_c", "highest_c"):
        np.testing.assert_allclose(getattr(recursive.model, name), getattr(whole.model, name), rtol=1e-7, err_msg=name)
    np.testing.assert_allclose(recursive.model.covariance, whole.model.covariance, rtol=1e-4, atol=1e-25)
    for found, expected in zip(
        recursive.predict_multi_and_one_step(27.0), whole.predict_multi_and_one_step(27.0), strict=True
    ):
        np.testing.assert_allclose(astuple(found), astuple(expected), rtol=1e-7)


@pytest.mark.parametrize("seed", [3, 5])
def test_recursion_starts_with_the_fitted_model(seed):
    means = simulate_hourly_means(seed, 2, 0.05)
    model = fit_thermal_model(means).model
    found = RecursiveThermalFit(model, means).model
    np.testing.assert_allclose(found.coefficients, model.coefficients, rtol=1e-6)
    np.testing.assert_allclose(found.initial_state, model.initial_state, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, model.covariance, rtol=1e-4, atol=1e-25)
    assert found.sigma == pytest.approx(model.sigma, rel=1e-9)


@pytest.mark.parametrize("to_c", [26.5, 60.0])
def test_one_step_prediction_equals_that_of_the_model(to_c):
    """The intervals use Student's distribution because the scatter is estimated from 71 intervals."""
    means = simulate_hourly_means(4, 1, 0.05)
    recursion = RecursiveThermalFit(replace(fit_thermal_model(means).model, phi=0.3), select_first_intervals(means, 71))
    temperature_c = np.append(means.temperature_c[:71], to_c)
    measured = np.append(means.bias[:71], np.nan)
    wide = student.ppf(0.975, recursion.degrees_of_freedom) / Z95
    for found, known in zip(recursion.predict_multi_and_one_step(to_c), (None, measured), strict=True):
        want = predict_interval_means(recursion.model, temperature_c, known, starts_with_fit=True)
        assert found.bias == pytest.approx(want.bias[-1], rel=1e-9)
        assert found.hi - found.bias == pytest.approx(wide * (want.hi[-1] - want.bias[-1]), rel=1e-6)
        assert found.bias - found.lo == pytest.approx(wide * (want.bias[-1] - want.lo[-1]), rel=1e-6)


def test_missing_temperature_is_treated_as_constant():
    means = simulate_hourly_means(6, 2, 0.05)
    model = fit_thermal_model(means).model
    unknown, constant = RecursiveThermalFit(model, means), RecursiveThermalFit(model, means)
    last = float(means.temperature_c[-1])
    unknown.add_interval(np.nan, 1.0)
    constant.add_interval(last, np.nan)
    assert unknown.predict_multi_and_one_step(np.nan)[0].bias == pytest.approx(
        constant.predict_multi_and_one_step(last)[0].bias
    )
    assert unknown.degrees_of_freedom == RecursiveThermalFit(model, means).degrees_of_freedom
