"""Compiled functions that fit the noise coefficients of each axis by weighted non-negative least squares.

The units are described in ``fit_kernel_types``. For given weights, the squared coefficients are a linear function of
the Allan variances. This linear function and the limits within which it is valid are stored for ``per_sample_refit``.
"""

from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled
from monitor.estimation.allan.uncertainty import NOISES, PAIRS
from monitor.estimation.fit.confidence_bounds import bound_q_by_first_point, limit_terms_by_measured_avar
from monitor.estimation.fit.fit_kernel_types import (
    FitOptions,
    FitOutput,
    LeastSquares,
    SharedInputs,
    SolutionMaps,
    TermResults,
    VariancesAndSlopesOfAxes,
)
from monitor.estimation.fit.least_squares import (
    N,
    Q,
    R,
    compute_normal_equations,
    compute_observation_variances,
    compute_weights,
    solve_nonnegative,
)
from monitor.estimation.fit.term_selection import (
    compute_linear_map_validity_limits,
    select_terms,
    store_linear_map,
    tighten_bounds,
    update_ramp_selection,
)

MIN_ROWS: Final = NOISES + 1
"""Minimum number of averaging times for a fit of the four noise terms Q, N, B and K."""
COLD_PASSES: Final = 3
"""Number of iterations that recompute the weights if no previous fit is known."""
WARM_PASSES: Final = 1
"""Number of iterations that recompute the weights if the fit starts from a recent fit."""
MISFIT_SIGMA: Final = 4.0
"""Residual in σ above which the Allan variance at a short τ contradicts the fit."""
REPEATED_MISFIT_SIGMA: Final = 2.5
"""Residual in σ above which the Allan variance at a short τ contradicts a fit with a negative Q².

This limit is lower than ``MISFIT_SIGMA`` to prevent a bias in N.
"""
TOTAL_MISFIT_SIGMA: Final = 6.0
"""Deviation of χ² in σ above which the five noise terms do not explain the Allan variances."""
SHORT_ROWS: Final = 4
"""Number of averaging times, beginning with the shortest, at which the residuals are tested."""
FILTER_MEMORY: Final = 16
"""Largest cluster size in samples that can be left out of a fit."""
WHITE: Final = PAIRS.index((N, N))
"""Index of the pair (N, N) in the last dimension of ``CovarianceTable.covariance``."""


@compiled
def fit_axes(
    first_axis: int,
    end_axis: int,
    shared: SharedInputs,
    curves: VariancesAndSlopesOfAxes,
    options: FitOptions,
    output: FitOutput,
    maps: SolutionMaps,
) -> None:
    """Fit the noise coefficients of the axes first_axis ≤ axis < end_axis.

    Parameters
    ----------
    first_axis, end_axis : int
        Range of axes.
    shared : SharedInputs
        Inputs that are the same for all axes.
    curves : VariancesAndSlopesOfAxes
        Measured Allan variances and slopes of the rate.
    options : FitOptions
        Thresholds to add and to drop noise terms, and the kind of weights.
    output : FitOutput
        Results of the fit, updated in place.
    maps : SolutionMaps
        Linear maps from the Allan variances to the solutions, updated in place; ``NO_MAPS`` if they are not needed.
    """
    for axis in range(first_axis, end_axis):
        _fit_axis(axis, shared, curves, options, output, maps)


