"""Quantiles and tail probabilities of the normal, χ², Student and F distributions.

The functions avoid a dependency on SciPy, which is a large package. Over the documented ranges, the relative difference
from SciPy is at most 1e-12.
"""

from functools import lru_cache
from math import exp, inf, lgamma, log, log1p, pi, sqrt
from statistics import NormalDist
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monitor.common.compiled import compiled, inlined

Floats = NDArray[np.float64]

CORNISH_FISHER_TERMS: Final = 10
MIN_ASYMPTOTIC_EDF: Final = 1000.0
"""Smallest number of degrees of freedom for which the Cornish-Fisher expansion is exact to rounding."""
MIN_EXPANDED_EDF: Final = 30.0
"""Smallest number of degrees of freedom for which the Halley iteration starts from the Cornish-Fisher expansion."""
MAX_ITERATIONS: Final = 60
STEP_TOLERANCE: Final = 1e-7
"""Relative step below which a Halley or Newton iteration ends. The result is then exact to rounding."""
FRACTION_TOLERANCE: Final = 1e-15
MIN_ASYMPTOTIC_DF: Final = 1000
"""Smallest number of degrees of freedom for which four terms of the expansion of Student's quantile are exact to
rounding.
"""
TINY: Final = 1e-300
"""Value that replaces zeros in the continued fraction."""

Z95: Final = 1.959963984540054
"""Quantile of the standard normal distribution for a two-sided probability of 95 %."""
HALF_CHI2_95: Final = 0.5 * Z95**2
"""Decrease of the log-likelihood at the ends of a 95 % interval: half of the 95 % quantile of χ² with one degree of
freedom."""
NORMAL_QUARTILE: Final = 0.6744897501960817
"""Upper quartile of the standard normal distribution, which is also the median absolute value."""

_NORMAL: Final = NormalDist()


def normal_quantile(probability: float) -> float:
    """Return the quantile of the standard normal distribution. The quantiles of 0 and 1 are infinite.

    Parameters
    ----------
    probability : float
        Lower tail probability, 0 to 1.

    Examples
    --------
    >>> f"{normal_quantile(0.975):.6f}"
    '1.959964'
    """
    if probability in (0.0, 1.0):
        return inf if probability else -inf
    return _NORMAL.inv_cdf(probability)


# --- χ²


class Chi2Level(NamedTuple):
    """Lower tail probability of the χ² distribution, with the expansion of its quantile (``expand_chi2_quantile``)."""

    probability: float
    z: float
    coefficients: Floats


@lru_cache(maxsize=16)
def expand_chi2_quantile(probability: float) -> Chi2Level:
    """Return the normal quantile z and the coefficients y_k(z) of the Cornish-Fisher expansion of a gamma quantile.

    The probability must be from 0.001 to 0.975. The accuracy of ``chi2_quantile`` decreases above 0.975.

    With shape a, normal quantile z and ε = 1/√a, the expansion is x = a (1 + ε Σ y_k ε^k). For the normal density φ and
    the gamma density f, the differential equation x' = φ(z)/f(x) gives y_0 = z and y_k'' − z y_k' − y_k = r_k. The
    coefficient y_k is the only polynomial solution of the equation of order k. The first five coefficients agree with
    Goldberg & Levine (Annals of Mathematical Statistics 17, 1946).
    """
    z = normal_quantile(probability)
    poly = np.polynomial.Polynomial
    x = poly([0.0, 1.0])
    y, first, second, squares = [x], [poly([1.0])], [poly([0.0])], [poly([1.0])]  # coefficients of y, y', y'', y'²
    for k in range(1, CORNISH_FISHER_TERMS):
        square = sum((first[i] * first[k - i] for i in range(1, k)), poly([0.0]))
        r = squares[k - 1] + x * square + sum((y[i] * squares[k - i] for i in range(1, k)), poly([0.0]))
        r = r - sum((y[i] * (second[k - 1 - i] + x * first[k - 1 - i]) for i in range(k)), poly([0.0]))
        u = np.zeros(r.coef.size + 2)
        for j in reversed(range(r.coef.size)):
            u[j] = ((j + 2) * (j + 1) * u[j + 2] - r.coef[j]) / (j + 1)
        y.append(poly(np.trim_zeros(u, "b")))
        first.append(y[k].deriv())
        second.append(first[k].deriv())
        squares.append(square + 2.0 * first[k])
    return Chi2Level(probability, z, np.array([float(one(z)) for one in y]))


