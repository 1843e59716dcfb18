"""Constant bias."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from monitor.noise.effect import RunningSource, Source, parameter_field
from monitor.noise.spectrum import Spectrum, zero_spectrum


@dataclass(frozen=True, slots=True)
class ConstantBias(Source):
    """Constant bias, which also represents gravity on an accelerometer axis. Allan variance and spectrum are zero.

    >>> ConstantBias(value=9.8).spectrum(0.01).level
    9.8
    """

    value: float = parameter_field("rad/s", "m/s²", signed=True)

    description: ClassVar[str] = "The sensor reads a constant offset when the true value is zero."

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return a spectrum with a constant bias and no noise."""
        return replace(zero_spectrum(tau0_s), level=self.value)

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a constant series."""
        return RunningSource(lambda values, block: np.add(values, self.value, out=values))
