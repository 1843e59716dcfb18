"""Tests of the detection of hysteresis and of temperature dependence, including noise that has neither."""

from dataclasses import replace

import numpy as np
import pytest

from monitor.drift.thermal.hysteresis import find_hysteresis, heating_direction
from monitor.drift.thermal.interval_means import IntervalMeans
from monitor.drift.thermal.temperature_removal import TemperatureDependence, find_temperature_dependence
from monitor.drift.thermal.thermal_fit import fit_thermal_model
from tests.monitor.drift.temperature_cycles import NOISES, SHAPES, simulate_chamber_means, simulate_noise_means

INTERVAL_COUNT = 75


def find_dependence(means: IntervalMeans) -> TemperatureDependence | None:
    return find_temperature_dependence(fit_thermal_model(means))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("law", ["linear", "cubic"])
def test_temperature_dependent_bias_is_found_in_every_cycle(shape: str, law: str) -> None:
    noise = simulate_noise_means("random walk", INTERVAL_COUNT, np.random.default_rng(1))
    found = find_dependence(simulate_chamber_means(shape, noise, law, 50.0 * noise.std()))
    assert found is not None
    assert found.explains_most_variance
    assert found.share > 0.99
    assert found.form == "polynomial 1" if law == "linear" else "polynomial 3"
    assert found.one_way == (shape == "heating")


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("shape", SHAPES)
def test_noise_is_not_attributed_to_temperature(shape: str, noise: str) -> None:
    for seed in range(3):
        means = simulate_chamber_means(shape, simulate_noise_means(noise, INTERVAL_COUNT, np.random.default_rng(seed)))
        assert find_dependence(means) is None
        hysteresis = find_hysteresis(means)
        assert (hysteresis is None) == (shape == "heating")
        assert hysteresis is None or not hysteresis.is_significant


@pytest.mark.parametrize("law", ["loop", "lag", "play"])
@pytest.mark.parametrize("shape", SHAPES[:-1])
def test_size_of_hysteresis_is_estimated(shape: str, law: str) -> None:
    curve = simulate_chamber_means(
        shape, simulate_noise_means("white", INTERVAL_COUNT, np.random.default_rng(4)), "cubic", 200.0
    ).bias
    assert not find_hysteresis(simulate_chamber_means(shape, curve)).is_significant  # type: ignore[union-attr]
    found = find_hysteresis(simulate_chamber_means(shape, curve, law, 100.0))
    assert found is not None
    assert found.is_significant
    assert found.size == pytest.approx(100.0, rel=0.12)


def test_steady_drift_is_neither_temperature_nor_hysteresis() -> None:
    means = simulate_chamber_means(
        "ramp",
        simulate_noise_means("white", INTERVAL_COUNT, np.random.default_rng(5))
        + np.linspace(0.0, 100.0, INTERVAL_COUNT),
    )
    assert find_dependence(means) is None
    hysteresis = find_hysteresis(means)
    assert hysteresis is not None
    assert not hysteresis.is_significant


def test_pure_hysteresis_is_found_as_temperature_dependence() -> None:
    found = find_dependence(
        simulate_chamber_means(
            "ramp", simulate_noise_means("white", INTERVAL_COUNT, np.random.default_rng(6)), "loop", 100.0
        )
    )
    assert found is not None
    assert found.form.startswith("difference") or found.form.endswith("with hysteresis")
    assert found.share > 0.95


def test_missing_values_and_units_do_not_change_the_result() -> None:
    noise = simulate_noise_means("random walk", INTERVAL_COUNT, np.random.default_rng(7))
    means = simulate_chamber_means("sine", noise, "cubic", 100.0)
    bias, temperature_c = 1e-6 * means.bias, means.temperature_c.copy()
    bias[20:26], temperature_c[40] = np.nan, np.nan
    found = find_dependence(replace(means, bias=bias, temperature_c=temperature_c))
    whole = find_dependence(means)
    assert found is not None
    assert whole is not None
    assert found.share == pytest.approx(whole.share, abs=0.01)
    looped = replace(simulate_chamber_means("sine", noise, "play", 100.0), temperature_c=temperature_c)
    size = find_hysteresis(replace(looped, bias=np.where(np.isfinite(bias), 1e-6 * looped.bias, np.nan)))
    assert size is not None
    assert size.size == pytest.approx(1e-4, rel=0.15)


def test_many_intervals_are_averaged_and_too_few_are_refused() -> None:
    noise = simulate_noise_means("white", 2000, np.random.default_rng(8))
    found = find_hysteresis(simulate_chamber_means("ramp", noise, "loop", 20.0))
    assert found is not None
    assert found.size == pytest.approx(20.0, rel=0.15)
    short = IntervalMeans(1.0, np.arange(8.0), np.ones(8), np.array([0.0, 1.0, 2.0, 3.0, 3.0, 2.0, 1.0, 0.0]))
    assert find_hysteresis(short) is None


def test_heating_direction_is_kept_in_dwells_and_ignores_noise() -> None:
    rng = np.random.default_rng(9)
    temperature_c = np.concatenate([np.linspace(0.0, 10.0, 30), np.full(20, 10.0), np.linspace(10.0, 0.0, 30)])
    direction = heating_direction(temperature_c + 0.02 * rng.standard_normal(temperature_c.size))
    assert set(direction[:28]) == {1.0}
    assert set(direction[52:]) == {-1.0}
    assert np.count_nonzero(np.diff(direction)) == 1
    assert not heating_direction(np.full(10, 25.0)).any()
