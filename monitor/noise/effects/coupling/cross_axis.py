"""Cross-axis sensitivity: leak from another gyroscope or accelerometer axis."""

from dataclasses import dataclass
from typing import ClassVar

from drivers.errors import ConfigError
from monitor.noise.effect import GYROS, AxisLeak, parameter_field, source_axis_field


@dataclass(frozen=True, slots=True)
class CrossAxis(AxisLeak):
    """Cross-axis sensitivity (IEEE Std 1293), which adds ``coefficient`` times the measurement of the axis ``source``.

    >>> CrossAxis(source="gx", coefficient=0.02).check_axis("gx")
    Traceback (most recent call last):
    drivers.errors.ConfigError: cross_axis: source must be another axis than gx itself
    """

    source: str = source_axis_field()
    coefficient: float = parameter_field("1", signed=True)

    description: ClassVar[str] = "A misalignment adds a fraction of the signal of another axis."

    def check_axis(self, axis: str) -> None:
        """Raise ConfigError if the source is the axis itself or has a different unit."""
        if self.source == axis:
            raise ConfigError(f"{self.name}: source must be another axis than {axis} itself")
        if (self.source in GYROS) != (axis in GYROS):
            kind = "a gyroscope" if axis in GYROS else "an accelerometer"
            raise ConfigError(f"{self.name}: source must be {kind} as {axis} is, is {self.source!r}")
