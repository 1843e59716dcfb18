"""Blocks in, Estimate out: the window, its uncertainty and the fit of one device.

``update`` advances the window sample by sample, missing ones in their places; ``get`` is a look at the result, with
the best fit there is (all covariances). Between looks, where it is wanted, the coefficients follow every sample by
the gains of ``refit``. The rate enters only as the label of the τ axis and the units of the coefficients: a cluster
is a number of samples.

Beside the fixed window of the fit, each τ has a shorter span of its own for the eye (``recent``): it shows a change of
N within half a minute.
"""

from collections import deque
from collections.abc import Generator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import NotReady
from drivers.sample import Floats, Ints, SampleBlock
from monitor.estimation.allan.batch import TauGrid, cluster_sizes
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.allan.hadamard import HadamardCurve
from monitor.estimation.allan.live_total_hadamard import SlowStatistics
from monitor.estimation.allan.total import TotalCurve
from monitor.estimation.allan.uncertainty import AxisTables, Spans, Table, intervals
from monitor.estimation.allan.window import MAX_LENGTH, MIN_LENGTH, AllanWindow, quick_spans
from monitor.estimation.estimate import Course, Estimate
from monitor.estimation.estimate import joined as joined_courses
from monitor.estimation.fit.bandwidth import LowPass, contradicted, power, searching, with_bandwidth
from monitor.estimation.fit.coefficient_fit import Fit, Looks, design, fit, joined, nothing_fitted
from monitor.estimation.fit.continuous_refit import Refit
from monitor.estimation.window_snapshot import Held, held

SETTLING: Final = 10
"""Looks that take a fit to its end; each leaves a quarter of what was left."""
FEWEST: Final = 8
"""Samples before the first answer: three τ with a few terms each."""
POWER_ROWS: Final = 65_536
"""The newest samples, whose spectrum is asked whether it shows a filter."""
COURSE_SAMPLES: Final = 65_536
"""Of the course of coefficients, the newest kept until someone looks."""


