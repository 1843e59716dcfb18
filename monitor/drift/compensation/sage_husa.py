"""Adaptive Kalman filter for the bias of one gyro axis from interval to interval, with its ARMA model.

The state is [x, x̂, level]. The first two elements are the process in the form of Green's function (see ``arma``). The
level is a random walk that is slower than anything in the record of the identification. The measurement is z = x +
level + v. The noise is estimated continuously after Sage and Husa (1969), in the forms that cannot become negative.
With ε = z − ẑ, S its variance, d_k = (1 − b)/(1 − b^{k+1}), k = 1, 2, …

    Q̂ ← Q̂ + d Q̂ D (ε² − S) Dᵀ Q̂,  D = Hᵀ/S        R̂ ← (1 − d) R̂ + d [(1 − H K)² ε² + H P Hᵀ]

Q̂ starts as s B Bᵀ and keeps this form: s ← s + d s² (ε² − S)/S². R̂ could collapse to zero. It is therefore kept above
half of the variance that the scatter within intervals gives, and s above a share of its identified value. The means of
the noise, q̂ and r̂, are not estimated. On recordings at rest they increased the error up to three times, because they
cannot be distinguished from the level.

An interval is rejected if its innovation exceeds OUTLIER_SIGMAS standard deviations, or if its scatter is far above the
usual scatter. Slow rotation has both effects, and its rate may pass through zero. After a rejected interval,
GUARD_INTERVALS successive intervals must therefore agree before one is used again. A step of the bias is assumed only
if the new value persists as long as the level before had been confirmed, within 10 s to 5 min.
"""

from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.drift.compensation.arma import ArmaModel, stationary_covariance

FORGETTING_FACTOR: Final = 0.995
"""Forgetting factor b of the noise estimate. It corresponds to 200 intervals."""
MIN_VARIANCE_SHARE: Final = 0.05
"""Lower limit of s, as a share of the identified variance of a."""
OUTLIER_SIGMAS: Final = 6.0
"""Largest innovation of an accepted interval, in predicted standard deviations."""
MAX_SCATTER_RATIO: Final = (16.0, 10.0)
"""Largest variance within an interval relative to the usual one, and the number of intervals that define the usual one.
Noise alone exceeds the limit with a probability of 1e-6 or less."""
GUARD_INTERVALS: Final = 5.0
"""Intervals that must agree after a rejected interval."""
AGREEMENT_SIGMAS: Final = 4.0
"""Largest difference of two intervals at rest that agree, in standard deviations of the difference."""
STEP_INTERVALS: Final = (10.0, 300.0)
"""Smallest and largest number of intervals after which a persistent change counts as a step."""
MIN_CONFIRMED_INTERVALS: Final = 5
"""Successive intervals at rest that confirm the first level. The carrier may rotate at the start."""
SCATTER_WEIGHT: Final = 0.02
"""Weight of one interval in the average of the scatter within intervals."""
MIN_LEVEL_MEMORY, MAX_LEVEL_MEMORY = 40, 1000
"""Smallest and largest memory of the level in intervals. It is a third of the record of the identification, within
these limits."""

X, P = 0, 3
"""First columns of the state and of its covariance."""
PHI1, PHI2, G1, VARIANCE, LEVEL = range(12, 17)
"""Columns of the model: φ1, φ2, G1, variance of a, and variance of the steps of the level."""
S, R, SCATTER, SCATTER_COUNT, REST_COUNT, OUTLIER_RUN, LAST_OUTLIER, GUARD_LEFT, ADAPTIVE, IDENTIFIED = range(17, 27)
"""Columns of the noise estimate, in the order of ROW_SIZE."""
ROW_SIZE: Final = 27
"""Number of columns of a row.

The columns are the state [3], its covariance [9] and the model, followed by the noise estimate. The noise estimate
holds s, R̂, the scatter within intervals, the number of intervals with a scatter and the number of intervals at rest.
It also holds the number of successive outliers, the last outlier, the remaining guard intervals, and two flags.
ADAPTIVE is 1 if the noise is estimated, and IDENTIFIED is 1 if a model has been identified.
"""
NOT_AT_REST, USED, REJECTED, STEPPED = range(4)
"""Outcomes of an interval: not at rest, used, rejected, or used as a step of the bias."""


