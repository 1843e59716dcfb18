"""Step of the white noise amplitude."""

from dataclasses import dataclass
from typing import ClassVar

from monitor.noise.effect import Effect, parameter_field


@dataclass(frozen=True, slots=True)
class NoiseStep(Effect):
    """Multiplication of the angle random walk by ``ratio`` from the first sample at or after ``time``.

    The ratios of several noise steps are multiplied. Allan variance and spectrum are NaN, because they depend on the
    length of the recording.

    >>> NoiseStep(time=600.0, ratio=2.0).name
    'noise_step'
    """

    time: float = parameter_field("s")
    ratio: float = parameter_field("1")

    description: ClassVar[str] = "The size of the white noise changes once by a factor."
