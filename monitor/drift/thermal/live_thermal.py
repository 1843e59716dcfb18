"""Live models of bias against temperature for one device.

The input consists of blocks of samples in order, with NaN for samples in motion. At the end of every interval, a
``ThermalIntervalResult`` holds the measured and the predicted mean of each axis. Changes that temperature does not
explain are reported as events. Nothing is stored or computed before the first temperature has been received.

``update`` takes a few milliseconds at the end of an interval. ``step`` selects models in short steps between the
intervals.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import AXES, Event, SampleBlock
from monitor.common.units import format_axis_value
from monitor.drift.thermal.interval_means import PARTS_PER_INTERVAL
from monitor.drift.thermal.online_thermal_model import MAX_INTERVALS, OnlineThermalModel, PredictedAxisInterval
from monitor.drift.thermal.residual_alarm import UnexplainedChange
from monitor.drift.thermal.running_interval_means import IntervalMean, RunningIntervalMeans
from monitor.estimation.detection.signal_monitor import MAX_RATE_CHANGE

KIND: Final = "temperature_unexplained"


@dataclass(frozen=True, slots=True)
class ThermalIntervalResult:
    """Interval means and predictions of all axes that have been measured."""

    t_ns: int  # end of the interval
    interval_s: float
    temperature_c: float  # mean of the interval, °C
    axes: Mapping[str, PredictedAxisInterval]  # axis -> result, in the order of AXES


class LiveThermal:
    """Interval means and thermal models of one device.

    Parameters
    ----------
    rate_hz : float
        Sample rate in Hz.
    interval_s : float
        Length of an interval in seconds. An interval has at least PARTS_PER_INTERVAL samples.
    """

    def __init__(self, rate_hz: float, interval_s: float) -> None:
        self._requested_interval_s = interval_s
        self._events: list[Event] = []
        self._rate_hz = rate_hz
        self._has_temperature = False  # True after the first temperature
        self._sample_count = 0  # samples since the first temperature, including missing ones
        self._reset()

    def update(self, samples: SampleBlock) -> list[ThermalIntervalResult]:
        """Add samples, and return the results of the intervals that ended and have a known temperature."""
        # Samples that are missing before the first temperature belong to no interval.
        lost = samples.lost if self._has_temperature else 0
        self._has_temperature = self._has_temperature or bool(np.isfinite(samples.temperature_c).any())
        if not self._has_temperature:
            return []
        self._sample_count += lost + len(samples)
        over = self._means.update(samples.values, samples.temperature_c, lost)
        updates = [self._process_interval(one, int(samples.t_ns[-1])) for one in over]
        return [update for update in updates if np.isfinite(update.temperature_c) and update.axes]

    @property
    def choosing(self) -> bool:
        """True if a model selection is active, so that ``step`` has work to do."""
        return any(one.choosing for one in self._axes.values())

    def step(self) -> bool:
        """Run one step of the model selection, which takes about 1 ms. Return False if no selection is active."""
        for axis, one in self._axes.items():
            if one.step():
                self._events += [self._event(axis, found) for found in one.take_unexplained_changes()]
                return True
        return False

    def take_events(self) -> list[Event]:
        """Return the events since the last call: changes of the bias that temperature does not explain."""
        events, self._events = self._events, []
        return events

    def learn_new_offset(self) -> None:
        """Learn new offsets after the sensor was moved or restarted, and discard the current interval."""
        self._means.forget_sensor_values()
        for one in self._axes.values():
            one.learn_new_offset()

    def set_rate(self, rate_hz: float) -> None:
        """Set a better estimate of the sample rate in Hz.

        If the rate differs by more than MAX_RATE_CHANGE, the models are discarded, because the length of an interval
        has changed.
        """
        if abs(rate_hz / self._rate_hz - 1.0) > MAX_RATE_CHANGE:
            self._rate_hz = rate_hz
            self._reset()

    def _reset(self) -> None:
        """Discard all models, and start at the current sample rate."""
        length = max(round(self._requested_interval_s * self._rate_hz), PARTS_PER_INTERVAL)
        self._interval_s = length / self._rate_hz
        self._means = RunningIntervalMeans(length, MAX_INTERVALS)
        self._axes: dict[str, OnlineThermalModel] = {}
        self._has_temperature, self._sample_count = False, 0
        self._t_ns = 0  # end of the last interval

    def _process_interval(self, interval: IntervalMean, newest_ns: int) -> ThermalIntervalResult:
        """Update the models of all axes with an interval; ``newest_ns`` is the time of the newest sample."""
        t_ns = newest_ns - round((self._sample_count - interval.end) / self._rate_hz * 1e9)
        axes: dict[str, PredictedAxisInterval] = {}
        for at, axis in enumerate(AXES):
            bias, error = float(interval.bias[at]), float(interval.error[at])
            if axis not in self._axes:
                if not np.isfinite(bias):
                    continue  # The axis has not been measured yet.
                self._axes[axis] = OnlineThermalModel(self._interval_s)
            axes[axis] = self._axes[axis].update(bias, error, interval.temperature_c)
        self._t_ns = t_ns
        return ThermalIntervalResult(t_ns, self._interval_s, interval.temperature_c, axes)

    def _event(self, axis: str, found: UnexplainedChange) -> Event:
        """Return the event of an unexplained change."""
        size = format_axis_value(axis, found.size, sign=True)
        text = (
            f"{axis} differs by {size} from the bias that its temperature predicts: {found.outside} of the last "
            f"{found.of} means were outside their prediction interval"
        )
        what = {"bias": {"size": found.size, "outside": float(found.outside), "of": float(found.of)}}
        since_ns = self._t_ns - round(found.since * self._interval_s * 1e9)
        return Event(KIND, self._t_ns, text, axis, what, since_ns, found.sigma)
