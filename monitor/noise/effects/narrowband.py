"""Narrowband noise: a resonance driven by white noise."""

from dataclasses import dataclass, replace
from math import pi
from typing import ClassVar

import numpy as np

from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.noise import gauss_markov
from monitor.noise.effect import NoiseSeries, SampleBlockContext, Source, check_below_nyquist, parameter
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class Narrowband(Source):
    """White noise through a second-order resonance: autocovariance σ² exp(−πΔ|t|) cos 2πft, Δ the full width.

    The series is the real part of complex first-order noise: z ← φz + w, φ = exp((−πΔ + 2πif)τ0). S(f) is therefore a
    pair of Lorentzian lines at ±f with full width Δ at half power. σ²(τ) is the real part of the closed form of
    exponentially correlated noise with this φ. Both are exact for the samples.

    >>> hum = Narrowband(sigma=1.0, frequency=20.0, bandwidth=1.0)
    >>> peak, half = hum.psd(np.array([20.0, 20.5]), 1e-4)
    >>> print(f"{half / peak:.3f}")
    0.500
    """

    sigma: float = parameter("rad/s", "m/s²")
    frequency: float = parameter("Hz", "Hz", positive=True)
    bandwidth: float = parameter("Hz", "Hz", positive=True)

    name: ClassVar[str] = "narrowband"
    description: ClassVar[str] = "Something near rings at its own frequency, with an amplitude that comes and goes."

    def check_rate(self, rate_hz: float) -> None:
        """Raise ConfigError if the frequency is not below half the sample rate."""
        check_below_nyquist(self, "frequency", rate_hz)

    @property
    def _decay(self) -> complex:
        """Return 1/T_c − iω of the complex process, 1/s."""
        return pi * self.bandwidth - 2j * pi * self.frequency

    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """Return the Allan variance by the closed form of ``gauss_markov`` with a complex φ."""
        return gauss_markov.avar(self.sigma, self._decay, tau_s, tau0_s)

    def psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """Return σ²τ0 Re{(1 − φ²)/(1 − 2φ cos 2πfτ0 + φ²)}."""
        return gauss_markov.psd(self.sigma, self._decay, f_hz, tau0_s)

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return the spectrum with the position of its peak, which refines the grid of the integral."""
        return replace(Source.spectrum(self, tau0_s), peaks=((self.frequency, self.bandwidth),))

    def start(self, rate_hz: float, rng: np.random.Generator) -> "_Ringing":
        """Return a stationary series."""
        return _Ringing(self.sigma, self._decay / rate_hz, rng)


class _Ringing(NoiseSeries):
    """Series of the real part of complex first-order noise."""

    def __init__(self, sigma: float, step: complex, rng: np.random.Generator) -> None:
        self._rng = rng
        phi = np.exp(-step)
        self._cos, self._sin = float(phi.real), float(phi.imag)
        self._drive = sigma * float(np.sqrt(-np.expm1(-2.0 * step.real)))
        self._x, self._y = sigma * rng.standard_normal(2)

    def add(self, values: Floats, block: SampleBlockContext) -> None:
        white = self._rng.standard_normal((values.size, 2))
        self._x, self._y = _add_resonance(values, white, self._cos, self._sin, self._drive, self._x, self._y)


@compiled
def _add_resonance(values, white, c, s, drive, x, y):  # type: ignore[no-untyped-def]
    """Add x of the rotating pair (x, y) to the values [n], and return the pair."""
    for k in range(values.size):
        values[k] += x
        x, y = c * x - s * y + drive * white[k, 0], s * x + c * y + drive * white[k, 1]
    return x, y
