"""Effect of missing samples on the width of the confidence intervals of the noise coefficients.

The same fit is repeated twice with the fitted model in place of the measured Allan variances: with the numbers of terms
and the excess of the actual missing samples, and with those of a complete record. Both fits therefore describe the same
noise and differ only in the covariances. The ratio of the widths does not contain the scatter of the measurement.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from drivers.data_types import Floats
from monitor.common.loss_of_samples import LossOfSamples
from monitor.estimation.allan.uncertainty import NOISES, CovarianceTable
from monitor.estimation.fit.coefficient_fit import (
    TO_SI,
    DesignMatrix,
    Fit,
    MeasuredVariancesAndSlopes,
    fit_coefficients,
    make_shared_inputs,
)
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Coefficients


class FitWithInputs(NamedTuple):
    """Fit of k axes with the same number of samples."""

    design: DesignMatrix
    table: CovarianceTable
    measured: MeasuredVariancesAndSlopes
    fit: Fit


def loss_of_samples(missing_shares: Floats, fits: Sequence[FitWithInputs]) -> LossOfSamples:
    """Return the share of missing samples and the widening of the intervals.

    Parameters
    ----------
    missing_shares : ndarray of float64, shape (6,)
        Share of missing samples of each axis. Axes without samples are ignored.
    fits : sequence of FitWithInputs
        Fits of all axes.
    """
    measured_shares = missing_shares[missing_shares < 1.0]
    share = float(measured_shares.max(initial=0.0))
    if share == 0.0 or not fits:
        return LossOfSamples(share, {})
    widening = np.concatenate([_interval_widening(*one) for one in fits], axis=1)
    known = np.isfinite(widening)
    largest = np.where(known, widening, 0.0).max(axis=1, initial=0.0)
    return LossOfSamples(
        share,
        {symbol: float(one) for symbol, one, any_known in zip(SYMBOLS, largest, known.any(axis=1), strict=True)
         if any_known},
    )  # fmt: skip


def _interval_widening(
    design: DesignMatrix, table: CovarianceTable, measured: MeasuredVariancesAndSlopes, fit: Fit
) -> Floats:
    """Return the relative increase [5, k] of the width of each interval, NaN if there is no interval."""
    theta = fit.theta / design.rate_hz ** (2.0 * TO_SI)[:, None]
    # a slope of zero removes the drift from both fits
    model = make_shared_inputs(design, table).flat[:, :NOISES] @ theta[:NOISES]
    used = np.isfinite(fit.fitted)
    zero = np.zeros(model.shape[1])
    expected = replace(
        measured,
        avar=np.where(used, model, np.nan),
        slope=zero,
        slopes=np.zeros(model.shape),
        entered_before=fit.entered,
    )
    complete = replace(expected, terms=np.where(used, table.terms[:, None], 0), excess=None)
    widths = [
        _widths(fit_coefficients(design, table, one, start_theta=fit.theta).coefficients)
        for one in (expected, complete)
    ]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(widths[0] / widths[1] - 1.0)


def _widths(coefficients: Coefficients) -> Floats:
    return coefficients.hi - coefficients.lo
