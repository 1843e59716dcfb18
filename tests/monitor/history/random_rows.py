"""Random history rows, and their aggregates computed independently in pure Python."""

import math
from collections.abc import Sequence

import numpy as np

from monitor.history.history_row import HistoryRow

COLUMN_NAMES = ("gz.N", "gz.sigma.1", "rate")


def make_row(
    start_s: int,
    rng: np.random.Generator,
    width_s: int = 60,
    names: tuple[str, ...] = COLUMN_NAMES,
    missing: float = 0.2,
) -> HistoryRow:
    """Return a row of random values in which some columns are missing."""
    k = len(names)
    present = rng.random(k) >= missing
    draws = np.sort(rng.lognormal(-9.0, 2.0, (3, k)).astype(np.float32), axis=0)
    low, last, high = (np.where(present, part, np.float32(np.nan)) for part in draws)
    n = np.where(present, rng.integers(1, 600, k), 0)
    counts = tuple(int(count) for count in rng.integers(0, 6000, 4))
    return HistoryRow(
        start_s, width_s, start_s + width_s - 0.5, names, n, low, high, last, counts, int(rng.integers(0, 4))
    )


def aggregate_column(rows: Sequence[HistoryRow], name: str) -> tuple[int, float, float, float]:
    """Return n, low, high and last of a column over rows in order of time."""
    n, low, high, last = 0, math.inf, -math.inf, math.nan
    for row in rows:
        if name in row.names:
            at = row.names.index(name)
            if int(row.n[at]):
                n += int(row.n[at])
                low, high, last = min(low, float(row.low[at])), max(high, float(row.high[at])), float(row.last[at])
    return (n, low, high, last) if n else (0, math.nan, math.nan, math.nan)


def equal_with_nan(found: tuple[float, ...], expected: tuple[float, ...]) -> bool:
    """Return True if all values are equal, where NaN equals NaN."""
    return all(a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(found, expected, strict=True))


def get_column_values(row: HistoryRow, name: str) -> tuple[int, float, float, float]:
    """Return n, low, high and last of a column; an absent column has n = 0."""
    if name not in row.names:
        return 0, math.nan, math.nan, math.nan
    at = row.names.index(name)
    return int(row.n[at]), float(row.low[at]), float(row.high[at]), float(row.last[at])