@compiled
def chi2_quantile(edf: float, level: Chi2Level) -> float:
    """Return the quantile of the χ² distribution.

    The quantile x solves P(edf/2, x/2) = probability, where P is the regularised incomplete gamma function. The
    function uses Halley's iteration, and a Cornish-Fisher expansion for many degrees of freedom.

    Parameters
    ----------
    edf : float
        Degrees of freedom, at least 0.01, not necessarily an integer. The result is NaN for NaN, zero and negative
        values.
    level : Chi2Level
        Result of ``expand_chi2_quantile``.

    Examples
    --------
    >>> [round(chi2_quantile(edf, expand_chi2_quantile(0.975)), 3) for edf in (1.0, 10.0, 1e6)]
    [5.024, 20.483, 1002773.701]
    """
    a = 0.5 * edf
    if not a > 0.0:
        return float(np.nan)
    if edf < MIN_EXPANDED_EDF:
        return 2.0 * _refined(a, _start(a, level.z, level.probability), level.probability)
    x = _expanded(a, level.coefficients)
    return 2.0 * (_refined(a, x, level.probability) if edf < MIN_ASYMPTOTIC_EDF else x)


@compiled
def _expanded(a: float, coefficients: Floats) -> float:
    """Return the Cornish-Fisher expansion of the quantile of the gamma distribution with shape ``a``."""
    epsilon = 1.0 / sqrt(a)
    total = 0.0
    for k in range(coefficients.size - 1, -1, -1):
        total = coefficients[k] + total * epsilon
    return a * (1.0 + epsilon * total)


@compiled
def _start(a: float, z: float, probability: float) -> float:
    """Return a start value for the gamma quantile: the power law near zero, or the formula of Wilson and Hilferty."""
    at_zero = exp((log(probability) + lgamma(a + 1.0)) / a)
    root = max(1.0 - 1.0 / (9.0 * a) + z / (3.0 * sqrt(a)), 0.0)
    return at_zero if at_zero < 0.2 * (a + 1.0) or root == 0.0 else a * root * root * root


@compiled
def _refined(a: float, x: float, probability: float) -> float:
    """Solve P(a, x) = probability for x by Halley's iteration in ln x.

    With the gamma density f, the derivatives of P with respect to ln x are x f(x) and (a − x) x f(x).
    """
    if x == 0.0:  # the quantile underflows
        return x
    log_gamma = lgamma(a)
    for _ in range(MAX_ITERATIONS):
        slope = exp(a * log(x) - x - log_gamma)
        newton = (slope * _series(a, x) - probability) / slope
        bend = min(max(0.5 * newton * (a - x), -0.5), 0.5)
        step = min(max(newton / (1.0 - bend), -2.0), 2.0)
        x *= exp(-step)
        if abs(step) <= STEP_TOLERANCE:
            break
    return x


@compiled
def _series(a: float, x: float) -> float:
    """Return the power series Σ_n x^n / (a (a + 1) … (a + n)), which equals P(a, x) Γ(a) / (x^a e^−x)."""
    total = term = 1.0 / a
    n = a
    while term > 1e-17 * total:
        n += 1.0
        term *= x / n
        total += term
    return total


# --- F and Student


