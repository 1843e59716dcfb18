"""The bias–temperature models of one device while its samples come.

Comes in: blocks in order, moving samples struck out (NaN). Goes out: at the end of every interval a ``ThermalLook``,
what was measured on each axis beside what was expected of it; and what temperature does not explain. Until a first
temperature has come nothing is kept and nothing is worked out.

``update`` takes a few ms at the end of an interval; ``step`` chooses models piece by piece, in the time between.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.sample import AXES, Event, SampleBlock
from monitor.common.rates import amount
from monitor.drift.thermal.interval_means import PARTS
from monitor.drift.thermal.online_thermal_model import KEPT, AxisThermal, Following
from monitor.drift.thermal.residual_alarm import Unexplained
from monitor.drift.thermal.running_interval_means import Interval, RunningMeans
from monitor.estimation.detection.signal_monitor import OTHER_RATE

KIND: Final = "temperature_unexplained"


@dataclass(frozen=True, slots=True)
class ThermalLook:
    """One interval of all axes that were ever measured."""

    t_ns: int  # its end
    interval_s: float
    temperature_c: float  # °C, its mean
    axes: Mapping[str, AxisThermal]  # in AXES order


class LiveThermal:
    """Interval means and models of one device.

    Args:
        rate_hz: samples a second
        interval_s: of a mean; at least PARTS samples
    """

    def __init__(self, rate_hz: float, interval_s: float) -> None:
        self._wanted_s = interval_s
        self._events: list[Event] = []
        self._rate_hz = rate_hz
        self._warm = False  # a temperature has come
        self._came = 0  # samples since then, missing ones included
        self._begin()

    def update(self, samples: SampleBlock) -> list[ThermalLook]:
        """The intervals that are over with these samples and have a temperature."""
        lost = samples.lost if self._warm else 0  # what was missing before the first belongs to no interval
        self._warm = self._warm or bool(np.isfinite(samples.temperature_c).any())
        if not self._warm:
            return []
        self._came += lost + len(samples)
        over = self._means.update(samples.values, samples.temperature_c, lost)
        looks = [self._enter(one, int(samples.t_ns[-1])) for one in over]
        return [look for look in looks if np.isfinite(look.temperature_c) and look.axes]

    @property
    def choosing(self) -> bool:
        """Whether ``step`` has something to do."""
        return any(one.choosing for one in self._axes.values())

    def step(self) -> bool:
        """One piece of choosing a model, about a ms; False when there is nothing to choose."""
        for axis, one in self._axes.items():
            if one.step():
                self._events += [self._event(axis, found) for found in one.take()]
                return True
        return False

    def take_events(self) -> list[Event]:
        """What temperature does not explain, since the last call."""
        events, self._events = self._events, []
        return events

    def offset_is_new(self) -> None:
        """The sensor was laid down another way, or started anew: what this interval has of before counts no more."""
        self._means.forget()
        for one in self._axes.values():
            one.offset_is_new()

    def relabel(self, rate_hz: float) -> None:
        """The rate is known better; if it is another one, intervals had another length."""
        if abs(rate_hz / self._rate_hz - 1.0) > OTHER_RATE:
            self._rate_hz = rate_hz
            self._begin()

    def _begin(self) -> None:
        length = max(round(self._wanted_s * self._rate_hz), PARTS)
        self._interval_s = length / self._rate_hz
        self._means = RunningMeans(length, KEPT)
        self._axes: dict[str, Following] = {}
        self._warm, self._came = False, 0
        self._t_ns = 0  # end of the last interval

    def _enter(self, interval: Interval, newest_ns: int) -> ThermalLook:
        t_ns = newest_ns - round((self._came - interval.end) / self._rate_hz * 1e9)
        axes: dict[str, AxisThermal] = {}
        for at, axis in enumerate(AXES):
            bias, error = float(interval.bias[at]), float(interval.error[at])
            if axis not in self._axes:
                if not np.isfinite(bias):
                    continue  # not measured so far
                self._axes[axis] = Following(self._interval_s)
            axes[axis] = self._axes[axis].update(bias, error, interval.temperature_c)
        self._t_ns = t_ns
        return ThermalLook(t_ns, self._interval_s, interval.temperature_c, axes)

    def _event(self, axis: str, found: Unexplained) -> Event:
        size = amount(axis, found.size, sign=True)
        text = (
            f"{axis} is {size} off what its temperature lets expect: {found.outside} of the last {found.of} means "
            f"were outside of their interval"
        )
        what = {"bias": {"size": found.size, "outside": float(found.outside), "of": float(found.of)}}
        since_ns = self._t_ns - round(found.since * self._interval_s * 1e9)
        return Event(KIND, self._t_ns, text, axis, what, since_ns, found.sigma)
