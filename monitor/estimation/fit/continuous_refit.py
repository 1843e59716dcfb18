"""Per-sample update of the coefficients in compiled code: the window advances by one sample, and the fit follows.

For fixed weights, the normal equations of the fit are linear in the curve. Each term is a row of ``Gains``, which takes
about eighty products per axis. The non-negative solution is a problem of four unknowns. If another set of terms becomes
positive, the equations are solved again with the same weights.

Weights and the selection of terms are recomputed in the following cases:

- A term would be added or dropped.
- A coefficient has moved by a fifth and by more than its scatter.
- The slope would add or drop a ramp.
- The window has grown by a tenth, or half of it has been replaced.

Between these events, the weights are out of date by less than that. This adds at most 2 % to the error of a
coefficient, because the error depends on the weights in second order.

The kernel returns when an axis needs new gains, and ``fit_axes`` is then called from Python. It is seldom needed, and
would otherwise be compiled a second time as a part of the kernel.

The result is one row of Q N B K R per sample, with NaN where a coefficient is not estimated. Intervals are computed
only by ``Estimator.get``.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Floats, Ints
from monitor.common.compiled import compiled
from monitor.estimation.allan.uncertainty import NOISES, UNLIMITED_SAMPLES, AxisCovarianceTables, CovarianceTable
from monitor.estimation.allan.window import AllanWindow
from monitor.estimation.allan.window_kernel import (
    AXES,
    LANES,
    NEWEST,
    STAGE_SAMPLES,
    TOTAL,
    advance,
    cut_floats,
    cut_ints,
    mean_second_difference,
    slope_of_thirds,
)
from monitor.estimation.fit.coefficient_fit import THRESHOLDS_WATCHED, TO_SI, Design, shared_inputs
from monitor.estimation.fit.coefficients import Status
from monitor.estimation.fit.fit_kernel import fit_axes
from monitor.estimation.fit.least_squares import Q, R, invert, nonzero_terms, solve_nonnegative
from monitor.estimation.fit.term_selection import (
    LIMIT_COUNT,
    FitOutput,
    Gains,
    SharedInputs,
    empty_fit_output,
    empty_gains,
)

REFRESH: Final = 2
"""Minimum number of times that the gains are recomputed within one window length."""

PATIENCE: Final = 64
"""Number of attempts per window length for an axis without a solution, or with a misfit of the five terms.

