"""Likelihood ratio of a random telegraph and exponentially correlated noise, which have the same second moments.

The two levels are the modes of a switching Kalman filter. The Gaussian state of the filter holds the background noise
and the position of the levels. In each block the level stays, changes once, or changes there and back. Each of the
three cases has its own mean and variance of the block mean. After each block, the cases that end in the same level are
merged into one Gaussian with their mean and covariance (GPB2 of Bar-Shalom, Li & Kirubarajan, "Estimation with
Applications to Tracking and Navigation", 2001, section 11.6.4). With white noise around a known level, only the cases
within a block are merged. The filter is then the forward algorithm of a hidden Markov model.
"""

from math import log
from typing import Final, NamedTuple

import numpy as np

from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.reconcile.likelihood.event_process_comparison import (
    TARGET_BLOCKS,
    BackgroundNoise,
    EventProcessComparison,
    EventProcessFit,
    StateSpaceNoise,
    block_markov_noise,
    block_means,
    fit_event_process,
    initial_covariance,
    innovation_of_block,
    kalman_log_likelihood,
    maximise,
    predict_block_mean_variance,
    prior_level_variance,
    state_space_noise,
)

BLOCKS_PER_CORRELATION_TIME: Final = 8.0
"""Number of blocks in a correlation time: the level changes in one of sixteen blocks."""
MAX_FINE_BLOCKS: Final = 20_000.0
"""Largest number of blocks in a recording if the time of switches is resolved more finely."""
MIN_SAMPLES_PER_BLOCK: Final = 20
"""Smallest number of samples in a block if the correlation time allows it. The noise of a sensor is white only over
several samples.
"""
START_AMPLITUDE_FACTORS: Final = np.geomspace(0.5, 2.0, 7)
"""Starting amplitudes as multiples of 2 σ. A few dwells do not determine σ well, and the likelihood has several maxima.
"""
START_DWELL_FACTORS: Final = (0.35, 1.0)
"""Starting dwell times as multiples of 2 T_c. A random walk in the noise makes the correlation appear longer."""
INITIAL_LEVEL_BLOCKS: Final = 1024
"""Number of blocks, about 64 dwells, after which the unknown first level is no longer tracked."""
MIN_WEIGHT: Final = 1e-300
"""Lower limit of the weight of a case relative to the likeliest one. It avoids a division by zero."""


def compare_telegraph_with_correlated_noise(
    y: Floats, tau0_s: float, rest: BackgroundNoise, sigma: float, correlation_time: float
) -> EventProcessComparison:
    """Compare a random telegraph with exponentially correlated noise.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Series in the unit of the axis, without gaps.
    tau0_s : float
        Sample period in seconds.
    rest : BackgroundNoise
        Additional noise of the axis.
    sigma : float
        Starting value of the standard deviation of the process, in the unit of the axis.
    correlation_time : float
        Starting value of the correlation time in seconds.

    Returns
    -------
    EventProcessComparison
        Gain, ``amplitude`` and ``dwell_time`` of the telegraph, and the number of switches.

    Raises
    ------
    ValueError
        If there are too few samples or no white noise.
    """
    means, block_s = block_means(
        y, tau0_s, _block_length_s(y.size * tau0_s, tau0_s, correlation_time, rest.white / sigma**2)
    )
    noise, start = state_space_noise(rest, block_s, means.size * block_s), prior_level_variance(means)

    def correlated(sigma: float, time_s: float) -> float:
        row, own = block_markov_noise(sigma, time_s, block_s)
        both = StateSpaceNoise(np.vstack([noise.table, row]), noise.white + own)
        return float(kalman_log_likelihood(means, both, start))

    telegraph = _fit_telegraph(means, block_s, noise, sigma, correlation_time)
    return telegraph.compare(maximise(correlated, (sigma, correlation_time))[0])


