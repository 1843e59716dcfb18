"""Weighted non-negative least-squares fit of the noise coefficients Q, N, B, K and R to Allan variances.

The Allan variance is a linear function of θ = (Q², N², B², K², R²), so θ is fitted by non-negative least squares. The
weight matrix is the inverse of the covariance matrix of the Allan variances under the fitted model. A faster fit
neglects the correlations between different τ. The standard deviations of the coefficients are within a few percent of
the Cramér–Rao bound.

The status of each coefficient is determined from the solution û without the constraint θ ≥ 0. If the true squared
coefficient is t, the variance of û is v(t) = c0 + c1 t + c2 t². A noise term is included in the fit if û exceeds a
multiple of √c0, the standard deviation of û for t = 0. The confidence interval contains all t for which û is a
plausible estimate. For a noise term that is not included in the fit, only an upper bound is given.

The Allan variance alone cannot distinguish a linear drift from a random walk. If the slope of the rate is known, its
contribution is subtracted from the Allan variance before the fit, so that K is unbiased. R is included in the fit if
the slope is significantly larger than noise alone would cause. If the slope is unknown, a linear drift contributes to
K, and only an upper bound of R is given.

The bandwidth of many sensors is less than half the sample rate. At long τ, low-pass filtered white noise has the Allan
variance N²/τ − c/τ². The second term looks like quantization noise with a negative sign. If the Allan variances at the
shortest τ contradict the fit, Q² may therefore become negative. In this case, only an upper bound of Q is given. If the
contradiction remains, the shortest τ are left out one after another. If no low-pass filter explains the Allan
variances, all τ are used, and the misfit is reported.

If an axis has no noise or too few τ, the status of all its coefficients is UNESTIMATED.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats, Ints
from monitor.common.compiled import compiled
from monitor.estimation.allan.uncertainty import NOISES, CovarianceTable
from monitor.estimation.fit.coefficients_with_intervals import Coefficients, Status
from monitor.estimation.fit.fit_kernel import fit_axes
from monitor.estimation.fit.fit_kernel_types import (
    NO_MAPS,
    FitOptions,
    FitOutput,
    SharedInputs,
    VariancesAndSlopesOfAxes,
    empty_fit_output,
)
from monitor.estimation.fit.least_squares import R
from monitor.noise.standard_terms import unit_coefficient_allan_variances

TO_SI: Final = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
"""Powers of the sample rate that convert Q, N, B, K and R from units of one sample interval to SI units."""

PER_AXIS_FIELDS: Final = ("theta", "fitted", "edf", "entered", "left_out", "scatter", "misfit", "k_or_r")
"""Names of the fields of ``Fit`` with one column per axis, except the field ``coefficients``."""
THRESHOLDS_ONCE: Final = (2.33, 2.33)
"""Thresholds in σ to add and to drop a noise term in a single fit. The false-alarm probability is 1 %."""
THRESHOLDS_WATCHED: Final = (3.0, 1.5)
"""Thresholds in σ to add and to drop a noise term in repeated fits. The difference provides hysteresis."""


@dataclass(frozen=True, slots=True, eq=False)
class DesignMatrix:
    """Design matrix of the fit for given cluster sizes."""

    factors: Ints  # [m] cluster sizes in samples
    rate_hz: float
    columns: Floats  # [m, 5] Allan variance for each unit coefficient at τ0 = 1


@dataclass(frozen=True, slots=True)
class Fit:
    """Result of one fit of six axes."""

    coefficients: Coefficients
    theta: Floats  # [5, 6] fitted Q², N², B², K², R² in SI units; a negative Q² represents a limited bandwidth
    fitted: Floats  # [m, 6] Allan variance of the fitted model; NaN at a τ that is not used in the fit
    edf: Floats  # [m, 6] equivalent degrees of freedom of the measured Allan variance
    entered: NDArray[np.bool_]  # [5, 6] True for noise terms that are included in the fit
    left_out: Ints  # [6] number of averaging times that are left out of the fit, from the shortest τ
    scatter: Floats  # [6] mean squared residual, relative to the variance that the five noise terms explain
    misfit: Floats  # [6] equal to ``scatter`` if the residuals are significantly too large, otherwise 1
    k_or_r: NDArray[np.bool_]  # [6] True if the rate drifts, but K and R cannot be distinguished

    @property
    def poorly_fitted_axes(self) -> tuple[str, ...]:
        """Axes whose residuals are significantly too large, so that the fit does not describe the curve."""
        return tuple(axis for axis, misfit in zip(AXES, self.misfit, strict=True) if misfit > 1.0)


def make_design_matrix(factors: Ints, rate_hz: float) -> DesignMatrix:
    """Return the design matrix, whose columns are the Allan variances of the five noise terms.

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
    """Prepare the inputs of a fit that are the same for all axes.

    Parameters
    ----------
    design : DesignMatrix
        Design matrix of the fit.
    table : CovarianceTable
        Covariances of the Allan variances.
    ignored_direction : ndarray of float64, shape (m,), or None
        Change of the Allan variances that must not affect the fit, in units of one sample interval.
    may_drop_short_taus : bool
        True to leave out the shortest τ if they contradict the fit.
    """
    inputs = _make_default_inputs(design, table)
    if ignored_direction is not None:
        inputs = inputs._replace(ignored_direction=ignored_direction)
    return inputs if may_drop_short_taus else inputs._replace(may_drop_short_taus=False)


