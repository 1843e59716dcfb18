"""Random telegraph, or something with the same second moments.

The two levels are the modes of a switching Kalman filter; everything else (``Rest``, and where the level lies) is its
Gaussian state. In a block the level stays, or it changes once, or there and back: three cases, each with mean and
variance of its block's mean. After each block the cases that end in the same level are merged into one Gaussian of
their mean and covariance (GPB2 of Bar-Shalom, Li & Kirubarajan, "Estimation with Applications to Tracking and
Navigation", 2001, section 11.6.4). With white noise around a known level nothing is merged but the cases within a
block: then it is the forward algorithm of a hidden Markov model.
"""

from math import log
from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.reconcile.likelihood.hidden_state import (
    WANTED,
    Contest,
    Parts,
    Process,
    Rest,
    anywhere,
    begin,
    block_means,
    fit_process,
    kalman,
    markov,
    maximise,
    parts,
    predict,
)

BLOCKS: Final = 8.0
"""Blocks in a correlation time: one dwell in sixteen blocks ends."""
FINEST: Final = 20_000.0
"""Blocks in a recording, at most, for sharper times."""
SAMPLES: Final = 20
"""In a block, where a correlation time has as many: a sensor's noise is white from a few samples on only."""
AMPLITUDES: Final = np.geomspace(0.5, 2.0, 7)
"""Where the search begins, times 2 σ: few dwells tell σ badly, and between two wrong levels a likelihood is rough."""
DWELLS: Final = (0.35, 1.0)
"""The same for the dwell time, times 2 T_c: a random walk beside it makes correlation longer."""
HEAD: Final = 1024
"""Blocks, 64 dwells, after which it is no longer asked in which level the recording began."""
NEVER: Final = 1e-300
"""Weight of what is all but impossible, beside the likeliest case: nothing is divided by zero."""


def telegraph_or_correlated(y: Floats, tau0_s: float, rest: Rest, sigma: float, correlation_time: float) -> Contest:
    """Random telegraph (first) against exponentially correlated noise (second).

    Args:
        y: [n] series of one axis, unit of the axis, without gaps
        tau0_s: s between samples
        rest: the other noise of the axis
        sigma: standard deviation of the process, unit of the axis, where the search begins
        correlation_time: s, where the search begins
    Returns:
        ``amplitude`` and ``dwell_time`` against ``sigma`` and ``correlation_time``; switches of the telegraph
    Raises:
        ValueError: hardly any samples, or no white noise
    """
    means, block_s = block_means(y, tau0_s, block_for(y.size * tau0_s, tau0_s, correlation_time, rest.white / sigma**2))
    around, start = parts(rest, block_s, means.size * block_s), anywhere(means)

    def correlated(sigma: float, time_s: float) -> float:
        row, own = markov(sigma, time_s, block_s)
        return float(kalman(means, np.vstack([around.table, row]), around.white + own, start))

    first = fit_levels(means, block_s, around, sigma, correlation_time)
    second = maximise(correlated, (sigma, correlation_time))
    return Contest(
        first.peak.height - second.height,
        first.parameters,
        {"sigma": second.bounds(0), "correlation_time": second.bounds(1)},
        round(first.events),
    )


def block_for(span_s: float, tau0_s: float, correlation_time: float, even_s: float) -> float:
    """Length of a block, s; switches are timed better by short ones.

    Args:
        even_s: white noise of blocks as long is half of the amplitude; shorter ones tell nothing more
    """
    return min(correlation_time / BLOCKS, span_s / WANTED, max(even_s, span_s / FINEST, SAMPLES * tau0_s))


def fit_levels(means: Floats, block_s: float, around: Parts, sigma: float, correlation_time: float) -> Process:
    """Maximum over amplitude and dwell time, from those whose second moments are ``sigma`` and ``correlation_time``."""
    start = anywhere(means)

    def two_levels(amplitude: float, dwell_s: float, odds: float) -> float:
        return log_likelihood(means, around, start, amplitude, block_s / dwell_s, odds)

    starts = [(2.0 * sigma * a, 2.0 * correlation_time * d) for a in AMPLITUDES.tolist() for d in DWELLS]
    amplitude, dwell_s = max(starts, key=lambda start: two_levels(start[0], start[1], 1.0))
    return fit_process(two_levels, {"amplitude": amplitude, "dwell_time": dwell_s})


