"""Means of the bias and the temperature over successive intervals, with standard errors."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints

PARTS_PER_INTERVAL: Final = 8
"""Number of parts into which an interval is divided to estimate the standard error of the mean."""
MIN_KNOWN_SHARE: Final = 0.5


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
    n = values.size // length
    bias, error = _row_means(values[: n * length].reshape(n, length))
    mean_temperature_c, _ = _row_means(temperature_c[: n * length].reshape(n, length))
    return IntervalMeans(length / rate_hz, bias, error, mean_temperature_c)


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
