"""Simulated biases that depend on temperature, generated independently of the code under test."""

from dataclasses import replace

import numpy as np

from drivers.data_types import Floats
from monitor.drift.thermal.interval_means import IntervalMeans

HOUR_S = 3600.0
BIAS_SLOPE = 2e-5  # rad/s per °C


def simulate_temperature(hours: int, rng: np.random.Generator, swing_c: float = 3.0) -> Floats:
    """Return temperature in °C per minute, from 48 h before until ``hours``: a daily cycle and slow variations."""
    minutes = np.arange(-48 * 60, hours * 60)
    clouds = np.zeros(minutes.size)
    keep = np.exp(-1.0 / 180.0)
    draws = 0.05 * swing_c * (1.0 - keep**2) ** 0.5 * rng.standard_normal(minutes.size)
    for k in range(1, minutes.size):
        clouds[k] = keep * clouds[k - 1] + draws[k]
    daily = 0.5 * swing_c * np.sin(2.0 * np.pi * minutes / 1440.0 + rng.uniform(0.0, 2.0 * np.pi))
    return np.asarray(26.5 + daily + clouds)


def apply_lag(temperature_c: Floats, lag_h: float) -> Floats:
    """Return the temperature after a first-order lag of ``lag_h`` hours."""
    if lag_h == 0.0:
        return temperature_c
    out, keep = np.empty(temperature_c.size), np.exp(-1.0 / (60.0 * lag_h))
    level = float(temperature_c[0])
    for k, now in enumerate(temperature_c.tolist()):
        level = keep * level + (1.0 - keep) * now
        out[k] = level
    return out


def select_first_intervals(means: IntervalMeans, n: int) -> IntervalMeans:
    return replace(means, bias=means.bias[:n], error=means.error[:n], temperature_c=means.temperature_c[:n])


def simulate_hourly_means(seed: int, lag_h: float, noise: float, hours: int = 72) -> IntervalMeans:
    """Return hourly means with noise of ``noise`` times the range of the bias."""
    rng = np.random.default_rng(seed)
    temperature_c = simulate_temperature(hours, rng)
    bias = BIAS_SLOPE * apply_lag(temperature_c, lag_h)[-60 * hours :].reshape(hours, 60).mean(axis=1)
    error = noise * np.ptp(bias)
    return IntervalMeans(
        HOUR_S,
        bias + error * rng.standard_normal(hours),
        np.full(hours, error),
        temperature_c[-60 * hours :].reshape(hours, 60).mean(axis=1),
    )
