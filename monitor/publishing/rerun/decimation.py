"""Fewer rows for the eye: what the viewer is given of a fast device.

In come the samples since the last flush; out go at most ``ROWS_PER_S`` rows a second and axis. A slow
device passes unchanged. Of a fast one every time bucket keeps its smallest and its largest sample, each
at its own time, so an outlier of one sample still shows. Nothing but the drawing sees these rows.
"""

from typing import Final

import numpy as np

from drivers.sample import Floats, Ints

ROWS_PER_S: Final = 200.0
BUCKETS_PER_S: Final = 95.0  # two rows each; the rest pays for the bucket cut at each flush
ROWS_PER_FLUSH: Final = 4000  # a replay at full speed brings hours at once


def extremes(wall_s: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Times and values to draw of one axis: finite ones only, min and max of each bucket if fast.

    ``wall_s`` [n] s, ``values`` [n]; both of equal, any length.
    """
    good = np.isfinite(values)
    wall_s, values = wall_s[good], values[good]
    if values.size < 3:
        return wall_s, values
    width_s = _bucket_width_s(wall_s)
    if width_s is None:
        return wall_s, values
    bucket = np.floor(wall_s / width_s).astype(np.int64)
    keep = _ends(np.lexsort((values, bucket)), bucket)
    return wall_s[keep], values[keep]


def means(wall_s: Floats, values: Floats, per_s: float) -> tuple[Floats, Floats]:
    """Mean time and mean value of each bucket of 1/``per_s`` s: for a slow quantity such as temperature."""
    good = np.isfinite(values)
    wall_s, values = wall_s[good], values[good]
    if values.size == 0:
        return wall_s, values
    _, inverse, count = np.unique(np.floor(wall_s * per_s), return_inverse=True, return_counts=True)
    origin = wall_s[0]  # sums of Unix times would lose microseconds
    t = origin + np.bincount(inverse, wall_s - origin) / count
    return t, np.bincount(inverse, values) / count


def _bucket_width_s(wall_s: Floats) -> float | None:
    """Bucket width in s, or None where the samples are slow enough as they are."""
    span_s = float(wall_s.max() - wall_s.min())
    rate_hz = (wall_s.size - 1) / span_s if span_s > 0 else np.inf
    if rate_hz <= ROWS_PER_S and wall_s.size <= ROWS_PER_FLUSH:
        return None
    return max(1.0 / BUCKETS_PER_S, 2.0 * span_s / ROWS_PER_FLUSH)


def _ends(order: Ints, bucket: Ints) -> Ints:
    """Rows that stand first and last of their bucket in ``order``, in time order and once each."""
    sorted_bucket = bucket[order]
    first = np.concatenate([[True], sorted_bucket[1:] != sorted_bucket[:-1]])
    last = np.concatenate([first[1:], [True]])
    return np.unique(order[first | last])
