"""Samples that are missing, wrong or clipped, replaced by such as might have been there.

``filled`` draws each from around it: the mean of good neighbours and what another neighbour, by chance, is away from
its own, so that level, drift and white noise go on through the hole. The neighbourhood is as wide as the drift allows.
A mean carries the noise of what it is made of; where p samples of a hundred are missing, frequencies below one over the
neighbourhood therefore read 2p percent high where noise is white, and no others do. Through a long hole runs a line
between the levels at its ends, wandering as much as the recording does over such a time.

``unclipped`` draws from the tail of a Gaussian beyond the limit, about a level that knows what was clipped.

What comes in stays as it is; of the samples that were good none changes.
"""

from typing import Final

import numpy as np
from scipy.special import log_ndtr, ndtr, ndtri

from drivers.sample import Floats, Ints
from monitor.common.compiled import compiled
from monitor.reconcile.preparation.value_statistics import Mask

WIDTHS: Final = (1024, 256, 64, 16, 4)
"""Samples on each side that a neighbourhood may have, widest first."""
DRIFT: Final = 1.01
"""A neighbourhood whose mean foretells samples worse than the best one, by more than this in variance, is too wide."""
ASKED: Final = 20_000
"""Samples at which widths are compared."""
DONORS: Final = 1024
"""Good samples on each side of which any may lend what it is away from its own level."""
LONG: Final = 100
"""Samples: longer holes are bridged."""
WANDERS: Final = 16
"""Times that the way over which the recording's wandering is measured goes into it, at least."""
LEVEL: Final = 64
"""Samples on each side that the level of clipped samples is taken from."""
ROUNDS: Final = 50
"""Of the level and the samples beyond the limit in turn, at most."""
SETTLED: Final = 1e-2
"""Deviations that no sample moves by any more."""


