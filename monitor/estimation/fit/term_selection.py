"""Select the significant noise terms, compute their confidence intervals, and store the linear maps.

All decisions are based on the unconstrained solution û. If the true squared coefficient is t, the variance of û is v(t)
= c0 + c1 t + c2 t². The method is described in ``coefficient_fit``.
"""

from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled
from monitor.common.distributions import Z95
from monitor.estimation.allan.uncertainty import NOISES
from monitor.estimation.fit.confidence_bounds import UPPER_BOUND_Z, confidence_interval_end, pearson_quantile
from monitor.estimation.fit.fit_kernel_types import (
    LIMIT_COUNT,
    FitOptions,
    FitOutput,
    LeastSquares,
    SolutionMaps,
    TermResults,
    TermTests,
    VariancesAndSlopesOfAxes,
)
from monitor.estimation.fit.least_squares import (
    K,
    N,
    Q,
    R,
    compute_normal_equations,
    compute_weights,
    invert_on_subset,
    nonzero_term_bits,
)

MAX_THETA_CHANGE: Final = 0.4
"""Relative change of θ above which the linear map is recomputed, provided that it also exceeds ``MAX_THETA_SIGMA``."""
MAX_THETA_SIGMA: Final = 1.0
"""Largest change of θ, in standard deviations, for which the linear map is kept."""
DETECTABLE_SIGMA: Final = 3.0
"""Size of a squared coefficient, in σ, at which the noise term is detected."""
ALL_NOISES: Final = 2**NOISES - 1
"""Bit set of the coefficients Q, N, B and K."""


@compiled
def select_terms(
    problem: LeastSquares, rows: Ints, options: FitOptions, straight: bool, misfit: float, terms: TermResults
) -> TermTests:
    """Select the significant noise terms, and compute confidence intervals and upper bounds.

    Parameters
    ----------
    problem : LeastSquares
        Least-squares problem with its weights and normal equations.
    rows : ndarray of int64
        Indices of the τ to use.
    options : FitOptions
        Thresholds to add and to drop a noise term.
    straight : bool
        True if the contribution of the slope has been subtracted from the Allan variances.
    misfit : float
        Factor by which the variances of the estimates are multiplied.
    terms : TermResults
        Results of the fit of one axis, updated in place.
    """
    count = NOISES if straight else 5
    tests, gain = TermTests(np.zeros(5), np.empty(NOISES), np.empty(NOISES)), np.zeros((5, rows.size))
    inverse = np.empty((5, 5))
    known = invert_on_subset(problem.normal, ALL_NOISES, inverse)
    for a in range(count):
        if a == R:
            known = invert_on_subset(problem.normal, ALL_NOISES | 1 << R, inverse)
        if not known:
            terms.entered[a] = False
            continue
        _map_to_term(a, inverse, problem, rows, gain[a])
        tests.estimate[a] = _estimate(gain[a], problem, rows)
    forms = _variance_forms(0, count, gain, rows, terms.theta, problem)
    for a in range(NOISES):
        tests.enter_limit[a], tests.absent_variance[a] = np.inf, misfit * forms[a, 0]
    for a in range(count):
        c0, c1, c2 = misfit * forms[a, 0], misfit * forms[a, 1], forms[a, 2]
        if c0 <= 0.0 and c2 <= 0.0:  # the normal equations have no solution
            continue
        if a != R:
            tests.enter_limit[a] = max(options.enter, pearson_quantile(Z95, 2.0 * np.sqrt(c2))) * np.sqrt(c0)
        _select_term(a, tests.estimate[a], c0, c1, c2, options, terms)
    return tests


@compiled
def _select_term(
    a: int, estimate: float, c0: float, c1: float, c2: float, options: FitOptions, terms: TermResults
) -> None:
    threshold = options.leave if terms.entered[a] else options.enter
    low = confidence_interval_end(estimate, c0, c1, c2, Z95)
    high = confidence_interval_end(estimate, c0, c1, c2, -Z95)
    if terms.theta[a] > 0.0 and not low < np.sqrt(terms.theta[a]) < high:
        # If other coefficients are fixed at zero, θ differs from û, so the interval must contain both values.
        low = min(low, confidence_interval_end(terms.theta[a], c0, c1, c2, Z95))
        high = max(high, confidence_interval_end(terms.theta[a], c0, c1, c2, -Z95))
    # A noise term is not added while the confidence interval includes zero.
    seen = terms.entered[a] or low > 0.0
    terms.entered[a] = seen and a != R and terms.theta[a] > 0.0 and estimate > threshold * np.sqrt(c0)
    if terms.entered[a]:
        terms.status[a], terms.lo[a], terms.hi[a] = 2, low, high
    else:
        # A negative estimate is replaced by zero, because the upper bound would otherwise be too small.
        terms.status[a], terms.lo[a] = 1, 0.0
        terms.hi[a] = confidence_interval_end(max(estimate, 0.0), c0, c1, c2, -UPPER_BOUND_Z)


