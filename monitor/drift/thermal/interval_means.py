"""Means of the bias and the temperature over successive intervals, with standard errors."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import AXES, Floats, Ints

PARTS_PER_INTERVAL: Final = 8
"""Number of parts into which an interval is divided to estimate the standard error of the mean."""
MIN_KNOWN_SHARE: Final = 0.5
MAX_MEANS: Final = 150
"""Maximum number of interval means in a regression. Longer recordings are averaged in groups of intervals."""
BLOCK_SAMPLES: Final = 1 << 18
"""Number of samples that are processed at once."""
BUFFER_ROWS: Final = 1024
TEMPERATURE_COLUMN: Final = len(AXES)


@dataclass(frozen=True, slots=True)
class IntervalMeans:
    """Means of the bias of one axis and of the temperature over successive intervals."""

    interval_s: float
    bias: Floats  # [n] mean bias, rad/s or m/s²; NaN if too few samples are known
    error: Floats  # [n] standard error of each mean bias
    temperature_c: Floats  # [n] mean temperature, °C; NaN if too few samples are known

    @property
    def both_known(self) -> np.ndarray:
        """Return a mask [n] that is True for intervals in which both bias and temperature are known."""
        return np.isfinite(self.bias) & np.isfinite(self.temperature_c)


def interpolate_missing_temperatures(temperature_c: Floats) -> Floats:
    """Replace missing temperatures [n] by interpolated values."""
    there = np.flatnonzero(np.isfinite(temperature_c))
    return np.interp(np.arange(temperature_c.size), there, temperature_c[there])


class Grouping:
    """Division of intervals into groups of equal length, so that there are at most MAX_MEANS groups.

    Intervals before the first complete group are ignored. A group is known if at least half of its intervals are known.
    """

    def __init__(self, known: np.ndarray) -> None:
        self.size = -(-known.size // MAX_MEANS)
        self._first = known.size % self.size
        self._members = known[self._first :].reshape(-1, self.size)
        self.counts = self._members.sum(axis=1)
        self.known: np.ndarray = 2 * self.counts >= self.size

    def average(self, columns: Floats, known_only: bool = True) -> Floats:
        """Return the mean [groups, m] of the known rows of each group, or of all rows."""
        rows = columns[self._first :].reshape(*self._members.shape, -1)
        if not known_only:
            return np.asarray(rows.mean(axis=1))
        total = np.where(self._members[:, :, None], rows, 0.0).sum(axis=1)
        return np.asarray(total / np.maximum(self.counts, 1)[:, None])


def average_groups(means: IntervalMeans) -> IntervalMeans:
    """Return the interval means, averaged in groups if there are more than MAX_MEANS of them."""
    grouping = Grouping(means.both_known)
    if grouping.size == 1:
        return means
    temperature_c = grouping.average(interpolate_missing_temperatures(means.temperature_c)[:, None], False)[:, 0]
    bias, error = grouping.average(np.stack([means.bias, means.error], axis=1)).T
    bias[~grouping.known] = np.nan
    return IntervalMeans(
        grouping.size * means.interval_s, bias, error / np.sqrt(np.maximum(grouping.counts, 1)), temperature_c
    )


def compute_interval_means(values: Floats, temperature_c: Floats, rate_hz: float, interval_s: float) -> IntervalMeans:
    """Compute the means of the bias and the temperature over successive intervals.

    To estimate the standard error, an interval is divided into PARTS_PER_INTERVAL parts. The variance of a part mean is
    half the mean square difference between neighbouring part means. The standard error is the square root of this
    variance divided by the number of parts. A drift within the interval has little effect on it. Samples after the last
    complete interval are ignored.

    Parameters
    ----------
    values : ndarray, shape (samples,)
        Samples of one axis, rad/s or m/s²; NaN means missing.
    temperature_c : ndarray, shape (samples,)
        Temperature, °C; NaN means missing.
    rate_hz : float
        Sample rate, Hz.
    interval_s : float
        Length of an interval in seconds, rounded to whole samples.

    Examples
    --------
    >>> means = compute_interval_means(np.arange(100.0), np.full(100, 25.0), 10.0, 5.0)
    >>> means.bias.tolist(), means.temperature_c.tolist()
    ([24.5, 74.5], [25.0, 25.0])
    """
    length = max(round(interval_s * rate_hz), 1)
    (bias, error), (mean_temperature_c, _) = (
        _means_of_intervals(values, length),
        _means_of_intervals(temperature_c, length),
    )
    return IntervalMeans(length / rate_hz, bias, error, mean_temperature_c)


def _means_of_intervals(samples: Floats, length: int) -> tuple[Floats, Floats]:
    """Return the mean and the standard error of each complete interval of ``length`` samples."""
    n = samples.size // length
    rows = max(BLOCK_SAMPLES // length, 1)  # intermediate results of all samples would need much memory
    parts = [
        _row_means(samples[row * length : min(row + rows, n) * length].reshape(-1, length))
        for row in range(0, max(n, 1), rows)
    ]
    mean, error = map(np.concatenate, zip(*parts, strict=True))
    return mean, error


def _row_means(rows: Floats) -> tuple[Floats, Floats]:
    """Return the mean and the standard error of each row [n, length], or NaN if too few values are known."""
    known_samples = np.isfinite(rows)
    count = known_samples.sum(axis=1)
    too_few = count < max(MIN_KNOWN_SHARE * rows.shape[1], 1.0)
    # Subtracting the origin reduces rounding errors, for example with noise of 1e-4 m/s² on gravity of 9.81 m/s².
    origin = np.nanmedian(rows) if known_samples.any() else 0.0
    mean = origin + np.where(known_samples, rows - origin, 0.0).sum(axis=1) / np.maximum(count, 1)
    size = rows.shape[1] // PARTS_PER_INTERVAL
    error = np.full(count.size, np.nan)
    if size:
        shape = (count.size, PARTS_PER_INTERVAL, size)
        inside = known_samples[:, : PARTS_PER_INTERVAL * size].reshape(shape).sum(axis=2)
        differences = np.where(known_samples, rows - mean[:, None], 0.0)[:, : PARTS_PER_INTERVAL * size]
        error = standard_error_from_parts(differences.reshape(shape).sum(axis=2).T, inside.T)
    mean[too_few], error[too_few] = np.nan, np.nan
    return mean, error


def standard_error_from_parts(part_sums: Floats, part_counts: Ints) -> Floats:
    """Return the standard errors [n] of interval means, computed from sums over parts of the intervals.

    Parameters
    ----------
    part_sums : ndarray, shape (PARTS_PER_INTERVAL, n)
        Sum of the known samples in each part.
    part_counts : ndarray, shape (PARTS_PER_INTERVAL, n)
        Number of known samples in each part.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        differences = np.diff(part_sums / part_counts, axis=0)
        known = np.isfinite(differences)
        square = np.where(known, differences, 0.0) ** 2
        return np.asarray(np.sqrt(0.5 * square.sum(axis=0) / known.sum(axis=0) / PARTS_PER_INTERVAL))


