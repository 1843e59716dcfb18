"""Bias that depends on temperature without delay."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import BiasWithoutSpectrum, RunningSource, SampleBlockContext, parameter_field


@dataclass(frozen=True, slots=True)
class TemperatureBias(BiasWithoutSpectrum):
    """Bias that is a polynomial of the temperature: b = c (T − T_r) + q (T − T_r)² + k (T − T_r)³ (IEEE Std 952).

    >>> bool(np.isnan(TemperatureBias(coefficient=1e-4, reference=25.0).two_sided_psd(np.array([1.0]), 0.01)[0]))
    True
    """

    coefficient: float = parameter_field("rad/s/°C", "m/s²/°C", signed=True)
    reference: float = parameter_field("°C", signed=True)
    quadratic: float | None = parameter_field("rad/s/°C²", "m/s²/°C²", signed=True, optional=True)
    cubic: float | None = parameter_field("rad/s/°C³", "m/s²/°C³", signed=True, optional=True)

    description: ClassVar[str] = "The bias depends on the temperature of the sensor, without delay."
    uses_temperature: ClassVar[bool] = True

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a series that depends on the temperature of each sample."""

        def add_temperature_bias(values: Floats, block: SampleBlockContext) -> None:
            warmer = block.temperature_c - self.reference
            values += (self.coefficient + ((self.quadratic or 0.0) + (self.cubic or 0.0) * warmer) * warmer) * warmer

        return RunningSource(add_temperature_bias)
