"""Exchanged axes: the column of one axis contains the measurement of another axis."""

from dataclasses import dataclass
from typing import ClassVar

from drivers.errors import ConfigError
from monitor.noise.effect import GYROS, Effect, source_axis_field


@dataclass(frozen=True, slots=True)
class AxisPermutation(Effect):
    """Replacement of the output of an axis by the output of the axis ``source``.

    Each of two exchanged axes has this effect, with the other axis as its source. Allan variance and spectrum are those
    of the source.

    >>> AxisPermutation(source="ax").check_axis("gx")
    Traceback (most recent call last):
    drivers.errors.ConfigError: axis_permutation: source must be a gyroscope as gx is, is 'ax'
    """

    source: str = source_axis_field()

    description: ClassVar[str] = "The axis shows the measurement of another axis."

    def check_axis(self, axis: str) -> None:
        """Raise ConfigError if the unit of the source differs from the unit of the axis."""
        if (self.source in GYROS) != (axis in GYROS):
            kind = "a gyroscope" if axis in GYROS else "an accelerometer"
            raise ConfigError(f"{self.name}: source must be {kind} as {axis} is, is {self.source!r}")
