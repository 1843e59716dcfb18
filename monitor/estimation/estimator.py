"""Live estimator that computes the Allan deviations and noise coefficients of one device in a sliding window.

The estimator counts in samples. The sample rate is only used to convert cluster sizes to averaging times in seconds and
coefficients to SI units.
"""

from collections import deque
from collections.abc import Generator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats, SampleBlock
from drivers.errors import NotReady
from monitor.common.loss_of_samples import LossOfSamples
from monitor.estimation.allan.batch import TauGrid, cluster_sizes
from monitor.estimation.allan.curve import AllanCurve, VarianceCurve
from monitor.estimation.allan.live_total_and_hadamard import LiveTotalAndHadamard
from monitor.estimation.allan.missing_samples import AllanVariances
from monitor.estimation.allan.uncertainty import (
    CovarianceTable,
    CovarianceTablesByAxis,
    DegreesOfFreedomWithSpanPerTau,
    deviation_intervals,
)
from monitor.estimation.allan.window import MAX_LENGTH, MIN_LENGTH, AllanWindow, newest_samples_per_displayed_tau
from monitor.estimation.estimate import CoefficientsAfterEachSample, Estimate, concatenate_successive_coefficients
from monitor.estimation.fit.coefficient_fit import (
    Fit,
    MeasuredVariancesAndSlopes,
    concatenate_fits,
    empty_fit,
    fit_coefficients,
    make_design_matrix,
)
from monitor.estimation.fit.interval_widening import FitWithInputs, loss_of_samples
from monitor.estimation.fit.low_pass_search import (
    LowPass,
    axes_contradicting_five_terms,
    power_spectrum,
    refit_with_low_passes,
    search_low_pass_in_steps,
)
from monitor.estimation.fit.per_sample_refit import ContinuousRefit
from monitor.estimation.window_sample_snapshot import WindowSnapshot, copy_window

SETTLING_FITS: Final = 10
"""Number of successive fits that are needed for convergence. Each fit reduces the error to about a quarter."""
MIN_SAMPLES: Final = 8
"""Minimum number of samples from which an estimate is computed."""
SPECTRUM_SAMPLES: Final = 65_536
"""Number of newest samples that are used to search for a low-pass filter."""
MAX_HISTORY_SAMPLES: Final = 65_536
"""Maximum number of samples whose coefficients are stored between two calls of ``Estimator.get_estimate``."""


