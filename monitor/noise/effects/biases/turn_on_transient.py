"""Transient of the bias after switching on."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import BiasWithoutSpectrum, RunningSource, SampleBlockContext, parameter_field


@dataclass(frozen=True, slots=True)
class TurnOnTransient(BiasWithoutSpectrum):
    """Exponential transient A exp(−t/τ) that starts at the first sample (warm-up term of IEEE Std 952).

    >>> bool(np.isnan(TurnOnTransient(amplitude=1e-3, time_constant=60.0).avar(np.array([1.0]), 0.01)[0]))
    True
    """

    amplitude: float = parameter_field("rad/s", "m/s²", signed=True)
    time_constant: float = parameter_field("s", positive=True)

    description: ClassVar[str] = "After the sensor is switched on, the bias decays exponentially to its final value."

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a transient at the next sample."""
        step, count = 1.0 / (self.time_constant * rate_hz), 0

        def add_decay(values: Floats, block: SampleBlockContext) -> None:
            nonlocal count
            values += self.amplitude * np.exp(-step * np.arange(count, count + values.size))
            count += values.size

        return RunningSource(add_decay)
