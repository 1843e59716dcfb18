"""What a solution is worth, compiled: which terms are in, their intervals, and how long the solution may stand.

The unconstrained solution û beside the fit has the variance v(t) = c0 + c1 t + c2 t² if the true θ_a were t, from the
covariances of ``uncertainty``; all that is said here of a term rests on that, see the head of ``fit``.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Floats, Ints
from monitor.common.compiled import compiled
from monitor.estimation.allan.uncertainty import NOISES
from monitor.estimation.fit.confidence_bounds import BOUND, TWO_SIDED_95, interval_end, quantile
from monitor.estimation.fit.least_squares import K, Q, R, invert, normal_equations, present, solve, weigh

MOVED: Final = 0.4
"""Gains are made anew when a θ has moved by this share, a coefficient by a fifth, and by more than its own scatter."""

SCATTER: Final = 1.0
"""σ by which a θ may move before its gains are made anew, where that is more."""

JUST_SEEN: Final = 3.0
"""σ of an absent term, at which it would be seen."""

NUMBERS: Final = 2 * NOISES
"""With limits in Gains: θ of Q N B K, then û of Q N B K, the solution without bounds."""


class Known(NamedTuple):
    """What holds for all axes at one length of the window."""

    columns: Floats  # [m, 5] Allan variance of coefficients of one
    flat: Floats  # [m, 5] the same without what their own noise puts into slope² τ²/2 on average
    covariance: Floats  # [m, m, 10] of ``uncertainty.Table``
    whole: Floats  # [m] terms in a window without gaps
    slope_variance: Floats  # [4] of the slope of thirds, for θ of one
    blind: Floats  # [m] a direction of the curve that the fit does not look along, larger than any noise; zero = none
    ask: bool  # leave out short τ that contradict the fit


class Answer(NamedTuple):
    """One fit, a row an axis."""

    entered: NDArray[np.bool_]  # [axes, 5] which terms are in; also read, as what was in before
    theta: Floats  # [axes, 5] also read by a warm start
    lo: Floats  # [axes, 5]
    hi: Floats  # [axes, 5]
    status: NDArray[np.int8]  # [axes, 5]
    edf: Floats  # [axes, m]
    fitted: Floats  # [axes, m]
    left_out: Ints  # [axes]
    misfit: Floats  # [axes] variance about the fit over that of noise of the five terms; one where chance explains it
    scatter: Floats  # [axes] the same, whether or not


class Gains(NamedTuple):
    """A solution as a linear map from curve to coefficients, and how far it holds; a row an axis.

    With r = Xᵀ V⁻¹ y of the normal equations: θ = ``inverse`` r on the terms that are not zero, û = ``whole`` r.
    """

    rows: Floats  # [axes, m, NOISES] V⁻¹ X
    ramp: Floats  # [axes, NOISES] of r, what slope² takes away
    twist: Floats  # [axes, NOISES] and what the slope itself does, as the τ see other slopes than the window
    normal: Floats  # [axes, 5, 5] Xᵀ V⁻¹ X
    inverse: Floats  # [axes, NOISES, NOISES]
    whole: Floats  # [axes, NOISES, NOISES]
    low: Floats  # [axes, NUMBERS + 1] θ, û, and last the slope's size, must stay between these
    high: Floats  # [axes, NUMBERS + 1]
    used: Ints  # [axes, 2] first τ used, and the one after the last; equal: there is no solution
    free: NDArray[np.bool_]  # [axes] Q² may be negative
    straight: NDArray[np.bool_]  # [axes] they stand for a curve from which slope² τ²/2 is taken
    either: NDArray[np.bool_]  # [axes] the slope is more than noise without K makes: K or R


def answer(axes: int, m: int, entered: NDArray[np.bool_]) -> Answer:
    """Room for the answer of m τ."""
    theta, lo, hi = np.full((3, axes, 5), np.nan)
    edf, fitted = np.full((2, axes, m), np.nan)
    status, left_out = np.zeros((axes, 5), np.int8), np.zeros(axes, np.int64)
    return Answer(entered, theta, lo, hi, status, edf, fitted, left_out, np.ones(axes), np.full(axes, np.inf))


def gains(axes: int, m: int) -> Gains:
    """Room for the gains of m τ; they do not hold yet."""
    return Gains(
        np.zeros((axes, m, NOISES)),
        np.zeros((axes, NOISES)),
        np.zeros((axes, NOISES)),
        np.zeros((axes, 5, 5)),
        np.zeros((axes, NOISES, NOISES)),
        np.zeros((axes, NOISES, NOISES)),
        np.full((axes, NUMBERS + 1), np.inf),
        np.full((axes, NUMBERS + 1), -np.inf),
        np.zeros((axes, 2), np.int64),
        np.zeros(axes, np.bool_),
        np.zeros(axes, np.bool_),
        np.zeros(axes, np.bool_),
    )


@compiled
def judge(  # type: ignore[no-untyped-def]
    level, rows, stretch, covariance, weighted, normal, thresholds, straight, misfit,
    entered, theta, lo, hi, status,
):  # fmt: skip
    """Which terms are in, and the interval of each: see the head of ``fit``.

    Returns û, its variance if its term were absent, and from where on a term that is out comes in.
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
            enters[a] = max(thresholds[0], quantile(TWO_SIDED_95, skewness)) * np.sqrt(c0)
        threshold = thresholds[1] if entered[a] else thresholds[0]
        low = interval_end(estimate[a], c0, c1, c2, skewness, TWO_SIDED_95)
        high = interval_end(estimate[a], c0, c1, c2, skewness, -TWO_SIDED_95)
        if theta[a] > 0.0 and not low < np.sqrt(theta[a]) < high:
            # others were held at zero, and this one is not û: the interval of what it is
            low = min(low, interval_end(theta[a], c0, c1, c2, skewness, TWO_SIDED_95))
            high = max(high, interval_end(theta[a], c0, c1, c2, skewness, -TWO_SIDED_95))
        # what was out stays out while its interval reaches to zero
        seen = entered[a] or low > 0.0
        entered[a] = seen and a != R and theta[a] > 0.0 and estimate[a] > threshold * np.sqrt(c0)
        if entered[a]:
            status[a], lo[a], hi[a] = 2, low, high
        else:
            # a bound below what an estimate of zero would give claims more than the curve can know
            status[a] = 1
            lo[a] = 0.0
            hi[a] = interval_end(max(estimate[a], 0.0), c0, c1, c2, skewness, -BOUND)
    return estimate, absent, enters


