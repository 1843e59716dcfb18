"""Kalman filter of a drift and a rate in NumPy, with one step per sample and matrices of four states.

The drift is an ARMA(2, 1) process in the form of Green's function. The rate is the "current" model with the one-step
prediction as its mean and a constant intensity. ``filter_drift_and_rate`` is plain NumPy, and its time is measured.
``compiled_filter`` is the same function compiled by Numba, and its errors are measured.
"""

from collections.abc import Callable
from typing import Any, cast

import numba
import numpy as np

from drivers.data_types import Floats


def filter_drift_and_rate(
    z: Floats, step_s: float, phi1: float, phi2: float, theta: float, variance: float, white: float, intensity: float
) -> Floats:
    """Return rates [n] without drift.

    Parameters
    ----------
    z : ndarray, shape (n,)
        Measured rate in rad/s, less its mean at rest.
    step_s : float
        Sample period in seconds.
    phi1, phi2, theta, variance : float
        Parameters of the drift.
    white : float
        Variance of z at rest.
    intensity : float
        Intensity of the white noise in ω̈, in (rad/s³)²/Hz.
    """
    x, p, f, q = np.zeros(4), np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4))
    f[0, 1], f[1, 0], f[1, 1] = 1.0, phi2, phi1
    f[2, 2], f[2, 3], f[3, 3] = 1.0, step_s, 1.0
    green = phi1 + theta
    q[0, 0], q[0, 1], q[1, 0], q[1, 1] = variance, green * variance, green * variance, green**2 * variance
    q[2, 2] = intensity * step_s**3 / 3.0
    q[2, 3] = q[3, 2] = intensity * step_s**2 / 2.0
    q[3, 3] = intensity * step_s
    h = np.array([1.0, 0.0, 1.0, 0.0])
    out = np.empty(z.size)
    for k in range(z.size):
        x = f @ x
        p = f @ p @ f.T + q
        s = h @ p @ h + white
        gain = p @ h / s
        x = x + gain * (z[k] - h @ x)
        p = p - np.outer(gain, h @ p)
        out[k] = x[2]
    return out


compiled_filter = cast("Callable[..., Floats]", cast("Any", numba).njit(filter_drift_and_rate))
