"""Table of the kinds of results that leave the pipeline of a device.

A row of ``RESULT_KINDS`` lists the messages that are published and the viewer panels that draw the result. It also
states how often the panels draw, and how results are merged while they wait for a slow viewer. A new kind of result
needs a row here, a message in ``monitor.publishing.messages.results``, a panel in
``monitor.publishing.rerun.result_panels`` and the code that produces the result. The module does no I/O and does not
import Rerun.
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
    GapMessage,
    SlowStatistics,
    StatusMessage,
    ThermalMessage,
    TotalMessage,
)

POINT_INTERVAL_S: Final = 1.0
"""Interval between two points of a time series of estimates, in the time of the samples."""
SMALL_RESULT_BYTES: Final = 1000
"""Approximate size of a result without large arrays."""

TimedResult = tuple[float, Any]
"""Unix time of a result [s], and the result."""
Merge = Callable[[list[TimedResult], TimedResult], None]
"""Function that adds a new result to the results that wait to be drawn."""


@dataclass(frozen=True, slots=True)
class SampleRows:
    """Batch of samples."""

    unix_s: Floats  # [n]
    values: Floats  # [n, 6] rad/s and m/s²; NaN if not measured
    temperature_c: Floats  # [n] NaN if not measured


@dataclass(frozen=True, slots=True)
class CompensatedRows:
    """Batch of angular rates without drift."""

    unix_s: Floats  # [n]
    values: Floats  # [n, 3] rad/s


@dataclass(frozen=True, slots=True)
class DeviceTableText:
    """Table of all devices as Markdown. It is passed on with an empty device name."""

    text: str


def keep_all(waiting: list[TimedResult], new: TimedResult) -> None:
    """Keep every result.

    Parameters
    ----------
    waiting
        Results that wait to be drawn. The list is changed.
    new
        The new result.
    """
    waiting.append(new)


def keep_newest(waiting: list[TimedResult], new: TimedResult) -> None:
    """Keep only the new result. The parameters are those of ``keep_all``."""
    waiting[:] = [new]


def keep_spaced(waiting: list[TimedResult], new: TimedResult) -> None:
    """Add the new result, and drop the previous result if it follows the result before it too closely.

    The coefficients for each sample of a dropped estimate are kept. The parameters are those of ``keep_all``.
    """
    if len(waiting) > 1 and new[0] - waiting[-2][0] < POINT_INTERVAL_S:
        _, previous = waiting.pop()
        if isinstance(previous, Estimate):
            unix_s, estimate = new
            histories = [one for one in (previous.history, estimate.history) if one is not None]
            new = unix_s, replace(estimate, history=concatenate_coefficients(histories))
    waiting.append(new)


@dataclass(frozen=True, slots=True)
class Drawing:
    """Rule for drawing one kind of result in one panel of the viewer."""

    panel: str
    """Class in ``monitor.publishing.rerun.result_panels``."""
    merge: Merge = keep_all
    period_s: float = 0.0
    """Shortest interval between two drawings of a device [s]."""
    shares_rate: bool = False
    """True if all devices share a limited drawing rate, so that the period grows with the number of devices."""


@dataclass(frozen=True, slots=True)
class ResultKind:
    """Row of the table."""

    result: type
    """Class of the results."""
    messages: tuple[type[Message], ...] = ()
    drawings: tuple[Drawing, ...] = ()
    size_bytes: Callable[[Any], int] = lambda _result: SMALL_RESULT_BYTES
    """Approximate size of a result, for the limit of the viewer's queue."""


RESULT_KINDS: Final = (
    ResultKind(
        SampleRows,
        drawings=(Drawing("SamplesPanel"),),
        size_bytes=lambda one: one.unix_s.nbytes + one.values.nbytes + one.temperature_c.nbytes,
    ),
    ResultKind(Event, (EventMessage,), (Drawing("EventsPanel"),)),
    ResultKind(Health, (StatusMessage,), (Drawing("HealthPanel", keep_newest),)),
    ResultKind(
        DeviceTableText, drawings=(Drawing("DeviceTablePanel", keep_newest),), size_bytes=lambda one: len(one.text)
    ),
    ResultKind(
        CompensatedRows,
        drawings=(Drawing("CompensatedPanel"),),
        size_bytes=lambda one: one.unix_s.nbytes + one.values.nbytes,
    ),
    ResultKind(ThermalIntervalResult, (ThermalMessage,), (Drawing("ThermalPanel"),)),
    ResultKind(DriftUpdate, drawings=(Drawing("DriftPanel"),)),
    ResultKind(SlowStatistics, (TotalMessage,)),
    ResultKind(
        ModelComparison,  # before the estimate, because the Allan plot also shows the deviations of the model
        (GapMessage,),
        (Drawing("GapPanel", keep_spaced, period_s=1.0),),
        size_bytes=lambda one: 6 * 4 * int(one.tau_s.nbytes),
    ),
    ResultKind(
        Estimate,
        (AllanMessage, CoefficientsMessage),
        (
            Drawing("AllanPanel", keep_newest, period_s=1.0, shares_rate=True),
            Drawing("CoefficientsPanel", keep_spaced, period_s=5.0),
        ),
        size_bytes=lambda one: 8 * int(one.curve.avar.nbytes),
    ),
)
"""All kinds of results, in the order in which the viewer draws them."""
_BY_TYPE: Final = {kind.result: kind for kind in RESULT_KINDS}


def kind_of(result: Any) -> ResultKind:
    """Return the row of a result."""
    return _BY_TYPE[type(result)]
