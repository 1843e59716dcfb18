"""Results of the compensation of a recording."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from monitor.drift.compensation.arma import ArmaModel
from monitor.drift.compensation.compensation_score import RestScore
from monitor.drift.compensation.compensator import DriftInterval


@dataclass(frozen=True, slots=True)
class AxisCompensation:
    """Quality of the drift compensation of a gyro axis at rest."""

    model: ArmaModel | None  # last identified model of the drift; None if there was too little rest
    uncompensated: RestScore  # without compensation, minus the mean of the first third
    compensated: RestScore  # with compensation
    rejected_intervals: int  # number of intervals that were rejected as outliers
    steps: int  # number of steps of the bias


@dataclass(frozen=True, slots=True)
class DriftCompensationResult:
    """Result of the drift compensation of a recording."""

    recording: str
    out: Path  # compensated recording
    method: str
    rate_hz: float
    samples: int
    interval_s: float
    learning_rest_s: float  # time at rest in the first third, s
    evaluated_rest_s: float  # time at rest after the first third, s
    intervals: tuple[DriftInterval, ...]
    axes: Mapping[str, AxisCompensation]
    notes: tuple[str, ...]
