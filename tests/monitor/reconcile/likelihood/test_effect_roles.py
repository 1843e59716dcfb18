"""Tests that sizes, spectra and regressors of the fit equal the series and spectra of the simulated effects."""

from dataclasses import replace

import numpy as np
import pytest

from monitor.noise.effect import AxisLeak, SampleBlockContext, Source
from monitor.noise.effects import EFFECTS, Sinusoidal, TemperatureBias
from monitor.reconcile.effect_properties import NOISE_SIZE_PARAMETERS, SERIES_SIZE_PARAMETERS
from monitor.reconcile.likelihood.effect_roles import (
    build_unit_regressors,
    effect_size,
    with_effect_size,
    with_regression_coefficients,
)
from tests.contracts.effect_examples import make_effect
from tests.monitor.reconcile.axes import RATE_HZ, make_temperature

NOISES = [EFFECTS[name] for name in NOISE_SIZE_PARAMETERS if issubclass(EFFECTS[name], Source)]
COURSES = [EFFECTS[name] for name in SERIES_SIZE_PARAMETERS if not issubclass(EFFECTS[name], AxisLeak)]
n = 3000


def draw_series(one):
    values = np.zeros(n)
    one.start_series(RATE_HZ, np.random.default_rng(1)).add_next_samples(
        values, SampleBlockContext(0, make_temperature(n), np.empty(n))
    )
    return values


def test_every_source_has_a_role():
    # a mean is always free; outliers are single samples; a wandering line is subtracted before the fit
    beside = {"bias", "outliers", "wandering_line"}
    names = {name for name, kind in EFFECTS.items() if issubclass(kind, Source | AxisLeak) and name not in beside}
    # the noise of a filter is its floor
    assert set(NOISE_SIZE_PARAMETERS) | set(SERIES_SIZE_PARAMETERS) == names | {"bandwidth_limit"}
    assert not set(NOISE_SIZE_PARAMETERS) & set(SERIES_SIZE_PARAMETERS)


@pytest.mark.parametrize("kind", NOISES, ids=lambda kind: kind.name)
def test_spectrum_is_proportional_to_the_square_of_the_size(kind):
    one = make_effect(kind.name)
    f_hz, tau0_s = np.geomspace(0.01, 0.5 * RATE_HZ, 40), 1.0 / RATE_HZ
    np.testing.assert_allclose(
        effect_size(one) ** 2 * with_effect_size(one, 1.0).two_sided_psd(f_hz, tau0_s),
        one.two_sided_psd(f_hz, tau0_s),
        rtol=1e-12,
    )
    bigger = with_effect_size(one, 7.0)
    np.testing.assert_allclose(
        49.0 * with_effect_size(one, 1.0).two_sided_psd(f_hz, tau0_s), bigger.two_sided_psd(f_hz, tau0_s), rtol=1e-12
    )
    assert effect_size(with_effect_size(one, -7.0)) == 7.0


@pytest.mark.parametrize("kind", COURSES, ids=lambda kind: kind.name)
def test_regressors_times_coefficients_equal_the_series(kind):
    one = make_effect(kind.name)
    if kind.name == "pulse_train":  # a delay that is not given is drawn
        one = replace(one, delay=0.03)
    made = build_unit_regressors(one, n, RATE_HZ, make_temperature(n))
    factors = np.array([0.8, -1.7, 0.6])[: len(made)]
    fitted = with_regression_coefficients(one, factors)
    want = draw_series(fitted)
    summed = sum(factor * column for factor, column in zip(factors, made, strict=True))
    if kind.name == "rate_ramp":  # a ramp's R is a size without a sign
        factors = np.abs(factors)
    np.testing.assert_allclose(summed, want, atol=1e-9 * np.abs(want).max())
    assert type(fitted) is kind
    assert np.abs(want).max() > 0.0


def test_two_regressors_contain_the_phase_of_a_line():
    line = Sinusoidal(amplitude=0.4, frequency=7.3, phase=2.2)
    made = np.stack(build_unit_regressors(line, n, RATE_HZ, None))
    factors, *_ = np.linalg.lstsq(made.T, draw_series(line), rcond=None)
    back = with_regression_coefficients(line, factors)
    assert back.amplitude == pytest.approx(0.4)
    assert back.phase == pytest.approx(2.2)


def test_quadratic_temperature_effect_has_two_regressors():
    straight = TemperatureBias(coefficient=0.3, reference=25.0)
    assert len(build_unit_regressors(straight, n, RATE_HZ, make_temperature(n))) == 1
    bent = TemperatureBias(coefficient=0.3, reference=25.0, quadratic=-0.04)
    one, two = build_unit_regressors(bent, n, RATE_HZ, make_temperature(n))
    np.testing.assert_allclose(one, make_temperature(n) - 25.0, atol=1e-12)
    np.testing.assert_allclose(two, (make_temperature(n) - 25.0) ** 2, atol=1e-12)


def test_signed_sizes_keep_their_sign():
    assert effect_size(with_effect_size(make_effect("bias_step"), -2.0)) == -2.0
    assert effect_size(with_effect_size(make_effect("sinusoidal"), -2.0)) == 2.0
    assert effect_size(with_effect_size(make_effect("rate_ramp"), -2.0)) == 2.0
