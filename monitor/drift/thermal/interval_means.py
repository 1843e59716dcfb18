"""Interval means of bias and temperature, with what each is uncertain by."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.sample import Floats

PARTS: Final = 8
"""Of an interval: their scatter tells how uncertain its mean is."""
MOSTLY: Final = 0.5
"""Of the samples of an interval must be there."""


@dataclass(frozen=True, slots=True)
class Means:
    """One axis beside temperature, averaged over intervals that follow each other without a gap in time."""

    interval_s: float
    bias: Floats  # [n] rad/s or m/s²; NaN where too little was there
    error: Floats  # [n] standard error of each
    temperature_c: Floats  # [n] °C

    @property
    def known(self) -> np.ndarray:
        """[n] whether both were measured."""
        return np.isfinite(self.bias) & np.isfinite(self.temperature_c)

    def upto(self, n: int) -> "Means":
        """The first n intervals."""
        return Means(self.interval_s, self.bias[:n], self.error[:n], self.temperature_c[:n])


def interval_means(values: Floats, temperature_c: Floats, rate_hz: float, interval_s: float) -> Means:
    """Means of whole intervals; what is left over at the end is too short for one.

    The standard error is √(mean square of half differences of neighbouring parts / parts): of white noise it is σ/√n,
    and a drift across the interval does not enter.

    Args:
        values: [samples] of one axis, rad/s or m/s²; NaN = missing
        temperature_c: [samples] °C; NaN = missing
        interval_s: rounded to whole samples

    >>> means = interval_means(np.arange(100.0), np.full(100, 25.0), 10.0, 5.0)
    >>> means.bias.tolist(), means.temperature_c.tolist()
    ([24.5, 74.5], [25.0, 25.0])
    """
    length = max(round(interval_s * rate_hz), 1)
    n = values.size // length
    bias, error = _mean(values[: n * length].reshape(n, length))
    warmth, _ = _mean(temperature_c[: n * length].reshape(n, length))
    return Means(length / rate_hz, bias, error, warmth)


def _mean(rows: Floats) -> tuple[Floats, Floats]:
    """Mean [n] and standard error [n] of each row [n, length]; NaN where fewer than MOSTLY are there."""
    there = np.isfinite(rows)
    count = there.sum(axis=1)
    few = count < max(MOSTLY * rows.shape[1], 1.0)
    origin = np.nanmedian(rows) if there.any() else 0.0  # a mean of 9.81 with noise of 1e-4 keeps its digits
    mean = origin + np.where(there, rows - origin, 0.0).sum(axis=1) / np.maximum(count, 1)
    size = rows.shape[1] // PARTS
    error = np.full(count.size, np.nan)
    if size:
        shape = (count.size, PARTS, size)
        inside = there[:, : PARTS * size].reshape(shape).sum(axis=2)
        part = np.where(there, rows - mean[:, None], 0.0)[:, : PARTS * size].reshape(shape).sum(axis=2)
        with np.errstate(invalid="ignore", divide="ignore"):
            apart = np.diff(part / inside, axis=1)
            both = np.isfinite(apart)
            square = np.where(both, apart, 0.0) ** 2
            error = np.sqrt(0.5 * square.sum(axis=1) / both.sum(axis=1) / PARTS)
    mean[few], error[few] = np.nan, np.nan
    return mean, error
