"""Bias that follows the temperature with a delay."""

from dataclasses import dataclass
from math import expm1
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import BiasWithoutSpectrum, RunningSource, SampleBlockContext, parameter_field
from monitor.noise.effects.ieee952.exponentially_correlated import add_recursion


@dataclass(frozen=True, slots=True)
class TemperatureLag(BiasWithoutSpectrum):
    """Bias that follows the temperature with a first-order lag (Newton's law of cooling).

    The bias is b = c (T_l − T_r), where dT_l/dt = (T − T_l)/τ. The lagged temperature T_l starts at the first
    temperature. The temperature is constant between samples.

    >>> lag = TemperatureLag(coefficient=1e-4, reference=25.0, time_constant=60.0)
    >>> bool(np.isnan(lag.avar(np.array([1.0]), 0.01)[0]))
    True
    """

    coefficient: float = parameter_field("rad/s/°C", "m/s²/°C", signed=True)
    reference: float = parameter_field("°C", signed=True)
    time_constant: float = parameter_field("s", positive=True)

    description: ClassVar[str] = "The bias follows the temperature of the sensor with a delay."
    uses_temperature: ClassVar[bool] = True

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a series whose lagged temperature starts at the first temperature."""
        share = -expm1(-1.0 / (self.time_constant * rate_hz))
        lagged_c: float | None = None

        def add_lagged_bias(values: Floats, block: SampleBlockContext) -> None:
            nonlocal lagged_c
            inside = float(block.temperature_c[0]) if lagged_c is None else lagged_c
            course_c = np.zeros(values.size)
            lagged_c = add_recursion(course_c, block.temperature_c, 1.0 - share, share, inside)
            values += self.coefficient * (course_c - self.reference)

        return RunningSource(add_lagged_bias)
