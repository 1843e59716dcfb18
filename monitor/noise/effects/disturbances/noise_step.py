"""Step of the white noise amplitude."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import RunningGain, WhiteNoiseGain, first_sample_at_or_after, parameter_field


@dataclass(frozen=True, slots=True)
class NoiseStep(WhiteNoiseGain):
    """Multiplication of the angle random walk by ``ratio`` from the first sample at or after ``time``.

    The ratios of several noise steps are multiplied. Allan variance and spectrum are NaN, because they depend on the
    length of the recording.

    >>> NoiseStep(time=600.0, ratio=2.0).name
    'noise_step'
    """

    time: float = parameter_field("s")
    ratio: float = parameter_field("1")

    description: ClassVar[str] = (
        "The standard deviation of the white noise changes by a constant factor at one point in time."
    )

    def start_gain(self, rate_hz: float, rng: np.random.Generator) -> RunningGain:
        """Start a gain with a step. ``time`` is relative to the first sample of the stream."""
        step = first_sample_at_or_after(self.time, rate_hz)

        def compute_gain(first: int, n: int) -> Floats:
            gain = np.ones(n)
            gain[max(0, step - first) :] = self.ratio
            return gain

        return RunningGain(compute_gain)