def _block_length_s(span_s: float, tau0_s: float, correlation_time: float, even_s: float) -> float:
    """Return the length of a block in seconds. Shorter blocks resolve the time of a switch better.

    At the length ``even_s``, the white noise of a block mean is half of the amplitude. Shorter blocks contain no more
    information.
    """
    return min(
        correlation_time / BLOCKS_PER_CORRELATION_TIME,
        span_s / TARGET_BLOCKS,
        max(even_s, span_s / MAX_FINE_BLOCKS, MIN_SAMPLES_PER_BLOCK * tau0_s),
    )


def _fit_telegraph(
    means: Floats, block_s: float, noise: StateSpaceNoise, sigma: float, correlation_time: float
) -> EventProcessFit:
    """Maximise the likelihood over amplitude and dwell time, from several starting values."""
    start = prior_level_variance(means)

    def two_levels(amplitude: float, dwell_s: float, odds: float) -> float:
        return _log_likelihood(means, noise, start, amplitude, block_s / dwell_s, odds)

    starts = [
        (2.0 * sigma * a, 2.0 * correlation_time * d)
        for a in START_AMPLITUDE_FACTORS.tolist()
        for d in START_DWELL_FACTORS
    ]
    amplitude, dwell_s = max(starts, key=lambda start: two_levels(start[0], start[1], 1.0))
    return fit_event_process(two_levels, {"amplitude": amplitude, "dwell_time": dwell_s})


def _log_likelihood(
    means: Floats, noise: StateSpaceNoise, start: float, amplitude: float, switches: float, odds: float = 1.0
) -> float:
    """Return the log-likelihood of a random telegraph in block means with an expected number of switches in a block.

    ``odds`` is a factor on the probability of each switch.
    """
    even, odd = 0.5 * (1.0 + np.exp(-2.0 * switches)), -0.5 * np.expm1(-2.0 * switches)
    none = np.exp(-switches)
    # The cases differ in the fraction x of the block that is spent in the other level: none; there and back, with the
    # density 2(1 − x), the mean 1/3 and the variance 1/18; one change, with a uniform density.
    cases = np.array([
        [none, 0.5 * amplitude, 0.0],
        [odds**2 * (even - none), amplitude / 6.0, amplitude**2 / 18.0],
        [odds * odd, 0.0, amplitude**2 / 12.0],
    ])  # fmt: skip
    # The position of the levels is unknown as well. If the filter began in both levels at once, the two explanations
    # would be merged too soon.
    states = [_initial_state(noise, start, first) for first in (0, 1)]
    heads = [_switching_log_likelihood(means[:INITIAL_LEVEL_BLOCKS], noise, cases, state) for state in states]
    rest = _switching_log_likelihood(means[INITIAL_LEVEL_BLOCKS:], noise, cases, states[int(np.argmax(heads))])
    return float(np.logaddexp(heads[0], heads[1]) - log(2.0) + rest)


class _SwitchingFilterState(NamedTuple):
    """State of the filter in each of the two levels."""

    share: Floats  # [2] probability of each level
    at: Floats  # [2, d] mean
    covariance: Floats  # [2, d, d]


class _BlockFilterUpdate(NamedTuple):
    """Update of the filter in each level and in each of the three cases of a block."""

    weight: Floats  # [2, 3] probability
    pull: Floats  # [2, 3] innovation divided by its variance
    known: Floats  # [2, 3] inverse of the variance of the innovation
    reach: Floats  # [2, d] covariance of the block mean with the next state


@compiled
def _initial_state(noise: StateSpaceNoise, start: float, first: int) -> _SwitchingFilterState:
    """Return the state for a known first level."""
    d = noise.table.shape[0]
    state = _SwitchingFilterState(np.zeros(2), np.zeros((2, d)), np.empty((2, d, d)))
    state.share[first] = 1.0
    state.covariance[:] = initial_covariance(noise, start)
    return state


