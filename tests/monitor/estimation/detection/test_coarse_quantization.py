"""Tests of the detection of quantization steps as large as the noise."""

import numpy as np
import pytest

from monitor.estimation.detection.coarse_quantization import MIN_STEP_TO_NOISE, find_coarsely_quantized_axes


def simulate_noise(n=30_000, seed=0):
    return np.random.default_rng(seed).standard_normal((n, 6))


@pytest.mark.parametrize("step", [0.6, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_coarse_axis_is_found_with_step_and_noise(step, scale):
    values = simulate_noise() + 9.81
    values[:, 4] = np.round(values[:, 4] / step) * step
    [found] = find_coarsely_quantized_axes(scale * values)
    assert found.axis == 4
    assert found.step == pytest.approx(step * scale, rel=1e-6)
    assert found.noise == pytest.approx(scale * (1.0 + step**2 / 12.0) ** 0.5, rel=0.2 if step < 3.0 else 0.5)


def test_steps_of_32_bit_numbers_are_found():
    values = 0.0327 * np.round(simulate_noise() + 300.0)
    assert [axis.axis for axis in find_coarsely_quantized_axes(values.astype(np.float32).astype(float))] == list(
        range(6)
    )


@pytest.mark.parametrize("step", [0.0, 1e-3, 0.9 * MIN_STEP_TO_NOISE])
def test_fine_steps_are_not_reported(step):
    values = simulate_noise() if step == 0.0 else np.round(simulate_noise() / step) * step
    assert find_coarsely_quantized_axes(values) == []


def test_axis_with_values_off_the_grid_is_not_coarse():
    values = np.round(simulate_noise())
    values[1000, 2] += 0.7
    values[1001, 2] += 0.3
    assert 2 not in [axis.axis for axis in find_coarsely_quantized_axes(values)]


def test_steps_are_found_in_spite_of_drift_and_outliers():
    values = simulate_noise() + 1e-3 * np.arange(30_000)[:, None]
    values[::500] += 50.0
    assert len(find_coarsely_quantized_axes(np.round(values))) == 6


@pytest.mark.parametrize("values", [np.zeros((0, 6)), np.ones((1, 6)), np.ones((500, 6)), np.full((500, 6), np.nan)])
def test_missing_or_constant_values_have_no_steps(values):
    assert find_coarsely_quantized_axes(values) == []


def test_missing_samples_are_ignored():
    values = np.round(simulate_noise())
    values[np.random.default_rng(1).random(30_000) < 0.3] = np.nan
    assert len(find_coarsely_quantized_axes(values)) == 6
