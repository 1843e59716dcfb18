"""Recursive least-squares fit, which updates the coefficients of a thermal model with each interval.

The triangular factor R of a QR decomposition represents the regressors and values of all intervals and is updated with
each interval (Golub & Van Loan, Matrix Computations, 6.5). Except for rounding errors, the coefficients equal those of
a least-squares fit to all intervals. Additional columns of R contain the derivatives of the bias with respect to the
time constants. The prediction intervals therefore include the uncertainty of the time constants. The time constants and
the residual correlation φ are not updated.
"""

from dataclasses import dataclass, replace

import numpy as np

from drivers.data_types import Floats
from monitor.common.distributions import student_quantile
from monitor.drift.thermal.interval_means import IntervalMeans
from monitor.drift.thermal.thermal_fit import Whitening
from monitor.drift.thermal.thermal_model import (
    LOG_TIME_CONSTANT_STEP,
    ThermalModel,
    coefficient_covariance,
    combine_regressor_derivatives,
    interpolate_missing_temperatures,
    predict_bias_and_variance,
    regressor_derivatives_by_log_time_constant,
)
from monitor.drift.thermal.thermal_response import ThermalModelForm, build_regressors, solve_least_squares


@dataclass(frozen=True, slots=True)
class PredictionInterval:
    """Predicted mean bias in one interval, with a 95 % prediction interval, in rad/s or m/s²."""

    bias: float
    lo: float
    hi: float

    def side_of_interval(self, bias: float) -> int:
        """Return 1 if a bias lies above the prediction interval, -1 if it lies below, and 0 otherwise."""
        return int(bias > self.hi) - int(bias < self.lo)


