"""Score that measures the quality of a compensated gyro rate at rest.

Samples from which the drift model was learned are not evaluated. Their mean is subtracted from the uncompensated rate,
so that removing a constant bias does not count as an improvement.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.drift.compensation.arma import ArmaModel
from monitor.drift.compensation.gyro_drift_compensator import MeasuredAndPredictedDrift
from monitor.estimation.allan.batch import cluster_sizes, overlapping_avar_axis

MINUTE_S: Final = 60.0
SPANS_S: Final = (60.0, 600.0, 3600.0)
"""Periods in seconds over which the rate is averaged to measure the remaining drift."""


@dataclass(frozen=True, slots=True)
class RateQualityAtRest:
    """Quality measures of the rate of a gyro axis at rest, in rad/s.

    A measure is NaN if the recording is too short.
    """

    rms: float  # rms of the rate about zero
    worst_minute: float  # largest rms of the rate within one minute
    drift: tuple[float, ...]  # rms of the mean rate over each period of SPANS_S
    tau_s: Floats  # [k] averaging times
    allan: Floats  # [k] overlapping Allan deviation of the rate


def score_at_rest(angular_rate: Floats, rate_hz: float) -> RateQualityAtRest:
    """Compute the quality measures of an angular rate whose true value is zero.

    Parameters
    ----------
    angular_rate : ndarray, shape (n,)
        Rate in rad/s; NaN means missing or not at rest.
    rate_hz : float
        Sample rate in Hz.
    """
    sizes: Ints = cluster_sizes(angular_rate.size, rate_hz)
    allan, _ = overlapping_avar_axis(angular_rate, sizes)
    minutes = _span_means(angular_rate**2, round(MINUTE_S * rate_hz))
    return RateQualityAtRest(
        rms=_rms(angular_rate),
        worst_minute=float(np.sqrt(minutes.max())) if minutes.size else np.nan,
        drift=tuple(_rms(_span_means(angular_rate, round(span * rate_hz))) for span in SPANS_S),
        tau_s=sizes / rate_hz,
        allan=np.sqrt(allan),
    )


def _span_means(x: Floats, samples: int) -> Floats:
    """Return the means over successive periods, except periods in which more than half of the samples are missing."""
    count = x.size // samples if samples else 0
    if not count:
        return np.zeros(0)
    rows = x[: count * samples].reshape(count, samples)
    known_count = np.isfinite(rows).sum(axis=1)
    rows = rows[2 * known_count >= samples]
    return np.nanmean(rows, axis=1) if len(rows) else np.zeros(0)


def _rms(x: Floats) -> float:
    known = x[np.isfinite(x)]
    return float(np.sqrt(np.mean(known**2))) if known.size else np.nan


@dataclass(frozen=True, slots=True)
class AxisCompensation:
    """Quality of the drift compensation of one gyro axis, measured at rest."""

    model: ArmaModel | None  # last identified drift model; None if the sensor was not at rest for long enough
    uncompensated: RateQualityAtRest  # score without compensation, after subtraction of the mean of the first third
    compensated: RateQualityAtRest  # score with compensation
    rejected_intervals: int  # number of intervals that were rejected as outliers
    steps: int  # number of bias steps


@dataclass(frozen=True, slots=True)
class DriftCompensationResult:
    """Result of the drift compensation of a recording."""

    recording: str
    out: Path  # path of the compensated recording
    method: str
    rate_hz: float
    samples: int
    interval_s: float
    learning_rest_s: float  # time at rest in the first third of the recording, s
    evaluated_rest_s: float  # time at rest in the rest of the recording, s
    intervals: tuple[MeasuredAndPredictedDrift, ...]
    axes: Mapping[str, AxisCompensation]
    notes: tuple[str, ...]
