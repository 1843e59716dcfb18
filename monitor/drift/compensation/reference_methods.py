"""Published methods that remove drift and noise from a complete recording, used for comparison.

All methods learn from given samples at rest and do not detect motion. The methods ``emd`` and ``wavelet`` need future
samples. The method ``ar`` assumes that the whole recording has the spectrum of the noise at rest.
"""

from collections.abc import Callable
from typing import Final

import numpy as np

from drivers.data_types import Floats
from drivers.errors import ConfigError, NotReady
from drivers.host.extras import install_command
from monitor.common.compiled import compiled
from monitor.common.distributions import NORMAL_QUARTILE

MAX_ORDER: Final = 8
"""Highest order of an autoregressive model."""
MIN_REST_SAMPLES: Final = 100
PIECE, OVERLAP = 16_384, 4_096
"""Number of samples in a segment, and in the overlap of two segments.

The empirical mode decomposition of a long signal would need too much memory.
"""
MAX_NOISE_LAG: Final = 2
"""Maximum lag in samples at which the autocorrelation of a noise mode falls below 1/e."""
WAVELET: Final = "db4"
MAX_DOUBLINGS: Final = 60
MAX_LEVELS: Final = 8
MISSING_PACKAGES: Final = f"EMD-signal and PyWavelets are not installed: {install_command('imu-monitor[denoise]')}"

ReferenceMethod = Callable[[Floats, Floats], Floats]
"""Function that filters a rate [n], given samples at rest [m]. The mean at rest has been subtracted from both."""


def apply_reference_method(rate: Floats, rest_samples: Floats, method: ReferenceMethod) -> Floats:
    """Remove drift and noise from the rate of a gyro axis with a reference method.

    Parameters
    ----------
    rate : ndarray, shape (n,)
        Rate in rad/s. NaN means missing and remains NaN in the result.
    rest_samples : ndarray, shape (m,)
        Rate at rest in rad/s, in chronological order.
    method : callable
        One of the methods in REFERENCE_METHODS.

    Returns
    -------
    ndarray, shape (n,)
        Compensated rate in rad/s.

    Raises
    ------
    NotReady
        If there are too few samples at rest to learn from.
    """
    rest = rest_samples[np.isfinite(rest_samples)]
    if rest.size < MIN_REST_SAMPLES:
        raise NotReady(f"{rest.size} samples at rest; at least {MIN_REST_SAMPLES} are needed for learning")
    mean = float(rest.mean())
    there = np.isfinite(rate)
    whole = np.interp(np.arange(rate.size), np.flatnonzero(there), rate[there]) - mean
    out = method(whole, rest - mean)
    return np.where(there, out, np.nan)


def _autoregressive_filter(x: Floats, learned: Floats) -> Floats:
    """Apply a Kalman filter with an autoregressive model whose order minimises the BIC."""
    return _kalman_filtered(x, *_autoregression(learned), float(learned.var()))


def _filter_emd_modes(x: Floats, _learned: Floats) -> Floats:
    """Decompose a signal into empirical modes (Huang et al. 1998), and filter the modes that consist of noise."""
    return _process_pieces(x, _filter_noise_modes)


def _shrink_wavelets(x: Floats, learned: Floats) -> Floats:
    """Apply soft thresholding with the universal threshold to the wavelet coefficients (Donoho & Johnstone 1994)."""
    try:
        import pywt
    except ImportError as error:
        raise ConfigError(MISSING_PACKAGES) from error
    depth = min(MAX_LEVELS, pywt.dwt_max_level(min(x.size, learned.size), WAVELET))
    parts = pywt.wavedec(x, WAVELET, level=depth)
    quiet = pywt.wavedec(learned, WAVELET, level=depth)
    for at in range(1, depth + 1):
        sigma = float(np.median(np.abs(quiet[at]))) / NORMAL_QUARTILE
        parts[at] = pywt.threshold(parts[at], sigma * (2.0 * np.log(x.size)) ** 0.5, "soft")
    return np.asarray(pywt.waverec(parts, WAVELET)[: x.size])


