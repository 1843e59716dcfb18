"""Allan variance and spectrum of first-order Gauss–Markov noise, random telegraph noise and resonances.

The autocovariance is σ² Re φ^|n| with φ = exp(−(1/T_c − iω) τ0). A real φ describes Gauss–Markov noise, and a complex φ
describes a resonance. The closed forms are exact for sampled noise. Near φ = 1, the closed form of the Allan variance
would lose digits by cancellation and is replaced by a power series.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats
from monitor.noise.spectrum import Spectrum

MAX_SERIES_ARGUMENT: Final = 1e-3
"""Maximum value of |τ(1/T_c − iω)| for which the power series is used.

At this value, the relative error of the Allan variance is 2.5·10⁻⁴ with the power series and 10⁻⁷ with the closed form.
"""


def gauss_markov_spectrum(sigma: float, decay_rate: complex, tau0_s: float) -> Spectrum:
    """Return the spectrum of noise whose autocorrelation decays exponentially.

    Parameters
    ----------
    sigma : float
        Standard deviation of the noise.
    decay_rate : complex
        Complex decay rate 1/T_c − iω in 1/s.
    tau0_s : float
        Sample interval, s.

    Examples
    --------
    >>> tau = np.array([1.89])
    >>> print(f"{gauss_markov_spectrum(0.5**0.5, 1.0, 1e-4).avar(tau)[0] ** 0.5:.3f}")  # peak: 0.437 q √T_c
    0.437
    """
    return Spectrum(
        lambda f: _psd(sigma, decay_rate, f, tau0_s), lambda tau: _avar(sigma, decay_rate, tau, tau0_s), tau0_s
    )


def _avar(sigma: float, decay: complex, tau_s: Floats, tau0_s: float) -> Floats:
    """Return the Allan variance σ² Re{[n(1 − φ²) − φ(1 − q)(3 − q)] / (n²(1 − φ)²)} with q = φⁿ and n = τ/τ0.

    The formula is a rearranged form of the formula by Zhang, Metrologia 45 (2008) 549.
    """
    n = np.asarray(tau_s, np.float64) / tau0_s
    x = np.asarray(n * (decay * tau0_s), np.complex128)
    near = np.abs(x) < MAX_SERIES_ARGUMENT
    found = np.where(near, _series(n, x), _closed(np.where(near, 1.0, n), decay * tau0_s))
    return np.asarray(sigma**2 * found)


def _closed(n: Floats, step: complex) -> Floats:
    phi, d, u = np.exp(-step), -np.expm1(-step), -np.expm1(-n * step)
    return np.asarray(np.real((n * d * (1.0 + phi) - phi * u * (2.0 + u)) / (n * d) ** 2))


def _series(n: Floats, x: NDArray[np.complex128]) -> Floats:
    """Return the Allan variance for σ = 1 as a power series in 1 − φ."""
    return np.asarray(np.real(2.0 / 3.0 * x * (1.0 + 0.5 / n**2) - 0.5 * x**2 + 7.0 / 30.0 * x**3))


def _psd(sigma: float, decay: complex, f_hz: Floats, tau0_s: float) -> Floats:
    """Return the two-sided power spectral density σ²τ0 Re{(1 − φ²)/(1 − 2φ cos 2πfτ0 + φ²)}."""
    phi, d = np.exp(-decay * tau0_s), -np.expm1(-decay * tau0_s)
    # The form 1 − 2φ cos θ + φ² = (1 − φ)² + 4φ sin²(θ/2) avoids cancellation.
    below = d**2 + 4.0 * phi * np.sin(np.pi * f_hz * tau0_s) ** 2
    return np.asarray(sigma**2 * tau0_s * np.real(d * (1.0 + phi) / below))
