"""Weighted mean of one parameter over several recordings, and a test of agreement.

Each value is weighted by the inverse of the variance, which follows from the 95 % interval. If an interval is symmetric
on a logarithmic scale, the logarithms are averaged. If the recordings disagree, the interval of the mean is widened by
√(χ²/ν) with ν degrees of freedom (Birge, "The calculation of errors by the method of least squares", Phys. Rev. 40,
1932).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf, log
from typing import Final

import numpy as np
from scipy.special import chdtrc

from drivers.data_types import Floats
from monitor.common.distributions import Z95
from monitor.reconcile.result import ParameterInterval

MIN_AGREEMENT_PROBABILITY: Final = 0.01
"""Probability below which recordings disagree. The value is small, because a report contains many parameters."""
MIN_RELATIVE_ERROR: Final = 1e-6
"""Smallest assumed standard deviation relative to the value, because numbers in files are rounded."""


@dataclass(frozen=True, slots=True)
class PooledParameter:
    """Parameter averaged over several recordings."""

    bounds: ParameterInterval
    chi2: float = 0.0  # χ² of the recordings about their mean
    freedom: int = 0  # degrees of freedom: number of recordings with an interval, less one

    @property
    def p_value(self) -> float | None:
        """Probability of a larger χ² if the true value is the same in all recordings."""
        return agreement_probability([self])


def agreement_probability(parameters: Iterable[PooledParameter]) -> float | None:
    """Return the probability of a larger χ² sum if all parameters agree, or None without degrees of freedom."""
    every = list(parameters)
    freedom = sum(one.freedom for one in every)
    return float(chdtrc(freedom, sum(one.chi2 for one in every))) if freedom else None


def pool_parameter(intervals: Sequence[ParameterInterval]) -> PooledParameter:
    """Compute the weighted mean of one parameter over one or more recordings.

    Examples
    --------
    >>> both = pool_parameter([ParameterInterval(10.0, 8.04, 11.96), ParameterInterval(12.0, 10.04, 13.96)])
    >>> print(round(both.bounds.value, 3), round(both.chi2, 3), both.freedom)
    11.0 2.0 1
    """
    known = [one for one in intervals if _finite_interval(one) is not None]
    if len(known) < 2:
        return PooledParameter(known[0] if known else intervals[0])
    ends, factors = _symmetric_scale(np.array([_finite_interval(one) for one in known]))
    x, deviation = ends[:, 1], 0.5 * (ends[:, 2] - ends[:, 0]) / Z95
    weight = np.maximum(deviation, MIN_RELATIVE_ERROR * (1.0 if factors else np.abs(x))) ** -2
    mean = float(np.average(x, weights=weight))
    chi2, freedom = float(weight @ (x - mean) ** 2), x.size - 1
    half = Z95 / float(np.sqrt(weight.sum()))
    if chdtrc(freedom, chi2) < MIN_AGREEMENT_PROBABILITY:
        half *= (chi2 / freedom) ** 0.5
    middle_and_ends = np.array([mean, mean - half, mean + half])
    values = np.exp(middle_and_ends) if factors else middle_and_ends
    return PooledParameter(ParameterInterval(*(float(value) for value in values)), chi2, freedom)


def distance_in_sigma(bounds: ParameterInterval, value: float) -> float:
    """Return the distance between a value and a parameter, in standard deviations of the parameter.

    The distance is 0 if the parameter has no interval.

    Parameters
    ----------
    bounds : ParameterInterval
        Parameter with its interval.
    value : float
        Value in the unit of the parameter.

    Examples
    --------
    >>> round(distance_in_sigma(ParameterInterval(10.0, 8.04, 11.96), 13.0), 3)
    3.0
    """
    three = _finite_interval(bounds)
    if three is None:
        return 0.0
    ((lo, at, hi),), factors = _symmetric_scale(np.array([three]))
    other = (log(value) if value > 0.0 else -inf) if factors else value
    return float(abs(at - other) * 2.0 * Z95 / (hi - lo))


def _finite_interval(bounds: ParameterInterval) -> tuple[float, float, float] | None:
    """Return the lower end, the value and the upper end of a finite interval, otherwise None."""
    if isinstance(bounds.value, str) or bounds.lo is None or bounds.hi is None or not bounds.lo < bounds.hi:
        return None
    three = bounds.lo, bounds.value, bounds.hi
    return three if np.isfinite(three).all() else None


def _symmetric_scale(ends: Floats) -> tuple[Floats, bool]:
    """Return intervals, shape (k, 3), on a symmetric scale, and True for a logarithmic scale."""
    lo, value, hi = ends.T
    if np.any(lo <= 0.0) or np.abs(value - np.sqrt(lo * hi)).sum() >= np.abs(value - 0.5 * (lo + hi)).sum():
        return ends, False
    return np.log(ends), True