def incomplete_beta(a: float, b: float, x: Floats) -> Floats:
    """Return the regularised incomplete beta function I_x(a, b), computed by a continued fraction (DLMF 8.17.22).

    For the F distribution with m and n degrees of freedom, P(F > f) = I_x(n/2, m/2) with x = n / (n + m f).

    Parameters
    ----------
    a, b : float
        Shape parameters, from 0.5 to 500.
    x : float64 [n]
        Argument, from 0 to 1.

    Returns
    -------
    float64 [n]
        I_x(a, b).

    Examples
    --------
    >>> incomplete_beta(2.0, 0.5, np.array([0.0, 0.5, 1.0])).round(6).tolist()
    [0.0, 0.116117, 1.0]
    """
    front = lgamma(a + b) - lgamma(a) - lgamma(b)
    other = x > (a + 1.0) / (a + b + 2.0)  # here the continued fraction of the complement converges faster
    p, q = np.where(other, b, a), np.where(other, a, b)
    y = np.where(other, 1.0 - x, x)
    with np.errstate(divide="ignore", under="ignore"):
        size = np.exp(front + p * np.log(y) + q * np.log1p(-y)) / p
    part = np.where(y > 0.0, size * _continued_fraction(p, q, y), 0.0)
    return np.where(other, 1.0 - part, part)


@compiled
def _continued_fraction(a: Floats, b: Floats, x: Floats) -> Floats:
    fractions = np.empty(x.size)
    for i in range(x.size):
        p, q, y = a[i], b[i], x[i]
        c, d = 1.0, 1.0 / _away_from_zero(1.0 - (p + q) * y / (p + 1.0))
        found = d
        for m in range(1, 10_000):
            even = m * (q - m) * y / ((p + 2 * m - 1.0) * (p + 2 * m))
            d = 1.0 / _away_from_zero(1.0 + even * d)
            c = _away_from_zero(1.0 + even / c)
            found *= c * d
            odd = -(p + m) * (p + q + m) * y / ((p + 2 * m) * (p + 2 * m + 1.0))
            d = 1.0 / _away_from_zero(1.0 + odd * d)
            c = _away_from_zero(1.0 + odd / c)
            found *= c * d
            if not abs(c * d - 1.0) > FRACTION_TOLERANCE:
                break
        fractions[i] = found
    return fractions


@inlined
def _away_from_zero(x: float) -> float:
    """Replace values near zero by TINY to prevent a division by zero."""
    return TINY if abs(x) < TINY else x


def student_quantile(df: int, probability: float) -> float:
    """Return the quantile of Student's t distribution.

    The function uses Newton's iteration, and an asymptotic expansion for many degrees of freedom (Abramowitz & Stegun
    26.7.5).

    Parameters
    ----------
    df : int
        Degrees of freedom, 1 or more.
    probability : float
        Lower tail probability, from 0.975 to 0.999.

    Examples
    --------
    >>> f"{student_quantile(1, 0.975):.4f} {student_quantile(30, 0.975):.4f}"
    '12.7062 2.0423'
    """
    z = normal_quantile(probability)
    t: float = z + sum(one / df**k for k, one in enumerate(_student_terms(z), 1))
    if df >= MIN_ASYMPTOTIC_DF:
        return t
    tail = 1.0 - probability
    scale = lgamma(0.5 * (df + 1)) - lgamma(0.5 * df) - 0.5 * log(pi * df)
    for _ in range(MAX_ITERATIONS):
        here = 0.5 * float(incomplete_beta(0.5 * df, 0.5, np.array([df / (df + t * t)]))[0])
        density = exp(scale - 0.5 * (df + 1) * log1p(t * t / df))
        # the tail is nearly a power of t, so the iteration converges faster in logarithms
        step = here / (density * t) * log(here / tail)
        t *= exp(min(max(step, -2.0), 2.0))
        if abs(step) < STEP_TOLERANCE:
            break
    return t


def _student_terms(z: float) -> tuple[float, float, float, float]:
    """Return the coefficients of 1/df, 1/df², 1/df³ and 1/df⁴ in the asymptotic expansion of Student's quantile."""
    return (
        (z**3 + z) / 4.0,
        (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / 96.0,
        (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / 384.0,
        (79.0 * z**9 + 776.0 * z**7 + 1482.0 * z**5 - 1920.0 * z**3 - 945.0 * z) / 92160.0,
    )
