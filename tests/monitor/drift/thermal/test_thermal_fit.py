"""Tests of the fit of thermal models, compared with a cubic polynomial."""

from dataclasses import replace

import numpy as np
import pytest

from drivers.errors import NotReady
from monitor.drift.thermal.interval_means import IntervalMeans
from monitor.drift.thermal.thermal_fit import fit_thermal_model
from monitor.drift.thermal.thermal_model import predict_interval_means
from monitor.drift.thermal.thermal_response import ThermalModelForm
from monitor.drift.thermal.thermal_results import compare_model_with_means
from tests.monitor.drift.thermal_biases import BIAS_SLOPE, select_first_intervals, simulate_hourly_means

FIT_HOURS = 48  # in a single daily cycle, slow noise often explains a lag as well; one further day tests the prediction


def compare_with_cubic(seed, lag_h, noise):
    """Return error relative to a cubic on the test day, share of means inside their intervals, and the fit."""
    means = simulate_hourly_means(seed, lag_h, noise)
    found = fit_thermal_model(select_first_intervals(means, FIT_HOURS))
    model = predict_interval_means(found.model, means.temperature_c, starts_with_fit=True)
    cubic = np.polynomial.Polynomial.fit(means.temperature_c[:FIT_HOURS], means.bias[:FIT_HOURS], 3)(
        means.temperature_c
    )
    model_error, cubic_error = ((means.bias - prediction)[FIT_HOURS:] for prediction in (model.bias, cubic))
    inside = (model.lo < means.bias) & (means.bias < model.hi)
    return np.sqrt(np.mean(model_error**2) / np.mean(cubic_error**2)), inside[FIT_HOURS:].mean(), found


@pytest.mark.long
@pytest.mark.parametrize(
    ("lag_h", "noise", "max_ratio"), [(1, 0.05, 0.65), (2, 0.05, 0.45), (4, 0.05, 0.3), (4, 0.02, 0.15)]
)
def test_delayed_temperature_effect_is_modelled(lag_h, noise, max_ratio):
    """The paper reports an error 0.654 times that of a cubic; docs/measurements/thermal-models.md lists the medians
    over 200 seeds."""
    ratios, inside, found = zip(*(compare_with_cubic(seed, lag_h, noise) for seed in range(6)), strict=True)
    assert np.median(ratios) < max_ratio
    assert np.mean(inside) > 0.9
    for fit in found:
        assert fit.model.shape.difference_equation_order >= 1
        # the lag of the mean of an interval is taken for that of its end, which lengthens the time constant
        ((lo, hi),) = fit.time_constant_intervals_s
        assert 0.7 * lo < 3600.0 * lag_h < 1.3 * hi
        assert fit.model.mean_bias_slope == pytest.approx(BIAS_SLOPE, rel=0.3)
    for seed in range(6):
        # in a single daily cycle, correlated noise explains the hysteresis as well
        two_days, three_days = (
            fit_thermal_model(
                select_first_intervals(simulate_hourly_means(seed, lag_h, noise), 24 * days)
            ).hysteresis.size
            for days in (2, 3)
        )
        assert two_days == pytest.approx(three_days, rel=0.25)


@pytest.mark.parametrize("noise", [0.02, 0.1])
def test_without_lag_a_polynomial_is_as_good_as_the_cubic(noise):
    ratios, _, found = zip(*(compare_with_cubic(seed, 0, noise) for seed in range(6)), strict=True)
    assert max(ratios) < 1.05
    assert all(fit.model.shape == ThermalModelForm(1, ()) for fit in found)


@pytest.mark.long
def test_one_step_predictions_follow_a_random_walk():
    """The measured bias of the previous interval follows a random walk that temperature does not explain."""
    ratios, inside = [], []
    for seed in range(6):
        means = simulate_hourly_means(seed, 2, 0.01)
        step = 0.04 * np.ptp(means.bias)
        drifting = replace(means, bias=means.bias + step * np.random.default_rng(seed).standard_normal(72).cumsum())
        model = fit_thermal_model(select_first_intervals(drifting, 48)).model
        prediction = predict_interval_means(model, drifting.temperature_c, drifting.bias, starts_with_fit=True)
        ratios.append(np.std((drifting.bias - prediction.bias)[48:]) / step)
        inside.append(np.mean(((prediction.lo < drifting.bias) & (drifting.bias < prediction.hi))[48:]))
    assert np.median(ratios) < 1.2  # an error of one step is unavoidable
    assert np.median(inside) > 0.85


