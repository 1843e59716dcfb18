"""Scale factor error."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from monitor.noise.effect import RunningTransform, Transform, parameter_field
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class ScaleFactor(Transform):
    """Scale factor f of the axis (IEEE Std 952), which multiplies Allan variance and power spectral density by f².

    >>> from monitor.noise.spectrum import white_noise_spectrum
    >>> float(ScaleFactor(factor=2.0).transform_spectrum(white_noise_spectrum(1.0, 0.01)).avar(np.array([0.01]))[0])
    4.0
    """

    factor: float = parameter_field("1")

    description: ClassVar[str] = (
        "All values of the axis are multiplied by a constant, for example because of a wrong unit."
    )

    def transform_spectrum(self, spectrum: Spectrum) -> Spectrum:
        """Return the spectrum multiplied by f²."""
        return spectrum.scaled_by_amplitude(self.factor)

    def start_transform(self, rate_hz: float, rng: np.random.Generator) -> RunningTransform:
        """Start a multiplying transform."""
        return RunningTransform(lambda values: np.multiply(values, self.factor, out=values))
