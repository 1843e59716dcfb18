"""Bias instability B: 1/f noise of the rate.

The series is white noise through a filter whose squared response is 1/f within 0.1 % from 1e-8 to
1/2 of the sample rate (28 hours of 100 Hz is 1e-7), flat below. Its poles and zeros, real and
alternating, were placed by least squares on the logarithm of the spectrum; the table holds them as
1 − p and 1 − z, because all but a few lie within a millionth of one. The filter runs as the sum of
its partial fractions, all driven by the same white noise: that form starts in its stationary state
exactly, so the first minute of a series is as good as any other.
"""

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.noise.effect import Block, Series, Source, parameter

# fmt: off
ONE_MINUS_POLE: Final = np.array([
    3.41648e-08, 1.4606e-07, 4.54863e-07, 1.40524e-06, 4.37611e-06, 1.36768e-05, 4.2766e-05,
    0.000133576, 0.000416433, 0.00129546, 0.00402026, 0.0124265, 0.0380313, 0.113138, 0.311883,
    0.716393, 1.36526, 1.81536, 1.97297,
])
ONE_MINUS_ZERO: Final = np.array([
    7.8334e-08, 2.59126e-07, 7.98566e-07, 2.47802e-06, 7.7347e-06, 2.41863e-05, 7.55963e-05,
    0.000235912, 0.000734692, 0.00228292, 0.00707306, 0.0217816, 0.0659628, 0.190572, 0.488228,
    0.952686, 1.41715, 1.82092, 1.97315,
])
# fmt: on
RESPONSE: Final = 5.436556224293264
"""In the band the squared response of these poles and zeros is 1 / (RESPONSE · f/fs)."""

SAMPLED_FACTORS: Final = 128
"""Up to this many samples a cluster the sampled form of σ² is integrated; above, it differs by < 1e-4."""

_MIDPOINTS: Final = 8192


@dataclass(frozen=True, slots=True)
class BiasInstability(Source):
    """IEEE Std 952 eq. C.22–C.24: S(f) = B²/(2πf), σ²(τ) = (2 ln 2/π) B², floor 0.664 B.

    >>> print(f"{BiasInstability(B=1.0).avar(np.array([100.0]), 0.01)[0] ** 0.5:.3f}")
    0.664
    """

    B: float = parameter("rad/s", "m/s²")

    name: ClassVar[str] = "bias_instability"
    means: ClassVar[str] = "Slow flicker of the bias: the floor that no averaging gets below."

    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """(2 ln 2/π) B²; over few samples, where the spectrum ends at 1/(2 τ0), that of the samples."""
        m = np.atleast_1d(np.asarray(tau_s / tau0_s, np.float64))
        shape = np.full(m.shape, 2.0 * np.log(2.0) / np.pi)
        few = m <= SAMPLED_FACTORS
        shape[few] = _sampled(m[few])
        return (self.B**2 * shape).reshape(np.shape(tau_s))

    def psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """B²/(2πf)."""
        return self.B**2 / (2.0 * np.pi * f_hz)

    def start(self, rate_hz: float, rng: np.random.Generator) -> "_Flicker":
        """A stationary series."""
        return _Flicker(self.B, rng)


def _sampled(m: Floats) -> Floats:
    """4 ∫ S sin⁴(πfm) / (m² sin²(πf)) df up to f = 1/2 for S = 1/(2πf), by the midpoint rule."""
    f = (np.arange(_MIDPOINTS) + 0.5) * (0.5 / _MIDPOINTS)
    kernel = np.sin(np.pi * f * m[:, None]) ** 4 / (m[:, None] * np.sin(np.pi * f)) ** 2
    integral: Floats = (kernel / f).sum(1) * (1.0 / (np.pi * _MIDPOINTS))
    return integral


class _Flicker(Series):
    """y = direct·w + Σ residue·s, s ← pole·s + w: the partial fractions of the filter."""

    def __init__(self, B: float, rng: np.random.Generator) -> None:
        # unit white noise has density τ0, so S = τ0 gain² / (RESPONSE f τ0), which is to be B²/(2πf)
        gain = B * np.sqrt(RESPONSE / (2.0 * np.pi))
        self._rng = rng
        self._poles = 1.0 - ONE_MINUS_POLE
        self._direct = gain * float(np.prod((1.0 - ONE_MINUS_ZERO) / self._poles))
        self._residues = gain * _residues()
        overlap = ONE_MINUS_POLE[:, None] + ONE_MINUS_POLE - ONE_MINUS_POLE[:, None] * ONE_MINUS_POLE
        self._states = np.linalg.cholesky(1.0 / overlap) @ rng.standard_normal(ONE_MINUS_POLE.size)

    def add(self, values: Floats, block: Block) -> None:
        white = self._rng.standard_normal(out=block.scratch)
        _colour(values, white, self._states, self._poles, self._residues, self._direct)


def _residues() -> Floats:
    """Residues r of H(z) = Π(1 − z_i/z)/Π(1 − p_i/z) = direct + Σ r_i/(1 − p_i/z), from differences to one."""
    p, z = ONE_MINUS_POLE, ONE_MINUS_ZERO
    others = p[None, :] - p[:, None]
    np.fill_diagonal(others, 1.0)
    ratios = (z[None, :] - p[:, None]) / others
    return np.asarray(np.prod(ratios, axis=1) / (1.0 - p))


@compiled
def _colour(values, white, states, poles, residues, direct):  # type: ignore[no-untyped-def]
    """White noise in, 1/f noise added; ``states`` is carried on."""
    for k in range(values.size):
        value = direct * white[k]
        for i in range(states.size):
            states[i] = poles[i] * states[i] + white[k]
            value += residues[i] * states[i]
        values[k] += value
