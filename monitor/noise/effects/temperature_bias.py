"""Bias that depends on temperature without delay."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import NoiseSeries, SampleBlockContext, Source, parameter


@dataclass(frozen=True, slots=True)
class TemperatureBias(Source):
    """Polynomial of second order in temperature, as in the error model of IEEE Std 952: b = c (T − T_r) + q (T − T_r)².

    Its Allan variance and spectrum depend on the temperature, which the effect does not contain. They are NaN.

    >>> bool(np.isnan(TemperatureBias(coefficient=1e-4, reference=25.0).psd(np.array([1.0]), 0.01)[0]))
    True
    """

    coefficient: float = parameter("rad/s/°C", "m/s²/°C", signed=True)
    reference: float = parameter("°C", "°C", signed=True)
    quadratic: float | None = parameter("rad/s/°C²", "m/s²/°C²", signed=True, optional=True)

    name: ClassVar[str] = "temperature_bias"
    description: ClassVar[str] = "The bias moves with the temperature of the sensor, without delay."
    uses_temperature: ClassVar[bool] = True

    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """Return NaN, because the Allan variance depends on the temperature."""
        return np.full_like(tau_s, np.nan)

    def psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """Return NaN, because the spectrum depends on the temperature."""
        return np.full_like(f_hz, np.nan)

    def start(self, rate_hz: float, rng: np.random.Generator) -> "_TemperaturePolynomial":
        """Return a series that is a function of the temperature of each sample."""
        return _TemperaturePolynomial(self.coefficient, self.quadratic or 0.0, self.reference)


class _TemperaturePolynomial(NoiseSeries):
    """Series of a polynomial in temperature."""

    def __init__(self, linear: float, quadratic: float, reference_c: float) -> None:
        self._linear, self._quadratic, self._reference_c = linear, quadratic, reference_c

    def add(self, values: Floats, block: SampleBlockContext) -> None:
        warmer = block.temperature_c - self._reference_c
        values += (self._linear + self._quadratic * warmer) * warmer
