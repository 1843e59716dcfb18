"""What the bias of one gyro axis does from interval to interval: an adaptive Kalman filter on its ARMA model.

State [x, x̂, level]: the process by Green's function (see ``arma``), and a level that wanders, slower than anything that
the model was identified from. z = x + level + v. Noise is estimated as time goes on, after Sage and Husa (1969), in
the forms that cannot turn negative: with ε = z − ẑ, S its variance, d_k = (1 − b)/(1 − b^{k+1}), k = 1, 2, …

    Q̂ ← Q̂ + d Q̂ D (ε² − S) Dᵀ Q̂,  D = Hᵀ/S        R̂ ← (1 − d) R̂ + d [(1 − H K)² ε² + H P Hᵀ]

Q̂ begins as s B Bᵀ, and so it stays: s ← s + d s² (ε² − S)/S². R̂ can collapse towards nothing; it is kept above half of
what the scatter within intervals says, and s above a share of what was identified. Means of the noise, q̂ and r̂, are not
estimated: on recordings at rest they made the error up to three times as large, as nothing tells them from the level.

An innovation beyond OUTLIER deviations is left out, and so is an interval that scatters LOUDER than usual: a slow
rotation looks like it, and it may swing through nothing, so after it GUARD intervals in a row have to agree before one
counts again. Only what stays the same for as long as the level before it had been confirmed, 10 s to 5 min, is a step
of the bias.
"""

from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.drift.compensation.arma import Arma, stationary

FADING: Final = 0.995
"""b: 200 intervals."""
FLOOR: Final = 0.05
"""Of the identified variance of a, below which s does not fall."""
OUTLIER: Final = 6.0
LOUDER: Final = (16.0, 10.0)
"""Times the usual variance within intervals, once so many have told what is usual; chance passes it in 1e-6 or less."""
GUARD: Final = 5.0
"""Intervals."""
AGREE: Final = 4.0
"""Deviations of the difference of two intervals at rest."""
STAYS: Final = (10.0, 300.0)
"""Intervals."""
CONFIRMED: Final = 5
"""Intervals at rest, one after the other, that a first level takes: a carrier may rotate when all begins."""
SCATTERED: Final = 0.02
"""Share of one interval in the scatter within intervals."""
SHORTEST, LONGEST = 40, 1000
"""Intervals of the level's memory: a third of what the model was identified from, within these."""

X, P = 0, 3
PHI1, PHI2, G1, VARIANCE, LEVEL = range(12, 17)
S, R, SCATTER, SEEN, COUNT, SKIPPED, LATEST, WAITS, ADAPTS, KNOWN = range(17, 27)
SIZE: Final = 27
"""Layout of a row: state [3], its covariance [9], the model, and what is estimated of the noise: s, R̂, scatter within
intervals, intervals with a scatter, intervals at rest, outliers in a row, the latest of them, intervals to wait,
whether noise is estimated, whether a model was identified."""
NOT_SEEN, USED, LEFT_OUT, STEPPED = range(4)
"""What became of an interval."""


def unknown(adapts: bool) -> Floats:
    """A row before anything is identified: a level alone."""
    row = np.zeros(SIZE)
    row[ADAPTS] = adapts
    return row


def adopt(row: Floats, arma: Arma) -> None:
    """Take a model over, its state not known yet; what was estimated of the noise begins from it."""
    phi1, phi2 = arma.phi
    p11, p12, p22 = stationary(phi1, phi2, arma.theta)
    row[X : X + 3] = 0.0, 0.0, arma.mean
    row[P : P + 9] = arma.variance * np.array([p11, p12, 0.0, p12, p22, 0.0, 0.0, 0.0, 0.0])
    row[PHI1], row[PHI2], row[G1] = phi1, phi2, phi1 + arma.theta
    row[VARIANCE] = row[S] = arma.variance
    row[R] = arma.white
    slow = arma.white + arma.variance * ((1.0 + arma.theta) / (1.0 - phi1 - phi2)) ** 2  # spectrum at f = 0
    row[LEVEL] = slow / min(max(arma.count / 3.0, SHORTEST), LONGEST) ** 2
    row[P + 8] = slow / arma.count
    row[SKIPPED] = row[WAITS] = 0.0
    row[KNOWN] = 1.0


