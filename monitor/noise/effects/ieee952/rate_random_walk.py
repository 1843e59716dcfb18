"""Rate random walk K: integrated white noise of the rate."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import RunningSource, SampleBlockContext, Source, parameter_field
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class RateRandomWalk(Source):
    """Sampled integrated white noise (IEEE Std 952 eq. C.28–C.29).

    The power spectral density is S(f) = K²τ0²/(4 sin²(πfτ0)). The Allan variance is σ²(τ) = K²τ/3 · (1 + 1/(2m²)) with
    m = τ/τ0. The continuous process has S(f) = K²/(2πf)² and σ²(τ) = K²τ/3.

    >>> print(f"{RateRandomWalk(K=3e-6).avar(np.array([1e4]), 0.01)[0]:.6g}")
    3e-08
    """

    K: float = parameter_field("rad/s/√s", "m/s²/√s")

    description: ClassVar[str] = "The bias takes independent random steps, so the error grows with the averaging time."

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return the spectrum and the Allan variance of the samples."""
        return Spectrum(
            lambda f: (0.5 * self.K * tau0_s / np.sin(np.pi * f * tau0_s)) ** 2,
            lambda tau: self.K**2 / 3.0 * (tau + 0.5 * tau0_s**2 / tau),
            tau0_s,
        )

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a random walk at zero."""
        level = 0.0

        def add_random_walk(values: Floats, block: SampleBlockContext) -> None:
            nonlocal level
            steps = rng.standard_normal(out=block.scratch)
            steps *= self.K / rate_hz**0.5
            steps[0] += level  # the sum does not depend on the division into blocks
            values += np.cumsum(steps, out=steps)
            level = float(steps[-1])

        return RunningSource(add_random_walk)
