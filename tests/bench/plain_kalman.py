"""A Kalman filter of a drift and a rate as one writes it in NumPy: one step a sample and axis, four states."""

import numpy as np

from drivers.sample import Floats


def plain_kalman(z: Floats, step_s: float) -> Floats:
    """Rates [n, k] without drift: ARMA(2, 1) by Green's function and the current model, both on one measured rate."""
    phi1, phi2, theta, variance, white, motion = 1.6, -0.61, -0.8, 1e-10, 1e-6, 1e-2
    a = np.zeros((4, 4))
    a[:2, :2] = [[0.0, 1.0], [phi2, phi1]]
    a[2:, 2:] = [[1.0, step_s], [0.0, 1.0]]
    b = np.array([1.0, phi1 + theta])
    q = np.zeros((4, 4))
    q[:2, :2] = variance * np.outer(b, b)
    q[2:, 2:] = motion * np.array([[step_s**3 / 3.0, step_s**2 / 2.0], [step_s**2 / 2.0, step_s]])
    h = np.array([[1.0, 0.0, 1.0, 0.0]])
    out = np.empty_like(z)
    for axis in range(z.shape[1]):
        x, p = np.zeros((4, 1)), np.eye(4)
        for k in range(z.shape[0]):
            x, p = a @ x, a @ p @ a.T + q
            s = h @ p @ h.T + white
            gain = p @ h.T / s
            x = x + gain * (z[k, axis] - h @ x)
            p = (np.eye(4) - gain @ h) @ p
            out[k, axis] = x[2, 0]
    return out
