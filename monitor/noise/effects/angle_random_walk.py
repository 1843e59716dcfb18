"""Angle random walk N (velocity random walk on an accelerometer): white noise of the rate."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import NoiseSeries, SampleBlockContext, Source, parameter


@dataclass(frozen=True, slots=True)
class AngleRandomWalk(Source):
    """White noise of the rate, IEEE Std 952 eq. C.18–C.19: S(f) = N², σ²(τ) = N²/τ.

    >>> print(f"{AngleRandomWalk(N=1.5e-4).avar(np.array([9.0]), 0.01)[0]:.6g}")
    2.5e-09
    """

    N: float = parameter("rad/√s", "m/s/√s")

    name: ClassVar[str] = "angle_random_walk"
    description: ClassVar[str] = "White noise of the rate: averaging four times as long halves it."

    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """Return the Allan variance N²/τ."""
        return self.N**2 / tau_s

    def psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """Return N² for every frequency."""
        return np.full_like(f_hz, self.N**2)

    def start(self, rate_hz: float, rng: np.random.Generator) -> "_White":
        """Return a series of independent samples with standard deviation N √rate."""
        return _White(self.N * rate_hz**0.5, rng)


class _White(NoiseSeries):
    """Series of independent Gaussian samples."""

    def __init__(self, deviation: float, rng: np.random.Generator) -> None:
        self._deviation = deviation
        self._rng = rng

    def add(self, values: Floats, block: SampleBlockContext) -> None:
        white = self._rng.standard_normal(out=block.scratch)
        white *= self._deviation
        values += white
