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
    difference_from_predicted_block_mean,
    fit_event_process,
    initial_state_covariance,
    kalman_log_likelihood,
    maximise_over_log_parameters,
    predict_block_mean_variance,
    prior_level_variance,
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

    Raises
    ------
    ValueError
        If the series is too short or the background contains no white noise.
    """
    means, block_s = compute_block_means(y, tau0_s, choose_block_length_s(y.size * tau0_s, background, K))
    level_variance, duration_s = prior_level_variance(means), means.size * block_s

    def random_walk_log_likelihood(K: float) -> float:
        noise = build_state_space_noise(replace(background, walk=background.walk + K * K), block_s, duration_s)
        return float(kalman_log_likelihood(means, noise, level_variance))

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
    duration_s, level_variance = means.size * block_s, prior_level_variance(means)
    noise = build_state_space_noise(background, block_s, duration_s)

    def poisson_log_likelihood(rate: float, height: float, odds: float = 1.0) -> float:
        return _log_likelihood(means, noise, level_variance, rate * block_s, height, odds)

    rates = np.geomspace(
        2.0 / duration_s, max(MAX_START_JUMPS * K / background.white**0.5, 4.0 / duration_s), START_RATES
    )
    rate = max(rates, key=lambda rate: poisson_log_likelihood(rate, K / rate**0.5))
    return fit_event_process(poisson_log_likelihood, {"rate": rate, "height": K / rate**0.5})


def _log_likelihood(
    means: Floats, noise: StateSpaceNoise, level_variance: float, jumps: float, height: float, odds: float = 1.0
) -> float:
    """Return the log-likelihood of Poisson steps, with the jump probability multiplied by ``odds``."""
    some = -expm1(-jumps)
    variance = jumps / some * height**2  # variance of the sum of all jumps in a block with at least one jump
    return float(
        _jump_log_likelihood(means, noise, level_variance, _JumpProbabilities(exp(-jumps), odds * some, variance))
    )


class _JumpProbabilities(NamedTuple):
    none: float  # probability of no jump
    some: float  # probability of at least one jump
    variance: float  # variance of the sum of all jumps in a block with at least one jump


class _GaussianMixture(NamedTuple):
    weight: Floats  # [k] probability of each component, or its logarithm
    mean: Floats  # [k, d]
    covariance: Floats  # [k, d, d]


@compiled
def _jump_log_likelihood(
    means: Floats, noise: StateSpaceNoise, level_variance: float, jumps: _JumpProbabilities
) -> float:
    d = noise.table.shape[0]
    by_age = _GaussianMixture(np.zeros(JUMP_AGES), np.zeros((JUMP_AGES, d)), np.zeros((JUMP_AGES, d, d)))
    # entries 0 to JUMP_AGES − 1 have no jump in this block, the other entries have a jump
    branches = _GaussianMixture(np.empty(2 * JUMP_AGES), np.zeros((2 * JUMP_AGES, d)), np.zeros((2 * JUMP_AGES, d, d)))
    by_age.weight[JUMP_AGES - 1] = 1.0
    by_age.covariance[JUMP_AGES - 1] = initial_state_covariance(noise, level_variance)
    total: float = -0.5 * means.size * np.log(2.0 * np.pi)
    for block_mean in means:
        for age in range(JUMP_AGES):
            _branch(block_mean, age, by_age, branches, noise, jumps)
        total += _normalise(branches.weight)
        for age in range(JUMP_AGES):
            if age == 0:  # merge all hypotheses with a jump in this block
                first, end = JUMP_AGES, 2 * JUMP_AGES
            else:  # without a jump, the age increases by one block; the last age includes all older jumps
                first, end = age - 1, age + age // (JUMP_AGES - 1)
            _merge(branches, first, end, by_age, age)
    return total


@compiled
def _branch(
    block_mean: float,
    age: int,
    by_age: _GaussianMixture,
    branches: _GaussianMixture,
    noise: StateSpaceNoise,
    jumps: _JumpProbabilities,
) -> None:
    """Update one hypothesis with a block mean, once with and once without a jump in the block.

    The time of a jump is uniformly distributed in the block. On average, the jump changes the block mean by half of the
    height. The variance of the block mean increases by one third of the height variance.
    """
    branches.weight[age] = branches.weight[JUMP_AGES + age] = -np.inf
    if by_age.weight[age] < MIN_HYPOTHESIS_PROBABILITY:
        return
    table = noise.table
    d = table.shape[0]
    covariance, state_covariance = by_age.covariance[age], np.empty(d)
    variance = predict_block_mean_variance(noise, covariance, state_covariance)
    innovation = difference_from_predicted_block_mean(block_mean, noise, by_age.mean[age])
    for jump in range(2):
        to, chance = (JUMP_AGES + age, jumps.some) if jump else (age, jumps.none)
        if jump:
            variance += jumps.variance / 3.0
            state_covariance[0] += 0.5 * jumps.variance
        likelihood = -0.5 * (innovation * innovation / variance + np.log(variance))
        branches.weight[to] = np.log(by_age.weight[age] * chance) + likelihood
        spread = branches.covariance[to]
        for i in range(d):
            branches.mean[to, i] = table[i, 0] * by_age.mean[age, i] + state_covariance[i] * innovation / variance
            for j in range(d):
                spread[i, j] = table[i, 0] * table[j, 0] * covariance[i, j]
                spread[i, j] -= state_covariance[i] * state_covariance[j] / variance
            spread[i, i] += table[i, 2]
        spread[0, 0] += jump * jumps.variance


@compiled
def _normalise(weight: Floats) -> float:
    """Normalise probabilities, given as logarithms, in place. Return the logarithm of the sum before normalisation."""
    highest = weight[0]
    for k in range(1, weight.size):
        highest = max(highest, weight[k])
    density = 0.0
    for k in range(weight.size):
        weight[k] = np.exp(weight[k] - highest)
        density += weight[k]
    for k in range(weight.size):
        weight[k] /= density
    log_sum: float = highest + np.log(density)
    return log_sum


@compiled
def _merge(branches: _GaussianMixture, first: int, end: int, merged: _GaussianMixture, to: int) -> None:
    share = 0.0
    for k in range(first, end):
        share += branches.weight[k]
    merged.weight[to] = share
    if share < MIN_HYPOTHESIS_PROBABILITY:
        return
    d = branches.mean.shape[1]
    mean, covariance = merged.mean[to], merged.covariance[to]
    for i in range(d):
        mean[i] = 0.0
        for k in range(first, end):
            mean[i] += branches.weight[k] / share * branches.mean[k, i]
    for i in range(d):
        for j in range(d):
            covariance[i, j] = 0.0
            for k in range(first, end):
                apart = (branches.mean[k, i] - mean[i]) * (branches.mean[k, j] - mean[j])
                covariance[i, j] += branches.weight[k] / share * (branches.covariance[k, i, j] + apart)
