"""How large an effect must be for its level: searched with the oracle.

The smallest size at which the gain over the baseline is what was drawn (see ``TARGETS``) and the margin over the
best wrong name is at least that of the level. So a case whose name is hard to tell from another has a large gain and
a bare margin.
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
}  # gain over the baseline between these; and over the best wrong name at least this
FARTHEST: Final = 1e4
"""Times the guess of a size: where that gains too little, no size does."""
ENLARGED: Final = 12.0  # how far a size may grow for its margin


class NotIdentifiable(RuntimeError):
    """No size of an effect of this shape on this sensor tells it from a wrong name by what the level asks for."""


@dataclass(frozen=True)
class Aim:
    """How large an effect is to be."""

    sense: float  # ±1
    target: float  # gain over the baseline
    margin: float  # over the best wrong name, at least
    size: float | None  # where it is given
    lines: bool = False  # where the baseline's lines are what is sized


def aim(world: World, rng: np.random.Generator, effect: Effect, level: str) -> Aim:
    """Drawn once, whatever is tried for a size."""
    sense, (lo, hi, margin) = sign(rng), TARGETS[level]
    target = log_uniform(rng, lo, hi)
    if effect.name == "sample_rate_error":
        return Aim(sense, target, margin, (1.0 + log_uniform(rng, 2e-3, 3e-2)) ** sense, lines=True)
    return Aim(sense, target, margin, RECIPES[effect.name].fixed(rng, world, effect.axis, level))


def at_level(world: World, effect: Effect, aimed: Aim) -> tuple[Effect, Gains]:
    """The effect at the size that its level asks for, beside all that is in the world's baseline."""
    if aimed.size is None:
        return _search(world, effect, aimed)
    effect = effect.sized(**{RECIPES[effect.name].size: float(aimed.size)})
    return effect, Gains(np.inf, np.inf) if effect.name in EXACT else Observer(world, effect).gains()


def at_multiple(world: World, effect: Effect, factor: float) -> tuple[Effect, Gains]:
    """The effect, which has a size already, at a multiple of it, and what the oracle gains there."""
    effect = scaled(effect, world, factor)
    return effect, Gains(np.inf, np.inf) if effect.name in EXACT else Observer(world, effect).gains()


def size_lines(world: World, target: float) -> tuple[World, Gains]:
    """Lines of the baseline so strong that finding all of them where they are gains what is asked for.

    A line of amplitude A in n samples of white noise s is worth A²n/4s²; one that the model expects and that is not
    there costs as much, so the margin over a line added beside it is the same.
    """
    lines = [one for one in world.baseline if one.name == "sinusoidal"]
    share = 2.0 * float(np.sqrt(target / (len(lines) * world.seconds * world.rate_hz)))
    resized = [
        one.sized(amplitude=share * world.noise(one.axis)) if one.name == "sinusoidal" else one
        for one in world.baseline
    ]
    return replace(world, baseline=tuple(resized)), Gains(target, target, "sinusoidal")


def _search(world: World, effect: Effect, aimed: Aim) -> tuple[Effect, Gains]:
    """The smallest size with that gain over the baseline and that margin over wrong names, to a few percent."""

    def observer(size: float) -> Observer:
        return Observer(world, sized(effect, size, aimed.sense))

    recipe = RECIPES[effect.name]
    hi = guess = recipe.guess(world, effect.axis)
    while observer(hi).gain() < aimed.target:
        hi *= 2.0
        if hi > FARTHEST * guess:
            raise NotIdentifiable(f"{effect.name}: no size gains {aimed.target:.3g}")
    lo = 0.5 * hi
    while lo > max(recipe.least, guess / FARTHEST) and observer(lo).gain() > aimed.target:
        lo, hi = 0.5 * lo, lo
    for _ in range(6):
        middle = float(np.sqrt(lo * hi))
        lo, hi = (lo, middle) if observer(middle).gain() > aimed.target else (middle, hi)
    gains, most = observer(hi).gains(), ENLARGED * hi
    while gains.over_wrong < aimed.margin:
        if hi > most:
            raise NotIdentifiable(f"{effect.name}: margin {gains.over_wrong:.3g} at {hi:g}, asked for {aimed.margin:g}")
        lo, hi = hi, 1.2 * hi
        gains = observer(hi).gains()
    for _ in range(2):
        middle = float(np.sqrt(lo * hi))
        less = observer(middle).gains()
        if less.over_wrong >= aimed.margin and less.over_baseline >= aimed.target:
            hi, gains = middle, less
        else:
            lo = middle
    return sized(effect, hi, aimed.sense), gains
