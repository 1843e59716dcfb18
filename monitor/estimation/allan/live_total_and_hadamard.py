"""Total and Hadamard variance of the live window, computed one τ at a time.

Computing both variances for every refit would take too long. Each call of ``compute_next_tau`` computes one τ of one of
the two variances. A round covers all τ of both variances, by default octaves of the window. The results of a round are
returned together when the last τ is complete. The thread that updates the window also calls ``compute_next_tau``, so
the sums can read the phase of the window without a copy.

The results lag behind the window. A window of 3.6 million samples has 22 averaging times for the total variance and 21
for the Hadamard variance. With ten steps per second, a round takes 4.3 s, and the oldest value returned by
``curves_of_last_round`` is between 4.3 and 8.6 s old. The largest delay is 0.24 % of the window length, which is an
hour at 1 kHz. Each value is exact for the window at the time of computation.

Except at the reflected ends, the terms of the total variance are also terms of the Allan variance. If the window
computes the Allan variance of the same τ over the full length, only the reflected terms are added to the sum of the
window.

Integer phase can represent the difference of two means over τ up to half of full scale. Averaging times at which a
difference could exceed 2⁶³ are left out. Rounding changes the phase of a constant axis by one or two units, and sums of
this size are set to zero.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints
from drivers.errors import ConfigError
from monitor.estimation.allan import hadamard, total
from monitor.estimation.allan.batch import octave_cluster_sizes
from monitor.estimation.allan.hadamard import HadamardCurve
from monitor.estimation.allan.squared_difference_moments import (
    EstimatorMoments,
    PhaseRing,
    variance_from_sums_of_squares,
)
from monitor.estimation.allan.total import TotalCurve
from monitor.estimation.allan.window import FULL_SCALE, AllanWindow
from monitor.estimation.allan.window_kernel import AXES

TOTAL, HADAMARD = 0, 1
MIN_SAMPLES: Final = 8
"""Minimum number of samples for a round."""
MOMENTS_RENEWAL_RATIO: Final = 1.02
"""Growth of the window after which bias and degrees of freedom are recomputed."""
MAX_ROUNDING_SQUARE: Final = (9.0, 16.0)
"""Largest squared difference that rounding alone can cause, in squared units of phase, for each statistic.

