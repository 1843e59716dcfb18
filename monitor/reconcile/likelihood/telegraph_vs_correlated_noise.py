"""Likelihood comparison of a random telegraph and exponentially correlated noise, which have the same second moments.

The random telegraph is modelled by a switching Kalman filter with two levels. Within a block, the level stays constant,
changes once, or changes and returns. After each block, all cases with the same final level are merged into one Gaussian
by the GPB2 algorithm (Bar-Shalom, Li & Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
section 11.6.4).
"""

from math import log
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
    correlated_noise_of_block_means,
    difference_from_predicted_block_mean,
    fit_event_process,
    initial_state_covariance,
    kalman_log_likelihood,
    maximise_over_log_parameters,
    predict_block_mean_variance,
)

BLOCKS_PER_CORRELATION_TIME: Final = 8.0
"""Number of blocks in a correlation time."""
MAX_FINE_BLOCKS: Final = 20_000.0
"""Largest number of blocks into which a recording is divided to resolve the switches."""
MIN_SAMPLES_PER_BLOCK: Final = 20
"""Smallest number of samples in a block. Blocks are shorter if the correlation time or the recording is short."""
START_AMPLITUDE_FACTORS: Final = np.geomspace(0.5, 2.0, 7)
"""Starting amplitudes as multiples of 2 σ, because the likelihood has several maxima."""
START_DWELL_FACTORS: Final = (0.35, 1.0)
"""Starting dwell times as multiples of 2 T_c."""
INITIAL_LEVEL_BLOCKS: Final = 1024
"""Number of blocks for which the filter tracks both possible first levels."""
MIN_WEIGHT: Final = 1e-300
"""Smallest weight of a case relative to the likeliest case, to avoid a division by zero."""


def compare_telegraph_with_correlated_noise(
    y: Floats, tau0_s: float, background: BackgroundNoise, sigma: float, correlation_time: float
) -> EventProcessComparison:
    """Compare the likelihoods of a random telegraph and exponentially correlated noise.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Series in the unit of the axis, without gaps.
    tau0_s : float
        Sample period in seconds.
    background : BackgroundNoise
        Other noise of the axis.
    sigma : float
        Starting value of the standard deviation of the process, in the unit of the axis.
    correlation_time : float
        Starting value of the correlation time in seconds.

    Returns
    -------
    EventProcessComparison
        Log-likelihood gain, fitted amplitude and dwell time, and number of switches of the telegraph.
    """
    means, block_s = compute_block_means(
        y, tau0_s, _choose_block_length_s(y.size * tau0_s, tau0_s, correlation_time, background.white / sigma**2)
    )
    noise = build_state_space_noise(background, means, block_s)

    def correlated_noise_log_likelihood(sigma: float, time_s: float) -> float:
        row, own = correlated_noise_of_block_means(sigma, time_s, block_s)
        both = StateSpaceNoise(np.vstack([noise.table, row]), noise.white + own, noise.level_variance)
        return float(kalman_log_likelihood(means, both))

    telegraph = _fit_telegraph(means, block_s, noise, sigma, correlation_time)
    return telegraph.compare_with_other_effect(
        maximise_over_log_parameters(correlated_noise_log_likelihood, (sigma, correlation_time))[0]
    )


def _choose_block_length_s(duration_s: float, tau0_s: float, correlation_time: float, equal_noise_s: float) -> float:
    """Choose the block length in seconds.

    Blocks shorter than ``equal_noise_s`` do not improve the resolution of the switches, because of the white noise.
    """
    return min(
        correlation_time / BLOCKS_PER_CORRELATION_TIME,
        duration_s / TARGET_BLOCKS,
        max(equal_noise_s, duration_s / MAX_FINE_BLOCKS, MIN_SAMPLES_PER_BLOCK * tau0_s),
    )


def _fit_telegraph(
    means: Floats, block_s: float, noise: StateSpaceNoise, sigma: float, correlation_time: float
) -> EventProcessFit:
    def telegraph_log_likelihood(amplitude: float, dwell_s: float, odds: float) -> float:
        return _log_likelihood(means, noise, amplitude, block_s / dwell_s, odds)

    starts = [
        (2.0 * sigma * a, 2.0 * correlation_time * d)
        for a in START_AMPLITUDE_FACTORS.tolist()
        for d in START_DWELL_FACTORS
    ]
    amplitude, dwell_s = max(starts, key=lambda start: telegraph_log_likelihood(start[0], start[1], 1.0))
    return fit_event_process(telegraph_log_likelihood, {"amplitude": amplitude, "dwell_time": dwell_s})


def _log_likelihood(
    means: Floats, noise: StateSpaceNoise, amplitude: float, switches: float, odds: float = 1.0
) -> float:
    """Return the log-likelihood of a random telegraph, with the switch probability multiplied by ``odds``."""
    even, odd = 0.5 * (1.0 + np.exp(-2.0 * switches)), -0.5 * np.expm1(-2.0 * switches)
    none = np.exp(-switches)
    # If the level changes and returns, the fraction of the block in the other level has the mean 1/3 and the variance
    # 1/18. If the level changes once, the fraction is uniformly distributed.
    cases = np.array([
        [none, 0.5 * amplitude, 0.0],
        [odds**2 * (even - none), amplitude / 6.0, amplitude**2 / 18.0],
        [odds * odd, 0.0, amplitude**2 / 12.0],
    ])  # fmt: skip
    # The filter runs once for each first level, because one filter would merge the levels too early.
    states = [_initial_state(noise, first_level) for first_level in (0, 1)]
    first_parts = [_switching_log_likelihood(means[:INITIAL_LEVEL_BLOCKS], noise, cases, state) for state in states]
    second_part = _switching_log_likelihood(
        means[INITIAL_LEVEL_BLOCKS:], noise, cases, states[int(np.argmax(first_parts))]
    )
    return float(np.logaddexp(first_parts[0], first_parts[1]) - log(2.0) + second_part)


