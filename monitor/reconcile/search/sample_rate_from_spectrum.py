"""Detect a wrong sample rate from the spectrum of a recording.

A wrong sample rate multiplies all frequencies on all axes by the same ratio. The ratio can be estimated from the lines
and resonances of the noise model (**features**). Without features, a wrong sample rate cannot be distinguished from a
wrong N.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import exp, log
from typing import Any, Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.distributions import HALF_CHI2_95
from monitor.noise.effect import Effect
from monitor.noise.effects import Narrowband, PowerLaw, Sinusoidal
from monitor.reconcile.likelihood.axis_fit import Axis, Effects
from monitor.reconcile.likelihood.hypothesis_fit import find_maximum_by_golden_section, fit_deterministic_effects
from monitor.reconcile.likelihood.whitening import WhitenedAxis, whiten_axis
from monitor.reconcile.result import ParameterInterval
from monitor.reconcile.search.candidate_effects import find_broad_spectral_peaks

MAX_LOG_RATIO: Final = 0.15
"""Largest absolute logarithm of the ratio of sample rates."""
MIN_OTHER_GAIN_NATS: Final = 6.0
"""Smallest log-likelihood gain of all features except the strongest, and largest loss of a single feature, in nats."""
SAME_FEATURE_RATIO: Final = 1.01
"""Largest frequency ratio of the same feature on different axes."""
MAX_TRIAL_RATIOS: Final = 12
SAMPLE_RATE_PENALTY_NATS: Final = 12.0
SEARCH_ITERATIONS: Final = 18
RATIO_EXPONENTS: Final[Mapping[str, float]] = {
    "Q": 1.0,
    "N": 0.5,
    "floor": 0.5,
    "K": -0.5,
    "R": -1.0,
    "frequency": -1.0,
    "bandwidth": -1.0,
    "cutoff": -1.0,
    "correlation_time": 1.0,
    "dwell_time": 1.0,
    "time_constant": 1.0,
    "time": 1.0,
    "period": 1.0,
    "width": 1.0,
    "delay": 1.0,
    "slope": -1.0,
    "curvature": -2.0,
    "rate": -1.0,
}
"""Exponent of each parameter in the conversion from true time to stated time.

