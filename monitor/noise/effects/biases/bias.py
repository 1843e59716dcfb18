"""Constant bias."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from monitor.noise.effect import Source, StatelessSeries, parameter_field
from monitor.noise.spectrum import Spectrum, zero_spectrum


@dataclass(frozen=True, slots=True)
class Bias(Source):
    """Constant bias. Its Allan variance and its spectrum are zero. Gravity on an accelerometer axis is simulated as a
    bias.

    >>> Bias(value=9.8).spectrum(0.01).level
    9.8
    """

    value: float = parameter_field("rad/s", "m/s²", signed=True)

    description: ClassVar[str] = "The sensor reads a constant value when the true value is zero."

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return a spectrum that has only a constant level."""
        return replace(zero_spectrum(tau0_s), level=self.value)

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> StatelessSeries:
        """Return a constant series."""
        return StatelessSeries(lambda values, block: np.add(values, self.value, out=values))