class Estimator:
    """Live estimator that computes the Allan deviations and noise coefficients of one device.

    Parameters
    ----------
    rate_hz : float
        Nominal sample rate in Hz.
    window_s : float
        Length of the sliding window in seconds.
    tau : TauGrid
        Name of a grid of averaging times, or a tuple of times in seconds.
    every_sample : bool
        True to fit the coefficients after every sample, False to fit them only in ``get_estimate``.

    Raises
    ------
    ConfigError
        If every averaging time is shorter than one sample or longer than half the window.
    """

    def __init__(self, rate_hz: float, window_s: float, tau: TauGrid = "octave", every_sample: bool = False) -> None:
        self.rate_hz = rate_hz
        length = min(max(round(window_s * rate_hz), MIN_LENGTH), MAX_LENGTH)
        self.window_s = length / rate_hz
        factors = cluster_sizes(length, rate_hz, tau)
        spans = newest_samples_per_displayed_tau(factors, rate_hz, length)
        self._m = factors.size
        # Every cluster size occurs twice: the first m are used for the fit, the other m for the display.
        rows, lengths = np.tile(factors, 2), np.concatenate([np.full(self._m, length), spans])
        self._window = AllanWindow(length, rows, lengths)
        self._factors = factors
        self._design = make_design_matrix(factors, rate_hz)
        self._tables = CovarianceTablesByAxis(factors, length)
        self._spans = DegreesOfFreedomWithSpanPerTau(factors, spans, self._design.columns)
        self._entered: NDArray[np.bool_] = np.zeros((5, 6), np.bool_)
        self._lengths = np.zeros(6, np.int64)  # number of samples of each axis in the window since its last restart
        self._refit = ContinuousRefit(self._window, self._m, self._tables) if every_sample else None
        self._history: deque[CoefficientsAfterEachSample] = deque()
        self._history_samples = 0  # total number of samples in ``_history``
        self._total_hadamard = LiveTotalAndHadamard(self._window)
        self._theta = np.full((5, 6), np.nan)  # squared coefficients of the newest fit
        self._newest_fits: list[FitWithInputs] = []
        # For each axis: the fit inputs if the five noise terms do not explain the Allan variance, or None otherwise.
        self._contradicting: list[tuple[CovarianceTable, MeasuredVariancesAndSlopes] | None] = [None] * 6
        self._low_passes: list[LowPass | None] = [None] * 6
        self._search_axis = 0  # axis that is searched for a low-pass filter
        self._search: Generator[None, None, LowPass | None] | None = None
        self._samples = 0
        self._newest_ns = 0

    @property
    def samples_received(self) -> int:
        """Total number of received samples, which ``empty_window`` does not reset."""
        return self._samples

    @property
    def samples_in_window(self) -> int:
        """Number of samples in the window, including missing samples."""
        return self._window.samples_in_window

    @property
    def window_length_samples(self) -> int:
        """Number of samples in the full window."""
        return self._window.length

    def copy_window(self) -> WindowSnapshot:
        """Return a copy of the samples in the window."""
        return copy_window(self._window, self.rate_hz)

    def add_samples(self, samples: SampleBlock) -> None:
        """Append a block of samples to the window, after the missing samples that precede the block."""
        if samples.lost > self._window.length:
            self.empty_window()
        elif samples.lost:
            self._window.append_missing_samples(samples.lost)
            self._lengths += samples.lost
        np.minimum(self._lengths, self._window.samples_in_window, out=self._lengths)
        if self._refit is None:
            self._window.append_samples(samples.values)
            self._lengths += len(samples)
        else:
            self._history.append(
                CoefficientsAfterEachSample(
                    samples.t_ns,
                    self._refit.append_and_refit_after_each_sample(self._design, samples.values, self._lengths),
                )
            )
            self._history_samples += len(samples)
            while self._history_samples - len(self._history[0].t_ns) >= MAX_HISTORY_SAMPLES:
                self._history_samples -= len(self._history.popleft().t_ns)
        self._samples += len(samples)
        self._newest_ns = int(samples.t_ns[-1])

    def empty_window(self) -> None:
        """Remove all samples from the window, and discard the fit."""
        self._window.discard_samples()
        self._lengths[:], self._theta[:] = 0, np.nan
        self._entered[:] = False
        self._newest_fits = []
        if self._refit is not None:
            self._refit.restart_all_fits()

    def restart_axis(self, axis: int, samples_to_keep: int) -> None:
        """Discard the old samples of one axis after a noise change.

        Parameters
        ----------
        axis : int
            Index into ``AXES``.
        samples_to_keep : int
            Number of newest samples to keep.
        """
        self._window.keep_newest(axis, samples_to_keep)
        self._lengths[axis] = min(samples_to_keep, self._lengths[axis])
        self._entered[:, axis], self._theta[:, axis] = False, np.nan
        if self._refit is not None:
            self._refit.restart_fit_of_axis(axis)

    def copy_terms_and_squared_coefficients(self) -> tuple[NDArray[np.bool_], Floats]:
        """Return the noise terms in the fit, and the squared coefficients in SI units.

        Both arrays have the shape (5, 6) and can be passed to ``restore_fit``.
        """
        return (self._entered if self._refit is None else self._refit.terms_in_fit).copy(), self._theta.copy()

    def restore_fit(self, terms_in_fit: NDArray[np.bool_], theta: Floats) -> None:
        """Continue with the fit that was stored before a restart of the program.

        A live fit updates the weights only once, so the fit is repeated until it has converged. The result depends on
        the previous fit, because the threshold for dropping a noise term is lower than the threshold for adding it.

        Parameters
        ----------
        terms_in_fit : ndarray of bool, shape (5, 6)
            True for noise terms that were included in the fit.
        theta : ndarray of float64, shape (5, 6)
            Squared coefficients Q², N², B², K², R² in SI units.
        """
        self._entered, self._theta = terms_in_fit.copy(), theta.copy()
        if self._window.samples_in_window >= MIN_SAMPLES:
            self.get_converged_estimate()

    def refine_rate(self, rate_hz: float) -> None:
        """Set a more accurate value of the sample rate.

        The cluster sizes in samples remain the same, but the averaging times in seconds and the coefficients change.
        """
        self.rate_hz = rate_hz
        self.window_s = self._window.length / rate_hz
        self._design = make_design_matrix(self._factors, rate_hz)

    def get_estimate(self, fit_coefficients: bool = True) -> Estimate:
        """Return the Allan deviations of the samples in the window, and the fitted noise coefficients.

        Parameters
        ----------
        fit_coefficients : bool
            True to fit the noise coefficients, False to compute only the Allan deviations.

        Raises
        ------
        NotReady
            If the window contains fewer than ``MIN_SAMPLES`` samples.
        """
        n = self._window.samples_in_window
        if n < MIN_SAMPLES:
            raise NotReady(f"{n} of at least {MIN_SAMPLES} samples")
        avar, terms, excess = self._window.variances()
        own, recent = slice(0, self._m), slice(self._m, None)
        measured = AllanVariances(avar[own], terms[own], excess[own])
        result = self._fit(measured) if fit_coefficients else empty_fit(avar[own])
        recent_edf = self._spans.edf(result.theta, self.rate_hz, terms[recent], excess[recent])
        edf = np.concatenate([result.edf, recent_edf])
        lo, hi = deviation_intervals(avar, edf, excess=excess)
        avar = np.maximum(avar, 0.0)
        tau_s = self._factors / self.rate_hz
        curve, quick = (
            AllanCurve(tau_s, self._factors, avar[rows], terms[rows], edf[rows], lo[rows], hi[rows], n, excess[rows])
            for rows in (own, recent)
        )
        history = concatenate_successive_coefficients(self._history)
        self._history.clear()
        self._history_samples = 0
        return Estimate(
            self._newest_ns, self.rate_hz, self.window_s, self._samples, curve, result.fitted, result.coefficients,
            result.k_or_r, quick, history, result.poorly_fitted_axes,
        )  # fmt: skip

    def get_converged_estimate(self) -> Estimate:
        """Repeat the fit until it has converged, and return the estimate.

        Raises
        ------
        NotReady
            If the window contains fewer than ``MIN_SAMPLES`` samples.
        """
        for _ in range(SETTLING_FITS - 1):
            self.get_estimate()
        return self.get_estimate()

    def loss_of_samples(self) -> LossOfSamples:
        """Return the share of missing samples in the window, and by how much they widen the intervals."""
        lengths = np.minimum(self._lengths, self._window.samples_in_window)
        return loss_of_samples(self._window.missing_samples(lengths) / np.maximum(lengths, 1), self._newest_fits)

    def step_slow_statistics(self) -> tuple[VarianceCurve, VarianceCurve] | None:
        """Run one step of the slow computations: total deviation, Hadamard deviation and search for a low-pass filter.

        Returns
        -------
        tuple of VarianceCurve and VarianceCurve, or None
            Total and Hadamard deviations if this step completes them, otherwise None.
        """
        rounds = self._total_hadamard.rounds
        self._total_hadamard.compute_next_tau()
        self._step_low_pass_search()
        return (
            self._total_hadamard.curves_of_last_round(self.rate_hz, np.where(self._entered, self._theta, 0.0))
            if self._total_hadamard.rounds > rounds
            else None
        )

    def _fit(self, variances: AllanVariances) -> Fit:
        """Fit all axes together, except for restarted axes, which have fewer samples and are fitted separately."""
        filled = self._window.samples_in_window
        np.minimum(self._lengths, filled, out=self._lengths)
        lengths = self._lengths.tolist()
        slope, slopes = self._window.drift_slopes_by_axis_and_tau(self._lengths, self._m)
        slope, slopes = slope * self.rate_hz, slopes * self.rate_hz
        before = self._entered if self._refit is None else self._refit.terms_in_fit
        whole = [axis for axis, n in enumerate(lengths) if n == filled]
        groups = [axes for axes in (whole, *([axis] for axis, n in enumerate(lengths) if n < filled)) if axes]
        fits = []
        self._newest_fits = []
        for axes in groups:
            table = self._tables.table_of_axis(axes[0], lengths[axes[0]], filled)
            columns = slice(None) if len(groups) == 1 else axes  # usually all axes, which need not be copied
            measured = MeasuredVariancesAndSlopes(
                variances.avar[:, columns], variances.terms[:, columns], slope[columns], slopes[:, columns],
                before[:, columns], variances.excess[:, columns],
            )  # fmt: skip
            one = fit_coefficients(self._design, table, measured, start_theta=self._theta[:, columns])
            self._theta[:, columns] = one.theta
            self._newest_fits.append(FitWithInputs(self._design, table, measured, one))
            for column, (axis, contradicts) in enumerate(zip(axes, axes_contradicting_five_terms(one), strict=True)):
                self._contradicting[axis] = (table, measured.select_axis(column)) if contradicts else None
            low_passes = [self._low_passes[axis] for axis in axes]
            if any(low_passes):
                one, _ = refit_with_low_passes(self._design, table, measured, one, low_passes)
            fits.append(one)
        result = fits[0] if len(fits) == 1 else concatenate_fits(fits, [axis for axes in groups for axis in axes])
        self._entered = result.entered
        return result

    def _step_low_pass_search(self) -> None:
        if self._search is not None:
            try:
                next(self._search)
            except StopIteration as end:
                self._low_passes[self._search_axis] = end.value
                self._search = None
            return
        for _ in range(len(self._contradicting)):
            self._search_axis = (self._search_axis + 1) % len(self._contradicting)
            contradicting = self._contradicting[self._search_axis]
            if contradicting is not None:
                self._search = search_low_pass_in_steps(
                    self._design,
                    *contradicting,
                    power_spectrum(self._window.newest_samples(self._search_axis, SPECTRUM_SAMPLES)),
                )
                return
            self._low_passes[self._search_axis] = None
