"""Role of each effect in the likelihood of an axis: noise, deterministic regressor or spectral transform.

The **size** of an effect is the scaling parameter, and all other parameters are **shape parameters**. A noise effect
adds variance to each frequency bin, proportional to the square of the size. A deterministic effect adds a series, which
is the product of size and **regressor**. The regressor of an ``AxisLeak`` is another axis.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import atan2, copysign, cos, hypot, pi, sin
from typing import Any, Final

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import Effect, SampleBlockContext, Source
from monitor.noise.effects import (
    BandwidthLimit,
    CommonVibration,
    ConstantBias,
    PoissonSteps,
    PulseTrain,
    RandomTelegraph,
    RateRamp,
    Resolution,
    SampleRateError,
    ScaleFactor,
    Sinusoidal,
)
from monitor.reconcile.effect_properties import (
    EFFECT_PROPERTIES,
    NOISE_SIZE_PARAMETERS,
    ONE_TIME_EFFECTS,
    SIZE_PARAMETERS,
)

MAX_REGRESSORS: Final = 3
"""Largest number of regressors of an effect."""

UNSIGNED_SERIES: Final = (RateRamp, Sinusoidal)
"""Deterministic effects whose sign or phase differs between recordings."""
NON_GAUSSIAN_NOISES: Final = (PoissonSteps, RandomTelegraph)
GAUSSIAN_TRANSFORMS: Final = (BandwidthLimit, ConstantBias, Resolution, SampleRateError, ScaleFactor)
"""Effects without a size that keep Gaussian noise Gaussian and stationary. Quantization does so with small steps."""


def linear_coefficient_names(effect: Effect) -> tuple[str, ...]:
    """Return the names of the linear coefficients of a deterministic effect, beginning with the size."""
    return tuple(name for name in EFFECT_PROPERTIES[effect.name].sizes if getattr(effect, name) is not None)


def regressor_count(effect: Effect) -> int:
    """Return the number of regressors of a deterministic effect.

    A sinusoid has a regressor for each of two phases. A polynomial has a regressor for each coefficient.
    Other effects have one regressor.
    """
    return 2 if isinstance(effect, Sinusoidal) else len(linear_coefficient_names(effect))


def is_noise_effect(effect: Effect) -> bool:
    """Return True if an effect adds noise, whose size is a parameter of the effect."""
    return getattr(effect, NOISE_SIZE_PARAMETERS.get(effect.name, ""), None) is not None


def is_repeatable_series(effect: Effect) -> bool:
    """Return True if a deterministic effect has the same size in all recordings of a sensor.

    Events that happen only once are excluded, and pulses, because the height depends on the fitted delay.
    """
    is_series = effect.name in SIZE_PARAMETERS and effect.name not in NOISE_SIZE_PARAMETERS
    return is_series and effect.name not in ONE_TIME_EFFECTS and not isinstance(effect, PulseTrain)


def has_same_size(a: Effect, b: Effect) -> bool:
    """Return True if two effects with the same name have equal sizes and equal linear coefficients."""
    return all(getattr(a, name) == getattr(b, name) for name in EFFECT_PROPERTIES[a.name].sizes)


def regression_coefficients(effect: Effect) -> Floats:
    """Return the coefficient of each regressor of a deterministic effect, shape (q,).

    For a sinusoid, the phase is zero if it is unknown.
    """
    if isinstance(effect, Sinusoidal):
        phase = effect.phase or 0.0
        return effect.amplitude * np.array([cos(phase), sin(phase)])
    return np.array([getattr(effect, name) for name in linear_coefficient_names(effect)], np.float64)


def is_stationary_gaussian(effects: Sequence[Effect]) -> bool:
    """Return True if the sum of all effects is stationary Gaussian noise with a known mean."""
    return not any(
        isinstance(effect, NON_GAUSSIAN_NOISES)
        or not (effect.name in SIZE_PARAMETERS or isinstance(effect, GAUSSIAN_TRANSFORMS))
        for effect in effects
    )


def effect_size(effect: Effect) -> float:
    """Return the size parameter of a noise effect or a deterministic effect. A noise effect has no sign."""
    size = float(getattr(effect, SIZE_PARAMETERS[effect.name]))
    return abs(size) if effect.name in NOISE_SIZE_PARAMETERS else size


def with_effect_size(effect: Effect, size: float) -> Effect:
    """Return a copy of an effect with a new size.

    The sizes of noise effects, ramps and sinusoids are never negative. A common vibration keeps its sign.

    Parameters
    ----------
    effect : Effect
        Noise effect or deterministic effect.
    size : float
        New size, in the unit of the size parameter.
    """
    name = SIZE_PARAMETERS[effect.name]
    if isinstance(effect, CommonVibration):
        return replace(effect, gain=copysign(size, effect.gain))
    unsigned = isinstance(effect, UNSIGNED_SERIES) or effect.name in NOISE_SIZE_PARAMETERS
    return replace(effect, **{name: abs(size) if unsigned else size})  # type: ignore[type-var]


def build_unit_regressors(effect: Effect, n: int, rate_hz: float, temperature_c: Floats | None) -> list[Floats]:
    """Build the regressors of a deterministic effect.

    Parameters
    ----------
    effect : Effect
        Deterministic effect that is not a leak from another axis.
    n : int
        Number of samples.
    rate_hz : float
        Sample rate in Hz.
    temperature_c : ndarray of float64, shape (n,), or None
        Temperature in °C.

    Returns
    -------
    list of ndarray of float64, shape (n,)
        Series of each of the ``regressor_count(effect)`` regressors.
    """
    variants: list[Any]
    if isinstance(effect, Sinusoidal):
        variants = [replace(effect, amplitude=1.0, phase=phase) for phase in (0.0, 0.5 * pi)]
    else:
        variants = [with_regression_coefficients(effect, unit) for unit in np.eye(regressor_count(effect))]
    return [_series_of(one, n, rate_hz, temperature_c) for one in variants]


def with_regression_coefficients(effect: Effect, coefficients: Floats) -> Effect:
    """Return a copy of an effect whose series is the sum of the regressors multiplied by the given coefficients.

    Parameters
    ----------
    effect : Effect
        Deterministic effect.
    coefficients : ndarray of float64, shape (q,)
        Coefficient of each regressor. Further coefficients are ignored.
    """
    if isinstance(effect, Sinusoidal):
        return replace(
            effect, amplitude=hypot(*coefficients[:2]), phase=atan2(coefficients[1], coefficients[0]) % (2.0 * pi)
        )
    if len(EFFECT_PROPERTIES[effect.name].sizes) > 1:
        changed: dict[str, Any] = dict(zip(linear_coefficient_names(effect), map(float, coefficients), strict=False))
        return replace(effect, **changed)  # type: ignore[type-var]
    return with_effect_size(effect, float(coefficients[0]))


def _series_of(effect: Source, n: int, rate_hz: float, temperature_c: Floats | None) -> Floats:
    values = np.zeros(n)
    known_c = np.broadcast_to(np.nan, n) if temperature_c is None else temperature_c
    # a deterministic effect draws no random numbers, but the interface requires a generator
    effect.start_series(rate_hz, np.random.default_rng(0)).add_next_samples(
        values, SampleBlockContext(0, known_c, np.empty(n))
    )
    return values
