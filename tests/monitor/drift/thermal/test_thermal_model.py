"""Tests of the thermal model: difference equation and derivatives."""

import numpy as np
import pytest

from monitor.drift.thermal.thermal_model import ThermalModel, bias_derivatives_by_log_time_constant
from monitor.drift.thermal.thermal_response import ThermalModelForm, build_regressors

TEMPERATURE_SERIES = np.random.default_rng(5).standard_normal(40).cumsum()


def make_model(shape: ThermalModelForm, sizes: list[float], start: list[float]) -> ThermalModel:
    n = len(sizes) + 2 * len(start)
    return ThermalModel(shape, 60.0, 25.0, np.array(sizes), np.array(start), 0.0, 1.0, np.zeros((n, n)), 20.0, 30.0)


def test_difference_equation_has_the_coefficients_of_the_lag():
    """A lag that decays by half per interval gives Y_n − ½ Y_{n−1} = ½ · 10 T_n + ½ · 3."""
    lagged = make_model(ThermalModelForm(0, (60.0 / np.log(2.0),)), [3.0, 10.0], [0.0])
    assert lagged.equation == {"a": pytest.approx([-0.5]), "b": pytest.approx([5.0]), "c": pytest.approx(1.5)}
    assert make_model(ThermalModelForm(1, ()), [3.0, 2.0], []).equation == {"a": [], "b": [2.0], "c": 3.0}
    assert make_model(ThermalModelForm(2, ()), [3.0, 2.0, 1.0], []).equation is None


def test_derivatives_by_time_constant_equal_finite_differences():
    constants, sizes, start = (100.0, 700.0), [1.0, 2.0, -3.0, 4.0], [0.5, -0.7]

    def compute_bias(at: int, by: float) -> np.ndarray:
        changed = tuple(constant * np.exp(by if i == at else 0.0) for i, constant in enumerate(constants))
        return build_regressors(
            ThermalModelForm(1, changed), TEMPERATURE_SERIES, 60.0, with_initial_state=True
        ) @ np.array(sizes + start)

    found = bias_derivatives_by_log_time_constant(
        make_model(ThermalModelForm(1, constants), sizes, start), TEMPERATURE_SERIES, np.array(sizes + start)
    )
    want = np.stack([(compute_bias(at, 1e-5) - compute_bias(at, -1e-5)) / 2e-5 for at in (0, 1)], axis=1)
    np.testing.assert_allclose(found, want, rtol=1e-4, atol=1e-5)
