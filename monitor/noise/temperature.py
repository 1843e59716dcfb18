"""Temperature of a sensor in a simulation.

The temperature is T(t) = mean + swing sin(2πt/period) plus first-order Gauss–Markov noise. The parameter ``wander`` is
the standard deviation of the noise, and ``wander_time`` is its correlation time.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import Floats
from drivers.errors import ConfigError
from drivers.validation.number_ranges import DURATION_S, TEMPERATURE_C
from monitor.noise.effect import ParameterTable, RunningSource, SampleBlockContext, parameter_field
from monitor.noise.effects.ieee952.exponentially_correlated import ExponentiallyCorrelated
from monitor.noise.effects.ieee952.sinusoidal import Sinusoidal

PAIRS: Final = (("swing", "period"), ("wander", "wander_time"))
"""Pairs of parameters that are only allowed together."""


@dataclass(frozen=True, slots=True)
class Temperature(ParameterTable):
    """Table ``[temperature]`` of a model file, which describes a simulated temperature.

    Raises
    ------
    ConfigError
        If a parameter is out of range, or if only one parameter of a pair is given.

    Examples
    --------
    >>> Temperature(mean=25.0, swing=3.0)
    Traceback (most recent call last):
    drivers.errors.ConfigError: temperature: swing needs a period
    """

    mean: float = parameter_field("°C", signed=True, number_range=TEMPERATURE_C)
    swing: float | None = parameter_field(
        "°C", optional=True, number_range=TEMPERATURE_C
    )  # amplitude of the periodic component
    period: float | None = parameter_field("s", positive=True, optional=True, number_range=DURATION_S)
    wander: float | None = parameter_field("°C", optional=True, number_range=TEMPERATURE_C)  # rms of the noise
    wander_time: float | None = parameter_field(
        "s", positive=True, optional=True, number_range=DURATION_S
    )  # correlation time of the noise

    def __post_init__(self) -> None:
        ParameterTable.__post_init__(self)
        for pair in PAIRS:
            for given, needed in (pair, pair[::-1]):
                if getattr(self, given) is not None and getattr(self, needed) is None:
                    raise ConfigError(f"temperature: {given} needs a {needed}")

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a simulated time series of the temperature in °C.

        Parameters
        ----------
        rate_hz : float
            Sample rate, Hz.
        rng : numpy.random.Generator
            Random generator of the temperature noise.
        """
        parts: list[RunningSource] = []
        if self.swing is not None and self.period is not None:
            swing = Sinusoidal(amplitude=self.swing, frequency=1.0 / self.period, phase=0.0)
            swing.check_rate(rate_hz)
            parts.append(swing.start_series(rate_hz, rng))
        if self.wander is not None and self.wander_time is not None:
            wander = ExponentiallyCorrelated(sigma=self.wander, correlation_time=self.wander_time)
            parts.append(wander.start_series(rate_hz, rng))

        def add_temperature_samples(values: Floats, block: SampleBlockContext) -> None:
            values += self.mean
            for part in parts:
                part.add_next_samples(values, block)

        return RunningSource(add_temperature_samples)


def recorded_temperature(temperature_c: Floats) -> RunningSource:
    """Return the temperature of a recording as a time series.

    Missing values are replaced by the preceding value. After the end of the recording, the last value is repeated.

    Parameters
    ----------
    temperature_c : ndarray, shape (n,)
        Temperature in °C; NaN means missing.

    Raises
    ------
    ConfigError
        If all values are missing.
    """
    given = np.asarray(temperature_c, np.float64).ravel()
    known = np.flatnonzero(np.isfinite(given))
    if known.size == 0:
        raise ConfigError("the recording has no temperature")
    before = np.searchsorted(known, np.arange(given.size), "right") - 1
    filled = given[known[np.maximum(before, 0)]]

    def add_recorded_temperature(values: Floats, block: SampleBlockContext) -> None:
        index = np.arange(block.first, block.first + values.size)
        values += filled[np.minimum(index, filled.size - 1)]

    return RunningSource(add_recorded_temperature)
