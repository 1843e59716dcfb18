"""Power spectral density of the samples of one axis, and the Allan variance that results from it.

Without filters, the Allan variance is the sum of the closed-form Allan variances of the sources. After a filter, the
Allan variance is the integral

    σ²(τ) = 4 ∫ S(f) sin⁴(πfτ) / (m² sin²(πfτ0)) df   from 0 to 1/(2 τ0),

where τ0 is the sample interval and m = τ/τ0. Spectral lines and slopes are added in closed form.

For f < 0.1/τ, the integral is computed by the trapezoidal rule on a logarithmic frequency grid. At higher frequencies,
sin⁴(πfτ) is expanded to 3/8 − cos(2πfτ)/2 + cos(4πfτ)/8. The density is interpolated linearly between grid points, and
its products with the cosines are integrated exactly. For all effects of noise models, the relative error is below
3·10⁻⁴.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from drivers.data_types import Floats

Curve = Callable[[Floats], Floats]
"""Type of a function of frequency in Hz or of averaging time in seconds."""

POINTS_PER_DECADE: Final = 400
MIN_FREQUENCY_CYCLES: Final = 1e-5
"""Lower limit of the numerical integral, as the product of frequency and longest averaging time.

Below this frequency, the density continues as a power of f.
For a random walk, frequencies below the limit contribute a fraction of 3·10⁻⁵ of the Allan variance.
"""
MIN_INTEGRAL_EXPONENT: Final = 0.05
"""Smallest exponent of f that is assumed for the integral below the lowest frequency.

