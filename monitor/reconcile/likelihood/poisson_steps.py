"""Poisson steps, or something with the same second moments: a random walk.

Poisson steps are a jump mixture: in a block there is a jump of Gaussian height, or there is none. Whether there was one
shows only some blocks later, so hypotheses are kept apart by the time since their last jump; those for which it is the
same are merged into one Gaussian of their mean and covariance (Harrison & Stevens, "Bayesian forecasting", J. R.
Statist. Soc. B 38, 1976; by run length: Fearnhead & Liu, "On-line inference for multiple changepoint problems", ibid.
69, 2007). A random walk is the limit of ever more and ever smaller jumps, so it loses little at the worst: not the
sign of the gain but its size says that there are jumps.
"""

from dataclasses import replace
from math import exp, expm1
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
    maximise,
    parts,
    predict,
)

FINE: Final = 3.0
"""Blocks in N/K, the time in which white noise and a random walk grow equal."""
AGES: Final = 16
"""Hypotheses: a jump in the newest block, in the one before, and so on; the last holds all that are older.

Together five times N/K: with a memory of 1.3 of them the rate comes out 15 to 25 % low, with 2.7 of them 5 to 10 %.
"""
GONE: Final = 1e-6
"""Probability of a hypothesis that is given up."""
OFTEN: Final = 2.0
"""Jumps in N/K beyond which no search begins: they are too small to be seen one by one."""
STARTS: Final = 6


def steps_or_walk(y: Floats, tau0_s: float, rest: Rest, K: float) -> Contest:
    """Poisson steps (first) against a random walk (second).

    Args:
        y: [n] series of one axis, unit of the axis, without gaps
        tau0_s: s between samples
        rest: the other noise of the axis; a random walk in it is there besides, on both sides
        K: coefficient of the random walk in question, unit/√s, where the search begins; above zero
    Returns:
        ``rate`` and ``height`` against ``K``; jumps of the Poisson steps
    Raises:
        ValueError: hardly any samples, or no white noise
    """
    means, block_s = block_means(y, tau0_s, block_for(y.size * tau0_s, rest, K))
    start, span_s = anywhere(means), means.size * block_s

    def walk(K: float) -> float:
        around = parts(replace(rest, walk=rest.walk + K * K), block_s, span_s)
        return float(kalman(means, around.table, around.white, start))

    first = fit_jumps(means, block_s, rest, K)
    second = maximise(walk, (K,))
    return Contest(
        first.peak.height - second.height,
        first.parameters,
        {"K": second.bounds(0)},
        round(first.events),
    )


def block_for(span_s: float, rest: Rest, K: float) -> float:
    """Length of a block, s."""
    crossing_s: float = rest.white**0.5 / K
    return min(crossing_s / FINE, span_s / WANTED)


def fit_jumps(means: Floats, block_s: float, rest: Rest, K: float) -> Process:
    """Maximum over rate and height, from the likeliest of some rates whose second moments are those of ``K``."""
    span_s, start = means.size * block_s, anywhere(means)
    around = parts(rest, block_s, span_s)

    def poisson(rate: float, height: float, odds: float = 1.0) -> float:
        return log_likelihood(means, around, start, rate * block_s, height, odds)

    rates = np.geomspace(2.0 / span_s, max(OFTEN * K / rest.white**0.5, 4.0 / span_s), STARTS)
    rate = max(rates, key=lambda rate: poisson(rate, K / rate**0.5))
    return fit_process(poisson, {"rate": rate, "height": K / rate**0.5})


def log_likelihood(means: Floats, around: Parts, start: float, jumps: float, height: float, odds: float = 1.0) -> float:
    """Of Poisson steps in block means.

    Args:
        means: [m] block means
        around: the other noise
        start: variance of the first level
        jumps: expected in a block, λΔ
        height: standard deviation of a jump
        odds: factor on the probability of each jump
    """
    some = -expm1(-jumps)
    variance = jumps / some * height**2  # of all jumps in a block, given that there are some
    return float(jumping(means, around.table, around.white, start, AGES, exp(-jumps), odds * some, variance))


@compiled
def jumping(means, table, white, start, ages, none, some, variance):  # type: ignore[no-untyped-def]
    """Log-likelihood of a level that jumps in a block with probability ``some``, by a height of that variance.

    A jump at a uniform time in the block shows in its mean with 1/2 of its height and 1/3 of its variance.
    """
    d = table.shape[0]
    share, at, covariance = np.zeros(ages), np.zeros((ages, d)), np.zeros((ages, d, d))
    # of each hypothesis: no jump, and from ages on a jump
    weight, moved, spread = np.empty(2 * ages), np.zeros((2 * ages, d)), np.zeros((2 * ages, d, d))
    reach = np.empty(d)
    share[ages - 1] = 1.0
    covariance[ages - 1] = begin(table, start)
    total = -0.5 * means.size * np.log(2.0 * np.pi)
    for z in means:
        for age in range(ages):
            weight[age] = weight[ages + age] = -np.inf
            if share[age] < GONE:
                continue
            seen = predict(table, covariance[age], reach) + white
            innovation = z
            for i in range(d):
                innovation -= table[i, 1] * at[age, i]
            for jump in range(2):
                to, chance = (ages + age, some) if jump else (age, none)
                if jump:
                    seen += variance / 3.0
                    reach[0] += 0.5 * variance
                weight[to] = np.log(share[age] * chance) - 0.5 * (innovation * innovation / seen + np.log(seen))
                for i in range(d):
                    moved[to, i] = table[i, 0] * at[age, i] + reach[i] * innovation / seen
                    for j in range(d):
                        spread[to, i, j] = table[i, 0] * table[j, 0] * covariance[age, i, j]
                        spread[to, i, j] -= reach[i] * reach[j] / seen
                    spread[to, i, i] += table[i, 2]
                spread[to, 0, 0] += jump * variance
        highest = weight[0]
        for k in range(1, 2 * ages):
            highest = max(highest, weight[k])
        density = 0.0
        for k in range(2 * ages):
            weight[k] = np.exp(weight[k] - highest)
            density += weight[k]
        total += highest + np.log(density)
        for k in range(2 * ages):
            weight[k] /= density
        for age in range(ages):
            if age == 0:  # all jumps
                first, end = ages, 2 * ages
            else:  # no jump since: those of one block less, and of the last age as well
                first, end = age - 1, age + age // (ages - 1)
            _merge(first, end, weight, moved, spread, age, share, at, covariance)
    return total


@compiled
def _merge(first, end, weight, moved, spread, to, share, at, covariance):  # type: ignore[no-untyped-def]
    """Put the Gaussian of the same mean and covariance as ``first`` … ``end`` − 1 in place ``to``, with their share."""
    share[to] = 0.0
    for k in range(first, end):
        share[to] += weight[k]
    if share[to] < GONE:
        return
    d = moved.shape[1]
    for i in range(d):
        at[to, i] = 0.0
        for k in range(first, end):
            at[to, i] += weight[k] / share[to] * moved[k, i]
    for i in range(d):
        for j in range(d):
            covariance[to, i, j] = 0.0
            for k in range(first, end):
                apart = (moved[k, i] - at[to, i]) * (moved[k, j] - at[to, j])
                covariance[to, i, j] += weight[k] / share[to] * (spread[k, i, j] + apart)