The gains cannot detect that a band limit, a spectral line or a transient has disappeared.
"""

U0, U1, U2, U3 = (np.uintp(a) for a in range(NOISES))


class ContinuousRefit:
    """Coefficients of a window, updated with every sample.

    Parameters
    ----------
    window : AllanWindow
        Window that is advanced only by this object.
    rows : int
        Number of rows of the window that are fitted, from the first.
    tables : AxisCovarianceTables
        Covariances of these rows, for the length of each axis.
    """

    def __init__(self, window: AllanWindow, rows: int, tables: AxisCovarianceTables) -> None:
        self._window, self._rows, self._tables = window, rows, tables
        self._curve, self._terms, self._slopes = np.zeros((3, AXES, rows))
        self._slope = np.zeros(AXES)
        self._ages = np.zeros(AXES, np.int64)
        self.reset()

    def reset(self) -> None:
        """Restart the fit of all axes, without any term."""
        self._answer: FitOutput = empty_fit_output(AXES, self._rows, np.zeros((AXES, 5), np.bool_))
        self._gains: Gains = empty_gains(AXES, self._rows)
        self._used: list[CovarianceTable | None] = [None] * AXES  # tables from which ``_known`` was computed
        self._known: list[SharedInputs] = []

    def restart(self, axis: int) -> None:
        """Restart the fit of one axis. It is fitted at the next sample."""
        self._answer.entered[axis], self._answer.status[axis] = False, 0
        self._answer.theta[axis] = np.nan
        self._request_fit(axis)

    @property
    def entered(self) -> NDArray[np.bool_]:
        """Terms in the fit, shape (5, 6)."""
        return self._answer.entered.T

    def update(self, design: Design, values: Floats, lengths: Ints) -> Floats:
        """Advance the window by samples and return the coefficients after each.

        Parameters
        ----------
        design : Design
            Columns of the fit.
        values : ndarray of float64, shape (n, 6)
            Samples in rad/s and m/s²; NaN means missing.
        lengths : ndarray of int64, shape (6,)
            Number of samples of each axis in the window, updated in place.

        Returns
        -------
        ndarray of float64, shape (n, 5, 6)
            Coefficients in SI; NaN where not estimated.
        """
        course = np.empty((len(values), 5, AXES))
        for start in range(0, len(values), STAGE_SAMPLES):
            self._advance(design, values[start : start + STAGE_SAMPLES], lengths, course[start : start + STAGE_SAMPLES])
        return course

    def _advance(self, design: Design, values: Floats, lengths: Ints, course: Floats) -> None:
        """Advance by up to ``STAGE_SAMPLES`` samples and write the coefficients into ``course``."""
        self._window.stage(values)
        to_si = design.rate_hz**TO_SI
        done = 0
        while done < len(values):
            until = done + min(len(values) - done, self._find_tables(design, lengths))
            while done < until:
                done, due = _follow(
                    self._window.kernel_arrays(), done, until, lengths, to_si, self._answer, self._gains, self._ages,
                    self._curve, self._terms, self._slope, self._slopes, course,
                )  # fmt: skip
                if due:
                    self._fit([axis for axis in range(AXES) if due >> axis & 1], to_si, course[done - 1])

    def _fit(self, axes: list[int], to_si: Floats, coefficients: Floats) -> None:
        """Fit some axes to ``_curve``, and write the estimated coefficients into ``coefficients`` [5, 6]."""
        for axis in axes:
            fit_axes(
                axis, axis + 1, self._known[axis], self._curve, self._terms, self._slope, self._slopes,
                THRESHOLDS_WATCHED, False, True, self._answer, self._gains,
            )  # fmt: skip
        size = np.sqrt(np.maximum(self._answer.theta[axes], 0.0)) * to_si
        coefficients[:, axes] = np.where(self._answer.status[axes] == Status.ESTIMATED, size, np.nan).T

    def _find_tables(self, design: Design, lengths: Ints) -> int:
        """Find the table of every axis, and return for how many samples all tables stay valid."""
        filled = min(self._window.n + 1, self._window.length)
        lasts = UNLIMITED_SAMPLES
        for axis in range(AXES):
            n = min(int(lengths[axis]) + 1, filled)
            tables = self._tables.of(axis, n, filled)
            table = tables.at(n)
            if table is not self._used[axis]:
                self._used[axis] = table
                self._request_fit(axis)
                self._known[axis : axis + 1] = [shared_inputs(design, table)]
            lasts = min(lasts, tables.valid_for(n))
        return lasts

    def _request_fit(self, axis: int) -> None:
        """Request a fit of one axis at the next sample."""
        self._gains.used[axis] = 0
        self._ages[axis] = self._window.length


@compiled
def _follow(  # type: ignore[no-untyped-def]
    parts, start, end, lengths, to_si, answer, gains, ages, curve, terms, slope, slopes, course
):
    """Advance by staged samples from row ``start``, and write the coefficients of each into that row of ``course``.

    Stop at row ``end``, or after a row at which axes must be fitted to ``curve``. Return the next row and these axes as
    a bit set.
    """
    ints, floats, missing, taus, window = parts
    state, factors, _, counts, phase = cut_ints(ints, taus)
    scaling, _, sums, rest, _ = cut_floats(floats, taus)
    m = curve.shape[1]
    right, held = np.empty((AXES, 5)), np.empty(AXES, np.bool_)
    units, inverse = np.empty((AXES, m)), np.empty((AXES, m))
    for axis in range(AXES):
        for i in range(m):
            units[axis, i] = 2.0 * (factors[i] * scaling[axis]) ** 2
            inverse[axis, i] = 1.0 / (units[axis, i] * terms[axis, i])
    for row in range(start, end):
        due = 0
        advance(ints, floats, missing, taus, row, 1)
        filled = min(state[TOTAL], window)
        for axis in range(AXES):
            lengths[axis] = min(lengths[axis] + 1, filled)
            slope[axis] = slope_of_thirds(phase, missing, state[NEWEST], lengths[axis], axis) / scaling[axis]
        _project(
            units, inverse, terms, counts, sums, rest, slope, gains.rows, gains.ramp, gains.twist, gains.used, right
        )
        _settle(
            right, slope, gains.normal, gains.inverse, gains.whole, gains.low, gains.high, gains.used, gains.free,
            gains.straight, answer.entered, answer.theta, held,
        )  # fmt: skip
        for axis in range(AXES):
            ages[axis] += 1
            solved = gains.used[axis, 1] > gains.used[axis, 0]
            explained = solved and not gains.free[axis] and answer.misfit[axis] == 1.0
            if (solved and not held[axis]) or ages[axis] * (REFRESH if explained else PATIENCE) > lengths[axis]:
                for i in range(m):
                    at = i * LANES + axis
                    total, terms[axis, i] = sums[at] + rest[at], counts[at]
                    inverse[axis, i] = 1.0 / (units[axis, i] * counts[at])
                    # as in AllanWindow.avar, a constant axis has no noise
                    curve[axis, i] = total * inverse[axis, i] if total > counts[at] else 0.0
                    bend = mean_second_difference(phase, missing, state[NEWEST], lengths[axis], factors[i], axis)
                    slopes[axis, i] = bend / scaling[axis]
                due |= 1 << axis
                ages[axis] = 0
            for a in range(5):
                estimated = answer.status[axis, a] == 2
                course[row, a, axis] = np.sqrt(max(answer.theta[axis, a], 0.0)) * to_si[a] if estimated else np.nan
        if due > 0:
            return row + 1, due
    return end, 0


@compiled
def _project(  # type: ignore[no-untyped-def]
    units, inverse, terms, counts, sums, rest, slope, rows, ramp, twist, used, right
):
    """Compute r = Xᵀ V⁻¹ y [axes, NOISES] of the current curve."""
    lanes = np.uintp(LANES)  # unsigned, because checks for negative indices would cost as much as the arithmetic
    for axis in range(np.uintp(AXES)):
        q = n = b = k = 0.0
        for i in range(np.uintp(used[axis, 0]), np.uintp(used[axis, 1])):
            at = i * lanes + axis
            x = sums[at] + rest[at]
            x = x * inverse[axis, i] if counts[at] == terms[axis, i] else x / (units[axis, i] * counts[at])
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
def _settle(  # type: ignore[no-untyped-def]
    right, slope, normal, inverse, whole, low, high, used, free, straight, entered, theta, held
):
    """Compute θ [axes, 5] from the gains, and whether the gains are still valid [axes].

    If another set of terms is now positive, θ is solved again with the same weights. Without gains, θ is not changed.
    """
    for axis in range(np.uintp(AXES)):
        if used[axis, 1] <= used[axis, 0]:
            held[axis] = False
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
                theta[axis, a] = x if allowed else 0.0  # a new fit starts with the weights of this θ
            # False for NaN, too; only a term that is not zero can be added
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
            invert(normal[axis], nonzero_terms(theta[axis]), inverse[axis])
        for a in range(np.uintp(NOISES)):
            holds = holds and low[axis, a] <= theta[axis, a] <= high[axis, a]
        theta[axis, R] = s * s if entered[axis, R] else 0.0
        held[axis] = holds
