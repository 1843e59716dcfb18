"""Example parameters of all effects, with the other effects that each of them needs.

A transform needs noise to act on, and a leak needs a source. An effect without an entry is tested alone, with every
parameter at 0.3. A new effect is therefore tested before it has an entry. Effects of temperature and events that occur
once have no stated variance. Their example contains the expected series, computed independently in plain NumPy.
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
CORRELATED = ExponentiallyCorrelated(sigma=0.5, correlation_time=2.0)
TEMPERATURE = Temperature(mean=30.0, swing=4.0, period=300.0, wander=0.5, wander_time=60.0)


@dataclass(frozen=True)
class Example:
    """Parameters of an effect, the other effects of the model, and the expected series."""

    parameters: dict[str, float | str]
    other_effects: dict[str, tuple[Effect, ...]] = field(default_factory=dict)
    temperature: Temperature | None = None
    # maps (series without the effect [n], time s [n], temperature °C [n]) to the series with the effect [n]
    expected_series: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None


def apply_thermal_lag(temperature_c: np.ndarray, time_constant_s: float) -> np.ndarray:
    inside = [temperature_c[0]]
    for outside in temperature_c[:-1]:
        inside.append(outside + (inside[-1] - outside) * np.exp(-1.0 / (RATE_HZ * time_constant_s)))
    return np.array(inside)


def compute_hysteresis_state(temperature_c: np.ndarray, reversal_c: float) -> np.ndarray:
    """Return the state of a play operator, from −½ (cooling) to ½ (heating), shape [n].

    The state is the temperature minus the output of the play operator, divided by ``reversal_c``.
    """
    half, play_output, state = 0.5 * reversal_c, temperature_c[0], []
    for temperature in temperature_c:
        play_output = min(max(play_output, temperature - half), temperature + half)
        state.append((temperature - play_output) / reversal_c)
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
        temperature=TEMPERATURE,
        expected_series=lambda x, t, c: x + 0.3 * (c - 25.0) - 0.04 * (c - 25.0) ** 2 + 0.002 * (c - 25.0) ** 3,
    ),
    "temperature_lag": Example(
        {"coefficient": 0.3, "reference": 25.0, "time_constant": 8.0},
        temperature=TEMPERATURE,
        expected_series=lambda x, t, c: x + 0.3 * (apply_thermal_lag(c, 8.0) - 25.0),
    ),
    "bias_curve": Example(
        {"slope": 0.3, "curvature": -0.02, "logarithmic": 0.7, "time_constant": 8.0},
        expected_series=lambda x, t, c: x + 0.3 * t - 0.02 * t**2 + 0.7 * np.log(1.0 + t / 8.0),
    ),
    "variance_modulation": Example({"depth": 0.7, "period": 3.0}, {AXIS: (WHITE,)}),
    "wandering_variance": Example({"deviation": 0.7, "correlation_time": 0.05}, {AXIS: (WHITE,)}),
    "pulse_train": Example({"height": -0.7, "period": 0.14, "width": 0.04}),
    "temperature_hysteresis": Example(
        {"height": 0.7, "reversal": 0.6},
        temperature=TEMPERATURE,
        expected_series=lambda x, t, c: x + 0.7 * compute_hysteresis_state(c, 0.6),
    ),
    "turn_on_transient": Example(
        {"amplitude": -0.7, "time_constant": 8.0}, expected_series=lambda x, t, c: x - 0.7 * np.exp(-t / 8.0)
    ),
    "bias_step": Example({"time": 3.3, "height": -0.7}, expected_series=lambda x, t, c: x - 0.7 * (t > 3.3 - 1e-9)),
    "noise_step": Example(
        {"time": 3.3, "ratio": 0.4},
        {AXIS: (WHITE,)},
        expected_series=lambda x, t, c: np.where(t > 3.3 - 1e-9, 0.4, 1.0) * x,
    ),
    "heavy_tails": Example({"nu": 6.0, "share": 0.7}, {AXIS: (WHITE,)}),
    "g_sensitivity": Example({"source": "az", "coefficient": -0.7}, {AXIS: (WHITE,), "az": (WHITE, CORRELATED)}),
    "cross_axis": Example({"source": "gx", "coefficient": 0.7}, {AXIS: (WHITE,), "gx": (CORRELATED,)}),
    "axis_permutation": Example({"source": "gx"}, {AXIS: (WHITE,), "gx": (CORRELATED,)}),
    "unit_error": Example({"factor": 0.6}, {AXIS: (WHITE, CORRELATED)}, expected_series=lambda x, t, c: 0.6 * x),
    "scale_factor": Example({"factor": 1.3}, {AXIS: (WHITE, CORRELATED)}, expected_series=lambda x, t, c: 1.3 * x),
    "bandwidth_limit": Example(
        {"cutoff": 6.0, "order": 2, "floor": 0.05, "kind": "fir"},
        {AXIS: (WHITE, CORRELATED, Sinusoidal(amplitude=0.4, frequency=7.3))},
    ),
    "sample_rate_error": Example({"ratio": 1.3}, {AXIS: (CORRELATED, RateRandomWalk(K=0.1))}),
    "saturation": Example({"limit": 2.5}, {AXIS: (WHITE,)}, expected_series=lambda x, t, c: np.clip(x, -2.5, 2.5)),
    "resolution": Example(
        {"step": 2.0}, {AXIS: (WHITE, CORRELATED)}, expected_series=lambda x, t, c: 2.0 * np.floor(x / 2.0 + 0.5)
    ),
    "sample_hold": Example({"fraction": 0.3}, {AXIS: (WHITE, CORRELATED)}),
}


def get_example(name: str) -> Example:
    """Return the entry of an effect, or an example with every parameter at 0.3.

    The value is not 1, so that a missing square changes the result.
    """
    return EXAMPLES.get(name) or Example(dict.fromkeys(gyro_and_accel_units(EFFECTS[name]), 0.3))


def make_effect(name: str) -> Effect:
    """Return the effect with the parameters of its example."""
    return EFFECTS[name](**get_example(name).parameters)


def make_model_without_effect(name: str) -> NoiseModel:
    """Return the model of the example without the effect itself."""
    return NoiseModel(get_example(name).other_effects, RATE_HZ, get_example(name).temperature)


def make_model(name: str) -> NoiseModel:
    """Return the model of the example with the effect on ``AXIS``."""
    return make_model_without_effect(name) + NoiseModel({AXIS: (make_effect(name),)})