@compiled
def _fit_axis(
    axis: int,
    shared: SharedInputs,
    curves: VariancesAndSlopesOfAxes,
    options: FitOptions,
    output: FitOutput,
    maps: SolutionMaps,
) -> None:
    curve, slope, m = curves.avar[axis], curves.slope[axis], curves.avar.shape[1]
    straight = slope == slope
    terms = TermResults(output.entered[axis], output.theta[axis], output.lo[axis], output.hi[axis], output.status[axis])
    problem = LeastSquares(
        np.empty(m), curves.excess[axis], np.zeros(m), np.empty(m), shared.flat if straight else shared.columns,
        shared.covariance, shared.ignored_direction, np.empty(m), np.empty((m, 5)), np.empty((5, 5)), np.empty(5),
    )  # fmt: skip
    rows = _prepare_rows(axis, shared, curves, problem)
    stores_map = maps.used.shape[0] > 0
    if stores_map:
        maps.used[axis, 0] = maps.used[axis, 1] = 0
        maps.straight[axis] = straight
    _reset_results(axis, rows, shared, curves.terms[axis], output)
    if rows.size < MIN_ROWS:
        for a in range(5):
            terms.entered[a] = False
        return
    first, free = _fit_or_fall_back(axis, rows, problem, curve, shared.may_drop_short_taus, options, output)
    used, misfit = rows[first:], output.misfit[axis]
    tests = select_terms(problem, used, options, straight, misfit, terms)
    tighten_bounds(problem, used, misfit, tests, terms)
    for a in range(5):
        if terms.status[a] == 1 and not terms.hi[a] < np.inf:  # too few averaging times for an upper bound
            terms.status[a], terms.lo[a], terms.hi[a] = 0, np.nan, np.nan
    extra = problem.extra_white[rows[-1]]
    noise, most, output.either[axis] = update_ramp_selection(
        slope, extra * extra, shared.slope_variance, options, terms
    )
    compute_observation_variances(problem, rows, terms.theta)
    _draw(axis, rows, shared.columns, noise, problem, output)
    if stores_map:
        maps.free[axis] = free
        if store_linear_map(axis, used, problem, curves, output, maps):
            compute_linear_map_validity_limits(maps.low[axis], maps.high[axis], options, tests, most, terms)
    if misfit > 1.0:
        limit_terms_by_measured_avar(
            curve, problem.excess, output.edf[axis], used, shared.columns, FILTER_MEMORY, terms
        )
    if free:
        i = rows[0]
        bound_q_by_first_point(curve[i], problem.excess[i], output.edf[axis, i], shared.columns[i, Q], terms)


@compiled
def _reset_results(axis: int, rows: Ints, shared: SharedInputs, terms: Floats, output: FitOutput) -> None:
    """Reset the results of an axis to those without a fit. The degrees of freedom are those of white noise."""
    for a in range(5):
        output.lo[axis, a], output.hi[axis, a], output.status[axis, a] = np.nan, np.nan, 0
    for i in range(shared.whole.size):
        output.edf[axis, i] = output.fitted[axis, i] = np.nan
    for i in rows:
        own = shared.covariance[i, i, WHITE] * (shared.whole[i] / terms[i])
        output.edf[axis, i] = 2.0 * shared.columns[i, N] ** 2 / own
    output.left_out[axis], output.misfit[axis], output.scatter[axis], output.either[axis] = 0, 1.0, np.inf, False


@compiled
def _prepare_rows(axis: int, shared: SharedInputs, curves: VariancesAndSlopesOfAxes, problem: LeastSquares) -> Ints:
    """Subtract the contribution of the slope from the Allan variances, and return the indices of the τ to use."""
    curve, terms, slope = curves.avar[axis], curves.terms[axis], curves.slope[axis]
    rows, count = np.empty(curve.size, np.int64), 0
    for i in range(curve.size):
        excess = problem.excess[i]
        if curve[i] + excess > 0.0 and terms[i] > 0.0 and shared.whole[i] > 0.0:
            rows[count] = i
            problem.stretch[i] = np.sqrt(shared.whole[i] / terms[i])
            # the Allan variance of white noise N² is N²/m, and that of a ramp R² is R² m²/2
            problem.extra_white[i] = np.sqrt(max(excess, 0.0) * np.sqrt(2.0 * shared.columns[i, R]))
            if curves.slopes[axis, i] != curves.slopes[axis, i]:
                curves.slopes[axis, i] = slope
            line = slope * (2.0 * curves.slopes[axis, i] - slope) if slope == slope else 0.0
            problem.level[i] = curve[i] - line * shared.columns[i, R]
            count += 1
    return rows[:count]


@compiled
def _fit_or_fall_back(
    axis: int,
    rows: Ints,
    problem: LeastSquares,
    curve: Floats,
    may_drop_short_taus: bool,
    options: FitOptions,
    output: FitOutput,
) -> tuple[int, bool]:
    """Fit with the full covariance matrix, or with the variances alone if the misfit is too large.

    Return how many of the shortest τ are left out, and whether Q² may be negative.
    """
    full_covariance, theta = options.full_covariance, output.theta[axis]
    while True:
        first, free = _fit_terms(curve, rows, problem, may_drop_short_taus, full_covariance, options.warm, theta)
        scatter, limit = _misfit(problem, rows[first:], theta)
        if not full_covariance or scatter <= limit:
            break
        full_covariance = False  # the covariances only hold for the five noise terms
    output.left_out[axis], output.scatter[axis] = first, scatter
    output.misfit[axis] = scatter if scatter > limit else 1.0
    return first, free


