"""A fit at every sample: the window advances by one, and the coefficients follow, in compiled code.

For frozen weights the normal equations of the fit are linear in the curve: a row of ``Gains`` a term, some eighty
products an axis; the non-negative solution is a matter of four by four. Where another set of terms becomes positive,
that is solved anew with the same weights. Weights and verdicts are made anew when they no longer hold: a term would
enter or leave, a coefficient has moved by a fifth and by more than its scatter, the slope would make or unmake a ramp,
the window has grown by a tenth, or half of it has passed. In between weights are stale by less than that, which adds
2 % to the error of a coefficient at most: it depends on the weights in second order.

The kernel returns where an axis needs new gains, and ``fit_axes`` is called from here: it is seldom needed, and would
otherwise be compiled a second time as a part of the kernel.

Comes in: samples. Goes out: the course of Q N B K R, a row a sample; what is not estimated is NaN there.
Intervals are for who looks: ``Estimator.get``.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Floats, Ints
from monitor.common.compiled import compiled
from monitor.estimation.allan.uncertainty import FOR_EVER, NOISES, AxisTables, Table
from monitor.estimation.allan.window import AllanWindow
from monitor.estimation.allan.window_kernel import (
    AXES,
    LANES,
    NEWEST,
    STAGE,
    TOTAL,
    advance,
    cut_floats,
    cut_ints,
    mean_bend,
    thirds,
)
from monitor.estimation.fit.coefficient_fit import THRESHOLDS_WATCHED, TO_SI, Design, known
from monitor.estimation.fit.coefficients import Status
from monitor.estimation.fit.fit_kernel import fit_axes
from monitor.estimation.fit.least_squares import Q, R, invert, present, solve_nonnegative
from monitor.estimation.fit.term_selection import NUMBERS, Answer, Gains, Known, answer, gains

REFRESH: Final = 2
"""Gains are made anew at least so often in the time a window takes to pass."""

PATIENCE: Final = 64
"""An axis is tried again after this share of the window while it has no solution, or one that the five terms alone do
not explain: gains cannot tell when a band limit, a line or a transient is gone."""

U0, U1, U2, U3 = (np.uintp(a) for a in range(NOISES))


class Refit:
    """The coefficients of a window, renewed with every sample.

    Args:
        window: advanced from here only
        rows: how many of its rows, from the first, are fitted
        tables: covariances of those rows, for each axis those of its own length
    """

    def __init__(self, window: AllanWindow, rows: int, tables: AxisTables) -> None:
        self._window, self._rows, self._tables = window, rows, tables
        self._curve, self._terms, self._slopes = np.zeros((3, AXES, rows))
        self._slope = np.zeros(AXES)
        self._ages = np.zeros(AXES, np.int64)
        self.reset()

    def reset(self) -> None:
        """Begin anew, with no term in."""
        self._answer: Answer = answer(AXES, self._rows, np.zeros((AXES, 5), np.bool_))
        self._gains: Gains = gains(AXES, self._rows)
        self._used: list[Table | None] = [None] * AXES  # whose ``Known`` those are
        self._known: list[Known] = []

    def restart(self, axis: int) -> None:
        """One axis begins anew, and is fitted at the next sample."""
        self._answer.entered[axis], self._answer.status[axis] = False, 0
        self._answer.theta[axis] = np.nan
        self._fit_anew(axis)

    @property
    def entered(self) -> NDArray[np.bool_]:
        """Which terms are in [5, 6]."""
        return self._answer.entered.T

    def update(self, design: Design, values: Floats, lengths: Ints) -> Floats:
        """Advance by samples [n, 6]; the coefficients [n, 5, 6] in SI after each, NaN where not estimated.

        ``lengths`` [6], samples of each axis that the window holds, are advanced too.
        """
        course = np.empty((len(values), 5, AXES))
        for start in range(0, len(values), STAGE):
            self._advance(design, values[start : start + STAGE], lengths, course[start : start + STAGE])
        return course

    def _advance(self, design: Design, values: Floats, lengths: Ints, course: Floats) -> None:
        self._window.stage(values)
        to_si = design.rate_hz**TO_SI
        done = 0
        while done < len(values):
            until = done + min(len(values) - done, self._lookup(design, lengths))
            while done < until:
                done, due = _follow(
                    self._window.parts(), done, until, lengths, to_si, self._answer, self._gains, self._ages,
                    self._curve, self._terms, self._slope, self._slopes, course,
                )  # fmt: skip
                if due:
                    self._fit([axis for axis in range(AXES) if due >> axis & 1], to_si, course[done - 1])

    def _fit(self, axes: list[int], to_si: Floats, coefficients: Floats) -> None:
        """Fit some axes to ``_curve``, and write what is estimated into ``coefficients`` [5, 6]."""
        for axis in axes:
            fit_axes(
                axis, axis + 1, self._known[axis], self._curve, self._terms, self._slope, self._slopes,
                THRESHOLDS_WATCHED, False, True, self._answer, self._gains,
            )  # fmt: skip
        size = np.sqrt(np.maximum(self._answer.theta[axes], 0.0)) * to_si
        coefficients[:, axes] = np.where(self._answer.status[axes] == Status.ESTIMATED, size, np.nan).T

    def _lookup(self, design: Design, lengths: Ints) -> int:
        """Find the table of every axis; for how many samples these last."""
        filled = min(self._window.n + 1, self._window.length)
        lasts = FOR_EVER
        for axis in range(AXES):
            n = min(int(lengths[axis]) + 1, filled)
            tables = self._tables.of(axis, n, filled)
            table = tables.at(n)
            if table is not self._used[axis]:
                self._used[axis] = table
                self._fit_anew(axis)
                self._known[axis : axis + 1] = [known(design, table)]
            lasts = min(lasts, tables.lasts(n))
        return lasts

    def _fit_anew(self, axis: int) -> None:
        """At the next sample."""
        self._gains.used[axis] = 0
        self._ages[axis] = self._window.length


@compiled
def _follow(  # type: ignore[no-untyped-def]
    parts, start, end, lengths, to_si, answer, gains, ages, curve, terms, slope, slopes, course
):
    """Advance by staged samples from row ``start``, each with its coefficients into that row of ``course``.

    Stop at row ``end``, or after a row at which axes are to be fitted to ``curve``. Return the row after the last, and
    those axes as a set of bits.
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
            slope[axis] = thirds(phase, missing, state[NEWEST], lengths[axis], axis) / scaling[axis]
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
                    # as AllanWindow.avar: a constant axis has no noise
                    curve[axis, i] = total * inverse[axis, i] if total > counts[at] else 0.0
                    bend = mean_bend(phase, missing, state[NEWEST], lengths[axis], factors[i], axis)
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
    """r = Xᵀ V⁻¹ y [axes, NOISES] of the curve as it is now."""
    lanes = np.uintp(LANES)  # an index that could be negative would cost as much as the arithmetic
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
    """θ [axes, 5] by the gains, and whether they hold [axes].

    Where another set of terms is positive now, θ is solved for anew with the same weights. Without gains it stays.
    """
    for axis in range(np.uintp(AXES)):
        if used[axis, 1] <= used[axis, 0]:
            held[axis] = False
            continue
        s = slope[axis]
        measured = s == s
        holds = measured == straight[axis] and (not measured or low[axis, NUMBERS] <= abs(s) <= high[axis, NUMBERS])
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
                theta[axis, a] = x if allowed else 0.0  # a new fit begins with the weights of these
            # false for NaN too; only a term that is there can enter
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
            invert(normal[axis], present(theta[axis]), inverse[axis])
        for a in range(np.uintp(NOISES)):
            holds = holds and low[axis, a] <= theta[axis, a] <= high[axis, a]
        theta[axis, R] = s * s if entered[axis, R] else 0.0
        held[axis] = holds
