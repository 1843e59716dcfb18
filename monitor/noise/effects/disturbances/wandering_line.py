"""Oscillation of constant amplitude whose frequency wanders, for example from a motor without speed control.

The frequency deviates from its centre by first-order Gauss–Markov noise with the standard deviation s and the
correlation time T. A pure random walk of the frequency has no stationary spectrum. Over times far below T, the
Gauss–Markov noise is a random walk of the frequency with the coefficient s√(2/T) in Hz/√s.

The autocovariance is A²/2 cos(2πf0t) exp(−Δ²(e^(−|t|/T) − 1 + |t|/T)) with Δ = 2πsT (Kubo, "A stochastic theory of line
shape", Adv. Chem. Phys. 15 (1969) 101). For Δ ≫ 1, the line has a Gaussian shape with the standard deviation s. For
Δ ≪ 1, the line has a Lorentzian shape with the full width 4πs²T at half power. For all Δ, the shape is the real part of
the continued fraction

    2/(z + a/(z + 1/T + 2a/(z + 2/T + 3a/(z + 3/T + …)))) with z = 2πi(f − f0) and a = (2πs)².
"""

from dataclasses import dataclass
from math import pi, sqrt, tanh
from typing import ClassVar, Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.compiled import compiled
from monitor.noise.effect import RunningSource, SampleBlockContext, Source, parameter_field
from monitor.noise.spectrum import Spectrum, allan_variance_of_density

FRACTION_TERMS: Final = 100
"""Number of terms of the continued fraction. The relative error of the line shape is below 0.3 %."""
MIN_TANH_ARGUMENT: Final = 0.01
"""Smallest ratio x of sample interval and correlation time for which 2x − 4 tanh(x/2) is computed without a series."""


@dataclass(frozen=True, slots=True)
class WanderingLine(Source):
    """Oscillation A sin φ(t), where the frequency dφ/dt/2π = f0 + δ(t) wanders with the standard deviation s of δ.

    The amplitude is constant, unlike that of ``Narrowband``, which can have the same spectrum. The Allan variance is an
    integral over the spectrum. If no phase is given, the phase is random.

    >>> line = WanderingLine(amplitude=1.0, frequency=20.0, frequency_deviation=0.2, correlation_time=20.0)
    >>> peak, side = line.two_sided_psd(np.array([20.0, 20.2]), 1e-4)
    >>> print(f"{side / peak:.1f}")  # exp(−1/2)
    0.6
    """

    amplitude: float = parameter_field("rad/s", "m/s²")
    frequency: float = parameter_field("Hz", positive=True, below_nyquist=True)
    frequency_deviation: float = parameter_field("Hz", positive=True)
    correlation_time: float = parameter_field("s", positive=True)
    phase: float | None = parameter_field("rad", signed=True, optional=True)

    description: ClassVar[str] = "The frequency of an oscillation with a constant amplitude varies randomly."

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return the mean spectrum, and the Allan variance by numerical integration."""
        deviation, time_s = self.frequency_deviation, self.correlation_time
        peaks = ((self.frequency, min(sqrt(8.0 * np.log(2.0)) * deviation, 4.0 * pi * deviation**2 * time_s)),)

        def density(f_hz: Floats) -> Floats:
            # the lines at ±f0, and their aliases beyond half the sample rate
            offsets_hz = np.add.outer([0.0, -1.0 / tau0_s], np.add.outer([-self.frequency, self.frequency], f_hz))
            return np.asarray(0.25 * self.amplitude**2 * line_shape(offsets_hz, deviation, time_s).sum((0, 1)))

        return Spectrum(
            density, lambda tau_s: allan_variance_of_density(density, tau_s, tau0_s, peaks), tau0_s, peaks=peaks
        )

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start an oscillation whose frequency is in its stationary state.

        The joint distribution of frequency and phase at the samples is exact. With x = τ0/T, the mean of the phase step
        is 2πT tanh(x/2)(δ + δ'), given the frequencies δ and δ' at its ends. Its variance is
        (2πsT)²(2x − 4 tanh(x/2)).
        """
        start = float(rng.uniform(0.0, 2.0 * pi)) if self.phase is None else self.phase
        x = 1.0 / (rate_hz * self.correlation_time)
        decay = float(np.exp(-x))
        drive = self.frequency_deviation * float(np.sqrt(-np.expm1(-2.0 * x)))
        scatter = x**3 / 6.0 if x < MIN_TANH_ARGUMENT else 2.0 * x - 4.0 * tanh(0.5 * x)
        cycles = (  # of the centre frequency, of 1 Hz in δ + δ', and of the scatter between two samples
            self.frequency / rate_hz,
            self.correlation_time * tanh(0.5 * x),
            self.frequency_deviation * self.correlation_time * sqrt(scatter),
        )
        phase, offset_hz = start / (2.0 * pi), self.frequency_deviation * rng.standard_normal()

        def add_sinusoid(values: Floats, block: SampleBlockContext) -> None:
            nonlocal phase, offset_hz
            white = rng.standard_normal((values.size, 2))
            phase, offset_hz = _add_wandering_sinusoid(
                values, white, self.amplitude, decay, drive, cycles, phase, offset_hz
            )

        return RunningSource(add_sinusoid, lambda: {"phase": start} if self.phase is None else {})


def line_shape(offset_hz: Floats, deviation_hz: float, time_s: float) -> Floats:
    """Return the spectral density of a complex oscillation of amplitude 1 whose frequency wanders, in 1/Hz.

    After the last term, the continued fraction is replaced by the solution of r = n a/(z + n/T + r).

    Parameters
    ----------
    offset_hz : ndarray, float64
        Difference from the centre frequency, Hz.
    deviation_hz : float
        Standard deviation of the frequency, Hz.
    time_s : float
        Correlation time of the frequency, s.

    Examples
    --------
    >>> print(f"{line_shape(np.array([0.0]), 0.1, 1e3)[0] * 0.1 * np.sqrt(2.0 * np.pi):.2f}")  # Gaussian shape
    1.00
    """
    z, a = 2j * pi * np.asarray(offset_hz, np.float64), (2.0 * pi * deviation_hz) ** 2
    last = z + (FRACTION_TERMS + 1) / time_s
    rest = 0.5 * (np.sqrt(last**2 + 4.0 * (FRACTION_TERMS + 1) * a) - last)
    for n in range(FRACTION_TERMS, 0, -1):
        rest = n * a / (z + n / time_s + rest)
    return np.asarray(2.0 * np.real(1.0 / (z + rest)))


@compiled
def _add_wandering_sinusoid(
    values: Floats,
    white: Floats,
    amplitude: float,
    decay: float,
    drive: float,
    cycles: tuple[float, float, float],
    phase: float,
    offset_hz: float,
) -> tuple[float, float]:
    """Add the sinusoid. ``phase`` is in cycles. Return the phase and the frequency offset at the next sample."""
    for k in range(values.size):
        values[k] += amplitude * np.sin(2.0 * pi * phase)
        next_hz = decay * offset_hz + drive * white[k, 0]
        phase += cycles[0] + cycles[1] * (offset_hz + next_hz) + cycles[2] * white[k, 1]
        phase -= np.floor(phase)
        offset_hz = next_hz
    return phase, offset_hz
