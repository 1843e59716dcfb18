"""Sinusoidal noise, for example from a motor, the mains or a fan."""

from dataclasses import dataclass
from math import pi
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import RunningSource, SampleBlockContext, Source, parameter_field
from monitor.noise.spectrum import Spectrum, allan_variance_of_line


@dataclass(frozen=True, slots=True)
class Sinusoidal(Source):
    """Sinusoid A sin(2πft + φ) (IEEE Std 952 annex C).

    The Allan variance is σ²(τ) = A² sin⁴(πfτ)/(m² sin²(πfτ0)) with m = τ/τ0. The spectrum consists of two lines of mean
    square A²/4 at ±f. If no phase is given, the phase is random.

    >>> line = Sinusoidal(amplitude=1.0, frequency=25.0)
    >>> [round(float(x), 6) for x in line.avar(np.array([0.01, 0.02, 0.04]), 0.01)]
    [0.5, 0.5, 0.0]
    """

    amplitude: float = parameter_field("rad/s", "m/s²")
    frequency: float = parameter_field("Hz", positive=True, below_nyquist=True)
    phase: float | None = parameter_field("rad", signed=True, optional=True)

    description: ClassVar[str] = (
        "A steady oscillation causes a line in the spectrum and ripples in the Allan deviation."
    )

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return a spectrum with one line and no density."""
        line = self.frequency, 0.5 * self.amplitude**2
        return Spectrum(np.zeros_like, lambda tau: allan_variance_of_line(*line, tau, tau0_s), tau0_s, lines=(line,))

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a sinusoid. The time is relative to the first sample of the stream."""
        phase = float(rng.uniform(0.0, 2.0 * pi)) if self.phase is None else self.phase

        def add_sinusoid(values: Floats, block: SampleBlockContext) -> None:
            cycles = self.frequency / rate_hz * np.arange(block.first, block.first + values.size)
            # whole cycles are removed to keep the rounding error small
            values += self.amplitude * np.sin(2.0 * pi * np.mod(cycles, 1.0) + phase)

        return RunningSource(add_sinusoid, lambda: {"phase": phase} if self.phase is None else {})
