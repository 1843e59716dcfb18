"""The arithmetic of ``fit``, compiled: weights and a non-negative solution, one axis after another.

Everything is in units of one sample: avar of the axis, θ as in ``uncertainty``. Results are arrays of the caller, one
row an axis (``verdict.Answer``, ``verdict.Gains``); what stays NaN was not to be had.

For given weights the solution is linear in the curve. So beside the answer the rows of that linear map are kept, with
the limits inside which their answer is as good as a new one: ``refit`` applies them to the curve of every sample.
"""

from typing import Final

import numpy as np

from monitor.common.compiled import compiled
from monitor.estimation.allan.uncertainty import NOISES, PAIRS
from monitor.estimation.fit.confidence_bounds import bound_by_first_point, cap
from monitor.estimation.fit.least_squares import K, N, Q, R, normal_equations, solve_nonnegative, variances, weigh
from monitor.estimation.fit.term_selection import freeze, judge, judge_ramp, sharpen

MIN_ROWS: Final = NOISES + 1
"""Fewer τ than this leave a fit no freedom to be contradicted."""

PASSES: Final = 3
"""Re-weightings from nothing; more of them move no coefficient by a tenth of its standard deviation."""

WARM_PASSES: Final = 1
"""Re-weightings from the coefficients of a moment ago."""

MISFIT: Final = 4.0
"""A short τ contradicts the fit when it is this many σ away."""

MISFIT_AGAIN: Final = 2.5
"""The same once one has: what is left of a band limit must not pull N."""

MISFIT_OF_ALL: Final = 6.0
"""Standard deviations of a χ² a τ, beyond which the five terms are no description of the curve."""

SHORT_ROWS: Final = 4
"""How many of the shortest τ in use are asked whether they contradict the fit."""

FILTER_MEMORY: Final = 16
"""Clusters of more samples are not left out: a filter that reaches so far would be no noise of the sensor."""

WHITE: Final = PAIRS.index((N, N))


@compiled
def fit_axes(  # type: ignore[no-untyped-def]
    first, end, known, avar, terms, slope, slopes, thresholds, full, warm, answer, gains
):
    """Fit the axes first ≤ axis < end: ``avar``, ``terms`` and ``slopes`` [axes, m], ``slope`` [axes] or NaN."""
    for axis in range(first, end):
        fit_axis(axis, known, avar, terms, slope[axis], slopes, thresholds, full, warm, answer, gains)


@compiled
def fit_axis(  # type: ignore[no-untyped-def]
    axis, known, avar, terms, slope, slopes, thresholds, full, warm, answer, gains
):
    """Fit one axis; ``warm``: begin with the weights of ``answer.theta``. Without enough τ nothing is said."""
    m = known.whole.size
    curve, level, stretch = avar[axis], np.empty(m), np.empty(m)
    straight = slope == slope
    flat = known.flat if straight else known.columns
    rows = _levels(known, curve, terms[axis], slope, slopes[axis], level, stretch)
    gains.used[axis, 0] = gains.used[axis, 1] = 0
    gains.either[axis] = False
    gains.straight[axis] = straight
    if rows.size < MIN_ROWS:
        for a in range(5):
            answer.entered[axis, a], answer.status[axis, a] = False, 0
        return
    theta, entered, status = answer.theta[axis], answer.entered[axis], answer.status[axis]
    lo, hi = answer.lo[axis], answer.hi[axis]
    variance, weighted, normal, right = np.empty(m), np.empty((m, 5)), np.empty((5, 5)), np.empty(5)
    while True:
        first, free = _fit_terms(
            curve, level, rows, stretch, flat, known, full, warm, variance, weighted, normal, right, theta
        )
        scatter, limit = _misfit(level, rows[first:], theta, flat, variance)
        if not full or scatter <= limit:
            break
        full = False  # covariances of noises that are not those of the curve draw a fit away from all of its points
    for a in range(5):
        lo[a], hi[a], status[a] = np.nan, np.nan, 0
    misfit = scatter if scatter > limit else 1.0
    found, c0, enters = judge(
        level, rows[first:], stretch, known.covariance, weighted, normal, thresholds, straight, misfit,
        entered, theta, lo, hi, status,
    )  # fmt: skip
    sharpen(level, rows[first:], stretch, flat, known.covariance, misfit, found, c0, theta, hi, status)
    for a in range(5):
        if status[a] == 1 and not hi[a] < np.inf:  # the curve is too short to bound it
            status[a], lo[a], hi[a] = 0, np.nan, np.nan
    noise, most = 0.0, np.nan
    if straight:
        noise, most = judge_ramp(slope, known.slope_variance, thresholds, entered, theta, lo, hi, status)
    # K is no more than a bound, and the slope more than the others make; or no slope could tell a ramp from K
    others = noise - max(theta[K], 0.0) * known.slope_variance[K]
    gains.either[axis] = (
        status[K] == 1 and status[R] == 1 and slope * slope > thresholds[0] ** 2 * others
        if straight
        else status[K] == 2
    )
    variances(rows, theta, known.covariance, stretch, variance)
    _draw(rows, first, theta, known.columns, noise, variance, answer.fitted[axis], answer.edf[axis])
    answer.left_out[axis] = first
    answer.misfit[axis], answer.scatter[axis] = misfit, scatter
    freeze(
        axis, rows[first:], weighted, normal, free, thresholds, found, c0, enters, most,
        known.columns, slope, slopes, answer, gains,
    )  # fmt: skip
    if misfit > 1.0:
        cap(curve, answer.edf[axis], rows[first:], known.columns, FILTER_MEMORY, entered, theta, lo, hi, status)
    if free:
        i = rows[0]
        bound_by_first_point(curve[i], answer.edf[axis, i], known.columns[i, Q], entered, lo, hi, status)


