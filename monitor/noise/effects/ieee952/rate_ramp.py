"""Rate ramp R: constant slope of the bias."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import RunningSource, SampleBlockContext, Source, parameter_field
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class RateRamp(Source):
    """Constant slope of the rate, with σ²(τ) = R²τ²/2 (IEEE Std 952 eq. C.32). A ramp has no spectrum.

    >>> float(RateRamp(R=2e-6).avar(np.array([1000.0]), 0.01)[0])
    2e-06
    """

    R: float = parameter_field("rad/s²", "m/s³")

    description: ClassVar[str] = "The bias changes at a constant rate, for example while a sensor warms up."

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return a spectrum with zero density that contains only the slope of the ramp."""
        return Spectrum(np.zeros_like, lambda tau: 0.5 * (self.R * tau) ** 2, tau0_s, slope=self.R)

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a ramp at zero."""
        count = 0

        def add_ramp(values: Floats, block: SampleBlockContext) -> None:
            nonlocal count
            values += self.R / rate_hz * np.arange(count, count + values.size, dtype=np.float64)
            count += values.size

        return RunningSource(add_ramp)
