"""Results of the drift compensation of a recording."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from monitor.drift.compensation.arma import ArmaModel
from monitor.drift.compensation.compensation_score import RateQualityAtRest
from monitor.drift.compensation.compensator import MeasuredAndPredictedDrift


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
