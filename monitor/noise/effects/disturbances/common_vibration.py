"""Vibration of one environmental source that several axes share."""

from dataclasses import dataclass, replace
from math import pi
from typing import ClassVar

import numpy as np

from monitor.noise.effect import RunningSource, Source, parameter_field
from monitor.noise.effects.disturbances.narrowband import start_resonance
from monitor.noise.gauss_markov_avar_and_spectrum import gauss_markov_spectrum
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class CommonVibration(Source):
    """Noise of a source that acts on each axis with a gain of its own.

    Axes with the same ``source_number`` share the random numbers. The spectrum on one axis is the spectrum of
    ``Narrowband`` with the standard deviation ``gain``. Without a frequency, the spectrum is a low-pass spectrum with
    half power at Δ/2.

    >>> vibration = CommonVibration(source_number=1, gain=-1.0, bandwidth=1.0)
    >>> low, half = vibration.two_sided_psd(np.array([1e-3, 0.5]), 1e-4)
    >>> print(f"{half / low:.3f}")
    0.500
    """

    source_number: float = parameter_field("1", positive=True, whole_number=True)
    gain: float = parameter_field("rad/s", "m/s²", signed=True)
    bandwidth: float = parameter_field("Hz", positive=True)
    frequency: float | None = parameter_field("Hz", positive=True, below_nyquist=True, optional=True)

    description: ClassVar[str] = "A vibration of the environment acts on several axes at the same time."

    @property
    def _decay(self) -> complex:
        """Complex decay rate 1/T_c − iω in 1/s."""
        return pi * self.bandwidth - 2j * pi * (self.frequency or 0.0)

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return the spectrum and the Allan variance in closed form."""
        peaks = () if self.frequency is None else ((self.frequency, self.bandwidth),)
        return replace(gauss_markov_spectrum(self.gain, self._decay, tau0_s), peaks=peaks)

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a stationary series."""
        return start_resonance(self.gain, self._decay / rate_hz, rng)
