"""State-space likelihoods that compare a process of random events with an effect of the same spectrum.

A random telegraph has the same second moments as exponentially correlated noise, and Poisson steps have the same second
moments as a random walk. Only the full likelihood distinguishes the two effects.

The background noise is modelled as a sum of independent first-order processes. Each step of the Kalman filter processes
the mean of one block of samples.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, exp, log, pi
from typing import Final, NamedTuple

import numpy as np

from drivers.data_types import Floats
from monitor.common.compiled import compiled
from monitor.common.distributions import Z95
from monitor.reconcile.result import ParameterInterval

MAX_BLOCKS: Final = 1 << 15
"""Largest number of blocks. The end of a longer recording is not used."""
TARGET_BLOCKS: Final = 200.0
"""Smallest number of blocks in a recording with enough samples."""
INITIAL_VARIANCE_RATIO: Final = 100.0
"""Prior variance of the first level, relative to the variance of the data."""
FLICKER_TIME_RATIO: Final = 10.0
"""Ratio of successive correlation times in the approximation of flicker noise. The spectrum deviates by 5 % from 1/f.
"""
FLICKER_CUTOFF_RATIO: Final = 20.0
"""Highest modelled frequency of flicker noise, relative to the frequency at which flicker and white noise are equal."""
CURVATURE_STEP: Final = 0.1
"""Step in the logarithm of a parameter for the numerical curvature at the maximum."""
ODDS_STEP: Final = 1e-3
"""Relative change of the odds for the numerical derivative."""
MAX_LOG_PARAMETER_RANGE: Final = log(30.0)
"""Largest change of the logarithm of a parameter during a search."""


@dataclass(frozen=True, slots=True)
class EventProcessComparison:
    """Comparison of a process of random events with an effect of the same spectrum."""

    gain: float  # log-likelihood of the process less the log-likelihood of the other effect, nats
    parameters: Mapping[str, ParameterInterval]  # of the process at the maximum, SI, 95 %
    events: int  # expected number of switches or jumps, given the data and the process
    single_steps: int = 0  # number of steps, if the process was compared with single steps


@dataclass(frozen=True, slots=True)
class BackgroundNoise:
    """Background noise of an axis, with two-sided spectral densities S(f)."""

    white: float  # N²: S(f) = N², unit² s
    walk: float = 0.0  # K²: S(f) = K²/(2πf)², unit²/s
    flicker: float = 0.0  # B²: S(f) = B²/(2πf), unit²
    correlated: tuple[tuple[float, float], ...] = ()  # (σ, unit; T_c, s) of each exponentially correlated noise


class StateSpaceNoise(NamedTuple):
    """State-space model of the noise in block means, as a sum of first-order processes and white noise.

    In each block, the state x of a process changes to a·x + w, and the process adds c·x + v to the block mean. The
    random terms w and v are Gaussian. The first process is the mean level, which includes the random walk.
    """

    table: Floats  # [d, 4] a, c, variance of w and covariance of v and w, for each process
    white: float  # variance of the white noise in a block mean, plus the variances of all v
    level_variance: float  # prior variance of the mean level in the first block


class EventProcessFit(NamedTuple):
    """Maximum-likelihood fit of a process of random events."""

    log_likelihood: float
    parameters: dict[str, ParameterInterval]
    events: float  # expected number of events, given the data

    def compare_with_other_effect(
        self, other_log_likelihood: float, single_step_count: int = 0
    ) -> EventProcessComparison:
        """Compare the process of random events with another effect.

        Parameters
        ----------
        other_log_likelihood : float
            Maximum log-likelihood of the other effect for the same data.
        single_step_count : int, optional
            Number of steps if the other effect consists of single steps.
        """
        gain = self.log_likelihood - other_log_likelihood
        return EventProcessComparison(gain, self.parameters, round(self.events), single_step_count)


def compute_block_means(y: Floats, tau0_s: float, block_s: float) -> tuple[Floats, float]:
    """Compute the means of consecutive blocks, less the mean of the series.

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

    Examples
    --------
    >>> means, block_s = compute_block_means(np.arange(48.0), 0.5, 1.4)
    >>> means[:3].tolist(), block_s
    ([-22.5, -19.5, -16.5], 1.5)
    """
    size = max(1, round(block_s / tau0_s))
    count = min(y.size // size, MAX_BLOCKS)
    means = y[: count * size].reshape(count, size).mean(1)
    return means - means.mean(), size * tau0_s


def build_state_space_noise(background: BackgroundNoise, means: Floats, block_s: float) -> StateSpaceNoise:
    """Build the state-space model of the background noise in block means.

    Parameters
    ----------
    background : BackgroundNoise
        Noise of the axis.
    means : ndarray of float64, shape (m,)
        Block means, of which the variance sets the prior variance of the mean level.
    block_s : float
        Length of a block in seconds.
    """
    walk = background.walk * block_s
    rows, white = [(1.0, 1.0, walk, 0.5 * walk)], background.white / block_s + walk / 3.0
    for sigma, time_s in (*background.correlated, *_flicker_processes(background, block_s, means.size * block_s)):
        row, own = correlated_noise_of_block_means(sigma, time_s, block_s)
        rows.append(row)
        white += own
    return StateSpaceNoise(np.array(rows), white, INITIAL_VARIANCE_RATIO * float(means.var()))


def correlated_noise_of_block_means(
    sigma: float, correlation_time_s: float, block_s: float
) -> tuple[tuple[float, float, float, float], float]:
    """Return the state-space model of exponentially correlated noise in block means.

    Let σ be the standard deviation of the noise, and x the ratio of block length to correlation time. The variance of a
    block mean is σ² 2(x − 1 + e^−x)/x². The covariance of a block mean with the noise at either end of the block is σ²
    (1 − e^−x)/x.

    Parameters
    ----------
    sigma : float
        Standard deviation, in the unit of the axis.
    correlation_time_s : float
        Correlation time in seconds.
    block_s : float
        Length of a block in seconds.

    Returns
    -------
    row : tuple of float
        Coefficients of one row of ``StateSpaceNoise.table``.
    variance : float
        Variance of the block mean given the noise at the start of the block.
    """
    x = block_s / correlation_time_s
    decay, mean_share = exp(-x), -float(np.expm1(-x)) / x
    own = x * (2.0 / 3.0 - x * (0.5 - x * 7.0 / 30.0)) if x < 0.01 else 2.0 * (x - 1.0 + decay) / x**2 - mean_share**2
    return (
        decay,
        mean_share,
        -(sigma**2) * float(np.expm1(-2.0 * x)),
        sigma**2 * mean_share * (1.0 - decay),
    ), sigma**2 * own


def _flicker_processes(background: BackgroundNoise, block_s: float, duration_s: float) -> list[tuple[float, float]]:
    """Return the standard deviations and correlation times of processes whose sum is flicker noise.

    The sum has the spectral density B²/(2πf) from the inverse of the recording length up to the frequency at which
    white noise dominates. If all processes have the variance s and successive correlation times have the ratio ρ, the
    sum has the density (s π/ln ρ)/(2πf) (Keshner, "1/f noise", Proc. IEEE 70, 1982). The variance s is therefore
    B² ln ρ/π.
    """
    if background.flicker <= 0.0:
        return []
    slowest = duration_s / pi
    fastest = min(max(block_s / pi, background.white / (FLICKER_CUTOFF_RATIO * background.flicker)), 0.1 * slowest)
    count = ceil(log(slowest / fastest) / log(FLICKER_TIME_RATIO)) + 1
    spacing = log(slowest / fastest) / (count - 1)
    sigma = (background.flicker * spacing / pi) ** 0.5
    return [(sigma, slowest * exp(-k * spacing)) for k in range(count)]


def maximise_over_log_parameters(
    log_likelihood: Callable[..., float], start_values: Sequence[float]
) -> tuple[float, Floats]:
    """Maximise a log-likelihood over the logarithms of positive parameters by the Nelder-Mead method.

    Parameters
    ----------
    log_likelihood : callable
        Function of the parameters.
    start_values : sequence of float
        Starting values of the parameters.

    Returns
    -------
    log_likelihood : float
        Log-likelihood at the maximum.
    log_parameters : ndarray of float64, shape (k,)
        Logarithms of the parameters at the maximum.
    """
    from scipy.optimize import minimize

    origin = np.log(np.asarray(start_values, np.float64))
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
    log_likelihood: Callable[[float, float, float], float], start_values: Mapping[str, float]
) -> EventProcessFit:
    """Fit the two parameters of a process of random events by maximum likelihood.

    The expected number of events is the derivative of the log-likelihood with respect to the log-odds of an event
    (Fisher's identity).

    Parameters
    ----------
    log_likelihood : callable
        Function of the two parameters and of a factor on the odds of an event.
    start_values : mapping of str to float
        Names and starting values of the two parameters.
    """
    maximum, at = maximise_over_log_parameters(lambda a, b: log_likelihood(a, b, 1.0), list(start_values.values()))
    deviations = estimate_log_parameter_standard_deviations(
        lambda x: log_likelihood(float(np.exp(x[0])), float(np.exp(x[1])), 1.0), at, maximum
    )
    first, second = np.exp(at).tolist()
    events = (log_likelihood(first, second, 1.0 + ODDS_STEP) - maximum) / ODDS_STEP
    bounds = [log_interval(*one) for one in zip((first, second), deviations.tolist(), strict=True)]
    return EventProcessFit(maximum, dict(zip(start_values, bounds, strict=True)), events)


def log_interval(value: float, deviation: float) -> ParameterInterval:
    """Return the 95 % interval of a positive parameter from the standard deviation of its logarithm."""
    wide = Z95 * deviation
    if not wide < MAX_LOG_PARAMETER_RANGE:
        return ParameterInterval(value)
    return ParameterInterval(value, value * exp(-wide), value * exp(wide))


def estimate_log_parameter_standard_deviations(
    log_likelihood: Callable[[Floats], float], log_parameters: Floats, maximum_log_likelihood: float
) -> Floats:
    """Return the standard deviations of log parameters from the curvature of a log-likelihood at its maximum.

    Parameters
    ----------
    log_likelihood : callable
        Log-likelihood as a function of the logarithms of the parameters.
    log_parameters : ndarray of float64, shape (k,)
        Logarithms of the parameters at the maximum.
    maximum_log_likelihood : float
        Log-likelihood at the maximum.

    Returns
    -------
    ndarray of float64, shape (k,)
        Standard deviations, or NaN if the log-likelihood has no curvature.
    """
    curvature = _curvature(log_likelihood, log_parameters, maximum_log_likelihood)
    if (np.linalg.eigvalsh(curvature) < 0.0).all():
        return np.asarray(np.sqrt(np.diag(np.linalg.inv(-curvature))))
    return np.full(log_parameters.size, np.nan)


def _curvature(function: Callable[[Floats], float], at: Floats, height: float) -> Floats:
    k = at.size
    steps = CURVATURE_STEP * np.eye(k)
    curvature = np.empty((k, k))
    for i in range(k):
        curvature[i, i] = function(at + steps[i]) - 2.0 * height + function(at - steps[i])
        for j in range(i):
            crossed = [function(at + p * steps[i] + q * steps[j]) * p * q for p in (1.0, -1.0) for q in (1.0, -1.0)]
            curvature[i, j] = curvature[j, i] = 0.25 * sum(crossed)
    return curvature / CURVATURE_STEP**2


@compiled
def initial_state_covariance(noise: StateSpaceNoise) -> Floats:
    """Return the state covariance, shape (d, d), before the first block."""
    table = noise.table
    d = table.shape[0]
    covariance = np.zeros((d, d))
    covariance[0, 0] = noise.level_variance
    for i in range(1, d):
        covariance[i, i] = table[i, 2] / (1.0 - table[i, 0] ** 2)
    return covariance


@compiled
def predict_block_mean_variance(noise: StateSpaceNoise, covariance: Floats, state_covariance_out: Floats) -> float:
    """Predict the variance of a block mean from the state covariance, shape (d, d), at the start of the block.

    The covariance of the block mean with the next state, shape (d,), is written to ``state_covariance_out``.
    """
    table = noise.table
    d = table.shape[0]
    variance = 0.0
    for i in range(d):
        total = 0.0
        for j in range(d):
            total += covariance[i, j] * table[j, 1]
        variance += table[i, 1] * total
        state_covariance_out[i] = table[i, 0] * total + table[i, 3]
    return variance + noise.white


@compiled
def difference_from_predicted_block_mean(block_mean: float, noise: StateSpaceNoise, state: Floats) -> float:
    """Return the difference between a block mean and the prediction from the state, shape (d,)."""
    innovation = block_mean
    for i in range(noise.table.shape[0]):
        innovation -= noise.table[i, 1] * state[i]
    return innovation


@compiled
def innovation_variances(extra_level_variance: Floats, noise: StateSpaceNoise) -> tuple[Floats, Floats]:
    """Return the innovation variances, shape (m,), and the covariances with the next state, shape (m, d).

    The variance of the mean level increases by ``extra_level_variance``, shape (m,), at the start of each block.
    """
    table = noise.table
    d, m = table.shape[0], extra_level_variance.size
    variances, state_covariances = np.empty(m), np.empty((m, d))
    covariance = initial_state_covariance(noise)
    for k in range(m):
        covariance[0, 0] += extra_level_variance[k]
        variances[k] = predict_block_mean_variance(noise, covariance, state_covariances[k])
        for i in range(d):
            for j in range(d):
                covariance[i, j] *= table[i, 0] * table[j, 0]
                covariance[i, j] -= state_covariances[k, i] * state_covariances[k, j] / variances[k]
            covariance[i, i] += table[i, 2]
    return variances, state_covariances


@compiled
def innovations_of_series(
    series: Floats, noise: StateSpaceNoise, variances: Floats, state_covariances: Floats
) -> Floats:
    """Return the innovations of a Kalman filter, shape (m,), for a series of block means."""
    table = noise.table
    d = table.shape[0]
    state, innovations = np.zeros(d), np.empty(series.size)
    for k in range(series.size):
        innovations[k] = difference_from_predicted_block_mean(series[k], noise, state)
        for i in range(d):
            state[i] = table[i, 0] * state[i] + state_covariances[k, i] * innovations[k] / variances[k]
    return innovations


@compiled
def kalman_log_likelihood(means: Floats, noise: StateSpaceNoise) -> float:
    """Return the log-likelihood of block means under Gaussian noise.

    The Kalman filter follows Anderson & Moore, "Optimal Filtering", 1979, sections 5.5 and 10.4.
    """
    variances, state_covariances = innovation_variances(np.zeros(means.size), noise)
    innovations = innovations_of_series(means, noise, variances, state_covariances)
    total = 0.0
    for k in range(means.size):
        total -= 0.5 * (np.log(2.0 * np.pi * variances[k]) + innovations[k] * innovations[k] / variances[k])
    return total