# a sensor repeats the fit with the same table, and the inputs are as large as the table
_inputs_of_tables: WeakKeyDictionary[CovarianceTable, tuple[DesignMatrix, SharedInputs]] = WeakKeyDictionary()


def _make_default_inputs(design: DesignMatrix, table: CovarianceTable) -> SharedInputs:
    known_design, known_inputs = _inputs_of_tables.get(table, (None, None))
    if known_inputs is not None and known_design is design:
        return known_inputs
    flat = design.columns.copy()
    # The measured slope includes noise, so its subtraction reduces the expected contribution of each noise term.
    flat[:, :NOISES] -= (2.0 * table.bend - table.slope) * design.columns[:, R, None]
    flat[:, ~design.columns.any(axis=0)] = 0.0  # zero columns represent terms that are not fitted
    nothing_ignored = np.zeros(design.factors.size)
    whole = table.terms.astype(np.float64)
    inputs = SharedInputs(design.columns, flat, table.covariance, whole, table.slope, nothing_ignored, True)
    _inputs_of_tables[table] = design, inputs
    return inputs


@dataclass(frozen=True, slots=True)
class MeasuredVariancesAndSlopes:
    """Measured Allan variances of k axes, and slopes of the rate in the same window."""

    avar: Floats  # [m, k] Allan variance in squared units of the axis; NaN if the window is too short
    terms: Ints  # [m, k] number of averaged second differences
    slope: Floats | None = None  # [k] ``batch.rate_slope_from_thirds`` in unit/s; None or NaN if unknown
    slopes: Floats | None = None  # [m, k] ``batch.rate_slope_per_tau`` in unit/s; if None, a strong drift biases K
    entered_before: NDArray[np.bool_] | None = None  # [5, k] ``entered`` of the previous fit; None for a single fit
    excess: Floats | None = None  # [m, k] field of ``AllanVariances``; None if no samples are missing

    def select_axis(self, column: int) -> "MeasuredVariancesAndSlopes":
        """Return the measured Allan variances and slopes of one axis."""
        one = slice(column, column + 1)
        slope = None if self.slope is None else self.slope[one]
        slopes = None if self.slopes is None else self.slopes[:, one]
        before = None if self.entered_before is None else self.entered_before[:, one]
        excess = None if self.excess is None else self.excess[:, one]
        return MeasuredVariancesAndSlopes(self.avar[:, one], self.terms[:, one], slope, slopes, before, excess)


