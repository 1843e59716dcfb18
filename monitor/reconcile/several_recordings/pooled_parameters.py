"""One parameter from several recordings: the mean by the inverse of their variances, and whether they agree.

In come the 95 % intervals of one parameter, each from a recording by itself; out goes the mean with its interval, and
χ² of their distances from it with its degrees of freedom. A parameter whose intervals are even as factors (a standard
deviation, a time constant) is averaged as its logarithm. Where the recordings disagree, the mean is known no better
than they scatter: its interval is wider by √(χ²/ν) (Birge, "The calculation of errors by the method of least
squares", Phys. Rev. 40, 1932). What has no interval (the name of an axis, an order) is taken from the first.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf, log
from typing import Final

import numpy as np
from scipy.special import chdtrc

from drivers.sample import Floats
from monitor.reconcile.likelihood.hypothesis import Z95
from monitor.reconcile.result import Bounds

DISAGREE: Final = 0.01
"""Probability below which recordings do not agree: each of the many parameters of a report is asked."""
EXACT: Final = 1e-6
"""Of a value: no interval is narrower, as times of samples and numbers in files are rounded."""


@dataclass(frozen=True, slots=True)
class Pooled:
    """A parameter from all recordings that have it."""

    bounds: Bounds
    chi2: float = 0.0  # of the recordings about their mean
    freedom: int = 0  # recordings with an interval, less one

    @property
    def p(self) -> float | None:
        """Probability of a larger χ² if all measure the same; None where fewer than two have an interval."""
        return agreement([self])


def agreement(parameters: Iterable[Pooled]) -> float | None:
    """Probability of a larger χ² of all these together, as if they were independent."""
    every = list(parameters)
    freedom = sum(one.freedom for one in every)
    return float(chdtrc(freedom, sum(one.chi2 for one in every))) if freedom else None


def pooled(found: Sequence[Bounds]) -> Pooled:
    """One parameter from one recording or more.

    >>> both = pooled([Bounds(10.0, 8.04, 11.96), Bounds(12.0, 10.04, 13.96)])  # ± 1 standard deviation each
    >>> print(both.bounds.value, round(both.chi2, 3), both.freedom)
    11.0 2.0 1
    """
    known = [one for one in found if _interval(one) is not None]
    if len(known) < 2:
        return Pooled(known[0] if known else found[0])
    ends, factors = _even(np.array([_interval(one) for one in known]))
    x, deviation = ends[:, 1], 0.5 * (ends[:, 2] - ends[:, 0]) / Z95
    weight = np.maximum(deviation, EXACT * (1.0 if factors else np.abs(x))) ** -2
    mean = float(np.average(x, weights=weight))
    chi2, freedom = float(weight @ (x - mean) ** 2), x.size - 1
    half = Z95 / float(np.sqrt(weight.sum()))
    if chdtrc(freedom, chi2) < DISAGREE:
        half *= (chi2 / freedom) ** 0.5
    middle_and_ends = np.array([mean, mean - half, mean + half])
    values = np.exp(middle_and_ends) if factors else middle_and_ends
    return Pooled(Bounds(*(float(value) for value in values)), chi2, freedom)


def deviations(one: Bounds, value: float) -> float:
    """Between a parameter and a value, in standard deviations of the parameter; 0 where it has no interval.

    >>> round(deviations(Bounds(10.0, 8.04, 11.96), 13.0), 3)
    3.0
    """
    three = _interval(one)
    if three is None:
        return 0.0
    ((lo, at, hi),), factors = _even(np.array([three]))
    other = (log(value) if value > 0.0 else -inf) if factors else value
    return float(abs(at - other) * 2.0 * Z95 / (hi - lo))


def _interval(one: Bounds) -> tuple[float, float, float] | None:
    if isinstance(one.value, str) or one.lo is None or one.hi is None or not one.lo < one.hi:
        return None
    three = one.lo, one.value, one.hi
    return three if np.isfinite(three).all() else None


def _even(ends: Floats) -> tuple[Floats, bool]:
    """Intervals [k, 3] on the scale on which they are even, and whether that is the logarithm."""
    lo, value, hi = ends.T
    if np.any(lo <= 0.0) or np.abs(value - np.sqrt(lo * hi)).sum() >= np.abs(value - 0.5 * (lo + hi)).sum():
        return ends, False
    return np.log(ends), True
