"""Records of arrays that the compiled functions of the fit pass to each other.

All quantities are in units of one sample: τ0 = 1, and θ stands for Q²/τ0², N²/τ0, B², K² τ0, R² τ0². A result that
remains NaN could not be computed.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Floats, Ints
from monitor.estimation.allan.uncertainty import NOISES

LIMIT_COUNT: Final = 2 * NOISES
"""Number of quantities with limits in ``SolutionMaps``: θ of Q N B K, then the unconstrained solution û of Q N B K."""


class SharedInputs(NamedTuple):
    """Inputs of a fit that are the same for all axes at one window length."""

    columns: Floats  # [m, 5] Allan variance of unit coefficients
    flat: Floats  # [m, 5] the same without the mean contribution of their own noise to slope² τ²/2
    covariance: Floats  # [m, m, 10] ``CovarianceTable.covariance``
    whole: Floats  # [m] number of terms in a window without gaps
    slope_variance: Floats  # [4] variance of the slope of thirds, for unit θ
    blind: Floats  # [m] direction of the curve that the fit ignores, larger than any noise; zero means none
    ask: bool  # True to leave out short τ that contradict the fit


class CurvesOfAxes(NamedTuple):
    """Measured curves and slopes, with one row per axis."""

    avar: Floats  # [axes, m] Allan variance
    terms: Floats  # [axes, m] number of second differences averaged
    slope: Floats  # [axes] slope of the rate; NaN means not measured
    slopes: Floats  # [axes, m] slope as seen by each τ


class FitOptions(NamedTuple):
    """Options of a fit."""

    enter: float  # threshold in σ to add a term
    leave: float  # threshold in σ to drop a term
    full: bool  # True to weight by the covariances of all τ, False to weight by their variances alone
    warm: bool  # True to start with the weights of ``FitOutput.theta``


class FitOutput(NamedTuple):
    """Results of a fit, with one row per axis."""

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


class TermResults(NamedTuple):
    """Results of a fit for the five terms of one axis: rows of ``FitOutput``."""

    entered: NDArray[np.bool_]  # [5] terms in the fit
    theta: Floats  # [5] squared coefficients
    lo: Floats  # [5] lower end of the interval
    hi: Floats  # [5] upper end of the interval
    status: NDArray[np.int8]  # [5] values of ``Status``


class LeastSquares(NamedTuple):
    """Weighted least-squares problem of one axis, with the memory for its weights and normal equations."""

    level: Floats  # [m] observations y: the curve without the line of the slope
    stretch: Floats  # [m] square root of the terms in a window without gaps over the terms present
    columns: Floats  # [m, 5] columns X
    covariance: Floats  # [m, m, 10] ``CovarianceTable.covariance``
    blind: Floats  # [m] direction that the fit ignores; ``blind`` blindᵀ is added to the covariance V
    variance: Floats  # [m] variances of the observations under the model
    weighted: Floats  # [m, 5] V⁻¹ X
    normal: Floats  # [5, 5] Xᵀ V⁻¹ X
    right: Floats  # [5] Xᵀ V⁻¹ y


class TermTests(NamedTuple):
    """Test statistics of the terms Q N B K of one axis."""

    estimate: Floats  # [5] unconstrained solution û
    absent_variance: Floats  # [4] variance of û if its term were absent
    enter_limit: Floats  # [4] value of û above which an absent term is added


class SolutionMaps(NamedTuple):
    """Solution as a linear map from curve to coefficients, with the limits of its validity, and one row per axis.

    With r = Xᵀ V⁻¹ y of the normal equations, θ = ``inverse`` r on the terms that are not zero, and û = ``whole`` r.
    """

    rows: Floats  # [axes, m, NOISES] V⁻¹ X
    ramp: Floats  # [axes, NOISES] part of r that is subtracted per slope²
    twist: Floats  # [axes, NOISES] part of r per slope, because each τ sees another slope than the window
    normal: Floats  # [axes, 5, 5] Xᵀ V⁻¹ X
    inverse: Floats  # [axes, NOISES, NOISES]
    whole: Floats  # [axes, NOISES, NOISES]
    low: Floats  # [axes, LIMIT_COUNT + 1] lower limits of θ, û, and last of the absolute slope
    high: Floats  # [axes, LIMIT_COUNT + 1] upper limits of the same
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


def empty_solution_maps(axes: int, m: int) -> SolutionMaps:
    """Allocate maps that are not valid yet.

    Parameters
    ----------
    axes : int
        Number of axes.
    m : int
        Number of τ.
    """
    ramp, twist = np.zeros((2, axes, NOISES))
    inverse, whole = np.zeros((2, axes, NOISES, NOISES))
    limits = np.full((axes, LIMIT_COUNT + 1), np.inf)
    free, straight, either = np.zeros((3, axes), np.bool_)
    return SolutionMaps(
        np.zeros((axes, m, NOISES)), ramp, twist, np.zeros((axes, 5, 5)), inverse, whole, limits, -limits,
        np.zeros((axes, 2), np.int64), free, straight, either,
    )  # fmt: skip
