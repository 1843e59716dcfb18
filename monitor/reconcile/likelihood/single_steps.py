"""A few steps that happened once each, against Poisson steps, a process that goes on.

Steps at fixed times with free heights are found one after the other, where the smoother of the rest of the noise sees
the likeliest shock of the level (de Jong & Penzer, "Diagnosing shocks in time series", JASA 93, 1998), and each once
more beside all others. Then their times are refined within blocks, and their heights are a least squares fit.

The likelihood of a process is an average over the times and heights that it allows, that of fixed steps is their
maximum. So each step pays what its time and height would cost in such an average: ln of the number of blocks, and
½ ln(1 + h²/Var h) (the minimum description length of Rissanen, 1978). Up to five steps are
mostly cheaper each by itself; from a dozen on the process is, which knows that they are of one kind.
"""

from math import log
from typing import Final, NamedTuple

import numpy as np

from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.reconcile.likelihood import poisson_steps
from monitor.reconcile.likelihood.hidden_state import (
    DEVIATIONS,
    Contest,
    Parts,
    Rest,
    anywhere,
    begin,
    block_means,
    kalman,
    parts,
    predict,
)
from monitor.reconcile.result import Bounds

PLACES: Final = 8
"""Times tried in a block."""


class Steps(NamedTuple):
    """Fixed steps at their best."""

    height: float  # log-likelihood, less what times and heights cost
    times: Floats  # [k] in blocks since the start
    earliest: Floats  # [k]
    latest: Floats  # [k]
    heights: Floats  # [k] unit of the axis
    deviations: Floats  # [k] their standard deviations

    def parameters(self, block_s: float) -> dict[str, Bounds]:
        """``time_1``, ``height_1``, ``time_2``, … in the order of time."""
        found: dict[str, Bounds] = {}
        for k in range(self.times.size):
            time, early, late = (float(t[k]) * block_s for t in (self.times, self.earliest, self.latest))
            height, wide = float(self.heights[k]), DEVIATIONS * float(self.deviations[k])
            found[f"time_{k + 1}"] = Bounds(time, early, late)
            found[f"height_{k + 1}"] = Bounds(height, height - wide, height + wide)
        return found


def steps_or_once(y: Floats, tau0_s: float, rest: Rest, K: float, most: int = 5) -> Contest:
    """Poisson steps (first) against none to ``most`` steps that happened once (second).

    Arguments, errors and the first's parameters are those of ``steps_or_walk``; the second's are ``time_1``, s from the
    start, and ``height_1``, ``time_2``, ….
    """
    means, block_s = block_means(y, tau0_s, poisson_steps.block_for(y.size * tau0_s, rest, K))
    first = poisson_steps.fit_jumps(means, block_s, rest, K)
    second = fit_once(means, parts(rest, block_s, means.size * block_s), most)
    return Contest(first.peak.height - second.height, first.parameters, second.parameters(block_s), round(first.events))


def fit_once(means: Floats, around: Parts, most: int) -> Steps:
    """The number of steps, from none to ``most``, that explains ``means`` at the least cost."""
    blocks: list[int] = []
    best = Steps(kalman(means, around.table, around.white, anywhere(means)), *np.empty((5, 0)))
    for _ in range(most):
        blocks.append(int(np.argmax(_scores(means, around, blocks))))
        for k in range(len(blocks)):
            blocks[k] = int(np.argmax(_scores(means, around, blocks[:k] + blocks[k + 1 :])))
        found = _fit(means, around, sorted(blocks))
        if found.height > best.height:
            best = found
    return best


def _scores(means: Floats, around: Parts, blocks: list[int]) -> Floats:
    """[m] twice the log-likelihood gained by one more shock at the start of each block, beside those in ``blocks``."""
    free = np.zeros(means.size)
    free[blocks] = anywhere(means)
    scores = np.asarray(shocks(means, around.table, around.white, anywhere(means), free))
    scores[blocks] = 0.0
    return scores


