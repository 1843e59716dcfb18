"""When a bias leaves what temperature lets expect, and hardly by chance: one axis, interval by interval.

Every interval is predicted one step ahead before it enters the fit, so if the model is true, one in forty lies above
its 95 % interval and one in forty below, each on its own. OUTSIDE of the last OF known intervals on one side of theirs
are a doubt, which ``following`` settles: docs/thermal.md has how often one is told of a true model, counted.
"""

from collections import deque
from dataclasses import dataclass
from itertools import dropwhile
from typing import Final

import numpy as np

from monitor.drift.thermal.recursive_least_squares import Band
from monitor.drift.thermal.thermal_model import Z95

OUTSIDE: Final = 4
OF: Final = 6
FAR: Final = 2.0
"""Half widths of the interval: what is further out waits for its fellows before a fit believes it."""


@dataclass(frozen=True, slots=True)
class Unexplained:
    """A bias that temperature does not explain."""

    size: float  # measured less what temperature lets expect, mean since it began; rad/s or m/s²
    outside: int  # intervals outside of theirs, on one side
    of: int  # of so many
    since: int  # intervals from the first of them to the last, missing ones included
    sigma: float  # how far outside all of them are together, standard deviations


@dataclass(frozen=True, slots=True)
class _Seen:
    at: int  # number of the interval
    side: int
    apart: float  # of the multi-step estimate
    z: float  # of the one-step estimate


class Suspicion:
    """Keeps the last intervals of one axis."""

    def __init__(self) -> None:
        self._seen: deque[_Seen] = deque(maxlen=OF)  # known ones
        self._came = 0

    @property
    def clear(self) -> bool:
        """The last interval was inside, and at most one of those before was not: they may shape a model."""
        return not (self._seen and self._seen[-1].side) and all(self._outside(side) < 2 for side in (-1, 1))

    @property
    def far(self) -> bool:
        """The last interval was so far outside that it is no chance, though it may be a mistake."""
        return bool(self._seen) and abs(self._seen[-1].z) > FAR * Z95

    def update(self, bias: float, multi_step: Band, one_step: Band) -> Unexplained | None:
        """One interval beside what was expected of it; NaN = not measured."""
        self._came += 1
        if not np.isfinite(bias):
            return None
        half = max(0.5 * (one_step.hi - one_step.lo), 1e-300)
        z = Z95 * (bias - one_step.bias) / half
        self._seen.append(_Seen(self._came, one_step.side(bias), bias - multi_step.bias, z))
        side = self._seen[-1].side
        if not side or self._outside(side) < OUTSIDE:
            return None
        part = list(dropwhile(lambda one: one.side != side, self._seen))
        size = float(np.mean([one.apart for one in part]))
        together = float(abs(sum(one.z for one in part))) / len(part) ** 0.5
        outside, of, since = self._outside(side), len(self._seen), self._came - part[0].at + 1
        found = Unexplained(size, outside, of, since, together)
        self._seen.clear()
        return found

    def forget(self) -> None:
        """What was is no witness any more."""
        self._seen.clear()

    def _outside(self, side: int) -> int:
        return sum(one.side == side for one in self._seen)
