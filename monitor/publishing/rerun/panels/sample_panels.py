"""Panels of the Rerun viewer for measured and compensated samples, which are decimated for display.

If the sample rate is high, time is divided into short intervals (buckets). The smallest and the largest sample of each
bucket are kept, so that an outlier of a single sample remains visible. Importing this module imports Rerun.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from drivers.data_types import AXES, Floats, Ints
from monitor.common.unit_formatting import SAMPLE_UNITS, axes_of, sensor_kind
from monitor.history.bucketed_history import HistoryTable
from monitor.publishing.plots import axis_colours
from monitor.publishing.rerun.panels import history_points
from monitor.publishing.rerun.panels.panel import Panel

if TYPE_CHECKING:
    from monitor.publishing.result_kinds import CompensatedRateBatch, SampleBatch

ROWS_PER_S: Final = 200.0
BUCKETS_PER_S: Final = 95.0  # a bucket gives two values, or more if it is divided between two batches
ROWS_PER_FLUSH: Final = 4000  # limit for a fast replay, which delivers hours of samples at once
MIN_GAP_S: Final = 1.0  # shorter gaps are not visible in a plot of 30 s
MIN_GAP_INTERVALS: Final = 5.0  # for a sensor with less than five samples per second


def decimate_extremes(wall_s: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return the times and values of the smallest and the largest sample in each short time interval.

    If the sample rate is low, all samples are returned.

    Parameters
    ----------
    wall_s
        Unix times [s], shape [n].
    values
        Samples, shape [n].
    """
    good = np.isfinite(values)
    wall_s, values = wall_s[good], values[good]
    if values.size < 3:
        return wall_s, values
    width_s = _bucket_width_s(wall_s)
    if width_s is None:
        return wall_s, values
    bucket = np.floor(wall_s / width_s).astype(np.int64)
    keep = _bucket_ends(np.lexsort((values, bucket)), bucket)
    return wall_s[keep], values[keep]


def average_buckets(wall_s: Floats, values: Floats, per_s: float) -> tuple[Floats, Floats]:
    """Return the mean time and the mean value in each time interval, for slow quantities such as temperature.

    Parameters
    ----------
    wall_s
        Unix times [s], shape [n].
    values
        Values, shape [n]; NaN if missing.
    per_s
        Number of time intervals per second.
    """
    good = np.isfinite(values)
    wall_s, values = wall_s[good], values[good]
    if values.size == 0:
        return wall_s, values
    _, inverse, count = np.unique(np.floor(wall_s * per_s), return_inverse=True, return_counts=True)
    origin = wall_s[0]  # sums of Unix times would have rounding errors of microseconds
    t = origin + np.bincount(inverse, wall_s - origin) / count
    return t, np.bincount(inverse, values) / count


def _bucket_width_s(wall_s: Floats) -> float | None:
    """Return the length of a bucket [s], or None if the sample rate is so low that no decimation is needed."""
    span_s = float(wall_s.max() - wall_s.min())
    rate_hz = (wall_s.size - 1) / span_s if span_s > 0 else np.inf
    if rate_hz <= ROWS_PER_S and wall_s.size <= ROWS_PER_FLUSH:
        return None
    return max(1.0 / BUCKETS_PER_S, 2.0 * span_s / ROWS_PER_FLUSH)


def _bucket_ends(order: Ints, bucket: Ints) -> Ints:
    """Return the positions of the first and the last sample of each bucket in the given order."""
    sorted_bucket = bucket[order]
    first = np.concatenate([[True], sorted_bucket[1:] != sorted_bucket[:-1]])
    last = np.concatenate([first[1:], [True]])
    return np.unique(order[first | last])


