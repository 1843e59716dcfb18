"""Points that the viewer draws of the past: few a bucket, and none of its extremes lost. Pure.

A bucket gives its last value, with the interval of that, at its end. An extreme that lies outside of that interval, as
no chance would explain it, is a point of its own before: the lowest a third into the bucket, the highest two thirds.
"""

from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.history.reading import Course, Past

NARROW: Final = 1.5
"""Ends of an interval further than this factor from their value are not drawn: they would hide all else."""


def points(past: Past, course: Course, lo: Floats, hi: Floats) -> tuple[Floats, Floats]:
    """Unix times [m] and value, lo, hi [m, 3]; NaN where the course has a gap, and behind its end.

    Args:
        past: whose buckets they are
        course: a number over its p buckets
        lo: [p] ends of the interval of each last value; NaN = none
        hi: [p]
    """
    start_s, width_s = past.start_s.astype(np.float64), past.width_s.astype(np.float64)
    newest_s = start_s + width_s
    near = (lo * NARROW > course.last) & (hi < course.last * NARROW)
    lo, hi = np.where(near, lo, np.nan), np.where(near, hi, np.nan)
    ends = [np.fmin(lo, course.last), np.fmax(hi, course.last)]
    parts = [_rows(newest_s, course.last, lo, hi, np.isfinite(course.last))]
    parts.append(_rows(start_s + width_s / 3.0, course.low, lo, hi, course.low < ends[0]))
    parts.append(_rows(start_s + width_s / 1.5, course.high, lo, hi, course.high > ends[1]))
    missing = np.full(start_s.size, np.nan)
    broken = np.append(past.start_s[1:] > past.end_s[:-1], True)
    broken |= ~np.isfinite(course.last)
    parts.append(_rows(newest_s + 1e-3, missing, missing, missing, broken))
    table = np.concatenate(parts)
    table = table[np.argsort(table[:, 0], kind="stable")]
    return table[:, 0], table[:, 1:]


def _rows(
    t_s: Floats, value: Floats, lo: Floats, hi: Floats, there: "np.ndarray[tuple[int], np.dtype[np.bool_]]"
) -> Floats:
    """[some, 4] of those that are there."""
    return np.column_stack([t_s, value, lo, hi])[there]
