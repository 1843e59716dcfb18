"""Compiled code that updates the noise coefficients with every sample.

For fixed weights, the solution of the least-squares fit is a linear function of the Allan variances. ``SolutionMaps``
contains the matrices of this linear function. If a coefficient becomes zero or positive, the normal equations are
solved again with the same weights.

The weights and the selection of noise terms are recomputed in each of the following cases.

- A noise term or a linear drift would be added or dropped.
- A coefficient has changed by a fifth and by more than its standard deviation.
- The window has grown by a tenth, or half of its samples have been replaced.

Outdated weights increase the error of a coefficient by at most 2 %. To recompute the weights of an axis, the compiled
loop over the samples stops, and Python calls ``fit_axes``. A call inside the loop would compile ``fit_axes`` a second
time.

The result contains Q, N, B, K and R after every sample, with NaN for coefficients that are not estimated. Confidence
intervals are only computed by ``Estimator.get_estimate``.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled, inlined
from monitor.common.compiled_vectors import LANES
from monitor.estimation.allan.uncertainty import NOISES, UNLIMITED_SAMPLES, CovarianceTable, CovarianceTablesByAxis
from monitor.estimation.allan.window import AllanWindow
from monitor.estimation.allan.window_kernel import (
    AXES,
    LAST_MISSING,
    MAX_ROUNDING_SQUARE,
    NEWEST,
    STAGE_SAMPLES,
    TOTAL,
    WindowArrays,
    WindowBuffers,
    append_staged_samples,
    compiled_view_window_arrays,
    compute_variances,
    integer_slope_from_thirds,
    mean_rate_slope,
)
from monitor.estimation.fit.coefficient_fit import THRESHOLDS_WATCHED, TO_SI, DesignMatrix, make_shared_inputs
from monitor.estimation.fit.coefficients_with_intervals import Status
from monitor.estimation.fit.fit_kernel import fit_axes
from monitor.estimation.fit.fit_kernel_types import (
    LIMIT_COUNT,
    FitOptions,
    FitOutput,
    SharedInputs,
    SolutionMaps,
    VariancesAndSlopesOfAxes,
    empty_fit_output,
    empty_solution_maps,
)
from monitor.estimation.fit.least_squares import Q, R, invert_on_subset, nonzero_term_bits, solve_nonnegative

REFRESH: Final = 2
"""Minimum number of fits of an axis while the window moves by its own length."""
PATIENCE: Final = 64
"""Minimum number of fits per window length for an axis without a satisfactory fit."""
OPTIONS: Final = FitOptions(*THRESHOLDS_WATCHED, full_covariance=False, warm=True)
"""Options of the fits that recompute the weights."""

U0, U1, U2, U3 = (np.uintp(a) for a in range(NOISES))


class RefitState(NamedTuple):
    """State of the continuous fit of all axes."""

    curves: VariancesAndSlopesOfAxes  # at the last fit, but ``slope`` is updated with every sample
    output: FitOutput
    maps: SolutionMaps
    ages: Ints  # [6] number of samples since the last fit of each axis


class SumsToVariances(NamedTuple):
    """Factors that convert the sums of squares in the window to Allan variances."""

    unit: Floats  # [6, m] factor 2 m² in squared units of phase
    inverse: Floats  # [6, m] 1/(unit · terms) for the number of second differences at the last fit


class ContinuousRefit:
    """Noise coefficients of a sliding window that are updated with every sample.

    Parameters
    ----------
    window : AllanWindow
        Sliding window, to which no other object may append samples.
    rows : int
        Number of cluster sizes to which the coefficients are fitted.
    tables : CovarianceTablesByAxis
        Covariances of the Allan variances at the fitted cluster sizes.
    """

    def __init__(self, window: AllanWindow, rows: int, tables: CovarianceTablesByAxis) -> None:
        self._window, self._rows, self._tables = window, rows, tables
        avar, terms, slopes, excess = np.zeros((4, AXES, rows))
        self._curves = VariancesAndSlopesOfAxes(avar, terms, np.zeros(AXES), slopes, excess)
        self._ages = np.zeros(AXES, np.int64)
        self.restart_all_fits()

    def restart_all_fits(self) -> None:
        """Restart the fits of all axes from an empty set of noise terms."""
        output = empty_fit_output(AXES, self._rows, np.zeros((AXES, 5), np.bool_))
        output.status[:], output.misfit[:] = Status.UNESTIMATED, 1.0
        self._state = RefitState(self._curves, output, empty_solution_maps(AXES, self._rows), self._ages)
        self._used: list[CovarianceTable | None] = [None] * AXES  # covariance tables from which ``_known`` was computed
        self._known: list[SharedInputs] = []

    def restart_fit_of_axis(self, axis: int) -> None:
        """Restart the fit of one axis with the next sample."""
        output = self._state.output
        output.entered[axis], output.status[axis], output.theta[axis] = False, 0, np.nan
        self._request_fit(axis)

    @property
    def terms_in_fit(self) -> NDArray[np.bool_]:
        """Boolean array of shape (5, 6) that is True for noise terms that are included in the fit."""
        return self._state.output.entered.T

    def append_and_refit_after_each_sample(self, design: DesignMatrix, samples: Floats, lengths: Ints) -> Floats:
        """Append samples to the window, and return the noise coefficients after each sample.

        Parameters
        ----------
        design : DesignMatrix
            Design matrix of the fit.
        samples : ndarray of float64, shape (n, 6)
            Samples in rad/s and m/s²; NaN means missing.
        lengths : ndarray of int64, shape (6,)
            Number of newest samples that are used for each axis, updated in place.

        Returns
        -------
        ndarray of float64, shape (n, 5, 6)
            Coefficients in SI units; NaN for coefficients that are not estimated.
        """
        coefficients = np.empty((len(samples), 5, AXES))
        for start in range(0, len(samples), STAGE_SAMPLES):
            part = slice(start, start + STAGE_SAMPLES)
            self._advance(design, samples[part], lengths, coefficients[part])
        return coefficients

    def _advance(self, design: DesignMatrix, values: Floats, lengths: Ints, coefficients: Floats) -> None:
        self._window.copy_to_input_buffer(values)
        to_si = design.rate_hz**TO_SI
        done = 0
        while done < len(values):
            until = done + min(len(values) - done, self._find_tables(design, lengths))
            while done < until:
                done, due = _follow(
                    self._window.kernel_buffers(), self._state, lengths, to_si, done, until, coefficients
                )
                if due:
                    self._fit([axis for axis in range(AXES) if due >> axis & 1], to_si, coefficients[done - 1])

    def _fit(self, axes: list[int], to_si: Floats, coefficients: Floats) -> None:
        output = self._state.output
        for axis in axes:
            fit_axes(axis, axis + 1, self._known[axis], self._curves, OPTIONS, output, self._state.maps)
        size = np.sqrt(np.maximum(output.theta[axes], 0.0)) * to_si
        coefficients[:, axes] = np.where(output.status[axes] == Status.ESTIMATED, size, np.nan).T

    def _find_tables(self, design: DesignMatrix, lengths: Ints) -> int:
        """Find the covariance tables of all axes, and return the number of samples for which they stay valid."""
        filled = min(self._window.samples_in_window + 1, self._window.length)
        lasts = UNLIMITED_SAMPLES
        for axis in range(AXES):
            n = min(int(lengths[axis]) + 1, filled)
            table = self._tables.table_of_axis(axis, n, filled)
            if table is not self._used[axis]:
                self._used[axis] = table
                self._request_fit(axis)
                self._known[axis : axis + 1] = [make_shared_inputs(design, table)]
            lasts = min(lasts, self._tables.samples_until_table_expires(table, n))
        return lasts

    def _request_fit(self, axis: int) -> None:
        self._state.maps.used[axis] = 0
        self._ages[axis] = self._window.length


@compiled
def _follow(
    buffers: WindowBuffers, state: RefitState, lengths: Ints, to_si: Floats, start: int, end: int, coefficients: Floats
) -> tuple[int, int]:
    """Append samples from the input buffer to the window, and write the coefficients after each sample.

    If an axis must be fitted again, the function stops and copies the Allan variances of the axis to ``state.curves``.
    The function returns the index of the next sample and the bit set of the axes to fit.
    """
    w = compiled_view_window_arrays(buffers.memory, buffers.taus)
    curves, output, maps, ages = state
    memory, taus, window = buffers
    # Fields are copied to local variables, because each access to a field in a loop changes a reference count.
    counters, phase, missing, scaling, terms, slope = w.state, w.phase, w.missing, w.scaling, curves.terms, curves.slope
    work = np.empty((3, taus, AXES))
    grid = int(np.count_nonzero(w.first == 0))  # number of cluster sizes of the fit, and powers of two between them
    used, free, misfit, theta, status = maps.used, maps.free, output.misfit, output.theta, output.status
    right, valid, m = np.empty((AXES, 5)), np.empty(AXES, np.bool_), terms.shape[1]
    unit, inverse = np.empty((AXES, m)), np.empty((AXES, m))
    for axis in range(AXES):
        for i in range(m):
            unit[axis, i] = 2.0 * (w.factors[i] * scaling[axis]) ** 2
            inverse[axis, i] = 1.0 / (unit[axis, i] * terms[axis, i])
    scale = SumsToVariances(unit, inverse)
    for row in range(start, end):
        due = 0
        append_staged_samples(memory, taus, row, 1)
        filled = min(counters[TOTAL], window)
        for axis in range(AXES):
            lengths[axis] = min(lengths[axis] + 1, filled)
            slope[axis] = (
                integer_slope_from_thirds(phase, missing, counters[NEWEST], lengths[axis], axis) / scaling[axis]
            )
        _project(w, scale, curves, maps, right)
        if counters[TOTAL] - counters[LAST_MISSING] <= window:
            _subtract_excess(w, grid, maps, work, right)
        _apply_maps(right, slope, maps, output, valid)
        for axis in range(AXES):
            ages[axis] += 1
            solved = used[axis, 1] > used[axis, 0]
            patience = REFRESH if solved and not free[axis] and misfit[axis] == 1.0 else PATIENCE
            if (solved and not valid[axis]) or ages[axis] * patience > lengths[axis]:
                _copy_curve(w, grid, scale, curves, axis, lengths[axis])
                due |= 1 << axis
                ages[axis] = 0
            for a in range(5):
                estimated = status[axis, a] == 2
                coefficients[row, a, axis] = np.sqrt(max(theta[axis, a], 0.0)) * to_si[a] if estimated else np.nan
        if due > 0:
            return row + 1, due
    return end, 0


@compiled
def _copy_curve(
    w: WindowArrays, grid: int, scale: SumsToVariances, curves: VariancesAndSlopesOfAxes, axis: int, length: int
) -> None:
    work = np.empty((3, w.factors.size, AXES))
    avar, excess, share = work[0], work[1], work[2]
    compute_variances(w, grid, avar, excess, share)
    for i in range(curves.avar.shape[1]):
        at = i * LANES + axis
        total, count = w.sums[at] + w.rest[at], w.terms[at]
        curves.terms[axis, i] = count
        scale.inverse[axis, i] = 1.0 / (scale.unit[axis, i] * count)
        # Smaller sums can be caused by rounding alone, as in AllanWindow.avar.
        limit = MAX_ROUNDING_SQUARE if w.excess[at] != 0 else 1.0
        curves.avar[axis, i] = total * scale.inverse[axis, i] - excess[i, axis] if total > limit * count else 0.0
        curves.excess[axis, i] = excess[i, axis]
        bend = mean_rate_slope(w.phase, w.missing, w.state[NEWEST], length, w.factors[i], axis)
        curves.slopes[axis, i] = bend / w.scaling[axis]


@inlined
def _project(
    w: WindowArrays, scale: SumsToVariances, curves: VariancesAndSlopesOfAxes, maps: SolutionMaps, right: Floats
) -> None:
    lanes = np.uintp(LANES)  # unsigned, because checks for negative indices would slow down the loop
    # Fields are copied to local variables, because each access to a field in a loop changes a reference count.
    sums, rest, counts, terms, slope = w.sums, w.rest, w.terms, curves.terms, curves.slope
    unit, inverse, used = scale.unit, scale.inverse, maps.used
    rows, ramp, twist = maps.rows, maps.ramp, maps.twist
    for axis in range(np.uintp(AXES)):
        q = n = b = k = 0.0
        for i in range(np.uintp(used[axis, 0]), np.uintp(used[axis, 1])):
            at = i * lanes + axis
            x = sums[at] + rest[at]
            x = x * inverse[axis, i] if counts[at] == terms[axis, i] else x / (unit[axis, i] * counts[at])
            q += rows[axis, i, U0] * x
            n += rows[axis, i, U1] * x
            b += rows[axis, i, U2] * x
            k += rows[axis, i, U3] * x
        s = slope[axis] if slope[axis] == slope[axis] else 0.0
        right[axis, U0] = q - s * (s * ramp[axis, U0] + twist[axis, U0])
        right[axis, U1] = n - s * (s * ramp[axis, U1] + twist[axis, U1])
        right[axis, U2] = b - s * (s * ramp[axis, U2] + twist[axis, U2])
        right[axis, U3] = k - s * (s * ramp[axis, U3] + twist[axis, U3])


@compiled
def _subtract_excess(w: WindowArrays, grid: int, maps: SolutionMaps, work: Floats, right: Floats) -> None:
    """Subtract the contribution of missing samples to the mean squares from the right-hand sides.

    ``work`` [3, m, 6] is memory for intermediate results.
    """
    avar, excess, share = work[0], work[1], work[2]
    rows, used = maps.rows, maps.used
    compute_variances(w, grid, avar, excess, share)
    for axis in range(AXES):
        for i in range(used[axis, 0], used[axis, 1]):
            for a in range(NOISES):
                right[axis, a] -= rows[axis, i, a] * excess[i, axis]


@inlined
def _apply_maps(right: Floats, slope: Floats, maps: SolutionMaps, output: FitOutput, valid: NDArray[np.bool_]) -> None:
    """Compute θ [axes, 5] from the linear maps, and set ``valid`` [axes] to True where a map is still valid.

    For an axis without a linear map, θ is not changed.
    """
    normal, inverse, whole, low, high = maps.normal, maps.inverse, maps.whole, maps.low, maps.high
    used, free, straight, theta, entered = maps.used, maps.free, maps.straight, output.theta, output.entered
    for axis in range(np.uintp(AXES)):
        if used[axis, 1] <= used[axis, 0]:
            valid[axis] = False
            continue
        s = slope[axis]
        measured = s == s
        holds = measured == straight[axis] and (
            not measured or low[axis, LIMIT_COUNT] <= abs(s) <= high[axis, LIMIT_COUNT]
        )
        same = True
        for a in range(np.uintp(NOISES)):
            x, u = 0.0, 0.0
            for b in range(np.uintp(NOISES)):
                x += inverse[axis, a, b] * right[axis, b]
                u += whole[axis, a, b] * right[axis, b]
            there = theta[axis, a] != 0.0
            if there:
                allowed = x > 0.0 or (free[axis] and a == Q)
                same = same and allowed
                theta[axis, a] = x if allowed else 0.0  # the next fit computes its first weights from this θ
            # For NaN, the following comparison is False.
            limit = high[axis, NOISES + a] if there else np.inf
            holds = holds and low[axis, NOISES + a] <= u <= limit
        for a in range(np.uintp(NOISES)):
            if theta[axis, a] == 0.0:
                pull = right[axis, a]
                for b in range(np.uintp(NOISES)):
                    pull -= normal[axis, a, b] * theta[axis, b]
                same = same and pull <= 1e-9 * abs(right[axis, a])
        if holds and not same:
            solve_nonnegative(normal[axis], right[axis], free[axis], theta[axis])
            invert_on_subset(normal[axis], nonzero_term_bits(theta[axis]), inverse[axis])
        for a in range(np.uintp(NOISES)):
            holds = holds and low[axis, a] <= theta[axis, a] <= high[axis, a]
        theta[axis, R] = s * s if entered[axis, R] else 0.0
        valid[axis] = holds
