"""Role of each effect in the likelihood of an axis: noise, deterministic regressor or spectral transform.

The **size** of an effect is the scaling parameter, and all other parameters are **shape parameters**. A noise effect
adds variance to each frequency bin, proportional to the square of the size. A deterministic effect adds a series, which
is the product of size and **regressor**. The regressor of an ``AxisLeak`` is another axis.
"""

from dataclasses import replace
from math import atan2, hypot, pi
from typing import Any, Final

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import AxisLeak, Effect, SampleBlockContext, Source
from monitor.noise.effects import (
    AngleRandomWalk,
    BiasInstability,
    BiasStep,
    CrossAxis,
    ExponentiallyCorrelated,
    GSensitivity,
    Narrowband,
    PoissonSteps,
    QuantizationNoise,
    RandomTelegraph,
    RateRamp,
    RateRandomWalk,
    Sinusoidal,
    TemperatureBias,
    TemperatureLag,
    TurnOnTransient,
)

NOISE_SIZE_PARAMETERS: Final[dict[type[Effect], str]] = {
    QuantizationNoise: "Q",
    AngleRandomWalk: "N",
    BiasInstability: "B",
    RateRandomWalk: "K",
    ExponentiallyCorrelated: "sigma",
    Narrowband: "sigma",
    RandomTelegraph: "amplitude",
    PoissonSteps: "height",
}
"""For each noise effect, the name of the size parameter."""

DETERMINISTIC_SIZE_PARAMETERS: Final[dict[type[Effect], str]] = {
    RateRamp: "R",
    Sinusoidal: "amplitude",
    TemperatureBias: "coefficient",
    TemperatureLag: "coefficient",
    TurnOnTransient: "amplitude",
    BiasStep: "height",
    GSensitivity: "coefficient",
    CrossAxis: "coefficient",
}
"""For each deterministic effect, the name of the size parameter."""

SIZE_PARAMETERS: Final = NOISE_SIZE_PARAMETERS | DETERMINISTIC_SIZE_PARAMETERS
"""For each effect with a size, the name of the size parameter."""

ONE_TIME_EFFECTS: Final = frozenset({"bias_step", "noise_step", "turn_on_transient"})
"""Names of the effects that happen at most once in a recording."""

_EFFECTS_BY_DIAGNOSTIC: Final = {
    "psd": (
        *("quantization_noise", "angle_random_walk", "bias_instability", "rate_random_walk"),
        *("exponentially_correlated", "scale_factor", "narrowband", "bandwidth_limit"),
    ),
    "lines": ("sinusoidal",),
    "temperature": ("temperature_bias", "temperature_lag"),
    "other_axes": ("g_sensitivity", "cross_axis"),
    "level": ("bias_step", "rate_ramp", "turn_on_transient"),
    "tails": ("outliers",),
    "variance": ("noise_step",),
    "values": ("resolution", "saturation", "sample_hold"),
}
MOST_DIRECT_DIAGNOSTIC: Final = {effect: lens for lens, effects in _EFFECTS_BY_DIAGNOSTIC.items() for effect in effects}
"""Diagnostic that is most sensitive to each effect."""


def effect_size(effect: Effect) -> float:
    """Return the size parameter of a noise effect or a deterministic effect."""
    return float(getattr(effect, SIZE_PARAMETERS[type(effect)]))


def with_effect_size(effect: Effect, size: float) -> Effect:
    """Return a copy of an effect with a new size.

    The sizes of noise effects, ramps and sinusoids are never negative.

    Parameters
    ----------
    effect : Effect
        Noise effect or deterministic effect.
    size : float
        New size, in the unit of the size parameter.
    """
    name = SIZE_PARAMETERS[type(effect)]
    unsigned = isinstance(effect, (RateRamp, Sinusoidal)) or type(effect) in NOISE_SIZE_PARAMETERS
    return replace(effect, **{name: abs(size) if unsigned else size})  # type: ignore[type-var]


def build_unit_regressors(effect: Effect, n: int, rate_hz: float, temperature_c: Floats | None) -> list[Floats]:
    """Build the regressors of a deterministic effect.

    A sinusoid has a regressor for each of two phases. A quadratic temperature effect has a linear and a quadratic
    regressor. Other effects have one regressor.

    Parameters
    ----------
    effect : Effect
        Deterministic effect.
    n : int
        Number of samples.
    rate_hz : float
        Sample rate in Hz.
    temperature_c : ndarray of float64, shape (n,), or None
        Temperature in °C.

    Returns
    -------
    list of ndarray of float64, shape (n,)
        One or two series.

    Raises
    ------
    TypeError
        If the effect is a leak from another axis.
    """
    if isinstance(effect, AxisLeak):
        raise TypeError("the series of a leak is another axis")
    variants: list[Any]
    if isinstance(effect, Sinusoidal):
        variants = [replace(effect, amplitude=1.0, phase=phase) for phase in (0.0, 0.5 * pi)]
    elif isinstance(effect, TemperatureBias) and effect.quadratic is not None:
        variants = [
            replace(effect, coefficient=1.0, quadratic=0.0),
            replace(effect, coefficient=0.0, quadratic=1.0),
        ]
    else:
        variants = [with_effect_size(effect, 1.0)]
    return [_series_of(one, n, rate_hz, temperature_c) for one in variants]


def with_regressor_factors(effect: Effect, factors: Floats) -> Effect:
    """Return a copy of an effect that equals the sum of the regressors times the given factors.

    Parameters
    ----------
    effect : Effect
        Deterministic effect.
    factors : ndarray of float64, shape (1,) or (2,)
        Factor for each regressor.
    """
    if isinstance(effect, Sinusoidal):
        return replace(effect, amplitude=hypot(*factors), phase=atan2(factors[1], factors[0]) % (2.0 * pi))
    if isinstance(effect, TemperatureBias) and effect.quadratic is not None:
        return replace(effect, coefficient=float(factors[0]), quadratic=float(factors[1]))
    return with_effect_size(effect, float(factors[0]))


def _series_of(effect: Source, n: int, rate_hz: float, temperature_c: Floats | None) -> Floats:
    values = np.zeros(n)
    known_c = np.full(n, np.nan) if temperature_c is None else temperature_c
    # a deterministic effect draws no random numbers, but the interface requires a generator
    effect.start_series(rate_hz, np.random.default_rng(0)).add_next_samples(
        values, SampleBlockContext(0, known_c, np.empty(n))
    )
    return values
