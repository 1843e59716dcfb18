"""Bias that depends on temperature with a delay."""

from dataclasses import dataclass
from math import expm1
from typing import ClassVar

import numpy as np

from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.noise.effect import NoiseSeries, SampleBlockContext, Source, parameter


@dataclass(frozen=True, slots=True)
class TemperatureLag(Source):
    """Bias that follows temperature with a first-order lag (Newton's law of cooling): b = c (T_l − T_r), dT_l/dt = (T −
    T_l)/τ.

    T_l is the lagged temperature. It starts at the first temperature of the series. The temperature is constant between
    samples. Allan variance and spectrum depend on the temperature and are NaN.

    >>> lag = TemperatureLag(coefficient=1e-4, reference=25.0, time_constant=60.0)
    >>> bool(np.isnan(lag.avar(np.array([1.0]), 0.01)[0]))
    True
    """

    coefficient: float = parameter("rad/s/°C", "m/s²/°C", signed=True)
    reference: float = parameter("°C", "°C", signed=True)
    time_constant: float = parameter("s", "s", positive=True)

    name: ClassVar[str] = "temperature_lag"
    description: ClassVar[str] = "The bias follows the temperature of the sensor, but later: heat takes its time."
    uses_temperature: ClassVar[bool] = True

    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """Return NaN, because the Allan variance depends on the temperature."""
        return np.full_like(tau_s, np.nan)

    def psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """Return NaN, because the spectrum depends on the temperature."""
        return np.full_like(f_hz, np.nan)

    def start(self, rate_hz: float, rng: np.random.Generator) -> "_Lagging":
        """Return a series that is settled at the first temperature."""
        return _Lagging(self.coefficient, self.reference, -expm1(-1.0 / (self.time_constant * rate_hz)))


class _Lagging(NoiseSeries):
    """Series of a first-order lag of the temperature."""

    def __init__(self, coefficient: float, reference_c: float, share: float) -> None:
        self._coefficient, self._reference_c, self._share = coefficient, reference_c, share
        self._lagged_c: float | None = None

    def add(self, values: Floats, block: SampleBlockContext) -> None:
        inside = float(block.temperature_c[0]) if self._lagged_c is None else self._lagged_c
        self._lagged_c = _add_lagged_bias(
            values, block.temperature_c, inside, self._coefficient, self._reference_c, self._share
        )


@compiled
def _add_lagged_bias(values, temperature, inside, coefficient, reference, share):  # type: ignore[no-untyped-def]
    """Add the bias of the lagged temperature to the values [n], and return that temperature in °C."""
    for k in range(values.size):
        values[k] += coefficient * (inside - reference)
        inside += share * (temperature[k] - inside)
    return inside
