"""Compiled kernel of the fit: weights and a non-negative solution, one axis after another.

All quantities are in units of one sample: the Allan variance in the unit of the axis, and θ as in ``uncertainty``. The
results are written to arrays of the caller with one row per axis (``term_selection.FitOutput``,
``term_selection.Gains``). A result that stays NaN could not be computed.

For given weights, the solution is linear in the curve. The rows of this linear map are stored together with the limits
within which they are as good as a new fit. ``continuous_refit`` applies them to the curve after every sample.
"""

from typing import Final

import numpy as np

from monitor.common.compiled import compiled
from monitor.estimation.allan.uncertainty import NOISES, PAIRS
from monitor.estimation.fit.confidence_bounds import bound_by_first_point, limit_by_curve
from monitor.estimation.fit.least_squares import (
    K,
    N,
    Q,
    R,
    normal_equations,
    solve_nonnegative,
    variances,
    weight_columns,
)
from monitor.estimation.fit.term_selection import select_ramp, select_terms, store_linear_map, tighten_bounds

MIN_ROWS: Final = NOISES + 1
"""Minimum number of τ. With fewer τ, a fit has no degree of freedom left to be contradicted."""

COLD_PASSES: Final = 3
"""Number of re-weightings from scratch. More passes move no coefficient by a tenth of its standard deviation."""

WARM_PASSES: Final = 1
"""Number of re-weightings from the coefficients of a recent fit."""

MISFIT_SIGMA: Final = 4.0
"""Distance in σ from which a short τ contradicts the fit."""

REPEATED_MISFIT_SIGMA: Final = 2.5
"""Same threshold after a contradiction, so that the remaining effect of a band limit does not bias N."""

TOTAL_MISFIT_SIGMA: Final = 6.0
"""Standard deviations of χ² per τ beyond which the five terms do not describe the curve."""

SHORT_ROWS: Final = 4
"""Number of shortest τ in use that are tested for a contradiction."""

FILTER_MEMORY: Final = 16
"""Largest cluster size in samples that can be left out. A filter with a longer memory is not noise of the sensor."""

WHITE: Final = PAIRS.index((N, N))
"""Index of the pair (N, N) in the table."""


@compiled
def fit_axes(  # type: ignore[no-untyped-def]
    first, end, shared, avar, terms, slope, slopes, thresholds, full, warm, answer, gains
):
    """Fit the axes first ≤ axis < end.

    Parameters
    ----------
    first, end : int
        Range of axes.
    shared : SharedInputs
        Inputs that are the same for all axes.
    avar, terms : ndarray of float64, shape (axes, m)
        Allan variance and number of terms.
    slope : ndarray of float64, shape (axes,)
        Slope of the rate in units of one sample; NaN means not measured.
    slopes : ndarray of float64, shape (axes, m)
        Slope as seen by each τ.
    thresholds : tuple of float
        Thresholds in σ to add and to drop a term.
    full : bool
        True to weight by the covariances of all τ.
    warm : bool
        True to start with the weights of ``answer.theta``.
    answer : Answer
        Results, updated in place.
    gains : Gains
        Linear map of the solution, updated in place.
    """
    for axis in range(first, end):
        fit_axis(axis, shared, avar, terms, slope[axis], slopes, thresholds, full, warm, answer, gains)


@compiled
def fit_axis(  # type: ignore[no-untyped-def]
    axis, shared, avar, terms, slope, slopes, thresholds, full, warm, answer, gains
):
    """Fit one axis; see ``fit_axes`` for the parameters. With too few τ, all coefficients are unestimated."""
    m = shared.whole.size
    curve, level, stretch = avar[axis], np.empty(m), np.empty(m)
    straight = slope == slope
    flat = shared.flat if straight else shared.columns
    rows = _levels(shared, curve, terms[axis], slope, slopes[axis], level, stretch)
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
            curve, level, rows, stretch, flat, shared, full, warm, variance, weighted, normal, right, theta
        )
        scatter, limit = _misfit(level, rows[first:], theta, flat, variance)
        if not full or scatter <= limit:
            break
        full = False  # covariances of noise that the curve does not have make the fit miss all of its points
    for a in range(5):
        lo[a], hi[a], status[a] = np.nan, np.nan, 0
    misfit = scatter if scatter > limit else 1.0
    found, c0, enters = select_terms(
        level, rows[first:], stretch, shared.covariance, weighted, normal, thresholds, straight, misfit,
        entered, theta, lo, hi, status,
    )  # fmt: skip
    tighten_bounds(level, rows[first:], stretch, flat, shared.covariance, misfit, found, c0, theta, hi, status)
    for a in range(5):
        if status[a] == 1 and not hi[a] < np.inf:  # the curve is too short for a bound
            status[a], lo[a], hi[a] = 0, np.nan, np.nan
    noise, most = 0.0, np.nan
    if straight:
        noise, most = select_ramp(slope, shared.slope_variance, thresholds, entered, theta, lo, hi, status)
    # K is only bounded and the other terms do not explain the slope, or K is estimated without a measured slope
    others = noise - max(theta[K], 0.0) * shared.slope_variance[K]
    gains.either[axis] = (
        status[K] == 1 and status[R] == 1 and slope * slope > thresholds[0] ** 2 * others
        if straight
        else status[K] == 2
    )
    variances(rows, theta, shared.covariance, stretch, variance)
    _draw(rows, first, theta, shared.columns, noise, variance, answer.fitted[axis], answer.edf[axis])
    answer.left_out[axis] = first
    answer.misfit[axis], answer.scatter[axis] = misfit, scatter
    store_linear_map(
        axis, rows[first:], weighted, normal, free, thresholds, found, c0, enters, most,
        shared.columns, slope, slopes, answer, gains,
    )  # fmt: skip
    if misfit > 1.0:
        limit_by_curve(
            curve, answer.edf[axis], rows[first:], shared.columns, FILTER_MEMORY, entered, theta, lo, hi, status
        )
    if free:
        i = rows[0]
        bound_by_first_point(curve[i], answer.edf[axis, i], shared.columns[i, Q], entered, lo, hi, status)