def initial_row(adapts: bool) -> Floats:
    """Return a row before the first identification, which models a level only.

    ``adapts`` is True if the noise is to be estimated continuously.
    """
    row = np.zeros(ROW_SIZE)
    row[ADAPTIVE] = adapts
    return row


def set_model(row: Floats, arma: ArmaModel) -> None:
    """Set a new model, with an unknown state and the identified noise.

    Parameters
    ----------
    row : ndarray, shape (ROW_SIZE,)
        State of one axis. It is updated in place.
    arma : Arma
        Identified model, in rad/s.
    """
    phi1, phi2 = arma.phi
    p11, p12, p22 = stationary_covariance(phi1, phi2, arma.theta)
    row[X : X + 3] = 0.0, 0.0, arma.mean
    row[P : P + 9] = arma.variance * np.array([p11, p12, 0.0, p12, p22, 0.0, 0.0, 0.0, 0.0])
    row[PHI1], row[PHI2], row[G1] = phi1, phi2, phi1 + arma.theta
    row[VARIANCE] = row[S] = arma.variance
    row[R] = arma.white_variance
    slow = (
        arma.white_variance + arma.variance * ((1.0 + arma.theta) / (1.0 - phi1 - phi2)) ** 2
    )  # spectral density at f = 0
    row[LEVEL] = slow / min(max(arma.count / 3.0, MIN_LEVEL_MEMORY), MAX_LEVEL_MEMORY) ** 2
    row[P + 8] = slow / arma.count
    row[OUTLIER_RUN] = row[GUARD_LEFT] = 0.0
    row[IDENTIFIED] = 1.0


@compiled
def predict(row):  # type: ignore[no-untyped-def]
    """Predict the state of the next interval."""
    phi1, phi2, g1, s = row[PHI1], row[PHI2], row[G1], row[S]
    row[X], row[X + 1] = row[X + 1], phi2 * row[X] + phi1 * row[X + 1]
    p00, p01, p02, p11, p12 = row[P], row[P + 1], row[P + 2], row[P + 4], row[P + 5]
    row[P] = p11 + s
    row[P + 1] = row[P + 3] = phi2 * p01 + phi1 * p11 + g1 * s
    row[P + 4] = phi2 * phi2 * p00 + 2.0 * phi1 * phi2 * p01 + phi1 * phi1 * p11 + g1 * g1 * s
    row[P + 2] = row[P + 6] = p12
    row[P + 5] = row[P + 7] = phi2 * p02 + phi1 * p12
    row[P + 8] += row[LEVEL]


@compiled
def skip_interval(row):  # type: ignore[no-untyped-def]
    """Process an interval that was not at rest."""
    if row[REST_COUNT] < MIN_CONFIRMED_INTERVALS:
        row[REST_COUNT] = 0.0


@compiled
def expected_bias(row):  # type: ignore[no-untyped-def]
    """Return the expected bias of the interval in rad/s and its variance in (rad/s)²."""
    return row[X] + row[X + 2], row[P] + 2.0 * row[P + 2] + row[P + 8]


