"""Temperature of a simulated sensor: a periodic swing, such as day and night, plus slow random wander.

T(t) = mean + swing sin(2πt/period) + first-order Gauss–Markov noise of standard deviation ``wander`` and correlation
time ``wander_time``. If a recording has its own temperature, it is used instead.
"""

from dataclasses import dataclass, fields
from math import isfinite
from typing import Final

import numpy as np

from drivers.discovery import format_suggestion
from drivers.errors import ConfigError
from drivers.quantities import DURATION_S, TEMPERATURE_C
from drivers.sample import Floats
from monitor.noise.effect import NoiseSeries, SampleBlockContext
from monitor.noise.effects.exponentially_correlated import ExponentiallyCorrelated
from monitor.noise.effects.sinusoidal import Sinusoidal

TEMPERATURE_UNITS: Final = {"mean": "°C", "swing": "°C", "period": "s", "wander": "°C", "wander_time": "s"}
"""Parameter of a temperature -> its unit."""


@dataclass(frozen=True, slots=True)
class Temperature:
    """Parameters of the table ``[temperature]`` of a model file. A swing needs its period, and a wander its time.

    Raises
    ------
    ConfigError
        If a parameter is not allowed, or if one of a pair is missing.

    Examples
    --------
    >>> Temperature(mean=25.0, swing=3.0)
    Traceback (most recent call last):
    drivers.errors.ConfigError: temperature: swing needs a period
    """

    mean: float  # °C
    swing: float | None = None  # °C, amplitude of the periodic part
    period: float | None = None  # s
    wander: float | None = None  # °C, standard deviation of the random part
    wander_time: float | None = None  # s, correlation time of the random part

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if value is None and f.name != "mean":
                continue
            if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
                raise ConfigError(f"temperature: {f.name} must be a finite number, is {value!r}")
            if f.name in ("swing", "wander") and value < 0.0:
                raise ConfigError(f"temperature: {f.name} must not be negative, is {value!r}")
            quantity = DURATION_S if f.name in ("period", "wander_time") else TEMPERATURE_C
            try:
                quantity.check(value)
            except ConfigError as error:
                raise ConfigError(f"temperature: {f.name}: {error}") from None
        if (self.swing is None) != (self.period is None):
            raise ConfigError(
                "temperature: " + ("swing needs a period" if self.swing is not None else "period needs a swing")
            )
        if (self.wander is None) != (self.wander_time is None):
            needs = "wander needs a wander_time" if self.wander is not None else "wander_time needs a wander"
            raise ConfigError(f"temperature: {needs}")

    @classmethod
    def from_table(cls, table: object) -> "Temperature":
        """Return the temperature of a parsed ``[temperature]`` table.

        Raises
        ------
        ConfigError
            If the table is not valid.
        """
        if not isinstance(table, dict):
            raise ConfigError(f"temperature must be a table with {', '.join(TEMPERATURE_UNITS)}")
        for name in table:
            if name not in TEMPERATURE_UNITS:
                raise ConfigError(
                    f'temperature: unknown parameter "{name}"{format_suggestion(name, tuple(TEMPERATURE_UNITS))}'
                )
        if "mean" not in table:
            raise ConfigError("temperature: mean is missing")
        return cls(**table)

    def start(self, rate_hz: float, rng: np.random.Generator) -> NoiseSeries:
        """Return a new series in °C.

        Parameters
        ----------
        rate_hz : float
            Sample rate, Hz.
        rng : numpy.random.Generator
            Generator of the temperature alone.
        """
        parts: list[NoiseSeries] = []
        if self.swing is not None and self.period is not None:
            swing = Sinusoidal(amplitude=self.swing, frequency=1.0 / self.period, phase=0.0)
            swing.check_rate(rate_hz)
            parts.append(swing.start(rate_hz, rng))
        if self.wander is not None and self.wander_time is not None:
            wander = ExponentiallyCorrelated(sigma=self.wander, correlation_time=self.wander_time)
            parts.append(wander.start(rate_hz, rng))
        return _Generated(self.mean, parts)


class RecordedTemperature(NoiseSeries):
    """Temperature of a recording.

    A missing value is replaced by the value before, and the last value continues beyond the end.

    Parameters
    ----------
    temperature_c : ndarray, shape (n,)
        Temperature in °C; NaN = missing.

    Raises
    ------
    ConfigError
        If there is no value at all.
    """

    def __init__(self, temperature_c: Floats) -> None:
        given = np.asarray(temperature_c, np.float64).ravel()
        known = np.flatnonzero(np.isfinite(given))
        if known.size == 0:
            raise ConfigError("the recording has no temperature")
        before = np.searchsorted(known, np.arange(given.size), "right") - 1
        self._values = given[known[np.maximum(before, 0)]]

    def add(self, values: Floats, block: SampleBlockContext) -> None:
        """Add the next temperatures to the values [n].

        Parameters
        ----------
        values : ndarray, shape (n,), float64
            Temperature in °C. It is updated in place.
        block : Block
            Index of the block.
        """
        index = np.arange(block.first, block.first + values.size)
        values += self._values[np.minimum(index, self._values.size - 1)]


class _Generated(NoiseSeries):
    """Simulated temperature: a mean and the sum of its parts."""

    def __init__(self, mean: float, parts: list[NoiseSeries]) -> None:
        self._mean, self._parts = mean, parts

    def add(self, values: Floats, block: SampleBlockContext) -> None:
        values += self._mean
        for part in self._parts:
            part.add(values, block)
