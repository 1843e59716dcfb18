"""Search of the size of an effect for its level, with the gains of the oracle.

The size is the smallest size with two properties. The gain over the baseline reaches a target, which is drawn from
``TARGETS``. The margin over the best wrong name reaches that of the level. An effect that is similar to another effect
therefore has a large gain and a small margin.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from tests.experiments.blind.oracle import EXACT, Gains, Observer
from tests.experiments.blind.recipes import RECIPES, log_uniform, scaled, sign, sized
from tests.experiments.blind.world import Effect, World

TARGETS: Final[Mapping[str, tuple[float, float, float]]] = {
    "plain": (60.0, 180.0, 12.0),
    "faint": (18.0, 38.0, 6.0),
}  # smallest and largest gain over the baseline, least gain over the best wrong name
MAX_SIZE_RATIO: Final = 1e4
"""Largest size over the first guess. If the gain is still too small, no size has the gain."""
MAX_MARGIN_RATIO: Final = 12.0  # largest factor on the size to reach the margin


class NotIdentifiable(RuntimeError):
    """No size of an effect on a sensor reaches the gain or margin of the level."""


@dataclass(frozen=True)
class SizeTarget:
    """Required gain, margin and direction of an effect."""

    direction: float  # ±1
    gain: float  # over the baseline
    margin: float  # least gain over the best wrong name
    size: float | None  # for an effect with a fixed size
    lines: bool = False  # True if the lines of the baseline get the size


def draw_size_target(world: World, rng: np.random.Generator, effect: Effect, level: str) -> SizeTarget:
    """Draw the target of an effect once, before the search for its size."""
    direction, (lo, hi, margin) = sign(rng), TARGETS[level]
    target = log_uniform(rng, lo, hi)
    if effect.name == "sample_rate_error":
        return SizeTarget(direction, target, margin, (1.0 + log_uniform(rng, 2e-3, 3e-2)) ** direction, lines=True)
    return SizeTarget(direction, target, margin, RECIPES[effect.name].fixed(rng, world, effect.axis, level))


def set_size_for_level(world: World, effect: Effect, wanted: SizeTarget) -> tuple[Effect, Gains]:
    """Return the effect with the size for its level, in addition to the baseline, and its gains."""
    if wanted.size is None:
        return _search(world, effect, wanted)
    effect = effect.sized(**{RECIPES[effect.name].size: float(wanted.size)})
    return effect, Gains(np.inf, np.inf) if effect.name in EXACT else Observer(world, effect).gains()


def scale_size(world: World, effect: Effect, factor: float) -> tuple[Effect, Gains]:
    """Return the effect at a multiple of its size, and its gains."""
    effect = scaled(effect, world, factor)
    return effect, Gains(np.inf, np.inf) if effect.name in EXACT else Observer(world, effect).gains()


def set_line_amplitudes(world: World, target: float) -> tuple[World, Gains]:
    """Return the sensor with lines whose correct frequencies have the gain ``target``, and the gains.

    A line of amplitude A in n samples of white noise s has the gain A²n/4s². A line that the model contains and the
    recording lacks loses as much, so the margin over an additional line is the same.
    """
    lines = [effect for effect in world.baseline if effect.name == "sinusoidal"]
    share = 2.0 * float(np.sqrt(target / (len(lines) * world.seconds * world.rate_hz)))
    resized = [
        effect.sized(amplitude=share * world.noise(effect.axis)) if effect.name == "sinusoidal" else effect
        for effect in world.baseline
    ]
    return replace(world, baseline=tuple(resized)), Gains(target, target, "sinusoidal")


def _search(world: World, effect: Effect, wanted: SizeTarget) -> tuple[Effect, Gains]:
    """Return the effect with the smallest size that reaches gain and margin, to a few percent, and its gains."""

    def observer(size: float) -> Observer:
        return Observer(world, sized(effect, size, wanted.direction))

    recipe = RECIPES[effect.name]
    hi = guess = recipe.guess(world, effect.axis)
    while observer(hi).gain() < wanted.gain:
        hi *= 2.0
        if hi > MAX_SIZE_RATIO * guess:
            raise NotIdentifiable(f"{effect.name}: no size gains {wanted.gain:.3g}")
    lo = 0.5 * hi
    while lo > max(recipe.least, guess / MAX_SIZE_RATIO) and observer(lo).gain() > wanted.gain:
        lo, hi = 0.5 * lo, lo
    for _ in range(6):
        middle = float(np.sqrt(lo * hi))
        lo, hi = (lo, middle) if observer(middle).gain() > wanted.gain else (middle, hi)
    gains, most = observer(hi).gains(), MAX_MARGIN_RATIO * hi
    while gains.over_wrong < wanted.margin:
        if hi > most:
            raise NotIdentifiable(f"{effect.name}: margin {gains.over_wrong:.3g} at {hi:g}, required {wanted.margin:g}")
        lo, hi = hi, 1.2 * hi
        gains = observer(hi).gains()
    for _ in range(2):
        middle = float(np.sqrt(lo * hi))
        gains_at_middle = observer(middle).gains()
        if gains_at_middle.over_wrong >= wanted.margin and gains_at_middle.over_baseline >= wanted.gain:
            hi, gains = middle, gains_at_middle
        else:
            lo = middle
    return sized(effect, hi, wanted.direction), gains