Let r be the ratio of true to stated sample rate. A spectral density S(f) in true time is r S(rf) in stated time.
"""
Feature = Sinusoidal | Narrowband
"""Effect at a known frequency."""


@dataclass(frozen=True, slots=True)
class SampleRateErrorEstimate:
    """Estimate of the ratio of true to stated sample rate."""

    ratio: ParameterInterval  # true rate over stated rate
    gain: float  # log-likelihood gain summed over all axes, nats
    axis: str  # axis with the largest gain
    frequency: tuple[float, float]  # frequency of the feature in the model and in the recording, Hz
    smallest_axis_gain: float = 0.0  # log-likelihood gain of the axis with the smallest gain, nats
    feature_gain: float = 0.0  # log-likelihood gain of the moved frequencies alone, nats


def convert_effect_to_stated_time(effect: Effect, rate_ratio: float) -> Effect:
    """Convert an effect from true time to the time scale of a recording with a wrong sample rate.

    Parameters
    ----------
    effect : Effect
        Effect with parameters in true time.
    rate_ratio : float
        True rate over stated rate.

    Examples
    --------
    >>> convert_effect_to_stated_time(Sinusoidal(amplitude=1.0, frequency=10.1), 1.01).frequency
    10.0
    """
    changed: dict[str, Any] = {
        name: getattr(effect, name) * rate_ratio**power
        for name, power in RATIO_EXPONENTS.items()
        if getattr(effect, name, None)
    }
    if isinstance(effect, PowerLaw):
        changed["density"] = effect.density * rate_ratio ** (0.5 * (1.0 - effect.exponent))
    return replace(effect, **changed) if changed else effect  # type: ignore[type-var]


def detect_sample_rate_error(
    axes: Mapping[str, Axis], effects: Mapping[str, Effects]
) -> SampleRateErrorEstimate | None:
    """Detect a sample rate error that is common to all axes.

    Parameters
    ----------
    axes : mapping of str to Axis
        Repaired axes of the recording.
    effects : mapping of str to tuple of Effect
        Effects of each axis in the model under test.

    Returns
    -------
    SampleRateErrorEstimate or None
        Most likely sample rate error of all axes, or None if no error is significant.
    """
    trials = _candidate_ratios(axes, effects)
    if not trials:
        return None
    before = {name: _log_likelihood(axes[name], effects[name]) for name in axes}

    def gain_by_axis(log_ratio: float) -> dict[str, float]:
        changed = {
            name: tuple(convert_effect_to_stated_time(effect, exp(log_ratio)) for effect in effects[name])
            for name in axes
        }
        return {name: _log_likelihood(axes[name], changed[name]) - before[name] for name in axes}

    def total_gain(log_ratio: float) -> float:
        return sum(gain_by_axis(log_ratio).values())

    ratio, width = max(trials, key=lambda one: total_gain(log(one[0])))
    x = find_maximum_by_golden_section(total_gain, log(ratio) - width, log(ratio) + width, SEARCH_ITERATIONS)
    top = total_gain(x)
    if top < SAMPLE_RATE_PENALTY_NATS:
        return None
    alone = _gain_per_feature(axes, effects, before, exp(x))
    if top - max(alone) < MIN_OTHER_GAIN_NATS or min(alone) < -MIN_OTHER_GAIN_NATS:
        return None
    ends = [_interval_end(total_gain, x, top, sign * width) for sign in (-1.0, 1.0)]
    of_axes = gain_by_axis(x)
    strongest = max(of_axes, key=lambda one: of_axes[one])
    features = _features(effects[strongest])
    stated = features[0].frequency if features else 0.0
    return SampleRateErrorEstimate(
        ParameterInterval(exp(x), exp(ends[0]), exp(ends[1])),
        top,
        strongest,
        (stated, stated / exp(x)),
        min(of_axes.values()),
        sum(alone),
    )


def _log_likelihood(axis: Axis, effects: Effects) -> float:
    return fit_deterministic_effects(axis, effects).log_likelihood


def _features(effects: Effects) -> list[Feature]:
    return [effect for effect in effects if isinstance(effect, Feature)]


def _gain_per_feature(
    axes: Mapping[str, Axis], effects: Mapping[str, Effects], before: Mapping[str, float], ratio: float
) -> list[float]:
    """Return the log-likelihood gain of each feature if only the feature frequency changes by the ratio."""
    groups: list[list[float]] = []
    for f_hz in sorted({feature.frequency for of in effects.values() for feature in _features(of)}):
        if groups and f_hz < groups[-1][-1] * SAME_FEATURE_RATIO:
            groups[-1].append(f_hz)
        else:
            groups.append([f_hz])
    gains = [0.0]
    for group in groups:
        gain = 0.0
        for name, of in effects.items():
            moved = tuple(
                convert_effect_to_stated_time(e, ratio) if getattr(e, "frequency", None) in group else e for e in of
            )
            if moved != of:
                gain += _log_likelihood(axes[name], moved) - before[name]
        gains.append(gain)
    return gains


def _candidate_ratios(axes: Mapping[str, Axis], effects: Mapping[str, Effects]) -> list[tuple[float, float]]:
    """Return the ratios of feature frequencies to observed peaks, with half the width of each search range."""
    features = {name: _features(of) for name, of in effects.items()}
    if not any(features.values()):
        return []
    highest = max(feature.frequency for of in features.values() for feature in of)
    first = next(iter(axes.values()))
    step = 0.25 * first.rate_hz / first.n / highest
    grid = np.arange(-MAX_LOG_RATIO, MAX_LOG_RATIO, step)  # ln ratio
    power = np.zeros(grid.size)
    found: list[tuple[float, float]] = []
    for name, axis in axes.items():
        if features[name]:
            whitened = whiten_axis(fit_deterministic_effects(axis, effects[name]))
            power += _line_power(whitened, features[name], np.exp(-grid))
            found += _resonance_ratios(whitened, features[name])
    strongest = [at for at in np.argsort(power)[-MAX_TRIAL_RATIOS:] if power[at] > 0.0]
    return found + [(exp(float(grid[at])), 8.0 * step) for at in strongest]


def _line_power(whitened: WhitenedAxis, features: list[Feature], factors: Floats) -> Floats:
    """For each factor, return the total power at the line frequencies multiplied by this factor."""
    power = np.zeros(factors.size)
    spectrum = whitened.periodogram
    spacing_hz = whitened.axis.rate_hz / (2 * (spectrum.size - 1))
    for line in features:
        if isinstance(line, Sinusoidal):
            at = np.rint(line.frequency * factors / spacing_hz).astype(np.int64)
            power += spectrum[np.minimum(at, spectrum.size - 1)]
    return power


def _resonance_ratios(whitened: WhitenedAxis, features: list[Feature]) -> list[tuple[float, float]]:
    return [
        (feature.frequency / peak_hz, 2.0 * feature.bandwidth / feature.frequency)
        for feature in features
        if isinstance(feature, Narrowband)
        for peak_hz, _ in find_broad_spectral_peaks(whitened, 4)
        if abs(log(feature.frequency / peak_hz)) < MAX_LOG_RATIO
    ]


def _interval_end(gain: Callable[[float], float], x: float, top: float, step: float) -> float:
    near, far = x, x + step
    for _ in range(12):
        if top - gain(far) > HALF_CHI2_95:
            break
        near, far = far, x + 2.0 * (far - x)
    for _ in range(10):
        middle = 0.5 * (near + far)
        near, far = (near, middle) if top - gain(middle) > HALF_CHI2_95 else (middle, far)
    return far
