"""Likelihood comparison of Poisson steps and a random walk, which have the same second moments.

In the model of Poisson steps, each block may contain a jump of Gaussian height. The filter tracks one hypothesis for
each possible time since the last jump (Fearnhead & Liu, "On-line inference for multiple changepoint problems", J. R.
Statist. Soc. B 69, 2007). Each hypothesis is approximated by one Gaussian distribution with the same mean and
covariance (Harrison & Stevens, "Bayesian forecasting", J. R. Statist. Soc. B 38, 1976).

A random walk is the limit of many small jumps. Poisson steps therefore never fit much worse than a random walk, and
only a large gain indicates jumps.
"""

from dataclasses import replace
from math import exp, expm1
from typing import Final, NamedTuple

import numpy as np

from drivers.data_types import Floats
from monitor.common.compiled import compiled
from monitor.reconcile.likelihood.event_process_likelihood import (
    TARGET_BLOCKS,
    BackgroundNoise,
    EventProcessComparison,
    EventProcessFit,
    StateSpaceNoise,
    build_state_space_noise,
    compute_block_means,
    fit_event_process,
    initial_state_covariance,
    kalman_log_likelihood,
    maximise_over_log_parameters,
)

BLOCKS_PER_CROSSING_TIME: Final = 3.0
"""Number of blocks in the time N/K, after which a random walk exceeds white noise."""
JUMP_AGES: Final = 16
"""Number of hypotheses about the age of the last jump. The ages cover five times N/K.

With a coverage of 2.7 times N/K, the estimated rate would be 5 to 10 % too low.
"""
MIN_HYPOTHESIS_PROBABILITY: Final = 1e-6
MAX_START_JUMPS: Final = 2.0
"""Largest expected number of jumps in the time N/K. More frequent jumps cannot be resolved."""
START_RATES: Final = 6


def compare_poisson_with_random_walk(
    y: Floats, tau0_s: float, background: BackgroundNoise, K: float
) -> EventProcessComparison:
    """Compare the likelihoods of Poisson steps and a random walk.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Series in the unit of the axis, without gaps.
    tau0_s : float
        Sample period in seconds.
    background : BackgroundNoise
        All other noise of the axis.
    K : float
        Starting value of the random walk coefficient, in unit/√s. The value must be positive.

    Returns
    -------
    EventProcessComparison
        Log-likelihood gain, fitted rate and height, and number of Poisson steps.
    """
    means, block_s = compute_block_means(y, tau0_s, choose_block_length_s(y.size * tau0_s, background, K))

    def random_walk_log_likelihood(K: float) -> float:
        noise = build_state_space_noise(replace(background, walk=background.walk + K * K), means, block_s)
        return float(kalman_log_likelihood(means, noise))

    return fit_poisson_jumps(means, block_s, background, K).compare_with_other_effect(
        maximise_over_log_parameters(random_walk_log_likelihood, (K,))[0]
    )


def choose_block_length_s(duration_s: float, background: BackgroundNoise, K: float) -> float:
    """Choose the length, in seconds, of the blocks over which samples are averaged.

    Parameters
    ----------
    duration_s : float
        Length of the recording in seconds.
    background : BackgroundNoise
        Additional noise of the axis.
    K : float
        Random walk coefficient in unit/√s.
    """
    crossing_s: float = background.white**0.5 / K
    return min(crossing_s / BLOCKS_PER_CROSSING_TIME, duration_s / TARGET_BLOCKS)


def fit_poisson_jumps(means: Floats, block_s: float, background: BackgroundNoise, K: float) -> EventProcessFit:
    """Fit the rate and the height of Poisson steps by maximum likelihood.

    Parameters
    ----------
    means : ndarray of float64, shape (m,)
        Block means in the unit of the axis.
    block_s : float
        Length of a block in seconds.
    background : BackgroundNoise
        Additional noise of the axis.
    K : float
        Random walk coefficient in unit/√s.
    """
    duration_s = means.size * block_s
    noise = build_state_space_noise(background, means, block_s)

    def poisson_log_likelihood(rate: float, height: float, odds: float = 1.0) -> float:
        return _log_likelihood(means, noise, rate * block_s, height, odds)

    rates = np.geomspace(
        2.0 / duration_s, max(MAX_START_JUMPS * K / background.white**0.5, 4.0 / duration_s), START_RATES
    )
    rate = max(rates, key=lambda rate: poisson_log_likelihood(rate, K / rate**0.5))
    return fit_event_process(poisson_log_likelihood, {"rate": rate, "height": K / rate**0.5})


