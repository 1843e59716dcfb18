"""Processes whose correlation decays by one factor a sample, real or turning: what three effects have in common.

Autocovariance σ² Re φ^|n| with φ = exp(−(1/T_c − iω) τ0). Real φ is first-order Gauss–Markov noise, and a random
telegraph has the same second moments; a turning φ is a resonance. Allan variance and spectrum are closed forms, exact
for the samples. Near φ = 1 the closed form of σ² cancels to nothing in double precision, and its series takes over.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Floats

NEAR_ZERO: Final = 1e-3
"""|τ(1/T_c − iω)| below which the series stands: there it is true to 2.5·10⁻⁴ of σ², the closed form to 10⁻⁷."""


def avar(sigma: float, decay: complex, tau_s: Floats, tau0_s: float) -> Floats:
    """σ² Re{[n(1 − φ²) − φ(1 − q)(3 − q)] / (n²(1 − φ)²)}, q = φⁿ, n = τ/τ0; ``decay`` = 1/T_c − iω, 1/s.

    Zhang, "Allan variance of time series models for measurement data", Metrologia 45 (2008) 549, rearranged.

    >>> tau = np.array([1.89])
    >>> print(f"{avar(0.5**0.5, 1.0, tau, 1e-4)[0] ** 0.5:.3f}")  # peak of the deviation: 0.437 q √T_c
    0.437
    """
    n = np.asarray(tau_s, np.float64) / tau0_s
    x = np.asarray(n * (decay * tau0_s), np.complex128)
    near = np.abs(x) < NEAR_ZERO
    found = np.where(near, _series(n, x), _closed(np.where(near, 1.0, n), decay * tau0_s))
    return np.asarray(sigma**2 * found)


def _closed(n: Floats, step: complex) -> Floats:
    phi, d, u = np.exp(-step), -np.expm1(-step), -np.expm1(-n * step)
    return np.asarray(np.real((n * d * (1.0 + phi) - phi * u * (2.0 + u)) / (n * d) ** 2))


def _series(n: Floats, x: NDArray[np.complex128]) -> Floats:
    # a correlation that falls as k is that of random walk, as k² that of a slope of random size
    return np.asarray(np.real(2.0 / 3.0 * x * (1.0 + 0.5 / n**2) - 0.5 * x**2 + 7.0 / 30.0 * x**3))


def psd(sigma: float, decay: complex, f_hz: Floats, tau0_s: float) -> Floats:
    """σ²τ0 Re{(1 − φ²)/(1 − 2φ cos 2πfτ0 + φ²)}, two-sided."""
    phi, d = np.exp(-decay * tau0_s), -np.expm1(-decay * tau0_s)
    # 1 − 2φ cos θ + φ² = (1 − φ)² + 4φ sin²(θ/2), which does not cancel
    below = d**2 + 4.0 * phi * np.sin(np.pi * f_hz * tau0_s) ** 2
    return np.asarray(sigma**2 * tau0_s * np.real(d * (1.0 + phi) / below))
