"""Periodic variation of the white noise variance."""

from dataclasses import dataclass
from math import pi
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import RunningGain, WhiteNoiseGain, parameter_field


@dataclass(frozen=True, slots=True)
class VarianceModulation(WhiteNoiseGain):
    """Variation of the white noise variance: N² becomes N² (1 + m sin(2πt/T + φ)) with the depth m and the period T.

    The modulated noise is still white, so Allan variance and spectrum are unchanged. If no phase is given, the phase is
    random.

    >>> gain = VarianceModulation(depth=0.5, period=4.0, phase=0.0).start_gain(1.0, None).compute_gain(1, 1)
    >>> round(float(gain[0] ** 2), 6)
    1.5
    """

    depth: float = parameter_field("1", maximum=1.0)
    period: float = parameter_field("s", positive=True)
    phase: float | None = parameter_field("rad", signed=True, optional=True)

    description: ClassVar[str] = "The variance of the white noise rises and falls periodically."

    def start_gain(self, rate_hz: float, rng: np.random.Generator) -> RunningGain:
        """Start a periodic gain. The time is relative to the first sample of the stream."""
        phase = float(rng.uniform(0.0, 2.0 * pi)) if self.phase is None else self.phase
        period = self.period * rate_hz

        def compute_gain(first: int, n: int) -> Floats:
            angle = 2.0 * pi * np.mod(np.arange(first, first + n) / period, 1.0) + phase
            return np.asarray(np.sqrt(np.maximum(1.0 + self.depth * np.sin(angle), 0.0)))

        return RunningGain(compute_gain, lambda: {"phase": phase} if self.phase is None else {})
