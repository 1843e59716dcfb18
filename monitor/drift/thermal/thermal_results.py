"""Reports on thermal models that are fitted to a recording or predict the bias in another recording."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import Floats
from drivers.validation.number_ranges import HOUR_S
from monitor.drift.thermal.interval_means import IntervalMeans
from monitor.drift.thermal.thermal_fit import ThermalFit
from monitor.drift.thermal.thermal_model import ThermalModel, ThermalPrediction, predict_interval_means

DEFAULT_INTERVALS: Final = 72
"""Default number of intervals into which a recording is divided. Wang et al. use 72 intervals of 1 h."""
ROUND_INTERVALS_S: Final = (
    *(0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 20, 30),
    *(60 * minutes for minutes in (1, 2, 5, 10, 15, 20, 30)),
    *(HOUR_S * hours for hours in (1, 2, 4)),
)


@dataclass(frozen=True, slots=True)
class ThermalFitReport:
    """Thermal models that were fitted to a recording."""

    recording: str
    interval_s: float
    means: Mapping[str, IntervalMeans]
    fits: Mapping[str, ThermalFit]
    refused: Mapping[str, str]  # reason why no model was fitted, by axis
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ThermalPredictionErrors:
    """Prediction errors of a thermal model for interval means of the bias."""

    multi_step: ThermalPrediction
    one_step: ThermalPrediction
    offset: float  # mean of measured minus multi-step bias, which differs after each start of the sensor
    rms: float  # rms of measured minus multi-step bias, rad/s or m/s²
    rms_without_offset: float  # rms of measured minus multi-step bias minus ``offset``
    rms_one_step: float  # rms of measured minus one-step bias
    rms_about_mean: float  # rms of the measured bias about its mean
    coverage: float  # share of interval means inside the multi-step prediction interval


@dataclass(frozen=True, slots=True)
class ThermalPredictionReport:
    """Prediction errors of the thermal models of all axes in a recording."""

    recording: str
    interval_s: float
    means: Mapping[str, IntervalMeans]
    judged: Mapping[str, ThermalPredictionErrors]
    refused: Mapping[str, str]
    notes: tuple[str, ...] = ()


def compare_model_with_means(model: ThermalModel, means: IntervalMeans) -> ThermalPredictionErrors:
    """Compare the predictions of a thermal model with interval means that were not used for the fit.

    Parameters
    ----------
    model : ThermalModel
        Fitted model.
    means : IntervalMeans
        Interval means of the bias (rad/s or m/s²) and of the temperature (°C).
    """
    multi, known = predict_interval_means(model, means.temperature_c), means.both_known
    residual = means.bias - multi.bias
    offset = float(residual[known].mean())
    one = predict_interval_means(model, means.temperature_c, means.bias - offset)
    inside = (means.bias >= multi.lo) & (means.bias <= multi.hi)
    return ThermalPredictionErrors(
        multi,
        ThermalPrediction(one.bias + offset, one.lo + offset, one.hi + offset),
        offset,
        _rms(residual[known]),
        _rms(residual[known] - offset),
        _rms((means.bias - offset - one.bias)[known]),
        _rms(means.bias[known] - means.bias[known].mean()),
        float(inside[known].mean()),
    )


def choose_interval_s(recording_s: float, rate_hz: float) -> float:
    """Choose a round interval length in seconds that divides a recording into about DEFAULT_INTERVALS intervals.

    Parameters
    ----------
    recording_s : float
        Length of the recording in seconds.
    rate_hz : float
        Sample rate in Hz.

    Examples
    --------
    >>> choose_interval_s(72 * 3600.0, 100.0), choose_interval_s(8784.0, 4.16), choose_interval_s(60.0, 100.0)
    (3600, 120, 0.5)
    """
    most = max(recording_s / DEFAULT_INTERVALS, 1.0 / rate_hz) * 1.01
    return max((one for one in ROUND_INTERVALS_S if 1.0 / rate_hz <= one <= most), default=1.0 / rate_hz)


def _rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(x**2)))
