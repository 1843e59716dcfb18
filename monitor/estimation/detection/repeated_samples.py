"""Rows that the sensor had not measured anew: what share of a recording repeats the row before for no better reason.

In comes a recording; out goes one number. Rows repeat by coarse resolution too, but then axes do so independently of
each other, and held rows repeat in all axes at once: that tells them apart. Noise may change during a recording, so
that the share is solved for in stretches of ROWS, MOST of them spread over the recording, and their median is the
answer. It takes two axes that move; with fewer it is 0.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Floats, Ints
from monitor.common.compiled import compiled

ROWS: Final = 1000
"""Of a stretch: within it noise is taken to be the same."""
MOST: Final = 500
"""Stretches."""
HALVINGS: Final = 40


def stale_share(values: Floats) -> float:
    """Share of rows [n, 6] that repeat the one before because the sensor had not measured anew; NaN = missing.

    Where a share s of rows is held, axis a repeats in p_a = s + (1 - s) q_a of the rows, q_a by its coarse resolution,
    and all axes at once in s + (1 - s) Π q_a, as noises of axes are independent: one equation for s.

    >>> noise = np.random.default_rng(0).normal(size=(5000, 6)).round()
    >>> stale_share(noise), round(stale_share(noise.repeat(2, axis=0)), 1)
    (0.0, 0.5)
    """
    there = np.array([not np.isnan(column[:1]).all() or not np.isnan(column).all() for column in values.T])
    if there.sum() < 2 or len(values) < 2:
        return 0.0
    begins = np.linspace(0, max(len(values) - ROWS, 0), min(-(-len(values) // ROWS), MOST)).astype(np.int64)
    asked, whole = np.zeros(begins.size, np.int64), np.zeros(begins.size, np.int64)
    repeats = np.zeros((begins.size, values.shape[1]), np.int64)
    _count(values, there, begins, asked, repeats, whole)
    some = asked > 0
    if not some.any():
        return 0.0
    return float(np.median(_held(repeats[some][:, there] / asked[some, None], whole[some] / asked[some])))


@compiled
def _count(values: Floats, there: NDArray[np.bool_], begins: Ints, asked: Ints, repeats: Ints, whole: Ints) -> None:
    """Pairs of rows of each stretch: how many lack nothing, in how many each axis repeats, and in how many all do."""
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
            asked[stretch] += 1
            whole[stretch] += all_same
            if any_same:
                for a in range(values.shape[1]):
                    if there[a]:
                        repeats[stretch, a] += values[i, a] == values[i - 1, a]


def _held(each: Floats, all_of_them: Floats) -> Floats:
    """The shares s [k] that solve all_of_them = s + (1 - s) Π (each - s)/(1 - s), each [k, axes], by halving."""
    explained = each.prod(axis=1)
    # within its counting error; an axis that never moves, each = 1, says nothing for or against
    none = all_of_them <= explained + 3.0 * np.sqrt(explained / ROWS)
    each, all_of_them = each[~none], all_of_them[~none]
    low, high = np.zeros(len(each)), np.minimum(each.min(axis=1), all_of_them)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        by_chance = ((each - middle[:, None]) / (1.0 - middle[:, None])).prod(axis=1)
        more = middle + (1.0 - middle) * by_chance < all_of_them
        low, high = np.where(more, middle, low), np.where(more, high, middle)
    shares = np.zeros(none.size)
    shares[~none] = low
    return shares