def _log_likelihood(means: Floats, noise: StateSpaceNoise, jumps: float, height: float, odds: float = 1.0) -> float:
    """Return the log-likelihood of Poisson steps, with the jump probability multiplied by ``odds``."""
    some = -expm1(-jumps)
    variance = jumps / some * height**2  # variance of the sum of all jumps in a block with at least one jump
    return float(_jump_log_likelihood(means, noise, _JumpProbabilities(exp(-jumps), odds * some, variance)))


class _JumpProbabilities(NamedTuple):
    none: float  # probability of no jump
    some: float  # probability of at least one jump
    variance: float  # variance of the sum of all jumps in a block with at least one jump


class _JumpFilterState(NamedTuple):
    """Probability and Gaussian state of each hypothesis about the age of the last jump."""

    probability: Floats  # [JUMP_AGES]
    mean: Floats  # [JUMP_AGES, d]
    covariance: Floats  # [JUMP_AGES, d, d], of which only the lower triangle is up to date


class _JumpFilterUpdate(NamedTuple):
    """Update of each hypothesis with one block mean, without (0) and with (1) a jump in the block."""

    weight: Floats  # [2, JUMP_AGES] probability
    inverse_variance: Floats  # [2, JUMP_AGES] inverse of the variance of the innovation
    state_covariance: Floats  # [2, JUMP_AGES, d] covariance of the block mean with the next state
    mean: Floats  # [2, JUMP_AGES, d] mean of the next state


@compiled
def _jump_log_likelihood(means: Floats, noise: StateSpaceNoise, jumps: _JumpProbabilities) -> float:
    d, last = noise.table.shape[0], JUMP_AGES - 1
    state = _JumpFilterState(np.zeros(JUMP_AGES), np.zeros((JUMP_AGES, d)), np.zeros((JUMP_AGES, d, d)))
    state.probability[last] = 1.0
    state.covariance[last] = initial_state_covariance(noise)
    update = _JumpFilterUpdate(
        np.zeros((2, JUMP_AGES)), np.zeros((2, JUMP_AGES)), np.zeros((2, JUMP_AGES, d)), np.zeros((2, JUMP_AGES, d))
    )
    jumped_mean, jumped_covariance = np.zeros(d), np.zeros((d, d))
    merged_mean, merged_covariance = np.zeros(d), np.zeros((d, d))
    total: float = -0.5 * means.size * np.log(2.0 * np.pi)
    for block_mean in means:
        density, log_scale = _weigh_branches(block_mean, noise, jumps, state, update)
        total += np.log(density) - log_scale
        update.weight[:] /= density
        # all hypotheses with a jump in this block become the hypothesis with age 0
        jumped = _merge(1, 0, JUMP_AGES, noise.table, state.covariance, update, jumped_mean, jumped_covariance)
        # the last age includes all older jumps
        state.probability[last] = _merge(
            0, last - 1, JUMP_AGES, noise.table, state.covariance, update, merged_mean, merged_covariance
        )
        state.mean[last] = merged_mean
        state.covariance[last] = merged_covariance
        _increase_ages(noise.table, state, update)
        state.probability[0] = jumped
        state.mean[0] = jumped_mean
        state.covariance[0] = jumped_covariance
        state.covariance[0, 0, 0] += jumps.variance
    return total


