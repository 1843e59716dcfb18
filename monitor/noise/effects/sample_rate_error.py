"""A sample rate that is not what the recording says."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.errors import ConfigError
from drivers.quantities import RATE_RATIO
from drivers.sample import Floats
from monitor.noise.effect import Running, Transform, parameter
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class SampleRateError(Transform):
    """True rate over stated rate, of the whole recording: by substitution σ²(τ) ← σ²(τ/r), S(f) ← r·S(rf).

    Every effect of every axis is simulated at the true rate, and nothing is resampled: the samples are right, only the
    clock is not. Stated on any axis it holds for all; stated twice it must be the same.

    >>> from monitor.noise.spectrum import white
    >>> stated = SampleRateError(ratio=2.0).restated(white(1.0, 0.005))
    >>> stated.tau0_s, float(stated.allan(np.array([0.01]))[0])
    (0.01, 1.0)
    """

    ratio: float = parameter("1", "1", positive=True)

    name: ClassVar[str] = "sample_rate_error"
    means: ClassVar[str] = "The clock is off: what happens at one frequency is seen at another."

    def check_rate(self, rate_hz: float) -> None:
        """The true rate must not be far from every rate that is supported."""
        if not RATE_RATIO.supports(self.ratio):
            raise ConfigError(f"{self.name}: ratio must be {RATE_RATIO.range_text()}, is {self.ratio!r}")

    def reshape(self, spectrum: Spectrum) -> Spectrum:
        """As it is: samples do not change, and ``restated`` relabels them once all transforms have acted."""
        return spectrum

    def restated(self, spectrum: Spectrum) -> Spectrum:
        """The spectrum of samples at the true rate, in the time that the recording states."""
        r, closed = self.ratio, spectrum.closed
        return Spectrum(
            lambda f: r * spectrum.density(r * f),
            None if closed is None else lambda tau: closed(tau / r),
            r * spectrum.tau0_s,
            tuple((f / r, size) for f, size in spectrum.lines),
            spectrum.slope / r,
            spectrum.level,
            tuple((f / r, width / r) for f, width in spectrum.peaks),
        )

    def start(self, rate_hz: float, rng: np.random.Generator) -> "_Untouched":
        """Nothing to do."""
        return _Untouched()


class _Untouched(Running):
    def apply(self, values: Floats) -> None:
        """Samples are what they are."""
