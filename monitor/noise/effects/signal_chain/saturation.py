"""Saturation at the limits of the measurement range."""

from dataclasses import dataclass, replace
from typing import ClassVar, Final

import numpy as np

from drivers.validation.number_ranges import HOUR_S
from monitor.noise.effect import RunningTransform, Transform, parameter_field
from monitor.noise.spectrum import Spectrum, nan_spectrum

OBSERVATION_S: Final = float(HOUR_S)
"""Time in seconds for which a signal must stay within the range to be unaffected."""
NOISE_SIGMAS: Final = 6.0
"""Number of standard deviations of the noise that must be within the range."""


@dataclass(frozen=True, slots=True)
class Saturation(Transform):
    """Clipping of the measurement at ±``limit``.

    The spectrum does not change if the signal stays within the range for one hour. Otherwise, the spectrum is NaN. The
    size of the signal is the sum of the bias, all sinusoids, the drift in one hour and six standard deviations of the
    noise.

    >>> from monitor.noise.spectrum import white_noise_spectrum
    >>> clipped = [Saturation(limit=x).transform_spectrum(white_noise_spectrum(1.0, 0.01)) for x in (10.0, 1.0)]
    >>> [float(spectrum.avar(np.array([1.0]))[0]) for spectrum in clipped]
    [0.01, nan]
    """

    limit: float = parameter_field("rad/s", "m/s²", positive=True)

    description: ClassVar[str] = "Values beyond the measurement range are replaced by the nearest limit of the range."

    def transform_spectrum(self, spectrum: Spectrum) -> Spectrum:
        """Return the spectrum unchanged if the signal stays within the range for one hour, otherwise NaN."""
        steady = abs(spectrum.level) + sum((2.0 * size) ** 0.5 for _, size in spectrum.lines)
        steady += spectrum.slope * OBSERVATION_S
        noise = replace(spectrum, lines=()).mean_square(1.0 / max(OBSERVATION_S, 4.0 * spectrum.tau0_s)) ** 0.5
        return spectrum if steady + NOISE_SIGMAS * noise < self.limit else nan_spectrum(spectrum.tau0_s)

    def start_transform(self, rate_hz: float, rng: np.random.Generator) -> RunningTransform:
        """Start a clipping transform."""
        return RunningTransform(lambda values: np.clip(values, -self.limit, self.limit, out=values))
