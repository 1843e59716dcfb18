"""Tests of the search for periodic pulses in white noise and of the distinction from other periodic shapes."""

import numpy as np
import pytest

from monitor.reconcile.likelihood.periodic_pulse_search import find_harmonic_series, find_pulse_delay, fit_pulses
from monitor.reconcile.likelihood.whitening import compute_periodogram

RATE_HZ, n = 100.0, 60_000
T = np.arange(n) / RATE_HZ
SAW = 2.0 * np.mod(T + 1e-9, 1.0) - 1.0


def draw_noise(seed):
    return np.random.default_rng(seed).standard_normal(n)


def make_pulses(period_s, width_s, delay_s=0.0):
    return (np.mod(T - delay_s + 1e-9, period_s) < width_s).astype(float)


def search_pulses(y):
    harmonics = find_harmonic_series(compute_periodogram(y), n, RATE_HZ)
    return harmonics, fit_pulses(y, RATE_HZ, harmonics)


@pytest.mark.parametrize(
    ("period_s", "width_s", "height"),
    [(1.0, 0.02, 0.5), (1.000_03, 0.02, 0.6), (0.5, 0.1, -0.2), (7.3, 0.3, 0.4), (0.2007, 0.05, 0.4)],
)
def test_period_and_width_of_pulses_are_found(period_s, width_s, height):
    harmonics, one = search_pulses(draw_noise(1) + height * make_pulses(period_s, width_s, 0.13))
    assert harmonics.gain > 25.0
    assert one.is_rectangular
    assert one.period_s == pytest.approx(period_s, rel=3e-5)
    assert one.width_s == pytest.approx(width_s, abs=0.02)


def test_white_noise_stays_below_the_threshold():
    gains = [find_harmonic_series(compute_periodogram(draw_noise(seed)), n, RATE_HZ).gain for seed in range(20)]
    assert max(gains) < np.log(n) + 8.0  # about 3 n independent sums, each beyond x with exp(−x)


@pytest.mark.parametrize(
    "shape", [SAW, SAW + 2.0 / np.pi * np.sin(2.0 * np.pi * T), make_pulses(1.0, 0.02) - make_pulses(1.0, 0.02, 0.5)]
)
def test_other_periodic_shapes_are_no_rectangle(shape):
    """A sawtooth without its first spectral line is not a rectangular wave either."""
    assert not search_pulses(draw_noise(2) + 0.6 * shape)[1].is_rectangular


@pytest.mark.parametrize("period_s", [1.0, 1.0003])
def test_delay_of_known_pulses_is_found(period_s):
    y = draw_noise(3) + 0.6 * make_pulses(period_s, 0.05, 0.37)
    assert find_pulse_delay(y, RATE_HZ, period_s, 0.05) == pytest.approx(0.37, abs=0.02)