@compiled
def _draw(axis: int, rows: Ints, columns: Floats, noise: float, problem: LeastSquares, output: FitOutput) -> None:
    theta, variance = output.theta[axis], problem.variance
    for k in range(rows.size):
        i = rows[k]
        model, positive = 0.0, 0.0
        for a in range(5):
            model += columns[i, a] * theta[a]
            positive += columns[i, a] * max(theta[a], 0.0)
        output.fitted[axis, i] = model if k >= output.left_out[axis] and model > 0.0 else np.nan
        # The cross term of drift and noise in the squared second differences adds the variance 4 R² (m²/2)² Var(slope).
        variance[i] += 4.0 * theta[R] * columns[i, R] ** 2 * noise
        edf = 2.0 * (positive + problem.excess[i]) ** 2 / variance[i]
        if edf == edf:
            output.edf[axis, i] = edf


@compiled
def _fit_terms(
    curve: Floats,
    rows: Ints,
    problem: LeastSquares,
    may_drop_short_taus: bool,
    full_covariance: bool,
    warm: bool,
    theta: Floats,
) -> tuple[int, bool]:
    """Fit Q, N, B and K iteratively with recomputed weights.

    Return how many of the shortest τ are left out, and whether Q² may be negative.
    """
    first, free = 0, False
    warm = warm and theta[N] > 0.0
    while True:
        used = rows[first:]
        if warm:
            compute_weights(problem, used, theta, full_covariance)
        else:
            for i in used:  # the weights of the first iteration assume white noise
                raw = curve[i] + problem.excess[i]
                variance = raw * raw * problem.covariance[i, i, WHITE] / problem.columns[i, N] ** 2
                for a in range(5):
                    problem.weighted[i, a] = problem.columns[i, a] / variance
        for _ in range(WARM_PASSES if warm else COLD_PASSES):
            compute_normal_equations(problem, used)
            solve_nonnegative(problem.normal, problem.right, free, theta)
            compute_weights(problem, used, theta, full_covariance)
        limit = REPEATED_MISFIT_SIGMA if free else MISFIT_SIGMA
        if not may_drop_short_taus or not _is_contradicted(problem, used[:SHORT_ROWS], theta, limit):
            break
        if not free:
            free = True
        elif used.size > MIN_ROWS and problem.columns[used[0], N] * FILTER_MEMORY >= 1.0:
            first += 1
        else:  # A low-pass filter does not explain the misfit.
            first, free, may_drop_short_taus = 0, False, False
    compute_normal_equations(problem, used)
    solve_nonnegative(problem.normal, problem.right, free, theta)
    return first, free


@compiled
def _misfit(problem: LeastSquares, rows: Ints, theta: Floats) -> tuple[float, float]:
    """Return the mean squared residual in σ², and the largest value that the five noise terms would explain.

    If the mean squared residual exceeds the limit, the confidence intervals are widened (Birge 1932).
    """
    level, columns, variance, excess = problem.level, problem.columns, problem.variance, problem.excess
    total, freedom = 0.0, rows.size
    for a in range(NOISES):
        if theta[a] != 0.0:
            freedom -= 1
    for i in rows:
        model = 0.0
        for a in range(5):
            model += columns[i, a] * theta[a]
        raw = model + excess[i]
        if model > 0.0:
            spread = variance[i] / (9.0 * raw * raw)
            total += ((max(level[i] + excess[i], 0.0) / raw) ** (1.0 / 3.0) - 1.0 + spread) ** 2 / spread
    freedom = max(freedom, 1)
    return total / freedom, 1.0 + TOTAL_MISFIT_SIGMA * np.sqrt(2.0 / freedom)


@compiled
def _is_contradicted(problem: LeastSquares, rows: Ints, theta: Floats, limit: float) -> bool:
    """Return True if any residual exceeds ``limit`` σ.

    Residuals are computed from the cube root of χ², whose distribution is approximately normal (Wilson & Hilferty
    1931).
    """
    columns = problem.columns
    for i in rows:
        model = 0.0
        for a in range(5):
            model += columns[i, a] * theta[a]
        if model <= 0.0:
            return True
        excess = problem.excess[i]
        spread = problem.variance[i] / (9.0 * (model + excess) ** 2)  # 2/(9 edf)
        ratio = (problem.level[i] + excess) / (model + excess)
        if abs(ratio ** (1.0 / 3.0) - 1.0 + spread) > limit * np.sqrt(spread):
            return True
    return False