@pytest.mark.long
def test_missing_intervals_keep_their_positions():
    means = simulate_hourly_means(2, 2, 0.02)
    bias, temperature_c = means.bias.copy(), means.temperature_c.copy()
    bias[5:9], temperature_c[15] = np.nan, np.nan
    holes = replace(means, bias=bias, temperature_c=temperature_c)
    whole, found = fit_thermal_model(means).model, fit_thermal_model(holes).model
    assert found.shape.name == whole.shape.name
    np.testing.assert_allclose(found.mean_bias_slope, whole.mean_bias_slope, rtol=0.1)
    assert np.isfinite(predict_interval_means(found, temperature_c).bias).all()


def test_fit_is_invariant_to_units():
    means = simulate_hourly_means(3, 2, 0.05)
    large = replace(means, bias=1e6 * means.bias)
    original, scaled = fit_thermal_model(means).model, fit_thermal_model(large).model
    assert original.shape == scaled.shape
    assert scaled.mean_bias_slope == pytest.approx(1e6 * original.mean_bias_slope, rel=1e-6)


def test_other_switch_on_bias_is_found_as_an_offset():
    """The second recording has an offset of 0.3 mrad/s; without the offset only its noise remains."""
    model = fit_thermal_model(simulate_hourly_means(4, 1, 0.02)).model
    other = simulate_hourly_means(14, 1, 0.02)
    comparison = compare_model_with_means(model, replace(other, bias=other.bias + 3e-4))
    assert comparison.offset == pytest.approx(3e-4, rel=0.02)
    assert comparison.rms_without_offset < 0.15 * comparison.rms_about_mean
    assert comparison.rms > 10.0 * comparison.rms_without_offset


def test_prediction_beyond_the_fitted_temperatures_is_linear():
    """A model fitted up to 30 °C predicts up to 40 °C along its chord, with growing uncertainty."""
    t = np.linspace(20.0, 30.0, 60)
    rng = np.random.default_rng(10)
    bias = 1e-5 * (t - 25.0) + 4e-7 * (t - 25.0) ** 3 + 1e-6 * rng.standard_normal(60)
    model = fit_thermal_model(IntervalMeans(60.0, bias, np.full(60, 1e-6), t)).model
    assert model.shape.powers >= 3
    beyond = predict_interval_means(model, np.array([30.0, 35.0, 40.0]))
    np.testing.assert_allclose(np.diff(beyond.bias), 5.0 * model.mean_bias_slope, rtol=1e-9)
    assert np.all(np.diff(beyond.hi - beyond.lo) > 5.0 * model.mean_bias_slope)


def test_monotonic_temperature_gives_no_estimate_of_the_lag():
    t = np.arange(60.0)
    temperature_c = 25.0 + 8.0 * (1.0 - np.exp(-t / 20.0))
    rng = np.random.default_rng(6)
    found = fit_thermal_model(
        IntervalMeans(60.0, 1e-5 * temperature_c + 2e-6 * rng.standard_normal(60), np.full(60, 2e-6), temperature_c)
    )
    assert not found.temperature_rose_and_fell
    assert found.hysteresis is None
    assert not found.model.shape.difference_equation_order


def test_hysteresis_of_a_lag_has_the_expected_size():
    """With a lag τ and a daily cycle ω, rising and falling differ by 2 sin(arctan ωτ) cos(arctan ωτ)."""
    found = fit_thermal_model(simulate_hourly_means(7, 2, 0.01))
    angle = np.arctan(2.0 * np.pi * 2.0 / 24.0)
    want = 2.0 * np.sin(angle) * np.cos(angle) * 1.5 * BIAS_SLOPE
    assert found.hysteresis.size == pytest.approx(want, rel=0.3)