@compiled
def forward(row):  # type: ignore[no-untyped-def]
    """To the next interval."""
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
def not_seen(row):  # type: ignore[no-untyped-def]
    """An interval that was not at rest."""
    if row[COUNT] < CONFIRMED:
        row[COUNT] = 0.0


@compiled
def drift(row):  # type: ignore[no-untyped-def]
    """Expected bias of the interval, and its variance."""
    return row[X] + row[X + 2], row[P] + 2.0 * row[P + 2] + row[P + 8]


@compiled
def measure(row, z, scatter, least):  # type: ignore[no-untyped-def]
    """An interval at rest: its mean z, the variance that the scatter within it gives z (NaN = none), the least of that.

    Returns:
        The variance S of ε, and what became of the interval.
    """
    loud = row[SEEN] >= LOUDER[1] and scatter > LOUDER[0] * max(row[SCATTER], least)
    if scatter == scatter and not loud:
        row[SEEN] += 1.0
        row[SCATTER] += max(SCATTERED, 1.0 / row[SEEN]) * (scatter - row[SCATTER])
    if row[KNOWN] == 0.0:  # a level alone: all that is not level is what scatters
        row[R] = max(row[SCATTER], least)
        row[LEVEL] = row[R] / SHORTEST**2
        if row[COUNT] == 0.0:
            row[X + 2], row[P + 8] = z, row[R]
    row[R] = max(row[R], least)
    expected, known = drift(row)
    e, total = z - expected, known + row[R]
    became = USED
    if loud or e * e > OUTLIER * OUTLIER * total:
        if row[COUNT] < CONFIRMED:
            row[X + 2], row[P + 8], row[COUNT] = z, row[R], 1.0
            return total, LEFT_OUT
        alike = (z - row[LATEST]) ** 2 < 2.0 * OUTLIER * OUTLIER * row[R]
        row[SKIPPED] = row[SKIPPED] + 1.0 if alike else 1.0
        row[LATEST] = z
        if row[SKIPPED] < min(max(row[COUNT], STAYS[0]), STAYS[1]):
            row[WAITS] = GUARD
            return total, LEFT_OUT
        became, row[WAITS] = STEPPED, 0.0
        row[P + 8] += e * e
        row[SEEN] = 0.0  # its noise may be another one too
    row[SKIPPED] = 0.0
    if row[WAITS] > 0.0:
        agrees = (z - row[LATEST]) ** 2 < 2.0 * AGREE * AGREE * row[R]
        row[WAITS] = row[WAITS] - 1.0 if agrees else GUARD
        row[LATEST] = z
        return total, LEFT_OUT
    row[COUNT] += 1.0
    _correct(row, e)
    if row[ADAPTS] > 0.0 and row[KNOWN] > 0.0 and became == USED:
        d = (1.0 - FADING) / (1.0 - FADING ** (row[COUNT] + 1.0))
        left = row[R] / total  # 1 − H K
        row[R] = max((1.0 - d) * row[R] + d * (left * left * e * e + drift(row)[1]), 0.5 * row[SCATTER], least)
        s = row[S]
        row[S] = max(s + d * s * s * (e * e - total) / (total * total), FLOOR * row[VARIANCE])
    return total, became


@compiled
def _correct(row, e):  # type: ignore[no-untyped-def]
    """K ε, and (I − K H) P."""
    h = row[P] + row[P + 6], row[P + 1] + row[P + 7], row[P + 2] + row[P + 8]  # H P
    total = h[0] + h[2] + row[R]
    for i in range(3):
        row[X + i] += h[i] / total * e
    for i in range(3):
        for j in range(3):
            row[P + 3 * i + j] -= h[i] * h[j] / total


@compiled
def again(row, z, scatter, least):  # type: ignore[no-untyped-def]
    """All intervals that are remembered, [n] each, oldest first, NaN where not at rest: after ``adopt``."""
    for k in range(z.size):
        if z[k] == z[k]:
            measure(row, z[k], scatter[k], least)
        forward(row)
