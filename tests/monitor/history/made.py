"""Rows drawn at random, and what they are together by other arithmetic: pure Python, one number at a time."""

import math
from collections.abc import Sequence

import numpy as np

from monitor.history.history_row import HistoryRow

NAMES = ("gz.N", "gz.sigma.1", "rate")


def row(
    start_s: int, rng: np.random.Generator, width_s: int = 60, names: tuple[str, ...] = NAMES, missing: float = 0.2
) -> HistoryRow:
    """Numbers that are there, and some that are not."""
    k = len(names)
    there = rng.random(k) >= missing
    draws = np.sort(rng.lognormal(-9.0, 2.0, (3, k)).astype(np.float32), axis=0)
    low, last, high = (np.where(there, part, np.float32(np.nan)) for part in draws)
    n = np.where(there, rng.integers(1, 600, k), 0)
    counts = tuple(int(one) for one in rng.integers(0, 6000, 4))
    return HistoryRow(
        start_s, width_s, start_s + width_s - 0.5, names, n, low, high, last, counts, int(rng.integers(0, 4))
    )


def together(rows: Sequence[HistoryRow], name: str) -> tuple[int, float, float, float]:
    """n, low, high and last of a number over rows by time."""
    n, low, high, last = 0, math.inf, -math.inf, math.nan
    for one in rows:
        if name in one.names:
            at = one.names.index(name)
            if int(one.n[at]):
                n += int(one.n[at])
                low, high, last = min(low, float(one.low[at])), max(high, float(one.high[at])), float(one.last[at])
    return (n, low, high, last) if n else (0, math.nan, math.nan, math.nan)


def same(found: tuple[float, ...], expected: tuple[float, ...]) -> bool:
    """Equal to the bit, NaN being NaN."""
    return all(a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(found, expected, strict=True))


def numbers_of(one: HistoryRow, name: str) -> tuple[int, float, float, float]:
    """n, low, high and last; of a number that it has not, that it was never there."""
    if name not in one.names:
        return 0, math.nan, math.nan, math.nan
    at = one.names.index(name)
    return int(one.n[at]), float(one.low[at]), float(one.high[at]), float(one.last[at])
