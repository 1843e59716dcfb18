"""Results of the compensation of a recording."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from monitor.drift.compensation.arma import Arma
from monitor.drift.compensation.compensation_score import AtRest
from monitor.drift.compensation.compensator import Interval


@dataclass(frozen=True, slots=True)
class Axis:
    """Compensation of one gyro axis, evaluated at rest on samples that were not used for learning before."""

    model: Arma | None  # last identified model of the drift; None if there was too little rest
    before: AtRest  # without compensation, minus the mean of the first third
    after: AtRest  # with compensation
    left_out: int  # number of rejected intervals, which no drift explains
    steps: int  # number of steps of the bias


@dataclass(frozen=True, slots=True)
class Result:
    """Compensation of one recording."""

    recording: str
    out: Path  # compensated recording
    method: str
    rate_hz: float
    samples: int
    interval_s: float
    learned_s: float  # time at rest in the first third, s
    judged_s: float  # time at rest after the first third, s
    intervals: tuple[Interval, ...]
    axes: Mapping[str, Axis]
    notes: tuple[str, ...]
