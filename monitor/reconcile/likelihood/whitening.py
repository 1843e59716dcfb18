"""Whitening of an axis by a fitted model.

If the model is true, the whitened coefficients are independent with variance one, and so are the samples of the
whitened series. All diagnostics work on a ``WhitenedAxis``.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.noise.effect import Effect, first_sample_index
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
"""Fraction of the frequency range, from zero, that the tests of tails and variance ignore. A model describes low
frequencies less accurately, and they contain little information about single samples.
"""
MIN_COEFFICIENTS_PER_BIN: Final = 64
"""Number of coefficients whose mean power has a standard error of 18 %. The power of smaller bins is averaged over
``SMOOTHING_BINS`` bins.
"""
SMOOTHING_BINS: Final = 9
"""Number of bins over which the power of a small bin is averaged."""
MIN_DENSITY_RATIO: Final = 1e-3
"""Smallest density of a bin relative to the median. Bins with less are stop bands without information about samples."""


@dataclass(frozen=True, eq=False)
class WhitenedAxis:
    """Axis whitened by a model."""

    fit: AxisFit
    coefficients: Floats  # [n − 1] coefficients divided by the standard deviation; random draws in stop bands
    weights: Floats  # [n − 1] inverse of the standard deviation; 0 in stop bands
    series: Floats  # [n] series of the whitened coefficients
    flat_series: Floats  # [n] series with unit power in each bin and random draws at low frequencies

    @property
    def axis(self) -> Axis:
        """Axis that was whitened."""
        return self.fit.axis

    @property
    def effects(self) -> Effects:
        """Fitted effects by which the axis was whitened."""
        return self.fit.effects

    @property
    def effect_types(self) -> set[type[Effect]]:
        """Types of the fitted effects."""
        return {type(effect) for effect in self.effects}

    @cached_property
    def variance_changes(self) -> VarianceChangeFit:
        """Changes of the variance of the flattened series over time."""
        return fit_variance_changes(self.flat_series, 1.0 / self.axis.rate_hz)

    @cached_property
    def spectrogram_change(self) -> SpectrogramChange:
        """Least constant tile and row of the spectrogram, after the noise steps of the model are removed."""
        series = self.series / relative_noise_deviation_over_time(self.fit)
        return find_spectrogram_change(series, 1.0 / self.axis.rate_hz)

    @cached_property
    def outlier_fit(self) -> OutlierFit | None:
        """Outliers of the flattened series, or None if a Gaussian fits as well as a mixture."""
        return fit_outliers(self.flat_series)


def whiten_axis(fit: AxisFit) -> WhitenedAxis:
    """Whiten an axis by a fitted model."""
    axis = fit.axis
    weight = axis.bins.expand_to_coefficients(axis.used_bins / np.sqrt(fit.whittle.variance))
    whitened = fit.coefficients_without_deterministic_effects() * weight
    _replace_by_noise(whitened, np.flatnonzero(weight == 0.0))  # a diagnostic would detect a gap in the spectrum
    return WhitenedAxis(fit, whitened, weight, inverse_cosine_transform(whitened), _flattened_series(fit, whitened))


def _flattened_series(fit: AxisFit, whitened: Floats) -> Floats:
    """Return the whitened series, rescaled to unit power in each bin.

    The result has the tails and the variance of white noise, even if the spectrum of the model is wrong.
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
    """Replace the coefficients at the given indices by white noise. The seed is the number of indices."""
    coefficients[at] = np.random.default_rng(at.size).standard_normal(at.size)


def relative_noise_deviation_over_time(fit: AxisFit) -> Floats:
    """Return the relative standard deviation over time, shape (n,), of white noise with the noise steps of a fit."""
    deviation = np.ones(fit.axis.n)
    for effect in fit.effects:
        if isinstance(effect, NoiseStep):
            deviation[min(first_sample_index(effect.time, fit.axis.rate_hz), fit.axis.n) :] *= effect.ratio
    return np.asarray(deviation / np.sqrt(np.mean(deviation**2)))
