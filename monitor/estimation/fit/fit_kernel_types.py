"""Named tuples of arrays that are passed between the compiled functions of the fit.

Time is in units of one sample interval τ0, so θ = (Q²/τ0², N²/τ0, B², K² τ0, R² τ0²). NaN means that a result is
unknown.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats, Ints
from monitor.estimation.allan.uncertainty import NOISES

LIMIT_COUNT: Final = 2 * NOISES
"""Number of limits in ``SolutionMaps`` for the solution θ and the unconstrained solution û of Q, N, B and K."""


class SharedInputs(NamedTuple):
    """Inputs of a fit that are the same for all axes with the same number of samples."""

    columns: Floats  # [m, 5] Allan variance for each unit coefficient
    flat: Floats  # [m, 5] ``columns`` if the contribution of the measured slope has been subtracted
    covariance: Floats  # [m, m, 10] field ``CovarianceTable.covariance``
    whole: Floats  # [m] number of second differences if no samples are missing
    slope_variance: Floats  # [4] variance of the slope of the rate for each unit coefficient
    ignored_direction: Floats  # [m] change of the Allan variances that must not affect the fit; 0 for none
    may_drop_short_taus: bool  # True to leave out the shortest τ if they contradict the fit


class VariancesAndSlopesOfAxes(NamedTuple):
    """Measured Allan variances and slopes of the rate, with one row per axis."""

    avar: Floats  # [axes, m] Allan variance
    terms: Floats  # [axes, m] number of averaged second differences
    slope: Floats  # [axes] slope of the rate; NaN means not measured
    slopes: Floats  # [axes, m] slope of the rate at each τ; NaN if too many samples are missing
    excess: Floats  # [axes, m] contribution of missing samples that has been subtracted from the mean square


class FitOptions(NamedTuple):
    """Thresholds and weights of a fit."""

    enter: float  # threshold in σ to add a noise term
    leave: float  # threshold in σ to drop a noise term
    full_covariance: bool  # True to weight by the covariances of all τ, False to weight by their variances alone
    warm: bool  # True to start with the weights of ``FitOutput.theta``


class FitOutput(NamedTuple):
    """Results of a fit, with one row per axis."""

    entered: NDArray[np.bool_]  # [axes, 5] True for noise terms in the fit; on input, terms of the previous fit
    theta: Floats  # [axes, 5] squared coefficients; on input, result of a recent fit
    lo: Floats  # [axes, 5] lower end of the confidence interval
    hi: Floats  # [axes, 5] upper end of the confidence interval
    status: NDArray[np.int8]  # [axes, 5] values of ``Status``
    edf: Floats  # [axes, m] degrees of freedom of the Allan variance
    fitted: Floats  # [axes, m] Allan variance of the fitted model
    left_out: Ints  # [axes] number of averaging times that are left out, from the shortest τ
    misfit: Floats  # [axes] equal to ``scatter`` if the residuals are significantly too large, otherwise 1
    scatter: Floats  # [axes] mean squared residual, relative to the variance that the five noise terms explain
    either: NDArray[np.bool_]  # [axes] True if K and R cannot be distinguished


class TermResults(NamedTuple):
    """Results of the fit of one axis, which are views of one row of ``FitOutput``."""

    entered: NDArray[np.bool_]  # [5] True for noise terms in the fit

    theta: Floats  # [5] squared coefficients
    lo: Floats  # [5] lower end of the confidence interval
    hi: Floats  # [5] upper end of the confidence interval
    status: NDArray[np.int8]  # [5] values of ``Status``


class LeastSquares(NamedTuple):
    """Weighted least-squares problem of one axis, with its weights and normal equations."""

    level: Floats  # [m] observations y: Allan variances without the contribution of the slope
    excess: Floats  # [m] contribution of missing samples that has been subtracted from the mean squares
    extra_white: Floats  # [m] N of white noise that contributes as much as the missing samples
    stretch: Floats  # [m] square root of the ratio of all second differences to those that count
    columns: Floats  # [m, 5] design matrix X
    covariance: Floats  # [m, m, 10] field ``CovarianceTable.covariance``
    ignored_direction: Floats  # [m] change of y that must not affect the fit; its outer product is added to V
    variance: Floats  # [m] variances of the observations, the diagonal of V
    weighted: Floats  # [m, 5] V⁻¹ X
    normal: Floats  # [5, 5] Xᵀ V⁻¹ X
    right: Floats  # [5] Xᵀ V⁻¹ y


class TermTests(NamedTuple):
    """Test statistics of the noise terms Q, N, B and K of one axis."""

    estimate: Floats  # [5] unconstrained solution û
    absent_variance: Floats  # [4] variance of û if the noise term is absent
    enter_limit: Floats  # [4] value of û above which an absent noise term is added


class SolutionMaps(NamedTuple):
    """Linear maps from the Allan variances of each axis to the squared coefficients, with limits of validity.

    The right-hand side of the normal equations is r = Xᵀ V⁻¹ y. The constrained solution is θ = ``inverse`` r, and the
    unconstrained solution is û = ``whole`` r.
    """

    rows: Floats  # [axes, m, NOISES] V⁻¹ X
    ramp: Floats  # [axes, NOISES] factor of slope² that is subtracted from r
    twist: Floats  # [axes, NOISES] factor of the slope that is subtracted from r
    normal: Floats  # [axes, 5, 5] Xᵀ V⁻¹ X
    inverse: Floats  # [axes, NOISES, NOISES] linear map from r to θ
    whole: Floats  # [axes, NOISES, NOISES] linear map from r to û
    low: Floats  # [axes, LIMIT_COUNT + 1] lower limits of θ, of û and of the absolute slope
    high: Floats  # [axes, LIMIT_COUNT + 1] upper limits of θ, of û and of the absolute slope
    used: Ints  # [axes, 2] range of the τ that are used; empty if there is no solution
    free: NDArray[np.bool_]  # [axes] True if Q² may be negative
    straight: NDArray[np.bool_]  # [axes] True if slope² τ²/2 is subtracted from the Allan variance


def empty_fit_output(axes: int, m: int, entered: NDArray[np.bool_]) -> FitOutput:
    """Allocate the arrays for the results of a fit, in which only the inputs ``entered`` and ``theta`` have values.

    ``theta`` is NaN, which means that no recent fit is known.

    Parameters
    ----------
    axes : int
        Number of axes.
    m : int
        Number of τ.
    entered : ndarray of bool, shape (axes, 5)
        Noise terms of the previous fit, which become part of the returned object.
    """
    theta, lo, hi = np.empty((3, axes, 5))
    theta[:] = np.nan
    edf, fitted = np.empty((2, axes, m))
    misfit, scatter = np.empty((2, axes))
    status, left_out, either = np.empty((axes, 5), np.int8), np.empty(axes, np.int64), np.empty(axes, np.bool_)
    return FitOutput(entered, theta, lo, hi, status, edf, fitted, left_out, misfit, scatter, either)


def empty_solution_maps(axes: int, m: int) -> SolutionMaps:
    """Allocate the arrays for linear maps, which are marked as invalid.

    Parameters
    ----------
    axes : int
        Number of axes; 0 if the linear maps are not needed.
    m : int
        Number of τ.
    """
    ramp, twist = np.zeros((2, axes, NOISES))
    inverse, whole = np.zeros((2, axes, NOISES, NOISES))
    limits = np.full((axes, LIMIT_COUNT + 1), np.inf)
    free, straight = np.zeros((2, axes), np.bool_)
    return SolutionMaps(
        np.zeros((axes, m, NOISES)), ramp, twist, np.zeros((axes, 5, 5)), inverse, whole, limits, -limits,
        np.zeros((axes, 2), np.int64), free, straight,
    )  # fmt: skip


NO_MAPS: Final = empty_solution_maps(0, 0)
"""Argument ``maps`` of a fit whose linear maps are not needed."""
