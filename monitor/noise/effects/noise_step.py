"""A step of the noise."""

from dataclasses import dataclass
from typing import ClassVar

from monitor.noise.effect import Effect, parameter


@dataclass(frozen=True, slots=True)
class NoiseStep(Effect):
    """The angle random walk of the axis is multiplied by ``ratio`` from the first sample at or after ``time``.

    Two of them multiply. It happens once, so the Allan variance and the spectrum of such an axis depend on the
    length of the recording: NaN.

    >>> NoiseStep(time=600.0, ratio=2.0).name
    'noise_step'
    """

    time: float = parameter("s", "s")
    ratio: float = parameter("1", "1")

    name: ClassVar[str] = "noise_step"
    means: ClassVar[str] = "From one moment on the white noise is stronger, or weaker, by a factor."
