"""Bias instability B: 1/f noise of the rate.

The simulated series is white noise after a filter. The power response of the filter is proportional to 1/f within 0.1 %
from 1e-8 to 1/2 of the sample rate. All poles and zeros are real, and were fitted to the logarithm of the spectrum by
least squares. The filter is implemented as a sum of partial fractions and starts in the stationary state.
"""

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.compiled import compiled
from monitor.noise.effect import RunningSource, SampleBlockContext, Source, parameter_field
from monitor.noise.spectrum import Spectrum

# fmt: off
ONE_MINUS_POLE: Final = np.array([
    3.41648e-08, 1.4606e-07, 4.54863e-07, 1.40524e-06, 4.37611e-06, 1.36768e-05, 4.2766e-05,
    0.000133576, 0.000416433, 0.00129546, 0.00402026, 0.0124265, 0.0380313, 0.113138, 0.311883,
    0.716393, 1.36526, 1.81536, 1.97297,
])
"""One minus the poles of the filter."""
ONE_MINUS_ZERO: Final = np.array([
    7.8334e-08, 2.59126e-07, 7.98566e-07, 2.47802e-06, 7.7347e-06, 2.41863e-05, 7.55963e-05,
    0.000235912, 0.000734692, 0.00228292, 0.00707306, 0.0217816, 0.0659628, 0.190572, 0.488228,
    0.952686, 1.41715, 1.82092, 1.97315,
])
"""One minus the zeros of the filter."""
# fmt: on
RESPONSE_CONSTANT: Final = 5.436556224293264
"""Constant of the filter. The squared response is 1 / (RESPONSE_CONSTANT · f/fs)."""

FLICKER_AVAR: Final = float(2.0 * np.log(2.0) / np.pi)
"""Allan variance of continuous flicker noise with B = 1 (IEEE Std 952 eq. C.24)."""
MAX_SAMPLED_FACTOR: Final = 128
"""Maximum cluster size for which the Allan variance of the samples is integrated.

For larger clusters, the continuous formula differs by less than 1e-4.
"""

_MIDPOINT_COUNT: Final = 8192


@dataclass(frozen=True, slots=True)
class BiasInstability(Source):
    """1/f noise of the rate, with S(f) = B²/(2πf) and σ²(τ) = (2 ln 2/π) B² (IEEE Std 952 eq. C.22–C.24).

    The Allan deviation is 0.664 B.

    >>> print(f"{BiasInstability(B=1.0).avar(np.array([100.0]), 0.01)[0] ** 0.5:.3f}")
    0.664
    """

    B: float = parameter_field("rad/s", "m/s²")

    description: ClassVar[str] = (
        "The bias fluctuates with 1/f noise, so longer averaging does not reduce the error below a floor."
    )

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return the spectrum B²/(2πf) and the Allan variance (2 ln 2/π) B².

        For small clusters, the Allan variance is integrated over the spectrum up to half the sample rate.
        """

        def avar(tau_s: Floats) -> Floats:
            m = np.atleast_1d(np.asarray(tau_s / tau0_s, np.float64))
            shape = np.full(m.shape, FLICKER_AVAR)
            few = m <= MAX_SAMPLED_FACTOR
            shape[few] = _sampled_allan_variance(m[few])
            return (self.B**2 * shape).reshape(np.shape(tau_s))

        return Spectrum(lambda f: self.B**2 / (2.0 * np.pi * f), avar, tau0_s)

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a stationary series y = direct·w + Σ residue·s, with white noise w and s ← pole·s + w."""
        # The output density gain² / (RESPONSE_CONSTANT f) must equal B²/(2πf).
        gain = self.B * np.sqrt(RESPONSE_CONSTANT / (2.0 * np.pi))
        direct, poles, residues = _partial_fractions(gain)
        overlap = ONE_MINUS_POLE[:, None] + ONE_MINUS_POLE - ONE_MINUS_POLE[:, None] * ONE_MINUS_POLE
        states = np.linalg.cholesky(1.0 / overlap) @ rng.standard_normal(ONE_MINUS_POLE.size)

        def add_flicker_noise(values: Floats, block: SampleBlockContext) -> None:
            add_filtered_noise(values, rng.standard_normal(out=block.scratch), states, poles, residues, direct)

        return RunningSource(add_flicker_noise)


def _sampled_allan_variance(m: Floats) -> Floats:
    """Return the Allan variance of the sampled spectrum 1/(2πf), by the midpoint rule."""
    f = (np.arange(_MIDPOINT_COUNT) + 0.5) * (0.5 / _MIDPOINT_COUNT)
    kernel = np.sin(np.pi * f * m[:, None]) ** 4 / (m[:, None] * np.sin(np.pi * f)) ** 2
    integral: Floats = (kernel / f).sum(1) * (1.0 / (np.pi * _MIDPOINT_COUNT))
    return integral


def _partial_fractions(gain: float) -> tuple[float, Floats, Floats]:
    """Return direct, p and r of the filter gain Π(1 − z_i/z)/Π(1 − p_i/z) = direct + Σ r_i/(1 − p_i/z)."""
    p, z = ONE_MINUS_POLE, ONE_MINUS_ZERO
    others = p[None, :] - p[:, None]
    np.fill_diagonal(others, 1.0)
    residues = np.prod((z[None, :] - p[:, None]) / others, axis=1) / (1.0 - p)
    return gain * float(np.prod((1.0 - z) / (1.0 - p))), 1.0 - p, np.asarray(gain * residues)


@compiled
def add_filtered_noise(
    values: Floats, white: Floats, states: Floats, poles: Floats, residues: Floats, direct: float
) -> None:
    """Add the noise direct·w + Σ residue·s to values, with white noise w and s ← pole·s + w.

    Parameters
    ----------
    values, white : ndarray, shape (n,)
        Values to which the noise is added in place, and white noise.
    states : ndarray, shape (k,)
        States s, updated in place.
    poles, residues : ndarray, shape (k,)
        Pole and weight of each state.
    direct : float
        Weight of the white noise.
    """
    for k in range(values.size):
        value = direct * white[k]
        for i in range(states.size):
            states[i] = poles[i] * states[i] + white[k]
            value += residues[i] * states[i]
        values[k] += value