The limit is the square of half the sum of the absolute weights of a difference. The differences are the second
difference of reflected phase and the third difference.
"""


@dataclass(frozen=True, slots=True)
class _Result:
    """Result of one step: one statistic of six axes at one τ."""

    variance: Floats  # [6] squared unit of the axis, not corrected for bias
    terms: Ints  # [6] number of terms
    moments: EstimatorMoments


class LiveTotalAndHadamard:
    """Total and Hadamard variance of a window, computed in rounds.

    Parameters
    ----------
    window : AllanWindow
        Window, which is only read.
    totals : ndarray of int64 or None
        Cluster sizes of the total variance in samples, below the window length. None means octaves.
    hadamards : ndarray of int64 or None
        Cluster sizes of the Hadamard variance in samples, up to a third of the window length. None means octaves.

    Raises
    ------
    ConfigError
        If a cluster size is out of range.
    """

    def __init__(self, window: AllanWindow, totals: Ints | None = None, hadamards: Ints | None = None) -> None:
        self._window = window
        unit = window.view_phase_ring()[3]
        longest = int((2.0**63 * unit / (0.5 * np.array(FULL_SCALE[:AXES]))).min())
        limits = (min(window.length - 1, longest), min(window.length // 3, longest // 2))
        given = [octave_cluster_sizes(limits[0]) if totals is None else totals]
        given.append(octave_cluster_sizes(limits[1]) if hadamards is None else hadamards)
        for factors, limit in zip(given, limits, strict=True):
            if factors.size == 0 or factors.min() < 1 or factors.max() > limit:
                raise ConfigError(f"cluster sizes {factors.tolist()} must lie within 1 and {limit}")
        self._factors = [[int(m) for m in factors] for factors in given]
        self._moments: list[dict[int, EstimatorMoments]] = [{}, {}]
        self.rounds = 0  # number of complete rounds
        self._window_resets = window.resets
        self._round = self._steps()
        self._last: tuple[list[_Result], list[_Result]] | None = None

    def compute_next_tau(self) -> None:
        """Compute one τ of one statistic, or nothing while the window is nearly empty.

        If the window has been emptied, the round starts again and the results of the last round are discarded.
        """
        if self._window.resets != self._window_resets:
            self._last = None
            self._round = self._steps()
        self._window_resets = self._window.resets
        next(self._round)

    def curves_of_last_round(self, rate_hz: float, theta: Floats) -> tuple[TotalCurve, HadamardCurve] | None:
        """Return the last complete round as curves, or None before the first round is complete.

        Parameters
        ----------
        rate_hz : float
            Sample rate in Hz.
        theta : ndarray of float64, shape (5, 6)
            Fitted Q² N² B² K² R² in SI, see ``coefficient_fit.Fit.theta``. The coefficients determine the bias
            correction and the degrees of freedom.
        """
        if self._last is None:
            return None
        totals, hadamards = self._last
        return (
            total.correct_total_variance([one.moments for one in totals], rate_hz, theta, *_stack(totals)),
            hadamard.hadamard_curve_from_variance(
                [one.moments for one in hadamards], rate_hz, theta, *_stack(hadamards)
            ),
        )

    def _steps(self) -> Iterator[None]:
        """Run rounds in an endless loop, and yield after each step.

        The number of samples at the start of a round determines the τ of the round.
        """
        while True:
            n = self._window.samples_in_window
            totals = [m for m in self._factors[TOTAL] if m < n]
            hadamards = [m for m in self._factors[HADAMARD] if 3 * m <= n]
            if n < MIN_SAMPLES or not totals or not hadamards:
                yield
                continue
            sums: tuple[list[_Result], list[_Result]] = [], []
            for m in totals:
                sums[TOTAL].append(self._total(m))
                yield
            for m in hadamards:
                sums[HADAMARD].append(self._hadamard(m))
                if m == hadamards[-1]:
                    self._last = sums
                    self.rounds += 1
                yield

    def _total(self, m: int) -> _Result:
        """Compute the total variance at one cluster size."""
        ring, unit = self._ring()
        n = ring.n
        sums, terms = np.zeros(AXES), np.zeros(AXES, np.int64)
        inner = np.flatnonzero((self._window.factors == m) & (self._window.spans == self._window.length))
        if inner.size and 2 * m <= n:
            row = inner[0]
            terms += self._window.term_counts()[row]
            sums += np.nan_to_num(self._window.avar()[row]) * terms * 2.0 * (m / unit) ** 2
            total.add_total_variance_squares(ring, m, 1, m, sums, terms)
            total.add_total_variance_squares(ring, m, n - m + 1, n, sums, terms)
        else:
            total.add_total_variance_squares(ring, m, 1, n, sums, terms)
        return self._result(TOTAL, n, m, sums, terms)

    def _hadamard(self, m: int) -> _Result:
        """Compute the Hadamard variance at one cluster size."""
        ring, _ = self._ring()
        sums, terms = np.zeros(AXES), np.zeros(AXES, np.int64)
        hadamard.add_hadamard_squares(ring, m, sums, terms)
        return self._result(HADAMARD, ring.n, m, sums, terms)

    def _ring(self) -> tuple[PhaseRing, Floats]:
        """Return the phase of the window, and the size of one unit of phase of each axis in SI."""
        phase, missing, first, unit = self._window.view_phase_ring()
        return PhaseRing(phase, missing, first, self._window.samples_in_window), unit

    def _result(self, statistic: int, n: int, m: int, sums: Floats, terms: Ints) -> _Result:
        """Convert the sums of one statistic at one cluster size to variances."""
        _, unit = self._ring()
        sums[sums <= MAX_ROUNDING_SQUARE[statistic] * terms] = 0.0
        weights = (total, hadamard)[statistic].SQUARED_WEIGHTS
        variance = variance_from_sums_of_squares((sums * unit**2)[None], terms[None], np.array([m]), weights)[0]
        return _Result(variance, terms, self._cached_moments(statistic, n, m))

    def _cached_moments(self, statistic: int, n: int, m: int) -> EstimatorMoments:
        """Return moments for about n samples, or for exactly n once the window is full."""
        known = self._moments[statistic].get(m)
        full = n == self._window.length
        if known is None or not (known.n == n or (known.n < n < MOMENTS_RENEWAL_RATIO * known.n and not full)):
            known = (
                total.total_estimator_moments(n, m) if statistic == TOTAL else hadamard.hadamard_estimator_moments(n, m)
            )
            self._moments[statistic][m] = known
        return known


def _stack(sums: list[_Result]) -> tuple[Floats, Ints]:
    """Return variances and terms, [m, 6] each."""
    return np.stack([one.variance for one in sums]), np.stack([one.terms for one in sums])
