"""Selection of significant terms, their confidence intervals, and the limits within which a solution stays valid.

The unconstrained solution û has the variance v(t) = c0 + c1 t + c2 t² if the true θ_a is t, from the covariances of
``uncertainty``. All decisions in this module are based on this variance; see the docstring of ``coefficient_fit``. The
functions are compiled.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Floats, Ints
from monitor.common.compiled import compiled
from monitor.common.distributions import Z95
from monitor.estimation.allan.uncertainty import NOISES
from monitor.estimation.fit.confidence_bounds import UPPER_BOUND_Z, interval_end, quantile
from monitor.estimation.fit.least_squares import K, Q, R, invert, nonzero_terms, normal_equations, solve, weight_columns

MAX_THETA_CHANGE: Final = 0.4
"""Gains are recomputed when a θ has moved by this share (a coefficient by a fifth) and by more than its own scatter."""

MAX_THETA_SIGMA: Final = 1.0
"""Distance in σ that a θ may move before its gains are recomputed, if this is more than the share ``MAX_THETA_CHANGE``.
"""

DETECTABLE_SIGMA: Final = 3.0
"""Size in σ at which an absent term would be detected."""

LIMIT_COUNT: Final = 2 * NOISES
"""Number of quantities with limits in ``Gains``: θ of Q N B K, then the unconstrained û of Q N B K."""


class SharedInputs(NamedTuple):
    """Inputs of a fit that are the same for all axes at one window length."""

    columns: Floats  # [m, 5] Allan variance of unit coefficients
    flat: Floats  # [m, 5] the same without the mean contribution of their own noise to slope² τ²/2
    covariance: Floats  # [m, m, 10] ``uncertainty.Table.covariance``
    whole: Floats  # [m] number of terms in a window without gaps
    slope_variance: Floats  # [4] variance of the slope of thirds, for unit θ
    blind: Floats  # [m] direction of the curve that the fit ignores, larger than any noise; zero means none
    ask: bool  # True to leave out short τ that contradict the fit


class FitOutput(NamedTuple):
    """Results of a fit, one row per axis."""

    entered: NDArray[np.bool_]  # [axes, 5] terms in the fit; on input, the terms of the previous fit
    theta: Floats  # [axes, 5] squared coefficients; on input, the start of a warm fit
    lo: Floats  # [axes, 5] lower end of the interval
    hi: Floats  # [axes, 5] upper end of the interval
    status: NDArray[np.int8]  # [axes, 5] values of ``Status``
    edf: Floats  # [axes, m] degrees of freedom of the curve
    fitted: Floats  # [axes, m] fitted model
    left_out: Ints  # [axes] number of shortest τ left out
    misfit: Floats  # [axes] variance about the fit, relative to noise of the five terms; 1 if chance explains it
    scatter: Floats  # [axes] the same ratio in any case


class Gains(NamedTuple):
    """Solution as a linear map from curve to coefficients, with the limits of its validity, one row per axis.

    With r = Xᵀ V⁻¹ y of the normal equations, θ = ``inverse`` r on the terms that are not zero, and û = ``whole`` r.
    """

    rows: Floats  # [axes, m, NOISES] V⁻¹ X
    ramp: Floats  # [axes, NOISES] part of r that is subtracted per slope²
    twist: Floats  # [axes, NOISES] part of r per slope, because each τ sees another slope than the window
    normal: Floats  # [axes, 5, 5] Xᵀ V⁻¹ X
    inverse: Floats  # [axes, NOISES, NOISES]
    whole: Floats  # [axes, NOISES, NOISES]
    low: Floats  # [axes, NUMBERS + 1] lower limits of θ, û, and last of the absolute slope
    high: Floats  # [axes, NUMBERS + 1] upper limits of the same
    used: Ints  # [axes, 2] first τ in use and the one after the last; equal if there is no solution
    free: NDArray[np.bool_]  # [axes] True if Q² may be negative
    straight: NDArray[np.bool_]  # [axes] True if slope² τ²/2 is subtracted from the curve
    either: NDArray[np.bool_]  # [axes] True if noise without K does not explain the slope: K or R


def empty_fit_output(axes: int, m: int, entered: NDArray[np.bool_]) -> FitOutput:
    """Allocate the results of a fit.

    Parameters
    ----------
    axes : int
        Number of axes.
    m : int
        Number of τ.
    entered : ndarray of bool, shape (axes, 5)
        Terms of the previous fit. The array is kept and updated.
    """
    theta, lo, hi = np.full((3, axes, 5), np.nan)
    edf, fitted = np.full((2, axes, m), np.nan)
    status, left_out = np.zeros((axes, 5), np.int8), np.zeros(axes, np.int64)
    return FitOutput(entered, theta, lo, hi, status, edf, fitted, left_out, np.ones(axes), np.full(axes, np.inf))


def empty_gains(axes: int, m: int) -> Gains:
    """Allocate gains that are not valid yet.

    Parameters
    ----------
    axes : int
        Number of axes.
    m : int
        Number of τ.
    """
    return Gains(
        np.zeros((axes, m, NOISES)),
        np.zeros((axes, NOISES)),
        np.zeros((axes, NOISES)),
        np.zeros((axes, 5, 5)),
        np.zeros((axes, NOISES, NOISES)),
        np.zeros((axes, NOISES, NOISES)),
        np.full((axes, LIMIT_COUNT + 1), np.inf),
        np.full((axes, LIMIT_COUNT + 1), -np.inf),
        np.zeros((axes, 2), np.int64),
        np.zeros(axes, np.bool_),
        np.zeros(axes, np.bool_),
        np.zeros(axes, np.bool_),
    )


@compiled
def select_terms(  # type: ignore[no-untyped-def]
    level, rows, stretch, covariance, weighted, normal, thresholds, straight, misfit,
    entered, theta, lo, hi, status,
):  # fmt: skip
    """Select the terms and compute their intervals; see the docstring of ``coefficient_fit``.

    Parameters
    ----------
    level : ndarray of float64, shape (m,)
        Curve without the line of the slope.
    rows : ndarray of int64
        Rows in use.
    stretch, covariance, weighted, normal
        See ``least_squares.weight_columns`` and ``least_squares.normal_equations``.
    thresholds : tuple of float
        Thresholds in σ to add and to drop a term.
    straight : bool
        True if the line of the slope has been subtracted.
    misfit : float
        Factor by which variances are widened.
    entered, theta, lo, hi, status : ndarray, shape (5,)
        Results of the axis, updated in place.

    Returns
    -------
    estimate : ndarray of float64, shape (5,)
        Unconstrained solution û.
    absent : ndarray of float64, shape (4,)
        Variance of û if its term were absent.
    enters : ndarray of float64, shape (4,)
        Value of û above which an absent term is added.
    """
    terms = NOISES if straight else 5
    gain, estimate, enters, absent = np.zeros((5, rows.size)), np.zeros(5), np.empty(NOISES), np.empty(NOISES)
    for a in range(terms):
        if not _row_of(a, rows, weighted, normal, stretch, gain[a]):
            entered[a] = False
            continue
        estimate[a] = _estimate(gain[a], level, rows, stretch)
    forms = _variance_forms(0, terms, gain, rows, theta, covariance)
    for a in range(NOISES):
        enters[a], absent[a] = np.inf, misfit * forms[a, 0]
    for a in range(terms):
        c0, c1, c2 = misfit * forms[a, 0], misfit * forms[a, 1], forms[a, 2]
        if c0 <= 0.0 and c2 <= 0.0:  # there was no solution
            continue
        skewness = 2.0 * np.sqrt(forms[a, 2])
        if a != R:
            enters[a] = max(thresholds[0], quantile(Z95, skewness)) * np.sqrt(c0)
        threshold = thresholds[1] if entered[a] else thresholds[0]
        low = interval_end(estimate[a], c0, c1, c2, skewness, Z95)
        high = interval_end(estimate[a], c0, c1, c2, skewness, -Z95)
        if theta[a] > 0.0 and not low < np.sqrt(theta[a]) < high:
            # other terms were held at zero, so θ differs from û: include the interval of θ
            low = min(low, interval_end(theta[a], c0, c1, c2, skewness, Z95))
            high = max(high, interval_end(theta[a], c0, c1, c2, skewness, -Z95))
        # an absent term stays out while its interval includes zero
        seen = entered[a] or low > 0.0
        entered[a] = seen and a != R and theta[a] > 0.0 and estimate[a] > threshold * np.sqrt(c0)
        if entered[a]:
            status[a], lo[a], hi[a] = 2, low, high
        else:
            # a bound tighter than the one from an estimate of zero would claim more than the curve supports
            status[a] = 1
            lo[a] = 0.0
            hi[a] = interval_end(max(estimate[a], 0.0), c0, c1, c2, skewness, -UPPER_BOUND_Z)
    return estimate, absent, enters


@compiled
def tighten_bounds(  # type: ignore[no-untyped-def]
    level, rows, stretch, columns, covariance, misfit, found, c0, theta, hi, status
):
    """Recompute the bounds of absent terms with weights that suit a term just large enough to be detected.

    Weights for an absent term use the τ where the term has no effect. For K, for example, they give so little weight to
    the few long τ that its own scatter dominates. The bound is then very large or infinite.

    Parameters
    ----------
    level : ndarray of float64, shape (m,)
        Curve without the line of the slope.
    rows : ndarray of int64
        Rows in use.
    stretch, columns, covariance
        See ``least_squares.weight_columns``.
    misfit : float
        Factor by which variances are widened.
    found, c0 : ndarray of float64
        Unconstrained solution and its variance for absent terms, from ``select_terms``.
    theta, hi, status : ndarray, shape (5,)
        Results of the axis; ``hi`` is updated in place.
    """
    supposed, scratch, weights = np.empty(5), np.empty(level.size), np.empty((level.size, 5))
    normal, right, gain = np.empty((5, 5)), np.empty(5), np.empty((1, rows.size))
    for a in range(NOISES):
        if status[a] != 1 or c0[a] <= 0.0:
            continue
        for b in range(5):
            supposed[b] = theta[b]
        supposed[a] = max(found[a], 0.0) + DETECTABLE_SIGMA * np.sqrt(c0[a])
        weight_columns(rows, supposed, covariance, stretch, columns, scratch, False, scratch, weights)
        normal_equations(level, rows, columns, weights, normal, right)
        if _row_of(a, rows, weights, normal, stretch, gain[0]):
            c = _variance_forms(a, a + 1, gain, rows, theta, covariance)[0]
            estimate = max(_estimate(gain[0], level, rows, stretch), 0.0)
            skewness = 2.0 * np.sqrt(c[2])
            hi[a] = interval_end(estimate, misfit * c[0], misfit * c[1], c[2], skewness, -UPPER_BOUND_Z)


@compiled
def _estimate(gain, level, rows, stretch):  # type: ignore[no-untyped-def]
    """Return û from one row of the linear map."""
    estimate = 0.0
    for k in range(rows.size):
        estimate += gain[k] / stretch[rows[k]] * level[rows[k]]
    return estimate


@compiled
def _row_of(a, rows, weighted, normal, stretch, gain):  # type: ignore[no-untyped-def]
    """Compute the row of the linear map from curve to û_a, as if each τ had all terms.

    Return False if the row does not exist.
    """
    unit, solution = np.zeros(5), np.empty(5)
    unit[a] = 1.0
    if not solve(normal, unit, (2**NOISES - 1) | (1 << a), solution):
        return False
    for k in range(rows.size):
        x = 0.0
        for c in range(5):
            x += solution[c] * weighted[rows[k], c]
        gain[k] = x * stretch[rows[k]]
    return True


@compiled
def _variance_forms(first, end, gain, rows, theta, covariance):  # type: ignore[no-untyped-def]
    """Return c0 c1 c2 [end - first, 3] of the variance c0 + c1 t + c2 t² of û, for each term from ``first``.

    One pass over the pairs of τ serves all terms. The ramp has no noise and only has c0.
    """
    q, n, b, k = max(theta[0], 0.0), theta[1], theta[2], theta[3]
    forms, bent, own = np.zeros((end - first, 3)), np.zeros(5), np.zeros(5)
    for i in range(rows.size):
        for j in range(i + 1):
            c = covariance[rows[i], rows[j]]
            own[0], own[1], own[2], own[3] = c[0], c[4], c[7], c[9]
            bent[0] = n * c[1] + b * c[2] + k * c[3]
            bent[1] = q * c[1] + b * c[5] + k * c[6]
            bent[2] = q * c[2] + n * c[5] + k * c[8]
            bent[3] = q * c[3] + n * c[6] + b * c[8]
            others = n * (n * c[4] + b * c[5] + k * c[6]) + b * (n * c[5] + b * c[7] + k * c[8])
            others += k * (n * c[6] + b * c[8] + k * c[9])  # without Q
            twice = 1.0 if i == j else 2.0
            for index in range(end - first):
                a = first + index
                weight = twice * gain[index, i] * gain[index, j]
                if a == Q:
                    absent = others
                elif a == R:
                    absent = others + q * (2.0 * bent[0] + q * own[0])
                else:
                    absent = others + q * (2.0 * bent[0] + q * own[0]) - theta[a] * (2.0 * bent[a] + theta[a] * own[a])
                forms[index, 0] += weight * absent
                forms[index, 1] += weight * 2.0 * bent[a]
                forms[index, 2] += weight * own[a]
    for a in range(forms.shape[0]):
        forms[a, 0] = max(forms[a, 0], 0.0)
    return forms


@compiled
def select_ramp(slope, slope_variance, thresholds, entered, theta, lo, hi, status):  # type: ignore[no-untyped-def]
    """Include R if the slope is larger than noise explains with K at the upper end of its interval.

    Parameters
    ----------
    slope : float
        Slope of the rate in units of one sample.
    slope_variance : ndarray of float64, shape (4,)
        Variance of the slope for unit θ.
    thresholds : tuple of float
        Thresholds in σ to add and to drop a term.
    entered, theta, lo, hi, status : ndarray, shape (5,)
        Results of the axis, updated in place.

    Returns
    -------
    noise : float
        Variance of the slope under the fitted noise.
    most : float
        Variance of the slope with K at the upper end of its interval.
    """
    noise = 0.0
    for a in range(NOISES):
        noise += max(theta[a], 0.0) * slope_variance[a]
    most = noise
    if status[K] > 0:
        most += (hi[K] ** 2 - theta[K]) * slope_variance[K]
    entered[R] = status[K] > 0 and abs(slope) > thresholds[1 if entered[R] else 0] * np.sqrt(most)
    theta[R] = slope * slope if entered[R] else max(slope * slope - noise, 0.0)
    status[R] = 2 if entered[R] else 1
    lo[R] = max(abs(slope) - Z95 * np.sqrt(most), 0.0) if entered[R] else 0.0
    hi[R] = abs(slope) + (Z95 if entered[R] else UPPER_BOUND_Z) * np.sqrt(most)
    return noise, most


@compiled
def store_linear_map(  # type: ignore[no-untyped-def]
    axis, rows, weighted, normal, free, thresholds, found, c0, enters, most, columns, slope, slopes, answer, gains
):
    """Store the solution as a linear map with the limits of its validity.

    Parameters
    ----------
    axis : int
        Row of ``empty_fit_output`` and ``empty_gains``.
    rows : ndarray of int64
        Rows in use.
    weighted, normal
        See ``least_squares.normal_equations``.
    free : bool
        True if Q² may be negative.
    thresholds : tuple of float
        Thresholds in σ to add and to drop a term.
    found, c0, enters
        Results of ``select_terms``.
    most : float
        Result of ``select_ramp``; NaN without a slope.
    columns : ndarray of float64, shape (m, 5)
        Columns of the fit.
    slope : float
        Slope of the rate in units of one sample.
    slopes : ndarray of float64, shape (axes, m)
        Slope as seen by each τ.
    answer : Answer
        Results of the fit.
    gains : Gains
        Gains, updated in place.
    """
    if rows[-1] - rows[0] != rows.size - 1:
        return  # a τ without terms between others, which only a gap nearly as long as the window can cause
    low, high = gains.low[axis], gains.high[axis]
    theta, entered, status = answer.theta[axis], answer.entered[axis], answer.status[axis]
    for a in range(5):
        for b in range(5):
            gains.normal[axis, a, b] = normal[a, b]
    if not invert(normal, 2**NOISES - 1, gains.whole[axis]) or not invert(
        normal, nonzero_terms(theta), gains.inverse[axis]
    ):
        return
    for a in range(NOISES):
        gains.ramp[axis, a] = gains.twist[axis, a] = 0.0
        for i in rows:
            gains.rows[axis, i, a] = weighted[i, a]
            if gains.straight[axis]:
                gains.ramp[axis, a] += weighted[i, a] * columns[i, R]
                gains.twist[axis, a] += weighted[i, a] * columns[i, R] * 2.0 * (slopes[axis, i] - slope)
        reach = max(MAX_THETA_CHANGE * abs(theta[a]), MAX_THETA_SIGMA * np.sqrt(c0[a]))
        low[a], high[a] = theta[a] - reach, theta[a] + reach
        # limits of û, at which the term would be added or dropped
        low[NOISES + a], high[NOISES + a] = -np.inf, np.inf
        if entered[a]:
            low[NOISES + a] = thresholds[1] * np.sqrt(c0[a])
        else:
            high[NOISES + a] = max(enters[a], found[a] + MAX_THETA_SIGMA * np.sqrt(c0[a]))
    low[LIMIT_COUNT], high[LIMIT_COUNT] = 0.0, np.inf
    if entered[R]:
        low[LIMIT_COUNT] = thresholds[1] * np.sqrt(most)
    elif status[K] > 0 and most == most:
        high[LIMIT_COUNT] = thresholds[0] * np.sqrt(most)
    gains.free[axis] = free
    gains.used[axis, 0], gains.used[axis, 1] = rows[0], rows[-1] + 1
