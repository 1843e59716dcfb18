"""Table of the kinds of results that a device produces.

For each kind of result, ``RESULT_KINDS`` names the messages that publish the result and the viewer panels that draw it.
To add a kind of result, add an entry to ``RESULT_KINDS``, a message in ``monitor.publishing.messages.results`` and a
panel in ``monitor.publishing.rerun.panels``. This module does not import Rerun.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

from drivers.data_types import Event, Floats
from monitor.common.device_health import Health
from monitor.drift.compensation.live_compensation import MeasuredAndSubtractedDrift
from monitor.drift.thermal.live_thermal import ThermalIntervalResult
from monitor.estimation.detection.comparison_with_noise_model import ModelComparison
from monitor.estimation.estimate import Estimate, concatenate_successive_coefficients
from monitor.publishing.messages.message import Message
from monitor.publishing.messages.results import (
    AllanMessage,
    CoefficientsMessage,
    EventMessage,
    ModelGapMessage,
    StatusMessage,
    ThermalPredictionMessage,
    TotalAndHadamardCurves,
    TotalAndHadamardMessage,
)

POINT_INTERVAL_S: Final = 1.0
"""Shortest interval between two estimates in a time series of the viewer [s]."""
SAMPLES_PERIOD_S: Final = 0.5
"""Interval between two batches of samples in the viewer [s]. Each batch of an axis costs more than its samples."""
SERIES_PERIOD_S: Final = 5.0
"""Interval between two batches of a slow time series in the viewer [s]."""
SMALL_RESULT_BYTES: Final = 1000
"""Approximate memory size of a result without large arrays."""

TimedResult = tuple[float, Any]
"""Unix time [s] and the result at this time."""
Merge = Callable[[list[TimedResult], TimedResult], None]
"""Function that merges a new result into the results that wait to be drawn."""


@dataclass(frozen=True, slots=True)
class SampleBatch:
    """Batch of inertial samples of one device."""

    unix_s: Floats  # [n]
    values: Floats  # [n, 6] rad/s and m/s²; NaN if not measured
    temperature_c: Floats  # [n] NaN if not measured


@dataclass(frozen=True, slots=True)
class CompensatedRateBatch:
    """Batch of angular rates of one device after drift removal."""

    unix_s: Floats  # [n]
    values: Floats  # [n, 3] rad/s


@dataclass(frozen=True, slots=True)
class AllDevicesTableText:
    """Markdown text of the table that lists all devices."""

    text: str


def keep_all(waiting: list[TimedResult], new: TimedResult) -> None:
    """Append the new result, so that the viewer draws every result.

    Parameters
    ----------
    waiting
        Results that wait to be drawn, modified in place.
    new
        Result to add.
    """
    waiting.append(new)


def keep_newest(waiting: list[TimedResult], new: TimedResult) -> None:
    """Replace all waiting results with the new result. The parameters are those of ``keep_all``."""
    waiting[:] = [new]


def keep_newest_and_spaced(waiting: list[TimedResult], new: TimedResult) -> None:
    """Append the new result, and drop the previous result if the remaining results are closely spaced.

    The previous result is dropped if the new result is less than POINT_INTERVAL_S newer than the result before the
    previous one. The new estimate takes over the coefficient history of a dropped estimate. The parameters are those of
    ``keep_all``.
    """
    if len(waiting) > 1 and new[0] - waiting[-2][0] < POINT_INTERVAL_S:
        _, previous = waiting.pop()
        if isinstance(previous, Estimate):
            unix_s, estimate = new
            histories = [one for one in (previous.history, estimate.history) if one is not None]
            new = unix_s, replace(estimate, history=concatenate_successive_coefficients(histories))
    waiting.append(new)


@dataclass(frozen=True, slots=True)
class DrawingSchedule:
    """Rule for drawing one kind of result in one panel of the viewer."""

    panel: str
    """Name of the panel class in ``monitor.publishing.rerun.panels``."""
    merge: Merge = keep_all
    period_s: float = 0.0
    """Shortest interval between two drawings for the same device [s]."""
    shares_rate: bool = False
    """True if all devices share one drawing rate, so that ``period_s`` increases with the number of devices."""


@dataclass(frozen=True, slots=True)
class ResultKind:
    """Messages, drawing rules and size of one kind of result."""

    result: type
    """Class of the results of this kind."""
    messages: tuple[type[Message], ...] = ()
    drawings: tuple[DrawingSchedule, ...] = ()
    size_bytes: Callable[[Any], int] = lambda _result: SMALL_RESULT_BYTES
    """Function that returns the approximate memory size of a result, for the limit of the viewer's queue."""


RESULT_KINDS: Final = (
    ResultKind(
        SampleBatch,
        drawings=(DrawingSchedule("SamplesAndTemperaturePanel", period_s=SAMPLES_PERIOD_S),),
        size_bytes=lambda one: one.unix_s.nbytes + one.values.nbytes + one.temperature_c.nbytes,
    ),
    ResultKind(Event, (EventMessage,), (DrawingSchedule("EventsPanel"),)),
    ResultKind(Health, (StatusMessage,), (DrawingSchedule("HealthPanel", keep_newest),)),
    ResultKind(
        AllDevicesTableText,
        drawings=(DrawingSchedule("AllDevicesTablePanel", keep_newest),),
        size_bytes=lambda one: len(one.text),
    ),
    ResultKind(
        CompensatedRateBatch,
        drawings=(DrawingSchedule("CompensatedPanel", period_s=SAMPLES_PERIOD_S),),
        size_bytes=lambda one: one.unix_s.nbytes + one.values.nbytes,
    ),
    ResultKind(ThermalIntervalResult, (ThermalPredictionMessage,), (DrawingSchedule("ThermalPredictionPanel"),)),
    ResultKind(MeasuredAndSubtractedDrift, drawings=(DrawingSchedule("DriftPanel", period_s=SERIES_PERIOD_S),)),
    ResultKind(TotalAndHadamardCurves, (TotalAndHadamardMessage,)),
    ResultKind(
        ModelComparison,  # precedes the estimate, because the Allan plot also shows the model
        (ModelGapMessage,),
        (DrawingSchedule("ModelDifferencePanel", keep_newest_and_spaced, period_s=1.0),),
        size_bytes=lambda one: 6 * 4 * int(one.tau_s.nbytes),
    ),
    ResultKind(
        Estimate,
        (AllanMessage, CoefficientsMessage),
        (
            DrawingSchedule("AllanAndCoefficientPanel", keep_newest, period_s=1.0, shares_rate=True),
            DrawingSchedule("CoefficientsPanel", keep_newest_and_spaced, period_s=SERIES_PERIOD_S),
        ),
        size_bytes=lambda one: 8 * int(one.curve.avar.nbytes),
    ),
)
"""All kinds of results, in the order in which the viewer draws them."""
_BY_TYPE: Final = {kind.result: kind for kind in RESULT_KINDS}


def kind_of(result: Any) -> ResultKind:
    """Return the entry of RESULT_KINDS for a result."""
    return _BY_TYPE[type(result)]
