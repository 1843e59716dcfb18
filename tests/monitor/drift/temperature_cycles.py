"""Simulated interval means of biases in a temperature chamber, and of noise that is independent of temperature."""

from typing import Final

import numpy as np
from scipy.signal import lfilter

from drivers.data_types import Floats
from monitor.drift.thermal.interval_means import IntervalMeans

COLDEST_C: Final = -18.0
HOTTEST_C: Final = 74.0
SHAPES: Final = ("ramp", "steps", "sine", "chamber", "heating")
NOISES: Final = ("white", "random walk", "strong random walk", "flicker", "Gauss-Markov", "smooth random walk")
POINTS_PER_INTERVAL: Final = 20
"""Number of points per interval."""


def make_temperature_cycle(shape: str, n: int) -> Floats:
    """Return the temperature [n] of a cycle in °C; "heating" only rises, and "chamber" starts and ends at 25 °C."""
    u = np.arange(n) / n
    if shape == "ramp":
        level = 1.0 - np.abs(2.0 * u - 1.0)
    elif shape == "steps":
        step = np.floor(16.0 * u)
        keep = np.exp(-1.0 / (0.008 * n))
        level = lfilter([1.0 - keep], [1.0, -keep], np.where(step < 8, step, 15.0 - step) / 7.0)
    elif shape == "sine":
        level = 0.5 - 0.5 * np.cos(2.0 * np.pi * u)
    elif shape == "chamber":
        return np.interp(u, [0.0, 0.27, 0.3, 0.78, 0.82, 1.0], [25.0, HOTTEST_C, HOTTEST_C, COLDEST_C, COLDEST_C, 25.0])
    else:
        level = u
    return np.asarray(COLDEST_C + (HOTTEST_C - COLDEST_C) * level)


def simulate_noise_means(kind: str, n: int, rng: np.random.Generator) -> Floats:
    """Return noise [n] of interval means with white noise of deviation 1 ("smooth random walk": 0.1)."""
    e = rng.standard_normal(n * POINTS_PER_INTERVAL) / POINTS_PER_INTERVAL**0.5
    slow = np.zeros(n * POINTS_PER_INTERVAL)
    if kind == "random walk":
        slow = 0.3 * e.cumsum()
    elif kind == "strong random walk":
        slow = 3.0 * e.cumsum()
    elif kind == "smooth random walk":
        keep = np.exp(-1.0 / (3 * POINTS_PER_INTERVAL))
        slow = lfilter([1.0 - keep], [1.0, -keep], e).cumsum()
    elif kind == "Gauss-Markov":
        slow = lfilter([1.0], [1.0, -np.exp(-1.0 / (10 * POINTS_PER_INTERVAL))], e)
    elif kind == "flicker":
        k = np.arange(1, n * POINTS_PER_INTERVAL)
        response = np.concatenate([[1.0], np.cumprod((k - 0.5) / k)])  # Kasdin, Proc. IEEE 83(5), 1995
        slow = np.fft.irfft(np.fft.rfft(response, 2 * e.size) * np.fft.rfft(e * POINTS_PER_INTERVAL**0.5, 2 * e.size))[
            : e.size
        ]
    white = 0.1 if kind == "smooth random walk" else 1.0
    return np.asarray(white * rng.standard_normal(n) + slow.reshape(n, POINTS_PER_INTERVAL).mean(axis=1))


def simulate_chamber_means(shape: str, noise: Floats, law: str = "none", size: float = 0.0) -> IntervalMeans:
    """Return means of 120 s of noise [n] and of a bias that depends on temperature.

    ``law`` is "none", or "linear" or "cubic" with a bias of deviation ``size``, or "loop", "lag" or "play" with a
    largest difference of ``size`` between heating and cooling.
    """
    n = noise.size
    temperature_c = make_temperature_cycle(shape, n * POINTS_PER_INTERVAL)
    x = (temperature_c - COLDEST_C) / (HOTTEST_C - COLDEST_C)
    bias = np.zeros(x.size)
    if law in ("linear", "cubic"):
        bias = x if law == "linear" else 4.0 * (x - 0.5) ** 3 + 0.5 * (x - 0.5) + 0.3 * (x - 0.5) ** 2
        bias = size * bias / bias.std()
    elif law != "none":
        bias = compute_hysteresis_bias(law, x)
        bias = size * bias / compute_hysteresis_width(bias, x)
    interval = (n, POINTS_PER_INTERVAL)
    mean_temperature_c = temperature_c.reshape(interval).mean(axis=1)
    return IntervalMeans(120.0, noise + bias.reshape(interval).mean(axis=1), np.ones(n), mean_temperature_c)


def compute_hysteresis_bias(law: str, x: Floats) -> Floats:
    """Return a bias that differs between heating and cooling."""
    if law == "loop":
        return np.asarray(np.where(is_rising(x), 1.0, -1.0) * x * (1.0 - x))
    if law == "lag":
        keep = np.exp(-1.0 / (2.0 * POINTS_PER_INTERVAL))
        return np.asarray(lfilter([1.0 - keep], [1.0, -keep], x - x[0]) + x[0])
    out, level = np.empty(x.size), float(x[0])
    for i, value in enumerate(x.tolist()):
        level = min(max(level, value - 0.1), value + 0.1)
        out[i] = level
    return out


def is_rising(x: Floats) -> np.ndarray:
    """Return True where the last change of a noise-free temperature was a rise."""
    sign = np.sign(np.round(np.diff(x, prepend=x[0]), 9))
    last = np.maximum.accumulate(np.where(sign != 0.0, np.arange(x.size), 0))
    return np.asarray(sign[last] >= 0.0)


def compute_hysteresis_width(bias: Floats, x: Floats) -> float:
    """Return the largest difference between heating and cooling in narrow temperature bins."""
    rising, bin_index = is_rising(x), np.clip((40.0 * x).astype(int), 0, 39)
    differences = [
        abs(bias[rising & (bin_index == k)].mean() - bias[~rising & (bin_index == k)].mean())
        for k in range(2, 38)
        if (rising & (bin_index == k)).any() and (~rising & (bin_index == k)).any()
    ]
    return float(max(differences))
