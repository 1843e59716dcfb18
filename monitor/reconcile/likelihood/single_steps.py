"""Likelihood ratio of Poisson steps, a continuing process, and a few single steps.

Steps at fixed times with free heights are found one after the other. Each step is placed where the smoother of the
remaining noise shows the likeliest shock of the level (de Jong & Penzer, "Diagnosing shocks in time series", JASA 93,
1998). Each step is then placed once more with all others present. Finally the times are refined within blocks, and the
heights are fitted by least squares.

The likelihood of a process is an average over all times and heights that it allows. The likelihood of fixed steps is a
maximum. Each step therefore gets the penalty that its time and height would have in such an average: ln of the number
of blocks, and ½ ln(1 + h²/Var h) (the minimum description length of Rissanen, 1978). Up to about five steps, single
steps usually have the smaller penalty. From about a dozen steps on, the process has the smaller penalty, because it
describes them by common parameters.
"""

from math import log
from typing import Final, NamedTuple

import numpy as np

from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.common.distributions import Z95
from monitor.reconcile.likelihood import poisson_steps
from monitor.reconcile.likelihood.hidden_state import (
    BackgroundNoise,
    ModelComparison,
    StateSpaceNoise,
    block_means,
    initial_covariance,
    kalman_log_likelihood,
    predict_block,
    prior_level_variance,
    state_space_noise,
)
from monitor.reconcile.result import ParameterInterval

TIMES_PER_BLOCK: Final = 8
"""Number of times that are tried within a block."""


class SingleStepsFit(NamedTuple):
    """Best fit of single steps."""

    height: float  # log-likelihood less the penalties for times and heights
    times: Floats  # [k] in blocks since the start
    earliest: Floats  # [k] lower end of the 95 % interval of the time
    latest: Floats  # [k] upper end of the same interval
    heights: Floats  # [k] unit of the axis
    deviations: Floats  # [k] standard deviations of the heights

    def parameters(self, block_s: float) -> dict[str, ParameterInterval]:
        """Return ``time_1``, ``height_1``, ``time_2``, … with 95 % intervals, in the order of time."""
        found: dict[str, ParameterInterval] = {}
        for k in range(self.times.size):
            time, early, late = (float(t[k]) * block_s for t in (self.times, self.earliest, self.latest))
            height, wide = float(self.heights[k]), Z95 * float(self.deviations[k])
            found[f"time_{k + 1}"] = ParameterInterval(time, early, late)
            found[f"height_{k + 1}"] = ParameterInterval(height, height - wide, height + wide)
        return found


def compare_steps_with_single_steps(
    y: Floats, tau0_s: float, rest: BackgroundNoise, K: float, most: int = 5
) -> ModelComparison:
    """Compare Poisson steps with a few single steps.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Series in the unit of the axis, without gaps.
    tau0_s : float
        Sample period in seconds.
    rest : Rest
        Additional noise of the axis.
    K : float
        Starting value of the random walk coefficient, in unit/√s, above zero.
    most : int, optional
        Largest number of single steps.

    Returns
    -------
    ModelComparison
        ``rate`` and ``height`` of the Poisson steps (first). ``time_1`` in seconds from the start, ``height_1``,
        ``time_2``, … of the single steps (second). The number of jumps of the Poisson steps.

    Raises
    ------
    ValueError
        If there are too few samples or no white noise.
    """
    means, block_s = block_means(y, tau0_s, poisson_steps.block_for(y.size * tau0_s, rest, K))
    first = poisson_steps.fit_jumps(means, block_s, rest, K)
    second = fit_single_steps(means, state_space_noise(rest, block_s, means.size * block_s), most)
    return ModelComparison(
        first.peak.height - second.height, first.parameters, second.parameters(block_s), round(first.events)
    )


def fit_single_steps(means: Floats, noise: StateSpaceNoise, most: int) -> SingleStepsFit:
    """Fit the number of single steps that explains the block means at the smallest cost.

    Parameters
    ----------
    means : ndarray of float64, shape (m,)
        Block means in the unit of the axis.
    noise : StateSpaceNoise
        Additional noise.
    most : int
        Largest number of steps.
    """
    blocks: list[int] = []
    best = SingleStepsFit(
        kalman_log_likelihood(means, noise.table, noise.white, prior_level_variance(means)), *np.empty((5, 0))
    )
    for _ in range(most):
        blocks.append(int(np.argmax(_shock_gains(means, noise, blocks))))
        for k in range(len(blocks)):
            blocks[k] = int(np.argmax(_shock_gains(means, noise, blocks[:k] + blocks[k + 1 :])))
        found = _refine_steps(means, noise, sorted(blocks))
        if found.height > best.height:
            best = found
    return best


def _shock_gains(means: Floats, noise: StateSpaceNoise, blocks: list[int]) -> Floats:
    """Return twice the log-likelihood gain, shape (m,), of one more shock at the start of each block.

    The shocks in ``blocks`` are already present.
    """
    free = np.zeros(means.size)
    free[blocks] = prior_level_variance(means)
    scores = np.asarray(shock_statistics(means, noise.table, noise.white, prior_level_variance(means), free))
    scores[blocks] = 0.0
    return scores