class RecursiveThermalFit:
    """Thermal model whose coefficients are updated recursively.

    Parameters
    ----------
    model : ThermalModel
        Thermal model that provides the terms, time constants, φ and reference temperature.
    means : IntervalMeans
        Interval means to which the coefficients are fitted initially.
    """

    def __init__(self, model: ThermalModel, means: IntervalMeans) -> None:
        self._model = model
        shape = model.shape
        k = self._k = shape.difference_equation_order
        self._terms = 1 + shape.powers + k
        excess = interpolate_missing_temperatures(means.temperature_c) - model.reference_c
        columns = build_regressors(shape, excess, model.interval_s, with_initial_state=True)
        rows = np.hstack([columns, regressor_derivatives_by_log_time_constant(shape, excess, model.interval_s)])
        near = np.multiply.outer(
            np.exp([-LOG_TIME_CONSTANT_STEP, 0.0, LOG_TIME_CONSTANT_STEP]), np.asarray(shape.constants_s)
        )
        # The rows [3, k] are for slightly shorter, exact and slightly longer time constants.
        self._decays = np.exp(-model.interval_s / near)
        moved = [
            build_regressors(ThermalModelForm(0, tuple(one)), excess, model.interval_s, with_initial_state=True)[-1, 1:]
            for one in near
        ]
        # Both arrays [3, k] hold the state after the last interval.
        self._lags, self._initial_responses = np.hsplit(np.array(moved).reshape(3, 2 * k), 2)
        self._excess = float(excess[-1])
        self._row, self._bias = rows[-1], float(means.bias[-1]) if means.both_known[-1] else np.nan
        whitening = Whitening(means.both_known, model.phi)
        white, z = whitening.whiten(rows), whitening.whiten(np.where(means.both_known, means.bias, 0.0))
        self._triangle = _upper_triangle(np.hstack([white, z[:, None]]))
        self._count = int(means.both_known.sum())
        self.model = self._with_current_coefficients(
            float(np.nanmin(means.temperature_c)), float(np.nanmax(means.temperature_c))
        )

    @property
    def degrees_of_freedom(self) -> int:
        """Return the residual degrees of freedom."""
        taken = self._terms + 2 * self._k + (self._model.phi > 0.0)
        return max(self._count - taken, 1)

    def predict_multi_and_one_step(self, temperature_c: float) -> tuple[PredictionInterval, PredictionInterval]:
        """Return the multi-step and the one-step prediction for the next interval at a temperature in °C.

        Because the number of intervals may be small, the prediction intervals are based on Student's t distribution.
        """
        model = self.model
        excess = np.array([self._excess, temperature_c - model.reference_c if np.isfinite(temperature_c) else np.nan])
        excess[1] = excess[0] if np.isnan(excess[1]) else excess[1]
        row, _, _ = self._next_row(float(excess[1]), model.temperature_range_from_reference_c)
        rows = np.stack([self._row, row])
        sizes = np.concatenate([model.coefficients, model.initial_state])
        own = sizes.size
        bends = combine_regressor_derivatives(model.shape, rows[:, own:], sizes)
        wide = student_quantile(self.degrees_of_freedom, 0.975)
        both = []
        for measured in (None, np.array([self._bias, np.nan])):
            bias, variance = predict_bias_and_variance(model, excess, rows[:, :own], sizes, bends, measured)
            at, half = float(bias[1]), wide * float(variance[1]) ** 0.5
            both.append(PredictionInterval(at, at - half, at + half))
        return both[0], both[1]

    def add_interval(self, temperature_c: float, bias: float) -> None:
        """Update the coefficients with the mean temperature and the mean bias of an interval.

        Parameters
        ----------
        temperature_c : float
            Mean temperature in °C; NaN means not measured.
        bias : float
            Mean bias in rad/s or m/s²; NaN means not measured.
        """
        model = self.model
        known = bool(np.isfinite(temperature_c) and np.isfinite(bias))
        excess = temperature_c - model.reference_c if np.isfinite(temperature_c) else self._excess
        row, lags, left = self._next_row(excess, None)
        if known:
            follows = np.isfinite(self._bias)
            white = row - model.phi * self._row if follows else row * (1.0 - model.phi**2) ** 0.5
            z = bias - model.phi * self._bias if follows else bias * (1.0 - model.phi**2) ** 0.5
            stacked = np.vstack([self._triangle, np.append(white, z)])
            self._triangle = _upper_triangle(stacked)
            self._count += 1
        self._row, self._lags, self._initial_responses, self._excess = row, lags, left, excess
        self._bias = bias if known else np.nan
        if known:
            lowest, highest = min(model.lowest_c, temperature_c), max(model.highest_c, temperature_c)
            self.model = self._with_current_coefficients(lowest, highest)

    def _next_row(self, excess: float, ends: tuple[float, float] | None) -> tuple[Floats, Floats, Floats]:
        """Return the regressors for the next interval, the updated lags, and the updated initial-state responses."""
        lags = self._decays * self._lags + (1.0 - self._decays) * excess
        left = self._initial_responses * self._decays
        shape = replace(self._model.shape, constants_s=())
        first = build_regressors(shape, np.array([excess]), self._model.interval_s, range_c=ends)[0]
        by = [(one[2] - one[0]) / (2.0 * LOG_TIME_CONSTANT_STEP) for one in (lags, left)]
        return np.concatenate([first, lags[1], left[1], *by]), lags, left

    def _with_current_coefficients(self, lowest_c: float, highest_c: float) -> ThermalModel:
        """Return the thermal model with coefficients that are fitted to all intervals so far."""
        own = self._terms + self._k
        x, z = self._triangle[:, :own], self._triangle[:, -1]
        sizes = solve_least_squares(x, z)
        square = max(float(((z - x @ sizes) ** 2).sum()), 1e-300)
        sigma = (square / self.degrees_of_freedom) ** 0.5
        bends = combine_regressor_derivatives(self._model.shape, self._triangle[:, own:-1], sizes)
        return replace(
            self._model,
            coefficients=sizes[: self._terms],
            initial_state=sizes[self._terms :],
            sigma=sigma,
            covariance=coefficient_covariance(np.hstack([x, bends]), sigma),
            lowest_c=lowest_c,
            highest_c=highest_c,
        )


def _upper_triangle(rows: Floats) -> Floats:
    return np.asarray(np.linalg.qr(rows, mode="r"))