@compiled
def tighten_bounds(problem: LeastSquares, rows: Ints, misfit: float, tests: TermTests, terms: TermResults) -> None:
    """Recompute the upper bounds of absent noise terms with better weights.

    The weights for K = 0 make little use of long τ, so the upper bound of K would be very large. The bounds are
    therefore computed with the weights for a noise term that is just large enough to be detected.

    Parameters
    ----------
    problem : LeastSquares
        Least-squares problem of the axis.
    rows : ndarray of int64
        Indices of the τ to use.
    misfit : float
        Factor by which the variances of the estimates are multiplied.
    tests : TermTests
        Result of ``select_terms``.
    terms : TermResults
        Results of the fit of one axis, whose field ``hi`` is updated in place.
    """
    m = problem.level.size
    own = LeastSquares(
        problem.level, problem.excess, problem.extra_white, problem.stretch, problem.columns, problem.covariance,
        problem.ignored_direction, np.empty(m), np.empty((m, 5)), np.empty((5, 5)), np.empty(5),
    )  # fmt: skip
    supposed, gain, inverse = np.empty(5), np.empty((1, rows.size)), np.empty((5, 5))
    for a in range(NOISES):
        if terms.status[a] != 1 or tests.absent_variance[a] <= 0.0:
            continue
        for b in range(5):
            supposed[b] = terms.theta[b]
        supposed[a] = max(tests.estimate[a], 0.0) + DETECTABLE_SIGMA * np.sqrt(tests.absent_variance[a])
        compute_weights(own, rows, supposed, False)
        compute_normal_equations(own, rows)
        if invert_on_subset(own.normal, ALL_NOISES, inverse):
            _map_to_term(a, inverse, own, rows, gain[0])
            c = _variance_forms(a, a + 1, gain, rows, terms.theta, own)[0]
            estimate = max(_estimate(gain[0], own, rows), 0.0)
            terms.hi[a] = confidence_interval_end(estimate, misfit * c[0], misfit * c[1], c[2], -UPPER_BOUND_Z)


@compiled
def _estimate(gain: Floats, problem: LeastSquares, rows: Ints) -> float:
    estimate, stretch, level = 0.0, problem.stretch, problem.level
    for k in range(rows.size):
        estimate += gain[k] / stretch[rows[k]] * level[rows[k]]
    return estimate


@compiled
def _map_to_term(a: int, inverse: Floats, problem: LeastSquares, rows: Ints, gain: Floats) -> None:
    """Compute the linear map from the Allan variances to the unconstrained estimate of coefficient a.

    ``inverse`` is the inverse of the normal matrix.
    """
    weighted, stretch = problem.weighted, problem.stretch
    for k in range(rows.size):
        x = 0.0
        for c in range(5):
            x += inverse[c, a] * weighted[rows[k], c]
        gain[k] = x * stretch[rows[k]]


@compiled
def _variance_forms(first: int, end: int, gain: Floats, rows: Ints, theta: Floats, problem: LeastSquares) -> Floats:
    """Return c0, c1 and c2 of the variance of û for the coefficients first ≤ a < end.

    White noise that missing samples add does not depend on the coefficient a, whichever coefficient that is.
    """
    covariance, extra_white = problem.covariance, problem.extra_white
    q, b, k = max(theta[0], 0.0), theta[2], theta[3]
    forms, bent, own = np.zeros((end - first, 3)), np.zeros(5), np.zeros(5)
    for i in range(rows.size):
        for j in range(i + 1):
            c = covariance[rows[i], rows[j]]
            extra = extra_white[rows[i]] * extra_white[rows[j]]
            n = theta[1] + extra
            own[0], own[1], own[2], own[3] = c[0], c[4], c[7], c[9]
            bent[0] = n * c[1] + b * c[2] + k * c[3]
            bent[1] = q * c[1] + b * c[5] + k * c[6] + extra * c[4]
            bent[2] = q * c[2] + n * c[5] + k * c[8]
            bent[3] = q * c[3] + n * c[6] + b * c[8]
            others = n * (n * c[4] + b * c[5] + k * c[6]) + b * (n * c[5] + b * c[7] + k * c[8])
            others += k * (n * c[6] + b * c[8] + k * c[9])  # variance of all terms except Q
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
def update_ramp_selection(
    slope: float, extra_white: float, slope_variance: Floats, options: FitOptions, terms: TermResults
) -> tuple[float, float, bool]:
    """Include R in the fit if the slope of the rate is significantly larger than noise alone would cause.

    Parameters
    ----------
    slope : float
        Slope of the rate per sample interval; NaN means not measured.
    extra_white : float
        N² of white noise that missing samples add to the means of long clusters.
    slope_variance : ndarray of float64, shape (4,)
        Variance of the slope for each unit coefficient.
    options : FitOptions
        Thresholds to add and to drop a noise term.
    terms : TermResults
        Results of the fit of one axis, updated in place.

    Returns
    -------
    noise : float
        Variance of the slope that the fitted noise causes; 0 if the slope is not measured.
    most : float
        Variance of the slope if K is at the upper end of its confidence interval; NaN if the slope is not measured.
    either : bool
        True if the rate drifts, but K and R cannot be distinguished.
    """
    theta, status = terms.theta, terms.status
    if slope != slope:
        return 0.0, np.nan, bool(status[K] == 2)
    noise = extra_white * slope_variance[N]
    for a in range(NOISES):
        noise += max(theta[a], 0.0) * slope_variance[a]
    most = noise + (terms.hi[K] ** 2 - theta[K]) * slope_variance[K] if status[K] > 0 else noise
    threshold = options.leave if terms.entered[R] else options.enter
    terms.entered[R] = status[K] > 0 and abs(slope) > threshold * np.sqrt(most)
    theta[R] = slope * slope if terms.entered[R] else max(slope * slope - noise, 0.0)
    status[R] = 2 if terms.entered[R] else 1
    terms.lo[R] = max(abs(slope) - Z95 * np.sqrt(most), 0.0) if terms.entered[R] else 0.0
    terms.hi[R] = abs(slope) + (Z95 if terms.entered[R] else UPPER_BOUND_Z) * np.sqrt(most)
    # Only an upper bound of K is known, and the other noise terms do not explain the slope.
    others = noise - max(theta[K], 0.0) * slope_variance[K]
    either = status[K] == 1 and status[R] == 1 and slope * slope > options.enter**2 * others
    return noise, most, bool(either)


