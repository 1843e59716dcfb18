"""Thermal model of a bias with coefficients and uncertainties, which predicts interval means from the temperature.

A multi-step prediction uses only the temperature. A one-step prediction also uses the bias of the previous interval.
The prediction intervals take into account the scatter of the interval means and the uncertainty of the coefficients and
time constants.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.distributions import Z95
from monitor.drift.thermal.interval_means import interpolate_missing_temperatures
from monitor.drift.thermal.thermal_response import (
    ThermalModelForm,
    build_regressors,
    compute_lag_roots,
    difference_equation_coefficients,
    temperature_beyond_range,
)

LOG_TIME_CONSTANT_STEP: Final = 1e-3
"""Step of the logarithm of a time constant that is used to compute numerical derivatives."""


@dataclass(frozen=True, slots=True)
class ThermalModel:
    """Model of the bias of an axis as a function of the temperature and its history."""

    shape: ThermalModelForm
    interval_s: float
    reference_c: float  # reference temperature at which the constant applies, °C
    coefficients: Floats  # [terms] coefficients of the constant, powers and lags, in rad/s or m/s² per power of °C
    initial_state: Floats  # [k] initial state of each lag at the start of the fit, rad/s or m/s²
    phi: float  # correlation between the residuals of successive intervals
    sigma: float  # standard deviation of the one-step residuals, rad/s or m/s²
    covariance: Floats  # covariance matrix of coefficients, initial state and log time constants
    lowest_c: float  # lowest temperature in the fit, °C
    highest_c: float  # highest temperature in the fit, °C

    @property
    def residual_std(self) -> float:
        """Return the standard deviation of the multi-step residuals in rad/s or m/s²."""
        return float(self.sigma / (1.0 - self.phi**2) ** 0.5)

    @property
    def mean_bias_slope(self) -> float:
        """Return the mean change of the bias per °C, in rad/s or m/s², after all lags have settled."""
        powers = self.shape.powers
        return float(self.coefficients[1 : 1 + powers] @ self._chords + self.coefficients[1 + powers :].sum())

    @property
    def slope_gradient(self) -> Floats:
        """Return the derivatives of ``mean_bias_slope`` with respect to the parameters of ``covariance``."""
        gradient = np.zeros(self.covariance.shape[0])
        gradient[1 : 1 + self.shape.powers] = self._chords
        gradient[1 + self.shape.powers : self.coefficients.size] = 1.0
        return gradient

    @property
    def _chords(self) -> Floats:
        """Return the mean slope of each power of the temperature over the range of the fit."""
        (lo, hi), powers = self.temperature_range_from_reference_c, np.arange(1, self.shape.powers + 1)
        return np.asarray((hi**powers - lo**powers) / (hi - lo))

    @property
    def equation(self) -> dict[str, list[float] | float] | None:
        """Return the coefficients a, b and c of the difference equation, or None for polynomials above order 1."""
        if self.shape.powers > 1:
            return None
        a, b, c = difference_equation_coefficients(self.shape, self.coefficients, self.interval_s)
        return {"a": a.tolist(), "b": b.tolist(), "c": c}

    @property
    def temperature_range_from_reference_c(self) -> tuple[float, float]:
        """Return the lowest and the highest temperature in the fit, relative to the reference temperature, in °C."""
        return self.lowest_c - self.reference_c, self.highest_c - self.reference_c


@dataclass(frozen=True, slots=True)
class ThermalPrediction:
    """Predicted interval means, with 95 % prediction intervals."""

    bias: Floats  # [n] predicted mean bias, rad/s or m/s²
    lo: Floats  # [n] lower end of the 95 % prediction interval for the measured mean
    hi: Floats  # [n]


def predict_interval_means(
    model: ThermalModel, temperature_c: Floats, measured_bias: Floats | None = None, starts_with_fit: bool = False
) -> ThermalPrediction:
    """Predict interval means of the bias by multi-step or one-step prediction.

    Outside the temperature range of the fit, each power of the temperature is extrapolated linearly. The extrapolated
    change is added to the uncertainty.

    Parameters
    ----------
    model : ThermalModel
        Fitted thermal model.
    temperature_c : ndarray, shape (n,)
        Mean temperature of each interval, °C; NaN means missing.
    measured_bias : ndarray, shape (n,), or None
        Measured bias in each interval in rad/s or m/s², which one-step predictions require. None selects multi-step
        predictions.
    starts_with_fit : bool
        True if the first interval is also the first interval of the fit, so that the initial state is known. Otherwise,
        the temperature before the first interval is assumed to be constant, which increases the uncertainty.
    """
    excess = interpolate_missing_temperatures(temperature_c) - model.reference_c
    columns = build_regressors(
        model.shape, excess, model.interval_s, with_initial_state=True, range_c=model.temperature_range_from_reference_c
    )
    k = model.shape.difference_equation_order
    if not starts_with_fit:
        columns[:, columns.shape[1] - k :] = 0.0
    sizes = np.concatenate([model.coefficients, model.initial_state if starts_with_fit else np.zeros(k)])
    bias, variance = predict_bias_and_variance(
        model, excess, columns, sizes, bias_derivatives_by_log_time_constant(model, excess, sizes), measured_bias
    )
    if not starts_with_fit and k:
        swing = (model.highest_c - model.lowest_c) / 12.0**0.5
        lags = model.coefficients[1 + model.shape.powers :]
        p = compute_lag_roots(model.shape, model.interval_s)
        variance += ((lags * swing) ** 2 * p ** (2.0 * np.arange(excess.size)[:, None])).sum(axis=1)
    half = Z95 * np.sqrt(variance)
    return ThermalPrediction(bias, bias - half, bias + half)


def predict_bias_and_variance(
    model: ThermalModel,
    excess_c: Floats,
    regressors: Floats,
    coefficients: Floats,
    derivatives: Floats,
    measured_bias: Floats | None,
) -> tuple[Floats, Floats]:
    """Predict the bias in successive intervals, and return the prediction and the variance of its errors.

    Parameters
    ----------
    model : ThermalModel
        Fitted thermal model.
    excess_c : ndarray, shape (n,)
        Temperature relative to the reference temperature, °C.
    regressors : ndarray, shape (n, terms + k)
        Result of ``build_regressors``.
    coefficients : ndarray, shape (terms + k,)
        Coefficients of the regressors.
    derivatives : ndarray, shape (n, k)
        Result of ``bias_derivatives_by_log_time_constant``.
    measured_bias : ndarray, shape (n,), or None
        Measured bias in rad/s or m/s², which one-step predictions require. None selects multi-step predictions.

    Returns
    -------
    bias : ndarray, shape (n,)
        Predicted bias in rad/s or m/s².
    variance : ndarray, shape (n,)
        Variance of the prediction errors, in the squared unit of the bias.
    """
    bias = regressors @ coefficients
    rows = np.hstack([regressors, derivatives])
    sigma = np.full(excess_c.size, model.residual_std)
    if measured_bias is not None:
        known = np.isfinite(measured_bias[:-1])
        last = np.where(known, measured_bias[:-1] - bias[:-1], 0.0)
        rows[1:] -= model.phi * known[:, None] * rows[:-1]
        bias[1:] += model.phi * last
        sigma[1:][known] = model.sigma
    variance = np.einsum("ij,jk,ik->i", rows, model.covariance, rows) + sigma**2
    variance += (
        model.mean_bias_slope * temperature_beyond_range(excess_c, model.temperature_range_from_reference_c)
    ) ** 2
    return bias, variance


def bias_derivatives_by_log_time_constant(model: ThermalModel, excess_c: Floats, coefficients: Floats) -> Floats:
    """Return the derivatives [n, k] of the bias with respect to the logarithms of the time constants.

    Parameters
    ----------
    model : ThermalModel
        Fitted thermal model.
    excess_c : ndarray, shape (n,)
        Temperature relative to the reference temperature, °C.
    coefficients : ndarray, shape (terms + k,)
        Coefficients of the regressors.
    """
    shape = model.shape
    less, more = (
        build_regressors(
            ThermalModelForm(0, tuple(one * np.exp(by) for one in shape.constants_s)),
            excess_c,
            model.interval_s,
            with_initial_state=True,
        )
        for by in (-LOG_TIME_CONSTANT_STEP, LOG_TIME_CONSTANT_STEP)
    )
    derivatives = (more - less)[:, 1:] / (2.0 * LOG_TIME_CONSTANT_STEP)
    k, first = shape.difference_equation_order, 1 + shape.powers
    return np.asarray(
        derivatives[:, :k] * coefficients[first : first + k] + derivatives[:, k:] * coefficients[first + k :]
    )
