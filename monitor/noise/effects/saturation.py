"""The end of the range."""

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import Running, Transform, parameter
from monitor.noise.spectrum import Spectrum, unknown

WITHIN_S: Final = 3600.0
"""Noise and slope of this long decide whether the range is ever left."""
SIGMAS: Final = 6.0


@dataclass(frozen=True, slots=True)
class Saturation(Transform):
    """y = x clipped at ± limit.

    Where level, lines and six deviations of an hour's noise stay within the range, nothing is clipped, and spectrum
    and Allan variance are unchanged. Elsewhere there is no closed form: NaN.

    >>> from monitor.noise.spectrum import white
    >>> [float(Saturation(limit=x).reshape(white(1.0, 0.01)).allan(np.array([1.0]))[0]) for x in (10.0, 1.0)]
    [0.01, nan]
    """

    limit: float = parameter("rad/s", "m/s²", positive=True)

    name: ClassVar[str] = "saturation"
    means: ClassVar[str] = "Beyond its range the sensor reads the end of the range."

    def reshape(self, spectrum: Spectrum) -> Spectrum:
        """Unchanged as long as the range is not left within an hour."""
        steady = abs(spectrum.level) + sum((2.0 * size) ** 0.5 for _, size in spectrum.lines)
        steady += spectrum.slope * WITHIN_S
        noise = spectrum.without_lines().mean_square(1.0 / max(WITHIN_S, 4.0 * spectrum.tau0_s)) ** 0.5
        return spectrum if steady + SIGMAS * noise < self.limit else unknown(spectrum.tau0_s)

    def start(self, rate_hz: float, rng: np.random.Generator) -> "_Clipping":
        """A clip."""
        return _Clipping(self.limit)


class _Clipping(Running):
    def __init__(self, limit: float) -> None:
        self._limit = limit

    def apply(self, values: Floats) -> None:
        np.clip(values, -self._limit, self._limit, out=values)
