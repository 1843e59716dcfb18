"""The clock of the whole recording: is its true rate the stated one?

A wrong rate moves everything along the axis of frequency, on all axes by one ratio. It can be told where the model has
a feature that stands at one frequency, a line or a resonance: such a feature is then missing where it should be, and
one stands where it should not. Without a feature a wrong rate is a wrong N, and nobody can tell.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import exp, log
from typing import Any, Final

import numpy as np

from monitor.noise.effect import Effect
from monitor.noise.effects import Narrowband, Sinusoidal
from monitor.reconcile.diagnostics.diagnostics import periodogram, sight
from monitor.reconcile.likelihood.hypothesis import GOLDEN, HALF, believed
from monitor.reconcile.preparation.axis import Axis, Effects
from monitor.reconcile.result import Bounds
from monitor.reconcile.search.candidates import peaks

FURTHEST: Final = 0.15
"""A clock that is further off is another sensor."""
OTHERS: Final = 6.0
"""Nats that everything but the strongest feature must gain, the others and the noise of all axes; and that no feature
loses, which would then stand where it was."""
SAME: Final = 1.01
"""Factor between frequencies of one feature, seen on several axes."""
TRIED: Final = 12
"""Ratios at which all axes are fitted."""
PRICE: Final = 12.0
"""Nats: for the ratio, and for the features that may be meant."""
POWERS: Final[Mapping[str, float]] = {
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
"""Power of (true rate over stated rate) by which a parameter reads in stated time: S(f) becomes r S(rf), τ becomes
τ/r."""


@dataclass(frozen=True, slots=True)
class Clock:
    """A rate that is not the stated one."""

    ratio: Bounds  # true over stated
    gain: float  # nats over all axes
    axis: str  # where it shows most
    frequency: tuple[float, float]  # Hz, of the feature: as the model has it, as it is seen


def restated(effect: Effect, ratio: float) -> Effect:
    """The effect as it reads in a recording whose clock states 1/ratio of the true rate.

    >>> restated(Sinusoidal(amplitude=1.0, frequency=10.1), 1.01).frequency
    10.0
    """
    changed: dict[str, Any] = {
        name: getattr(effect, name) * ratio**power for name, power in POWERS.items() if getattr(effect, name, None)
    }
    return replace(effect, **changed) if changed else effect  # type: ignore[type-var]


def wrong_clock(axes: Mapping[str, Axis], effects: Mapping[str, Effects]) -> Clock | None:
    """The ratio at which all axes together fit best, if it is worth its price."""
    trials = _ratios(axes, effects)
    if not trials:
        return None
    before = {name: believed(axes[name], effects[name]).likely.log_likelihood for name in axes}

    def gains(x: float) -> dict[str, float]:
        changed = {name: tuple(restated(effect, exp(x)) for effect in effects[name]) for name in axes}
        return {name: believed(axes[name], changed[name]).likely.log_likelihood - before[name] for name in axes}

    def gain(x: float) -> float:
        return sum(gains(x).values())

    ratio, width = max(trials, key=lambda one: gain(log(one[0])))
    x = _highest(gain, log(ratio), width)
    top = gain(x)
    if top < PRICE:
        return None
    alone = _each(axes, effects, before, exp(x))
    if top - max(alone) < OTHERS or min(alone) < -OTHERS:
        return None
    ends = [_end(gain, x, top, sign * width) for sign in (-1.0, 1.0)]
    of_axes = gains(x)
    strongest = max(of_axes, key=lambda one: of_axes[one])
    features = [e for e in effects[strongest] if isinstance(e, (Sinusoidal, Narrowband))]
    stated = features[0].frequency if features else 0.0
    return Clock(Bounds(exp(x), exp(ends[0]), exp(ends[1])), top, strongest, (stated, stated / exp(x)))


def _each(
    axes: Mapping[str, Axis], effects: Mapping[str, Effects], before: Mapping[str, float], ratio: float
) -> list[float]:
    """Nats that each feature gains where the ratio puts it, alone; the strongest may have moved itself."""
    features = sorted({e.frequency for of in effects.values() for e in of if isinstance(e, (Sinusoidal, Narrowband))})
    groups: list[list[float]] = []
    for f_hz in features:
        if groups and f_hz < groups[-1][-1] * SAME:
            groups[-1].append(f_hz)
        else:
            groups.append([f_hz])
    gains = [0.0]
    for group in groups:
        gain = 0.0
        for name, of in effects.items():
            moved = tuple(restated(e, ratio) if getattr(e, "frequency", None) in group else e for e in of)
            if moved != of:
                gain += believed(axes[name], moved).likely.log_likelihood - before[name]
        gains.append(gain)
    return gains


def _ratios(axes: Mapping[str, Axis], effects: Mapping[str, Effects]) -> list[tuple[float, float]]:
    """(ratio, how far to look around it) that put features of the model where something is seen: the best of many."""
    found: list[tuple[float, float]] = []
    features = {name: [e for e in of if isinstance(e, (Sinusoidal, Narrowband))] for name, of in effects.items()}
    if not any(features.values()):
        return []
    highest = max(one.frequency for of in features.values() for one in of)
    first = next(iter(axes.values()))
    step = 0.25 * first.rate_hz / first.n / highest
    grid = np.arange(-FURTHEST, FURTHEST, step)  # ln ratio
    power = np.zeros(grid.size)
    for name, axis in axes.items():
        lines = [one for one in features[name] if isinstance(one, Sinusoidal)]
        if not features[name]:
            continue
        view = sight(axis, believed(axis, effects[name]).likely)
        turned = periodogram(view.white)
        spacing = axis.rate_hz / (2 * (turned.size - 1))
        for line in lines:
            power += turned[
                np.minimum(np.rint(line.frequency * np.exp(-grid) / spacing).astype(np.int64), turned.size - 1)
            ]
        for one in features[name]:
            if isinstance(one, Narrowband):
                places = [middle for middle, _ in peaks(view, 4)]
                near = [place for place in places if abs(log(one.frequency / place)) < FURTHEST]
                found += [(one.frequency / place, 2.0 * one.bandwidth / one.frequency) for place in near]
    for at in np.argsort(power)[-TRIED:]:
        if power[at] > 0.0:
            found.append((exp(float(grid[at])), 8.0 * step))
    return found


def _highest(gain: Any, x: float, width: float) -> float:
    lo, hi = x - width, x + width
    for _ in range(18):
        a, b = hi - GOLDEN * (hi - lo), lo + GOLDEN * (hi - lo)
        lo, hi = (lo, b) if gain(a) > gain(b) else (a, hi)
    return 0.5 * (lo + hi)


def _end(gain: Any, x: float, top: float, step: float) -> float:
    """Where the gain has fallen by HALF, on one side."""
    near, far = x, x + step
    for _ in range(12):
        if top - gain(far) > HALF:
            break
        near, far = far, x + 2.0 * (far - x)
    for _ in range(10):
        middle = 0.5 * (near + far)
        near, far = (near, middle) if top - gain(middle) > HALF else (middle, far)
    return far
