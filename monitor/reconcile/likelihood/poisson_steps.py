"""Likelihood ratio of Poisson steps and a random walk, which have the same second moments.

Poisson steps are a mixture: each block contains a jump of Gaussian height or no jump. Several later blocks are needed
to decide whether there was a jump. The filter therefore keeps separate hypotheses by the time since the last jump.
Hypotheses with the same time are merged into one Gaussian with their mean and covariance (Harrison & Stevens, "Bayesian
forecasting", J. R. Statist. Soc. B 38, 1976; by run length: Fearnhead & Liu, "On-line inference for multiple
changepoint problems", ibid. 69, 2007). A random walk is the limit of many small jumps, so Poisson steps never fit much
worse. The size of the gain indicates jumps, not its sign.
"""

from dataclasses import replace
from math import exp, expm1
from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.reconcile.likelihood.hidden_state import (
    TARGET_BLOCKS,
    BackgroundNoise,
    EventProcessFit,
    ModelComparison,
    StateSpaceNoise,
    block_means,
    fit_process,
    initial_covariance,
    kalman_log_likelihood,
    maximise,
    predict_block,
    prior_level_variance,
    state_space_noise,
)

BLOCKS_PER_CROSSING_TIME: Final = 3.0
"""Number of blocks in N/K, the time at which white noise and random walk are equal."""
JUMP_AGES: Final = 16
"""Number of hypotheses: a jump in the newest block, in the block before, and so on. The last one holds all older jumps.

Together they cover five times N/K. If they cover 1.3 times N/K, the rate is 15 to 25 % too low; with 2.7 times N/K it
is 5 to 10 % too low.
"""
MIN_HYPOTHESIS_PROBABILITY: Final = 1e-6
"""Probability below which a hypothesis is dropped."""
MAX_START_JUMPS: Final = 2.0
"""Largest number of jumps in N/K at the start of a search. More frequent jumps are too small to be seen one by one."""
START_RATES: Final = 6
"""Number of starting rates."""


def compare_steps_with_random_walk(y: Floats, tau0_s: float, rest: BackgroundNoise, K: float) -> ModelComparison:
    """Compare Poisson steps with a random walk.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Series in the unit of the axis, without gaps.
    tau0_s : float
        Sample period in seconds.
    rest : Rest
        Additional noise of the axis. A random walk in it is present in both alternatives.
    K : float
        Starting value of the random walk coefficient, in unit/√s, above zero.

    Returns
    -------
    ModelComparison
        ``rate`` and ``height`` of the Poisson steps (first), ``K`` of the random walk (second), and the number of
        jumps.

    Raises
    ------
    ValueError
        If there are too few samples or no white noise.
    """
    means, block_s = block_means(y, tau0_s, block_for(y.size * tau0_s, rest, K))
    start, span_s = prior_level_variance(means), means.size * block_s

    def walk(K: float) -> float:
        noise = state_space_noise(replace(rest, walk=rest.walk + K * K), block_s, span_s)
        return float(kalman_log_likelihood(means, noise.table, noise.white, start))

    first = fit_jumps(means, block_s, rest, K)
    second = maximise(walk, (K,))
    return ModelComparison(
        first.peak.height - second.height,
        first.parameters,
        {"K": second.bounds(0)},
        round(first.events),
    )


def block_for(span_s: float, rest: BackgroundNoise, K: float) -> float:
    """Return the length of a block in seconds.

    Parameters
    ----------
    span_s : float
        Length of the recording in seconds.
    rest : Rest
        Additional noise of the axis.
    K : float
        Random walk coefficient in unit/√s.
    """
    crossing_s: float = rest.white**0.5 / K
    return min(crossing_s / BLOCKS_PER_CROSSING_TIME, span_s / TARGET_BLOCKS)


def fit_jumps(means: Floats, block_s: float, rest: BackgroundNoise, K: float) -> EventProcessFit:
    """Maximise the likelihood over the rate and the height of the jumps.

    The search starts from the likeliest of several rates, with the second moments of a random walk ``K``.

    Parameters
    ----------
    means : ndarray of float64, shape (m,)
        Block means in the unit of the axis.
    block_s : float
        Length of a block in seconds.
    rest : Rest
        Additional noise of the axis.
    K : float
        Random walk coefficient in unit/√s.
    """
    span_s, start = means.size * block_s, prior_level_variance(means)
    noise = state_space_noise(rest, block_s, span_s)

    def poisson(rate: float, height: float, odds: float = 1.0) -> float:
        return log_likelihood(means, noise, start, rate * block_s, height, odds)

    rates = np.geomspace(2.0 / span_s, max(MAX_START_JUMPS * K / rest.white**0.5, 4.0 / span_s), START_RATES)
    rate = max(rates, key=lambda rate: poisson(rate, K / rate**0.5))
    return fit_process(poisson, {"rate": rate, "height": K / rate**0.5})


def log_likelihood(
    means: Floats, noise: StateSpaceNoise, start: float, jumps: float, height: float, odds: float = 1.0
) -> float:
    """Return the log-likelihood of Poisson steps in block means.

    Parameters
    ----------
    means : ndarray of float64, shape (m,)
        Block means in the unit of the axis.
    noise : StateSpaceNoise
        Additional noise.
    start : float
        Prior variance of the first level, in the squared unit of the axis.
    jumps : float
        Expected number of jumps in a block, λΔ.
    height : float
        Standard deviation of a jump, in the unit of the axis.
    odds : float, optional
        Factor on the probability of each jump.
    """
    some = -expm1(-jumps)
    variance = jumps / some * height**2  # variance of the sum of all jumps in a block with at least one jump
    return float(
        jump_log_likelihood(means, noise.table, noise.white, start, JUMP_AGES, exp(-jumps), odds * some, variance)
    )


@compiled
def jump_log_likelihood(means, table, white, start, ages, none, some, variance):  # type: ignore[no-untyped-def]
    """Return the log-likelihood of a level that jumps in a block with probability ``some``, by a height with that
    variance.

    A jump at a uniformly distributed time in the block changes the block mean by 1/2 of its height on average and
    contributes 1/3 of its variance.
    """
    d = table.shape[0]
    share, at, covariance = np.zeros(ages), np.zeros((ages, d)), np.zeros((ages, d, d))
    # for each hypothesis: entries below ``ages`` without a jump, the others with a jump
    weight, moved, spread = np.empty(2 * ages), np.zeros((2 * ages, d)), np.zeros((2 * ages, d, d))
    reach = np.empty(d)
    share[ages - 1] = 1.0
    covariance[ages - 1] = initial_covariance(table, start)
    total = -0.5 * means.size * np.log(2.0 * np.pi)
    for z in means:
        for age in range(ages):
            weight[age] = weight[ages + age] = -np.inf
            if share[age] < MIN_HYPOTHESIS_PROBABILITY:
                continue
            seen = predict_block(table, covariance[age], reach) + white
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
            if age == 0:  # all hypotheses with a jump in this block
                first, end = ages, 2 * ages
            else:  # no jump in this block: the previous age, and for the last age also the last age itself
                first, end = age - 1, age + age // (ages - 1)
            _merge_hypotheses(first, end, weight, moved, spread, age, share, at, covariance)
    return total


@compiled
def _merge_hypotheses(first, end, weight, moved, spread, to, share, at, covariance):  # type: ignore[no-untyped-def]
    """Merge hypotheses ``first`` to ``end`` − 1 into one Gaussian with their mean and covariance, at index ``to``."""
    share[to] = 0.0
    for k in range(first, end):
        share[to] += weight[k]
    if share[to] < MIN_HYPOTHESIS_PROBABILITY:
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