@dataclass(frozen=True, slots=True)
class IntervalMean:
    """Means of the biases and of the temperature in one interval."""

    bias: Floats  # [6] mean biases, rad/s and m/s²; NaN if too few samples are known
    error: Floats  # [6] standard error of each mean bias
    temperature_c: float  # mean temperature, °C; NaN if too few samples are known
    end: int  # index of the first sample after the interval, counting missing samples


class RunningIntervalMeans:
    """Computes interval means from a stream of samples, with the same results as ``compute_interval_means``.

    The results do not depend on how the stream is divided into blocks.

    Parameters
    ----------
    length : int
        Number of samples in an interval, at least PARTS_PER_INTERVAL.
    longest : int
        Maximum number of empty intervals that are returned for a gap in the samples.

    Examples
    --------
    >>> means = RunningIntervalMeans(50)
    >>> ramp = np.repeat(np.arange(100.0)[:, None], 6, axis=1)
    >>> [(one.bias[0].item(), one.temperature_c) for one in means.add_samples(ramp, np.full(100, 25.0), 0)]
    [(24.5, 25.0), (74.5, 25.0)]
    """

    def __init__(self, length: int, longest: int = 1000) -> None:
        size = length // PARTS_PER_INTERVAL
        self._length = length
        self._max_empty = longest
        # Samples after the last of the equal parts contribute to the mean, but not to the standard error.
        self._edges = [*(size * k for k in range(1, PARTS_PER_INTERVAL)), size * PARTS_PER_INTERVAL, length]
        self._rows = np.empty((BUFFER_ROWS, TEMPERATURE_COLUMN + 1))
        self._buffered = 0
        # Subtracting the origin reduces rounding errors, for example with noise of 1e-4 m/s² on gravity of 9.81 m/s².
        self._origin = np.full(TEMPERATURE_COLUMN + 1, np.nan)
        self._end = 0  # end of the last complete interval, in samples
        self._begin()

    def add_samples(self, values: Floats, temperature_c: Floats, lost: int) -> list[IntervalMean]:
        """Add samples, and return the means of the intervals that have ended.

        Parameters
        ----------
        values : ndarray, shape (n, 6)
            Samples in rad/s and m/s²; NaN means missing.
        temperature_c : ndarray, shape (n,)
            Temperature in °C; NaN means missing.
        lost : int
            Number of samples that are missing before ``values``.
        """
        finished = self._skip_missing(lost) if lost else []
        at = 0
        while at < len(values):
            count = min(len(values) - at, BUFFER_ROWS - self._buffered, self._edges[self._part] - self._position)
            rows = slice(self._buffered, self._buffered + count)
            self._rows[rows, :TEMPERATURE_COLUMN] = values[at : at + count]
            self._rows[rows, TEMPERATURE_COLUMN] = temperature_c[at : at + count]
            self._buffered += count
            at += count
            finished += self._advance(count)
        return finished

    def forget_interval_samples_except_temperature(self) -> None:
        """Discard the samples of the current interval, but keep the temperatures."""
        self._rows[: self._buffered, :TEMPERATURE_COLUMN] = np.nan
        self._sum[:, :TEMPERATURE_COLUMN], self._count[:, :TEMPERATURE_COLUMN] = 0.0, 0

    def _begin(self) -> None:
        self._position = self._part = 0
        self._sum = np.zeros((PARTS_PER_INTERVAL + 1, TEMPERATURE_COLUMN + 1))
        self._count = np.zeros((PARTS_PER_INTERVAL + 1, TEMPERATURE_COLUMN + 1), np.int64)

    def _advance(self, count: int) -> list[IntervalMean]:
        """Advance by ``count`` samples, and return the means if the interval has ended."""
        self._position += count
        if self._buffered == BUFFER_ROWS or self._position == self._edges[self._part]:
            self._sum_buffer()
        while self._part < PARTS_PER_INTERVAL and self._position == self._edges[self._part]:
            self._part += 1
        if self._position < self._length:
            return []
        self._end += self._length
        closed = self._interval()
        self._begin()
        return [closed]

    def _sum_buffer(self) -> None:
        rows, self._buffered = self._rows[: self._buffered], 0
        there = np.isfinite(rows)
        new = there.any(axis=0) & np.isnan(self._origin)
        if new.any():
            self._origin[new] = rows[there.argmax(axis=0), np.arange(TEMPERATURE_COLUMN + 1)][new]
        self._sum[self._part] += np.where(there, rows - self._origin, 0.0).sum(axis=0)
        self._count[self._part] += there.sum(axis=0)

    def _skip_missing(self, lost: int) -> list[IntervalMean]:
        """Advance over missing samples, and return the means of the intervals that have ended."""
        finished: list[IntervalMean] = []
        while lost and self._position:
            count = min(lost, self._edges[self._part] - self._position)
            lost -= count
            if self._buffered:
                self._sum_buffer()
            finished += self._advance(count)
        if not lost:
            return finished
        whole, self._position = divmod(lost, self._length)
        nothing = np.full(TEMPERATURE_COLUMN, np.nan)
        for left in range(min(whole, self._max_empty) - 1, -1, -1):
            finished.append(IntervalMean(nothing, nothing, np.nan, self._end + (whole - left) * self._length))
        self._end += whole * self._length
        while self._part < PARTS_PER_INTERVAL and self._position >= self._edges[self._part]:
            self._part += 1
        return finished

    def _interval(self) -> IntervalMean:
        count = self._count.sum(axis=0)
        too_few = count < max(MIN_KNOWN_SHARE * self._length, 1.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = self._origin + self._sum.sum(axis=0) / count
        parts = np.s_[:PARTS_PER_INTERVAL, :TEMPERATURE_COLUMN]
        error = standard_error_from_parts(self._sum[parts], self._count[parts])
        mean[too_few], error[too_few[:TEMPERATURE_COLUMN]] = np.nan, np.nan
        return IntervalMean(mean[:TEMPERATURE_COLUMN], error, float(mean[TEMPERATURE_COLUMN]), self._end)
