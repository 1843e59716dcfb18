"""How far apart measurement and model are, and how far a true model would be: scores with a null.

A gap is √(2 × gain), standard deviations of the departure that a lens likes best. Its null is made by recordings
simulated from the very model under test, looked at through the same lenses. Gains of a true model are nearly pivotal,
the same for all axes and models, so those of all axes stand together: with their upper quartile q, gains beyond fall
off as exp(−(g − q)/s), s the mean excess over q, held within [1, 1.3] as the tails of maxima of χ²/2 are.
``threshold`` is where an axis and a lens are passed once in 100 × lenses × axes recordings; ``null95`` is for one lens
and axis alone. An axis whose own simulated gains lie above all this (coarse values, clipped ones) has the largest of
them, and more.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log, sqrt
from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.reconcile.diagnostics.diagnostics import LENSES, Finding, Sight
from monitor.reconcile.result import Score

ACCUSED: Final = 0.01
"""Of the recordings of a true model, through any lens, on any axis."""
UPPER: Final = 0.25
EXCESS: Final = (1.0, 1.3)
BEYOND: Final = 3.0
"""Nats above the largest of an axis' own simulated gains."""

Findings = Mapping[str, Finding]


@dataclass(frozen=True, slots=True)
class Null:
    """What a true model gives through one lens."""

    null95: float  # gain
    threshold: float  # gain


def look(seen: Sight) -> Findings:
    """Through all lenses."""
    return {name: lens(seen) for name, lens in LENSES.items()}


def nulls(simulated: Mapping[str, Sequence[Findings]], looks: int) -> dict[str, dict[str, Null]]:
    """Of each axis and lens.

    Args:
        simulated: axis -> what the lenses see in simulated recordings
        looks: axes that are judged together
    """
    found: dict[str, dict[str, Null]] = {axis: {} for axis in simulated}
    for lens in LENSES:
        gains = {axis: np.array([one[lens].gain for one in seen]) for axis, seen in simulated.items()}
        pooled = _tail(np.concatenate(list(gains.values())), looks)
        for axis, own in gains.items():
            beyond = float(own.max(initial=0.0)) + BEYOND
            found[axis][lens] = (
                pooled if beyond <= pooled.threshold else Null(max(pooled.null95, float(own.max())), beyond)
            )
    return found


def _tail(gains: Floats, looks: int) -> Null:
    quartile = float(np.quantile(gains, 1.0 - UPPER)) if gains.size else 0.0
    beyond = gains[gains > quartile] - quartile
    scale = float(np.clip(beyond.mean() if beyond.size else EXCESS[0], *EXCESS))
    p = ACCUSED / (len(LENSES) * looks)
    return Null(quartile + scale * log(UPPER / 0.05), quartile + scale * log(UPPER / p))


def scores(seen: Findings, null: Mapping[str, Null]) -> tuple[Score, ...]:
    """Gaps of an axis, in the order of the lenses."""
    return tuple(
        Score(lens, one.where, *(sqrt(2.0 * x) for x in (one.gain, null[lens].null95, null[lens].threshold)))
        for lens, one in seen.items()
    )
