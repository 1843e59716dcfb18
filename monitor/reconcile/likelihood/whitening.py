"""Whitening of an axis by a fitted noise model.

If the model is true, the whitened coefficients are independent and have a variance of one.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.noise.effect import Effect, first_sample_at_or_after
from monitor.noise.effects import NoiseStep
from monitor.reconcile.likelihood.axis_fit import Axis, AxisFit, Effects
from monitor.reconcile.likelihood.outlier_fit import OutlierFit, fit_outliers
from monitor.reconcile.likelihood.variance_history import (
    SpectrogramChange,
    VarianceChangeFit,
    find_spectrogram_change,
    fit_variance_changes,
)
from monitor.reconcile.preparation.cosine_bins import inverse_cosine_transform

SLOW_BAND_FRACTION: Final = 0.01
"""Fraction of the frequency range, from zero, that the tests for outliers and variance changes ignore.
"""
MIN_COEFFICIENTS_PER_BIN: Final = 64
"""Smallest number of coefficients in a bin whose power is not smoothed. The standard error is 18 %.
"""
SMOOTHING_BINS: Final = 9
"""Number of neighbouring bins over which the power of a small bin is averaged."""
MIN_DENSITY_RATIO: Final = 1e-3
"""Smallest spectral density of a bin relative to the median. Bins below this limit are stop bands."""


@dataclass(frozen=True, eq=False)
class WhitenedAxis:
    """Axis whitened by a fitted noise model."""

    fit: AxisFit
    coefficients: Floats  # [n − 1] coefficients divided by the standard deviation; random draws in stop bands
    weights: Floats  # [n − 1] inverse of the standard deviation; 0 in stop bands
    series: Floats  # [n] series of the whitened coefficients
    flat_series: Floats  # [n] series with unit power in each bin and random draws at low frequencies

    @property
    def axis(self) -> Axis:
        """Axis before whitening."""
        return self.fit.axis

    @property
    def effects(self) -> Effects:
        """Effects of the fitted noise model."""
        return self.fit.effects

    @property
    def effect_types(self) -> set[type[Effect]]:
        """Types of the fitted effects."""
        return {type(effect) for effect in self.effects}

    @cached_property
    def variance_changes(self) -> VarianceChangeFit:
        """Changes of the variance of the flattened series."""
        return fit_variance_changes(self.flat_series, 1.0 / self.axis.rate_hz)

    @cached_property
    def spectrogram_change(self) -> SpectrogramChange:
        """Largest change of power in the spectrogram that no noise step of the model explains."""
        series = self.series / relative_noise_deviation_over_time(self.fit)
        return find_spectrogram_change(series, 1.0 / self.axis.rate_hz)

    @cached_property
    def outlier_fit(self) -> OutlierFit | None:
        """Fit of outliers to the flattened series, or None if a Gaussian fits equally well."""
        return fit_outliers(self.flat_series)


def whiten_axis(fit: AxisFit) -> WhitenedAxis:
    """Whiten an axis by a fitted noise model."""
    axis = fit.axis
    weight = axis.bins.expand_to_coefficients(axis.used_bins / np.sqrt(fit.whittle.variance))
    whitened = fit.coefficients_without_deterministic_effects() * weight
    _replace_by_noise(whitened, np.flatnonzero(weight == 0.0))  # a diagnostic would detect a gap in the spectrum
    return WhitenedAxis(fit, whitened, weight, inverse_cosine_transform(whitened), _flattened_series(fit, whitened))


def _flattened_series(fit: AxisFit, whitened: Floats) -> Floats:
    """Return the whitened series with unit power in each frequency bin.

    The flattened series has the tails and the variance of white noise, even if the spectrum of the model is wrong.
    """
    axis = fit.axis
    count, window = axis.bins.count, np.ones(SMOOTHING_BINS)
    sums = axis.bins.sum_over_bins(whitened**2)
    smoothed = np.convolve(sums, window, "same") / np.convolve(count, window, "same")
    power = np.where(count >= MIN_COEFFICIENTS_PER_BIN, sums / count, smoothed)
    flat = whitened * axis.bins.expand_to_coefficients(1.0 / np.sqrt(power))
    density = power * fit.whittle.variance
    _replace_by_noise(
        flat, np.flatnonzero(axis.bins.expand_to_coefficients(density) < MIN_DENSITY_RATIO * np.median(density))
    )
    _replace_by_noise(flat, np.arange(int(SLOW_BAND_FRACTION * axis.n)))
    return inverse_cosine_transform(flat) / relative_noise_deviation_over_time(fit)


def _replace_by_noise(coefficients: Floats, at: Ints) -> None:
    coefficients[at] = np.random.default_rng(at.size).standard_normal(at.size)


def relative_noise_deviation_over_time(fit: AxisFit) -> Floats:
    """Return the standard deviation of the white noise over time, shape (n,), relative to the root mean square."""
    deviation = np.ones(fit.axis.n)
    for effect in fit.effects:
        if isinstance(effect, NoiseStep):
            deviation[min(first_sample_at_or_after(effect.time, fit.axis.rate_hz), fit.axis.n) :] *= effect.ratio
    return np.asarray(deviation / np.sqrt(np.mean(deviation**2)))
