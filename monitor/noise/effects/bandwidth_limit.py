"""Low-pass filter of the sensor."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import RunningTransform, Transform, check_below_nyquist, parameter
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class BandwidthLimit(Transform):
    """Butterworth low-pass, digital by the bilinear transform: |H|² = 1/(1 + (tan(πfτ0)/tan(πf_cτ0))^(2n)).

    Butterworth, "On the theory of filter amplifiers", 1930. The Allan variance after the filter is an integral over the
    spectrum. The filter starts in its settled state at the first sample, so that gravity causes no transient.

    >>> from monitor.noise.spectrum import white_noise_spectrum
    >>> limited = BandwidthLimit(cutoff=10.0, order=2).transform_spectrum(white_noise_spectrum(1.0, 0.01))
    >>> print(f"{limited.density(np.array([10.0]))[0]:.6g}")
    0.005
    """

    cutoff: float = parameter("Hz", "Hz", positive=True)
    order: int = parameter("1", "1", positive=True, whole=True, most=8)

    name: ClassVar[str] = "bandwidth_limit"
    description: ClassVar[str] = "The sensor's own filter lets slow motion through and damps what is fast, noise too."

    def check_rate(self, rate_hz: float) -> None:
        """Raise ConfigError if the cutoff is not below half the sample rate."""
        check_below_nyquist(self, "cutoff", rate_hz)

    def transform_spectrum(self, spectrum: Spectrum) -> Spectrum:
        """Return the spectrum times |H|²."""
        tau0_s = spectrum.tau0_s
        corner = np.tan(np.pi * self.cutoff * tau0_s)

        def gain(f_hz: Floats) -> Floats:
            # At half the sample rate the tangent is 1e16. Its power overflows to infinity, and the gain is zero.
            with np.errstate(over="ignore"):
                return np.asarray(1.0 / (1.0 + (np.tan(np.pi * f_hz * tau0_s) / corner) ** (2 * int(self.order))))

        return spectrum.filtered(gain)

    def start(self, rate_hz: float, rng: np.random.Generator) -> RunningTransform:
        """Return the filter, which settles at the first sample."""
        from monitor.noise.low_pass import LowPass, butterworth_sections  # imports Numba, which only simulation needs

        return LowPass(butterworth_sections(int(self.order), self.cutoff, rate_hz))
