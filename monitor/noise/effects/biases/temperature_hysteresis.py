"""Bias that differs between rising and falling temperature."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.common.compiled import compiled
from monitor.noise.effect import BiasWithoutSpectrum, RunningSource, SampleBlockContext, parameter_field


@dataclass(frozen=True, slots=True)
class TemperatureHysteresis(BiasWithoutSpectrum):
    """Hysteresis between the heating branch and the cooling branch (stop operator of Prandtl).

    The bias is b = h x. The state x follows dx = dT/r, limited to −½ … ½. It is ½ on the heating branch and −½ on the
    cooling branch. After a reversal, the temperature must change by r before the bias reaches the other branch. The
    state starts at 0.

    Source: Brokate & Sprekels, Hysteresis and Phase Transitions (1996), section 2.1.

    >>> hysteresis = TemperatureHysteresis(height=1e-3, reversal=2.0)
    >>> bool(np.isnan(hysteresis.avar(np.array([1.0]), 0.01)[0]))
    True
    """

    height: float = parameter_field("rad/s", "m/s²", signed=True)
    reversal: float = parameter_field("°C", positive=True)

    description: ClassVar[str] = "At the same temperature, the bias differs between heating and cooling."
    uses_temperature: ClassVar[bool] = True

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a series midway between the two branches."""
        state = 0.0
        last_c: float | None = None

        def add_hysteresis(values: Floats, block: SampleBlockContext) -> None:
            nonlocal state, last_c
            before_c = float(block.temperature_c[0]) if last_c is None else last_c
            state = _add_hysteresis(values, block.temperature_c, before_c, state, self.height, 1.0 / self.reversal)
            last_c = float(block.temperature_c[-1])

        return RunningSource(add_hysteresis)


@compiled
def _add_hysteresis(
    values: Floats, temperature_c: Floats, last_c: float, state: float, height: float, slope: float
) -> float:
    for k in range(values.size):
        state = min(max(state + slope * (temperature_c[k] - last_c), -0.5), 0.5)
        last_c = temperature_c[k]
        values[k] += height * state
    return state