The exponent is 3 − α for a density f^(−α).
"""
MAX_SMOOTH_CYCLES: Final = 0.1
"""Maximum f·τ for which the trapezoidal rule is sufficiently accurate."""


@dataclass(frozen=True, slots=True)
class Spectrum:
    """Power spectral density and Allan variance of the samples of one axis."""

    density: Curve  # two-sided density in unit²/Hz as a function of f in Hz, excluding lines and slope
    closed_form_avar: Curve | None  # Allan variance in unit² as a function of τ in s; None after a filter
    tau0_s: float  # sample interval, s
    lines: tuple[tuple[float, float], ...] = ()  # frequency in Hz and mean square in unit² of each spectral line
    slope: float = 0.0  # root sum of squares of the constant slopes, unit/s
    level: float = 0.0  # sum of the constant biases, unit
    peaks: tuple[tuple[float, float], ...] = ()  # centre and width in Hz of each narrow peak

    def __add__(self, other: "Spectrum") -> "Spectrum":
        """Return the spectrum of the sum of two independent time series."""
        one, two = self.closed_form_avar, other.closed_form_avar
        return Spectrum(
            lambda f: self.density(f) + other.density(f),
            None if one is None or two is None else lambda tau: one(tau) + two(tau),
            self.tau0_s,
            self.lines + other.lines,
            float(np.hypot(self.slope, other.slope)),
            self.level + other.level,
            self.peaks + other.peaks,
        )

    def scaled_by_amplitude(self, factor: float) -> "Spectrum":
        """Return the spectrum of the samples multiplied by ``factor``."""
        power, closed = factor**2, self.closed_form_avar
        return replace(
            self,
            density=lambda f: power * self.density(f),
            closed_form_avar=None if closed is None else lambda tau: power * closed(tau),
            lines=tuple((f, power * size) for f, size in self.lines),
            slope=abs(factor) * self.slope,
            level=factor * self.level,
        )

    def filtered_by(self, power_gain: Curve, narrow_peaks: tuple[tuple[float, float], ...] = ()) -> "Spectrum":
        """Return the spectrum of the samples after a filter with unit gain at zero frequency.

        Parameters
        ----------
        power_gain : callable
            Squared magnitude of the frequency response as a function of frequency in Hz.
        narrow_peaks : tuple of (float, float)
            Centre and width in Hz of each narrow peak of the frequency response.
        """
        return replace(
            self,
            density=lambda f: power_gain(f) * self.density(f),
            closed_form_avar=None,
            lines=tuple((f, float(power_gain(np.array([f]))[0]) * size) for f, size in self.lines),
            peaks=self.peaks + narrow_peaks,
        )

    def avar(self, tau_s: Floats) -> Floats:
        """Return the overlapping Allan variance in unit² at averaging times in seconds."""
        if self.closed_form_avar is not None:
            return self.closed_form_avar(tau_s)
        total = allan_variance_of_density(self.density, tau_s, self.tau0_s, self.peaks)
        total += 0.5 * (self.slope * tau_s) ** 2
        for f_hz, mean_square in self.lines:
            total += allan_variance_of_line(f_hz, mean_square, tau_s, self.tau0_s)
        return total

    def mean_square(self, lowest_hz: float, weight: Curve | None = None) -> float:
        """Return the mean square in unit² above ``lowest_hz``, which is 2 ∫ S w df plus the spectral lines.

        Parameters
        ----------
        lowest_hz : float
            Lower end of the integral, Hz.
        weight : callable or None
            Weight w as a function of frequency in Hz. None means that w is 1.
        """
        f = frequency_grid(lowest_hz, self.tau0_s, self.peaks)
        weighted = self.density(f) if weight is None else self.density(f) * weight(f)
        lines = sum(size * (1.0 if weight is None else float(weight(np.array([f]))[0])) for f, size in self.lines)
        return 2.0 * float(np.trapezoid(weighted * f, np.log(f))) + lines


def white_noise_spectrum(mean_square: float, tau0_s: float) -> Spectrum:
    """Return the spectrum of white noise.

    The two-sided density is S = σ²τ0, and the Allan variance is σ²τ0/τ (IEEE Std 952 eq. C.18–C.19).

    Parameters
    ----------
    mean_square : float
        Variance σ² of a sample, unit².
    tau0_s : float
        Sample interval, s.
    """
    power = mean_square * tau0_s
    return Spectrum(lambda f: np.full_like(f, power), lambda tau: power / tau, tau0_s)


def zero_spectrum(tau0_s: float) -> Spectrum:
    """Return the spectrum of an axis without effects."""
    return Spectrum(np.zeros_like, np.zeros_like, tau0_s)


def nan_spectrum(tau0_s: float) -> Spectrum:
    """Return a spectrum of NaN, which represents a time series whose spectrum is unknown or not stationary."""
    return Spectrum(_nan, _nan, tau0_s)


def allan_variance_of_line(f_hz: float, mean_square: float, tau_s: Floats, tau0_s: float) -> Floats:
    """Return the Allan variance of a sampled sinusoid.

    The Allan variance is A² sin⁴(πfτ)/(m² sin²(πfτ0)) with A² = 2·mean square (IEEE Std 952 annex C, for sampled data).

    Parameters
    ----------
    f_hz : float
        Frequency of the sinusoid, Hz.
    mean_square : float
        Mean square of the sinusoid, unit².
    tau_s : ndarray, float64
        Averaging times, s.
    tau0_s : float
        Sample interval, s.
    """
    m = tau_s / tau0_s
    ratio = np.sin(np.pi * f_hz * tau_s) ** 2 / (m * np.sin(np.pi * f_hz * tau0_s))
    return np.asarray(2.0 * mean_square * ratio**2)


def allan_variance_of_density(
    density: Curve, tau_s: Floats, tau0_s: float, peaks: tuple[tuple[float, float], ...]
) -> Floats:
    """Compute the Allan variance from a power spectral density by numerical integration.

    Parameters
    ----------
    density : callable
        Two-sided density in unit²/Hz as a function of frequency in Hz.
    tau_s : ndarray, float64
        Averaging times, s.
    tau0_s : float
        Sample interval, s.
    peaks : tuple of (float, float)
        Centre and width of each narrow peak, Hz.

    Examples
    --------
    >>> tau = np.array([0.01, 0.02, 1.0, 50.0])
    >>> flat = allan_variance_of_density(lambda f: np.full_like(f, 4.0), tau, 0.01, ())
    >>> bool(np.all(np.abs(flat * tau / 4.0 - 1.0) < 3e-4))
    True
    """
    tau = np.atleast_1d(np.asarray(tau_s, np.float64))
    f = frequency_grid(MIN_FREQUENCY_CYCLES / float(tau.max()), tau0_s, peaks)
    rest = density(f) / np.sin(np.pi * f * tau0_s) ** 2
    found = [_allan_variance_at(float(t), f, rest, tau0_s) for t in tau]
    return np.reshape(found, np.shape(tau_s))


def frequency_grid(lowest_hz: float, tau0_s: float, peaks: tuple[tuple[float, float], ...]) -> Floats:
    """Return a logarithmic frequency grid in Hz up to half the sample rate, which is finer around peaks.

    Parameters
    ----------
    lowest_hz : float
        Lower end of the grid, Hz.
    tau0_s : float
        Sample interval, s.
    peaks : tuple of (float, float)
        Centre and width of each narrow peak, Hz.
    """
    nyquist = 0.5 / tau0_s
    # Near half the sample rate, linearly spaced points are needed to resolve the integrand at short averaging times.
    parts = [
        np.geomspace(lowest_hz, nyquist, max(2, round(POINTS_PER_DECADE * np.log10(nyquist / lowest_hz)))),
        np.linspace(0.1 * nyquist, nyquist, 2 * POINTS_PER_DECADE),
    ]
    away = np.geomspace(1e-3, 1e3, 2 * POINTS_PER_DECADE)
    for centre, width in peaks:
        parts += [centre + width * away, centre - width * away, np.array([centre])]
    f = np.unique(np.concatenate(parts))
    return np.asarray(f[(f >= lowest_hz) & (f <= nyquist)])


def _allan_variance_at(tau: float, f: Floats, rest: Floats, tau0_s: float) -> float:
    """Return the Allan variance at one averaging time, where ``rest`` is the density divided by sin²(πfτ0)."""
    split = int(np.clip(np.searchsorted(f, MAX_SMOOTH_CYCLES / tau), 1, f.size - 1))
    low = slice(0, split + 1)
    smooth = rest[low] * np.sin(np.pi * f[low] * tau) ** 4
    # the trapezoidal rule in ln f
    total = float(np.trapezoid(smooth * f[low], np.log(f[low]))) + _integral_below(smooth, f[low])
    f, rest = f[split:], rest[split:]
    slopes = np.diff(rest) / np.diff(f)
    total += 0.375 * float(np.trapezoid(rest, f)) - 0.5 * _integrate_cosine(2.0 * np.pi * tau, f, rest, slopes)
    total += 0.125 * _integrate_cosine(4.0 * np.pi * tau, f, rest, slopes)
    return 4.0 * total * (tau0_s / tau) ** 2


def _integrate_cosine(omega: float, f: Floats, rest: Floats, slopes: Floats) -> float:
    """Integrate the product of a piecewise linear function and cos(ωf) exactly."""
    ends = rest[-1] * np.sin(omega * f[-1]) - rest[0] * np.sin(omega * f[0])
    return float(ends / omega + (slopes * np.diff(np.cos(omega * f))).sum() / omega**2)


def _integral_below(values: Floats, f: Floats) -> float:
    """Return the integral from zero to the lowest frequency, for values that continue as a power of f."""
    first, second = values[:2]
    if not (first > 0.0 and second > 0.0):
        return 0.0 * float(first)  # NaN remains NaN
    slope = float(np.log(second / first) / np.log(f[1] / f[0]))
    return float(first * f[0] / max(slope + 1.0, MIN_INTEGRAL_EXPONENT))


def _nan(x: Floats) -> Floats:
    return np.full_like(x, np.nan)
