"""Sinusoidal noise, for example from a motor, the mains or a fan."""

from dataclasses import dataclass
from math import cos, floor, pi, sin
from typing import ClassVar, Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.compiled import compiled
from monitor.noise.effect import RunningSource, SampleBlockContext, Source, parameter_field
from monitor.noise.spectrum import Spectrum, allan_variance_of_line

RENEWAL_SAMPLES: Final = 64
"""Number of samples after which the sinusoid is computed exactly, which limits the rounding error."""


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

    description: ClassVar[str] = "A steady oscillation adds a line to the spectrum and waves to the Allan deviation."

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return a spectrum with one line and no density."""
        line = self.frequency, 0.5 * self.amplitude**2
        return Spectrum(np.zeros_like, lambda tau: allan_variance_of_line(*line, tau, tau0_s), tau0_s, lines=(line,))

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a sinusoid. The time is relative to the first sample of the stream."""
        phase = float(rng.uniform(0.0, 2.0 * pi)) if self.phase is None else self.phase

        def add_sinusoid(values: Floats, block: SampleBlockContext) -> None:
            _add_sinusoid(values, block.first, self.amplitude, self.frequency / rate_hz, phase)

        return RunningSource(add_sinusoid, lambda: {"phase": phase} if self.phase is None else {})


@compiled
def _add_sinusoid(values: Floats, first: int, amplitude: float, step: float, phase: float) -> None:
    """Add A sin(2π·step·k + phase) for k ≥ first. ``step`` is in cycles per sample."""
    c, s = cos(2.0 * pi * step), sin(2.0 * pi * step)
    k = first - first % RENEWAL_SAMPLES
    while k < first + values.size:
        cycles = step * k
        angle = 2.0 * pi * (cycles - floor(cycles)) + phase
        x, y = amplitude * cos(angle), amplitude * sin(angle)
        for i in range(k, min(k + RENEWAL_SAMPLES, first + values.size)):
            if i >= first:
                values[i - first] += y
            x, y = c * x - s * y, s * x + c * y
        k += RENEWAL_SAMPLES
