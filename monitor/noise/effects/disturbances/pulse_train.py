"""Periodic pulses, for example from the pulse-per-second signal of a satellite receiver."""

from dataclasses import dataclass
from fractions import Fraction
from math import ceil
from typing import ClassVar, Final

import numpy as np

from drivers.data_types import Floats, Ints
from drivers.errors import ConfigError
from monitor.noise.effect import RunningSource, SampleBlockContext, Source, parameter_field
from monitor.noise.spectrum import Curve, Spectrum, nan_spectrum

MAX_PERIOD_SAMPLES: Final = 1 << 20
"""Longest period, in samples, for which the spectrum is computed."""
MAX_CYCLE_SAMPLES: Final = 8192
"""Longest common cycle of pulses and samples, in samples, if the period is not a whole number of samples."""
MAX_LINES: Final = 4096
EDGE_TOLERANCE_SAMPLES: Final = 1e-6


@dataclass(frozen=True, slots=True)
class PulseTrain(Source):
    """Rectangular pulses of height h and width w with the period T. The first pulse starts at ``delay``.

    If no delay is given, the delay is random. For a random delay, the autocovariance is h² (o(s)/T − w²/T²), where o(s)
    is the overlap of the pulses with pulses that are shifted by s. The Allan variance and the spectral lines follow
    from the autocovariance.

    >>> pulses = PulseTrain(height=1.0, period=0.04, width=0.02)
    >>> [round(float(x), 6) for x in pulses.avar(np.array([0.01, 0.02, 0.04]), 0.01)]
    [0.25, 0.25, 0.0]
    """

    height: float = parameter_field("rad/s", "m/s²", signed=True)
    period: float = parameter_field("s", positive=True)
    width: float = parameter_field("s", positive=True)
    delay: float | None = parameter_field("s", optional=True)

    description: ClassVar[str] = "Rectangular pulses repeat with a constant period."

    def __post_init__(self) -> None:
        Source.__post_init__(self)
        if not self.width < self.period:
            raise ConfigError(f"{self.name}: width must be below the period of {self.period!r} s, is {self.width!r}")

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return a spectrum of lines without a density, or NaN if the period exceeds ``MAX_PERIOD_SAMPLES``."""
        samples = self.period / tau0_s
        if samples > MAX_PERIOD_SAMPLES:
            return nan_spectrum(tau0_s)
        cycle = Fraction(samples).limit_denominator(max(1, int(MAX_CYCLE_SAMPLES / samples)))
        p = max(cycle.numerator, 1)
        covariance = self._autocovariance(np.arange(p) * cycle.denominator % p / p)
        mean = self.height * self.width / self.period
        return Spectrum(
            np.zeros_like, _allan_variance(covariance, tau0_s), tau0_s, _spectral_lines(covariance, tau0_s), level=mean
        )

    def _autocovariance(self, shift: Floats) -> Floats:
        """Return the autocovariance for shifts from 0 to 1 period."""
        duty = self.width / self.period
        overlap = np.maximum(duty - shift, 0.0) + np.maximum(duty - 1.0 + shift, 0.0)
        return np.asarray(self.height**2 * (overlap - duty**2))

    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a series of pulses. The delay is relative to the first sample of the stream."""
        delay_s = float(rng.uniform(0.0, self.period)) if self.delay is None else self.delay
        period, width = self.period * rate_hz, self.width * rate_hz
        start = delay_s * rate_hz - EDGE_TOLERANCE_SAMPLES

        def add_pulses(values: Floats, block: SampleBlockContext) -> None:
            since = np.arange(block.first, block.first + values.size) - start
            values[np.mod(since, period) < width] += self.height

        return RunningSource(add_pulses, lambda: {"delay": delay_s} if self.delay is None else {})


def _spectral_lines(covariance: Floats, tau0_s: float) -> tuple[tuple[float, float], ...]:
    """Return the frequency and the mean square of the strongest lines. ``covariance`` covers one cycle."""
    p = covariance.size
    power = np.maximum(np.fft.rfft(covariance).real / p, 0.0)
    power[1 : ceil(p / 2)] *= 2.0  # positive and negative frequencies
    power[0] = 0.0  # the mean is no line
    strongest = np.sort(np.argsort(power)[-MAX_LINES:])
    return tuple((float(k) / (p * tau0_s), float(power[k])) for k in strongest if power[k] > 1e-12 * power.sum())


def _allan_variance(covariance: Floats, tau0_s: float) -> Curve:
    """Return the Allan variance of a series with the given periodic autocovariance R.

    σ²(mτ0) = [m R(0) + Σ (2m − 3l) R(l) + Σ (l − 2m) R(l)]/m². The first sum ends at l = m, and the second at l = 2m.
    """
    p = covariance.size
    sums = np.concatenate([[0.0], np.cumsum(covariance)])
    moments = np.concatenate([[0.0], np.cumsum(np.arange(p) * covariance)])

    def sum_autocovariance_below_lag(end: Ints) -> tuple[Floats, Floats]:
        """Return Σ R(l) and Σ l R(l) for 0 ≤ l < end."""
        a, b = np.divmod(end, p)
        first = a * moments[-1] + p * sums[-1] * (a * (a - 1) / 2.0) + a * p * sums[b] + moments[b]
        return a * sums[-1] + sums[b], first

    def allan_variance(tau_s: Floats) -> Floats:
        m = np.maximum(np.rint(np.asarray(tau_s) / tau0_s), 1.0).astype(np.int64)
        inner, inner_first = sum_autocovariance_below_lag(m + 1)
        outer, outer_first = sum_autocovariance_below_lag(2 * m)
        total = 2.0 * m * inner - 3.0 * inner_first + (outer_first - inner_first) - 2.0 * m * (outer - inner)
        return np.asarray(np.maximum(total - m * covariance[0], 0.0) / m.astype(np.float64) ** 2)

    return allan_variance
