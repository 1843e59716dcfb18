"""A fit at every sample: the window advances by one, and the coefficients follow, in compiled code.

For frozen weights the fit is linear in the curve: rows of gains that ``fit_kernel`` leaves behind, some
hundred products an axis. A new solution is made when the old one no longer holds: a term would turn negative, enter
or leave, a coefficient has moved by a fifth and by more than its scatter, the slope would make or unmake a ramp, the
window has grown by a tenth, or a quarter of the window has passed. In between weights are stale by less
than that, which costs a least-squares fit next to nothing: its error depends on the weights in second order.

Comes in: samples. Goes out: the course of Q N B K R, a row a sample; what is not estimated is NaN there.
Intervals are for who looks: ``Estimator.get``.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Floats, Ints
from monitor.compiled import compiled
from monitor.estimate.fit import THRESHOLDS_WATCHED, TO_SI, Design, known
from monitor.estimate.fit_kernel import fit_axis
from monitor.estimate.least_squares import R
from monitor.estimate.uncertainty import NOISES, Tables
from monitor.estimate.verdict import NUMBERS, Answer, Gains, answer, gains
from monitor.estimate.window import AllanWindow
from monitor.estimate.window_kernel import (
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

REFRESH: Final = 4
"""Gains are made anew at least so often in the time a window takes to pass."""

PATIENCE: Final = 64
"""An axis without a solution is tried again after this share of the window."""

U0, U1, U2, U3, U4, U5, U6, U7 = (np.uintp(k) for k in range(NUMBERS))


class Refit:
    """The coefficients of a window, renewed with every sample.

    Args:
        window: advanced from here only
        rows: how many of its rows, from the first, are fitted
        tables: covariances of those rows
    """

    def __init__(self, window: AllanWindow, rows: int, tables: Tables) -> None:
        self._window, self._rows, self._tables = window, rows, tables
        self._curve, self._terms, self._slopes = np.zeros((3, AXES, rows))
        self._ages = np.zeros(AXES, np.int64)
        self.reset()

    def reset(self) -> None:
        """Begin anew, with no term in."""
        self._answer: Answer = answer(AXES, self._rows, np.zeros((AXES, 5), np.bool_))
        self._gains: Gains = gains(AXES, self._rows)
        self._n = 0

    def restart(self, axis: int) -> None:
        """One axis begins anew."""
        self._answer.entered[axis] = False
        self._answer.theta[axis] = np.nan
        self._gains.used[axis] = 0

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
        done = 0
        while done < len(values):
            n = min(self._window.n + 1, self._window.length)
            table = self._tables.at(n)
            if table.n != self._n:
                self._gains.used[:] = 0
                self._n = table.n
            until = min(len(values) - done, self._tables.lasts(n))
            _follow(
                self._window.parts(), done, until, lengths, known(design, table), THRESHOLDS_WATCHED,
                design.rate_hz**TO_SI,
                self._answer, self._gains, self._ages, self._curve, self._terms, self._slopes, course,
            )  # fmt: skip
            done += until


@compiled
def _follow(  # type: ignore[no-untyped-def]
    parts, start, n, lengths, known, thresholds, to_si, answer, gains, ages, curve, terms, slopes, course
):
    """Advance by n staged samples from row ``start``, and fit after each into that row of ``course``."""
    ints, floats, missing, taus, window = parts
    state, factors, _, counts, phase = cut_ints(ints, taus)
    scaling, _, sums, rest, _ = cut_floats(floats, taus)
    m = known.whole.size
    numbers, slope, held = np.empty((AXES, NUMBERS)), np.empty(AXES), np.empty(AXES, np.bool_)
    units, inverse = np.empty((AXES, m)), np.empty((AXES, m))
    for axis in range(AXES):
        for i in range(m):
            units[axis, i] = 2.0 * (factors[i] * scaling[axis]) ** 2
            inverse[axis, i] = 1.0 / (units[axis, i] * terms[axis, i])
    for row in range(start, start + n):
        advance(ints, floats, missing, taus, row, 1)
        filled = min(state[TOTAL], window)
        for axis in range(AXES):
            lengths[axis] = min(lengths[axis] + 1, filled)
            slope[axis] = thirds(phase, missing, state[NEWEST], lengths[axis], axis) / scaling[axis]
        _apply(
            units, inverse, terms, counts, sums, rest, slope,
            gains.rows, gains.ramp, gains.twist, gains.low, gains.high, gains.used, gains.straight, numbers, held,
        )  # fmt: skip
        for axis in range(AXES):
            ages[axis] += 1
            if held[axis] and ages[axis] * REFRESH <= filled:
                for a in range(NOISES):
                    if answer.theta[axis, a] != 0.0:
                        answer.theta[axis, a] = numbers[axis, a]
                if answer.entered[axis, R]:
                    answer.theta[axis, R] = slope[axis] ** 2
            elif gains.used[axis, 0] < gains.used[axis, 1] or ages[axis] * PATIENCE > filled:
                for i in range(m):
                    at = i * LANES + axis
                    total, terms[axis, i] = sums[at] + rest[at], counts[at]
                    inverse[axis, i] = 1.0 / (units[axis, i] * counts[at])
                    # as AllanWindow.avar: a constant axis has no noise
                    curve[axis, i] = total * inverse[axis, i] if total > counts[at] else 0.0
                    slopes[axis, i] = (
                        mean_bend(phase, missing, state[NEWEST], lengths[axis], factors[i], axis) / scaling[axis]
                    )
                fit_axis(axis, known, curve, terms, slope[axis], slopes, thresholds, False, True, answer, gains)
                ages[axis] = 0
            for a in range(5):
                estimated = answer.status[axis, a] == 2
                course[row, a, axis] = np.sqrt(max(answer.theta[axis, a], 0.0)) * to_si[a] if estimated else np.nan


@compiled
def _apply(  # type: ignore[no-untyped-def]
    units, inverse, terms, counts, sums, rest, slope, rows, ramp, twist, low, high, used, straight, numbers, held
):
    """The numbers [axes, NUMBERS] of the curve as it is now, and whether the gains still hold for them [axes]."""
    lanes = np.uintp(LANES)  # an index that could be negative would cost as much as the arithmetic
    for axis in range(np.uintp(numbers.shape[0])):
        n0 = n1 = n2 = n3 = n4 = n5 = n6 = n7 = 0.0
        for i in range(np.uintp(used[axis, 0]), np.uintp(used[axis, 1])):
            at = i * lanes + axis
            x = sums[at] + rest[at]
            x = x * inverse[axis, i] if counts[at] == terms[axis, i] else x / (units[axis, i] * counts[at])
            n0 += rows[axis, i, U0] * x
            n1 += rows[axis, i, U1] * x
            n2 += rows[axis, i, U2] * x
            n3 += rows[axis, i, U3] * x
            n4 += rows[axis, i, U4] * x
            n5 += rows[axis, i, U5] * x
            n6 += rows[axis, i, U6] * x
            n7 += rows[axis, i, U7] * x
        numbers[axis, U0], numbers[axis, U1], numbers[axis, U2], numbers[axis, U3] = n0, n1, n2, n3
        numbers[axis, U4], numbers[axis, U5], numbers[axis, U6], numbers[axis, U7] = n4, n5, n6, n7
        s = slope[axis]
        known = s == s
        held[axis] = used[axis, 1] > used[axis, 0] and straight[axis] == known
        if known:
            for r in range(NUMBERS):
                numbers[axis, r] -= s * (s * ramp[axis, r] + twist[axis, r])
            held[axis] = held[axis] and low[axis, NUMBERS] <= abs(s) <= high[axis, NUMBERS]
        for r in range(NUMBERS):  # false for NaN too
            held[axis] = held[axis] and low[axis, r] <= numbers[axis, r] <= high[axis, r]
