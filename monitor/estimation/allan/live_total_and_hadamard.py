"""Total and Hadamard variance of a sliding window of live samples, computed one averaging time at a time.

If both variances were computed for all averaging times at once, new samples would have to wait. Each call of
``compute_next_tau`` therefore computes one variance at one averaging time. A round computes both variances at all
averaging times, and the results become available at the end of a round.

The results are therefore slightly out of date. For 3.6 million samples and ten calls per second, a round of 43 calls
takes 4.3 s. The values that ``curves_of_last_round`` returns are then up to 8.6 s old.

Away from the reflected ends, the total variance and the Allan variance have the same second differences. The sums that
the sliding window stores for an averaging time are therefore reused. The Allan variances of a round give the variance
within clusters, from which the contribution of missing samples is computed.

Averaging times at which a difference of integer phase could exceed 2⁶³ are left out, because the phase would overflow.
Sums that are small enough to be caused by rounding alone are set to zero.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.estimation.allan import hadamard, total
from monitor.estimation.allan.batch import octave_cluster_sizes
from monitor.estimation.allan.curve import VarianceCurve
from monitor.estimation.allan.missing_samples import variance_within_clusters_from_octaves
from monitor.estimation.allan.squared_difference_moments import (
    EstimatorMoments,
    PhaseRing,
    correct_squared_differences,
)
from monitor.estimation.allan.window import FULL_SCALE, AllanWindow
from monitor.estimation.allan.window_kernel import AXES
from monitor.estimation.allan.window_kernel import MAX_ROUNDING_SQUARE as MAX_ROUNDING_SQUARE_OF_WINDOW

TOTAL, HADAMARD = 0, 1
MIN_SAMPLES: Final = 8
"""Minimum number of samples in the window from which the variances are computed."""
MOMENTS_RENEWAL_RATIO: Final = 1.02
"""Factor by which the number of samples must grow before the bias and the degrees of freedom are recomputed."""
MAX_ROUNDING_SQUARE: Final = (25.0, 45.0)
"""Largest squared difference of the total and the Hadamard variance that rounding can cause, in squared units of phase.

