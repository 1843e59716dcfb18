"""Wrong unit of the measured values."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from monitor.noise.effect import RunningTransform, Transform, parameter_field
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class UnitError(Transform):
    """Factor f by which a wrong conversion multiplies the output of an axis, for example π/180.

    Unlike a scale factor, the conversion also multiplies the measurement range and the resolution of the sensor. Allan
    variance and power spectral density are multiplied by f².

    >>> from monitor.noise.spectrum import white_noise_spectrum
    >>> float(UnitError(factor=2.0).transform_spectrum(white_noise_spectrum(1.0, 0.01)).avar(np.array([0.01]))[0])
    4.0
    """

    factor: float = parameter_field("1", positive=True)

    description: ClassVar[str] = (
        "All output values are multiplied by a constant factor, because they are in a wrong unit."
    )

    def transform_spectrum(self, spectrum: Spectrum) -> Spectrum:
        """Return the spectrum multiplied by f²."""
        return spectrum.scaled_by_amplitude(self.factor)

    def start_transform(self, rate_hz: float, rng: np.random.Generator) -> RunningTransform:
        """Start a multiplying transform."""
        return RunningTransform(lambda values: np.multiply(values, self.factor, out=values))
