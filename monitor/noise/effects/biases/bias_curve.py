"""Curved drift of the bias, for example due to ageing."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from drivers.errors import ConfigError
from monitor.noise.effect import BiasWithoutSpectrum, RunningSource, SampleBlockContext, parameter_field


@dataclass(frozen=True, slots=True)
class BiasCurve(BiasWithoutSpectrum):
    """Curved drift b = s t + c t² + a ln(1 + t/τ), which starts at zero.

    The logarithm describes the ageing of quartz resonators (MIL-PRF-55310).

    >>> bool(np.isnan(BiasCurve(slope=1e-6, curvature=1e-9).avar(np.array([1.0]), 0.01)[0]))
    True
    """

    slope: float = parameter_field("rad/s²", "m/s³", signed=True)
    curvature: float | None = parameter_field("rad/s³", "m/s⁴", signed=True, optional=True)
    logarithmic: float | None = parameter_field("rad/s", "m/s²", signed=True, optional=True)
    time_constant: float | None = parameter_field("s", positive=True, optional=True)

    description: ClassVar[str] = "The bias drifts along a curve, for example while a sensor ages."

    def __post_init__(self) -> None:
        BiasWithoutSpectrum.__post_init__(self)
        if (self.logarithmic is None) != (self.time_constant is None):
            raise ConfigError(f"{self.name}: logarithmic and time_constant need each other")

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a drift at the next sample."""
        count = 0

        def add_drift(values: Floats, block: SampleBlockContext) -> None:
            nonlocal count
            t_s = 1.0 / rate_hz * np.arange(count, count + values.size)
            values += (self.slope + (self.curvature or 0.0) * t_s) * t_s
            if self.logarithmic and self.time_constant is not None:
                values += self.logarithmic * np.log1p(t_s / self.time_constant)
            count += values.size

        return RunningSource(add_drift)
