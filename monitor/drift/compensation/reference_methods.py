"""What others take drift and noise out of a finished recording with, on one interface: for comparison.

All three learn from samples at rest and then treat the recording as one signal; none knows of motion. They need the
future (``emd``, ``wavelet``), or a signal that looks like the noise at rest (``ar``).
"""

from collections.abc import Callable
from typing import Final

import numpy as np

from drivers.errors import ConfigError, NotReady
from drivers.sample import Floats
from monitor.common.compiled import compiled

HIGHEST: Final = 8
"""Order of an autoregression."""
LEAST: Final = 100
"""Samples at rest to learn from."""
PIECE, OVERLAP = 16_384, 4_096
"""Samples of one decomposition into modes, and of the cross-fade to the next: its memory grows with its length."""
AT_ONCE: Final = 2
"""Lag by which the autocorrelation of a noise mode has fallen below 1/e."""
WAVELET: Final = "db4"
MOST_DOUBLINGS: Final = 60
DEEPEST: Final = 8
"""Levels of a wavelet decomposition."""
SIGMA_OF_MAD: Final = 0.6745
MISSING: Final = 'EMD-signal and PyWavelets are not installed: pip install "imu-monitor[denoise]"'

Variant = Callable[[Floats, Floats], Floats]
"""A rate [n] less the mean at rest, and samples at rest [m] to learn from, less the same: the rate without noise."""


def compensated(x: Floats, learned: Floats, variant: Variant) -> Floats:
    """A rate [n] of one axis by a variant; NaN = missing, and stays so.

    Args:
        learned: [m] rate at rest, in order
    Raises:
        NotReady: too few samples at rest
    """
    rest = learned[np.isfinite(learned)]
    if rest.size < LEAST:
        raise NotReady(f"{rest.size} samples at rest; {LEAST} are needed to learn from")
    mean = float(rest.mean())
    there = np.isfinite(x)
    whole = np.interp(np.arange(x.size), np.flatnonzero(there), x[there]) - mean
    out = variant(whole, rest - mean)
    return np.where(there, out, np.nan)


def ar(x: Floats, learned: Floats) -> Floats:
    """Autoregression (Yule–Walker), order by BIC; Kalman filter with the variance at rest as measuring noise."""
    return _filtered(x, *_autoregression(learned), float(learned.var()))


def emd(x: Floats, learned: Floats) -> Floats:
    """Empirical modes (Huang et al. 1998); those whose autocorrelation drops at once are filtered as in ``ar``."""
    return _in_pieces(x, _modes_filtered)


def wavelet(x: Floats, learned: Floats) -> Floats:
    """Soft shrinkage by the universal threshold (Donoho & Johnstone 1994), noise told level by level from rest."""
    try:
        import pywt
    except ImportError as error:
        raise ConfigError(MISSING) from error
    depth = min(DEEPEST, pywt.dwt_max_level(min(x.size, learned.size), WAVELET))
    parts = pywt.wavedec(x, WAVELET, level=depth)
    quiet = pywt.wavedec(learned, WAVELET, level=depth)
    for at in range(1, depth + 1):
        sigma = float(np.median(np.abs(quiet[at]))) / SIGMA_OF_MAD
        parts[at] = pywt.threshold(parts[at], sigma * (2.0 * np.log(x.size)) ** 0.5, "soft")
    return np.asarray(pywt.waverec(parts, WAVELET)[: x.size])


def _autoregression(x: Floats) -> tuple[Floats, float]:
    """Coefficients [p ≥ 1] and the variance of what is new."""
    n = x.size
    most = min(HIGHEST, n // 10)
    covariance = np.array([float(x[: n - k] @ x[k:]) / n for k in range(most + 1)])
    best = (np.inf, np.zeros(1), float(covariance[0]))
    for p in range(1, most + 1):
        lag = np.abs(np.subtract.outer(np.arange(p), np.arange(p)))
        phi = np.linalg.solve(covariance[lag], covariance[1 : p + 1])
        left = max(float(covariance[0] - phi @ covariance[1 : p + 1]), 1e-300)
        best = min(best, (n * np.log(left) + p * np.log(n), phi, left), key=lambda one: one[0])
    return best[1], best[2]


def _filtered(x: Floats, phi: Floats, new: float, measuring: float) -> Floats:
    """The steady Kalman filter of z = autoregression + white noise."""
    p = phi.size
    step = np.zeros((p, p))
    step[0], step[1:, :-1] = phi, np.eye(p - 1)
    unit = max(measuring, 1e-300)
    before = _steady_covariance(step, new / unit)
    return np.asarray(_run(x, phi, before[:, 0] / (before[0, 0] + 1.0)))


def _steady_covariance(step: Floats, new: float) -> Floats:
    """Return the steady covariance of a Kalman filter's prediction.

    The state's step [p, p] is given, ``new`` is the variance that its first element gains, and the first element is
    measured with a variance of one. The structure-preserving doubling algorithm (Chu, Fan, Lin & Wang, Int. J. Control
    77, 2004) converges quadratically.
    """
    p = step.shape[0]
    a, g, h = step.T.copy(), np.zeros((p, p)), np.zeros((p, p))
    g[0, 0], h[0, 0] = 1.0, new
    for _ in range(MOST_DOUBLINGS):
        inner = np.linalg.solve(np.eye(p) + g @ h, np.hstack([a, g]))
        more = a.T @ h @ inner[:, :p]
        g = g + a @ inner[:, p:] @ a.T
        a = a @ inner[:, :p]
        h = h + more
        if np.abs(more).max() <= np.finfo(float).eps * np.abs(h).max():
            break
    return h


@compiled
def _run(x, phi, gain):  # type: ignore[no-untyped-def]
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


def _modes_filtered(x: Floats) -> Floats:
    try:
        from PyEMD import EMD
    except ImportError as error:
        raise ConfigError(MISSING) from error
    out = np.zeros(x.size)
    for mode in EMD().emd(x):
        if _drops_at_once(mode):
            out += _filtered(mode, *_autoregression(mode), float(mode.var()))
        else:
            out += mode
    return out


def _drops_at_once(mode: Floats) -> bool:
    centred = mode - mode.mean()
    power = float(centred @ centred)
    if not power > 0.0:
        return False
    lags = range(1, AT_ONCE + 1)
    return any(float(centred[:-k] @ centred[k:]) < power / np.e for k in lags if k < mode.size)


def _in_pieces(x: Floats, work: Callable[[Floats], Floats]) -> Floats:
    """Overlapping pieces, worked on one by one and faded into each other."""
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


VARIANTS: Final[dict[str, Variant]] = {"ar": ar, "emd": emd, "wavelet": wavelet}
