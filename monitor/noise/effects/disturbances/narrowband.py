"""Narrowband noise: a resonance driven by white noise."""

from dataclasses import dataclass, replace
from math import pi
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.common.compiled import compiled
from monitor.noise.effect import RunningSource, SampleBlockContext, Source, parameter_field
from monitor.noise.gauss_markov_avar_and_spectrum import gauss_markov_spectrum
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class Narrowband(Source):
    """White noise after a second-order resonance of frequency f and bandwidth Δ.

    The autocovariance is σ² exp(−πΔ|t|) cos 2πft. The series is the real part of the complex process z ← φz + w with φ
    = exp((−πΔ + 2πif)τ0). The spectrum has two Lorentzian peaks at ±f with the full width Δ at half power. Allan
    variance and spectrum are exact for samples.

    >>> hum = Narrowband(sigma=1.0, frequency=20.0, bandwidth=1.0)
    >>> peak, half = hum.two_sided_psd(np.array([20.0, 20.5]), 1e-4)
    >>> print(f"{half / peak:.3f}")
    0.500
    """

    sigma: float = parameter_field("rad/s", "m/s²")
    frequency: float = parameter_field("Hz", positive=True, below_nyquist=True)
    bandwidth: float = parameter_field("Hz", positive=True)

    description: ClassVar[str] = "A resonance near the sensor adds an oscillation with a randomly varying amplitude."

    @property
    def _decay(self) -> complex:
        """Complex decay rate 1/T_c − iω in 1/s."""
        return pi * self.bandwidth - 2j * pi * self.frequency

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return the spectrum and the Allan variance in closed form."""
        peaks = ((self.frequency, self.bandwidth),)
        return replace(gauss_markov_spectrum(self.sigma, self._decay, tau0_s), peaks=peaks)

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a stationary series."""
        return start_resonance(self.sigma, self._decay / rate_hz, rng)


def start_resonance(sigma: float, step: complex, rng: np.random.Generator) -> RunningSource:
    """Start a stationary series of the real part of the process z ← φz + w.

    Parameters
    ----------
    sigma : float
        Standard deviation of the series.
    step : complex
        Complex decay −ln φ per sample.
    rng : numpy.random.Generator
        Random generator of the effect.
    """
    phi = np.exp(-step)
    drive = sigma * float(np.sqrt(-np.expm1(-2.0 * step.real)))
    x, y = sigma * rng.standard_normal(2)

    def add_resonance(values: Floats, block: SampleBlockContext) -> None:
        nonlocal x, y
        white = rng.standard_normal((values.size, 2))
        x, y = _add_resonance(values, white, float(phi.real), float(phi.imag), drive, x, y)

    return RunningSource(add_resonance)


@compiled
def _add_resonance(
    values: Floats, white: Floats, c: float, s: float, drive: float, x: float, y: float
) -> tuple[float, float]:
    for k in range(values.size):
        values[k] += x
        x, y = c * x - s * y + drive * white[k, 0], s * x + c * y + drive * white[k, 1]
    return x, y