@compiled
def _levels(shared, curve, terms, slope, slopes, level, stretch):  # type: ignore[no-untyped-def]
    """Return the τ in use, and compute the curve without the line of the measured slope."""
    rows, count = np.empty(curve.size, np.int64), 0
    for i in range(curve.size):
        if curve[i] > 0.0 and terms[i] > 0.0 and shared.whole[i] > 0.0:
            rows[count] = i
            stretch[i] = np.sqrt(shared.whole[i] / terms[i])
            line = slope * (2.0 * slopes[i] - slope) if slope == slope else 0.0
            level[i] = curve[i] - line * shared.columns[i, R]
            count += 1
    return rows[:count]


@compiled
def _draw(rows, first, theta, columns, noise, variance, fitted, edf):  # type: ignore[no-untyped-def]
    """Compute the fitted model, NaN for τ left out, and the degrees of freedom of the curve under it."""
    for k in range(rows.size):
        i = rows[k]
        model, positive = 0.0, 0.0
        for a in range(5):
            model += columns[i, a] * theta[a]
            positive += columns[i, a] * max(theta[a], 0.0)
        fitted[i] = model if k >= first and model > 0.0 else np.nan
        # the product of a ramp with the noise of the mean second difference adds 4 R² (m²/2)² Var(slope)
        variance[i] += 4.0 * theta[R] * columns[i, R] ** 2 * noise
        edf[i] = 2.0 * positive * positive / variance[i]


@compiled
def _fit_terms(  # type: ignore[no-untyped-def]
    avar, level, rows, stretch, columns, shared, full, warm, variance, weighted, normal, right, theta
):
    """Fit Q N B K with re-weighting.

    Return the number of shortest τ left out, and whether Q² was allowed to be negative.
    """
    first, free = 0, False
    asking, covariance = shared.ask, shared.covariance
    warm = warm and theta[N] > 0.0
    while True:
        used = rows[first:]
        if warm:
            weight_columns(used, theta, covariance, stretch, columns, shared.blind, full, variance, weighted)
        else:
            for i in used:  # start with white noise of the level of the curve
                variance[i] = avar[i] * avar[i] * covariance[i, i, WHITE] / columns[i, N] ** 2
                for a in range(5):
                    weighted[i, a] = columns[i, a] / variance[i]
        for _ in range(WARM_PASSES if warm else COLD_PASSES):
            normal_equations(level, used, columns, weighted, normal, right)
            solve_nonnegative(normal, right, free, theta)
            weight_columns(used, theta, covariance, stretch, columns, shared.blind, full, variance, weighted)
        limit = REPEATED_MISFIT_SIGMA if free else MISFIT_SIGMA
        if not asking or not _contradicted(level, used[:SHORT_ROWS], theta, columns, variance, limit):
            break
        if not free:
            free = True
        elif used.size > MIN_ROWS and columns[used[0], N] * FILTER_MEMORY >= 1.0:
            first += 1
        else:  # not a filter, but a spectral line, motion, or another effect outside the five terms
            first, free, asking = 0, False, False
    normal_equations(level, used, columns, weighted, normal, right)
    solve_nonnegative(normal, right, free, theta)
    return first, free


@compiled
def _misfit(level, rows, theta, columns, variance):  # type: ignore[no-untyped-def]
    """Return the variance of the curve about the fit relative to noise of the five terms, and its limit by chance.

    Beyond the limit, intervals are widened accordingly (Birge 1932).
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
    return total / freedom, 1.0 + TOTAL_MISFIT_SIGMA * np.sqrt(2.0 / freedom)


@compiled
def _contradicted(avar, rows, theta, columns, variance, limit):  # type: ignore[no-untyped-def]
    """Return True if a row is more than ``limit`` σ off. The cube root makes χ² normal (Wilson & Hilferty 1931)."""
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
