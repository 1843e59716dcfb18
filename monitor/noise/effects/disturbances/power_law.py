"""Power-law noise with any exponent.

The simulated series is white noise w after the fractional integration (1 − B)^(−d) with d = α/2, where B is the delay
of one sample (Hosking, "Fractional differencing", 1981). Whole integrations are cumulative sums. For 0 < d < 1, the
beta function gives the impulse response as a mixture of exponentials,

    ψ_k = sin(πd)/π ∫ x^(k+d−1) (1 − x)^(−d) dx   from 0 to 1.

With x = 1/(1 + eˢ), the trapezoidal rule in s approximates ψ_k as Σ w_j x_jᵏ within 0.5 %, up to k = 10⁷.
"""

from dataclasses import dataclass
from math import floor, pi, sin
from typing import ClassVar, Final

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import RunningSource, SampleBlockContext, Source, parameter_field
from monitor.noise.effects.ieee952.bias_instability import add_filtered_noise
from monitor.noise.spectrum import Spectrum, allan_variance_of_density

MAX_EXPONENT: Final = 2.9
"""Largest exponent. The Allan variance is infinite for an exponent of 3."""
LOG_ODDS: Final = np.arange(-23.0, 11.0)
"""Nodes s of the trapezoidal rule, with a spacing of 1."""


@dataclass(frozen=True, slots=True)
class PowerLaw(Source):
    """Noise with the spectrum S(f) = D² (sin(πfτ0)/(πτ0))^(−α), which is D² f^(−α) far below half the sample rate.

    The exponent α is 0 for angle random walk, 1 for bias instability and 2 for rate random walk. The Allan variance is
    an integral over the spectrum.

    >>> flicker = PowerLaw(density=1.0, exponent=1.0)
    >>> print(f"{flicker.avar(np.array([100.0]), 0.01)[0] / (4.0 * np.log(2.0)):.3f}")
    1.000
    """

    density: float = parameter_field("rad/s/√Hz", "m/s²/√Hz")
    exponent: float = parameter_field("1", maximum=MAX_EXPONENT)

    description: ClassVar[str] = "The spectral density of the noise is a power of the frequency."

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return the spectrum, and the Allan variance by numerical integration."""

        def density(f_hz: Floats) -> Floats:
            return self.density**2 * (np.sin(np.pi * f_hz * tau0_s) / (np.pi * tau0_s)) ** -self.exponent

        return Spectrum(density, lambda tau_s: allan_variance_of_density(density, tau_s, tau0_s, ()), tau0_s)

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a stationary series or, for exponents of at least 1, a series that starts at zero.

        The series is y = direct·w + walk·W + Σ weight·s, where w is white noise, W ← W + w, and s ← pole·s + w. For
        exponents of at least 2, the output is the cumulative sum of y.
        """
        d, gain = 0.5 * self.exponent, self.density * (2.0 * np.pi / rate_hz) ** (0.5 * self.exponent) * rate_hz**0.5
        decay, weights, direct, walk = _fractional_filter(gain, d - floor(d))
        overlap = decay[:, None] + decay - decay[:, None] * decay  # 1 − x_i x_j
        variances, vectors = np.linalg.eigh(1.0 / overlap)
        stationary = vectors @ (np.sqrt(np.maximum(variances, 0.0)) * rng.standard_normal(decay.size))
        # the integrator W is a state with the pole 1 that starts at zero
        states, poles, weights = np.append(stationary, 0.0), np.append(1.0 - decay, 1.0), np.append(weights, walk)
        total = 0.0  # cumulative sum of y
        start: float | None = None

        def add_fractional_noise(values: Floats, block: SampleBlockContext) -> None:
            nonlocal start, total
            series = np.zeros(values.size)
            add_filtered_noise(series, rng.standard_normal(out=block.scratch), states, poles, weights, direct)
            if d >= 1.0:
                series[0] += total  # the sum does not depend on the division into blocks
                np.cumsum(series, out=series)
                total = float(series[-1])
            if start is None:
                start = float(series[0]) if d >= 0.5 else 0.0
            values += series
            values -= start

        return RunningSource(add_fractional_noise)


def _fractional_filter(gain: float, d: float) -> tuple[Floats, Floats, float, float]:
    """Return 1 − pole, weight, direct and walk of the filter gain·(1 − 1/z)^(−d) for 0 ≤ d < 1."""
    scale = sin(pi * d) / pi
    decay = 1.0 / (1.0 + np.exp(-LOG_ODDS))  # 1 − x
    weights = scale * (1.0 - decay) ** d * decay ** (1.0 - d)
    # poles below the smallest node act as one integrator
    walk = float(scale * (decay[0] * np.exp(-0.5)) ** (1.0 - d) / (1.0 - d)) if d >= 0.5 else 0.0
    return decay, gain * weights, gain * (1.0 - float(weights.sum()) - walk), gain * walk  # ψ_0 = 1
