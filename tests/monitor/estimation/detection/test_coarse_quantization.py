"""Steps of values are told where they are as large as the noise, and nowhere else."""

import numpy as np
import pytest

from monitor.estimation.detection.coarse_quantization import MIN_STEP_TO_NOISE, find_coarsely_quantized_axes


def noise(n=30_000, seed=0):
    return np.random.default_rng(seed).standard_normal((n, 6))


@pytest.mark.parametrize("step", [0.6, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_a_coarse_axis_has_its_step_and_noise(step, scale):
    values = noise() + 9.81
    values[:, 4] = np.round(values[:, 4] / step) * step
    [found] = find_coarsely_quantized_axes(scale * values)
    assert found.axis == 4
    assert found.step == pytest.approx(step * scale, rel=1e-6)
    assert found.noise == pytest.approx(scale * (1.0 + step**2 / 12.0) ** 0.5, rel=0.2 if step < 3.0 else 0.5)


def test_numbers_of_32_bits_are_on_their_grid():
    values = 0.0327 * np.round(noise() + 300.0)
    assert [one.axis for one in find_coarsely_quantized_axes(values.astype(np.float32).astype(float))] == list(range(6))


@pytest.mark.parametrize("step", [0.0, 1e-3, 0.9 * MIN_STEP_TO_NOISE])
def test_fine_steps_are_not_told(step):
    values = noise() if step == 0.0 else np.round(noise() / step) * step
    assert find_coarsely_quantized_axes(values) == []


def test_values_off_the_grid_are_not_coarse():
    values = np.round(noise())
    values[1000, 2] += 0.7
    values[1001, 2] += 0.3
    assert 2 not in [one.axis for one in find_coarsely_quantized_axes(values)]


def test_a_slow_drift_and_a_few_outliers_hide_no_steps():
    values = noise() + 1e-3 * np.arange(30_000)[:, None]
    values[::500] += 50.0
    assert len(find_coarsely_quantized_axes(np.round(values))) == 6


@pytest.mark.parametrize("values", [np.zeros((0, 6)), np.ones((1, 6)), np.ones((500, 6)), np.full((500, 6), np.nan)])
def test_what_says_nothing_has_no_steps(values):
    assert find_coarsely_quantized_axes(values) == []


def test_missing_samples_are_passed_over():
    values = np.round(noise())
    values[np.random.default_rng(1).random(30_000) < 0.3] = np.nan
    assert len(find_coarsely_quantized_axes(values)) == 6