def simulate_slow_noise(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return means of 60 s of white noise, flicker and a random walk, in deviations of the white noise."""
    points = 20
    walk = 0.5 / points**0.5 * rng.standard_normal(n * points).cumsum()
    frequencies = np.fft.rfftfreq(2 * n * points)[1:]
    spectrum = (rng.standard_normal((2, frequencies.size)).T @ [1.0, 1.0j]) * np.sqrt(n * points / frequencies / 4.0)
    flicker = np.fft.irfft(np.append(0.0, spectrum))[: n * points]
    return (walk + flicker).reshape(n, points).mean(axis=1) + rng.standard_normal(n)


def simulate_two_hours(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Return the temperature of 120 intervals of 60 s in °C."""
    t, draw = np.arange(120) / 120.0, rng.uniform()
    made = {
        "warm-up": 12.0 * (1.0 - np.exp(-t / (0.05 + 0.3 * draw))),
        "day": 10.0 * np.sin(2.0 * np.pi * (t / 12.0 + draw)),
        "cycles": 3.0 * np.sin(2.0 * np.pi * (t * (1.0 + 5.0 * draw) + draw)),
        "ramp": 10.0 * (0.1 + draw) * t,
        "steps": np.repeat(rng.uniform(-5.0, 5.0, 6), 20),
    }
    return 25.0 + made[kind] + 0.01 * rng.standard_normal(120)


TEMPERATURES = ("warm-up", "day", "cycles", "ramp", "steps")


def count_claims(kind: str, trials: int) -> int:
    """Return the number of recordings of noise alone with a thermal model, a lag or hysteresis."""
    count = 0
    for seed in range(trials):
        rng = np.random.default_rng([seed, TEMPERATURES.index(kind)])
        bias = simulate_slow_noise(120, rng)
        bias[rng.random(120) < 0.1] = np.nan
        try:
            found = fit_thermal_model(IntervalMeans(60.0, bias, np.ones(120), simulate_two_hours(kind, rng)))
        except NotReady:  # the ramp or the part of a day is too flat
            continue
        loop = found.hysteresis
        count += not found.model.shape.is_constant or (loop is not None and loop.is_significant)
    return count


@pytest.mark.parametrize("kind", TEMPERATURES)
def test_random_walk_is_not_a_thermal_model(kind: str) -> None:
    assert count_claims(kind, 6) == 0


@pytest.mark.long
@pytest.mark.parametrize("kind", TEMPERATURES)
def test_false_thermal_models_are_rare(kind: str) -> None:
    assert count_claims(kind, 100) <= 5


@pytest.mark.long
@pytest.mark.parametrize("kind", ["warm-up", "cycles", "steps"])
def test_slope_beside_a_random_walk_lies_in_its_interval(kind: str) -> None:
    """At least 134 of 150 intervals contain the true slope; 95 % would be 142.5 ± 2.7."""
    inside = lags = 0
    for seed in range(150):
        rng = np.random.default_rng([1, seed, TEMPERATURES.index(kind)])
        temperature_c = simulate_two_hours(kind, rng)
        bias = simulate_slow_noise(120, rng) + 10.0 * temperature_c
        found = fit_thermal_model(IntervalMeans(60.0, bias, np.ones(120), temperature_c))
        inside += found.slope_interval[0] <= 10.0 <= found.slope_interval[1]
        lags += found.model.shape.difference_equation_order > 0
    assert inside >= 134
    assert lags <= 5


def test_model_that_explains_nothing_is_replaced_by_a_constant():
    """The increments follow the temperature, but the random walk moves the bias the other way."""
    t = np.linspace(0.0, 1.0, 120)
    rng = np.random.default_rng(1)
    temperature_c = 25.0 + 5.0 * t + np.repeat(rng.uniform(-0.5, 0.5, 24), 5)
    bias = temperature_c - 12.0 * t + 0.01 * rng.standard_normal(120) + 0.05 * rng.standard_normal(120).cumsum()
    found = fit_thermal_model(IntervalMeans(60.0, bias, np.full(120, 0.01), temperature_c))
    assert found.tests[0].shape == ThermalModelForm(1, ())
    assert found.tests[0].p_value < 1e-9
    assert found.model.shape == ThermalModelForm(0, ())
    assert found.model.mean_bias_slope == 0.0


def test_bias_independent_of_temperature_gives_a_constant():
    means = simulate_hourly_means(8, 0, 0.01)
    noise = 1e-6 * np.random.default_rng(9).standard_normal(72)
    found = fit_thermal_model(replace(means, bias=1e-3 + noise))
    assert found.model.shape == ThermalModelForm(0, ())
    assert found.explained == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("means", "message"),
    [
        (select_first_intervals(simulate_hourly_means(1, 1, 0.05), 11), "11 intervals of 3600 s"),
        (replace(simulate_hourly_means(1, 1, 0.05), temperature_c=np.full(72, 25.0)), "temperature hardly changed"),
        (
            replace(
                simulate_hourly_means(1, 1, 0.05),
                temperature_c=25.0 + 0.1 * np.random.default_rng(2).standard_normal(72),
            ),
            "temperature hardly changed",
        ),
        (replace(simulate_hourly_means(1, 1, 0.05), bias=np.zeros(72)), "the same in all intervals"),
        (replace(simulate_hourly_means(1, 1, 0.05), bias=np.full(72, np.nan)), "0 intervals"),
    ],
)
def test_insufficient_data_is_refused_with_the_reason(means, message):
    with pytest.raises(NotReady, match=message):
        fit_thermal_model(means)