@compiled
def store_linear_map(
    axis: int,
    rows: Ints,
    problem: LeastSquares,
    curves: VariancesAndSlopesOfAxes,
    output: FitOutput,
    maps: SolutionMaps,
) -> bool:
    """Store the solution of one axis as a linear map from the Allan variances to the squared coefficients.

    Parameters
    ----------
    axis : int
        Index of the axis.
    rows : ndarray of int64
        Indices of the τ to use.
    problem : LeastSquares
        Least-squares problem with its weights and normal equations.
    curves : VariancesAndSlopesOfAxes
        Measured Allan variances and slopes of the rate.
    output : FitOutput
        Results of the fit.
    maps : SolutionMaps
        Linear maps of all axes, updated in place.

    Returns
    -------
    bool
        False if the solution cannot be stored as a linear map.
    """
    if rows[-1] - rows[0] != rows.size - 1:
        return False  # a linear map requires consecutive indices of τ
    for a in range(5):
        for b in range(5):
            maps.normal[axis, a, b] = problem.normal[a, b]
    subset = nonzero_term_bits(output.theta[axis])
    if not invert_on_subset(problem.normal, ALL_NOISES, maps.whole[axis]):
        return False
    if not invert_on_subset(problem.normal, subset, maps.inverse[axis]):
        return False
    for a in range(NOISES):
        maps.ramp[axis, a] = maps.twist[axis, a] = 0.0
        for i in rows:
            weight = problem.weighted[i, a]
            maps.rows[axis, i, a] = weight
            if maps.straight[axis]:
                bend = curves.slopes[axis, i] - curves.slope[axis]
                maps.ramp[axis, a] += weight * problem.columns[i, R]
                maps.twist[axis, a] += weight * problem.columns[i, R] * 2.0 * bend
    maps.used[axis, 0], maps.used[axis, 1] = rows[0], rows[-1] + 1
    return True


@compiled
def compute_linear_map_validity_limits(
    low: Floats, high: Floats, options: FitOptions, tests: TermTests, most: float, terms: TermResults
) -> None:
    """Compute the limits within which the linear map of one axis stays valid.

    Parameters
    ----------
    low, high : ndarray of float64, shape (LIMIT_COUNT + 1,)
        Output arrays for the limits in ``SolutionMaps``.
    options : FitOptions
        Thresholds to add and to drop a noise term.
    tests : TermTests
        Result of ``select_terms``.
    most : float
        Variance of the slope, as returned by ``update_ramp_selection``; NaN if the slope is not measured.
    terms : TermResults
        Results of the fit of one axis.
    """
    for a in range(NOISES):
        sigma = np.sqrt(tests.absent_variance[a])
        reach = max(MAX_THETA_CHANGE * abs(terms.theta[a]), MAX_THETA_SIGMA * sigma)
        low[a], high[a] = terms.theta[a] - reach, terms.theta[a] + reach
        # At these limits of û, a noise term would be added or dropped.
        low[NOISES + a], high[NOISES + a] = -np.inf, np.inf
        if terms.entered[a]:
            low[NOISES + a] = options.leave * sigma
        else:
            high[NOISES + a] = max(tests.enter_limit[a], tests.estimate[a] + MAX_THETA_SIGMA * sigma)
    low[LIMIT_COUNT], high[LIMIT_COUNT] = 0.0, np.inf
    if terms.entered[R]:
        low[LIMIT_COUNT] = options.leave * np.sqrt(most)
    elif terms.status[K] > 0 and most == most:
        high[LIMIT_COUNT] = options.enter * np.sqrt(most)
