"""Plot data that compare an axis with the expectation and the 95 % band of a noise model.

If the noise model is true, each measured point lies in the band with a probability of 95 %.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
from scipy.special import chdtri, erfc

from drivers.data_types import Floats, Ints
from monitor.common.distributions import Z95
from monitor.estimation.allan.batch import cluster_sizes, overlapping_avar_axis
from monitor.noise.effects import RandomSampleHold
from monitor.noise.spectrum import allan_variance_of_density
from monitor.reconcile.diagnostics.whiteness_tests import MAX_LAG_SAMPLES, compute_autocorrelation
from monitor.reconcile.likelihood.whitening import WhitenedAxis, relative_noise_std_over_time
from monitor.reconcile.preparation.cosine_bins import FrequencyBins, inverse_cosine_transform
from monitor.reconcile.preparation.value_artifacts import RepeatedSamples
from monitor.reconcile.result import DiagnosticPlotData

SPECTRUM_POINTS: Final = 240
TIME_BLOCKS: Final = 240
TEMPERATURE_BINS: Final = 24
MAX_RUN_SAMPLES: Final = 60
"""Length of the longest run of equal values in the plot."""
MIN_RUNS: Final = 0.3
"""Smallest number of runs in the plot, whose axis is logarithmic."""
MAX_CHANCE_RUNS: Final = 3.0
"""Upper end of the 95 % interval of the expected number if no run is expected."""
LEVEL_UNITS: Final = {"g": "rad/s", "a": "m/s²"}
"""Unit of the samples by the first letter of the axis."""


def build_plot_data(whitened: WhitenedAxis) -> tuple[DiagnosticPlotData, ...]:
    """Build the data of all plots of one whitened axis."""
    fitted = _deterministic_series(whitened)
    plots = [
        _plot_psd(whitened),
        _plot_allan_deviation(whitened, fitted),
        _plot_level(whitened, fitted),
        _plot_variance(whitened),
        _plot_tails(whitened),
        _plot_autocorrelation(whitened),
    ]
    if whitened.axis.temperature_c is not None and np.ptp(whitened.axis.temperature_c) > 0.0:
        plots.append(_plot_level_over_temperature(whitened, fitted, whitened.axis.temperature_c))
    if whitened.axis.value_artifacts.repeats is not None:
        plots.append(_plot_runs_of_equal_values(whitened, whitened.axis.value_artifacts.repeats))
    return tuple(plots)


def _deterministic_series(whitened: WhitenedAxis) -> Floats:
    """Return the sum of the fitted deterministic effects, shape (n,), without the mean."""
    repaired = whitened.axis.repaired
    if not whitened.fit.regressor_slices:
        return np.zeros(repaired.size)
    return np.asarray(
        repaired
        - repaired.mean()
        - inverse_cosine_transform(whitened.fit.cosine_transform_without_deterministic_effects())
    )


def _plot_psd(whitened: WhitenedAxis) -> DiagnosticPlotData:
    bins, tau0_s = whitened.axis.bins, 1.0 / whitened.axis.rate_hz
    used = np.flatnonzero(whitened.axis.used_bins)
    # average neighbouring bins to about SPECTRUM_POINTS points that are evenly spaced in the logarithm of frequency
    f = np.log(bins.f_hz[used])
    cell = np.floor((f - f[0]) / max(f[-1] - f[0], 1e-9) * SPECTRUM_POINTS)
    first = np.flatnonzero(np.diff(cell, prepend=-1.0))
    count = np.add.reduceat(bins.count[used], first)
    expected = np.add.reduceat((bins.count * whitened.fit.whittle.variance)[used], first) / count * tau0_s
    measured = np.add.reduceat(whitened.fit.whittle.residual[used], first) / count * tau0_s
    middle = np.exp(np.add.reduceat((bins.count * np.log(bins.f_hz))[used], first) / count)
    lo, hi = _chi2_band(count)
    unit = f"({_level_unit(whitened)})²/Hz"
    names = ("psd", "frequency", "Hz", "spectral density", unit)
    return DiagnosticPlotData(*names, True, middle, measured, expected, lo * expected, hi * expected)


def _plot_allan_deviation(whitened: WhitenedAxis, fitted: Floats) -> DiagnosticPlotData:
    axis, tau0_s = whitened.axis, 1.0 / whitened.axis.rate_hz
    m = cluster_sizes(axis.n, axis.rate_hz)
    measured, _ = overlapping_avar_axis(axis.repaired, m)
    deterministic = overlapping_avar_axis(fitted, m)[0] if fitted.any() else np.zeros(m.size)
    tau_s = np.asarray(m * tau0_s, np.float64)
    density = interpolated_density(axis.bins, whitened.fit.whittle.variance)
    noise = allan_variance_of_density(density, tau_s, tau0_s, ())
    lo, hi = _chi2_band(_allan_degrees_of_freedom(whitened, m))
    curves = (measured, noise + deterministic, lo * noise + deterministic, hi * noise + deterministic)
    names = ("allan", "averaging time", "s", "Allan deviation", _level_unit(whitened))
    return DiagnosticPlotData(*names, True, tau_s, *(np.sqrt(avar) for avar in curves))


def interpolated_density(bins: FrequencyBins, variance: Floats) -> Callable[[Floats], Floats]:
    """Return the spectral density of a model as a function of the frequency in Hz.

    Below the first bin, the density continues with the slope between the first two bins. Otherwise, the Allan deviation
    of a random walk would be too small at the longest averaging times.

    Parameters
    ----------
    bins : FrequencyBins
        Frequency bins.
    variance : ndarray of float64, shape (m,)
        Variance of a coefficient in each bin.
    """
    x, y = np.log(bins.f_hz), np.log(variance / bins.rate_hz)
    slope = (y[1] - y[0]) / (x[1] - x[0])

    def density(f_hz: Floats) -> Floats:
        log_f = np.log(f_hz)
        return np.asarray(np.exp(np.interp(log_f, x, y) + slope * np.minimum(log_f - x[0], 0.0)))

    return density


def _allan_degrees_of_freedom(whitened: WhitenedAxis, m: Ints) -> Floats:
    """Return the degrees of freedom of overlapping Allan variances.

    An Allan variance is a weighted sum Σ a_k Y_k², where the weight a_k is proportional to sin⁴(πfτ)/sin²(πfτ0). Let
    v_k be the variance of Y_k. The degrees of freedom are then (Σ a_k v_k)²/Σ (a_k v_k)². For a bin wider than one
    period of sin⁴, the means of sin⁴ (3/8) and sin⁸ (35/128) replace the values at the bin centre.
    """
    bins, variance = whitened.axis.bins, whitened.fit.whittle.variance
    f, count = bins.f_hz, bins.count
    width = count * 0.5 * whitened.axis.rate_hz / whitened.axis.n
    found = np.empty(m.size)
    for at, factor in enumerate(m.tolist()):
        tau_s = factor / whitened.axis.rate_hz
        averaged = width * tau_s > 0.5
        square = np.sin(np.pi * f * tau_s) ** 2
        first, second = np.where(averaged, 0.375, square**2), np.where(averaged, 35.0 / 128.0, square**4)
        rest = variance / np.sin(np.pi * f / whitened.axis.rate_hz) ** 2
        found[at] = (count * first * rest).sum() ** 2 / (count * second * rest**2).sum()
    return np.maximum(found, 1.0)


def _plot_level(whitened: WhitenedAxis, fitted: Floats) -> DiagnosticPlotData:
    axis = whitened.axis
    length = max(1, axis.n // TIME_BLOCKS)
    measured, expected = _block_means(axis.repaired, length), _block_means(fitted, length) + axis.repaired.mean()
    spread = _level_spread(whitened, length / axis.rate_hz)
    names = ("level", "time", "s", "level", _level_unit(whitened))
    times_s = _block_times_s(measured.size, length, axis.rate_hz)
    return DiagnosticPlotData(*names, False, times_s, measured, expected, expected - spread, expected + spread)


def _level_spread(whitened: WhitenedAxis, length_s: float) -> float:
    """Return half the width of the 95 % band of a mean over ``length_s`` seconds."""
    bins = whitened.axis.bins
    weight = np.sinc(bins.f_hz * length_s) ** 2
    return Z95 * float(np.sqrt((bins.count * whitened.fit.whittle.variance * weight).sum() / whitened.axis.n))


def _plot_variance(whitened: WhitenedAxis) -> DiagnosticPlotData:
    axis = whitened.axis
    length = max(1, axis.n // TIME_BLOCKS)
    deviation = relative_noise_std_over_time(whitened.fit)
    measured = np.sqrt(_block_means((whitened.flat_series * deviation) ** 2, length))
    expected = np.sqrt(_block_means(deviation**2, length))
    lo, hi = np.sqrt(_chi2_band(np.array([float(length)])))
    names = ("variance", "time", "s", "noise over its mean", "1")
    times_s = _block_times_s(measured.size, length, axis.rate_hz)
    return DiagnosticPlotData(*names, False, times_s, measured, expected, lo * expected, hi * expected)


def _plot_tails(whitened: WhitenedAxis) -> DiagnosticPlotData:
    magnitudes = np.sort(np.abs(whitened.flat_series))
    n = magnitudes.size
    x = np.linspace(0.5, max(float(magnitudes[-1]), 4.0), 80)
    measured = 1.0 - np.searchsorted(magnitudes, x) / n
    expected = erfc(x / 2.0**0.5)
    spread = Z95 * np.sqrt(np.maximum(expected * (1.0 - expected), 0.0) / n)
    least = 0.3 / n
    hi = np.maximum(expected + spread, 3.0 / n)
    measured, expected, lo = (np.maximum(one, least) for one in (measured, expected, expected - spread))
    names = ("tails", "distance", "σ", "share of samples beyond", "1")
    return DiagnosticPlotData(*names, True, x, measured, expected, lo, hi)


def _plot_autocorrelation(whitened: WhitenedAxis) -> DiagnosticPlotData:
    lag_s = np.arange(1, MAX_LAG_SAMPLES + 1) / whitened.axis.rate_hz
    zero, band = np.zeros(MAX_LAG_SAMPLES), np.full(MAX_LAG_SAMPLES, Z95 / whitened.axis.n**0.5)
    names = ("autocorrelation", "lag", "s", "autocorrelation", "1")
    return DiagnosticPlotData(*names, False, lag_s, compute_autocorrelation(whitened.periodogram), zero, -band, band)


def _plot_level_over_temperature(whitened: WhitenedAxis, fitted: Floats, temperature_c: Floats) -> DiagnosticPlotData:
    axis = whitened.axis
    edges = np.linspace(float(temperature_c.min()), float(temperature_c.max()), TEMPERATURE_BINS + 1)
    cell = np.clip(np.searchsorted(edges, temperature_c, "right") - 1, 0, TEMPERATURE_BINS - 1)
    count = np.bincount(cell, minlength=TEMPERATURE_BINS)
    filled = count > 0

    def temperature_bin_means(series: Floats) -> Floats:
        return np.asarray(np.bincount(cell, weights=series, minlength=TEMPERATURE_BINS)[filled] / count[filled])

    expected = temperature_bin_means(fitted) + axis.repaired.mean()
    spread = np.array([_level_spread(whitened, length_s) for length_s in count[filled] / axis.rate_hz])
    names = ("temperature", "temperature", "°C", "level", _level_unit(whitened))
    middle = 0.5 * (edges[1:] + edges[:-1])[filled]
    return DiagnosticPlotData(
        *names, False, middle, temperature_bin_means(axis.repaired), expected, expected - spread, expected + spread
    )


def _plot_runs_of_equal_values(whitened: WhitenedAxis, repeats: RepeatedSamples) -> DiagnosticPlotData:
    """Plot the number of runs of equal values that are at least as long as k samples.

    If the share q of the n samples equals the previous sample, n (1 − q) qᵏ⁻¹ runs have at least k samples. A model
    with the fraction g of repeated samples has q = g + (1 − g) p, where p is the share of equal neighbours by chance.
    """
    raw, found = whitened.axis.raw, repeats.fraction.value
    same = raw[1:] == raw[:-1]
    chance = max((float(same.mean()) - found) / (1.0 - found), 0.0) if found < 1.0 else 0.0
    fraction = sum(effect.fraction for effect in whitened.effects if isinstance(effect, RandomSampleHold))
    equal = fraction + (1.0 - fraction) * chance
    lengths = np.diff(np.concatenate([[0], np.flatnonzero(~same) + 1, [raw.size]]))
    k = np.arange(1, min(int(lengths.max()), MAX_RUN_SAMPLES) + 1)
    measured = (lengths[None] >= k[:, None]).sum(axis=1).astype(np.float64)
    expected = raw.size * (1.0 - equal) * equal ** (k - 1.0)
    spread = Z95 * np.sqrt(expected)
    lo, hi = np.maximum(expected - spread, MIN_RUNS), np.maximum(expected + spread, MAX_CHANCE_RUNS)
    names = ("values", "run of equal values", "samples", "runs at least as long", "1")
    return DiagnosticPlotData(*names, True, k.astype(np.float64), measured, np.maximum(expected, MIN_RUNS), lo, hi)


def _level_unit(whitened: WhitenedAxis) -> str:
    return LEVEL_UNITS[whitened.axis.name[0]]


def _block_means(values: Floats, length: int) -> Floats:
    count = values.size // length
    return np.asarray(values[: count * length].reshape(count, length).mean(axis=1))


def _block_times_s(count: int, length: int, rate_hz: float) -> Floats:
    return np.asarray((np.arange(count) + 0.5) * length / rate_hz, np.float64)


def _chi2_band(freedom: Floats) -> tuple[Floats, Floats]:
    """Return the 95 % band of a mean square relative to the expected value."""
    return np.asarray(chdtri(freedom, 0.975) / freedom), np.asarray(chdtri(freedom, 0.025) / freedom)