@compiled
def update_with_interval(row, z, scatter, least):  # type: ignore[no-untyped-def]
    """Process the mean of an interval at rest.

    Parameters
    ----------
    row : ndarray, shape (ROW_SIZE,)
        State of one axis. It is updated in place.
    z : float
        Mean of the interval, rad/s.
    scatter : float
        Variance of the mean from the scatter within the interval, (rad/s)²; NaN = not known.
    least : float
        Smallest variance of the mean, (rad/s)².

    Returns
    -------
    variance : float
        Variance S of the innovation, (rad/s)².
    outcome : int
        USED, LEFT_OUT or STEPPED.
    """
    loud = row[SCATTER_COUNT] >= MAX_SCATTER_RATIO[1] and scatter > MAX_SCATTER_RATIO[0] * max(row[SCATTER], least)
    if scatter == scatter and not loud:
        row[SCATTER_COUNT] += 1.0
        row[SCATTER] += max(SCATTER_WEIGHT, 1.0 / row[SCATTER_COUNT]) * (scatter - row[SCATTER])
    if row[IDENTIFIED] == 0.0:  # The row models a level only, so all other variation is scatter.
        row[R] = max(row[SCATTER], least)
        row[LEVEL] = row[R] / MIN_LEVEL_MEMORY**2
        if row[REST_COUNT] == 0.0:
            row[X + 2], row[P + 8] = z, row[R]
    row[R] = max(row[R], least)
    expected, known = expected_bias(row)
    e, total = z - expected, known + row[R]
    became = USED
    if loud or e * e > OUTLIER_SIGMAS * OUTLIER_SIGMAS * total:
        if row[REST_COUNT] < MIN_CONFIRMED_INTERVALS:
            row[X + 2], row[P + 8], row[REST_COUNT] = z, row[R], 1.0
            return total, REJECTED
        alike = (z - row[LAST_OUTLIER]) ** 2 < 2.0 * OUTLIER_SIGMAS * OUTLIER_SIGMAS * row[R]
        row[OUTLIER_RUN] = row[OUTLIER_RUN] + 1.0 if alike else 1.0
        row[LAST_OUTLIER] = z
        if row[OUTLIER_RUN] < min(max(row[REST_COUNT], STEP_INTERVALS[0]), STEP_INTERVALS[1]):
            row[GUARD_LEFT] = GUARD_INTERVALS
            return total, REJECTED
        became, row[GUARD_LEFT] = STEPPED, 0.0
        row[P + 8] += e * e
        row[SCATTER_COUNT] = 0.0  # The noise may have changed with the level.
    row[OUTLIER_RUN] = 0.0
    if row[GUARD_LEFT] > 0.0:
        agrees = (z - row[LAST_OUTLIER]) ** 2 < 2.0 * AGREEMENT_SIGMAS * AGREEMENT_SIGMAS * row[R]
        row[GUARD_LEFT] = row[GUARD_LEFT] - 1.0 if agrees else GUARD_INTERVALS
        row[LAST_OUTLIER] = z
        return total, REJECTED
    row[REST_COUNT] += 1.0
    _correct(row, e)
    if row[ADAPTIVE] > 0.0 and row[IDENTIFIED] > 0.0 and became == USED:
        d = (1.0 - FORGETTING_FACTOR) / (1.0 - FORGETTING_FACTOR ** (row[REST_COUNT] + 1.0))
        left = row[R] / total  # 1 − H K
        row[R] = max((1.0 - d) * row[R] + d * (left * left * e * e + expected_bias(row)[1]), 0.5 * row[SCATTER], least)
        s = row[S]
        row[S] = max(s + d * s * s * (e * e - total) / (total * total), MIN_VARIANCE_SHARE * row[VARIANCE])
    return total, became


@compiled
def _correct(row, e):  # type: ignore[no-untyped-def]
    """Correct state and covariance with the innovation ``e``: add K ε, and multiply P by I − K H."""
    h = row[P] + row[P + 6], row[P + 1] + row[P + 7], row[P + 2] + row[P + 8]  # H P
    total = h[0] + h[2] + row[R]
    for i in range(3):
        row[X + i] += h[i] / total * e
    for i in range(3):
        for j in range(3):
            row[P + 3 * i + j] -= h[i] * h[j] / total


@compiled
def refilter_history(row, z, scatter, least):  # type: ignore[no-untyped-def]
    """Filter all remembered intervals again after ``set_model``.

    Parameters
    ----------
    row : ndarray, shape (ROW_SIZE,)
        State of one axis. It is updated in place.
    z : ndarray, shape (n,)
        Interval means in rad/s, oldest first; NaN = not at rest.
    scatter : ndarray, shape (n,)
        Variances of the means from the scatter within the intervals, (rad/s)².
    least : float
        Smallest variance of a mean, (rad/s)².
    """
    for k in range(z.size):
        if z[k] == z[k]:
            update_with_interval(row, z[k], scatter[k], least)
        predict(row)
