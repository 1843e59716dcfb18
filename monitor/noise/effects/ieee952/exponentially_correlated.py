"""Exponentially correlated noise (first-order Gauss–Markov process)."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from drivers.data_types import Floats
from monitor.common.compiled import compiled
from monitor.noise.effect import RunningSource, SampleBlockContext, Source, parameter_field
from monitor.noise.gauss_markov_avar_and_spectrum import gauss_markov_spectrum
from monitor.noise.spectrum import Spectrum


@dataclass(frozen=True, slots=True)
class ExponentiallyCorrelated(Source):
    """Sampled Markov noise (IEEE Std 952 annex C) with the autocovariance σ²φ^|n| and φ = exp(−τ0/T_c).

    With n = τ/τ0, the Allan variance and the power spectral density are:

        σ²(τ) = σ²(1 − φ²)[n − 3φ − nφ² + 4φ^(n+1) − φ^(2n+1)] / [n²(1 − φ)²(1 − φ²)]
        S(f) = σ²τ0(1 − φ²)/(1 − 2φ cos 2πfτ0 + φ²)

    >>> noise = ExponentiallyCorrelated(sigma=1.0, correlation_time=10.0)
    >>> print(f"{noise.avar(np.array([18.9]), 1e-3)[0]:.3f}")
    0.381
    """

    sigma: float = parameter_field("rad/s", "m/s²")
    correlation_time: float = parameter_field("s", positive=True)

    description: ClassVar[str] = "The bias fluctuates about zero with an exponential autocorrelation."

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return the spectrum and the Allan variance in closed form."""
        return gauss_markov_spectrum(self.sigma, 1.0 / self.correlation_time, tau0_s)

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Initialize a stationary series given by the recursion x ← φx + σ√(1 − φ²) w with white noise w."""
        step = 1.0 / (self.correlation_time * rate_hz)
        phi, drive = float(np.exp(-step)), self.sigma * float(np.sqrt(-np.expm1(-2.0 * step)))
        state = self.sigma * float(rng.standard_normal())

        def add_correlated_noise(values: Floats, block: SampleBlockContext) -> None:
            nonlocal state
            state = add_recursion(values, rng.standard_normal(out=block.scratch), phi, drive, state)

        return RunningSource(add_correlated_noise)


@compiled
def add_recursion(values: Floats, inputs: Floats, phi: float, drive: float, state: float) -> float:
    """Add the states of the recursion x ← φx + drive·input to values, and return the next state.

    Parameters
    ----------
    values, inputs : ndarray, shape (n,)
        Values to which the states are added in place, and inputs of the recursion.
    phi, drive : float
        Coefficients of the recursion.
    state : float
        State that is added to the first value.
    """
    for k in range(values.size):
        values[k] += state
        state = phi * state + drive * inputs[k]
    return state