@compiled
def _switching_log_likelihood(
    means: Floats, noise: StateSpaceNoise, cases: Floats, state: _SwitchingFilterState
) -> float:
    """Return the log-likelihood of two levels and update the filter state in place.

    ``cases`` [3, 3] holds the probability, the mean (from the upper level) and the variance of the contribution to a
    block mean. The first two cases end in the level in which they began. The third case ends in the other level.
    """
    d = noise.table.shape[0]
    update = _BlockFilterUpdate(np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3)), np.empty((2, d)))
    moved, merged = np.empty((2, d)), np.empty((2, d, d))
    total: float = -0.5 * means.size * np.log(2.0 * np.pi)
    for z in means:
        density, log_scale = _weigh_cases(z, noise, cases, state, update)
        total += np.log(density) - log_scale
        for level in range(2):
            _merge_returning_cases(update.weight[level], update.pull[level], update.known[level])
        for level in range(2):
            _merge_into_level(level, density, noise.table, state, update, moved[level], merged[level])
        state.at[:] = moved
        state.covariance[:] = merged
    return total


@compiled
def _weigh_cases(
    z: float, noise: StateSpaceNoise, cases: Floats, state: _SwitchingFilterState, update: _BlockFilterUpdate
) -> tuple[float, float]:
    """Update the filter by a block mean ``z`` in each level and case.

    Return the sum of the weights, and the logarithm of the factor by which all weights are too large.
    """
    weight, pull, known = update.weight, update.pull, update.known
    for level in range(2):
        variance = predict_block_mean_variance(noise, state.covariance[level], update.reach[level])
        innovation = innovation_of_block(z, noise, state.at[level])
        sign = 1.0 - 2.0 * level
        for k in range(3):
            apart = innovation - sign * cases[k, 1]
            known[level, k] = 1.0 / (variance + cases[k, 2])
            pull[level, k] = apart * known[level, k]
            weight[level, k] = 0.5 * apart * pull[level, k]
    least, density = weight.min(), 0.0
    for level in range(2):
        for k in range(3):
            prior = state.share[level] * cases[k, 0] * np.sqrt(known[level, k])
            weight[level, k] = prior * np.exp(least - weight[level, k]) + MIN_WEIGHT
            density += weight[level, k]
    return density, least


@compiled
def _merge_returning_cases(weight: Floats, pull: Floats, known: Floats) -> None:
    """Merge the two cases that end in the level in which they began into the first of them."""
    back = weight[1] / (weight[0] + weight[1])
    apart = pull[1] - pull[0]
    pull[0] += back * apart
    known[0] += back * (known[1] - known[0] - (1.0 - back) * apart * apart)
    weight[0] += weight[1]


@compiled
def _merge_into_level(
    level: int,
    density: float,
    table: Floats,
    state: _SwitchingFilterState,
    update: _BlockFilterUpdate,
    moved: Floats,
    merged: Floats,
) -> None:
    """Merge the cases that end in one level into one Gaussian with the mean ``moved`` and covariance ``merged``."""
    d, other = table.shape[0], 1 - level
    reach, pull, known, at, covariance = update.reach, update.pull, update.known, state.at, state.covariance
    step = np.empty(d)
    stays, comes = update.weight[level, 0], update.weight[other, 2]
    state.share[level] = (stays + comes) / density
    came = comes / (stays + comes)
    for i in range(d):
        stay = table[i, 0] * at[level, i] + reach[level, i] * pull[level, 0]
        step[i] = table[i, 0] * at[other, i] + reach[other, i] * pull[other, 2] - stay
        moved[i] = stay + came * step[i]
    for i in range(d):
        for j in range(d):
            decay = table[i, 0] * table[j, 0]
            stay = covariance[level, i, j] * decay - reach[level, i] * reach[level, j] * known[level, 0]
            come = covariance[other, i, j] * decay - reach[other, i] * reach[other, j] * known[other, 2]
            apart = (1.0 - came) * step[i] * step[j]
            merged[i, j] = stay + came * (come - stay + apart)
        merged[i, i] += table[i, 2]
