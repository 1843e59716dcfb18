"""How each effect enters the likelihood of an axis, said once for all that fit, propose and describe.

An effect has one **size** that scales it, and **shapes** that do not. Of a ``NOISE`` effect the variance grows with
the square of its size, and its spectrum with size one is its basis. A ``COURSE`` is a series times its size: the
regressor is that very series with size one, so that what is fitted is what would be simulated. A ``Leak`` is a course
whose series is another axis. A transform shapes the bases of all that stand before it.
"""

from dataclasses import replace
from math import atan2, hypot, pi
from typing import Any, Final

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import Block, Effect, Leak, Source
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

NOISE: Final[dict[type[Effect], str]] = {
    QuantizationNoise: "Q",
    AngleRandomWalk: "N",
    BiasInstability: "B",
    RateRandomWalk: "K",
    ExponentiallyCorrelated: "sigma",
    Narrowband: "sigma",
    RandomTelegraph: "amplitude",
    PoissonSteps: "height",
}
"""Effect -> the parameter that is its size."""

COURSE: Final[dict[type[Effect], str]] = {
    RateRamp: "R",
    Sinusoidal: "amplitude",
    TemperatureBias: "coefficient",
    TemperatureLag: "coefficient",
    TurnOnTransient: "amplitude",
    BiasStep: "height",
    GSensitivity: "coefficient",
    CrossAxis: "coefficient",
}

ONCE: Final = frozenset({"bias_step", "noise_step", "turn_on_transient"})
"""Effects that happen once: one part of a recording says nothing of another."""


NATURAL: Final[dict[str, str]] = {
    "quantization_noise": "psd",
    "angle_random_walk": "psd",
    "bias_instability": "psd",
    "rate_random_walk": "psd",
    "exponentially_correlated": "psd",
    "scale_factor": "psd",
    "sinusoidal": "lines",
    "narrowband": "psd",
    "bandwidth_limit": "psd",
    "temperature_bias": "temperature",
    "temperature_lag": "temperature",
    "g_sensitivity": "other_axes",
    "cross_axis": "other_axes",
    "bias_step": "level",
    "rate_ramp": "level",
    "turn_on_transient": "level",
    "outliers": "tails",
    "noise_step": "variance",
    "resolution": "values",
    "saturation": "values",
    "sample_hold": "values",
}
"""The lens through which a person would look for an effect, if it passes its threshold there."""


def size(effect: Effect) -> float:
    """Of a noise or a course."""
    return float(getattr(effect, (NOISE | COURSE)[type(effect)]))


def resized(effect: Effect, value: float) -> Effect:
    """The same with another size; a ramp and an amplitude of a line have no sign."""
    name = (NOISE | COURSE)[type(effect)]
    unsigned = isinstance(effect, (RateRamp, Sinusoidal)) or type(effect) in NOISE
    return replace(effect, **{name: abs(value) if unsigned else value})  # type: ignore[type-var]


def basis(effect: Effect, f_hz: Floats, tau0_s: float) -> Floats:
    """Two-sided spectrum [m] of a noise with size one, unit²/Hz before transforms."""
    assert isinstance(effect, Source)
    return np.asarray(resized(effect, 1.0).psd(f_hz, tau0_s))  # type: ignore[attr-defined]


def columns(effect: Effect, n: int, rate_hz: float, temperature_c: Floats | None) -> list[Floats]:
    """Series [n] whose sum, each times a factor, is a course of any size; two for what has a phase or a curve."""
    if isinstance(effect, Leak):
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
        variants = [resized(effect, 1.0)]
    return [_drawn(one, n, rate_hz, temperature_c) for one in variants]


def sized(effect: Effect, factors: Floats) -> Effect:
    """The effect whose columns have these factors."""
    if isinstance(effect, Sinusoidal):
        return replace(effect, amplitude=hypot(*factors), phase=atan2(factors[1], factors[0]) % (2.0 * pi))
    if isinstance(effect, TemperatureBias) and effect.quadratic is not None:
        return replace(effect, coefficient=float(factors[0]), quadratic=float(factors[1]))
    return resized(effect, float(factors[0]))


def _drawn(effect: Source, n: int, rate_hz: float, temperature_c: Floats | None) -> Floats:
    values = np.zeros(n)
    warmth = np.full(n, np.nan) if temperature_c is None else temperature_c
    # a course draws nothing: the generator is a formality
    effect.start(rate_hz, np.random.default_rng(0)).add(values, Block(0, warmth, np.empty(n)))
    return values