class _SwitchingFilterState(NamedTuple):
    """Gaussian state of the switching Kalman filter for each of the two levels."""

    probability: Floats  # [2]
    mean: Floats  # [2, d]
    covariance: Floats  # [2, d, d]


class _BlockFilterUpdate(NamedTuple):
    """Update of the switching Kalman filter with one block mean."""

    weight: Floats  # [2, 3] probability
    scaled_innovation: Floats  # [2, 3] innovation divided by its variance
    inverse_variance: Floats  # [2, 3] inverse of the variance of the innovation
    state_covariance: Floats  # [2, d] covariance of the block mean with the next state
    mean_difference: Floats  # [d] difference of the state means of the two cases that are merged


@compiled
def _initial_state(noise: StateSpaceNoise, first_level: int) -> _SwitchingFilterState:
    d = noise.table.shape[0]
    state = _SwitchingFilterState(np.zeros(2), np.zeros((2, d)), np.empty((2, d, d)))
    state.probability[first_level] = 1.0
    state.covariance[:] = initial_state_covariance(noise)
    return state


@compiled
def _switching_log_likelihood(
    means: Floats, noise: StateSpaceNoise, cases: Floats, state: _SwitchingFilterState
) -> float:
    """Return the log-likelihood of a random telegraph, and update the filter state in place.

    Each row of ``cases``, shape (3, 3), contains the probability of a case, and the mean and variance that the
    telegraph adds to a block mean. The mean is given for a block whose first sample is at the
    upper level.
    """
    d = noise.table.shape[0]
    update = _BlockFilterUpdate(np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3)), np.empty((2, d)), np.empty(d))
    moved, merged = np.empty((2, d)), np.empty((2, d, d))
    total: float = -0.5 * means.size * np.log(2.0 * np.pi)
    for block_mean in means:
        density, log_scale = _weigh_cases(block_mean, noise, cases, state, update)
        total += np.log(density) - log_scale
        for level in range(2):
            _merge_returning_case(update.weight[level], update.scaled_innovation[level], update.inverse_variance[level])
        for level in range(2):
            _merge_into_level(level, density, noise.table, state, update, moved[level], merged[level])
        state.mean[:] = moved
        state.covariance[:] = merged
    return total


@compiled
def _weigh_cases(
    block_mean: float, noise: StateSpaceNoise, cases: Floats, state: _SwitchingFilterState, update: _BlockFilterUpdate
) -> tuple[float, float]:
    """Compute the filter update for each level and case. Return the sum of the weights and the logarithm of a scale
    factor.
    """
    weight, pull, known = update.weight, update.scaled_innovation, update.inverse_variance
    for level in range(2):
        variance = predict_block_mean_variance(noise, state.covariance[level], update.state_covariance[level])
        innovation = difference_from_predicted_block_mean(block_mean, noise, state.mean[level])
        sign = 1.0 - 2.0 * level
        for k in range(3):
            apart = innovation - sign * cases[k, 1]
            known[level, k] = 1.0 / (variance + cases[k, 2])
            pull[level, k] = apart * known[level, k]
            weight[level, k] = 0.5 * apart * pull[level, k]
    least, density = weight.min(), 0.0
    for level in range(2):
        for k in range(3):
            prior = state.probability[level] * cases[k, 0] * np.sqrt(known[level, k])
            weight[level, k] = prior * np.exp(least - weight[level, k]) + MIN_WEIGHT
            density += weight[level, k]
    return density, least


@compiled
def _merge_returning_case(weight: Floats, pull: Floats, known: Floats) -> None:
    """Merge the case in which the level changes and returns with the case of a constant level."""
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
    """Merge all cases that end at ``level`` into one Gaussian, and write its mean and covariance in place."""
    d, other = table.shape[0], 1 - level
    _, at, covariance = state
    weight, pull, known, state_covariance, step = update
    stays, comes = weight[level, 0], weight[other, 2]
    state.probability[level] = (stays + comes) / density
    came = comes / (stays + comes)
    for i in range(d):
        stay = table[i, 0] * at[level, i] + state_covariance[level, i] * pull[level, 0]
        step[i] = table[i, 0] * at[other, i] + state_covariance[other, i] * pull[other, 2] - stay
        moved[i] = stay + came * step[i]
    for i in range(d):
        for j in range(i + 1):
            decay = table[i, 0] * table[j, 0]
            stay = (
                covariance[level, i, j] * decay
                - state_covariance[level, i] * state_covariance[level, j] * known[level, 0]
            )
            come = (
                covariance[other, i, j] * decay
                - state_covariance[other, i] * state_covariance[other, j] * known[other, 2]
            )
            apart = (1.0 - came) * step[i] * step[j]
            merged[i, j] = merged[j, i] = stay + came * (come - stay + apart)
        merged[i, i] += table[i, 2]
