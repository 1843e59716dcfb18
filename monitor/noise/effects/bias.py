"""A constant bias."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import Block, Series, Source, parameter
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class Bias(Source):
    """A constant: no Allan variance, no spectrum; an accelerometer's share of gravity belongs here too.

    >>> Bias(value=9.8).spectrum(0.01).level
    9.8
    """

    value: float = parameter("rad/s", "m/s²", signed=True)

    name: ClassVar[str] = "bias"
    means: ClassVar[str] = "What the sensor reads when it should read zero."

    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """Zero at every τ."""
        return np.zeros_like(tau_s)

    def psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """Zero above f = 0."""
        return np.zeros_like(f_hz)

    def spectrum(self, tau0_s: float) -> Spectrum:
        """A level and nothing else."""
        return replace(Source.spectrum(self, tau0_s), level=self.value)

    def start(self, rate_hz: float, rng: np.random.Generator) -> "_Constant":
        """The same value for ever."""
        return _Constant(self.value)


class _Constant(Series):
    def __init__(self, value: float) -> None:
        self._value = value

    def add(self, values: Floats, block: Block) -> None:
        values += self._value
