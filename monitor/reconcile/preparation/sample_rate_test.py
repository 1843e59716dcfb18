"""Test of whether the true sample rate of a recording differs from the stated one.

A wrong sample rate shifts all frequencies on all axes by one ratio. It is detectable if the model has a feature at a
known frequency, such as a line or a resonance. The feature is then missing at its own frequency and appears at another
one. Without such a feature, a wrong sample rate cannot be distinguished from a wrong N.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import exp, log
from typing import Any, Final

import numpy as np

from monitor.common.distributions import HALF_CHI2_95
from monitor.noise.effect import Effect
from monitor.noise.effects import Narrowband, Sinusoidal
from monitor.reconcile.diagnostics.diagnostics import periodogram, whiten_axis
from monitor.reconcile.likelihood.hypothesis import GOLDEN, fit_with_given_sizes
from monitor.reconcile.preparation.axis import Axis, Effects
from monitor.reconcile.result import ParameterInterval
from monitor.reconcile.search.candidates import find_spectral_peaks

MAX_LOG_RATIO: Final = 0.15
"""Largest absolute logarithm of the ratio. A larger error means that the recording is from another sensor."""
MIN_OTHER_GAIN_NATS: Final = 6.0
"""Log-likelihood gain in nats that everything except the strongest feature must reach: the other features and the noise
of all axes. It is also the largest loss of a single feature. A feature that loses more has stayed at its stated
frequency.
"""
SAME_FEATURE_RATIO: Final = 1.01
"""Largest ratio of two frequencies, on any axes, that belong to the same feature."""
MAX_TRIAL_RATIOS: Final = 12
"""Number of ratios at which all axes are fitted."""
SAMPLE_RATE_PENALTY_NATS: Final = 12.0
"""Penalty in nats for the ratio and for the choice of features."""
RATIO_EXPONENTS: Final[Mapping[str, float]] = {
    "Q": 1.0,
    "N": 0.5,
    "K": -0.5,
    "R": -1.0,
    "frequency": -1.0,
    "bandwidth": -1.0,
    "cutoff": -1.0,
    "correlation_time": 1.0,
    "dwell_time": 1.0,
    "time_constant": 1.0,
    "time": 1.0,
    "rate": -1.0,
}
"""For each parameter, the power of r = (true rate / stated rate) that converts it to stated time: S(f) becomes r S(rf),
and τ becomes τ/r.
"""


@dataclass(frozen=True, slots=True)
class SampleRateErrorEstimate:
    """Detected error of the sample rate."""

    ratio: ParameterInterval  # true rate over stated rate
    gain: float  # log-likelihood gain summed over all axes, nats
    axis: str  # axis with the largest gain
    frequency: tuple[float, float]  # frequency of the feature in the model and in the recording, Hz


def in_stated_time(effect: Effect, ratio: float) -> Effect:
    """Return the effect as it appears in a recording whose stated sample rate is 1/ratio of the true rate.

    Parameters
    ----------
    effect : Effect
        Effect in true time.
    ratio : float
        True rate over stated rate.

    Examples
    --------
    >>> in_stated_time(Sinusoidal(amplitude=1.0, frequency=10.1), 1.01).frequency
    10.0
    """
    changed: dict[str, Any] = {
        name: getattr(effect, name) * ratio**power
        for name, power in RATIO_EXPONENTS.items()
        if getattr(effect, name, None)
    }
    return replace(effect, **changed) if changed else effect  # type: ignore[type-var]


def detect_sample_rate_error(
    axes: Mapping[str, Axis], effects: Mapping[str, Effects]
) -> SampleRateErrorEstimate | None:
    """Detect a sample rate error that is common to all axes.

    Parameters
    ----------
    axes : mapping of str to Axis
        Prepared axes of the recording.
    effects : mapping of str to tuple of Effect
        Effects of each axis in the model under test.

    Returns
    -------
    Clock or None
        The ratio at which all axes together fit best, or None if its gain does not exceed the penalty.
    """
    trials = _candidate_ratios(axes, effects)
    if not trials:
        return None
    before = {name: fit_with_given_sizes(axes[name], effects[name]).likely.log_likelihood for name in axes}

    def gains(x: float) -> dict[str, float]:
        changed = {name: tuple(in_stated_time(effect, exp(x)) for effect in effects[name]) for name in axes}
        return {
            name: fit_with_given_sizes(axes[name], changed[name]).likely.log_likelihood - before[name] for name in axes
        }

    def gain(x: float) -> float:
        return sum(gains(x).values())

    ratio, width = max(trials, key=lambda one: gain(log(one[0])))
    x = _maximise_gain(gain, log(ratio), width)
    top = gain(x)
    if top < SAMPLE_RATE_PENALTY_NATS:
        return None
    alone = _gain_per_feature(axes, effects, before, exp(x))
    if top - max(alone) < MIN_OTHER_GAIN_NATS or min(alone) < -MIN_OTHER_GAIN_NATS:
        return None
    ends = [_interval_end(gain, x, top, sign * width) for sign in (-1.0, 1.0)]
    of_axes = gains(x)
    strongest = max(of_axes, key=lambda one: of_axes[one])
    features = [e for e in effects[strongest] if isinstance(e, (Sinusoidal, Narrowband))]
    stated = features[0].frequency if features else 0.0
    return SampleRateErrorEstimate(
        ParameterInterval(exp(x), exp(ends[0]), exp(ends[1])), top, strongest, (stated, stated / exp(x))
    )


def _gain_per_feature(
    axes: Mapping[str, Axis], effects: Mapping[str, Effects], before: Mapping[str, float], ratio: float
) -> list[float]:
    """Return the gain in nats of each feature when only this feature is moved by the ratio."""
    features = sorted({e.frequency for of in effects.values() for e in of if isinstance(e, (Sinusoidal, Narrowband))})
    groups: list[list[float]] = []
    for f_hz in features:
        if groups and f_hz < groups[-1][-1] * SAME_FEATURE_RATIO:
            groups[-1].append(f_hz)
        else:
            groups.append([f_hz])
    gains = [0.0]
    for group in groups:
        gain = 0.0
        for name, of in effects.items():
            moved = tuple(in_stated_time(e, ratio) if getattr(e, "frequency", None) in group else e for e in of)
            if moved != of:
                gain += fit_with_given_sizes(axes[name], moved).likely.log_likelihood - before[name]
        gains.append(gain)
    return gains


def _candidate_ratios(axes: Mapping[str, Axis], effects: Mapping[str, Effects]) -> list[tuple[float, float]]:
    """Return the best ratios that move features of the model to observed peaks, each with the width of the search
    around it.
    """
    found: list[tuple[float, float]] = []
    features = {name: [e for e in of if isinstance(e, (Sinusoidal, Narrowband))] for name, of in effects.items()}
    if not any(features.values()):
        return []
    highest = max(one.frequency for of in features.values() for one in of)
    first = next(iter(axes.values()))
    step = 0.25 * first.rate_hz / first.n / highest
    grid = np.arange(-MAX_LOG_RATIO, MAX_LOG_RATIO, step)  # ln ratio
    power = np.zeros(grid.size)
    for name, axis in axes.items():
        lines = [one for one in features[name] if isinstance(one, Sinusoidal)]
        if not features[name]:
            continue
        view = whiten_axis(axis, fit_with_given_sizes(axis, effects[name]).likely)
        turned = periodogram(view.white)
        spacing = axis.rate_hz / (2 * (turned.size - 1))
        for line in lines:
            power += turned[
                np.minimum(np.rint(line.frequency * np.exp(-grid) / spacing).astype(np.int64), turned.size - 1)
            ]
        for one in features[name]:
            if isinstance(one, Narrowband):
                places = [middle for middle, _ in find_spectral_peaks(view, 4)]
                near = [place for place in places if abs(log(one.frequency / place)) < MAX_LOG_RATIO]
                found += [(one.frequency / place, 2.0 * one.bandwidth / one.frequency) for place in near]
    for at in np.argsort(power)[-MAX_TRIAL_RATIOS:]:
        if power[at] > 0.0:
            found.append((exp(float(grid[at])), 8.0 * step))
    return found


def _maximise_gain(gain: Any, x: float, width: float) -> float:
    """Return the logarithm of the ratio with the largest gain, by golden-section search."""
    lo, hi = x - width, x + width
    for _ in range(18):
        a, b = hi - GOLDEN * (hi - lo), lo + GOLDEN * (hi - lo)
        lo, hi = (lo, b) if gain(a) > gain(b) else (a, hi)
    return 0.5 * (lo + hi)


def _interval_end(gain: Any, x: float, top: float, step: float) -> float:
    """Return the point on one side of the maximum at which the gain has fallen by ``HALF_CHI2_95``."""
    near, far = x, x + step
    for _ in range(12):
        if top - gain(far) > HALF_CHI2_95:
            break
        near, far = far, x + 2.0 * (far - x)
    for _ in range(10):
        middle = 0.5 * (near + far)
        near, far = (near, middle) if top - gain(middle) > HALF_CHI2_95 else (middle, far)
    return far
