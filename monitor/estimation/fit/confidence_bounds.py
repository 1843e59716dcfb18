"""Ends of intervals, and what a measured variance allows at most: compiled, of one coefficient at a time."""

from typing import Final

import numpy as np

from monitor.common.compiled import compiled
from monitor.estimation.fit.least_squares import N, Q

TWO_SIDED_95: Final = 1.959963984540054
BOUND: Final = TWO_SIDED_95
"""Of an upper bound: 97.5 % for one look, and still 95 % of what is said where terms that come out large are estimated
instead and their intervals miss too."""

SURELY: Final = 3.3
"""σ by which a curve is below a term that it does not have; of 20 τ none is so far by chance in 99 of 100."""

LEAST_SHRUNK: Final = 0.05
"""Below this (under two degrees of freedom) a measured variance is no bound."""


@compiled
def quantile(z, skewness):  # type: ignore[no-untyped-def]
    """Of probability Φ(z), Pearson III of variance one, as χ² with 8/skewness² degrees (Wilson & Hilferty 1931)."""
    s = skewness
    return z if s < 1e-6 else 2.0 / s * (max(1.0 + s * z / 6.0 - s * s / 36.0, 0.0) ** 3 - 1.0)


@compiled
def interval_end(estimate, c0, c1, c2, skewness, z):  # type: ignore[no-untyped-def]
    """√t where the estimate lies k √v(t) above t, k the quantile of Φ(z) with the skewness 2 √c2 of the estimate alone.

    t solves (1 − k²c2) t² − (2û + k²c1) t + û² − k²c0 = 0; the end is clipped at zero.
    """
    k = quantile(z, skewness)
    a = 1.0 - k * k * c2
    b = estimate + 0.5 * k * k * c1
    root = b * b - a * (estimate * estimate - k * k * c0)
    if root < 0.0 or a <= 1e-9:
        return 0.0 if z > 0.0 else np.inf
    t = (b - np.sqrt(root)) / a if z > 0.0 else (b + np.sqrt(root)) / a
    return np.sqrt(max(t, 0.0))


@compiled
def cap(  # type: ignore[no-untyped-def]
    curve, edf, rows, columns, memory, entered, theta, lo, hi, status
):
    """Where the five terms are no description of the curve: none may be more than the whole of it at any τ.

    N only beyond ``memory`` samples: within, the sensor's own filter may have taken white noise away.
    """
    for a in range(5):
        most = np.inf
        for i in rows:
            if columns[i, a] > 0.0 and (a != N or columns[i, N] * memory < 1.0):
                most = min(most, highest(curve[i], edf[i], SURELY) / columns[i, a])
        most = np.sqrt(most)
        if status[a] == 0 or hi[a] <= most:
            continue
        hi[a] = most
        if status[a] == 2 and not lo[a] < np.sqrt(theta[a]) < most:
            entered[a], status[a], lo[a] = False, 1, 0.0


@compiled
def highest(avar, edf, z):  # type: ignore[no-untyped-def]
    """What the truth may be above a measured variance, at z σ (Wilson & Hilferty); infinite with too little freedom."""
    spread = 2.0 / (9.0 * max(edf, 1.0))
    shrunk = 1.0 - spread - z * np.sqrt(spread)
    return avar / shrunk**3 if shrunk > LEAST_SHRUNK else np.inf


@compiled
def bound_by_first_point(avar, edf, column, entered, lo, hi, status):  # type: ignore[no-untyped-def]
    """Q is hidden behind the sensor's band limit: it makes no more than the whole of the first point."""
    entered[Q] = False
    status[Q] = 1
    lo[Q] = 0.0
    hi[Q] = np.sqrt(highest(avar, edf, BOUND) / column)
