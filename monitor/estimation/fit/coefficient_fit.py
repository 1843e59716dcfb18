"""Weighted non-negative least-squares fit of the coefficients Q N B K R to the Allan variances of several axes.

The Allan variance is linear in θ = (Q², N², B², K², R²). Each axis is fitted by non-negative least squares. The weight
matrix is the inverse covariance of the Allan variances at all τ under the fitted model. A fast fit uses only the
variances. The errors of the coefficients are within a few percent of the Cramér–Rao limit.

The status of each coefficient is determined from the solution û without the constraint θ ≥ 0. If the true squared
coefficient is t, the variance of û is a polynomial v(t) = c0 + c1 t + c2 t². A term is included in the fit if û exceeds
a multiple of √c0, the standard deviation for an absent term. The confidence interval contains all t for which û is a
plausible estimate. For a term that is not included, only an upper bound is given.

The Allan variance alone cannot distinguish a ramp from a random walk. If the slope of the rate in the window is known,
the contribution of the slope is subtracted from the Allan variance before the fit, so K is unbiased. R is included if
the slope is significantly larger than the slope that noise would cause. If the slope is unknown, a ramp is estimated as
K, and R is only bounded.

The bandwidth of real sensors ends below half the sample rate. White noise after a low-pass filter has the Allan
variance N²/τ − c/τ² at long τ. The term c/τ² has the shape of quantization noise with a negative sign. If the fit is
inconsistent with the shortest τ, Q² may therefore become negative, and Q is only bounded. If the fit is still
inconsistent, the shortest τ are left out one after another. If no low-pass filter explains the Allan variance, all τ
are used, and the misfit is reported.

All coefficients of an axis with too few τ or without noise are UNESTIMATED.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats, Ints
from monitor.estimation.allan.uncertainty import NOISES, CovarianceTable
from monitor.estimation.fit.coefficient_values import Coefficients, Status
from monitor.estimation.fit.fit_kernel import WHITE, fit_axes
from monitor.estimation.fit.fit_kernel_types import (
    CurvesOfAxes,
    FitOptions,
    SharedInputs,
    empty_fit_output,
    empty_solution_maps,
)
from monitor.estimation.fit.least_squares import N, R
from monitor.noise.standard_terms import unit_coefficient_allan_variances

TO_SI: Final = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
"""Powers of the sample rate that convert Q N B K R from τ0 = 1 to SI."""

PER_AXIS_FIELDS: Final = ("theta", "fitted", "edf", "entered", "left_out", "scatter", "misfit", "k_or_r")
"""Fields of ``Fit`` with one column per axis, except the coefficients."""
THRESHOLDS_ONCE: Final = (2.33, 2.33)
"""Thresholds in σ to add and to drop a term in a single fit, with a false-alarm probability of 1 %."""
THRESHOLDS_WATCHED: Final = (3.0, 1.5)
"""Thresholds in σ to add and to drop a term in repeated fits, with hysteresis."""


@dataclass(frozen=True, slots=True)
class DesignMatrix:
    """Design matrix of the fit for one list of cluster sizes."""

    factors: Ints  # [m] cluster sizes in samples
    rate_hz: float
    columns: Floats  # [m, 5] Allan variance of unit coefficients at τ0 = 1


@dataclass(frozen=True, slots=True)
class Fit:
    """Result of one fit of six axes."""

    coefficients: Coefficients
    theta: Floats  # [5, 6] fitted Q² N² B² K² R² in SI; a negative Q² represents a band limit
    fitted: Floats  # [m, 6] Allan variance of the fitted model; NaN without a fit or if τ is left out
    edf: Floats  # [m, 6] equivalent degrees of freedom of the measured Allan variance
    entered: NDArray[np.bool_]  # [5, 6] True for the terms in the fit
    left_out: Ints  # [6] number of shortest τ that are left out of the fit
    scatter: Floats  # [6] mean squared residual relative to the variance expected from the five terms
    misfit: Floats  # [6] ``scatter`` if the residuals are significantly too large, otherwise 1
    k_or_r: NDArray[np.bool_]  # [6] True if the rate drifts, but random walk and ramp cannot be distinguished


def make_design_matrix(factors: Ints, rate_hz: float) -> DesignMatrix:
    """Return the design matrix of the fit, whose columns are the Allan variances of the noise terms.

    Parameters
    ----------
    factors : ndarray of int64, shape (m,)
        Cluster sizes in samples.
    rate_hz : float
        Sample rate in Hz.
    """
    m = np.asarray(factors, np.float64)
    columns = np.ascontiguousarray(unit_coefficient_allan_variances(m, 1.0))
    return DesignMatrix(factors, rate_hz, columns)


def make_shared_inputs(
    design: DesignMatrix,
    table: CovarianceTable,
    ignored_direction: Floats | None = None,
    may_drop_short_taus: bool = True,
) -> SharedInputs:
    """Return the inputs of a fit that are the same for all axes.

    Parameters
    ----------
    design : DesignMatrix
        Design matrix for the cluster sizes.
    table : CovarianceTable
        Covariances for the window length.
    ignored_direction : ndarray of float64, shape (m,), or None
        Change of the Allan variances that has no effect on the fit, in units of one sample.
    may_drop_short_taus : bool
        True to leave out the shortest τ if they contradict the fit.
    """
    flat = design.columns.copy()
    # The measured slope includes noise, so its subtraction reduces the expected contribution of each noise term.
    flat[:, :NOISES] -= (2.0 * table.bend - table.slope) * design.columns[:, R, None]
    flat[:, ~design.columns.any(axis=0)] = 0.0  # terms that are not fitted

    ignored_direction = np.zeros(design.factors.size) if ignored_direction is None else ignored_direction
    whole = table.terms.astype(np.float64)
    return SharedInputs(
        design.columns, flat, table.covariance, whole, table.slope, ignored_direction, may_drop_short_taus
    )


@dataclass(frozen=True, slots=True)
class MeasuredCurve:
    """Measured Allan variances of k axes, and slopes of the rate in the same window."""

    avar: Floats  # [m, k] Allan variance in squared units of the axis; NaN if the window is too short
    terms: Ints  # [m, k] number of second differences averaged
    slope: Floats | None = None  # [k] ``batch.rate_slope_from_thirds`` in unit/s; if None or NaN, R is only bounded
    slopes: Floats | None = None  # [m, k] ``batch.rate_slope_per_tau`` in unit/s; if None, a strong ramp biases K
    entered_before: NDArray[np.bool_] | None = None  # [5, k] ``entered`` of the previous fit; None for a single fit

    def select_axis(self, column: int) -> "MeasuredCurve":
        """Return the measured Allan variances and slopes of one axis."""
        one = slice(column, column + 1)
        slope = None if self.slope is None else self.slope[one]
        slopes = None if self.slopes is None else self.slopes[:, one]
        before = None if self.entered_before is None else self.entered_before[:, one]
        return MeasuredCurve(self.avar[:, one], self.terms[:, one], slope, slopes, before)


def fit_coefficients(
    design: DesignMatrix,
    table: CovarianceTable,
    measured: MeasuredCurve,
    full_covariance: bool = True,
    start_theta: Floats | None = None,
    ignored_direction: Floats | None = None,
    may_drop_short_taus: bool = True,
) -> Fit:
    """Fit the coefficients Q N B K R of k axes to overlapping Allan variances.

    In repeated fits, terms are added at 3 σ and dropped at 1.5 σ. In a single fit, both thresholds are 2.33 σ.

    Parameters
    ----------
    design : DesignMatrix
        Design matrix for the cluster sizes.
    table : CovarianceTable
        Covariances for the window length.
    measured : MeasuredCurve
        Measured Allan variances and slopes.
    full_covariance : bool
        True to weight by the covariances of all τ, False to weight by the variances alone.
    start_theta : ndarray of float64, shape (5, k), or None
        ``theta`` of a recent fit, from which the first weights are computed. The fit is then three times as fast.
    ignored_direction : ndarray of float64, shape (m,), or None
        Change of the Allan variances that has no effect on the fit, in units of one sample.
    may_drop_short_taus : bool
        True to leave out the shortest τ if they contradict the fit.
    """
    avar, terms, before = measured.avar, measured.terms, measured.entered_before
    m, axes = avar.shape
    found = empty_fit_output(
        axes, m, np.zeros((axes, 5), np.bool_) if before is None else np.array(before.T, order="C")
    )
    maps = empty_solution_maps(axes, m)
    if start_theta is not None:
        found.theta[:] = start_theta.T / design.rate_hz ** (2.0 * TO_SI)
    curves, counts = np.ascontiguousarray(avar.T), np.ascontiguousarray(terms.T, np.float64)
    slope = np.full(axes, np.nan) if measured.slope is None else measured.slope / design.rate_hz
    slopes = np.tile(slope, (m, 1)).T if measured.slopes is None else measured.slopes.T / design.rate_hz
    options = FitOptions(
        *(THRESHOLDS_ONCE if before is None else THRESHOLDS_WATCHED), full_covariance, start_theta is not None
    )
    shared = make_shared_inputs(design, table, ignored_direction, may_drop_short_taus)
    fit_axes(0, axes, shared, CurvesOfAxes(curves, counts, slope, np.ascontiguousarray(slopes)), options, found, maps)
    to_si = design.rate_hz**TO_SI
    value = np.where(found.status == Status.ESTIMATED, np.sqrt(np.maximum(found.theta, 0.0)), np.nan)
    coefficients = Coefficients((value * to_si).T, (found.lo * to_si).T, (found.hi * to_si).T, found.status.T)
    edf = found.edf.T
    missing = np.isnan(edf) & (avar > 0.0)
    if missing.any():
        edf = np.where(missing, _white_edf(design, table, terms), edf)
    return Fit(
        coefficients, (found.theta * to_si**2).T, found.fitted.T, edf, found.entered.T, found.left_out,
        found.scatter, found.misfit, maps.either,
    )  # fmt: skip


def replace_axis_results(all_axes: Fit, axis: int, axis_fit: Fit) -> Fit:
    """Return a copy of a fit in which the results of one axis are replaced.

    Parameters
    ----------
    all_axes : Fit
        Fit of all axes.
    axis : int
        Index of the axis to replace.
    axis_fit : Fit
        Fit of this axis alone.
    """

    def replace_column(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
        result = parts[0].copy()
        result[..., axis] = parts[1][..., 0]
        return result

    return _combine((all_axes, axis_fit), replace_column)


def concatenate_fits(fits: Sequence[Fit], axes: Ints) -> Fit:
    """Concatenate fits of different axes in the order of the axes.

    Parameters
    ----------
    fits : sequence of Fit
        Fits of one or more axes.
    axes : ndarray of int64, shape (k,)
        Index of the axis of each column of the fits.
    """
    order = np.argsort(axes)
    return _combine(fits, lambda parts: np.concatenate(parts, axis=-1)[..., order])


def _combine(fits: Sequence[Fit], join: Callable[[Sequence[NDArray[Any]]], NDArray[Any]]) -> Fit:
    names = ("value", "lo", "hi", "status")
    coefficients = (join([getattr(one.coefficients, name) for one in fits]) for name in names)
    fields = {name: join([getattr(one, name) for one in fits]) for name in PER_AXIS_FIELDS}
    return Fit(Coefficients(*coefficients), **fields)


def empty_fit(avar: Floats) -> Fit:
    """Return a fit for Allan variances [m, 6] in which all coefficients are unestimated."""
    nothing = np.full((5, avar.shape[1]), np.nan)
    status = np.full((5, avar.shape[1]), Status.UNESTIMATED, np.int8)
    return Fit(
        Coefficients(nothing, nothing, nothing, status),
        theta=nothing,
        fitted=np.full_like(avar, np.nan),
        edf=np.full_like(avar, np.nan),
        entered=np.zeros((5, avar.shape[1]), np.bool_),
        left_out=np.zeros(avar.shape[1], np.int64),
        scatter=np.full(avar.shape[1], np.nan),
        misfit=np.ones(avar.shape[1]),
        k_or_r=np.zeros(avar.shape[1], np.bool_),
    )


def _white_edf(design: DesignMatrix, table: CovarianceTable, terms: Ints) -> Floats:
    """Return the degrees of freedom for white noise, which are used for axes without a fit."""
    whole = table.terms[:, None]
    ratio = np.where((whole > 0) & (terms > 0), whole / np.maximum(terms, 1), np.nan)  # of all terms to present terms
    own = table.covariance[:, :, WHITE].diagonal()[:, None] * ratio
    return np.asarray(2.0 * design.columns[:, N, None] ** 2 / own)
