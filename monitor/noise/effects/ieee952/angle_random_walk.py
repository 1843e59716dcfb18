"""Angle random walk N of a gyroscope, or velocity random walk of an accelerometer."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import RunningSource, SampleBlockContext, Source, parameter_field
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class AngleRandomWalk(Source):
    """White noise of the rate, with S(f) = N² and σ²(τ) = N²/τ (IEEE Std 952 eq. C.18–C.19).

    >>> print(f"{AngleRandomWalk(N=1.5e-4).avar(np.array([9.0]), 0.01)[0]:.6g}")
    2.5e-09
    """

    N: float = parameter_field("rad/√s", "m/s/√s")

    description: ClassVar[str] = (
        "The rate contains white noise, so the error of a mean decreases with the square root of the averaging time."
    )

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return the spectrum N² and the Allan variance N²/τ."""
        return Spectrum(lambda f: np.full_like(f, self.N**2), lambda tau: self.N**2 / tau, tau0_s)

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a series of independent samples with the standard deviation N √rate."""

        def add_white_noise(values: Floats, block: SampleBlockContext) -> None:
            white = rng.standard_normal(out=block.scratch)
            white *= self.N * rate_hz**0.5
            values += white

        return RunningSource(add_white_noise)
