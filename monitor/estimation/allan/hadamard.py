"""Overlapping Hadamard variance: Allan's with third differences of phase, which no linear drift of the rate moves.

NIST SP 1065 eq. 20 on rates: σ²(m) = mean of (x_{i+3m} − 3 x_{i+2m} + 3 x_{i+m} − x_i)² / 6m² over every i, m ≤ n/3.
The 6 makes white noise read as in Allan's; the others do not: quantization 10/9 of it, flicker 0.811, random walk 0.5
beyond the first few samples. So it stands beside the Allan curve, to read past a ramp or slow heating, and is not
corrected to it.

Degrees of freedom are 2 E²/Var of the fitted mixture from the exact covariance of its terms, where the formula of
Greenhall & Riley (PTTI 2003, d = 3) holds for one power law at a time. What is missing strikes out the terms across it.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.sample import Floats, Ints
from monitor.common.compiled import compiled
from monitor.estimation.allan.difference_moments import SOURCES, Moments, autocovariance, nodes, per_sample, spread
from monitor.estimation.allan.total import octaves, phase_of

FARTHEST: Final = 16
"""Clusters apart beyond which terms share nothing: the square of what flicker leaves is 1e-9 of that of one term."""


@dataclass(frozen=True, slots=True)
class HadamardCurve:
    """Overlapping Hadamard variance at m averaging times of k axes."""

    tau_s: Floats  # [m]
    factors: Ints  # [m] cluster sizes in samples
    hvar: Floats  # [m, k] unit²; NaN where no term is complete
    terms: Ints  # [m, k] third differences averaged
    edf: Floats  # [m, k] equivalent degrees of freedom; NaN where no noise is known
    lo: Floats  # [m, k] deviation, lower end of the 95 % interval
    hi: Floats  # [m, k] deviation, upper end


def hadamard(values: Floats, factors: Ints) -> tuple[Floats, Ints]:
    """Overlapping Hadamard variance [m, k] of rates [n, k], and the number of its terms [m, k].

    τ0 does not enter. What is not finite is missing.

    >>> ramp = np.arange(90.0)[:, None]
    >>> hadamard(ramp + np.tile([[0.0], [0.5]], (45, 1)), np.array([1, 2]))[0].ravel().round(12).tolist()
    [0.166666666667, 0.0]
    """
    phase, missing = phase_of(values)
    sums = np.zeros((factors.size, values.shape[1]))
    terms = np.zeros(sums.shape, np.int64)
    for i, m in enumerate(factors):
        add_hadamard(phase, missing, 0, len(values), int(m), sums[i], terms[i])
    return variance(sums, terms, factors), terms


def hadamard_curve(values: Floats, rate_hz: float, theta: Floats, factors: Ints | None = None) -> HadamardCurve:
    """Hadamard variance of a record with intervals.

    Args:
        values: [n, k] rates; what is not finite is missing
        rate_hz: samples a second
        theta: [5, k] fitted Q² N² B² K² R² in SI, as ``fit.Fit.theta``; NaN = not known
        factors: cluster sizes up to n/3; None = octaves
    """
    n = len(values)
    factors = octaves(n // 3) if factors is None else factors
    raw, terms = hadamard(values, factors)
    return curve_of([moments(n, int(m)) for m in factors], rate_hz, theta, raw, terms)


def curve_of(known: Iterable[Moments], rate_hz: float, theta: Floats, raw: Floats, terms: Ints) -> HadamardCurve:
    """Variances [m, k] to a curve."""
    each = list(known)
    _, edf, lo, hi = spread(each, per_sample(theta, rate_hz), raw, terms)
    factors = np.array([one.factor for one in each])
    return HadamardCurve(factors / rate_hz, factors, raw, terms, edf, lo, hi)


def variance(sums: Floats, terms: Ints, factors: Ints) -> Floats:
    """Sums of squared third differences to variances."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(terms > 0, sums / (6.0 * factors[:, None] ** 2 * terms), np.nan))


def moments(n: int, factor: int) -> Moments:
    """Mean and covariance of the Hadamard variance of ``n`` samples, 3 factor ≤ n; a millisecond.

    White noise, m = 1: neighbours share parts, edf = 18/35 of the terms.

    >>> one = moments(35_002, 1)
    >>> round(2 * one.mean[1] ** 2 / one.covariance[1, 1])
    18000
    """
    terms = n + 1 - 3 * factor
    lags, weights = nodes(0, min(terms, FARTHEST * factor), [factor, 2 * factor, 3 * factor])
    shared = np.zeros((4, lags.size))
    for p, weight in zip(range(-3, 4), (-1.0, 6.0, -15.0, 20.0, -15.0, 6.0, -1.0), strict=True):
        shared += weight * autocovariance(lags + p * factor)
    pairs = weights * (terms - lags) * np.where(lags > 0.0, 2.0, 1.0)
    scale = 1.0 / (6.0 * factor**2)
    mean, covariance = np.zeros(SOURCES), np.zeros((SOURCES, SOURCES))
    mean[:4] = scale * shared[:, np.argmin(lags)]
    covariance[:4, :4] = 2.0 * (scale / terms) ** 2 * (shared * pairs @ shared.T)
    return Moments(n, factor, terms, mean, mean, covariance)


@compiled
def add_hadamard(phase, missing, first, n, m, sums, terms):  # type: ignore[no-untyped-def]
    """Add the squares of all terms of the n + 1 phase points that start at row ``first`` of a ring.

    phase [places, ≥ k] float64, or integers that wrap; missing alike; sums [k] and terms [k] are added to.
    """
    places = phase.shape[0]
    last = (first + n) % places
    whole = True
    for lane in range(sums.size):
        whole = whole and missing[first, lane] == missing[last, lane]
    a, b, c, d = first % places, (first + m) % places, (first + 2 * m) % places, (first + 3 * m) % places
    for _ in range(n + 1 - 3 * m):
        u, v, w, x = np.uintp(a), np.uintp(b), np.uintp(c), np.uintp(d)
        for lane in range(np.uintp(sums.size)):
            if whole or missing[u, lane] == missing[x, lane]:
                e = float(phase[x, lane] - phase[u, lane] - 3 * (phase[w, lane] - phase[v, lane]))
                sums[lane] += e * e
                terms[lane] += 1
        a, b, c, d = a + 1, b + 1, c + 1, d + 1
        if a == places:
            a = 0
        if b == places:
            b = 0
        if c == places:
            c = 0
        if d == places:
            d = 0
