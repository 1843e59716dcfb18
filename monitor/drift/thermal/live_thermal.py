"""Live models of the bias as a function of temperature for one device.

The input consists of blocks of samples, in which samples in motion are NaN. Selecting a thermal model takes up to a
second, so ``run_selection_step_if_active`` divides the selection into short steps.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import AXES, Event, SampleBlock
from monitor.common.unit_formatting import format_axis_value
from monitor.drift.thermal.interval_means import PARTS_PER_INTERVAL, IntervalMean, RunningIntervalMeans
from monitor.drift.thermal.online_thermal_model import MAX_INTERVALS, MeasuredAndPredictedMean, OnlineThermalModel
from monitor.drift.thermal.residual_alarm import UnexplainedChange
from monitor.estimation.detection.motion_and_change_monitor import MAX_RATE_CHANGE

KIND: Final = "temperature_unexplained"


@dataclass(frozen=True, slots=True)
class ThermalIntervalResult:
    """Measured and predicted interval means of all axes."""

    t_ns: int  # time of the end of the interval
    interval_s: float
    temperature_c: float  # mean temperature of the interval, °C
    axes: Mapping[str, MeasuredAndPredictedMean]  # results by axis, in the order of AXES


class LiveThermalModels:
    """Thermal models of one device, which are updated with interval means.

    Parameters
    ----------
    rate_hz : float
        Sample rate in Hz.
    interval_s : float
        Length of an interval in seconds, at least PARTS_PER_INTERVAL samples.
    """

    def __init__(self, rate_hz: float, interval_s: float) -> None:
        self._requested_interval_s = interval_s
        self._events: list[Event] = []
        self._rate_hz = rate_hz
        self._has_temperature = False  # True after the first temperature has been received
        self._sample_count = 0  # number of samples since the first temperature, including missing samples
        self._reset()

    def process_block(self, samples: SampleBlock) -> list[ThermalIntervalResult]:
        """Process a block of samples, and return the results of the intervals that have ended."""
        # Samples that are missing before the first temperature are not counted.
        lost = samples.lost if self._has_temperature else 0
        self._has_temperature = self._has_temperature or bool(np.isfinite(samples.temperature_c).any())
        if not self._has_temperature:
            return []
        self._sample_count += lost + len(samples)
        over = self._means.add_samples(samples.values, samples.temperature_c, lost)
        updates = [self._process_interval(one, int(samples.t_ns[-1])) for one in over]
        return [update for update in updates if np.isfinite(update.temperature_c) and update.axes]

    @property
    def temperature_shares(self) -> dict[str, float]:
        """Variance share of the interval means that temperature explains, for each axis with a model."""
        shares = {axis: one.temperature_share for axis, one in self._axes.items()}
        return {axis: share for axis, share in shares.items() if share is not None}

    @property
    def is_selecting_model(self) -> bool:
        """Return True if a model selection is in progress on any axis."""
        return any(one.is_selecting_model for one in self._axes.values())

    def run_selection_step_if_active(self) -> bool:
        """Run one step of a model selection, which takes about 1 ms. Return False if no selection is in progress."""
        for axis, one in self._axes.items():
            if one.run_selection_step_if_active():
                self._events += [self._event(axis, found) for found in one.take_unexplained_changes()]
                return True
        return False

    def take_events(self) -> list[Event]:
        """Return the events since the last call. They report bias changes that temperature does not explain."""
        events, self._events = self._events, []
        return events

    def learn_new_offset(self) -> None:
        """Discard the current interval, and learn new bias offsets after the sensor has been moved or restarted."""
        self._means.forget_interval_samples_except_temperature()
        for one in self._axes.values():
            one.learn_new_offset()

    def set_rate(self, rate_hz: float) -> None:
        """Set a more accurate value of the sample rate in Hz.

        The models are discarded if the relative change of the rate exceeds MAX_RATE_CHANGE.
        """
        if abs(rate_hz / self._rate_hz - 1.0) > MAX_RATE_CHANGE:
            self._rate_hz = rate_hz
            self._reset()

    def _reset(self) -> None:
        length = max(round(self._requested_interval_s * self._rate_hz), PARTS_PER_INTERVAL)
        self._interval_s = length / self._rate_hz
        self._means = RunningIntervalMeans(length, MAX_INTERVALS)
        self._axes: dict[str, OnlineThermalModel] = {}
        self._has_temperature, self._sample_count = False, 0
        self._t_ns = 0  # time of the end of the last interval

    def _process_interval(self, interval: IntervalMean, newest_ns: int) -> ThermalIntervalResult:
        """Update the models of all axes with an interval. The newest sample was received at ``newest_ns``."""
        t_ns = newest_ns - round((self._sample_count - interval.end) / self._rate_hz * 1e9)
        axes: dict[str, MeasuredAndPredictedMean] = {}
        for at, axis in enumerate(AXES):
            bias, error = float(interval.bias[at]), float(interval.error[at])
            if axis not in self._axes:
                if not np.isfinite(bias):
                    continue  # no measurement of this axis yet
                self._axes[axis] = OnlineThermalModel(self._interval_s)
            axes[axis] = self._axes[axis].predict_and_add_interval(bias, error, interval.temperature_c)
        self._t_ns = t_ns
        return ThermalIntervalResult(t_ns, self._interval_s, interval.temperature_c, axes)

    def _event(self, axis: str, found: UnexplainedChange) -> Event:
        size = format_axis_value(axis, found.size, sign=True)
        text = (
            f"{axis} differs by {size} from the bias that its temperature predicts: {found.outside} of the last "
            f"{found.of} means were outside their prediction interval"
        )
        what = {"bias": {"size": found.size, "outside": float(found.outside), "of": float(found.of)}}
        since_ns = self._t_ns - round(found.since * self._interval_s * 1e9)
        return Event(KIND, self._t_ns, text, axis, what, since_ns, found.sigma)
