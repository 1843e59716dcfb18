"""Transient after switching on."""

from dataclasses import dataclass
from math import exp
from typing import ClassVar

import numpy as np

from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.noise.effect import NoiseSeries, SampleBlockContext, Source, parameter


@dataclass(frozen=True, slots=True)
class TurnOnTransient(Source):
    """Exponential transient A exp(−t/τ) from the first sample on: the warm-up term of the drift model of IEEE Std 952.

    The transient occurs once. Its Allan variance and spectrum therefore depend on the length of the recording and are
    NaN.

    >>> bool(np.isnan(TurnOnTransient(amplitude=1e-3, time_constant=60.0).avar(np.array([1.0]), 0.01)[0]))
    True
    """

    amplitude: float = parameter("rad/s", "m/s²", signed=True)
    time_constant: float = parameter("s", "s", positive=True)

    name: ClassVar[str] = "turn_on_transient"
    description: ClassVar[str] = "After switching on the bias runs in, quickly at first, then ever more slowly."

    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """Return NaN, because the Allan variance depends on the length of the recording."""
        return np.full_like(tau_s, np.nan)

    def psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """Return NaN, because the spectrum depends on the length of the recording."""
        return np.full_like(f_hz, np.nan)

    def start(self, rate_hz: float, rng: np.random.Generator) -> "_Decay":
        """Return a transient that begins at its first sample, even if it is added to a running stream."""
        return _Decay(self.amplitude, 1.0 / (self.time_constant * rate_hz))


class _Decay(NoiseSeries):
    """Series of an exponential decay."""

    def __init__(self, amplitude: float, step: float) -> None:
        self._amplitude, self._step = amplitude, step
        self._count = 0

    def add(self, values: Floats, block: SampleBlockContext) -> None:
        _add_decay(values, self._count, self._amplitude, self._step)
        self._count += values.size


@compiled
def _add_decay(values, first, amplitude, step):  # type: ignore[no-untyped-def]
    """Add amplitude · exp(−step · k) for k = first, … to the values [n]."""
    for k in range(values.size):
        values[k] += amplitude * exp(-step * (first + k))