class Estimator:
    """The live estimate of one device.

    Args:
        rate_hz: nominal samples a second
        window_s: length of the sliding window
        tau: grid of averaging times, or a list of them in s
        every_sample: have the coefficients follow every sample, not only each look
    Raises:
        ConfigError: the window or the list of τ is impossible at this rate
    """

    def __init__(self, rate_hz: float, window_s: float, tau: TauGrid = "octave", every_sample: bool = False) -> None:
        self.rate_hz = rate_hz
        length = min(max(round(window_s * rate_hz), MIN_LENGTH), MAX_LENGTH)
        self.window_s = length / rate_hz
        factors = cluster_sizes(length, rate_hz, tau)
        spans = quick_spans(factors, rate_hz, length)
        self._m = factors.size
        # the rows of the fit, then those for the eye
        rows, lengths = np.tile(factors, 2), np.concatenate([np.full(self._m, length), spans])
        self._window = AllanWindow(length, rows, lengths)
        self._factors = factors
        self._design = design(factors, rate_hz)
        self._tables = AxisTables(factors, length)
        self._spans = Spans(factors, spans, self._design.columns)
        self._entered: NDArray[np.bool_] = np.zeros((5, 6), np.bool_)
        self._lengths = np.zeros(6, np.int64)  # samples of each axis since its last restart, at most the window
        self._refit = Refit(self._window, self._m, self._tables) if every_sample else None
        self._course: deque[Course] = deque()
        self._followed = 0  # samples in it
        self._slow = SlowStatistics(self._window)
        self._theta = np.full((5, 6), np.nan)  # of the newest fit
        self._odd: list[tuple[Table, Looks] | None] = [None] * 6  # curves that contradict their fit
        self._filters: list[LowPass | None] = [None] * 6
        self._turn = 0  # the axis whose filter is sought
        self._search: Generator[None, None, LowPass | None] | None = None
        self._samples = 0
        self._newest_ns = 0

    @property
    def samples(self) -> int:
        """Samples received since the start, resets notwithstanding."""
        return self._samples

    @property
    def filled(self) -> int:
        """Samples in the window now, missing ones included."""
        return self._window.n

    @property
    def length(self) -> int:
        """Samples in the full window."""
        return self._window.length

    def held(self) -> Held:
        """The samples in the window now."""
        return held(self._window, self.rate_hz)

    def update(self, samples: SampleBlock) -> None:
        """Advance by the samples missing before the block, then by the block."""
        if samples.lost > self._window.length:
            self.reset()
        elif samples.lost:
            self._window.skip(samples.lost)
            self._lengths += samples.lost
        np.minimum(self._lengths, self._window.n, out=self._lengths)
        if self._refit is None:
            self._window.update(samples.values)
            self._lengths += len(samples)
        else:
            self._course.append(Course(samples.t_ns, self._refit.update(self._design, samples.values, self._lengths)))
            self._followed += len(samples)
            while self._followed - len(self._course[0].t_ns) >= COURSE_SAMPLES:
                self._followed -= len(self._course.popleft().t_ns)
        self._samples += len(samples)
        self._newest_ns = int(samples.t_ns[-1])

    def reset(self) -> None:
        """Empty the window."""
        self._window.reset()
        self._lengths[:], self._theta[:] = 0, np.nan
        self._entered[:] = False
        if self._refit is not None:
            self._refit.reset()

    def restart(self, axis: int, samples: int) -> None:
        """Of one axis, forget all but the newest samples: its noise was another before them."""
        self._window.forget(axis, samples)
        self._lengths[axis] = min(samples, self._lengths[axis])
        self._entered[:, axis], self._theta[:, axis] = False, np.nan
        if self._refit is not None:
            self._refit.restart(axis)

    def fitted(self) -> tuple[NDArray[np.bool_], Floats]:
        """Which terms the newest fit has, and their sizes [5, 6]: what the next one starts from."""
        return (self._entered if self._refit is None else self._refit.entered).copy(), self._theta.copy()

    def start_from(self, entered: NDArray[np.bool_], theta: Floats) -> None:
        """Let the next fit start from one before a restart of the program, and take it to its end.

        A term that is in the fit leaves it later than it enters, and the live fit follows by a step each look.
        """
        self._entered, self._theta = entered.copy(), theta.copy()
        if self._window.n >= FEWEST:
            for _ in range(SETTLING):
                self.get()

    def relabel(self, rate_hz: float) -> None:
        """The rate is known better now: the same clusters of samples, other τ and units."""
        self.rate_hz = rate_hz
        self.window_s = self._window.length / rate_hz
        self._design = design(self._factors, rate_hz)

    def get(self, fitted: bool = True) -> Estimate:
        """The curve of the window and the coefficients fitted to it; without ``fitted``, deviations alone.

        Raises:
            NotReady: fewer than FEWEST samples in the window
        """
        n = self._window.n
        if n < FEWEST:
            raise NotReady(f"{n} of at least {FEWEST} samples")
        avar, terms = self._window.avar(), self._window.terms()
        own, recent = slice(0, self._m), slice(self._m, None)
        result = self._fit(avar[own], terms[own]) if fitted else nothing_fitted(avar[own])
        curve = self._curve(avar[own], terms[own], result.edf, n)
        quick_edf = self._spans.edf(result.theta, self.rate_hz, terms[recent])
        quick = self._curve(avar[recent], terms[recent], quick_edf, n)
        course = joined_courses(self._course)
        self._course.clear()
        self._followed = 0
        return Estimate(
            self._newest_ns, self.rate_hz, self.window_s, self._samples, curve, result.fitted, result.coefficients,
            result.k_or_r, quick, course,
        )  # fmt: skip

    def step(self) -> tuple[TotalCurve, HadamardCurve] | None:
        """One step of what takes long: total and Hadamard deviations, see ``slow``, and the sensor's own low-pass.

        Returns the two curves when a round of them is complete.
        """
        rounds = self._slow.rounds
        self._slow.step()
        self._seek_bandwidth()
        return (
            self._slow.get(self.rate_hz, np.where(self._entered, self._theta, 0.0))
            if self._slow.rounds > rounds
            else None
        )

    def _fit(self, avar: Floats, terms: Ints) -> Fit:
        """Fit the axes that fill the window together, each restarted one by the covariances of its own length."""
        lengths = np.minimum(self._lengths, self._window.n)
        slope, slopes = self._window.slope(lengths), self._window.slopes(lengths)[: self._m]
        before = self._entered if self._refit is None else self._refit.entered
        shorter = [axis for axis in range(len(lengths)) if lengths[axis] < self._window.n]
        groups = [np.flatnonzero(lengths == self._window.n), *(np.array([axis]) for axis in shorter)]
        groups = [axes for axes in groups if axes.size]
        fits = []
        for axes in groups:
            n = int(lengths[axes[0]])
            table = self._tables.of(int(axes[0]), n, self._window.n).at(n)
            looks = Looks(
                avar[:, axes], terms[:, axes], slope[axes] * self.rate_hz, slopes[:, axes] * self.rate_hz,
                before[:, axes],
            )  # fmt: skip
            one = fit(
                self._design, table, looks.avar, looks.terms, looks.before, looks.slope, looks.slopes,
                start=self._theta[:, axes],
            )  # fmt: skip
            self._theta[:, axes] = one.theta
            for column, axis in enumerate(axes.tolist()):
                self._odd[axis] = (table, looks.axis(column)) if contradicted(one, column) else None
            fits.append(with_bandwidth(self._design, table, looks, one, [self._filters[axis] for axis in axes])[0])
        result = fits[0] if len(fits) == 1 else joined(fits, np.concatenate(groups))
        self._entered = result.entered
        return result

    def _seek_bandwidth(self) -> None:
        """A piece of the search for the low-pass of one axis; then of the next whose shortest τ contradict the fit."""
        if self._search is not None:
            try:
                next(self._search)
            except StopIteration as end:
                self._filters[self._turn] = end.value
                self._search = None
            return
        for _ in range(len(self._odd)):
            self._turn = (self._turn + 1) % len(self._odd)
            odd = self._odd[self._turn]
            if odd is not None:
                self._search = searching(self._design, *odd, power(self._window.newest(self._turn, POWER_ROWS)))
                return
            self._filters[self._turn] = None

    def _curve(self, avar: Floats, terms: Ints, edf: Floats, n: int) -> AllanCurve:
        lo, hi = intervals(avar, edf)
        return AllanCurve(self._factors / self.rate_hz, self._factors, avar, terms, edf, lo, hi, n)