def log_likelihood(
    means: Floats, around: Parts, start: float, amplitude: float, switches: float, odds: float = 1.0
) -> float:
    """Of a telegraph in block means.

    Args:
        means: [m] block means
        around: the other noise
        start: variance of the first level
        amplitude: from level to level
        switches: expected in a block, Δ/T
        odds: factor on the probability of each switch
    """
    even, odd = 0.5 * (1.0 + np.exp(-2.0 * switches)), -0.5 * np.expm1(-2.0 * switches)
    none = np.exp(-switches)
    # the time spent in the other level: none; uniform in the block; density 2(1 − x), mean 1/3 and variance 1/18
    cases = np.array([
        [none, 0.5 * amplitude, 0.0],
        [odds**2 * (even - none), amplitude / 6.0, amplitude**2 / 18.0],
        [odds * odd, 0.0, amplitude**2 / 12.0],
    ])  # fmt: skip
    # where the level lies is not known either: begun in both at once, the two explanations would be merged too soon
    states = [_begin(around.table, start, first) for first in (0, 1)]
    heads = [switching(means[:HEAD], around.table, around.white, cases, *state) for state in states]
    rest = switching(means[HEAD:], around.table, around.white, cases, *states[int(np.argmax(heads))])
    return float(np.logaddexp(*heads) - log(2.0) + rest)


@compiled
def _begin(table, start, first):  # type: ignore[no-untyped-def]
    d = table.shape[0]
    share, covariance = np.zeros(2), np.empty((2, d, d))
    share[first] = 1.0
    covariance[:] = begin(table, start)
    return share, np.zeros((2, d)), covariance


@compiled
def switching(means, table, white, cases, share, at, covariance):  # type: ignore[no-untyped-def]
    """Log-likelihood of two levels; ``share`` [2], ``at`` [2, d] and ``covariance`` [2, d, d] are carried on.

    ``cases`` [3, 3]: probability, mean (from the upper level) and variance of what a block adds. The first two end in
    the level they began in, the third in the other.
    """
    d = table.shape[0]
    reach, weight, pull, known = np.empty((2, d)), np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3))
    moved, merged, step = np.empty((2, d)), np.empty((2, d, d)), np.empty(d)
    total = -0.5 * means.size * np.log(2.0 * np.pi)
    for z in means:
        for level in range(2):
            variance = predict(table, covariance[level], reach[level]) + white
            innovation = z
            for i in range(d):
                innovation -= table[i, 1] * at[level, i]
            sign = 1.0 - 2.0 * level
            for k in range(3):
                apart = innovation - sign * cases[k, 1]
                known[level, k] = 1.0 / (variance + cases[k, 2])
                pull[level, k] = apart * known[level, k]
                weight[level, k] = 0.5 * apart * pull[level, k]
        least, density = weight.min(), 0.0
        for level in range(2):
            for k in range(3):
                prior = share[level] * cases[k, 0] * np.sqrt(known[level, k])
                weight[level, k] = prior * np.exp(least - weight[level, k]) + NEVER
                density += weight[level, k]
        total += np.log(density) - least
        for level in range(2):
            _join_stays(weight[level], pull[level], known[level])
        for level in range(2):
            other = 1 - level
            stays, comes = weight[level, 0], weight[other, 2]
            share[level] = (stays + comes) / density
            came = comes / (stays + comes)
            for i in range(d):
                stay = table[i, 0] * at[level, i] + reach[level, i] * pull[level, 0]
                step[i] = table[i, 0] * at[other, i] + reach[other, i] * pull[other, 2] - stay
                moved[level, i] = stay + came * step[i]
            for i in range(d):
                for j in range(d):
                    decay = table[i, 0] * table[j, 0]
                    stay = covariance[level, i, j] * decay - reach[level, i] * reach[level, j] * known[level, 0]
                    come = covariance[other, i, j] * decay - reach[other, i] * reach[other, j] * known[other, 2]
                    apart = (1.0 - came) * step[i] * step[j]
                    merged[level, i, j] = stay + came * (come - stay + apart)
                merged[level, i, i] += table[i, 2]
        at[:] = moved
        covariance[:] = merged
    return total


@compiled
def _join_stays(weight, pull, known):  # type: ignore[no-untyped-def]
    """Merge the two cases that end where they began into the first of them."""
    back = weight[1] / (weight[0] + weight[1])
    apart = pull[1] - pull[0]
    pull[0] += back * apart
    known[0] += back * (known[1] - known[0] - (1.0 - back) * apart * apart)
    weight[0] += weight[1]
