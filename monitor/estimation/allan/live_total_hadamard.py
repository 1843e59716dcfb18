"""Total and Hadamard variance of the live window: too much for every refit, so one τ of one of them at a time.

``step`` does one; its caller makes one call a pass of its loop. A round goes once through all τ of both, octaves of
the window by default, and is handed over as a whole when its last is done. Nothing is copied: the sums run over the
window's own ring of integer phase, between two updates, by the caller of both.

How stale: a window of 3.6 million samples has 22 τ of the total and 21 of the Hadamard variance, so with ten steps a
second a round takes 4.3 s, and the oldest number that ``get`` hands over is between 4.3 and 8.6 s old, 0.24 % of the
hour that such a window spans at 1 kHz. Each number is exact for the window as it stood at its own step.

A term of the total variance inside the record is one of the Allan variance: where the window has that τ over all of its
length, its sum is taken from there and only the reflected ends are added up.

Integer phase carries a difference of two means over τ up to half of full scale: τ that could pass 2⁶³ are left out. It
also shows a constant axis as one whose phase is off by one unit or two; such sums are zero.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.errors import ConfigError
from drivers.sample import Floats, Ints
from monitor.estimation.allan import hadamard, total
from monitor.estimation.allan.difference_moments import Moments
from monitor.estimation.allan.hadamard import HadamardCurve
from monitor.estimation.allan.total import TotalCurve
from monitor.estimation.allan.window import FULL_SCALE, AllanWindow
from monitor.estimation.allan.window_kernel import AXES

TOTAL, HADAMARD = 0, 1
FEWEST: Final = 8
"""Samples before the first round."""
RENEWED_AT: Final = 1.02
"""While the window grows, bias and degrees of freedom are computed anew at this ratio of lengths."""
ROUNDING: Final = (9.0, 16.0)
"""Square of the sum of |weights| times half a unit, of the second difference of reflected phase and of the third."""


@dataclass(frozen=True, slots=True)
class _Sum:
    """One τ of one statistic, as the window stood at its step."""

    variance: Floats  # [6] unit², with its bias
    terms: Ints  # [6]
    moments: Moments


class SlowStatistics:
    """Total and Hadamard variance of a window, in rounds.

    Args:
        window: looked at, never changed
        totals: cluster sizes of the total variance, below the window's length; None = octaves
        hadamards: of the Hadamard variance, up to a third of it; None = octaves
    Raises:
        ConfigError: a cluster size that is not possible
    """

    def __init__(self, window: AllanWindow, totals: Ints | None = None, hadamards: Ints | None = None) -> None:
        self._window = window
        unit = window.ring()[3]
        longest = int((2.0**63 * unit / (0.5 * np.array(FULL_SCALE[:AXES]))).min())
        limits = (min(window.length - 1, longest), min(window.length // 3, longest // 2))
        given = [total.octaves(limits[0]) if totals is None else totals]
        given.append(total.octaves(limits[1]) if hadamards is None else hadamards)
        for factors, limit in zip(given, limits, strict=True):
            if factors.size == 0 or factors.min() < 1 or factors.max() > limit:
                raise ConfigError(f"cluster sizes {factors.tolist()} must lie within 1 and {limit}")
        self._factors = [[int(m) for m in factors] for factors in given]
        self._moments: list[dict[int, Moments]] = [{}, {}]
        self.rounds = 0  # complete ones
        self._seen = window.resets
        self._round = self._steps()
        self._last: tuple[list[_Sum], list[_Sum]] | None = None

    def step(self) -> None:
        """Compute one τ of one statistic; nothing while the window is nearly empty.

        A window that was emptied ends the round, and what was handed over before is no longer.
        """
        if self._window.resets != self._seen:
            self._last = None
            self._round = self._steps()
        self._seen = self._window.resets
        next(self._round)

    def get(self, rate_hz: float, theta: Floats) -> tuple[TotalCurve, HadamardCurve] | None:
        """The last complete round as curves; None before the first.

        Args:
            rate_hz: samples a second
            theta: [5, 6] fitted Q² N² B² K² R² in SI, as ``fit.Fit.theta``; it corrects the bias and gives the
                degrees of freedom
        """
        if self._last is None:
            return None
        totals, hadamards = self._last
        return (
            total.curve_of([one.moments for one in totals], rate_hz, theta, *_stacked(totals)),
            hadamard.curve_of([one.moments for one in hadamards], rate_hz, theta, *_stacked(hadamards)),
        )

    def _steps(self) -> Iterator[None]:
        """Rounds without end, a step each; a round's τ are those that the window can hold at its beginning."""
        while True:
            n = self._window.n
            totals = [m for m in self._factors[TOTAL] if m < n]
            hadamards = [m for m in self._factors[HADAMARD] if 3 * m <= n]
            if n < FEWEST or not totals or not hadamards:
                yield
                continue
            sums: tuple[list[_Sum], list[_Sum]] = [], []
            for m in totals:
                sums[TOTAL].append(self._total(m))
                yield
            for m in hadamards:
                sums[HADAMARD].append(self._hadamard(m))
                if m == hadamards[-1]:
                    self._last = sums
                    self.rounds += 1
                yield

    def _total(self, m: int) -> _Sum:
        phase, missing, first, unit = self._window.ring()
        n = self._window.n
        sums, terms = np.zeros(AXES), np.zeros(AXES, np.int64)
        inner = np.flatnonzero((self._window.factors == m) & (self._window.spans == self._window.length))
        if inner.size and 2 * m <= n:
            row = inner[0]
            terms += self._window.terms()[row]
            sums += np.nan_to_num(self._window.avar()[row]) * terms * 2.0 * (m / unit) ** 2
            total.add_total(phase, missing, first, n, m, 1, m, sums, terms)
            total.add_total(phase, missing, first, n, m, n - m + 1, n, sums, terms)
        else:
            total.add_total(phase, missing, first, n, m, 1, n, sums, terms)
        sums[sums <= ROUNDING[TOTAL] * terms] = 0.0
        variance = total.variance((sums * unit**2)[None], terms[None], np.array([m]))[0]
        return _Sum(variance, terms, self._known(TOTAL, n, m))

    def _hadamard(self, m: int) -> _Sum:
        phase, missing, first, unit = self._window.ring()
        n = self._window.n
        sums, terms = np.zeros(AXES), np.zeros(AXES, np.int64)
        hadamard.add_hadamard(phase, missing, first, n, m, sums, terms)
        sums[sums <= ROUNDING[HADAMARD] * terms] = 0.0
        variance = hadamard.variance((sums * unit**2)[None], terms[None], np.array([m]))[0]
        return _Sum(variance, terms, self._known(HADAMARD, n, m))

    def _known(self, statistic: int, n: int, m: int) -> Moments:
        """Moments for about this many samples, exactly so many once the window is full."""
        known = self._moments[statistic].get(m)
        full = n == self._window.length
        if known is None or not (known.n == n or (known.n < n < RENEWED_AT * known.n and not full)):
            known = total.moments(n, m) if statistic == TOTAL else hadamard.moments(n, m)
            self._moments[statistic][m] = known
        return known


def _stacked(sums: list[_Sum]) -> tuple[Floats, Ints]:
    """Variances and terms, [m, 6] each."""
    return np.stack([one.variance for one in sums]), np.stack([one.terms for one in sums])
