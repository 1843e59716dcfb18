"""Error of the stated sample rate."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.validation.number_ranges import RATE_RATIO
from monitor.noise.effect import RunningTransform, Transform, parameter_field
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class SampleRateError(Transform):
    """Ratio r of the true sample rate to the stated sample rate.

    With the stated rate, the Allan variance becomes σ²(τ/r), and the power spectral density becomes r·S(rf). The effect
    applies to all axes, even if the model contains the effect on one axis only.

    >>> from monitor.noise.spectrum import white_noise_spectrum
    >>> stated = SampleRateError(ratio=2.0).convert_to_stated_rate(white_noise_spectrum(1.0, 0.005))
    >>> stated.tau0_s, float(stated.avar(np.array([0.01]))[0])
    (0.01, 1.0)
    """

    ratio: float = parameter_field("1", positive=True, number_range=RATE_RATIO)

    description: ClassVar[str] = (
        "The true sample rate differs from the stated rate, which scales all times and frequencies."
    )

    def transform_spectrum(self, spectrum: Spectrum) -> Spectrum:
        """Return the spectrum unchanged, because ``convert_to_stated_rate`` is applied after all transforms."""
        return spectrum

    def convert_to_stated_rate(self, spectrum: Spectrum) -> Spectrum:
        """Convert a spectrum at the true sample rate to the stated sample rate."""
        r, closed = self.ratio, spectrum.closed_form_avar
        return Spectrum(
            lambda f: r * spectrum.density(r * f),
            None if closed is None else lambda tau: closed(tau / r),
            r * spectrum.tau0_s,
            tuple((f / r, size) for f, size in spectrum.lines),
            spectrum.slope / r,
            spectrum.level,
            tuple((f / r, width / r) for f, width in spectrum.peaks),
        )

    def start_transform(self, rate_hz: float, rng: np.random.Generator) -> RunningTransform:
        """Start a transform that does not change the samples."""
        return RunningTransform(lambda values: None)