def _fit(means: Floats, around: Parts, blocks: list[int]) -> Steps:
    """Times within blocks, heights, and the cost of both."""
    times = np.array(blocks, np.float64)
    places = np.arange(-PLACES, PLACES + 1) / PLACES
    for k in range(times.size):
        others = np.delete(times, k)
        apart = [at for at in times[k] + places if 0.0 <= at < means.size and (np.abs(others - at) >= 1.0).all()]
        tried = [np.insert(others, k, at) for at in apart]
        times = max(tried, key=lambda t: _regress(means, around, t)[0])
    total, heights, deviations = _regress(means, around, times)
    cost = times.size * log(means.size) + 0.5 * float(np.log1p((heights / deviations) ** 2).sum())
    earliest, latest = np.array([_reach(means, around, blocks, k) for k in range(len(blocks))]).T
    return Steps(total - cost, times, np.minimum(earliest, times), np.maximum(latest, times), heights, deviations)


def _regress(means: Floats, around: Parts, times: Floats) -> tuple[float, Floats, Floats]:
    """Log-likelihood with steps at ``times``, and their heights with standard deviations, by least squares."""
    # what part of a block lies after the step
    columns = np.clip(np.arange(1.0, means.size + 1.0)[:, None] - times, 0.0, 1.0)
    columns = np.column_stack([means, columns])
    logarithms = whiten(columns, around.table, around.white, anywhere(means))
    data, design = columns[:, 0], columns[:, 1:]
    normal = np.linalg.inv(design.T @ design)
    heights = normal @ (design.T @ data)
    left = data - design @ heights
    return -0.5 * float(logarithms + left @ left), heights, np.sqrt(np.diag(normal))


def _reach(means: Floats, around: Parts, blocks: list[int], k: int) -> tuple[float, float]:
    """From where to where step ``k`` may be moved, others where they are, in 95 of 100."""
    scores = _scores(means, around, blocks[:k] + blocks[k + 1 :])
    worse = np.flatnonzero(scores < scores[blocks[k]] - DEVIATIONS**2)
    before, after = worse[worse < blocks[k]], worse[worse > blocks[k]]
    return float(before[-1] if before.size else 0), float(after[0] if after.size else means.size)


@compiled
def whiten(columns, table, white, start):  # type: ignore[no-untyped-def]
    """Make columns [m, c] independent, of variance one, in place; Σ ln 2πS of the variances that they had."""
    variances, reaches = _gains(np.zeros(columns.shape[0]), table, white, start)
    total = 0.0
    for c in range(columns.shape[1]):
        innovations = _innovations(columns[:, c].copy(), table, variances, reaches)
        for k in range(innovations.size):
            columns[k, c] = innovations[k] / np.sqrt(variances[k])
    for variance in variances:
        total += np.log(2.0 * np.pi * variance)
    return total


@compiled
def shocks(means, table, white, start, free):  # type: ignore[no-untyped-def]
    """Twice the log-likelihood ratio [m] of a shock of the level at the start of each block; ``free`` as in ``_gains``.

    r²/N of the fixed-interval smoother (de Jong & Penzer 1998, section 2), with state r ← h e/S + L'r and
    N ← h h'/S + L'N L backwards, L = F − reach h'/S.
    """
    d, m = table.shape[0], means.size
    variances, reaches = _gains(free, table, white, start)
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
def _gains(free, table, white, start):  # type: ignore[no-untyped-def]
    """Of a Kalman filter: variances [m] of the innovations, and their covariances [m, d] with the next state.

    ``free`` [m] is variance that the level is given at the start of each block.
    """
    d, m = table.shape[0], free.size
    variances, reaches, covariance = np.empty(m), np.empty((m, d)), begin(table, start)
    for k in range(m):
        covariance[0, 0] += free[k]
        variances[k] = predict(table, covariance, reaches[k]) + white
        for i in range(d):
            for j in range(d):
                covariance[i, j] *= table[i, 0] * table[j, 0]
                covariance[i, j] -= reaches[k, i] * reaches[k, j] / variances[k]
            covariance[i, i] += table[i, 2]
    return variances, reaches


@compiled
def _innovations(series, table, variances, reaches):  # type: ignore[no-untyped-def]
    """What of a series [m] its past does not tell."""
    d = table.shape[0]
    at, innovations = np.zeros(d), np.empty(series.size)
    for k in range(series.size):
        innovations[k] = series[k]
        for i in range(d):
            innovations[k] -= table[i, 1] * at[i]
        for i in range(d):
            at[i] = table[i, 0] * at[i] + reaches[k, i] * innovations[k] / variances[k]
    return innovations