@compiled
def sharpen(  # type: ignore[no-untyped-def]
    level, rows, stretch, columns, covariance, misfit, found, c0, theta, hi, status
):
    """Bounds of the terms that are not in, each by the weights that suit a term just as large as could be seen.

    Weights for an absent term look where none of it is: on the few long τ that K would fill, say, they leave so little
    that its own scatter drowns it, and the bound is far off or infinite.
    """
    supposed, scratch, weights = np.empty(5), np.empty(level.size), np.empty((level.size, 5))
    normal, right, gain = np.empty((5, 5)), np.empty(5), np.empty((1, rows.size))
    for a in range(NOISES):
        if status[a] != 1 or c0[a] <= 0.0:
            continue
        for b in range(5):
            supposed[b] = theta[b]
        supposed[a] = max(found[a], 0.0) + JUST_SEEN * np.sqrt(c0[a])
        weigh(rows, supposed, covariance, stretch, columns, scratch, False, scratch, weights)
        normal_equations(level, rows, columns, weights, normal, right)
        if _row_of(a, rows, weights, normal, stretch, gain[0]):
            c = _variance_forms(a, a + 1, gain, rows, theta, covariance)[0]
            estimate = max(_estimate(gain[0], level, rows, stretch), 0.0)
            skewness = 2.0 * np.sqrt(c[2])
            hi[a] = interval_end(estimate, misfit * c[0], misfit * c[1], c[2], skewness, -BOUND)


@compiled
def _estimate(gain, level, rows, stretch):  # type: ignore[no-untyped-def]
    """û of one row."""
    estimate = 0.0
    for k in range(rows.size):
        estimate += gain[k] / stretch[rows[k]] * level[rows[k]]
    return estimate


@compiled
def _row_of(a, rows, weighted, normal, stretch, gain):  # type: ignore[no-untyped-def]
    """The row of the linear map from curve to û_a, each τ as if it had all terms; False where there is none."""
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
    """c0 c1 c2 [end - first, 3] of û = g σ² of each term from ``first``: its variance is c0 + c1 t + c2 t² if θ were t.

    One walk over the pairs of τ for all terms; of those the ramp, which has no noise, only has c0.
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
def judge_ramp(slope, slope_variance, thresholds, entered, theta, lo, hi, status):  # type: ignore[no-untyped-def]
    """R is in when the slope is more than noise makes even with K at the upper end of its interval.

    Returns the variance of the slope under the fitted noise, and under that with most K.
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
    lo[R] = max(abs(slope) - TWO_SIDED_95 * np.sqrt(most), 0.0) if entered[R] else 0.0
    hi[R] = abs(slope) + (TWO_SIDED_95 if entered[R] else BOUND) * np.sqrt(most)
    return noise, most


@compiled
def freeze(  # type: ignore[no-untyped-def]
    axis, rows, weighted, normal, free, thresholds, found, c0, enters, most, columns, slope, slopes, answer, gains
):
    """Keep the solution as a linear map, with the limits of its use."""
    if rows[-1] - rows[0] != rows.size - 1:
        return  # a τ between others without a term: only a gap nearly as long as the window makes that
    low, high = gains.low[axis], gains.high[axis]
    theta, entered, status = answer.theta[axis], answer.entered[axis], answer.status[axis]
    for a in range(5):
        for b in range(5):
            gains.normal[axis, a, b] = normal[a, b]
    if not invert(normal, 2**NOISES - 1, gains.whole[axis]) or not invert(normal, present(theta), gains.inverse[axis]):
        return
    for a in range(NOISES):
        gains.ramp[axis, a] = gains.twist[axis, a] = 0.0
        for i in rows:
            gains.rows[axis, i, a] = weighted[i, a]
            if gains.straight[axis]:
                gains.ramp[axis, a] += weighted[i, a] * columns[i, R]
                gains.twist[axis, a] += weighted[i, a] * columns[i, R] * 2.0 * (slopes[axis, i] - slope)
        reach = max(MOVED * abs(theta[a]), SCATTER * np.sqrt(c0[a]))
        low[a], high[a] = theta[a] - reach, theta[a] + reach
        # of û: where the term would enter or leave
        low[NOISES + a], high[NOISES + a] = -np.inf, np.inf
        if entered[a]:
            low[NOISES + a] = thresholds[1] * np.sqrt(c0[a])
        else:
            high[NOISES + a] = max(enters[a], found[a] + SCATTER * np.sqrt(c0[a]))
    low[NUMBERS], high[NUMBERS] = 0.0, np.inf
    if entered[R]:
        low[NUMBERS] = thresholds[1] * np.sqrt(most)
    elif status[K] > 0 and most == most:
        high[NUMBERS] = thresholds[0] * np.sqrt(most)
    gains.free[axis] = free
    gains.used[axis, 0], gains.used[axis, 1] = rows[0], rows[-1] + 1
