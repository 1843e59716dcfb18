"""White noise with heavier tails than a Gaussian distribution."""

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from drivers.data_types import Floats
from drivers.validation.number_ranges import NumberRange
from monitor.noise.effect import Effect, RunningEffect, parameter_field

DEGREES_OF_FREEDOM: Final = NumberRange("", 2.1, 1000.0)
"""Range of ν. The variance of Student's t distribution is infinite for ν ≤ 2."""


@dataclass(frozen=True, slots=True)
class HeavyTails(Effect):
    """White noise in which a share of the samples follows Student's t distribution with ν degrees of freedom.

    Each of these samples is multiplied by √((ν − 2)/χ²) with a random χ² of ν degrees of freedom (Student, "The
    probable error of a mean", 1908). The variance is unchanged, so Allan variance and spectrum are those of the angle
    random walk.

    >>> HeavyTails(nu=5.0).name
    'heavy_tails'
    """

    nu: float = parameter_field("1", number_range=DEGREES_OF_FREEDOM)
    share: float | None = parameter_field("1", maximum=1.0, optional=True)

    description: ClassVar[str] = "Large errors of the white noise are more frequent than in Gaussian noise."

    def start_factors(self, rng: np.random.Generator) -> "WhiteNoiseFactors":
        """Start the series of factors by which the white noise is multiplied."""
        return WhiteNoiseFactors(self.nu, 1.0 if self.share is None else self.share, rng)


class WhiteNoiseFactors(RunningEffect):
    """Random factors that turn Gaussian samples into samples of Student's t distribution."""

    def __init__(self, nu: float, share: float, rng: np.random.Generator) -> None:
        self._nu, self._share, self._rng = nu, share, rng
        self._choice = rng.spawn(1)[0]

    def multiply_in_place(self, white_noise: Floats) -> None:
        """Multiply the next samples [n] of the white noise by random factors."""
        factors = np.sqrt((self._nu - 2.0) / self._rng.chisquare(self._nu, white_noise.size))
        white_noise *= np.where(self._choice.random(white_noise.size) < self._share, factors, 1.0)
