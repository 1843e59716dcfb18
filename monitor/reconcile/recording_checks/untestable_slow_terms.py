"""Check for slow terms of the model that cannot be tested because the recording is too short.

A term with a time constant needs a recording that is several time constants long. The rate random walk and the bias
instability are compared with the white noise at the lowest frequency, which is the inverse of the duration of the
recording.
"""

from typing import Final

import numpy as np

from monitor.noise.effect import Effect
from monitor.noise.effects import (
    AngleRandomWalk,
    BiasInstability,
    ExponentiallyCorrelated,
    RandomTelegraph,
    RateRandomWalk,
)
from monitor.noise.model import NoiseModel
from monitor.reconcile.recording_checks.recording_under_test import CheckResult, RecordingUnderTest
from monitor.reconcile.result import ParameterInterval, RecordingFinding

MIN_TIME_CONSTANTS: Final = 5.0
"""Shortest duration of a recording, as a multiple of the time constant of a term."""
MIN_POWER_RATIO: Final = 0.05
"""Smallest power of a visible term at the lowest frequency, relative to the white noise."""


def check_slow_terms(recording: RecordingUnderTest) -> CheckResult:
    """Report terms of the model that need a longer recording."""
    values, rate_hz, model = recording.values, recording.rate_hz, recording.model
    if model is None:
        return values, []
    duration_s = recording.sample_count / rate_hz
    hidden = {axis: names for axis in values if (names := _find_invisible_terms(axis, duration_s, rate_hz, model))}
    if not hidden:
        return values, []
    which = "; ".join(f"{', '.join(names)} of {axis}" for axis, names in hidden.items())
    return values, [
        RecordingFinding(
            "too_short",
            tuple(hidden),
            f"The recording of {duration_s:.4g} s is too short to test these terms of the model: {which}.",
            {"duration": ParameterInterval(duration_s)},
            {"terms": float(sum(len(names) for names in hidden.values()))},
            corrected=False,
        )
    ]


def _find_invisible_terms(axis: str, duration_s: float, rate_hz: float, model: NoiseModel) -> list[str]:
    effects = model.effects.get(axis, ())
    white = sum(effect.N**2 for effect in effects if isinstance(effect, AngleRandomWalk))
    return [effect.name.replace("_", " ") for effect in effects if _is_invisible(effect, duration_s, rate_hz, white)]


def _is_invisible(effect: Effect, duration_s: float, rate_hz: float, white: float) -> bool:
    """Return True if a recording of this duration does not show the effect."""
    if isinstance(effect, ExponentiallyCorrelated):
        return effect.correlation_time * MIN_TIME_CONSTANTS > duration_s
    if isinstance(effect, RandomTelegraph):
        return effect.dwell_time * MIN_TIME_CONSTANTS > duration_s
    if isinstance(effect, RateRandomWalk | BiasInstability):
        own = float(effect.spectrum(1.0 / rate_hz).density(np.array([1.0 / duration_s]))[0])
        return 0.0 < own < MIN_POWER_RATIO * white
    return False
