"""Example parameters of effects, and what must stand beside each: a transform needs noise to act on, a leak a source.

An effect without an entry is tested alone with every parameter at 0.3: a new one is in the suite before it is here.
What happens once, or depends on temperature, has no stated variance; for those ``exact`` is the series itself, written
down a second time in plain NumPy.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from monitor.noise.effect import Effect, gyro_and_accel_units
from monitor.noise.effects import EFFECTS, AngleRandomWalk, ExponentiallyCorrelated, RateRandomWalk, Sinusoidal
from monitor.noise.model import NoiseModel
from monitor.noise.temperature import Temperature

RATE_HZ = 50.0
AXIS = "gz"
WHITE = AngleRandomWalk(N=0.3)
SLOW = ExponentiallyCorrelated(sigma=0.5, correlation_time=2.0)
WARM = Temperature(mean=30.0, swing=4.0, period=300.0, wander=0.5, wander_time=60.0)


@dataclass(frozen=True)
class Example:
    """An effect and its company."""

    parameters: dict[str, float | str]
    beside: dict[str, tuple[Effect, ...]] = field(default_factory=dict)
    temperature: Temperature | None = None
    # (the axis without the effect [n], time s [n], temperature °C [n]) -> the axis with it
    exact: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None


def lagged(temperature_c: np.ndarray, time_constant_s: float) -> np.ndarray:
    inside = [temperature_c[0]]
    for outside in temperature_c[:-1]:
        inside.append(outside + (inside[-1] - outside) * np.exp(-1.0 / (RATE_HZ * time_constant_s)))
    return np.array(inside)


def branch(temperature_c: np.ndarray, reversal_c: float) -> np.ndarray:
    """From −½ (cooling) to ½ (heating): how far T is above the play operator's p, which is within ± half a reversal."""
    half, follower, state = 0.5 * reversal_c, temperature_c[0], []
    for one in temperature_c:
        follower = min(max(follower, one - half), one + half)
        state.append((one - follower) / reversal_c)
    return np.array(state)


EXAMPLES = {
    "exponentially_correlated": Example({"sigma": 0.7, "correlation_time": 0.8}),
    "sinusoidal": Example({"amplitude": 0.7, "frequency": 7.3}),
    "narrowband": Example({"sigma": 0.7, "frequency": 7.3, "bandwidth": 0.9}),
    "wandering_line": Example(
        {"amplitude": 0.7, "frequency": 7.3, "frequency_deviation": 0.9, "correlation_time": 0.1}
    ),
    "common_vibration": Example({"source_number": 2, "gain": -0.7, "bandwidth": 0.9, "frequency": 7.3}),
    "random_telegraph": Example({"amplitude": 0.7, "dwell_time": 0.4}),
    "poisson_steps": Example({"rate": 3.0, "height": 0.7}),
    "power_law": Example({"density": 0.7, "exponent": 1.5}),
    "outliers": Example({"fraction": 0.03, "scale": 0.7}),
    "temperature_bias": Example(
        {"coefficient": 0.3, "reference": 25.0, "quadratic": -0.04, "cubic": 0.002},
        temperature=WARM,
        exact=lambda x, t, c: x + 0.3 * (c - 25.0) - 0.04 * (c - 25.0) ** 2 + 0.002 * (c - 25.0) ** 3,
    ),
    "temperature_lag": Example(
        {"coefficient": 0.3, "reference": 25.0, "time_constant": 8.0},
        temperature=WARM,
        exact=lambda x, t, c: x + 0.3 * (lagged(c, 8.0) - 25.0),
    ),
    "bias_curve": Example(
        {"slope": 0.3, "curvature": -0.02, "logarithmic": 0.7, "time_constant": 8.0},
        exact=lambda x, t, c: x + 0.3 * t - 0.02 * t**2 + 0.7 * np.log(1.0 + t / 8.0),
    ),
    "variance_modulation": Example({"depth": 0.7, "period": 3.0}, {AXIS: (WHITE,)}),
    "pulse_train": Example({"height": -0.7, "period": 0.14, "width": 0.04}),
    "temperature_hysteresis": Example(
        {"height": 0.7, "reversal": 0.6},
        temperature=WARM,
        exact=lambda x, t, c: x + 0.7 * branch(c, 0.6),
    ),
    "turn_on_transient": Example(
        {"amplitude": -0.7, "time_constant": 8.0}, exact=lambda x, t, c: x - 0.7 * np.exp(-t / 8.0)
    ),
    "bias_step": Example({"time": 3.3, "height": -0.7}, exact=lambda x, t, c: x - 0.7 * (t > 3.3 - 1e-9)),
    "noise_step": Example(
        {"time": 3.3, "ratio": 0.4},
        {AXIS: (WHITE,)},
        exact=lambda x, t, c: np.where(t > 3.3 - 1e-9, 0.4, 1.0) * x,
    ),
    "heavy_tails": Example({"nu": 6.0, "share": 0.7}, {AXIS: (WHITE,)}),
    "g_sensitivity": Example({"source": "az", "coefficient": -0.7}, {AXIS: (WHITE,), "az": (WHITE, SLOW)}),
    "cross_axis": Example({"source": "gx", "coefficient": 0.7}, {AXIS: (WHITE,), "gx": (SLOW,)}),
    "axis_permutation": Example({"source": "gx"}, {AXIS: (WHITE,), "gx": (SLOW,)}),
    "unit_error": Example({"factor": 0.6}, {AXIS: (WHITE, SLOW)}, exact=lambda x, t, c: 0.6 * x),
    "scale_factor": Example({"factor": 1.3}, {AXIS: (WHITE, SLOW)}, exact=lambda x, t, c: 1.3 * x),
    "bandwidth_limit": Example(
        {"cutoff": 6.0, "order": 2, "floor": 0.05, "kind": "fir"},
        {AXIS: (WHITE, SLOW, Sinusoidal(amplitude=0.4, frequency=7.3))},
    ),
    "sample_rate_error": Example({"ratio": 1.3}, {AXIS: (SLOW, RateRandomWalk(K=0.1))}),
    "saturation": Example({"limit": 2.5}, {AXIS: (WHITE,)}, exact=lambda x, t, c: np.clip(x, -2.5, 2.5)),
    "resolution": Example({"step": 2.0}, {AXIS: (WHITE, SLOW)}, exact=lambda x, t, c: 2.0 * np.floor(x / 2.0 + 0.5)),
    "sample_hold": Example({"fraction": 0.3}, {AXIS: (WHITE, SLOW)}),
}


def example(name: str) -> Example:
    """The entry, or every parameter at 0.3: a value that is not one, so that a lost square shows."""
    return EXAMPLES.get(name) or Example(dict.fromkeys(gyro_and_accel_units(EFFECTS[name]), 0.3))


def effect(name: str) -> Effect:
    """The effect of the example."""
    return EFFECTS[name](**example(name).parameters)


def without(name: str) -> NoiseModel:
    """What stands beside the effect."""
    return NoiseModel(example(name).beside, RATE_HZ, example(name).temperature)


def model(name: str) -> NoiseModel:
    """The effect on its axis, and what stands beside it."""
    return without(name) + NoiseModel({AXIS: (effect(name),)})
