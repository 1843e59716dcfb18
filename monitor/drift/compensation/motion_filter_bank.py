"""The rate of a carrier that may move at any moment: a bank of filters on the "current" statistical model.

Zhou & Kumar 1984, with the one-step prediction as the mean of the acceleration (Yuan et al. 2010): state [ω, ω̇],
transition [[1, T], [0, 1]], process noise 2ασ_a² ∫ over T. With that mean the manoeuvre frequency α and the variance
σ_a² enter by their product alone; while αT ≪ 1 that is white noise of intensity 2ασ_a² in ω̈. In units of one sample,
and of the noise of the measured rate, one number q is left, and with it the gains: a filter of ``memory`` samples.

σ_a² adapts with the motion: filters with memories of 2, 4, 8, … samples run side by side, and at every sample the one
with the least estimated error is taken, or the measured rate itself. By Mallows' C_p (Technometrics 15, 1973) the mean
square error of a linear filter is its own variance of noise plus what its residual has grown by; both are learned at
rest, where the rate is known to be nothing, so neither white noise nor any model of the noise is assumed. A residual
beyond GATE deviations bars a filter at once, and makes it begin anew when it stays.

Where filters take turns, angle would get lost: what has not come out yet is fed back, slowly.
"""

from math import inf, log2, sqrt
from typing import Final

import numpy as np

from drivers.sample import Floats, Ints
from monitor.common.compiled import compiled, inlined

LONGEST_S: Final = 10.0
"""Memory of the slowest filter."""
RECENT: Final = 64.0
"""Samples over which a residual is averaged, exponentially."""
GATE: Final = 5.0
"""Standard deviations of a residual at rest."""
BARRED: Final = 3
"""Samples beyond the gate, one after the other, after which a filter begins anew."""
SETTLED: Final = (6, 48)
"""Memories, and samples at the least, after which a filter that began anew has its steady gains."""
LEAST: Final = 5
"""Intervals at rest before filters are trusted."""
LEARNED: Final = 60
"""Intervals at rest that noise is averaged over, exponentially."""
DIFFUSE: Final = 1e12
"""Variance of a state of which nothing is known, over that of a sample."""

RATE, SLOPE, RESIDUAL, NOISE, REST = range(5)
"""Columns of ``bank``: ω and ω̇ a sample, mean square residual of late, variance of the estimate and mean square
residual at rest. The first row is the measured rate itself: of it only NOISE is used."""
AGE, FAR = range(2)
"""Columns of ``ages``: samples since a filter began, samples beyond the gate in a row."""


def memories(rate_hz: float) -> Ints:
    """Samples: 2, 4, 8, … up to about LONGEST_S.

    >>> memories(4.0).tolist()
    [2, 4, 8, 16, 32]
    """
    return np.asarray(2 ** np.arange(1, max(round(log2(LONGEST_S * rate_hz)), 1) + 1), dtype=np.int64)


def intensity(memory: int) -> float:
    """2ασ_a² in units of one sample and of the measured variance, for which noise falls by ``memory`` in variance.

    The gain of the steady filter is about √2 q^¼, and the variance it leaves 3/4 of that.
    """
    return (4.0 / (3.0 * memory) / sqrt(2.0)) ** 4


def gains(each: Ints) -> tuple[Floats, Ints]:
    """Gains [rows, 2] of ω and ω̇ by age, one filter behind the other, and where each begins [filters + 1].

    The last row of a filter is its steady gain.
    """
    tables = [_gains(intensity(int(memory)), max(SETTLED[0] * int(memory), SETTLED[1])) for memory in each]
    return np.concatenate(tables), np.cumsum([0, *(len(one) for one in tables)])


@compiled
def _gains(q, rows):  # type: ignore[no-untyped-def]
    """Of a filter that knows nothing at first: the Riccati recursion."""
    out = np.empty((rows, 2))
    p00, p01, p11 = DIFFUSE, 0.0, DIFFUSE
    for k in range(rows):
        s = p00 + 1.0
        g0, g1 = p00 / s, p01 / s
        out[k, 0], out[k, 1] = g0, g1
        a00, a01, a11 = p00 - g0 * p00, p01 - g0 * p01, p11 - g1 * p01
        p00, p01, p11 = a00 + 2.0 * a01 + a11 + q / 3.0, a01 + a11 + q / 2.0, a11 + q
    return out


@inlined
def follow(z, bank, ages, table, first, sums, feedback, keep):  # type: ignore[no-untyped-def]
    """One sample of one axis.

    Args:
        z: measured rate, its bias taken out
        bank: [filters + 1, 5], ages: [filters, 2]
        table, first: of ``gains``
        sums: [filters + 1, 2] of squares of the estimate and of the residual, for what may turn out to be rest
        feedback: [1] angle that has not come out yet, in samples
        keep: share of it that comes out with a sample
    Returns:
        The rate.
    """
    least, rate = bank[0, NOISE], z
    sums[0, 0] += z * z
    for j in range(ages.shape[0]):
        at = min(first[j] + ages[j, AGE], first[j + 1] - 1)
        ages[j, AGE] += 1
        ahead = bank[j + 1, RATE] + bank[j + 1, SLOPE]
        new = z - ahead
        now = ahead + table[at, 0] * new
        bank[j + 1, RATE] = now
        bank[j + 1, SLOPE] += table[at, 1] * new
        square = (now - z) * (now - z)
        usual = bank[j + 1, REST]
        gate = GATE * GATE * usual if usual > 0.0 else inf
        bounded = min(square, gate)
        recent = bank[j + 1, RESIDUAL] + (bounded - bank[j + 1, RESIDUAL]) / RECENT
        bank[j + 1, RESIDUAL] = recent
        sums[j + 1, 0] += now * now
        sums[j + 1, 1] += bounded
        if square > gate:
            ages[j, FAR] += 1
            if ages[j, FAR] >= BARRED:
                bank[j + 1, RATE], bank[j + 1, SLOPE], ages[j, AGE], ages[j, FAR] = z, 0.0, 1, 0
            continue
        ages[j, FAR] = 0
        error = bank[j + 1, NOISE] + recent - usual
        if error < least:
            least, rate = error, now
    rate += keep * feedback[0]
    feedback[0] += z - rate
    return rate


@compiled
def coast(bank, ages, samples):  # type: ignore[no-untyped-def]
    """So many samples are missing: filters go on along their slopes, those of a shorter memory begin anew."""
    for j in range(ages.shape[0]):
        if samples >= 2 << j:
            ages[j, AGE] = ages[j, FAR] = 0
            bank[j + 1, SLOPE] = 0.0
        else:
            bank[j + 1, RATE] += samples * bank[j + 1, SLOPE]


@compiled
def shift(bank, by):  # type: ignore[no-untyped-def]
    """The bias is known to be larger by so much."""
    for j in range(1, bank.shape[0]):
        bank[j, RATE] -= by


@compiled
def learn(bank, sums, count, intervals):  # type: ignore[no-untyped-def]
    """An interval has turned out to be rest, one of so many: ``count`` samples whose sums these are."""
    share = max(1.0 / LEARNED, 1.0 / intervals)
    for j in range(bank.shape[0]):
        bank[j, NOISE] += share * (sums[j, 0] / count - bank[j, NOISE])
        bank[j, REST] += share * (sums[j, 1] / count - bank[j, REST])
