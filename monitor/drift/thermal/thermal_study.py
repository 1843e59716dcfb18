"""What was fitted in one recording, and what models expect of another."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.drift.thermal.interval_means import Means
from monitor.drift.thermal.thermal_fit import ThermalFit
from monitor.drift.thermal.thermal_model import Prediction, ThermalModel, predicted

INTERVALS: Final = 72
"""In a recording, unless an interval is given: the number of the paper, 72 h by the hour."""
NICE_S: Final = (0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 20, 30, 60, 120, 300, 600, 900, 1200, 1800, 3600, 7200, 14400)


@dataclass(frozen=True, slots=True)
class Study:
    """What was fitted in one recording."""

    recording: str
    interval_s: float
    means: Mapping[str, Means]
    fits: Mapping[str, ThermalFit]
    refused: Mapping[str, str]  # axis -> why
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Judged:
    """A model beside the means of a recording."""

    multi_step: Prediction
    one_step: Prediction
    offset: float  # mean of measured less multi-step: a bias changes from one start to the next
    rms: float  # of measured less multi-step, rad/s or m/s²
    rms_moved: float  # the same once the offset is taken out
    rms_one_step: float
    rms_alone: float  # of measured about its mean
    within: float  # share of means inside the multi-step interval


@dataclass(frozen=True, slots=True)
class Outlook:
    """What models expect of a recording."""

    recording: str
    interval_s: float
    means: Mapping[str, Means]
    judged: Mapping[str, Judged]
    refused: Mapping[str, str]
    notes: tuple[str, ...] = ()


def judge(model: ThermalModel, means: Means) -> Judged:
    """A model beside means that did not choose it."""
    multi, known = predicted(model, means.temperature_c), means.known
    apart = means.bias - multi.bias
    offset = float(apart[known].mean())
    one = predicted(model, means.temperature_c, means.bias - offset)
    inside = (means.bias >= multi.lo) & (means.bias <= multi.hi)
    return Judged(
        multi,
        Prediction(one.bias + offset, one.lo + offset, one.hi + offset),
        offset,
        _rms(apart[known]),
        _rms(apart[known] - offset),
        _rms((means.bias - offset - one.bias)[known]),
        _rms(means.bias[known] - means.bias[known].mean()),
        float(inside[known].mean()),
    )


def nice_interval(seconds: float, rate_hz: float) -> float:
    """A round interval of which a recording has about INTERVALS.

    >>> nice_interval(72 * 3600.0, 100.0), nice_interval(8784.0, 4.16), nice_interval(60.0, 100.0)
    (3600, 120, 0.5)
    """
    most = max(seconds / INTERVALS, 1.0 / rate_hz) * 1.01
    return max((one for one in NICE_S if 1.0 / rate_hz <= one <= most), default=1.0 / rate_hz)


def _rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(x**2)))
