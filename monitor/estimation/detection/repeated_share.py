"""Share of samples that repeat the previous sample because the sensor had no new measurement.

With coarse resolution, values can also repeat by chance, but only on single axes, whereas a repeated measurement
repeats all axes. Because the noise may change during a recording, the share is the median over segments of ``ROWS``
samples.

The command ``reconcile`` does not use this module but tests each axis separately, because it needs the positions of the
repeated samples.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats, Ints
from monitor.common.compiled import as_read_only, compiled

ROWS: Final = 1000
"""Number of samples in a segment, during which the noise is assumed to be constant."""
MAX_STRETCHES: Final = 500
BISECTIONS: Final = 40


def estimate_stale_sample_share(values: Floats) -> float:
    """Return the share of samples [n, 6] that repeat the previous sample because the sensor had no new measurement.

    Let s be the share of repeated measurements, and q_a the probability that the value of axis a repeats by chance.
    The share of repeated samples is then s + (1 - s) q_a on axis a, and s + (1 - s) Π q_a on all axes at once. The
    function solves these equations for s. NaN means missing. For fewer than two measured axes, the share is 0.

    >>> noise = np.random.default_rng(0).normal(size=(5000, 6)).round()
    >>> estimate_stale_sample_share(noise), round(estimate_stale_sample_share(noise.repeat(2, axis=0)), 1)
    (0.0, 0.5)
    """
    there = np.array([not np.isnan(column[:1]).all() or not np.isnan(column).all() for column in values.T])
    if there.sum() < 2 or len(values) < 2:
        return 0.0
    begins = np.linspace(0, max(len(values) - ROWS, 0), min(-(-len(values) // ROWS), MAX_STRETCHES)).astype(np.int64)
    pairs, whole = np.zeros(begins.size, np.int64), np.zeros(begins.size, np.int64)
    repeats = np.zeros((begins.size, values.shape[1]), np.int64)
    _count(as_read_only(values), there, begins, pairs, repeats, whole)
    some = pairs > 0
    if not some.any():
        return 0.0
    return float(np.median(_solve_share(repeats[some][:, there] / pairs[some, None], whole[some] / pairs[some])))


@compiled
def _count(values: Floats, there: NDArray[np.bool_], begins: Ints, pairs: Ints, repeats: Ints, whole: Ints) -> None:
    for stretch in range(begins.size):
        begin = begins[stretch]
        for i in range(begin + 1, min(begin + ROWS, len(values))):
            lacks, all_same, any_same = False, True, False
            for a in range(values.shape[1]):
                if there[a]:
                    one, before = values[i, a], values[i - 1, a]
                    lacks |= np.isnan(one) or np.isnan(before)
                    all_same &= one == before
                    any_same |= one == before
            if lacks:
                continue
            pairs[stretch] += 1
            whole[stretch] += all_same
            if any_same:
                for a in range(values.shape[1]):
                    if there[a]:
                        repeats[stretch, a] += values[i, a] == values[i - 1, a]


def _solve_share(each: Floats, all_of_them: Floats) -> Floats:
    """Solve all_of_them = s + (1 - s) Π (each - s)/(1 - s) for the shares s [k] by bisection.

    ``each`` [k, axes] is the share of samples in which an axis repeats. ``all_of_them`` [k] is the share of samples in
    which all axes repeat.
    """
    explained = each.prod(axis=1)
    none = all_of_them <= explained + 3.0 * np.sqrt(explained / ROWS)
    each, all_of_them = each[~none], all_of_them[~none]
    low, high = np.zeros(len(each)), np.minimum(each.min(axis=1), all_of_them)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        by_chance = ((each - middle[:, None]) / (1.0 - middle[:, None])).prod(axis=1)
        more = middle + (1.0 - middle) * by_chance < all_of_them
        low, high = np.where(more, middle, low), np.where(more, high, middle)
    shares = np.zeros(none.size)
    shares[~none] = low
    return shares
