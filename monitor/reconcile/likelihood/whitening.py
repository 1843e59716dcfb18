"""Whitening of an axis by a fitted model.

If the model is true, the whitened coefficients are independent with variance one, and so are the samples of the
whitened series. All diagnostics work on a ``WhitenedAxis``.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from drivers.sample import Floats, Ints
from monitor.noise.effect import Effect, first_sample_index
from monitor.noise.effects import NoiseStep
from monitor.reconcile.likelihood.axis import Axis, AxisFit, Effects
from monitor.reconcile.likelihood.outlier_statistics import OutlierFit, fit_outliers
from monitor.reconcile.likelihood.variance_history import VarianceChangeFit, fit_variance_changes
from monitor.reconcile.preparation.cosine_bins import inverse_cosine_transform

SLOW_BAND_FRACTION: Final = 0.01
"""Fraction of the band that is ignored for tails and variance. Low frequencies contain no information about them, and a
model describes low frequencies less accurately.
"""
MIN_COEFFICIENTS_PER_BIN: Final = 64
"""Number of coefficients whose power is known to a sixth. Bins with fewer coefficients are averaged over
``SMOOTHING_BINS`` bins.
"""
SMOOTHING_BINS: Final = 9
"""Number of bins that are averaged if one bin has too few coefficients."""
MIN_DENSITY_RATIO: Final = 1e-3
"""Smallest density relative to the median bin. A stop band contains no information about single samples."""


@dataclass(frozen=True, eq=False)
class WhitenedAxis:
    """Axis whitened by a model."""

    fit: AxisFit
    coefficients: Floats  # [n − 1] coefficients divided by their standard deviation; random draws in stop bands
    weights: Floats  # [n − 1] inverse of the standard deviation; 0 in stop bands
    series: Floats  # [n] series of the whitened coefficients
    flat_series: Floats  # [n] the same without low frequencies and with each bin at unit power, for tails and variance

    @property
    def axis(self) -> Axis:
        """Axis that was whitened."""
        return self.fit.axis

    @property
    def effects(self) -> Effects:
        """Fitted effects by which the axis was whitened."""
        return self.fit.effects

    @property
    def types(self) -> set[type[Effect]]:
        """Types of these effects."""
        return {type(effect) for effect in self.effects}

    @cached_property
    def variance_changes(self) -> VarianceChangeFit:
        """Variance of the whitened series as a function of time."""
        return fit_variance_changes(self.flat_series, 1.0 / self.axis.rate_hz)

    @cached_property
    def outliers(self) -> OutlierFit | None:
        """Outlier statistics of the whitened series, or None if a Gaussian fits no worse."""
        return fit_outliers(self.flat_series)


def whiten_axis(fit: AxisFit) -> WhitenedAxis:
    """Whiten an axis by a fitted model."""
    axis = fit.axis
    weight = axis.bins.spread(axis.used_bins / np.sqrt(fit.whittle.variance))
    whitened = fit.residual_coefficients() * weight
    _replace_by_noise(whitened, np.flatnonzero(weight == 0.0))  # a gap in the spectrum would itself be detected
    return WhitenedAxis(fit, whitened, weight, inverse_cosine_transform(whitened), _flattened_series(fit, whitened))


def _flattened_series(fit: AxisFit, whitened: Floats) -> Floats:
    """Return the whitened series with the fitted power of each bin removed.

    For any spectrum, its tails and variance are then those of white noise.
    """
    axis = fit.axis
    count, window = axis.bins.count, np.ones(SMOOTHING_BINS)
    sums = axis.bins.sums(whitened**2)
    smoothed = np.convolve(sums, window, "same") / np.convolve(count, window, "same")
    power = np.where(count >= MIN_COEFFICIENTS_PER_BIN, sums / count, smoothed)
    flat = whitened * axis.bins.spread(1.0 / np.sqrt(power))
    density = power * fit.whittle.variance
    _replace_by_noise(flat, np.flatnonzero(axis.bins.spread(density) < MIN_DENSITY_RATIO * np.median(density)))
    _replace_by_noise(flat, np.arange(int(SLOW_BAND_FRACTION * axis.n)))
    return inverse_cosine_transform(flat) / noise_deviation_over_time(fit)


def _replace_by_noise(coefficients: Floats, at: Ints) -> None:
    """Replace coefficients by white noise, always the same for the same number of coefficients."""
    coefficients[at] = np.random.default_rng(at.size).standard_normal(at.size)


def noise_deviation_over_time(fit: AxisFit) -> Floats:
    """Return the relative standard deviation, shape (n,), of the white noise with the noise steps of a fit."""
    deviation = np.ones(fit.axis.n)
    for effect in fit.effects:
        if isinstance(effect, NoiseStep):
            deviation[min(first_sample_index(effect.time, fit.axis.rate_hz), fit.axis.n) :] *= effect.ratio
    return np.asarray(deviation / np.sqrt(np.mean(deviation**2)))
