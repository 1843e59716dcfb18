"""Maximum likelihood fit of a slow random variation of the noise variance.

The logarithm of the mean square of each block is ln σ² plus the logarithm of a χ² variable, which is nearly Gaussian
with a known mean and variance. In the model, ln σ² is Gauss–Markov noise. The Whittle likelihood of the cosine
transform of the logarithms is maximised (Harvey, Ruiz & Shephard, "Multivariate stochastic variance models", 1994).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.fft import dct, idct
from scipy.special import polygamma, psi

from drivers.data_types import Floats
from monitor.common.distributions import Z95
from monitor.reconcile.likelihood.variance_change_tests import MIN_VARIANCE_BLOCKS, count_variance_blocks
from monitor.reconcile.preparation.value_artifacts import ValueWithInterval

MIN_CORRELATION_BLOCKS: Final = 1.0
"""Smallest correlation time, in blocks."""
MAX_CORRELATION_FRACTION: Final = 0.25
"""Largest correlation time, as a fraction of the recording."""
DEVIATIONS: Final = np.geomspace(0.01, 3.0, 24)
"""Standard deviations of ln σ² in the first search."""
CORRELATION_TIMES: Final = 16
"""Number of correlation times in the first search."""
DIFFERENCE_STEP: Final = 1e-3
"""Change of the logarithm of a parameter in the numerical derivatives."""


@dataclass(frozen=True, slots=True)
class _LogVariances:
    """Logarithms of the mean squares of all blocks."""

    logs: Floats  # [m] without the bias of the logarithm of a χ² variable
    error_variance: float  # variance of each logarithm for a constant σ²
    block_samples: int

    @property
    def centres(self) -> Floats:
        """Sample indices of the block centres, shape (m,)."""
        return np.asarray((np.arange(self.logs.size) + 0.5) * self.block_samples - 0.5)

    def transform(self) -> Floats:
        """Return the orthonormal cosine transform without the mean, shape (m − 1,)."""
        return np.asarray(dct(self.logs, norm="ortho")[1:])

    def variance(self, deviation: float, correlation_blocks: float) -> Floats:
        """Return the variance of ln σ² in each coefficient of the transform, shape (m − 1,)."""
        decay = np.exp(-1.0 / correlation_blocks)
        angle = np.pi * np.arange(1, self.logs.size) / self.logs.size
        return np.asarray(deviation**2 * (1.0 - decay**2) / (1.0 - 2.0 * decay * np.cos(angle) + decay**2))


@dataclass(frozen=True, slots=True)
class FittedWanderingVariance:
    """Gauss–Markov model of ln σ²."""

    _blocks: _LogVariances
    gain: float  # log-likelihood gain over a constant variance, nats
    gain_over_heavy_tails: float  # log-likelihood gain over independent logarithms with a larger variance, nats
    deviation: ValueWithInterval  # standard deviation of ln σ²
    correlation_time: ValueWithInterval  # s
    misfit_z: float  # excess kurtosis of the innovations, in standard errors

    def regression_gain(self, columns: Callable[[Floats], Floats]) -> float:
        """Return the log-likelihood gain of a regression of ln σ² over a constant variance, in nats.

        The gain is comparable with ``gain``, because both belong to the logarithms of the mean squares.

        Parameters
        ----------
        columns : callable
            Function that returns the regressors, shape (q, m), for the sample indices of the block centres, shape (m,).
        """
        x = columns(self._blocks.centres)
        x = x - x.mean(axis=1, keepdims=True)
        logs = self._blocks.logs - self._blocks.logs.mean()
        fitted = np.linalg.lstsq(x.T, logs, rcond=None)[0] @ x
        return 0.5 * float(fitted @ fitted) / self._blocks.error_variance


def fit_wandering_variance(residuals: Floats, tau0_s: float) -> FittedWanderingVariance | None:
    """Fit a random variation of the variance to white residuals.

    Parameters
    ----------
    residuals : ndarray of float64, shape (n,)
        White residuals without missing samples.
    tau0_s : float
        Sample period in seconds.

    Returns
    -------
    FittedWanderingVariance or None
        None if the residuals are too short.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> walk = np.repeat(np.convolve(rng.standard_normal(700), np.full(100, 0.05), "valid"), 100)
    >>> found = fit_wandering_variance(np.exp(0.5 * walk) * rng.standard_normal(walk.size), 0.01)
    >>> found.gain > 100.0, 0.3 < found.deviation.value < 0.8
    (True, True)
    """
    blocks = _log_variances(residuals)
    if blocks is None:
        return None
    power = blocks.transform() ** 2

    def log_likelihood(deviation: float, correlation_blocks: float) -> float:
        total = blocks.variance(deviation, correlation_blocks) + blocks.error_variance
        return -0.5 * float((np.log(total) + power / total).sum())

    longest = max(MAX_CORRELATION_FRACTION * blocks.logs.size, 2.0 * MIN_CORRELATION_BLOCKS)
    times = np.geomspace(MIN_CORRELATION_BLOCKS, longest, CORRELATION_TIMES)
    start = max(((float(s), float(t)) for s in DEVIATIONS for t in times), key=lambda one: log_likelihood(*one))
    deviation, time = _refine(log_likelihood, start, (MIN_CORRELATION_BLOCKS, longest))
    gain = log_likelihood(deviation, time) - log_likelihood(0.0, time)
    errors = _relative_errors(blocks, deviation, time)
    block_s = blocks.block_samples * tau0_s
    return FittedWanderingVariance(
        blocks,
        max(gain, 0.0),
        max(gain - _heavy_tails_gain(power / blocks.error_variance), 0.0),
        _with_interval(deviation, errors[0]),
        _with_interval(time * block_s, errors[1]),
        _innovation_misfit_z(blocks, deviation, time),
    )


def estimate_wandering_std(residuals: Floats, tau0_s: float, deviation: float, correlation_time_s: float) -> Floats:
    """Estimate the relative standard deviation of white residuals over time.

    The estimate of ln σ² is the posterior mean (Wiener filter) of the Gauss–Markov model.

    Parameters
    ----------
    residuals : ndarray of float64, shape (n,)
        White residuals without missing samples.
    tau0_s : float
        Sample period in seconds.
    deviation : float
        Standard deviation of ln σ².
    correlation_time_s : float
        Correlation time of ln σ² in seconds.

    Returns
    -------
    ndarray of float64, shape (n,)
        Standard deviation over time. The residuals divided by it have the same mean square as before.
    """
    blocks = _log_variances(residuals)
    if blocks is None:
        return np.ones(residuals.size)
    variance = blocks.variance(deviation, correlation_time_s / (blocks.block_samples * tau0_s))
    coefficients = blocks.transform() * variance / (variance + blocks.error_variance)
    logs = idct(np.concatenate([[0.0], coefficients]), norm="ortho")
    std = np.exp(0.5 * np.interp(np.arange(residuals.size), blocks.centres, logs))
    return np.asarray(std * np.sqrt(np.mean((residuals / std) ** 2) / np.mean(residuals**2)))


def _log_variances(residuals: Floats) -> _LogVariances | None:
    count = count_variance_blocks(residuals.size)
    if count < MIN_VARIANCE_BLOCKS:
        return None
    length = residuals.size // count
    squares = residuals[: count * length].reshape(count, length)
    energy = np.maximum(np.einsum("ij,ij->i", squares, squares) / length, 1e-300)
    bias = float(psi(0.5 * length)) - float(np.log(0.5 * length))
    return _LogVariances(np.log(energy) - bias, float(polygamma(1, 0.5 * length)), length)


def _refine(
    log_likelihood: Callable[[float, float], float], start: tuple[float, float], time_range: tuple[float, float]
) -> tuple[float, float]:
    """Return the most likely deviation and correlation time near the best values of the first search."""
    from scipy.optimize import minimize

    lo, hi = np.log([[DEVIATIONS[0], time_range[0]], [DEVIATIONS[-1], time_range[1]]])
    found = minimize(
        lambda x: -log_likelihood(*np.exp(x)),
        np.log(start),
        method="Nelder-Mead",
        bounds=list(zip(lo, hi, strict=True)),
    )
    deviation, time = np.exp(found.x)
    return float(deviation), float(time)


def _heavy_tails_gain(relative_power: Floats) -> float:
    """Return the gain from fitting the variance of independent logarithms. Heavy tails increase this variance."""
    ratio = float(relative_power.mean())
    return 0.5 * relative_power.size * (ratio - 1.0 - float(np.log(ratio))) if ratio > 1.0 else 0.0


def _innovation_misfit_z(blocks: _LogVariances, deviation: float, time: float) -> float:
    """Return the excess kurtosis of the innovations of a Kalman filter, in standard errors.

    The logarithm of a χ² variable has some excess kurtosis itself, which is subtracted.
    """
    decay, error = float(np.exp(-1.0 / time)), blocks.error_variance
    state, variance = 0.0, deviation**2
    innovations = []
    for log in (blocks.logs - blocks.logs.mean()).tolist():
        total = variance + error
        innovations.append((log - state) / total**0.5)
        state = decay * (state + variance / total * (log - state))
        variance = decay**2 * variance * error / total + (1.0 - decay**2) * deviation**2
    squares = np.square(innovations)
    k = 0.5 * blocks.block_samples
    expected = float(polygamma(3, k)) / float(polygamma(1, k)) ** 2 * (error / (variance + error)) ** 2
    kurtosis = float(np.mean(squares**2) / np.mean(squares) ** 2) - 3.0
    return (kurtosis - expected) / float(np.sqrt(24.0 / squares.size))


def _relative_errors(blocks: _LogVariances, deviation: float, time: float) -> Floats:
    """Return the standard errors, shape (2,), of the logarithms of both parameters from the Fisher information."""

    def log_variance(s: float, t: float) -> Floats:
        return np.asarray(np.log(blocks.variance(s, t) + blocks.error_variance))

    up = float(np.exp(DIFFERENCE_STEP))
    slopes = np.stack(
        [
            log_variance(deviation * up, time) - log_variance(deviation / up, time),
            log_variance(deviation, time * up) - log_variance(deviation, time / up),
        ]
    ) / (2.0 * DIFFERENCE_STEP)
    return np.asarray(np.sqrt(np.diag(np.linalg.pinv(0.5 * slopes @ slopes.T))))


def _with_interval(value: float, relative_error: float) -> ValueWithInterval:
    factor = float(np.exp(min(Z95 * relative_error, 20.0)))
    return ValueWithInterval(value, value / factor, value * factor)
