"""A hypothesis about one axis: the effects of the model, some of them of another size, and effects that were found.

The sizes that a model gives are believed until the data object: the size of a noise is fitted only where that is worth
RETUNED nats of likelihood. So a model whose N is 5 % off gets another N and no new name, while a K that is right keeps
its weight against everything that looks like a random walk. Sizes of what was found, and of all courses (a line, a
slope, what follows temperature), are always fitted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import exp, log
from typing import Any, Final

import numpy as np

from monitor.noise.effect import Effect
from monitor.reconcile.likelihood.effect_terms import COURSE, NOISE, size
from monitor.reconcile.preparation.axis import Axis, Effects, Likely
from monitor.reconcile.result import Bounds

RETUNED: Final = 5.0
"""Nats that another size of a known noise must be worth."""
Z95: Final = 1.959964
HALF: Final = 1.920729
"""Nats below the maximum at the ends of a 95 % interval of one parameter: χ²(0.95; 1)/2."""
GOLDEN: Final = 0.6180339887498949


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Effects, fitted."""

    model: Effects  # of the model under test, as it stands; they are the first of ``effects``
    likely: Likely

    @property
    def given(self) -> int:
        """How many effects stand in the model under test."""
        return len(self.model)

    @property
    def found(self) -> Effects:
        """Beyond the model."""
        return self.likely.effects[self.given :]

    @property
    def effects(self) -> Effects:
        """With fitted sizes."""
        return self.likely.effects

    @property
    def freed(self) -> int:
        """Noises of the model that have another size."""
        return sum(at < self.given for at in self.likely.noises)

    @property
    def score(self) -> float:
        """ln L less what other sizes cost."""
        return self.likely.log_likelihood - RETUNED * self.freed


def believed(axis: Axis, model: Effects) -> Hypothesis:
    """A model as it stands: only courses, whose sizes differ from run to run, are fitted."""
    return Hypothesis(model, axis.fit(model, frozenset(at for at, e in enumerate(model) if type(e) in NOISE)))


def settled(axis: Axis, found: Sequence[Effect], model: Effects) -> Hypothesis:
    """Fit what was found beside a model, with as few other sizes of the model's noises as the data ask for."""
    effects = (*model, *found)
    held = frozenset(at for at, effect in enumerate(model) if type(effect) in NOISE)
    best = Hypothesis(model, axis.fit(effects, held))
    if not held:
        return best
    free = axis.fit(effects)
    if free.log_likelihood - best.likely.log_likelihood < RETUNED:
        return best
    while held:
        trials = [Hypothesis(model, axis.fit(effects, held - {at})) for at in sorted(held)]
        better = max(trials, key=lambda one: one.score)
        if better.score <= best.score:
            break
        best, held = better, better.likely.held
    # one noise may have stood in for two others
    loose = Hypothesis(model, free)
    if loose.score > best.score:
        best = loose
    return best


def refined(axis: Axis, effects: Effects, at: int, names: Sequence[str], reach: float = 1.5) -> Effects:
    """Shapes of one effect at their best, all sizes free: in turns, by golden section in their logarithm.

    Args:
        at: index of the effect
        names: its shapes
        reach: factor up and down that is searched at first
    """
    found = effects
    for turn in range(1 if len(names) == 1 else 3):
        for name in names:
            width = log(reach) / (turn + 1)
            middle = log(getattr(found[at], name))
            best = _golden(axis, found, at, name, middle - width, middle + width)
            found = with_shape(found, at, name, exp(best))
    return found


def with_shape(effects: Effects, at: int, name: str, value: float) -> Effects:
    """Another value of one parameter of one effect."""
    changed: Any = replace(effects[at], **{name: value})  # type: ignore[type-var]
    return (*effects[:at], changed, *effects[at + 1 :])


def _golden(axis: Axis, effects: Effects, at: int, name: str, lo: float, hi: float) -> float:
    def value(x: float) -> float:
        return axis.fit(with_shape(effects, at, name, exp(x))).log_likelihood

    a, b = hi - GOLDEN * (hi - lo), lo + GOLDEN * (hi - lo)
    at_a, at_b = value(a), value(b)
    for _ in range(12):
        if at_a > at_b:
            hi, b, at_b = b, a, at_a
            a = hi - GOLDEN * (hi - lo)
            at_a = value(a)
        else:
            lo, a, at_a = a, b, at_b
            b = lo + GOLDEN * (hi - lo)
            at_b = value(b)
    return 0.5 * (lo + hi)


def size_bounds(likely: Likely, at: int) -> Bounds:
    """95 % interval of the size of an effect.

    A standard deviation is as its logarithm, a size with a sign is Gaussian.
    """
    value, error = size(likely.effects[at]), likely.error(at)
    if type(likely.effects[at]) in COURSE:
        return Bounds(value, value - Z95 * error, value + Z95 * error)
    if not value > 0.0 or not np.isfinite(error):
        return Bounds(value)
    return Bounds(value, value * exp(-Z95 * error / value), value * exp(Z95 * error / value))


def shape_bounds(axis: Axis, hypothesis: Hypothesis, at: int, name: str) -> Bounds:
    """95 % interval of a shape: where the profile of the likelihood falls by HALF, by its two flanks."""
    effects, held = hypothesis.effects, hypothesis.likely.held
    value = float(getattr(effects[at], name))
    top = hypothesis.likely.log_likelihood

    def fall(factor: float) -> float:
        return top - axis.fit(with_shape(effects, at, name, value * factor), held).log_likelihood

    ends = []
    for sign in (-1.0, 1.0):
        step = 1e-6
        while step < 2.0 and fall(exp(sign * step)) < HALF:
            step *= 2.0
        lo, hi = 0.5 * step, step
        for _ in range(8):
            middle = 0.5 * (lo + hi)
            lo, hi = (middle, hi) if fall(exp(sign * middle)) < HALF else (lo, middle)
        ends.append(value * exp(sign * hi))
    return Bounds(value, ends[0], ends[1])
