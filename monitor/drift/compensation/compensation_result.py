"""What compensation made of a recording."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from monitor.drift.compensation.arma import Arma
from monitor.drift.compensation.compensation_score import AtRest
from monitor.drift.compensation.compensator import Interval


@dataclass(frozen=True, slots=True)
class Axis:
    """One gyro axis at rest, on samples that taught nothing before they were compensated."""

    model: Arma | None  # of its drift, as identified last; None: not enough at rest
    before: AtRest  # the mean of the first third taken out
    after: AtRest
    left_out: int  # intervals that no drift explains
    steps: int  # of the bias


@dataclass(frozen=True, slots=True)
class Result:
    """What was done."""

    recording: str
    out: Path
    method: str
    rate_hz: float
    samples: int
    interval_s: float
    learned_s: float  # at rest, in the first third
    judged_s: float  # at rest, after it
    intervals: tuple[Interval, ...]
    axes: Mapping[str, Axis]
    notes: tuple[str, ...]