def filled(y: Floats, mask: Mask, rng: np.random.Generator) -> Floats:
    """A copy of y [n] with the samples of ``mask`` [n] and those that are no number replaced.

    Raises:
        ValueError: no sample is good

    >>> rng = np.random.default_rng(0)
    >>> y = 5.0 + rng.standard_normal(100_000)
    >>> new = filled(y, rng.random(100_000) < 0.3, rng)
    >>> print(f"{new.mean():.2f} {new.std():.2f}")
    5.00 1.00
    """
    good = np.isfinite(y) & ~mask
    missing = np.flatnonzero(~good)
    new = y.copy()
    if not missing.size:
        return new
    where = np.flatnonzero(good)
    if not where.size:
        raise ValueError("no sample is good")
    middle = float(y[where[where.size // 2]])
    sums, counts = _sums(y, good, middle)
    width = _width(y, where, sums, counts, middle)
    _draw(new, where, missing, sums, counts, middle, width, rng.random(missing.size))
    breaks = np.flatnonzero(np.diff(missing) > 1)
    firsts = missing[np.concatenate([[0], breaks + 1])]
    lasts = missing[np.concatenate([breaks, [missing.size - 1]])]
    for first, last in zip(firsts, lasts, strict=True):
        if last - first >= LONG and first > 0 and last < y.size - 1:
            length = int(last - first + 1)
            wander = _wander(sums, counts, length, width)
            new[first : last + 1] += _bridge(length, wander, rng)
    return new


def unclipped(y: Floats, limit: float, sigma: float, rng: np.random.Generator) -> Floats:
    """A copy of y [n] with the samples at or beyond ± limit replaced by draws from beyond it.

    Args:
        y: values [n]; NaN stay
        limit: of the range
        sigma: deviation of the noise before it was clipped

    >>> rng = np.random.default_rng(0)
    >>> x = 0.5 + rng.standard_normal(100_000)
    >>> new = unclipped(np.clip(x, -1.0, 1.0), 1.0, 1.0, rng)
    >>> print(f"{new.mean():.2f} {new.std():.2f}")
    0.50 1.00
    """
    new = y.copy()
    at = np.flatnonzero(np.abs(y) >= limit * (1.0 - 1e-9))
    if not at.size:
        return new
    side = np.sign(y[at])
    good = np.isfinite(y)
    for _ in range(ROUNDS):
        level = _levels(new, good, at)
        beyond = (limit - side * level) / sigma
        # mean of the tail: m + σ φ(a)/Φ(−a)
        tail = level + side * sigma * np.exp(-0.5 * beyond**2 - log_ndtr(-beyond)) / np.sqrt(2.0 * np.pi)
        moved = float(np.abs(tail - new[at]).max())
        new[at] = tail
        if moved < SETTLED * sigma:
            break
    beyond = (limit - side * _levels(new, good, at)) / sigma
    chance = (1.0 - rng.random(at.size)) * ndtr(-np.minimum(beyond, 37.0))
    new[at] = side * (limit + sigma * np.maximum(-ndtri(chance) - np.minimum(beyond, 37.0), 0.0))
    return new


def _levels(y: Floats, good: Mask, at: Ints) -> Floats:
    """Means of the good among LEVEL samples on each side."""
    sums, counts = _sums(y, good, 0.0)
    lo, hi = np.maximum(at - LEVEL, 0), np.minimum(at + LEVEL + 1, y.size)
    return np.asarray((sums[hi] - sums[lo]) / (counts[hi] - counts[lo]))


@compiled
def _sums(y, good, middle):  # type: ignore[no-untyped-def]
    """Running sums of the good samples less ``middle``, and their number, before each sample."""
    sums, counts = np.empty(y.size + 1), np.empty(y.size + 1, np.int64)
    total, count = 0.0, 0
    for k in range(y.size):
        sums[k], counts[k] = total, count
        if good[k]:
            total += y[k] - middle
            count += 1
    sums[-1], counts[-1] = total, count
    return sums, counts


def _width(y: Floats, where: Ints, sums: Floats, counts: Ints, middle: float) -> int:
    """The widest neighbourhood whose mean, without the sample itself, foretells samples as well as any."""
    some = where[:: max(1, where.size // ASKED)]
    errors = []
    for width in WIDTHS:
        lo, hi = np.maximum(some - width, 0), np.minimum(some + width + 1, y.size)
        others = counts[hi] - counts[lo] - 1
        some_, lo, hi, others = (x[others > 0] for x in (some, lo, hi, others))
        value = y[some_] - middle
        foretold = (sums[hi] - sums[lo] - value) / others
        # a mean of k has the noise of one sample over k more than it need
        errors.append(float(np.mean((value - foretold) ** 2 / (1.0 + 1.0 / others))) if some_.size else np.inf)
    return next(width for width, error in zip(WIDTHS, errors, strict=True) if error <= DRIFT * min(errors))


@compiled
def _draw(new, where, missing, sums, counts, middle, width, chances):  # type: ignore[no-untyped-def]
    """Fill the missing samples of ``new``; ``where`` are the good ones, ``chances`` [missing] in [0, 1)."""
    n = new.size
    for k in range(missing.size):
        at = missing[k]
        # to each side the nearest good samples, as many as the width
        left = counts[at]
        first, last = max(left - width, 0), min(left + width, where.size)
        before, after = left - first, last - left
        lo = where[first]
        hi = where[last - 1] + 1
        gap = where[left] - where[left - 1] if before > 0 and after > 0 else 1
        if gap > LONG:  # a line between the levels at both ends
            start = (sums[where[left - 1] + 1] - sums[lo]) / before
            end = (sums[hi] - sums[where[left]]) / after
            part = (at - where[left - 1]) / gap
            level = start + (end - start) * part
            used = 1.0 / ((1.0 - part) ** 2 / before + part**2 / after)
        else:
            level = (sums[hi] - sums[lo]) / (before + after)
            used = float(before + after)
        pool, stop = max(left - DONORS, 0), min(left + DONORS, where.size)
        donor = where[pool + int(chances[k] * (stop - pool))]
        from_, to = max(donor - width, 0), min(donor + width + 1, n)
        others = counts[to] - counts[from_]
        away = new[donor] - middle - (sums[to] - sums[from_]) / others
        # variances: of the level 1/used, of the donor from its own mean 1 − 1/others; together 1
        grown = 1.0
        if used > 1.0 and others > 1:
            grown = ((1.0 - 1.0 / used) / (1.0 - 1.0 / others)) ** 0.5
        new[at] = middle + level + grown * away


def _wander(sums: Floats, counts: Ints, length: int, width: int) -> float:
    """Variance a sample of a random walk that moves the level over about ``length`` as the recording does."""
    n = counts.size - 1
    length = min(length, n // WANDERS)
    begins = np.arange(0, n - length - 2 * width, max(width, (n - length) // 2000 or 1))
    if begins.size < 8:
        return 0.0
    left, right = counts[begins + width] - counts[begins], counts[begins + length + 2 * width]
    right = right - counts[begins + length + width]
    full = (left > 0.9 * width) & (right > 0.9 * width)
    begins, left, right = begins[full], left[full], right[full]
    if begins.size < 8:
        return 0.0
    first = (sums[begins + width] - sums[begins]) / left
    second = (sums[begins + length + 2 * width] - sums[begins + length + width]) / right
    near = np.diff(first)  # what white noise, and drift within a neighbourhood, move a mean by
    moved = float(np.median((second - first) ** 2)) - float(np.median(near**2))
    return max(moved, 0.0) / 0.4549364231195724 / (length + width)  # median of χ² with one degree of freedom


def _bridge(length: int, variance: float, rng: np.random.Generator) -> Floats:
    """A random walk of that variance a sample that is 0 before its first and after its last sample."""
    walk = np.cumsum(rng.standard_normal(length + 1)) * variance**0.5
    return np.asarray(walk[:-1] - walk[-1] * np.arange(1, length + 1) / (length + 1))
