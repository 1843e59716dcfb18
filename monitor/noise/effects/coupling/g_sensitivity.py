"""g-sensitivity: leak of acceleration into a gyroscope."""

from dataclasses import dataclass
from typing import ClassVar

from drivers.errors import ConfigError
from monitor.noise.effect import ACCELEROMETERS, GYROS, AxisLeak, parameter_field, source_axis_field


@dataclass(frozen=True, slots=True)
class GSensitivity(AxisLeak):
    """g-sensitivity (IEEE Std 952), which adds ``coefficient`` times the acceleration of the axis ``source`` to a
    gyroscope.

    >>> GSensitivity(source="az", coefficient=1e-5).check_axis("ax")
    Traceback (most recent call last):
    drivers.errors.ConfigError: g_sensitivity: belongs on a gyroscope, not on ax
    """

    source: str = source_axis_field()
    coefficient: float = parameter_field("rad/s per m/s²", "1", signed=True)

    description: ClassVar[str] = "Gravity and vibration change the reading of the gyroscope."

    def check_axis(self, axis: str) -> None:
        """Raise ConfigError if the axis is not a gyroscope or the source is not an accelerometer."""
        if axis not in GYROS:
            raise ConfigError(f"{self.name}: belongs on a gyroscope, not on {axis}")
        if self.source not in ACCELEROMETERS:
            raise ConfigError(f"{self.name}: source must be an accelerometer, is {self.source!r}")
