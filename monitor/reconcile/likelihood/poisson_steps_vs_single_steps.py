"""Likelihood comparison of Poisson steps, which are a random process, and a few single steps at fitted times.

A new step is placed in the block with the largest log-likelihood gain, which a Kalman smoother computes (de Jong &
Penzer, "Diagnosing shocks in time series", JASA 93, 1998).

The fitted time and height of each single step have a penalty, following the minimum description length of Rissanen
(1978). The time penalty is the logarithm of the number of blocks. The height penalty is ½ ln(1 + h²/Var h) for the
height h.
"""

from math import log
from typing import Final, NamedTuple

import numpy as np

from drivers.data_types import Floats
from monitor.common.compiled import compiled
from monitor.reconcile.likelihood import poisson_steps_vs_random_walk
from monitor.reconcile.likelihood.event_process_likelihood import (
    BackgroundNoise,
    EventProcessComparison,
    StateSpaceNoise,
    build_state_space_noise,
    compute_block_means,
    innovation_variances,
    innovations_of_series,
    kalman_log_likelihood,
)

TIMES_PER_BLOCK: Final = 8


class _SingleStepsFit(NamedTuple):
    score: float  # log-likelihood less the penalties for times and heights
    times: Floats  # [k] in blocks since the start


def compare_poisson_with_single_steps(
    y: Floats, tau0_s: float, background: BackgroundNoise, K: float, max_single_steps: int = 5
) -> EventProcessComparison:
    """Compare the likelihoods of Poisson steps and a few single steps.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Series in the unit of the axis, without gaps.
    tau0_s : float
        Sample period in seconds.
    background : BackgroundNoise
        Other noise of the axis.
    K : float
        Starting value of the random walk coefficient, in unit/√s. The value must be positive.
    max_single_steps : int, optional
        Largest number of single steps.

    Returns
    -------
    EventProcessComparison
        Log-likelihood gain, fitted rate and height of Poisson steps, and the numbers of jumps and single steps.
    """
    means, block_s = compute_block_means(
        y, tau0_s, poisson_steps_vs_random_walk.choose_block_length_s(y.size * tau0_s, background, K)
    )
    single = _fit_single_steps(means, build_state_space_noise(background, means, block_s), max_single_steps)
    return poisson_steps_vs_random_walk.fit_poisson_jumps(means, block_s, background, K).compare_with_other_effect(
        single.score, single.times.size
    )


def _fit_single_steps(means: Floats, noise: StateSpaceNoise, max_single_steps: int) -> _SingleStepsFit:
    """Return the best fit with 0 to ``max_single_steps`` single steps."""
    blocks: list[int] = []
    best = _SingleStepsFit(kalman_log_likelihood(means, noise), np.empty(0))
    for _ in range(max_single_steps):
        blocks.append(int(np.argmax(_shock_gains(means, noise, blocks))))
        for k in range(len(blocks)):
            blocks[k] = int(np.argmax(_shock_gains(means, noise, blocks[:k] + blocks[k + 1 :])))
        found = _refine_steps(means, noise, sorted(blocks))
        if found.score > best.score:
            best = found
    return best


def _shock_gains(means: Floats, noise: StateSpaceNoise, blocks: list[int]) -> Floats:
    """Return twice the log-likelihood gain of an additional step at the start of each block, shape (m,)."""
    shock_variances = np.zeros(means.size)
    shock_variances[blocks] = noise.level_variance
    gains = _shock_statistics(means, noise, shock_variances)
    gains[blocks] = 0.0
    return gains


def _refine_steps(means: Floats, noise: StateSpaceNoise, blocks: list[int]) -> _SingleStepsFit:
    times = np.array(blocks, np.float64)
    places = np.arange(-TIMES_PER_BLOCK, TIMES_PER_BLOCK + 1) / TIMES_PER_BLOCK
    for k in range(times.size):
        others = np.delete(times, k)
        apart = [at for at in times[k] + places if 0.0 <= at < means.size and (np.abs(others - at) >= 1.0).all()]
        tried = [np.insert(others, k, at) for at in apart]
        times = max(tried, key=lambda t: _fit_heights(means, noise, t)[0])
    total, heights, deviations = _fit_heights(means, noise, times)
    cost = times.size * log(means.size) + 0.5 * float(np.log1p((heights / deviations) ** 2).sum())
    return _SingleStepsFit(total - cost, times)


def _fit_heights(means: Floats, noise: StateSpaceNoise, times: Floats) -> tuple[float, Floats, Floats]:
    """Fit the heights of steps at given times. Return the log-likelihood, the heights and the standard errors."""
    # fraction of each block that lies after the step
    columns = np.clip(np.arange(1.0, means.size + 1.0)[:, None] - times, 0.0, 1.0)
    columns = np.column_stack([means, columns])
    logarithms = _whiten(columns, noise)
    data, design = columns[:, 0], columns[:, 1:]
    normal = np.linalg.inv(design.T @ design)
    heights = normal @ (design.T @ data)
    left = data - design @ heights
    return -0.5 * float(logarithms + left @ left), heights, np.sqrt(np.diag(normal))


@compiled
def _whiten(columns: Floats, noise: StateSpaceNoise) -> float:
    """Whiten columns, shape (m, c), in place. Return the sum of ln 2πS over all innovation variances S."""
    variances, state_covariances = innovation_variances(np.zeros(columns.shape[0]), noise)
    total = 0.0
    for c in range(columns.shape[1]):
        innovations = innovations_of_series(columns[:, c].copy(), noise, variances, state_covariances)
        for k in range(innovations.size):
            columns[k, c] = innovations[k] / np.sqrt(variances[k])
    for variance in variances:
        total += np.log(2.0 * np.pi * variance)
    return total


@compiled
def _shock_statistics(means: Floats, noise: StateSpaceNoise, extra_level_variance: Floats) -> Floats:
    """Return twice the log-likelihood ratio of a step at the start of each block, shape (m,).

    The ratio is r²/N of the fixed-interval smoother (de Jong & Penzer 1998, section 2). The backward recursions are r ←
    h e/S + L'r and N ← h h'/S + L'N L, with L = F − k h'/S. The innovation e has the variance S and the covariance k
    with the next state. The state transition is F, and the block mean contains h times the state.
    """
    table = noise.table
    d, m = table.shape[0], means.size
    variances, state_covariances = innovation_variances(extra_level_variance, noise)
    innovations = innovations_of_series(means, noise, variances, state_covariances)
    r, N, scores = np.zeros(d), np.zeros((d, d)), np.empty(m)
    L = np.empty((d, d))
    for k in range(m - 1, -1, -1):
        for i in range(d):
            for j in range(d):
                L[i, j] = (table[i, 0] if i == j else 0.0) - state_covariances[k, i] * table[j, 1] / variances[k]
        _smooth_backward(r, N, L, table, innovations[k], variances[k])
        scores[k] = r[0] * r[0] / N[0, 0]
    return scores


@compiled
def _smooth_backward(r: Floats, N: Floats, L: Floats, table: Floats, innovation: float, variance: float) -> None:
    d = r.size
    NL, new = np.empty((d, d)), np.empty(d)
    for i in range(d):
        new[i] = table[i, 1] * innovation / variance
        for j in range(d):
            new[i] += L[j, i] * r[j]
            NL[i, j] = 0.0
            for n in range(d):
                NL[i, j] += N[i, n] * L[n, j]
    for i in range(d):
        r[i] = new[i]
        for j in range(d):
            N[i, j] = table[i, 1] * table[j, 1] / variance
            for n in range(d):
                N[i, j] += L[n, i] * NL[n, j]