@compiled
def _weigh_branches(
    block_mean: float,
    noise: StateSpaceNoise,
    jumps: _JumpProbabilities,
    state: _JumpFilterState,
    update: _JumpFilterUpdate,
) -> tuple[float, float]:
    """Compute the update of each hypothesis, once with and once without a jump in the block.

    The time of a jump is uniformly distributed in the block. On average, the jump changes the block mean by half of the
    height. The variance of the block mean increases by one third of the height variance.

    Returns
    -------
    density : float
        Sum of the weights.
    log_scale : float
        Logarithm of the factor by which the weights were multiplied.
    """
    table, d = noise.table, noise.table.shape[0]
    probability, mean, covariance = state
    weight, inverse_variance, state_covariance, next_mean = update
    least = np.inf
    for age in range(JUMP_AGES):
        if probability[age] < MIN_HYPOTHESIS_PROBABILITY:
            continue
        variance, innovation = noise.white, block_mean
        for i in range(d):
            total = 0.0
            for j in range(i + 1):
                total += covariance[age, i, j] * table[j, 1]
            for j in range(i + 1, d):
                total += covariance[age, j, i] * table[j, 1]
            variance += table[i, 1] * total
            innovation -= table[i, 1] * mean[age, i]
            state_covariance[0, age, i] = state_covariance[1, age, i] = table[i, 0] * total + table[i, 3]
        state_covariance[1, age, 0] += 0.5 * jumps.variance
        inverse_variance[0, age] = 1.0 / variance
        inverse_variance[1, age] = 1.0 / (variance + jumps.variance / 3.0)
        for jump in range(2):
            pull = innovation * inverse_variance[jump, age]
            weight[jump, age] = 0.5 * innovation * pull
            least = min(least, weight[jump, age])
            for i in range(d):
                next_mean[jump, age, i] = table[i, 0] * mean[age, i] + state_covariance[jump, age, i] * pull
    density = 0.0
    for jump in range(2):
        chance = jumps.some if jump else jumps.none
        for age in range(JUMP_AGES):
            if probability[age] < MIN_HYPOTHESIS_PROBABILITY:
                weight[jump, age] = 0.0
            else:
                prior = probability[age] * chance * np.sqrt(inverse_variance[jump, age])
                weight[jump, age] = prior * np.exp(least - weight[jump, age])
                density += weight[jump, age]
    return density, least


@compiled
def _merge(
    jump: int,
    first: int,
    end: int,
    table: Floats,
    covariance: Floats,
    update: _JumpFilterUpdate,
    merged_mean: Floats,
    merged_covariance: Floats,
) -> float:
    """Merge the updated hypotheses ``first`` to ``end`` − 1 into one Gaussian, and return the probability.

    The mean and the lower triangle of the covariance are written in place. The jumps are independent of the earlier
    state, and the caller adds their variance.
    """
    weight, inverse_variance, state_covariance, mean = update
    share = 0.0
    for age in range(first, end):
        share += weight[jump, age]
    if share < MIN_HYPOTHESIS_PROBABILITY:
        return share
    d = table.shape[0]
    for i in range(d):
        total = 0.0
        for age in range(first, end):
            total += weight[jump, age] * mean[jump, age, i]
        merged_mean[i] = total / share
    merged_covariance[:] = 0.0
    for age in range(first, end):
        if weight[jump, age] == 0.0:
            continue
        part, known = weight[jump, age] / share, inverse_variance[jump, age]
        for i in range(d):
            decay, pull = table[i, 0], state_covariance[jump, age, i] * known
            apart = mean[jump, age, i] - merged_mean[i]
            for j in range(i + 1):
                own = decay * table[j, 0] * covariance[age, i, j] - pull * state_covariance[jump, age, j]
                merged_covariance[i, j] += part * (own + apart * (mean[jump, age, j] - merged_mean[j]))
    for i in range(d):
        merged_covariance[i, i] += table[i, 2]
    return share


@compiled
def _increase_ages(table: Floats, state: _JumpFilterState, update: _JumpFilterUpdate) -> None:
    """Update the hypotheses with ages from 1 to ``JUMP_AGES`` − 2, which have no jump in the block."""
    probability, mean, covariance = state
    weight, inverse_variance, state_covariance, next_mean = update
    for age in range(JUMP_AGES - 2, 0, -1):
        old = age - 1
        probability[age] = weight[0, old]
        for i in range(table.shape[0]):
            mean[age, i] = next_mean[0, old, i]
            decay, pull = table[i, 0], state_covariance[0, old, i] * inverse_variance[0, old]
            for j in range(i + 1):
                covariance[age, i, j] = decay * table[j, 0] * covariance[old, i, j] - pull * state_covariance[0, old, j]
            covariance[age, i, i] += table[i, 2]
