"""Whitening of an axis with a fitted noise model.

If the model is true, the whitened coefficients are independent and have a variance of one.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy.fft import next_fast_len, rfft

from drivers.data_types import Floats, Ints
from monitor.noise.effect import Effect, WhiteNoiseGain
from monitor.noise.effects import HeavyTails, WanderingVariance
from monitor.reconcile.likelihood.axis_fit import Axis, AxisFit, Effects
from monitor.reconcile.likelihood.outlier_fit import OutlierFit, convert_student_to_gaussian, fit_outliers
from monitor.reconcile.likelihood.periodic_pulse_search import HarmonicSeries, Pulses, find_harmonic_series, fit_pulses
from monitor.reconcile.likelihood.variance_change_tests import (
    SpectrogramChange,
    VarianceChangeGains,
    compare_variance_change_forms,
    find_spectrogram_change,
)
from monitor.reconcile.likelihood.wandering_variance_fit import (
    FittedWanderingVariance,
    estimate_wandering_std,
    fit_wandering_variance,
)
from monitor.reconcile.preparation.cosine_bins import inverse_cosine_transform

SLOW_BAND_FRACTION: Final = 0.01
"""Fraction of the frequency range, from zero, that the tests for outliers and variance changes ignore.
"""
MIN_NOISE_GAIN: Final = 1e-3
"""Lower limit of the gain of the white noise. A series is divided by this gain."""
MIN_DENSITY_RATIO: Final = 1e-3
"""Smallest spectral density of a bin relative to the median. Bins below this limit are stop bands."""


@dataclass(frozen=True, eq=False)
class WhitenedAxis:
    """Axis whitened with a fitted noise model."""

    fit: AxisFit
    coefficients: Floats  # [n − 1] coefficients divided by the standard deviation; random draws in stop bands
    weights: Floats  # [n − 1] inverse of the standard deviation; 0 in stop bands

    @cached_property
    def series(self) -> Floats:
        """Series of the whitened coefficients, shape (n,)."""
        return inverse_cosine_transform(self.coefficients)

    @cached_property
    def flat_series(self) -> Floats:
        """Series with unit power in each bin and random draws at low frequencies, shape (n,)."""
        return _flattened_series(self.fit, self.coefficients)

    @cached_property
    def periodogram(self) -> Floats:
        """Periodogram of the series with zero padding, shape (m + 1,)."""
        return compute_periodogram(self.series)

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
    def harmonic_series(self) -> HarmonicSeries:
        """Strongest harmonics of one frequency in the periodogram."""
        return find_harmonic_series(self.periodogram, self.axis.n, self.axis.rate_hz)

    @cached_property
    def pulses(self) -> Pulses | None:
        """Rectangular pulses near the frequency of the strongest harmonics."""
        return fit_pulses(self.series, self.axis.rate_hz, self.harmonic_series)

    @cached_property
    def variance_changes(self) -> VarianceChangeGains:
        """Changes of the variance of the flattened series."""
        return compare_variance_change_forms(self.flat_series, 1.0 / self.axis.rate_hz)

    @cached_property
    def wandering_variance(self) -> FittedWanderingVariance | None:
        """Fit of a random variation of the variance to the flattened series, or None if the recording is too short."""
        return fit_wandering_variance(self.flat_series, 1.0 / self.axis.rate_hz)

    @cached_property
    def unexplained_spectrogram_change(self) -> SpectrogramChange:
        """Largest change of power in the spectrogram that the model does not explain."""
        return find_spectrogram_change(_with_constant_gaussian_noise(self.series, self.fit), 1.0 / self.axis.rate_hz)

    @cached_property
    def outlier_fit(self) -> OutlierFit | None:
        """Fit of outliers to the flattened series, or None if a Gaussian fits as well or the values are too coarse."""
        return None if self.axis.value_artifacts.is_too_coarse_for_outliers else fit_outliers(self.flat_series)


def whiten_axis(fit: AxisFit) -> WhitenedAxis:
    """Whiten an axis with a fitted noise model."""
    axis = fit.axis
    weight = axis.bins.expand_to_coefficients(axis.used_bins / np.sqrt(fit.whittle.variance))
    whitened = fit.cosine_transform_without_deterministic_effects() * weight
    _replace_by_noise(whitened, np.flatnonzero(weight == 0.0))  # a diagnostic would detect a gap in the spectrum
    return WhitenedAxis(fit, whitened, weight)


def compute_periodogram(whitened_series: Floats) -> Floats:
    """Compute the periodogram of a whitened series, with zero padding to at least twice the length.

    Each value is the log-likelihood gain, in nats, of a spectral line. The m + 1 frequencies are equally spaced from 0
    to half the sample rate. The computation has 32-bit precision.
    """
    n = whitened_series.size
    size = next_fast_len(2 * n, real=True)
    turned = rfft(whitened_series.astype(np.float32), size + size % 2)
    return np.asarray((turned.real**2 + turned.imag**2) / np.float32(n))


def _flattened_series(fit: AxisFit, whitened: Floats) -> Floats:
    """Return the whitened series with unit power in each frequency bin and without known heavy tails.

    The flattened series has the tails and the variance of white noise, even if the spectrum of the model is wrong.
    """
    axis = fit.axis
    power = axis.bins.smoothed_mean_square(whitened)
    flat = whitened * axis.bins.expand_to_coefficients(1.0 / np.sqrt(power))
    density = power * fit.whittle.variance
    stopped = density < MIN_DENSITY_RATIO * np.median(density)
    if stopped.any():
        _replace_by_noise(flat, np.flatnonzero(axis.bins.expand_to_coefficients(stopped.astype(np.float64))))
    _replace_by_noise(flat, np.arange(int(SLOW_BAND_FRACTION * axis.n)))
    return _with_constant_gaussian_noise(inverse_cosine_transform(flat), fit)


def _with_constant_gaussian_noise(whitened: Floats, fit: AxisFit) -> Floats:
    """Remove the variance changes and the heavy tails of the model from a whitened series, shape (n,)."""
    series = whitened / relative_noise_std_over_time(fit)
    for effect in fit.effects:
        if isinstance(effect, WanderingVariance):
            series = series / estimate_wandering_std(
                series, 1.0 / fit.axis.rate_hz, effect.deviation, effect.correlation_time
            )
        if isinstance(effect, HeavyTails):
            series = convert_student_to_gaussian(series, effect.nu)
    return np.asarray(series)


def _replace_by_noise(coefficients: Floats, at: Ints) -> None:
    coefficients[at] = np.random.default_rng(at.size).standard_normal(at.size)


def relative_noise_std_over_time(fit: AxisFit) -> Floats:
    """Return the standard deviation of the white noise over time, shape (n,), relative to the root mean square."""
    if not any(isinstance(effect, WhiteNoiseGain) for effect in fit.effects):
        return np.ones(fit.axis.n)
    deviation = np.maximum(fit.axis.white_noise_gain_over_time(fit.effects), MIN_NOISE_GAIN)
    return np.asarray(deviation / np.sqrt(np.mean(deviation**2)))
