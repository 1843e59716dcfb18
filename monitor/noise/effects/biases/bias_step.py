"""Step of the bias."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import (
    BiasWithoutSpectrum,
    RunningSource,
    SampleBlockContext,
    first_sample_at_or_after,
    parameter_field,
)


@dataclass(frozen=True, slots=True)
class BiasStep(BiasWithoutSpectrum):
    """Bias step of size ``height`` at the first sample at or after ``time``.

    >>> bool(np.isnan(BiasStep(time=60.0, height=1e-3).avar(np.array([1.0]), 0.01)[0]))
    True
    """

    time: float = parameter_field("s")
    height: float = parameter_field("rad/s", "m/s²", signed=True)

    description: ClassVar[str] = "The bias jumps once and keeps the new value, for example after a knock."

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a series with a step. ``time`` is relative to the first sample of the stream."""
        first = first_sample_at_or_after(self.time, rate_hz)

        def add_bias_step(values: Floats, block: SampleBlockContext) -> None:
            values[max(0, first - block.first) :] += self.height

        return RunningSource(add_bias_step)