def gap_midpoints(sample_s: Floats, previous_s: float, interval_s: float) -> Floats:
    """Return the middle of each gap, at which the line of the samples is interrupted.

    >>> gap_midpoints(np.array([1.0, 1.1, 1.2, 9.2, 9.3]), 0.9, 0.1).round(1).tolist()
    [5.2]

    Parameters
    ----------
    sample_s
        Unix times of the samples [s], shape [n].
    previous_s
        Unix time of the sample before [s].
    interval_s
        Typical time between two samples [s].
    """
    before_s = np.concatenate([[previous_s], sample_s[:-1]])
    intervals_s = sample_s - before_s
    gaps = intervals_s > max(MIN_GAP_S, MIN_GAP_INTERVALS * interval_s)
    return np.asarray((before_s + intervals_s / 2.0)[gaps])


TEMPERATURES_PER_S: Final = 5.0


class _SamplePanel(Panel):
    _newest_s = float("nan")  # Unix time of the newest sample [s]
    _interval_s = float("nan")  # smallest median of the time between samples of all batches [s]

    def _style_samples(self, name: str, axes: Sequence[str]) -> None:
        for axis in axes:
            line = (axis, axis_colours.AXIS_COLOURS[axis], 1.0)
            self._style_lines(f"{name}/{axis}", [line])

    def _log_samples(
        self, name: str, axes: Sequence[str], results: "Sequence[SampleBatch | CompensatedRateBatch]"
    ) -> Floats:
        """Log decimated samples, and return the times of all samples."""
        times, values = np.concatenate([one.unix_s for one in results]), np.concatenate([one.values for one in results])
        if times.size == 0:
            return times
        previous_s = float(times[0]) if np.isnan(self._newest_s) else self._newest_s
        intervals_s = np.diff(times) if np.isnan(self._newest_s) else np.diff(times, prepend=previous_s)
        if intervals_s.size:
            self._interval_s = float(np.fmin(self._interval_s, np.median(intervals_s)))
        gaps_s = gap_midpoints(times, previous_s, self._interval_s)
        self._newest_s = float(times[-1])
        for i, axis in enumerate(axes):
            t, y = decimate_extremes(times, values[:, i])
            t, y = np.concatenate([t, gaps_s]), np.concatenate([y, np.full(gaps_s.size, np.nan)])
            order = np.argsort(t, kind="stable")
            factor = SAMPLE_UNITS[sensor_kind(axis)].factor
            self.scene.log_scalars(self.entity_path(f"{name}/{axis}"), t[order], y[order] * factor)
        return times


class SamplesAndTemperaturePanel(_SamplePanel):
    """Samples, decimated for display, and temperature over time."""

    def log_styles(self) -> None:
        """Log the names, colours and widths of the lines."""
        self._style_samples("samples", AXES)
        self._style_lines("temperature", [("temperature, °C", axis_colours.TEMPERATURE, 1.5)])

    def draw(self, unix_s: Floats, results: "Sequence[SampleBatch]") -> None:
        """Draw the samples and the temperature."""
        times = self._log_samples("samples", AXES, results)
        temperature_c = np.concatenate([one.temperature_c for one in results])
        self.scene.log_scalars(
            self.entity_path("temperature"), *average_buckets(times, temperature_c, TEMPERATURES_PER_S)
        )

    def draw_history(self, history: HistoryTable) -> None:
        """Draw the stored temperature of the device."""
        temperature = history.select_column("temperature")
        if np.isfinite(temperature.last).any():
            at, values = history_points.history_points(history, temperature, temperature.last, temperature.last)
            self.scene.log_scalars(self.entity_path("temperature"), at, values[:, 0])


class CompensatedPanel(_SamplePanel):
    """Angular rates after drift removal over time, decimated for display."""

    def log_styles(self) -> None:
        """Log the names, colours and widths of the lines."""
        self._style_samples("compensated", axes_of("gyro"))

    def draw(self, unix_s: Floats, results: "Sequence[CompensatedRateBatch]") -> None:
        """Draw the angular rates after drift removal."""
        self._log_samples("compensated", axes_of("gyro"), results)
