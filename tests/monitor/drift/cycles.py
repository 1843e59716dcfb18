"""Interval means of biases in a temperature chamber, -18 … 74 °C, and of noise that does not know the temperature."""

from typing import Final

import numpy as np
from scipy.signal import lfilter

from drivers.data_types import Floats
from monitor.drift.thermal.interval_means import IntervalMeans

COLDEST_C: Final = -18.0
HOTTEST_C: Final = 74.0
SHAPES: Final = ("ramp", "steps", "sine", "chamber", "heating")
NOISES: Final = ("white", "random walk", "strong random walk", "flicker", "Gauss-Markov", "smooth random walk")
PARTS: Final = 20
"""Points of an interval."""


def cycle(shape: str, n: int) -> Floats:
    """Return the temperature [n] of one cycle in °C; "heating" goes one way, "chamber" starts and ends at 25 °C."""
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


def drift(kind: str, n: int, rng: np.random.Generator) -> Floats:
    """Return noise [n] of interval means, white part of deviation 1 included ("smooth random walk": 0.1)."""
    e = rng.standard_normal(n * PARTS) / PARTS**0.5
    slow = np.zeros(n * PARTS)
    if kind == "random walk":
        slow = 0.3 * e.cumsum()
    elif kind == "strong random walk":
        slow = 3.0 * e.cumsum()
    elif kind == "smooth random walk":
        keep = np.exp(-1.0 / (3 * PARTS))
        slow = lfilter([1.0 - keep], [1.0, -keep], e).cumsum()
    elif kind == "Gauss-Markov":
        slow = lfilter([1.0], [1.0, -np.exp(-1.0 / (10 * PARTS))], e)
    elif kind == "flicker":
        k = np.arange(1, n * PARTS)
        response = np.concatenate([[1.0], np.cumprod((k - 0.5) / k)])  # Kasdin, Proc. IEEE 83(5), 1995
        slow = np.fft.irfft(np.fft.rfft(response, 2 * e.size) * np.fft.rfft(e * PARTS**0.5, 2 * e.size))[: e.size]
    white = 0.1 if kind == "smooth random walk" else 1.0
    return np.asarray(white * rng.standard_normal(n) + slow.reshape(n, PARTS).mean(axis=1))


def chamber_means(shape: str, noise: Floats, law: str = "none", size: float = 0.0) -> IntervalMeans:
    """Return means of 120 s of noise [n] and of a bias that follows temperature.

    ``law``: "none"; "linear" or "cubic", of deviation ``size``; "loop", "lag" or "play", whose heating and cooling
    differ by up to ``size``.
    """
    n = noise.size
    temperature_c = cycle(shape, n * PARTS)
    x = (temperature_c - COLDEST_C) / (HOTTEST_C - COLDEST_C)
    bias = np.zeros(x.size)
    if law in ("linear", "cubic"):
        bias = x if law == "linear" else 4.0 * (x - 0.5) ** 3 + 0.5 * (x - 0.5) + 0.3 * (x - 0.5) ** 2
        bias = size * bias / bias.std()
    elif law != "none":
        bias = loop(law, x)
        bias = size * bias / opening(bias, x)
    interval = (n, PARTS)
    warmth = temperature_c.reshape(interval).mean(axis=1)
    return IntervalMeans(120.0, noise + bias.reshape(interval).mean(axis=1), np.ones(n), warmth)


def loop(law: str, x: Floats) -> Floats:
    """Return a bias that differs between heating and cooling."""
    if law == "loop":
        return np.asarray(np.where(rising(x), 1.0, -1.0) * x * (1.0 - x))
    if law == "lag":
        keep = np.exp(-1.0 / (2.0 * PARTS))
        return np.asarray(lfilter([1.0 - keep], [1.0, -keep], x - x[0]) + x[0])
    out, level = np.empty(x.size), float(x[0])
    for at, value in enumerate(x.tolist()):
        level = min(max(level, value - 0.1), value + 0.1)
        out[at] = level
    return out


def rising(x: Floats) -> np.ndarray:
    """Return whether temperature rose when it last moved, of a course without noise."""
    moved = np.sign(np.round(np.diff(x, prepend=x[0]), 9))
    last = np.maximum.accumulate(np.where(moved != 0.0, np.arange(x.size), 0))
    return np.asarray(moved[last] >= 0.0)


def opening(bias: Floats, x: Floats) -> float:
    """Return the largest difference between heating and cooling in narrow bins of temperature."""
    up, place = rising(x), np.clip((40.0 * x).astype(int), 0, 39)
    apart = [
        abs(bias[up & (place == at)].mean() - bias[~up & (place == at)].mean())
        for at in range(2, 38)
        if (up & (place == at)).any() and (~up & (place == at)).any()
    ]
    return float(max(apart))
