"""Quantization noise Q: white noise of the angle, seen in the rate as its differences."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import Source, check_parameters, parameter


@dataclass(frozen=True, slots=True)
class QuantizationNoise(Source):
    """IEEE Std 952 eq. C.14–C.15: σ²(τ) = 3Q²/τ², S(f) = 4Q²/τ0 sin²(πfτ0).

    >>> print(f"{QuantizationNoise(Q=2e-6).avar(np.array([0.1]), 0.01)[0]:.6g}")
    1.2e-09
    """

    Q: float = parameter("rad", "m/s")

    name: ClassVar[str] = "quantization_noise"
    means: ClassVar[str] = (
        "The angle is rounded anew at every reading: strong between neighbouring samples, gone over seconds."
    )

    def __post_init__(self) -> None:
        check_parameters(self)

    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """3Q²/τ²."""
        return 3.0 * self.Q**2 / tau_s**2

    def psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """4Q²/τ0 sin²(πfτ0)."""
        return 4.0 * self.Q**2 / tau0_s * np.sin(np.pi * f_hz * tau0_s) ** 2

    def start(self, rate_hz: float, rng: np.random.Generator) -> "_Differences":
        """Differences of white angle noise."""
        return _Differences(self.Q, rate_hz, rng)


class _Differences:
    def __init__(self, Q: float, rate_hz: float, rng: np.random.Generator) -> None:
        self._rng = rng
        self._Q = Q
        self._rate_hz = rate_hz
        self._angle = Q * float(rng.standard_normal())

    def draw(self, n: int) -> Floats:
        angles = np.empty(n + 1)
        angles[0] = self._angle
        angles[1:] = self._Q * self._rng.standard_normal(n)
        self._angle = float(angles[-1])
        return np.diff(angles) * self._rate_hz
