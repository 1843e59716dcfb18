"""Step of the bias."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import NoiseSeries, SampleBlockContext, Source, first_sample, parameter


@dataclass(frozen=True, slots=True)
class BiasStep(Source):
    """Step of the bias: zero before ``time``, ``height`` from the first sample at or after ``time``.

    The step occurs once. Its Allan variance and spectrum therefore depend on the length of the recording and are NaN.

    >>> bool(np.isnan(BiasStep(time=60.0, height=1e-3).avar(np.array([1.0]), 0.01)[0]))
    True
    """

    time: float = parameter("s", "s")
    height: float = parameter("rad/s", "m/s²", signed=True)

    name: ClassVar[str] = "bias_step"
    description: ClassVar[str] = "The bias jumps once and stays there, as after a knock."

    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """Return NaN, because the Allan variance depends on the length of the recording."""
        return np.full_like(tau_s, np.nan)

    def psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """Return NaN, because the spectrum depends on the length of the recording."""
        return np.full_like(f_hz, np.nan)

    def start(self, rate_hz: float, rng: np.random.Generator) -> "_Step":
        """Return a series in which ``time`` counts from the first sample of the stream."""
        return _Step(first_sample(self.time, rate_hz), self.height)


class _Step(NoiseSeries):
    """Series with one step at a sample index."""

    def __init__(self, index: int, height: float) -> None:
        self._index, self._height = index, height

    def add(self, values: Floats, block: SampleBlockContext) -> None:
        values[max(0, self._index - block.first) :] += self._height
