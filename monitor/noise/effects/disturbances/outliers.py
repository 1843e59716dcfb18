"""Outliers: single samples with a large error."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import RunningSource, SampleBlockContext, Source, parameter_field
from monitor.noise.random_events import RandomEvents
from monitor.noise.spectrum import Spectrum, white_noise_spectrum


@dataclass(frozen=True, slots=True)
class Outliers(Source):
    """Additional Gaussian error of standard deviation s on a fraction p of the samples (Tukey's contaminated noise).

    The power spectral density is S(f) = p s² τ0, and the Allan variance is σ²(τ) = p s² τ0/τ.

    >>> print(f"{Outliers(fraction=1e-4, scale=0.1).avar(np.array([1.0]), 0.01)[0]:.6g}")
    1e-08
    """

    fraction: float = parameter_field("1", maximum=1.0)
    scale: float = parameter_field("rad/s", "m/s²")

    description: ClassVar[str] = "Individual samples deviate strongly from the samples before and after them."

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return the spectrum of white noise with the same mean square as the errors."""
        return white_noise_spectrum(self.fraction * self.scale**2, tau0_s)

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a series of outliers with geometrically distributed gaps."""

        def draw_gaps(n: int) -> Floats:
            return rng.geometric(self.fraction, n).astype(np.float64) if self.fraction else np.full(n, np.inf)

        events = RandomEvents(draw_gaps, lambda n: self.scale * rng.standard_normal(n), rate_hz, before=-1.0)

        def add_errors(values: Floats, block: SampleBlockContext) -> None:
            when, errors = events.take_block_events(block.first, values.size)
            values[when] += errors

        return RunningSource(add_errors, lambda: events.drawn_random_values("errors"))
