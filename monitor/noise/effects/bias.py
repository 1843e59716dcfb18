"""A constant bias."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import Source, check_parameters, parameter


@dataclass(frozen=True, slots=True)
class Bias(Source):
    """A constant: no Allan variance, no spectrum; an accelerometer's share of gravity belongs here too.

    >>> Bias(value=9.8).start(100.0, np.random.default_rng(0)).draw(2).tolist()
    [9.8, 9.8]
    """

    value: float = parameter("rad/s", "m/s²", signed=True)

    name: ClassVar[str] = "bias"
    means: ClassVar[str] = "What the sensor reads when it should read zero."

    def __post_init__(self) -> None:
        check_parameters(self)

    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """Zero at every τ."""
        return np.zeros_like(tau_s)

    def psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """Zero above f = 0."""
        return np.zeros_like(f_hz)

    def start(self, rate_hz: float, rng: np.random.Generator) -> "_Constant":
        """The same value for ever."""
        return _Constant(self.value)


class _Constant:
    def __init__(self, value: float) -> None:
        self._value = value

    def draw(self, n: int) -> Floats:
        return np.full(n, self._value)
