"""Compiled functions that compute the confidence interval and the upper bound of a noise coefficient."""

from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled
from monitor.common.distributions import Z95
from monitor.estimation.fit.fit_kernel_types import TermResults
from monitor.estimation.fit.least_squares import N, Q

UPPER_BOUND_Z: Final = Z95
"""Quantile of the normal distribution from which an upper bound is computed.

An upper bound is only reported for small coefficients, because large coefficients are estimated. The probability that a
reported bound holds is therefore not 97.5 %, but at least 95 %.
"""
EXCLUSION_SIGMA: Final = 3.3
"""Deviation in σ at which a measured Allan variance excludes the contribution of a noise term.

With a probability of 1 %, at least one of 20 Allan variances deviates by 3.3 σ.
"""
MIN_CUBE_ROOT_FACTOR: Final = 0.05
"""Minimum value of the normalized cube root of χ² for which the upper limit is finite."""


@compiled
def pearson_quantile(z: float, skewness: float) -> float:
    """Return the quantile of the standardized Pearson III distribution for the probability Φ(z).

    The quantile is computed with the approximation of Wilson & Hilferty (1931).

    Parameters
    ----------
    z : float
        Quantile of the standard normal distribution.
    skewness : float
        Skewness of the distribution.
    """
    s = skewness
    return z if s < 1e-6 else 2.0 / s * (max(1.0 + s * z / 6.0 - s * s / 36.0, 0.0) ** 3 - 1.0)


@compiled
def confidence_interval_end(estimate: float, c0: float, c1: float, c2: float, z: float) -> float:
    """Return the lower or upper end of the confidence interval of a coefficient.

    The end of the interval is √t, where the estimate û differs from t by k standard deviations √v(t). The factor k is a
    quantile of the Pearson III distribution with skewness 2 √c2. The value t is a solution of the quadratic equation (1
    − k²c2) t² − (2û + k²c1) t + û² − k²c0 = 0. A negative solution is replaced by zero.

    Parameters
    ----------
    estimate : float
        Unconstrained estimate û of the squared coefficient.
    c0, c1, c2 : float
        Coefficients of the variance v(t) = c0 + c1 t + c2 t² of û.
    z : float
        Quantile of the normal distribution, positive for the lower end and negative for the upper end.
    """
    k = pearson_quantile(z, 2.0 * np.sqrt(c2))
    a = 1.0 - k * k * c2
    b = estimate + 0.5 * k * k * c1
    root = b * b - a * (estimate * estimate - k * k * c0)
    if root < 0.0 or a <= 1e-9:
        return 0.0 if z > 0.0 else np.inf
    t = (b - np.sqrt(root)) / a if z > 0.0 else (b + np.sqrt(root)) / a
    return float(np.sqrt(max(t, 0.0)))


@compiled
def limit_terms_by_measured_avar(
    avar: Floats, excess: Floats, edf: Floats, rows: Ints, unit_avar: Floats, filter_memory: int, terms: TermResults
) -> None:
    """Limit each coefficient so that no noise term alone exceeds a measured Allan variance.

    N is limited only by the Allan variance at τ of more than ``filter_memory`` samples. At shorter τ, a low-pass filter
    in the sensor may have removed white noise. The contribution of missing samples is not subtracted from the limits,
    because it is too large if the samples are missing periodically beside a line.

    Parameters
    ----------
    avar, excess, edf : ndarray of float64, shape (m,)
        Allan variances, contributions of missing samples that have been subtracted, and degrees of freedom.
    rows : ndarray of int64
        Indices of the τ to use.
    unit_avar : ndarray of float64, shape (m, 5)
        Allan variance for each unit coefficient.
    filter_memory : int
        Length of the impulse response of the low-pass filter in samples.
    terms : TermResults
        Results of the fit, updated in place.
    """
    for a in range(5):
        most = np.inf
        for i in rows:
            if unit_avar[i, a] > 0.0 and (a != N or unit_avar[i, N] * filter_memory < 1.0):
                limit = avar_upper_limit(avar[i] + excess[i], 0.0, edf[i], EXCLUSION_SIGMA)
                most = min(most, limit / unit_avar[i, a])
        most = np.sqrt(most)
        if terms.status[a] == 0 or terms.hi[a] <= most:
            continue
        terms.hi[a] = most
        if terms.status[a] == 2 and not terms.lo[a] < np.sqrt(terms.theta[a]) < most:
            terms.entered[a], terms.status[a], terms.lo[a] = False, 1, 0.0


@compiled
def avar_upper_limit(avar: float, excess: float, edf: float, z: float) -> float:
    """Return the upper confidence limit of the true Allan variance at z σ (Wilson & Hilferty 1931).

    With too few degrees of freedom, the limit is infinite.

    Parameters
    ----------
    avar, excess : float
        Measured Allan variance, and the contribution of missing samples that has been subtracted from it.
    edf : float
        Degrees of freedom of the Allan variance.
    z : float
        Quantile of the standard normal distribution.
    """
    spread = 2.0 / (9.0 * max(edf, 1.0))
    shrunk = 1.0 - spread - z * np.sqrt(spread)
    return float(max((avar + excess) / shrunk**3 - excess, 0.0) if shrunk > MIN_CUBE_ROOT_FACTOR else np.inf)


@compiled
def bound_q_by_first_point(avar: float, excess: float, edf: float, unit_avar: float, terms: TermResults) -> None:
    """Compute an upper bound of Q from the Allan variance at the shortest τ.

    Parameters
    ----------
    avar, excess, edf : float
        Allan variance at the shortest τ, contribution of missing samples, and degrees of freedom.
    unit_avar : float
        Allan variance of unit Q at the shortest τ.
    terms : TermResults
        Results of the fit, updated in place.
    """
    terms.entered[Q], terms.status[Q] = False, 1
    terms.lo[Q], terms.hi[Q] = 0.0, np.sqrt(avar_upper_limit(avar, excess, edf, UPPER_BOUND_Z) / unit_avar)