def _autoregression(x: Floats) -> tuple[Floats, float]:
    """Fit an autoregressive model, and return its coefficients and innovation variance."""
    n = x.size
    most = min(MAX_ORDER, n // 10)
    covariance = np.array([float(x[: n - k] @ x[k:]) / n for k in range(most + 1)])
    best = (np.inf, np.zeros(1), float(covariance[0]))
    for p in range(1, most + 1):
        lag = np.abs(np.subtract.outer(np.arange(p), np.arange(p)))
        phi = np.linalg.solve(covariance[lag], covariance[1 : p + 1])
        left = max(float(covariance[0] - phi @ covariance[1 : p + 1]), 1e-300)
        best = min(best, (n * np.log(left) + p * np.log(n), phi, left), key=lambda one: one[0])
    return best[1], best[2]


def _kalman_filtered(x: Floats, phi: Floats, new: float, measuring: float) -> Floats:
    """Estimate an autoregressive process with white measurement noise by a steady-state Kalman filter."""
    p = phi.size
    step = np.zeros((p, p))
    step[0], step[1:, :-1] = phi, np.eye(p - 1)
    unit = max(measuring, 1e-300)
    before = _steady_covariance(step, new / unit)
    return np.asarray(_run_filter(x, phi, before[:, 0] / (before[0, 0] + 1.0)))


def _steady_covariance(step: Floats, new: float) -> Floats:
    """Return the steady-state covariance matrix of a Kalman prediction.

    The function uses the structure-preserving doubling algorithm, which converges quadratically (Chu, Fan, Lin & Wang,
    Int. J. Control 77, 2004). The transition matrix ``step`` has the shape (p, p). In each time step, ``new`` is added
    to the variance of the first state, and the first state is measured with unit variance.
    """
    p = step.shape[0]
    a, g, h = step.T.copy(), np.zeros((p, p)), np.zeros((p, p))
    g[0, 0], h[0, 0] = 1.0, new
    for _ in range(MAX_DOUBLINGS):
        inner = np.linalg.solve(np.eye(p) + g @ h, np.hstack([a, g]))
        more = a.T @ h @ inner[:, :p]
        g = g + a @ inner[:, p:] @ a.T
        a = a @ inner[:, :p]
        h = h + more
        if np.abs(more).max() <= np.finfo(float).eps * np.abs(h).max():
            break
    return h


@compiled
def _run_filter(x: Floats, phi: Floats, gain: Floats) -> Floats:
    """Apply a Kalman filter with a constant gain [p] to the values x [n]."""
    p = phi.size
    state, out = np.zeros(p), np.empty(x.size)
    for k in range(x.size):
        ahead = 0.0
        for i in range(p):
            ahead += phi[i] * state[i]
        for i in range(p - 1, 0, -1):
            state[i] = state[i - 1]
        state[0] = ahead
        new = x[k] - ahead
        for i in range(p):
            state[i] += gain[i] * new
        out[k] = state[0]
    return out


def _filter_noise_modes(x: Floats) -> Floats:
    """Decompose x [n] into empirical modes, filter the modes that are noise, and return the sum of all modes."""
    try:
        from PyEMD import EMD
    except ImportError as error:
        raise ConfigError(MISSING_PACKAGES) from error
    out = np.zeros(x.size)
    for mode in EMD().emd(x):
        if _is_noise(mode):
            out += _kalman_filtered(mode, *_autoregression(mode), float(mode.var()))
        else:
            out += mode
    return out


def _is_noise(mode: Floats) -> bool:
    """Return True if the autocorrelation of an empirical mode falls below 1/e within MAX_NOISE_LAG samples."""
    centred = mode - mode.mean()
    power = float(centred @ centred)
    if not power > 0.0:
        return False
    lags = range(1, MAX_NOISE_LAG + 1)
    return any(float(centred[:-k] @ centred[k:]) < power / np.e for k in lags if k < mode.size)


def _process_pieces(x: Floats, work: Callable[[Floats], Floats]) -> Floats:
    """Process overlapping segments of x [n], and cross-fade the results."""
    out = np.zeros(x.size)
    rise = (np.arange(OVERLAP) + 0.5) / OVERLAP
    start, end = 0, 0
    while end < x.size:
        end = start + PIECE
        if x.size - end < PIECE // 2:
            end = x.size
        piece = work(x[start:end])
        if start:
            piece[:OVERLAP] *= rise
        if end < x.size:
            piece[-OVERLAP:] *= rise[::-1]
        out[start:end] += piece
        start = end - OVERLAP
    return out


REFERENCE_METHODS: Final[dict[str, ReferenceMethod]] = {
    "ar": _autoregressive_filter,
    "emd": _filter_emd_modes,
    "wavelet": _shrink_wavelets,
}
