"""Tests of the comparison of a wandering line with a resonance and a modulated line, and of its subtraction."""

import numpy as np
import pytest

from monitor.noise.effects import Narrowband, WanderingLine
from monitor.reconcile.likelihood.wandering_line_likelihood import expand_band, extract_band
from monitor.reconcile.likelihood.wandering_line_vs_resonance import (
    compare_wandering_line_with_resonance,
    draw_wandering_line,
)
from tests.monitor.reconcile.axes import RATE_HZ, correlated, draw_resonance, time_s

n = 120_000
T = time_s(n)
WIDE = Narrowband(sigma=1.0, frequency=13.0, bandwidth=0.5)


def draw_wandering(rng, amplitude, deviation_hz, time_s):
    hz = 13.0 + correlated(n, rng, deviation_hz, time_s)
    return amplitude * np.sin(2.0 * np.pi * np.cumsum(hz) / RATE_HZ)


def add_noise(rng, y):
    return y + rng.standard_normal(n)


@pytest.mark.parametrize("amplitude", [0.15, 0.4, 4.0, 100.0])
@pytest.mark.parametrize("seed", range(2))
def test_wandering_line_is_no_resonance(amplitude, seed):
    """Weak lines are followed block by block, strong lines by their phase."""
    rng = np.random.default_rng(seed)
    found = compare_wandering_line_with_resonance(
        add_noise(rng, draw_wandering(rng, amplitude, 0.2, 40.0)), RATE_HZ, WIDE
    )
    assert found is not None
    assert found.gain > 20.0
    assert not found.is_modulated
    assert not found.is_sweep
    assert found.line.amplitude == pytest.approx(amplitude, rel=0.1)
    assert found.line.frequency == pytest.approx(13.0, abs=0.15)
    assert found.line.frequency_deviation == pytest.approx(0.2, rel=0.6)
    assert found.parameters["amplitude"].value == found.line.amplitude


@pytest.mark.parametrize("sigma", [0.08, 0.3, 3.0, 100.0])
@pytest.mark.parametrize("width_hz", [0.02, 0.2, 1.0])
def test_resonance_is_no_wandering_line(sigma, width_hz):
    rng = np.random.default_rng(3)
    y = add_noise(rng, draw_resonance(n, rng, sigma, 13.0, width_hz))
    found = compare_wandering_line_with_resonance(y, RATE_HZ, Narrowband(sigma, 13.0, width_hz))
    assert found is not None
    assert found.gain < 5.0
    assert not found.is_modulated


@pytest.mark.parametrize("depth", [0.5, 0.8, 2.0])
def test_line_of_varying_amplitude_is_neither(depth):
    rng = np.random.default_rng(4)
    swell = 1.0 + depth * np.sin(2.0 * np.pi * T / 50.0)
    y = add_noise(rng, 0.3 * swell * np.sin(2.0 * np.pi * 13.0 * T + 1.0))
    found = compare_wandering_line_with_resonance(y, RATE_HZ, Narrowband(0.2, 13.0, 0.02))
    assert found is not None
    assert found.is_modulated


@pytest.mark.parametrize("seed", range(2))
def test_line_whose_frequency_rises_linearly_is_a_sweep(seed):
    rng = np.random.default_rng(seed)
    y = add_noise(rng, 0.5 * np.sin(2.0 * np.pi * (12.0 * T + 0.5 * 2.0 * T**2 / T[-1])))
    found = compare_wandering_line_with_resonance(y, RATE_HZ, Narrowband(0.35, 13.0, 2.0))
    assert found is not None
    assert found.is_sweep


def test_short_series_is_not_compared():
    rng = np.random.default_rng(5)
    assert compare_wandering_line_with_resonance(rng.standard_normal(64), RATE_HZ, Narrowband(0.2, 49.99, 0.02)) is None


@pytest.mark.parametrize("amplitude", [0.15, 0.4, 4.0])
def test_white_noise_remains_where_the_line_was(amplitude):
    rng = np.random.default_rng(6)
    y = add_noise(rng, draw_wandering(rng, amplitude, 0.2, 40.0))
    line = WanderingLine(amplitude=amplitude, frequency=13.0, frequency_deviation=0.2, correlation_time=40.0)
    rest = y - draw_wandering_line(y, RATE_HZ, line, rng)
    f_hz = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    power = np.abs(np.fft.rfft(rest)) ** 2 / n
    for centre_hz in (12.5, 12.8, 13.0, 13.2, 13.5):
        near = np.abs(f_hz - centre_hz) < 0.1  # 240 frequencies, which know the power to 6.5 %
        assert power[near].mean() == pytest.approx(1.0, abs=0.26)


def test_band_is_put_back_where_it_was():
    rng = np.random.default_rng(7)
    y = np.sin(2.0 * np.pi * 13.01 * T) + 0.01 * rng.standard_normal(n)
    band = extract_band(y, RATE_HZ, 13.0, 1.0)
    assert band is not None
    assert np.abs(band.z[100:-100]).mean() == pytest.approx(np.sqrt(band.power_per_square), rel=0.01)
    np.testing.assert_allclose(expand_band(band, band.z, n)[500:-500], y[500:-500], atol=0.06)
