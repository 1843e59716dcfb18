"""Quantization noise Q: white noise of the angle."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import RunningSource, SampleBlockContext, Source, parameter_field
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class QuantizationNoise(Source):
    """White noise of the angle, with σ²(τ) = 3Q²/τ² and S(f) = 4Q²/τ0 sin²(πfτ0) (IEEE Std 952 eq. C.14–C.15).

    >>> print(f"{QuantizationNoise(Q=2e-6).avar(np.array([0.1]), 0.01)[0]:.6g}")
    1.2e-09
    """

    Q: float = parameter_field("rad", "m/s")

    description: ClassVar[str] = "Rounding of the angle adds noise that averages out faster than white noise."

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return the spectrum 4Q²/τ0 sin²(πfτ0) and the Allan variance 3Q²/τ²."""
        return Spectrum(
            lambda f: 4.0 * self.Q**2 / tau0_s * np.sin(np.pi * f * tau0_s) ** 2,
            lambda tau: 3.0 * self.Q**2 / tau**2,
            tau0_s,
        )

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a series of differences of white angle noise."""
        scale = self.Q * rate_hz
        last = scale * float(rng.standard_normal())  # last angle error, divided by the sample interval

        def add_differences(values: Floats, block: SampleBlockContext) -> None:
            nonlocal last
            angles = rng.standard_normal(out=block.scratch)
            angles *= scale
            values += angles
            values[0] -= last
            values[1:] -= angles[:-1]
            last = float(angles[-1])

        return RunningSource(add_differences)
