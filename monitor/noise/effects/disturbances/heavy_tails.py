"""White noise with heavier tails than a Gaussian distribution."""

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from drivers.data_types import Floats
from drivers.validation.number_ranges import NumberRange
from monitor.noise.effect import Effect, RunningGain, parameter_field

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

    description: ClassVar[str] = "Large values of the white noise are more frequent than in Gaussian noise."

    def start_gain(self, rate_hz: float, rng: np.random.Generator) -> RunningGain:
        """Start a random gain, which turns Gaussian samples into samples of Student's t distribution."""
        choice, share = rng.spawn(1)[0], 1.0 if self.share is None else self.share

        def compute_gain(first: int, n: int) -> Floats:
            factors = np.sqrt((self.nu - 2.0) / rng.chisquare(self.nu, n))
            return np.where(choice.random(n) < share, factors, 1.0)

        return RunningGain(compute_gain)