Each value is (Σ |w| / 2)², where w are the weights of the phase points in a difference. If samples are missing,
``window_kernel.MAX_ROUNDING_SQUARE`` applies.
"""


class _Sums(NamedTuple):
    squares: Floats  # [6] sum of squared differences in squared units of phase
    extra: Floats  # [6] sum of the excess of missing samples, see ``AddSquares``
    terms: Ints  # [6] number of differences


@dataclass(frozen=True, slots=True)
class _Result:
    variance: Floats  # [6] variance in squared units of the axis, not corrected for bias
    terms: Ints  # [6] number of averaged differences
    excess: Floats  # [6] contribution of missing samples, already subtracted from ``variance``
    moments: EstimatorMoments


class LiveTotalAndHadamard:
    """Computes the total and Hadamard variance of a sliding window, one averaging time at a time.

    Parameters
    ----------
    window : AllanWindow
        Sliding window, which is not changed.
    """

    def __init__(self, window: AllanWindow) -> None:
        self._window = window
        unit = window.view_phase_ring()[3]
        longest = int((2.0**63 * unit / (0.5 * np.array(FULL_SCALE[:AXES]))).min())
        limits = (min(window.length - 1, longest), min(window.length // 3, longest // 2))
        self._factors = [octave_cluster_sizes(limit).tolist() for limit in limits]
        self._moments: list[dict[int, EstimatorMoments]] = [{}, {}]
        self.rounds = 0  # number of complete rounds over all averaging times
        self._window_resets = window.resets
        self._round = self._steps()
        self._last: tuple[list[_Result], list[_Result]] | None = None
        self._allan = np.empty((0, AXES))  # Allan variances at 1, 2, 4, … samples of the current round

    def compute_next_tau(self) -> None:
        """Compute the total or Hadamard variance at the next averaging time.

        If the sliding window has been emptied, the results are discarded and a new round begins.
        """
        if self._window.resets != self._window_resets:
            self._last = None
            self._round = self._steps()
        self._window_resets = self._window.resets
        next(self._round)

    def curves_of_last_round(self, rate_hz: float, theta: Floats) -> tuple[VarianceCurve, VarianceCurve] | None:
        """Return the total and Hadamard variance of the last complete round, or None if there is none yet.

        Parameters
        ----------
        rate_hz : float
            Sample rate in Hz.
        theta : ndarray of float64, shape (5, 6)
            Fitted Q², N², B², K², R² in SI units, from which the bias and the degrees of freedom are computed.
        """
        if self._last is None:
            return None
        totals, hadamards = self._last
        return (
            total.correct_total_variance([one.moments for one in totals], rate_hz, theta, *_stack(totals)),
            hadamard.compute_hadamard_confidence_intervals(
                [one.moments for one in hadamards], rate_hz, theta, *_stack(hadamards)
            ),
        )

    def _steps(self) -> Iterator[None]:
        while True:
            n = self._window.samples_in_window
            totals = [m for m in self._factors[TOTAL] if m < n]
            hadamards = [m for m in self._factors[HADAMARD] if 3 * m <= n]
            if n < MIN_SAMPLES or not totals or not hadamards:
                yield
                continue
            sums: tuple[list[_Result], list[_Result]] = [], []
            self._allan = np.empty((0, AXES))
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
        ring, _ = self._ring()
        n = ring.n
        sums = _Sums(np.zeros(AXES), np.zeros(AXES), np.zeros(AXES, np.int64))
        begin, end = m, n - m + 1  # second differences that do not contain reflected samples
        inner = np.flatnonzero((self._window.factors == m) & (self._window.spans == self._window.length))
        if inner.size:
            for total_sum, part in zip(sums, self._window.squared_difference_sums(), strict=True):
                total_sum += part[inner[0]]
        elif begin < end:
            total.add_total_variance_squares(ring, m, begin, end, *sums)
        self._allan = np.concatenate([self._allan, [self._correct(TOTAL, m, sums)[0]]])
        if begin < end:
            total.add_total_variance_squares(ring, m, 1, begin, *sums)
            total.add_total_variance_squares(ring, m, end, n, *sums)
        else:
            total.add_total_variance_squares(ring, m, 1, n, *sums)
        return self._result(TOTAL, n, m, sums)

    def _hadamard(self, m: int) -> _Result:
        ring, _ = self._ring()
        sums = _Sums(np.zeros(AXES), np.zeros(AXES), np.zeros(AXES, np.int64))
        hadamard.add_hadamard_squares(ring, m, *sums)
        return self._result(HADAMARD, ring.n, m, sums)

    def _ring(self) -> tuple[PhaseRing, Floats]:
        phase, missing, first, unit = self._window.view_phase_ring()
        return PhaseRing(phase, missing, first, self._window.samples_in_window), unit

    def _result(self, statistic: int, n: int, m: int, sums: _Sums) -> _Result:
        variance, excess = self._correct(statistic, m, sums)
        return _Result(variance, sums.terms, excess, self._cached_moments(statistic, n, m))

    def _correct(self, statistic: int, m: int, sums: _Sums) -> tuple[Floats, Floats]:
        """Return the variance [6] and the contribution of missing samples [6], which has been subtracted."""
        _, unit = self._ring()
        limit = np.where(sums.extra != 0.0, MAX_ROUNDING_SQUARE_OF_WINDOW, MAX_ROUNDING_SQUARE[statistic])
        squares = np.where(sums.squares <= limit * sums.terms, 0.0, sums.squares) * unit**2
        factor = np.array([m])
        within = variance_within_clusters_from_octaves(self._allan, factor)
        variance, excess = correct_squared_differences(
            squares[None], sums.extra[None], sums.terms[None], factor,
            (total, hadamard)[statistic].SQUARED_WEIGHTS, within,
        )  # fmt: skip
        return variance[0], excess[0]

    def _cached_moments(self, statistic: int, n: int, m: int) -> EstimatorMoments:
        known = self._moments[statistic].get(m)
        full = n == self._window.length
        if known is None or not (known.n == n or (known.n < n < MOMENTS_RENEWAL_RATIO * known.n and not full)):
            known = (
                total.total_estimator_moments(n, m) if statistic == TOTAL else hadamard.hadamard_estimator_moments(n, m)
            )
            self._moments[statistic][m] = known
        return known


def _stack(sums: list[_Result]) -> tuple[Floats, Ints, Floats]:
    return (
        np.stack([one.variance for one in sums]),
        np.stack([one.terms for one in sums]),
        np.stack([one.excess for one in sums]),
    )