@compiled
def _levels(known, curve, terms, slope, slopes, level, stretch):  # type: ignore[no-untyped-def]
    """The τ in use, and of each the curve that its samples have without the line of that slope, if there is one."""
    rows, count = np.empty(curve.size, np.int64), 0
    for i in range(curve.size):
        if curve[i] > 0.0 and terms[i] > 0.0 and known.whole[i] > 0.0:
            rows[count] = i
            stretch[i] = np.sqrt(known.whole[i] / terms[i])
            line = slope * (2.0 * slopes[i] - slope) if slope == slope else 0.0
            level[i] = curve[i] - line * known.columns[i, R]
            count += 1
    return rows[:count]


@compiled
def _draw(rows, first, theta, columns, noise, variance, fitted, edf):  # type: ignore[no-untyped-def]
    """The fitted model, NaN where it was left out, and the degrees of freedom of the curve under it."""
    for k in range(rows.size):
        i = rows[k]
        model, positive = 0.0, 0.0
        for a in range(5):
            model += columns[i, a] * theta[a]
            positive += columns[i, a] * max(theta[a], 0.0)
        fitted[i] = model if k >= first and model > 0.0 else np.nan
        # a ramp multiplies the noise of the mean second difference: 4 R² (m²/2)² Var(slope)
        variance[i] += 4.0 * theta[R] * columns[i, R] ** 2 * noise
        edf[i] = 2.0 * positive * positive / variance[i]


@compiled
def _fit_terms(  # type: ignore[no-untyped-def]
    avar, level, rows, stretch, columns, known, full, warm, variance, weighted, normal, right, theta
):
    """Re-weighted Q N B K; how many of the shortest τ were left out, and whether Q² was set free."""
    first, free = 0, False
    asking, covariance = known.ask, known.covariance
    warm = warm and theta[N] > 0.0
    while True:
        used = rows[first:]
        if warm:
            weigh(used, theta, covariance, stretch, columns, known.blind, full, variance, weighted)
        else:
            for i in used:  # white noise of that level, to begin with
                variance[i] = avar[i] * avar[i] * covariance[i, i, WHITE] / columns[i, N] ** 2
                for a in range(5):
                    weighted[i, a] = columns[i, a] / variance[i]
        for _ in range(WARM_PASSES if warm else PASSES):
            normal_equations(level, used, columns, weighted, normal, right)
            solve_nonnegative(normal, right, free, theta)
            weigh(used, theta, covariance, stretch, columns, known.blind, full, variance, weighted)
        limit = MISFIT_AGAIN if free else MISFIT
        if not asking or not _contradicted(level, used[:SHORT_ROWS], theta, columns, variance, limit):
            break
        if not free:
            free = True
        elif used.size > MIN_ROWS and columns[used[0], N] * FILTER_MEMORY >= 1.0:
            first += 1
        else:  # no filter: a line, motion, or what else the five terms do not know
            first, free, asking = 0, False, False
    normal_equations(level, used, columns, weighted, normal, right)
    solve_nonnegative(normal, right, free, theta)
    return first, free


@compiled
def _misfit(level, rows, theta, columns, variance):  # type: ignore[no-untyped-def]
    """How many times wider the curve scatters about the fit, in variance, than noise of the five terms would.

    And the limit beyond which chance does not make that of so many τ: then intervals are as much wider (Birge 1932).
    """
    total, freedom = 0.0, rows.size
    for a in range(NOISES):
        if theta[a] != 0.0:
            freedom -= 1
    for i in rows:
        model = 0.0
        for a in range(5):
            model += columns[i, a] * theta[a]
        if model > 0.0:
            spread = variance[i] / (9.0 * model * model)
            total += ((max(level[i], 0.0) / model) ** (1.0 / 3.0) - 1.0 + spread) ** 2 / spread
    freedom = max(freedom, 1)
    return total / freedom, 1.0 + MISFIT_OF_ALL * np.sqrt(2.0 / freedom)


@compiled
def _contradicted(avar, rows, theta, columns, variance, limit):  # type: ignore[no-untyped-def]
    """Whether a row lies ``limit`` σ off; χ² made normal by its cube root (Wilson & Hilferty 1931)."""
    for i in rows:
        model = 0.0
        for a in range(5):
            model += columns[i, a] * theta[a]
        if model <= 0.0:
            return True
        spread = variance[i] / (9.0 * model * model)  # 2/(9 edf)
        if abs((avar[i] / model) ** (1.0 / 3.0) - 1.0 + spread) > limit * np.sqrt(spread):
            return True
    return False
