"""Which numbers a row of history has, and how an estimate becomes them.

Of each measured axis and letter: ``gz.N``, its value where it is estimated, with the ends of its interval (``gz.N.lo``,
``gz.N.hi``), and where the data only bound it the bound (``gz.N.bound``). Which of them is there is the status: a
number never travels without it. Deviations at the averaging times 1, 3, 10 … s (``gz.sigma.0.3``): the curve's own grid
follows the measured rate, so they are read off it, on a straight line between two neighbours in logarithms; half an
octave from a point of a curve of the five terms that is off by less than 1 %. Pure.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import AXES, Floats
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients import LETTERS, Status

TAU_S: Final = tuple(float(f"{one}e{power}") for power in range(-4, 6) for one in (1, 3))
"""0.1 ms to 300 000 s: every window has its own part of it."""
HEALTH: Final = ("rate", "latency", "memory")
"""Samples a second; receipt to published at 99 %, s; bytes of the process."""
TEMPERATURE: Final = ("temperature",)
"""°C, means of batches."""
PARTS: Final = ("", ".lo", ".hi", ".bound")
NEAR: Final = 1.02
"""A τ of the curve this near to one of ours is it."""
APART: Final = 2.5
"""Between neighbours further apart than this factor nothing is read off."""


class Numbers:
    """What of a device's estimates is kept.

    Args:
        estimate: the first; those whose axes and grid are the same ``fit``
    """

    def __init__(self, estimate: Estimate) -> None:
        self._measured = _measured(estimate)
        self._axes = np.flatnonzero(self._measured)
        self._tau_s = estimate.curve.tau_s
        at, below, above, share = _places(self._tau_s)
        self._below, self._above = np.array(below, np.intp), np.array(above, np.intp)
        self._share = share[:, None]
        columns, rows = len(AXES), len(LETTERS)
        self._letters = np.array([row * columns + axis for row in range(rows) for axis in self._axes], np.intp)
        axes = [AXES[i] for i in self._axes]
        self.names = (
            *(f"{axis}.{letter}{part}" for part in PARTS for letter in LETTERS for axis in axes),
            *(f"{axis}.sigma.{TAU_S[i]:g}" for i in at for axis in axes),
        )
        self._letter_count = len(self._letters)

    def fit(self, estimate: Estimate) -> bool:
        """Whether an estimate has the same axes and grid."""
        tau_s = estimate.curve.tau_s
        same = tau_s is self._tau_s or np.array_equal(tau_s, self._tau_s)
        return same and bool((_measured(estimate) == self._measured).all())

    def of(self, estimate: Estimate) -> Floats:
        """[k] in the order of ``names``, SI; NaN = not there."""
        c, m = estimate.coefficients, self._letter_count
        status, hi = c.status.take(self._letters), c.hi.take(self._letters)
        estimated = status == Status.ESTIMATED.value
        numbers = np.full(len(self.names), np.nan)
        np.copyto(numbers[:m], c.value.take(self._letters), where=estimated)
        np.copyto(numbers[m : 2 * m], c.lo.take(self._letters), where=estimated)
        np.copyto(numbers[2 * m : 3 * m], hi, where=estimated)
        np.copyto(numbers[3 * m : 4 * m], hi, where=status == Status.UPPER_BOUND.value)
        numbers[4 * m :] = self._deviations(estimate).ravel()
        return numbers

    def _deviations(self, estimate: Estimate) -> Floats:
        """[τ, axes]."""
        with np.errstate(divide="ignore"):  # an axis that never moves has a deviation of 0
            log = np.log(estimate.curve.avar[:, self._axes])
        below, above = log[self._below], log[self._above]
        with np.errstate(invalid="ignore"):  # beside a 0 there is nothing to read off between
            return np.asarray(np.exp(0.5 * (below + self._share * np.where(self._share > 0.0, above - below, 0.0))))


def _measured(estimate: Estimate) -> NDArray[np.bool_]:
    """[6] whether an axis has a curve: its shortest τ is there first."""
    shortest = estimate.curve.avar[0]
    return np.asarray(~np.isnan(shortest))


def _places(tau_s: Floats) -> "tuple[list[int], list[int], list[int], Floats]":
    """Which of TAU_S can be read off a curve, between which of its points, and how far from the lower one [0, 1)."""
    at, below, above, share = [], [], [], []
    for i, wanted in enumerate(TAU_S):
        near = int(np.argmin(np.abs(np.log(tau_s / wanted)))) if tau_s.size else 0
        if tau_s.size and 1.0 / NEAR < tau_s[near] / wanted < NEAR:
            low, high, part = near, near, 0.0
        else:
            high = int(np.searchsorted(tau_s, wanted))
            low = high - 1
            if low < 0 or high >= tau_s.size or tau_s[high] > APART * tau_s[low]:
                continue
            part = float(np.log(wanted / tau_s[low]) / np.log(tau_s[high] / tau_s[low]))
        at.append(i)
        below.append(low)
        above.append(high)
        share.append(part)
    return at, below, above, np.array(share)
