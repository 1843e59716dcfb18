"""Rate random walk K: white noise, integrated."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import Source, check_parameters, parameter


@dataclass(frozen=True, slots=True)
class RateRandomWalk(Source):
    """IEEE Std 952 eq. C.28–C.29, S(f) = K²/(2πf)² and σ²(τ) = K²τ/3, as sampled.

    Summing independent steps of variance K²τ0 gives S(f) = K²τ0²/(4 sin²(πfτ0)) and, m = τ/τ0,
    σ² = K²τ/3 · (1 + 1/(2m²)): the continuous forms but for the first few samples.

    >>> print(f"{RateRandomWalk(K=3e-6).avar(np.array([1e4]), 0.01)[0]:.6g}")
    3e-08
    """

    K: float = parameter("rad/s/√s", "m/s²/√s")

    name: ClassVar[str] = "rate_random_walk"
    means: ClassVar[str] = "The bias itself takes random steps and never returns: worse the longer one averages."

    def __post_init__(self) -> None:
        check_parameters(self)

    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """K²τ/3 (1 + τ0²/(2τ²))."""
        return self.K**2 / 3.0 * (tau_s + 0.5 * tau0_s**2 / tau_s)

    def psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """K²τ0²/(4 sin²(πfτ0))."""
        return (0.5 * self.K * tau0_s / np.sin(np.pi * f_hz * tau0_s)) ** 2

    def start(self, rate_hz: float, rng: np.random.Generator) -> "_Walk":
        """A walk that starts at zero."""
        return _Walk(self.K / rate_hz**0.5, rng)


class _Walk:
    def __init__(self, step: float, rng: np.random.Generator) -> None:
        self._step = step
        self._rng = rng
        self._place = 0.0

    def draw(self, n: int) -> Floats:
        if n == 0:
            return np.empty(0)
        steps = self._step * self._rng.standard_normal(n)
        steps[0] += self._place  # the running sum adds in the same order whatever the blocks
        places: Floats = np.cumsum(steps)
        self._place = float(places[-1])
        return places
