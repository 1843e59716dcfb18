"""Constant bias."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import NoiseSeries, SampleBlockContext, Source, parameter
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class Bias(Source):
    """Constant bias, without Allan variance or spectrum. The share of gravity on an accelerometer is also a bias.

    >>> Bias(value=9.8).spectrum(0.01).level
    9.8
    """

    value: float = parameter("rad/s", "m/s²", signed=True)

    name: ClassVar[str] = "bias"
    description: ClassVar[str] = "What the sensor reads when it should read zero."

    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """Return zero for every τ."""
        return np.zeros_like(tau_s)

    def psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """Return zero for every frequency above 0."""
        return np.zeros_like(f_hz)

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return a spectrum that has only a constant level."""
        return replace(Source.spectrum(self, tau0_s), level=self.value)

    def start(self, rate_hz: float, rng: np.random.Generator) -> "_Constant":
        """Return a constant series."""
        return _Constant(self.value)


class _Constant(NoiseSeries):
    """Series of one value."""

    def __init__(self, value: float) -> None:
        self._value = value

    def add(self, values: Floats, block: SampleBlockContext) -> None:
        values += self._value