def _refine_steps(means: Floats, noise: StateSpaceNoise, blocks: list[int]) -> SingleStepsFit:
    """Refine the times of the steps within their blocks and return the fit with its penalties."""
    times = np.array(blocks, np.float64)
    places = np.arange(-TIMES_PER_BLOCK, TIMES_PER_BLOCK + 1) / TIMES_PER_BLOCK
    for k in range(times.size):
        others = np.delete(times, k)
        apart = [at for at in times[k] + places if 0.0 <= at < means.size and (np.abs(others - at) >= 1.0).all()]
        tried = [np.insert(others, k, at) for at in apart]
        times = max(tried, key=lambda t: _fit_heights(means, noise, t)[0])
    total, heights, deviations = _fit_heights(means, noise, times)
    cost = times.size * log(means.size) + 0.5 * float(np.log1p((heights / deviations) ** 2).sum())
    earliest, latest = np.array([_time_interval(means, noise, blocks, k) for k in range(len(blocks))]).T
    return SingleStepsFit(
        total - cost, times, np.minimum(earliest, times), np.maximum(latest, times), heights, deviations
    )


def _fit_heights(means: Floats, noise: StateSpaceNoise, times: Floats) -> tuple[float, Floats, Floats]:
    """Return the log-likelihood with steps at given times, and the heights with standard deviations, by least
    squares.
    """
    # fraction of each block that lies after the step
    columns = np.clip(np.arange(1.0, means.size + 1.0)[:, None] - times, 0.0, 1.0)
    columns = np.column_stack([means, columns])
    logarithms = whiten(columns, noise.table, noise.white, prior_level_variance(means))
    data, design = columns[:, 0], columns[:, 1:]
    normal = np.linalg.inv(design.T @ design)
    heights = normal @ (design.T @ data)
    left = data - design @ heights
    return -0.5 * float(logarithms + left @ left), heights, np.sqrt(np.diag(normal))


def _time_interval(means: Floats, noise: StateSpaceNoise, blocks: list[int], k: int) -> tuple[float, float]:
    """Return the 95 % interval of the time of step ``k``, in blocks, with the other steps fixed."""
    scores = _shock_gains(means, noise, blocks[:k] + blocks[k + 1 :])
    worse = np.flatnonzero(scores < scores[blocks[k]] - Z95**2)
    before, after = worse[worse < blocks[k]], worse[worse > blocks[k]]
    return float(before[-1] if before.size else 0), float(after[0] if after.size else means.size)


@compiled
def whiten(columns, table, white, start):  # type: ignore[no-untyped-def]
    """Whiten columns, shape (m, c), in place to unit variance and return Σ ln 2πS of their innovation variances."""
    variances, reaches = _innovation_variances(np.zeros(columns.shape[0]), table, white, start)
    total = 0.0
    for c in range(columns.shape[1]):
        innovations = _innovations(columns[:, c].copy(), table, variances, reaches)
        for k in range(innovations.size):
            columns[k, c] = innovations[k] / np.sqrt(variances[k])
    for variance in variances:
        total += np.log(2.0 * np.pi * variance)
    return total


@compiled
def shock_statistics(means, table, white, start, free):  # type: ignore[no-untyped-def]
    """Return twice the log-likelihood ratio, shape (m,), of a shock of the level at the start of each block.

    The ratio is r²/N of the fixed-interval smoother (de Jong & Penzer 1998, section 2). The backward recursions are r ←
    h e/S + L'r and N ← h h'/S + L'N L, with L = F − reach h'/S. ``free`` has the same meaning as in
    ``_innovation_variances``.
    """
    d, m = table.shape[0], means.size
    variances, reaches = _innovation_variances(free, table, white, start)
    innovations = _innovations(means, table, variances, reaches)
    r, N, scores = np.zeros(d), np.zeros((d, d)), np.empty(m)
    L, NL, new = np.empty((d, d)), np.empty((d, d)), np.empty(d)
    for k in range(m - 1, -1, -1):
        for i in range(d):
            for j in range(d):
                L[i, j] = (table[i, 0] if i == j else 0.0) - reaches[k, i] * table[j, 1] / variances[k]
        for i in range(d):
            new[i] = table[i, 1] * innovations[k] / variances[k]
            for j in range(d):
                new[i] += L[j, i] * r[j]
                NL[i, j] = 0.0
                for n in range(d):
                    NL[i, j] += N[i, n] * L[n, j]
        for i in range(d):
            r[i] = new[i]
            for j in range(d):
                N[i, j] = table[i, 1] * table[j, 1] / variances[k]
                for n in range(d):
                    N[i, j] += L[n, i] * NL[n, j]
        scores[k] = r[0] * r[0] / N[0, 0]
    return scores


@compiled
def _innovation_variances(free, table, white, start):  # type: ignore[no-untyped-def]
    """Return the variances of the innovations, shape (m,), and their covariances with the next state, shape (m, d).

    ``free`` [m] is additional variance of the level at the start of each block.
    """
    d, m = table.shape[0], free.size
    variances, reaches, covariance = np.empty(m), np.empty((m, d)), initial_covariance(table, start)
    for k in range(m):
        covariance[0, 0] += free[k]
        variances[k] = predict_block(table, covariance, reaches[k]) + white
        for i in range(d):
            for j in range(d):
                covariance[i, j] *= table[i, 0] * table[j, 0]
                covariance[i, j] -= reaches[k, i] * reaches[k, j] / variances[k]
            covariance[i, i] += table[i, 2]
    return variances, reaches


@compiled
def _innovations(series, table, variances, reaches):  # type: ignore[no-untyped-def]
    """Return the innovations of a series, shape (m,): the differences from the predictions of the Kalman filter."""
    d = table.shape[0]
    at, innovations = np.zeros(d), np.empty(series.size)
    for k in range(series.size):
        innovations[k] = series[k]
        for i in range(d):
            innovations[k] -= table[i, 1] * at[i]
        for i in range(d):
            at[i] = table[i, 0] * at[i] + reaches[k, i] * innovations[k] / variances[k]
    return innovations
