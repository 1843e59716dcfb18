"""Resolution of the output: rounding to multiples of the least significant bit."""

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import RunningTransform, Transform, parameter_field
from monitor.noise.spectrum import Spectrum, nan_spectrum, white_noise_spectrum

MIN_DEVIATION_STEPS: Final = 0.6
"""Minimum Allan deviation at τ0, in steps, for which the rounding error is white.

Harmonics of the rounding error are then below exp(−2π²·0.6²) = 8·10⁻⁴.
"""


@dataclass(frozen=True, slots=True)
class Resolution(Transform):
    """Rounding to whole steps.

    If the Allan deviation at τ0 is at least 0.6 steps, rounding adds white noise with a variance of step²/12 (Widrow &
    Kollár, Quantization Noise, 2008). With less noise, the output depends on the position of the rate between two
    steps, and the spectrum is NaN.

    >>> one = white_noise_spectrum(1.0, 0.01)
    >>> [round(float(Resolution(step=x).transform_spectrum(one).avar(np.array([1.0]))[0]), 6) for x in (1.2, 3.0)]
    [0.0112, nan]
    """

    step: float = parameter_field("rad/s", "m/s²", positive=True)

    description: ClassVar[str] = "The output changes in steps of one least significant bit."

    def transform_spectrum(self, spectrum: Spectrum) -> Spectrum:
        """Return the spectrum plus white noise of variance step²/12, or NaN if the Allan deviation is too small."""
        tau0_s = spectrum.tau0_s
        deviation = float(spectrum.avar(np.array([tau0_s]))[0]) ** 0.5
        return (
            spectrum + white_noise_spectrum(self.step**2 / 12.0, tau0_s)
            if deviation >= MIN_DEVIATION_STEPS * self.step
            else nan_spectrum(tau0_s)
        )

    def start_transform(self, rate_hz: float, rng: np.random.Generator) -> RunningTransform:
        """Start a rounding transform."""

        def round_to_steps(values: Floats) -> None:
            values /= self.step
            np.rint(values, out=values)
            values *= self.step

        return RunningTransform(round_to_steps)
