"""Decimation of samples for display, to at most ``ROWS_PER_S`` values per second and axis.

If the sample rate is high, time is divided into short intervals (buckets). The smallest and the largest sample of each
bucket are kept, so that an outlier of a single sample remains visible.
"""

from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints

ROWS_PER_S: Final = 200.0
BUCKETS_PER_S: Final = 95.0  # a bucket gives two values, or more if it is divided between two batches
ROWS_PER_FLUSH: Final = 4000  # limit for a fast replay, which delivers hours of samples at once


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
