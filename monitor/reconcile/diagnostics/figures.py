"""Plot data of an axis and a model: the measurement, the expectation and the 95 % band.

The band contains 95 of 100 simulated recordings at each place. It is calculated from the spectrum of the model, without
simulation. A view has a few hundred points.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import chdtri, erfc

from drivers.sample import Floats, Ints
from monitor.common.distributions import Z95
from monitor.estimation.allan.batch import cluster_sizes, overlapping_avar_axis
from monitor.noise.spectrum import allan_of_density
from monitor.reconcile.diagnostics.diagnostics import MAX_LAG_SAMPLES, WhitenedAxis, noise_deviation_over_time
from monitor.reconcile.preparation.cosine_bins import inverse_cosine_transform
from monitor.reconcile.result import PlotData

SPECTRUM_POINTS: Final = 240
"""Approximate number of points of a spectrum."""
TIME_BLOCKS: Final = 240
"""Number of blocks of a plot over time."""
TEMPERATURE_BINS: Final = 24
"""Number of temperature intervals."""
LEVEL_UNITS: Final = {"g": "rad/s", "a": "m/s²"}
"""Unit of the level by the first letter of the axis."""
DENSITY_UNITS: Final = {"g": "(rad/s)²/Hz", "a": "(m/s²)²/Hz"}
"""Unit of the spectral density by the first letter of the axis."""


def plot_data(seen: WhitenedAxis) -> tuple[PlotData, ...]:
    """Return the plot data of every diagnostic that has a plot."""
    made = [
        _psd_view(seen),
        _allan_view(seen),
        _level_view(seen),
        _variance_view(seen),
        _tails_view(seen),
        _autocorrelation_view(seen),
    ]
    if seen.axis.temperature_c is not None and np.ptp(seen.axis.temperature_c) > 0.0:
        made.append(_temperature_view(seen))
    return tuple(made)


def _psd_view(seen: WhitenedAxis) -> PlotData:
    """Return the plot of the spectral density."""
    bins, tau0_s = seen.axis.bins, 1.0 / seen.axis.rate_hz
    variance, power = seen.likely.fitted.variance, seen.likely.fitted.residual
    used = np.flatnonzero(seen.axis.used_bins)
    # average neighbouring bins to about SPECTRUM_POINTS points that are evenly spaced in the logarithm of frequency
    f = np.log(bins.f_hz[used])
    cell = np.floor((f - f[0]) / max(f[-1] - f[0], 1e-9) * SPECTRUM_POINTS)
    first = np.flatnonzero(np.diff(cell, prepend=-1.0))
    count = np.add.reduceat(bins.count[used], first)
    expected = np.add.reduceat((bins.count * variance)[used], first) / count * tau0_s
    measured = np.add.reduceat(power[used], first) / count * tau0_s
    middle = np.exp(np.add.reduceat((bins.count * np.log(bins.f_hz))[used], first) / count)
    lo, hi = _chi2_band(count)
    unit = DENSITY_UNITS[seen.axis.name[0]]
    return PlotData(
        "psd",
        "frequency",
        "Hz",
        "spectral density",
        unit,
        True,
        middle,
        measured,
        expected,
        lo * expected,
        hi * expected,
    )


def _allan_view(seen: WhitenedAxis) -> PlotData:
    """Return the plot of the Allan deviation."""
    axis, tau0_s = seen.axis, 1.0 / seen.axis.rate_hz
    m = cluster_sizes(axis.n, axis.rate_hz)
    measured, _ = overlapping_avar_axis(axis.repaired, m)
    courses = axis.repaired - axis.repaired.mean() - inverse_cosine_transform(axis.residual(seen.likely))
    of_courses, _ = overlapping_avar_axis(courses, m)
    tau_s = np.asarray(m * tau0_s, np.float64)
    density = _density_function(seen)
    noise = allan_of_density(density, tau_s, tau0_s, ())
    lo, hi = _chi2_band(_allan_degrees_of_freedom(seen, m))
    expected = noise + of_courses
    bounds = (np.sqrt(lo * noise + of_courses), np.sqrt(hi * noise + of_courses))
    unit = LEVEL_UNITS[axis.name[0]]
    return PlotData(
        "allan",
        "averaging time",
        "s",
        "Allan deviation",
        unit,
        True,
        tau_s,
        np.sqrt(measured),
        np.sqrt(expected),
        *bounds,
    )


def _density_function(seen: WhitenedAxis) -> Callable[[Floats], Floats]:
    """Return the spectral density of the fitted noise as an interpolating function of the frequency in Hz."""
    bins = seen.axis.bins
    x, y = np.log(bins.f_hz), np.log(seen.likely.fitted.variance / seen.axis.rate_hz)
    return lambda f: np.asarray(np.exp(np.interp(np.log(f), x, y)))


def _allan_degrees_of_freedom(seen: WhitenedAxis, m: Ints) -> Floats:
    """Return the degrees of freedom of overlapping Allan variances: for Σ a_k Y_k², 2 E²/Var = (Σ a v)²/Σ (a v)².

    The weights are a_k ∝ sin⁴(πfτ)/sin²(πfτ0). If a bin contains more than a period of sin⁴, the mean 3/8 and the mean
    square 35/128 are used.
    """
    bins, variance = seen.axis.bins, seen.likely.fitted.variance
    f, count = bins.f_hz, bins.count
    width = count * 0.5 * seen.axis.rate_hz / seen.axis.n
    found = np.empty(m.size)
    for at, factor in enumerate(m.tolist()):
        tau_s = factor / seen.axis.rate_hz
        turning = width * tau_s > 0.5
        square = np.sin(np.pi * f * tau_s) ** 2
        first, second = np.where(turning, 0.375, square**2), np.where(turning, 35.0 / 128.0, square**4)
        rest = variance / np.sin(np.pi * f / seen.axis.rate_hz) ** 2
        found[at] = (count * first * rest).sum() ** 2 / (count * second * rest**2).sum()
    return np.maximum(found, 1.0)


def _level_view(seen: WhitenedAxis) -> PlotData:
    """Return the plot of the level over time."""
    axis = seen.axis
    size = max(1, axis.n // TIME_BLOCKS)
    courses = axis.repaired - axis.repaired.mean() - inverse_cosine_transform(axis.residual(seen.likely))
    measured, expected = _block_means(axis.repaired, size), _block_means(courses, size) + axis.repaired.mean()
    t = np.asarray((np.arange(measured.size) + 0.5) * size / axis.rate_hz, np.float64)
    bins = axis.bins
    block = np.sinc(bins.f_hz * size / axis.rate_hz) ** 2
    spread = Z95 * float(np.sqrt((bins.count * seen.likely.fitted.variance * block).sum() / axis.n))
    unit = LEVEL_UNITS[axis.name[0]]
    return PlotData(
        "level", "time", "s", "level", unit, False, t, measured, expected, expected - spread, expected + spread
    )


def _variance_view(seen: WhitenedAxis) -> PlotData:
    """Return the plot of the noise standard deviation over time."""
    axis = seen.axis
    size = max(1, axis.n // TIME_BLOCKS)
    course = noise_deviation_over_time(seen.likely.effects, axis.n, axis.rate_hz)
    measured, expected = np.sqrt(_block_means((seen.fast * course) ** 2, size)), np.sqrt(_block_means(course**2, size))
    t = np.asarray((np.arange(measured.size) + 0.5) * size / axis.rate_hz, np.float64)
    lo, hi = np.sqrt(_chi2_band(np.array([float(size)])))
    return PlotData(
        "variance", "time", "s", "noise over its mean", "1", False, t, measured, expected, lo * expected, hi * expected
    )


def _tails_view(seen: WhitenedAxis) -> PlotData:
    """Return the plot of the share of samples beyond a distance."""
    sizes = np.sort(np.abs(seen.fast))
    n = sizes.size
    x = np.linspace(0.5, max(float(sizes[-1]), 4.0), 80)
    measured = 1.0 - np.searchsorted(sizes, x) / n
    expected = erfc(x / 2.0**0.5)
    spread = Z95 * np.sqrt(np.maximum(expected * (1.0 - expected), 0.0) / n)
    least = 0.3 / n
    return PlotData(
        "tails",
        "distance",
        "σ",
        "share of samples beyond",
        "1",
        True,
        x,
        np.maximum(measured, least),
        np.maximum(expected, least),
        np.maximum(expected - spread, least),
        np.maximum(expected + spread, 3.0 / n),
    )


def _autocorrelation_view(seen: WhitenedAxis) -> PlotData:
    """Return the plot of the autocorrelation of the whitened series."""
    n = seen.white.size
    size = next_fast_len(n + MAX_LAG_SAMPLES, real=True)
    turned = rfft(seen.white, size)
    measured = irfft(turned.real**2 + turned.imag**2, size)[1 : MAX_LAG_SAMPLES + 1] / n
    lag_s = np.arange(1, MAX_LAG_SAMPLES + 1) / seen.axis.rate_hz
    zero, band = np.zeros(MAX_LAG_SAMPLES), np.full(MAX_LAG_SAMPLES, Z95 / n**0.5)
    return PlotData("autocorrelation", "lag", "s", "autocorrelation", "1", False, lag_s, measured, zero, -band, band)


def _temperature_view(seen: WhitenedAxis) -> PlotData:
    """Return the plot of the level over temperature."""
    axis = seen.axis
    warmth = axis.temperature_c
    assert warmth is not None
    courses = axis.repaired - axis.repaired.mean() - inverse_cosine_transform(axis.residual(seen.likely))
    edges = np.linspace(float(warmth.min()), float(warmth.max()), TEMPERATURE_BINS + 1)
    of = np.clip(np.searchsorted(edges, warmth, "right") - 1, 0, TEMPERATURE_BINS - 1)
    count = np.bincount(of, minlength=TEMPERATURE_BINS)
    there = count > 0
    mean = [
        np.bincount(of, weights=one, minlength=TEMPERATURE_BINS)[there] / count[there]
        for one in (axis.repaired, courses)
    ]
    expected = mean[1] + axis.repaired.mean()
    longest_s = count[there] / axis.rate_hz
    bins = axis.bins
    spread = np.array(
        [
            Z95
            * float(np.sqrt((bins.count * seen.likely.fitted.variance * np.sinc(bins.f_hz * s) ** 2).sum() / axis.n))
            for s in longest_s
        ]
    )
    x = 0.5 * (edges[1:] + edges[:-1])[there]
    unit = LEVEL_UNITS[axis.name[0]]
    return PlotData(
        "temperature",
        "temperature",
        "°C",
        "level",
        unit,
        False,
        x,
        mean[0],
        expected,
        expected - spread,
        expected + spread,
    )


def _block_means(values: Floats, size: int) -> Floats:
    """Return the means of consecutive blocks."""
    count = values.size // size
    return np.asarray(values[: count * size].reshape(count, size).mean(axis=1))


def _chi2_band(freedom: Floats) -> tuple[Floats, Floats]:
    """Return the 95 % band of a mean square relative to its expectation."""
    return np.asarray(chdtri(freedom, 0.975) / freedom), np.asarray(chdtri(freedom, 0.025) / freedom)
