"""Shared parts of the likelihoods for effects that have the same spectrum.

A random telegraph has the same second moments as exponentially correlated noise. Poisson steps have the same second
moments as a random walk. Only the distributions differ. Both effects of a pair therefore get their full likelihood on
the same data with the same background noise. The gain of an ``EventProcessComparison`` is the
logarithm of the ratio of the two maximum likelihoods. The caller subtracts penalties for parameters and prior odds.

The data are block means. The background noise consists of white noise, random walk, flicker noise and exponentially
correlated noise. It is written as a sum of independent first-order processes whose block means are known given the
value at the start of the block. Each block thus needs one step of a Kalman filter, and averaging adds no error. The
first level has a nearly flat prior, the same for both effects.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, exp, log, pi
from typing import Final, NamedTuple

import numpy as np

from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.common.distributions import Z95
from monitor.reconcile.result import ParameterInterval

MAX_BLOCKS: Final = 1 << 15
"""Largest number of blocks. Only the first blocks of a longer recording are used."""
TARGET_BLOCKS: Final = 200.0
"""Number of blocks in a recording, unless it has fewer samples."""
MIN_BLOCKS: Final = 16
"""Smallest number of blocks."""
INITIAL_VARIANCE_RATIO: Final = 100.0
"""Prior variance of the first level relative to the variance of the data. This prior is effectively flat. Both effects
have the same prior.
"""
FLICKER_TIME_RATIO: Final = 10.0
"""Ratio of successive correlation times of the processes that approximate flicker noise. With this ratio, the spectrum
deviates by 5 % from 1/f.
"""
FLICKER_CUTOFF_RATIO: Final = 20.0
"""Highest frequency at which flicker noise is modelled, relative to the frequency at which it equals the white noise.
"""
CURVATURE_STEP: Final = 0.1
"""Step in the logarithm of a parameter for the numerical curvature at the maximum."""
ODDS_STEP: Final = 1e-3
"""Relative change of the odds for the numerical derivative that counts the events."""
MAX_LOG_PARAMETER_RANGE: Final = log(30.0)
"""Largest distance of the logarithm of a parameter from its starting value."""


@dataclass(frozen=True, slots=True)
class EventProcessComparison:
    """Comparison of a process of random events with an effect that has the same spectrum, on one axis."""

    gain: float  # log-likelihood of the process minus that of the other effect
    parameters: Mapping[str, ParameterInterval]  # of the process at the maximum, SI, 95 %
    events: int  # expected number of switches or jumps, given the data and the process
    single_steps: int = 0  # number of steps, if the process was compared with single steps


@dataclass(frozen=True, slots=True)
class BackgroundNoise:
    """Additional noise of an axis, as two-sided spectra."""

    white: float  # N²: S(f) = N², unit² s
    walk: float = 0.0  # K²: S(f) = K²/(2πf)², unit²/s
    flicker: float = 0.0  # B²: S(f) = B²/(2πf), unit²
    correlated: tuple[tuple[float, float], ...] = ()  # (σ, unit; T_c, s) of each exponentially correlated noise


class StateSpaceNoise(NamedTuple):
    """Noise of block means as a sum of independent first-order processes and of white noise.

    From the start of one block to the start of the next, a process changes by x ← decay·x + w. The mean of the block
    contains seen·x + v, with Var w = drive and Cov(v, w) = shared. The first process is the level, including the random
    walk.
    """

    table: Floats  # [d, 4] decay, seen, drive, shared
    white: float  # variance of the white noise and of all v


class EventProcessFit(NamedTuple):
    """Fit of a process of random events at the maximum of the likelihood."""

    log_likelihood: float
    parameters: dict[str, ParameterInterval]
    events: float  # expected number of events, given the data

    def compare(self, log_likelihood: float, single_steps: int = 0) -> EventProcessComparison:
        """Compare the process with another effect.

        Parameters
        ----------
        log_likelihood : float
            Log-likelihood of the other effect on the same data.
        single_steps : int, optional
            Number of steps, if the other effect is a number of single steps.
        """
        return EventProcessComparison(
            self.log_likelihood - log_likelihood, self.parameters, round(self.events), single_steps
        )


def block_means(y: Floats, tau0_s: float, block_s: float) -> tuple[Floats, float]:
    """Return the means of consecutive blocks without their overall mean, and the length of a block.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Series in the unit of the axis.
    tau0_s : float
        Sample period in seconds.
    block_s : float
        Approximate length of a block in seconds.

    Returns
    -------
    means : ndarray of float64, shape (m,)
        Block means in the unit of ``y``.
    block_s : float
        Exact length of a block in seconds.

    Raises
    ------
    ValueError
        If the series has too few blocks.

    Examples
    --------
    >>> block_means(np.arange(48.0), 0.5, 1.4)[0][:3].tolist(), block_means(np.arange(48.0), 0.5, 1.4)[1]
    ([-22.5, -19.5, -16.5], 1.5)
    """
    size = max(1, round(block_s / tau0_s))
    count = min(y.size // size, MAX_BLOCKS)
    if count < MIN_BLOCKS:
        raise ValueError(f"{count} blocks of {size * tau0_s:g} s; at least {MIN_BLOCKS} are needed")
    means = y[: count * size].reshape(count, size).mean(1)
    return means - means.mean(), size * tau0_s


def state_space_noise(rest: BackgroundNoise, block_s: float, span_s: float) -> StateSpaceNoise:
    """Return the noise as it appears in block means.

    Parameters
    ----------
    rest : BackgroundNoise
        Noise of the axis.
    block_s : float
        Length of a block in seconds.
    span_s : float
        Length of the recording in seconds.

    Raises
    ------
    ValueError
        If there is no white noise. Every single switch would then be visible without a likelihood.
    """
    if not rest.white > 0.0:
        raise ValueError(f"white noise of {rest.white:g}; it must be above zero")
    walk = rest.walk * block_s
    rows, white = [(1.0, 1.0, walk, 0.5 * walk)], rest.white / block_s + walk / 3.0
    for sigma, time_s in (*rest.correlated, *_flicker_processes(rest, block_s, span_s)):
        row, own = block_markov_noise(sigma, time_s, block_s)
        rows.append(row)
        white += own
    return StateSpaceNoise(np.array(rows), white)


def block_markov_noise(sigma: float, time_s: float, block_s: float) -> tuple[tuple[float, float, float, float], float]:
    """Return exponentially correlated noise as it appears in block means.

    With x = Δ/T_c the mean of a block has the variance σ² 2(x − 1 + e^−x)/x². Its covariance with the value at either
    end is σ² (1 − e^−x)/x. Both are integrals of σ² e^−|t|/T_c. The result is conditional on the value at the start of
    the block.

    Parameters
    ----------
    sigma : float
        Standard deviation, in the unit of the axis.
    time_s : float
        Correlation time in seconds.
    block_s : float
        Length of a block in seconds.

    Returns
    -------
    row : tuple of float
        Row of ``StateSpaceNoise.table``.
    variance : float
        Variance of the block mean that is not explained by the start of the block.
    """
    x = block_s / time_s
    decay, seen = exp(-x), -float(np.expm1(-x)) / x
    own = x * (2.0 / 3.0 - x * (0.5 - x * 7.0 / 30.0)) if x < 0.01 else 2.0 * (x - 1.0 + decay) / x**2 - seen**2
    return (decay, seen, -(sigma**2) * float(np.expm1(-2.0 * x)), sigma**2 * seen * (1.0 - decay)), sigma**2 * own


def _flicker_processes(rest: BackgroundNoise, block_s: float, span_s: float) -> list[tuple[float, float]]:
    """Return the standard deviations and correlation times of correlated noises whose sum is flicker noise.

    The sum is B²/(2πf) from 1/span to the frequency at which white noise dominates. Processes with equal variance s and
    with a constant spacing ln ρ of ln T_c add up to πs/(ln ρ 2πf) (Keshner, "1/f noise", Proc. IEEE 70, 1982).
    Therefore s = B² ln ρ/π.
    """
    if rest.flicker <= 0.0:
        return []
    slowest = span_s / pi
    fastest = min(max(block_s / pi, rest.white / (FLICKER_CUTOFF_RATIO * rest.flicker)), 0.1 * slowest)
    count = ceil(log(slowest / fastest) / log(FLICKER_TIME_RATIO)) + 1
    spacing = log(slowest / fastest) / (count - 1)
    sigma = (rest.flicker * spacing / pi) ** 0.5
    return [(sigma, slowest * exp(-k * spacing)) for k in range(count)]


def maximise(log_likelihood: Callable[..., float], start: Sequence[float]) -> tuple[float, Floats]:
    """Maximise a log-likelihood over positive parameters, by the Nelder-Mead method in their logarithms.

    Parameters
    ----------
    log_likelihood : callable
        Function of the parameters.
    start : sequence of float
        Starting values of the parameters.

    Returns
    -------
    log_likelihood : float
        Log-likelihood at the maximum.
    log_parameters : ndarray of float64, shape (k,)
        Logarithms of the parameters at the maximum.
    """
    from scipy.optimize import minimize

    origin = np.log(np.asarray(start, np.float64))
    found = minimize(
        lambda at: -log_likelihood(*np.exp(at)),
        origin,
        method="Nelder-Mead",
        bounds=[(x - MAX_LOG_PARAMETER_RANGE, x + MAX_LOG_PARAMETER_RANGE) for x in origin],
        options={
            "initial_simplex": np.vstack([origin, origin + 0.3 * np.eye(origin.size)]),
            "xatol": 0.02,
            "fatol": 0.02,
            "maxiter": 80,
        },
    )
    return -float(found.fun), np.asarray(found.x)


def fit_event_process(
    likelihood: Callable[[float, float, float], float], start: Mapping[str, float]
) -> EventProcessFit:
    """Maximise the likelihood of a process of random events over its two parameters.

    The number of events expected from the data is the derivative of the log-likelihood by the logarithm of the odds of
    an event (Fisher's identity).

    Parameters
    ----------
    likelihood : callable
        Function of the two parameters and of a factor on the odds of an event.
    start : mapping of str to float
        Names and starting values of the two parameters.
    """
    height, at = maximise(lambda a, b: likelihood(a, b, 1.0), list(start.values()))
    deviations = _log_deviations(lambda x: likelihood(float(np.exp(x[0])), float(np.exp(x[1])), 1.0), at, height)
    first, second = np.exp(at).tolist()
    events = (likelihood(first, second, 1.0 + ODDS_STEP) - height) / ODDS_STEP
    bounds = [_log_interval(*one) for one in zip((first, second), deviations.tolist(), strict=True)]
    return EventProcessFit(height, dict(zip(start, bounds, strict=True)), events)


def _log_interval(value: float, deviation: float) -> ParameterInterval:
    """Return a parameter with its 95 % interval, or without an interval if this is wider than the search.

    ``deviation`` is the standard deviation of the logarithm.
    """
    wide = Z95 * deviation
    if not wide < MAX_LOG_PARAMETER_RANGE:
        return ParameterInterval(value)
    return ParameterInterval(value, value * exp(-wide), value * exp(wide))


def _log_deviations(function: Callable[[Floats], float], at: Floats, height: float) -> Floats:
    """Return the standard deviations of the logarithms of the parameters, or NaN if there is no maximum."""
    curvature = _curvature(function, at, height)
    if (np.linalg.eigvalsh(curvature) < 0.0).all():
        return np.asarray(np.sqrt(np.diag(np.linalg.inv(-curvature))))
    return np.full(at.size, np.nan)


def _curvature(function: Callable[[Floats], float], at: Floats, height: float) -> Floats:
    """Return the second derivatives, shape (k, k), from differences over ``CURVATURE_STEP``."""
    k = at.size
    steps = CURVATURE_STEP * np.eye(k)
    curvature = np.empty((k, k))
    for i in range(k):
        curvature[i, i] = function(at + steps[i]) - 2.0 * height + function(at - steps[i])
        for j in range(i):
            crossed = [function(at + p * steps[i] + q * steps[j]) * p * q for p in (1.0, -1.0) for q in (1.0, -1.0)]
            curvature[i, j] = curvature[j, i] = 0.25 * sum(crossed)
    return curvature / CURVATURE_STEP**2


def prior_level_variance(means: Floats) -> float:
    """Return the prior variance of the first level."""
    return INITIAL_VARIANCE_RATIO * float(means.var())


@compiled
def initial_covariance(noise: StateSpaceNoise, start: float) -> Floats:
    """Return the state covariance, shape (d, d), before the first block.

    The level has a wide prior with the variance ``start``. The other processes are stationary.
    """
    table = noise.table
    d = table.shape[0]
    covariance = np.zeros((d, d))
    covariance[0, 0] = start
    for i in range(1, d):
        covariance[i, i] = table[i, 2] / (1.0 - table[i, 0] ** 2)
    return covariance


@compiled
def predict_block_mean_variance(noise: StateSpaceNoise, covariance: Floats, reach: Floats) -> float:
    """Return the variance of a block mean, and store its covariance with the next state in ``reach`` [d]."""
    table = noise.table
    d = table.shape[0]
    variance = 0.0
    for i in range(d):
        total = 0.0
        for j in range(d):
            total += covariance[i, j] * table[j, 1]
        variance += table[i, 1] * total
        reach[i] = table[i, 0] * total + table[i, 3]
    return variance + noise.white


@compiled
def innovation_of_block(z: float, noise: StateSpaceNoise, at: Floats) -> float:
    """Return the difference of a block mean from the prediction by the state ``at`` [d]."""
    innovation = z
    for i in range(noise.table.shape[0]):
        innovation -= noise.table[i, 1] * at[i]
    return innovation


@compiled
def innovation_variances(free: Floats, noise: StateSpaceNoise, start: float) -> tuple[Floats, Floats]:
    """Return the variances of the innovations, shape (m,), and their covariances with the next state, shape (m, d).

    ``free`` [m] is additional variance of the level at the start of each block.
    """
    table = noise.table
    d, m = table.shape[0], free.size
    variances, reaches, covariance = np.empty(m), np.empty((m, d)), initial_covariance(noise, start)
    for k in range(m):
        covariance[0, 0] += free[k]
        variances[k] = predict_block_mean_variance(noise, covariance, reaches[k])
        for i in range(d):
            for j in range(d):
                covariance[i, j] *= table[i, 0] * table[j, 0]
                covariance[i, j] -= reaches[k, i] * reaches[k, j] / variances[k]
            covariance[i, i] += table[i, 2]
    return variances, reaches


@compiled
def innovations_of_series(series: Floats, noise: StateSpaceNoise, variances: Floats, reaches: Floats) -> Floats:
    """Return the innovations of a series, shape (m,): the differences from the predictions of the Kalman filter."""
    table = noise.table
    d = table.shape[0]
    at, innovations = np.zeros(d), np.empty(series.size)
    for k in range(series.size):
        innovations[k] = innovation_of_block(series[k], noise, at)
        for i in range(d):
            at[i] = table[i, 0] * at[i] + reaches[k, i] * innovations[k] / variances[k]
    return innovations


@compiled
def kalman_log_likelihood(means: Floats, noise: StateSpaceNoise, start: float) -> float:
    """Return the log-likelihood of Gaussian noise in block means.

    The Kalman filter follows Anderson & Moore, "Optimal Filtering", 1979, sections 5.5 and 10.4.
    """
    variances, reaches = innovation_variances(np.zeros(means.size), noise, start)
    innovations = innovations_of_series(means, noise, variances, reaches)
    total = 0.0
    for k in range(means.size):
        total -= 0.5 * (np.log(2.0 * np.pi * variances[k]) + innovations[k] * innovations[k] / variances[k])
    return total