def fit_coefficients(
    design: DesignMatrix,
    table: CovarianceTable,
    measured: MeasuredVariancesAndSlopes,
    full_covariance: bool = True,
    start_theta: Floats | None = None,
    ignored_direction: Floats | None = None,
    may_drop_short_taus: bool = True,
) -> Fit:
    """Fit the noise coefficients Q, N, B, K and R of k axes to overlapping Allan variances.

    In repeated fits, noise terms are added at 3 σ and dropped at 1.5 σ. In a single fit, both thresholds are 2.33 σ.

    Parameters
    ----------
    design : DesignMatrix
        Design matrix of the fit.
    table : CovarianceTable
        Covariances of the Allan variances.
    measured : MeasuredVariancesAndSlopes
        Measured Allan variances and slopes of the rate.
    full_covariance : bool
        True to weight by the covariances of all τ, False to weight by the variances alone.
    start_theta : ndarray of float64, shape (5, k), or None
        Field ``theta`` of a recent fit, from which the initial weights are computed. The fit is then three times as
        fast.
    ignored_direction : ndarray of float64, shape (m,), or None
        Change of the Allan variances that must not affect the fit, in units of one sample interval.
    may_drop_short_taus : bool
        True to leave out the shortest τ if they contradict the fit.
    """
    avar, terms, before = measured.avar, measured.terms, measured.entered_before
    m, axes = avar.shape
    found = empty_fit_output(
        axes, m, np.zeros((axes, 5), np.bool_) if before is None else np.array(before.T, order="C")
    )
    if start_theta is not None:
        found.theta[:] = start_theta.T / design.rate_hz ** (2.0 * TO_SI)
    curves, counts = np.ascontiguousarray(avar.T), np.ascontiguousarray(terms.T, np.float64)
    excess = np.zeros((axes, m)) if measured.excess is None else np.ascontiguousarray(measured.excess.T)
    slope = np.full(axes, np.nan) if measured.slope is None else measured.slope / design.rate_hz
    slopes = np.tile(slope, (m, 1)).T if measured.slopes is None else measured.slopes.T / design.rate_hz
    options = FitOptions(
        *(THRESHOLDS_ONCE if before is None else THRESHOLDS_WATCHED), full_covariance, start_theta is not None
    )
    shared = make_shared_inputs(design, table, ignored_direction, may_drop_short_taus)
    fit_axes(
        0,
        axes,
        shared,
        VariancesAndSlopesOfAxes(curves, counts, slope, np.array(slopes, order="C"), excess),
        options,
        found,
        NO_MAPS,
    )
    value, lo, hi, theta = np.empty((4, 5, axes))
    _convert_to_si(design.rate_hz, found, value, lo, hi, theta)
    return Fit(
        Coefficients(value, lo, hi, found.status.T), theta, found.fitted.T, found.edf.T, found.entered.T,
        found.left_out, found.scatter, found.misfit, found.either,
    )  # fmt: skip


@compiled
def _convert_to_si(rate_hz: float, output: FitOutput, value: Floats, lo: Floats, hi: Floats, theta: Floats) -> None:
    """Convert the results of all axes to SI units, in arrays of shape [5, axes]."""
    for a in range(5):
        to_si = rate_hz ** TO_SI[a]
        for axis in range(value.shape[1]):
            squared = output.theta[axis, a]
            estimated = output.status[axis, a] == 2
            value[a, axis] = np.sqrt(max(squared, 0.0)) * to_si if estimated else np.nan
            lo[a, axis], hi[a, axis] = output.lo[axis, a] * to_si, output.hi[axis, a] * to_si
            theta[a, axis] = squared * (to_si * to_si)


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

    def replace_axis_column(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
        result = parts[0].copy()
        result[..., axis] = parts[1][..., 0]
        return result

    return _combine((all_axes, axis_fit), replace_axis_column)


def concatenate_fits(fits: Sequence[Fit], axes: Sequence[int]) -> Fit:
    """Concatenate fits of different axes in the order of the axes.

    Parameters
    ----------
    fits : sequence of Fit
        Fits of one or more axes.
    axes : sequence of int
        Axis index of each column of the fits.
    """
    order = np.argsort(axes)
    return _combine(fits, lambda parts: np.concatenate(parts, axis=-1)[..., order])


def _combine(fits: Sequence[Fit], join: Callable[[Sequence[NDArray[Any]]], NDArray[Any]]) -> Fit:
    names = ("value", "lo", "hi", "status")
    coefficients = (join([getattr(one.coefficients, name) for one in fits]) for name in names)
    fields = {name: join([getattr(one, name) for one in fits]) for name in PER_AXIS_FIELDS}
    return Fit(Coefficients(*coefficients), **fields)


def empty_fit(avar: Floats) -> Fit:
    """Return a fit for Allan variances [m, 6] in which no coefficient is estimated."""
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
