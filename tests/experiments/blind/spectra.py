"""Spectra in closed form, and the transform in which noise of such a spectrum is independent, coefficient by
coefficient.

An axis is taken as its orthonormal DCT-II; coefficient k has the variance S(f_k)/τ0 at f_k = k·fs/2n. White noise
and random walk are diagonal exactly, others nearly. Densities are two-sided, of samples.
"""

from collections.abc import Callable, Iterable
from typing import Any, Final

import numpy as np
from scipy.fft import dct, rfft

from tests.experiments.blind.processes import Floats
from tests.experiments.blind.world import Effect


def density(effects: Iterable[Effect], f_hz: Floats, rate_hz: float) -> Floats:
    """Two-sided S(f) of samples, of all that is Gaussian on an axis; what is known in advance counts nothing."""
    tau0 = 1.0 / rate_hz
    total = np.zeros_like(f_hz)
    effects = tuple(effects)
    for effect in effects:
        if effect.name in SHAPES:
            total += SHAPES[effect.name](f_hz, tau0, **effect.parameters)
    for effect in effects:
        if effect.name == "scale_factor":
            total *= effect.parameters["factor"] ** 2
        elif effect.name == "bandwidth_limit":
            corner = np.tan(np.pi * effect.parameters["cutoff"] * tau0)
            with np.errstate(over="ignore"):
                total /= 1.0 + (np.tan(np.pi * f_hz * tau0) / corner) ** (2 * effect.parameters["order"])
            total += effect.parameters.get("floor", 0.0) ** 2
        elif effect.name == "resolution":
            total += effect.parameters["step"] ** 2 * tau0 / 12.0
    return total


def _decaying(f_hz: Floats, tau0: float, variance: float, phi: complex) -> Floats:
    """Autocovariance variance·Re φ^|k|, summed."""
    z = np.exp(-2j * np.pi * f_hz * tau0)
    rotations = [0.5 * (1.0 / (1.0 - p * z) + 1.0 / (1.0 - p / z) - 1.0) for p in (phi, np.conj(phi))]
    return np.asarray(variance * tau0 * (rotations[0] + rotations[1]).real)


def _wandering(
    f_hz: Floats,
    tau0: float,
    amplitude: float,
    frequency: float,
    frequency_deviation: float,
    correlation_time: float,
    phase: float = 0.0,
) -> Floats:
    """Kubo's autocovariance of an oscillation whose phase is the integral of correlated noise, summed at all lags."""
    n = round(0.5 / (tau0 * float(f_hz[1] - f_hz[0])))
    lag = np.arange(n) * tau0
    x, index = lag / correlation_time, (2.0 * np.pi * frequency_deviation * correlation_time) ** 2
    r = 0.5 * amplitude**2 * np.cos(2.0 * np.pi * frequency * lag) * np.exp(-index * (np.expm1(-x) + x))
    summed = tau0 * (2.0 * rfft(r, 2 * n).real - r[0])
    return np.asarray(np.interp(f_hz, np.arange(summed.size) / (2.0 * n * tau0), np.maximum(summed, 0.0)))


SHAPES: Final[dict[str, Callable[..., Any]]] = {
    "quantization_noise": lambda f, tau0, Q: 4.0 * Q**2 / tau0 * np.sin(np.pi * f * tau0) ** 2,
    "angle_random_walk": lambda f, tau0, N: N**2 * np.ones_like(f),
    "bias_instability": lambda f, tau0, B: B**2 / (2.0 * np.pi * f),
    "rate_random_walk": lambda f, tau0, K: (K * tau0 / (2.0 * np.sin(np.pi * f * tau0))) ** 2,
    "exponentially_correlated": lambda f, tau0, sigma, correlation_time: _decaying(
        f, tau0, sigma**2, np.exp(-tau0 / correlation_time)
    ),
    "narrowband": lambda f, tau0, sigma, frequency, bandwidth: _decaying(
        f, tau0, sigma**2, np.exp((-bandwidth + 2j * frequency) * np.pi * tau0)
    ),
    "wandering_line": _wandering,
    "power_law": lambda f, tau0, density, exponent: (
        density**2 * (np.sin(np.pi * f * tau0) / (np.pi * tau0)) ** -exponent
    ),
    "random_telegraph": lambda f, tau0, amplitude, dwell_time: _decaying(
        f, tau0, 0.25 * amplitude**2, np.exp(-2.0 * tau0 / dwell_time)
    ),
    "outliers": lambda f, tau0, fraction, scale: fraction * scale**2 * tau0 * np.ones_like(f),
    "poisson_steps": lambda f, tau0, rate, height: rate * (height * tau0 / (2.0 * np.sin(np.pi * f * tau0))) ** 2,
}


def coefficients(values: Floats) -> Floats:
    """[n − 1] without the mean."""
    return np.asarray(dct(values, norm="ortho")[1:])


def frequencies(n: int, rate_hz: float) -> Floats:
    """[n − 1] Hz."""
    return np.asarray(np.arange(1, n) * (rate_hz / (2.0 * n)))


def log_likelihood(y: Floats, variance: Floats) -> float:
    """Whittle's, without its constant."""
    return float(-0.5 * np.sum(np.log(variance) + y**2 / variance))
