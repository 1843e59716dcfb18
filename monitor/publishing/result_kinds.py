"""Table of the kinds of results that a device produces.

``RESULT_KINDS`` lists the messages that are published and the viewer panels that draw each kind of result. To add a
kind of result, add an entry here, a message in ``monitor.publishing.messages.results`` and a panel in
``monitor.publishing.rerun.result_panels``. This module does not import Rerun.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

from drivers.data_types import Event, Floats
from monitor.common.device_health import Health
from monitor.drift.compensation.live_compensation import DriftUpdate
from monitor.drift.thermal.live_thermal import ThermalIntervalResult
from monitor.estimation.detection.model_comparison import ModelComparison
from monitor.estimation.estimate import Estimate, concatenate_coefficients
from monitor.publishing.messages.message import Message
from monitor.publishing.messages.results import (
    AllanMessage,
    CoefficientsMessage,
    EventMessage,
    ModelGapMessage,
    StatusMessage,
    ThermalMessage,
    TotalAndHadamardCurves,
    TotalAndHadamardMessage,
)

POINT_INTERVAL_S: Final = 1.0
"""Shortest interval between two points of a time series of estimates [s]."""
SMALL_RESULT_BYTES: Final = 1000
"""Approximate size of a result without large arrays."""

TimedResult = tuple[float, Any]
"""Unix time of a result [s], and the result."""
Merge = Callable[[list[TimedResult], TimedResult], None]
"""Function that merges a new result into the results that wait to be drawn."""


@dataclass(frozen=True, slots=True)
class SampleRows:
    """Batch of samples."""

    unix_s: Floats  # [n]
    values: Floats  # [n, 6] rad/s and m/s²; NaN if not measured
    temperature_c: Floats  # [n] NaN if not measured


@dataclass(frozen=True, slots=True)
class CompensatedRows:
    """Batch of angular rates after drift removal."""

    unix_s: Floats  # [n]
    values: Floats  # [n, 3] rad/s


@dataclass(frozen=True, slots=True)
class DeviceTableText:
    """Table of all devices as Markdown, which belongs to no device."""

    text: str


def keep_all(waiting: list[TimedResult], new: TimedResult) -> None:
    """Keep every result.

    Parameters
    ----------
    waiting
        Results that wait to be drawn, modified in place.
    new
        The new result.
    """
    waiting.append(new)


def keep_newest(waiting: list[TimedResult], new: TimedResult) -> None:
    """Keep only the new result. The parameters are those of ``keep_all``."""
    waiting[:] = [new]


def keep_newest_and_spaced(waiting: list[TimedResult], new: TimedResult) -> None:
    """Append the new result, and replace the previous result if the interval between results is too short.

    The coefficient history of a replaced estimate is kept. The parameters are those of ``keep_all``.
    """
    if len(waiting) > 1 and new[0] - waiting[-2][0] < POINT_INTERVAL_S:
        _, previous = waiting.pop()
        if isinstance(previous, Estimate):
            unix_s, estimate = new
            histories = [one for one in (previous.history, estimate.history) if one is not None]
            new = unix_s, replace(estimate, history=concatenate_coefficients(histories))
    waiting.append(new)


@dataclass(frozen=True, slots=True)
class DrawingRule:
    """Rule for drawing one kind of result in one panel of the viewer."""

    panel: str
    """Class in ``monitor.publishing.rerun.result_panels``."""
    merge: Merge = keep_all
    period_s: float = 0.0
    """Shortest interval between two drawings of a device [s]."""
    shares_rate: bool = False
    """True if all devices share a drawing rate, so that the period increases with the number of devices."""


@dataclass(frozen=True, slots=True)
class ResultKind:
    """Messages, drawing rules and size of one kind of result."""

    result: type
    """Class of the results."""
    messages: tuple[type[Message], ...] = ()
    drawings: tuple[DrawingRule, ...] = ()
    size_bytes: Callable[[Any], int] = lambda _result: SMALL_RESULT_BYTES
    """Approximate size of a result, for the limit of the viewer's queue."""


RESULT_KINDS: Final = (
    ResultKind(
        SampleRows,
        drawings=(DrawingRule("SamplesPanel"),),
        size_bytes=lambda one: one.unix_s.nbytes + one.values.nbytes + one.temperature_c.nbytes,
    ),
    ResultKind(Event, (EventMessage,), (DrawingRule("EventsPanel"),)),
    ResultKind(Health, (StatusMessage,), (DrawingRule("HealthPanel", keep_newest),)),
    ResultKind(
        DeviceTableText, drawings=(DrawingRule("DeviceTablePanel", keep_newest),), size_bytes=lambda one: len(one.text)
    ),
    ResultKind(
        CompensatedRows,
        drawings=(DrawingRule("CompensatedPanel"),),
        size_bytes=lambda one: one.unix_s.nbytes + one.values.nbytes,
    ),
    ResultKind(ThermalIntervalResult, (ThermalMessage,), (DrawingRule("ThermalPanel"),)),
    ResultKind(DriftUpdate, drawings=(DrawingRule("DriftPanel"),)),
    ResultKind(TotalAndHadamardCurves, (TotalAndHadamardMessage,)),
    ResultKind(
        ModelComparison,  # precedes the estimate, because the Allan plot also shows the model
        (ModelGapMessage,),
        (DrawingRule("GapPanel", keep_newest_and_spaced, period_s=1.0),),
        size_bytes=lambda one: 6 * 4 * int(one.tau_s.nbytes),
    ),
    ResultKind(
        Estimate,
        (AllanMessage, CoefficientsMessage),
        (
            DrawingRule("AllanPanel", keep_newest, period_s=1.0, shares_rate=True),
            DrawingRule("CoefficientsPanel", keep_newest_and_spaced, period_s=5.0),
        ),
        size_bytes=lambda one: 8 * int(one.curve.avar.nbytes),
    ),
)
"""All kinds of results, in the order in which the viewer draws them."""
_BY_TYPE: Final = {kind.result: kind for kind in RESULT_KINDS}


def kind_of(result: Any) -> ResultKind:
    """Return the entry of RESULT_KINDS for a result."""
    return _BY_TYPE[type(result)]
