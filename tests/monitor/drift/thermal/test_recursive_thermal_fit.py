"""What is renewed interval by interval against least squares of the whole record."""

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
from tests.monitor.drift.made import first_intervals, hourly


def of(means: IntervalMeans, shape: ThermalModelForm, phi: float) -> ThermalModel:
    """A model whose sizes nobody has fitted yet."""
    model = fit_thermal_model(means).model
    return replace(model, shape=shape, phi=phi, coefficients=np.zeros(0), initial_state=np.zeros(0))


@pytest.mark.parametrize(
    "shape",
    [ThermalModelForm(3, ()), ThermalModelForm(0, (7e3,)), ThermalModelForm(1, (3e3, 4e4))],
    ids=lambda shape: shape.name,
)
@pytest.mark.parametrize("phi", [0.0, 0.6])
def test_interval_by_interval_is_the_whole_at_once(shape, phi):
    means = hourly(2, 2, 0.05)
    bias = means.bias.copy()
    bias[[30, 31, 45]] = np.nan
    means = replace(means, bias=bias)
    model = of(means, shape, phi)
    one, whole = RecursiveThermalFit(model, first_intervals(means, 20)), RecursiveThermalFit(model, means)
    for k in range(20, 72):
        one.add_interval(float(means.temperature_c[k]), float(means.bias[k]))
    for name in ("coefficients", "initial_state", "sigma", "lowest_c", "highest_c"):
        np.testing.assert_allclose(getattr(one.model, name), getattr(whole.model, name), rtol=1e-7, err_msg=name)
    np.testing.assert_allclose(one.model.covariance, whole.model.covariance, rtol=1e-4, atol=1e-25)
    for mine, theirs in zip(one.predict_multi_and_one_step(27.0), whole.predict_multi_and_one_step(27.0), strict=True):
        np.testing.assert_allclose(astuple(mine), astuple(theirs), rtol=1e-7)


@pytest.mark.parametrize("seed", [3, 5])
def test_it_begins_with_what_was_fitted(seed):
    means = hourly(seed, 2, 0.05)
    model = fit_thermal_model(means).model
    found = RecursiveThermalFit(model, means).model
    np.testing.assert_allclose(found.coefficients, model.coefficients, rtol=1e-6)
    np.testing.assert_allclose(found.initial_state, model.initial_state, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, model.covariance, rtol=1e-4, atol=1e-25)
    assert found.sigma == pytest.approx(model.sigma, rel=1e-9)


@pytest.mark.parametrize("to_c", [26.5, 60.0])
def test_what_it_expects_is_what_the_model_predicts(to_c):
    """With Student's factor, as the scatter is known from 71 intervals less what was fitted."""
    means = hourly(4, 1, 0.05)
    recursion = RecursiveThermalFit(replace(fit_thermal_model(means).model, phi=0.3), first_intervals(means, 71))
    warmth = np.append(means.temperature_c[:71], to_c)
    measured = np.append(means.bias[:71], np.nan)
    wide = student.ppf(0.975, recursion.degrees_of_freedom) / Z95
    for found, known in zip(recursion.predict_multi_and_one_step(to_c), (None, measured), strict=True):
        want = predict_interval_means(recursion.model, warmth, known, starts_with_fit=True)
        assert found.bias == pytest.approx(want.bias[-1], rel=1e-9)
        assert found.hi - found.bias == pytest.approx(wide * (want.hi[-1] - want.bias[-1]), rel=1e-6)
        assert found.bias - found.lo == pytest.approx(wide * (want.bias[-1] - want.lo[-1]), rel=1e-6)


def test_without_temperature_it_goes_on_as_if_that_had_stayed():
    means = hourly(6, 2, 0.05)
    model = fit_thermal_model(means).model
    held, told = RecursiveThermalFit(model, means), RecursiveThermalFit(model, means)
    last = float(means.temperature_c[-1])
    held.add_interval(np.nan, 1.0)
    told.add_interval(last, np.nan)
    assert held.predict_multi_and_one_step(np.nan)[0].bias == pytest.approx(
        told.predict_multi_and_one_step(last)[0].bias
    )
    assert held.degrees_of_freedom == RecursiveThermalFit(model, means).degrees_of_freedom
