"""Biases that follow temperature, drawn apart from the room under test: heat flows minute by minute."""

from dataclasses import replace

import numpy as np

from drivers.data_types import Floats
from monitor.drift.thermal.interval_means import IntervalMeans

HOUR_S = 3600.0
COEFFICIENT = 2e-5  # rad/s per °C


def weather(hours: int, rng: np.random.Generator, swing_c: float = 3.0) -> Floats:
    """Temperature of two days before and of ``hours``, °C by the minute: a daily swing and what clouds do."""
    minutes = np.arange(-48 * 60, hours * 60)
    clouds = np.zeros(minutes.size)
    keep = np.exp(-1.0 / 180.0)
    draws = 0.05 * swing_c * (1.0 - keep**2) ** 0.5 * rng.standard_normal(minutes.size)
    for k in range(1, minutes.size):
        clouds[k] = keep * clouds[k - 1] + draws[k]
    daily = 0.5 * swing_c * np.sin(2.0 * np.pi * minutes / 1440.0 + rng.uniform(0.0, 2.0 * np.pi))
    return np.asarray(26.5 + daily + clouds)


def late(temperature_c: Floats, lag_h: float) -> Floats:
    """What is ``lag_h`` behind."""
    if lag_h == 0.0:
        return temperature_c
    out, keep = np.empty(temperature_c.size), np.exp(-1.0 / (60.0 * lag_h))
    level = float(temperature_c[0])
    for k, now in enumerate(temperature_c.tolist()):
        level = keep * level + (1.0 - keep) * now
        out[k] = level
    return out


def first_intervals(means: IntervalMeans, n: int) -> IntervalMeans:
    return replace(means, bias=means.bias[:n], error=means.error[:n], temperature_c=means.temperature_c[:n])


def hourly(seed: int, lag_h: float, noise: float, hours: int = 72) -> IntervalMeans:
    """Means of the hour; ``noise`` of them over the swing of the bias."""
    rng = np.random.default_rng(seed)
    warmth = weather(hours, rng)
    bias = COEFFICIENT * late(warmth, lag_h)[-60 * hours :].reshape(hours, 60).mean(axis=1)
    error = noise * np.ptp(bias)
    return IntervalMeans(
        HOUR_S,
        bias + error * rng.standard_normal(hours),
        np.full(hours, error),
        warmth[-60 * hours :].reshape(hours, 60).mean(axis=1),
    )
