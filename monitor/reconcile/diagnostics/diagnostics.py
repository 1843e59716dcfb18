"""Diagnostics: functions that measure how far an axis differs from a model, for measured and simulated recordings
alike.

A diagnostic takes a ``WhitenedAxis``: an axis whitened by a model. If the model is true, the whitened coefficients are
independent with variance one, and so are the samples of the whitened series. Each diagnostic tests one kind of
departure from this. It returns the largest gain in ln L, in nats, that such a departure would bring at one place,
together with the place. The gains of a true model are nearly the same for every model and every length. The thresholds
in ``gap`` rely on this.

The diagnostics are deterministic and do not change their input.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from typing import Final

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from drivers.sample import Floats
from monitor.noise.effect import first_sample
from monitor.noise.effects import (
    NoiseStep,
    PoissonSteps,
    RandomTelegraph,
    RateRamp,
    Resolution,
    SampleHold,
    Saturation,
    TemperatureBias,
    TemperatureLag,
    TurnOnTransient,
)
from monitor.reconcile.likelihood.outlier_statistics import OutlierFit, fit_outliers
from monitor.reconcile.likelihood.variance_history import (
    SpectrogramExtremes,
    VarianceHistory,
    find_least_constant_tiles,
    fit_variance_history,
)
from monitor.reconcile.preparation.axis import Axis, Effects, Likely
from monitor.reconcile.preparation.cosine_bins import frequency_bins as even_bins
from monitor.reconcile.preparation.cosine_bins import inverse_cosine_transform
from monitor.reconcile.result import Location

MAX_LAG_SAMPLES: Final = 64
"""Number of lags of the autocorrelation, in samples."""
TRANSIENT_TIME_FRACTIONS: Final = 0.3 / 3.0 ** np.arange(6)
"""Time constants of transients, as fractions of the recording."""
TEMPERATURE_DELAYS_S: Final = (10.0, 30.0, 90.0, 270.0, 810.0)
"""Time constants of delayed temperature effects, in seconds."""
SLOW_BAND_FRACTION: Final = 0.01
"""Fraction of the band that is ignored for tails and variance. Low frequencies contain no information about them and
are the first that a model describes wrongly.
"""
MIN_COEFFICIENTS_PER_BIN: Final = 64
"""Number of coefficients whose power is known to a sixth. Bins with fewer coefficients are averaged over
``SMOOTHING_BINS`` bins.
"""
SMOOTHING_BINS: Final = 9
"""Number of bins that are averaged if one bin has too few coefficients."""
STEP_MARGIN_FRACTION: Final = 0.001
"""Fraction of the recording at each end in which no step is sought, because the ends of a recording affect the
spectrum.
"""
MIN_DENSITY_RATIO: Final = 1e-3
"""Smallest density relative to the median bin. A stop band contains no information about single samples."""


@dataclass(frozen=True, slots=True)
class WhitenedAxis:
    """Axis whitened by a model."""

    axis: Axis
    likely: Likely
    whitened: Floats  # [n − 1] coefficients divided by their standard deviation; random draws in stop bands
    weight: Floats  # [n − 1] inverse of the standard deviation; 0 in stop bands
    white: Floats  # [n] series of the whitened coefficients
    fast: Floats  # [n] the same without low frequencies and with each bin at unit power, for tails and variance

    @property
    def course(self) -> VarianceHistory:
        """Variance of the whitened series as a function of time."""
        return fit_variance_history(self.fast, 1.0 / self.axis.rate_hz)

    @property
    def outliers(self) -> OutlierFit | None:
        """Outlier statistics of the whitened series, or None if a Gaussian fits no worse."""
        return fit_outliers(self.fast)


@dataclass(frozen=True, slots=True)
class Finding:
    """Strongest departure that a diagnostic detects."""

    gain: float  # log-likelihood gain, nats
    where: Location


Diagnostic = Callable[[WhitenedAxis], Finding]
"""Function that measures one kind of departure."""


def whiten_axis(axis: Axis, likely: Likely) -> WhitenedAxis:
    """Whiten an axis by a fitted model.

    Parameters
    ----------
    axis : Axis
        Axis to whiten.
    likely : Likely
        Fitted effects of the axis.
    """
    weight = axis.bins.spread(axis.used_bins / np.sqrt(likely.fitted.variance))
    whitened = axis.residual(likely) * weight
    silent = np.flatnonzero(weight == 0.0)
    # a gap in the spectrum would itself be detected
    whitened[silent] = np.random.default_rng(silent.size).standard_normal(silent.size)
    return WhitenedAxis(
        axis, likely, whitened, weight, inverse_cosine_transform(whitened), _flattened_series(axis, likely, whitened)
    )


def _flattened_series(axis: Axis, likely: Likely, whitened: Floats) -> Floats:
    """Return the whitened series with the fitted power of each bin removed.

    For any spectrum, its tails and variance are then those of white noise.
    """
    count, together = axis.bins.count, np.ones(SMOOTHING_BINS)
    sums = axis.bins.sums(whitened**2)
    around = np.convolve(sums, together, "same") / np.convolve(count, together, "same")
    power = np.where(count >= MIN_COEFFICIENTS_PER_BIN, sums / count, around)
    flat = whitened * axis.bins.spread(1.0 / np.sqrt(power))
    density = power * likely.fitted.variance
    silent = np.flatnonzero(axis.bins.spread(density) < MIN_DENSITY_RATIO * np.median(density))
    flat[silent] = np.random.default_rng(silent.size).standard_normal(silent.size)
    slow = int(SLOW_BAND_FRACTION * axis.n)
    flat[:slow] = np.random.default_rng(slow).standard_normal(slow)  # replaced for the same reason
    return inverse_cosine_transform(flat) / noise_deviation_over_time(likely.effects, axis.n, axis.rate_hz)


def noise_deviation_over_time(effects: Effects, n: int, rate_hz: float) -> Floats:
    """Return the standard deviation of the white noise as a function of time, according to the noise steps of the axis.

    Parameters
    ----------
    effects : tuple of Effect
        Effects of the axis.
    n : int
        Number of samples.
    rate_hz : float
        Sample rate in Hz.

    Returns
    -------
    ndarray of float64, shape (n,)
        Standard deviation divided by its root mean square.
    """
    course = np.ones(n)
    for effect in effects:
        if isinstance(effect, NoiseStep):
            course[min(first_sample(effect.time, rate_hz), n) :] *= effect.ratio
    return np.asarray(course / np.sqrt(np.mean(course**2)))


def diagnose_psd(seen: WhitenedAxis) -> Finding:
    """Find the range of frequency bins, of any width, whose power differs most from its expectation."""
    bins = even_bins(seen.axis.n, seen.axis.rate_hz)  # the same bins for recordings with and without peaks
    power = np.concatenate([[0.0], np.cumsum(bins.sums(seen.whitened**2))])
    count = np.concatenate([[0.0], np.cumsum(bins.count)])
    best, place = 0.0, (0, 1)
    width = 1
    while width <= bins.count.size:
        step = max(1, width // 4)
        first = np.arange(0, bins.count.size - width + 1, step)
        c = count[first + width] - count[first]
        gains = power_gain((power[first + width] - power[first]) / c, c)
        at = int(np.argmax(gains))
        if gains[at] > best:
            best, place = float(gains[at]), (int(first[at]), int(first[at]) + width)
        width *= 2
    lo, hi = bins.f_hz[place[0]], bins.f_hz[place[1] - 1]
    return Finding(best, Location(frequency=(float(lo), float(hi))))


def power_gain(ratio: Floats, count: Floats) -> Floats:
    """Return the log-likelihood gain of a free variance: n/2 (ρ − 1 − ln ρ).

    Parameters
    ----------
    ratio : ndarray of float64, shape (k,)
        Mean square of the coefficients.
    count : ndarray of float64, shape (k,)
        Number of coefficients.

    Returns
    -------
    ndarray of float64, shape (k,)
        Gain in nats.
    """
    safe = np.maximum(ratio, 1e-300)
    return np.asarray(0.5 * count * (safe - 1.0 - np.log(safe)))


def diagnose_lines(seen: WhitenedAxis) -> Finding:
    """Find a steady oscillation: the largest value of the periodogram at twice the usual resolution."""
    found = find_line_peaks(seen.white, seen.axis.rate_hz, 1)
    gain, f_hz = found[0]
    half = seen.axis.rate_hz / seen.axis.n
    return Finding(gain, Location(frequency=(f_hz - half, f_hz + half)))


def find_line_peaks(white: Floats, rate_hz: float, most: int) -> list[tuple[float, float]]:
    """Return the largest peaks of the periodogram, strongest first and separated from each other.

    Parameters
    ----------
    white : ndarray of float64, shape (n,)
        Whitened series.
    rate_hz : float
        Sample rate in Hz.
    most : int
        Largest number of peaks.

    Returns
    -------
    list of tuple of float
        Gain in nats and frequency in Hz of each peak.
    """
    power = periodogram(white)
    size = 2 * (power.size - 1)
    found = []
    for _ in range(most):
        at = int(np.argmax(power))
        if power[at] <= 0.0:
            break
        found.append((float(power[at]), at * rate_hz / size))
        power[max(at - 12, 0) : at + 13] = 0.0
    return found


def periodogram(white: Floats) -> Floats:
    """Return the gain in nats of a line at frequencies from 0 to half the sample rate, shape (m + 1,).

    The frequencies are at least twice as dense as in a transform without zero padding.
    """
    n = white.size
    size = next_fast_len(2 * n, real=True)
    size += size % 2
    turned = rfft(white, size)
    power = (turned.real**2 + turned.imag**2) / n
    power[: 2 * size // n] = 0.0  # less than one cycle in the recording
    power[-2:] = 0.0
    return np.asarray(power)


def diagnose_level(seen: WhitenedAxis) -> Finding:
    """Find a change of the level: a step at any time, a slope, or a transient after the start.

    If the model itself contains jumps, a change of the level is no evidence, because whitening does not remove jumps.
    """
    if any(isinstance(effect, (PoissonSteps, RandomTelegraph)) for effect in seen.likely.effects):
        return Finding(0.0, Location())
    gains, times_s = step_gains(seen)
    at = int(np.argmax(gains))
    best = Finding(float(gains[at]), Location(time=(float(times_s[at]), float(times_s[at]))))
    axis = seen.axis
    length_s = axis.n / axis.rate_hz
    for share in TRANSIENT_TIME_FRACTIONS:
        effect = TurnOnTransient(amplitude=1.0, time_constant=float(share * length_s))
        gain = regressor_gain(seen, axis.columns(effect))
        if gain > best.gain:
            best = Finding(gain, Location(time=(0.0, effect.time_constant)))
    ramp = axis.columns(RateRamp(R=1.0))
    gain = max(regressor_gain(seen, ramp), regressor_gain(seen, [*ramp, axis.courses.curve]) - 1.0)
    return max(best, Finding(gain, Location(time=(0.0, length_s))), key=lambda one: one.gain)


def step_gains(seen: WhitenedAxis) -> tuple[Floats, Floats]:
    """Return the gain of a step at each time, by two Fourier transforms.

    The coefficients of a step at sample s are −√(2/n) sin(πks/n)/(2 sin(πk/2n)). Its squared length under the weights W
    is Σ W_k (1 − cos(2πks/n))/(4n sin²(πk/2n)), which is one Fourier transform. Its product with the data is a running
    sum.

    Parameters
    ----------
    seen : Sight
        Whitened axis.

    Returns
    -------
    gains : ndarray of float64, shape (k,)
        Gain in nats.
    times : ndarray of float64, shape (k,)
        Time of the step in seconds from the start.
    """
    axis = seen.axis
    n = axis.n
    weighted = inverse_cosine_transform(seen.whitened * seen.weight)
    product = np.cumsum(weighted[::-1])[::-1]  # [n] product of the data with a step at each sample
    u = np.zeros(n)
    u[1:] = seen.weight**2 * axis.courses.steps
    cosines = rfft(u).real  # for s up to n/2; the values beyond are the mirror image
    length = u.sum() - np.concatenate([cosines, cosines[1 : n - cosines.size + 1][::-1]])
    margin = ceil(STEP_MARGIN_FRACTION * n)
    inside = slice(margin, n - margin)
    gains = 0.5 * product[inside] ** 2 / np.maximum(length[inside], 1e-300)
    return gains, np.arange(n)[inside] / axis.rate_hz


def regressor_gain(seen: WhitenedAxis, columns: list[Floats]) -> float:
    """Return the log-likelihood gain in nats of regressors with free sizes.

    Parameters
    ----------
    seen : Sight
        Whitened axis.
    columns : list of ndarray of float64, shape (n − 1,)
        Transforms of the regressors.
    """
    stacked = np.stack([column * seen.weight for column in columns])
    normal, right = stacked @ stacked.T, stacked @ seen.whitened
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    solved, *_ = np.linalg.lstsq(normal / np.outer(scale, scale), right / scale, rcond=1e-9)
    return float(0.5 * solved @ (right / scale))


def diagnose_autocorrelation(seen: WhitenedAxis) -> Finding:
    """Find the lag at which the whitened series is most strongly correlated with itself."""
    n = seen.white.size
    turned = rfft(seen.white, next_fast_len(n + MAX_LAG_SAMPLES, real=True))
    products = irfft(turned.real**2 + turned.imag**2, next_fast_len(n + MAX_LAG_SAMPLES, real=True))[
        1 : MAX_LAG_SAMPLES + 1
    ]
    gains = 0.5 * (products / n) ** 2 * n
    at = int(np.argmax(gains))
    lag_s = (at + 1) / seen.axis.rate_hz
    return Finding(float(gains[at]), Location(tau=(lag_s, lag_s)))


def diagnose_temperature(seen: WhitenedAxis) -> Finding:
    """Find a dependence of the level on the temperature, with and without delay."""
    warmth = seen.axis.temperature_c
    if warmth is None:
        return Finding(0.0, Location())
    reference = float(warmth.mean())
    place = Location(temperature=(float(warmth.min()), float(warmth.max())))
    best = regressor_gain(seen, seen.axis.columns(TemperatureBias(coefficient=1.0, reference=reference, quadratic=1.0)))
    best = max(
        best - 1.0, regressor_gain(seen, seen.axis.columns(TemperatureBias(coefficient=1.0, reference=reference)))
    )
    for delay_s in TEMPERATURE_DELAYS_S:
        lag = TemperatureLag(coefficient=1.0, reference=reference, time_constant=delay_s)
        best = max(best, regressor_gain(seen, seen.axis.columns(lag)))
    return Finding(best, place)


def diagnose_other_axes(seen: WhitenedAxis) -> Finding:
    """Find the axis that leaks most strongly into this axis."""
    best = Finding(0.0, Location())
    for name, coefficients in seen.axis.others.items():
        gain = regressor_gain(seen, [coefficients])
        if gain > best.gain:
            best = Finding(gain, Location(source=name))
    return best


def diagnose_variance(seen: WhitenedAxis) -> Finding:
    """Find a variation of the noise variance in time: a step, a trend, a period or a slow random variation."""
    found = seen.course
    gain = max(found.step.gain, found.trend, found.periodic.gain, found.wander)
    return Finding(gain, Location(time=(found.step.time.lo, found.step.time.hi)))


def diagnose_spectrogram(seen: WhitenedAxis) -> Finding:
    """Find the place in time and frequency whose power is least constant: a rectangle or a whole row."""
    found = least_constant_tiles(seen)
    if found.gain >= found.row_gain:
        return Finding(found.gain, Location(time=found.time, frequency=found.frequency))
    return Finding(found.row_gain, Location(frequency=found.row))


def least_constant_tiles(seen: WhitenedAxis) -> SpectrogramExtremes:
    """Return the least constant rectangle and row of the spectrogram, corrected for the noise steps of the axis."""
    axis = seen.axis
    return find_least_constant_tiles(
        seen.white / noise_deviation_over_time(seen.likely.effects, axis.n, axis.rate_hz), 1.0 / axis.rate_hz
    )


def diagnose_tails(seen: WhitenedAxis) -> Finding:
    """Find outliers in the distribution of the samples."""
    found = seen.outliers
    return Finding(found.gain if found else 0.0, Location())


def diagnose_values(seen: WhitenedAxis) -> Finding:
    """Find quantization, clipping or repeats in the measured values that the model does not contain."""
    have = {type(effect) for effect in seen.likely.effects}
    shown = seen.axis.shown
    best = Finding(0.0, Location())
    for kind, found in ((Resolution, shown.levels), (Saturation, shown.clipped), (SampleHold, shown.repeats)):
        if found is not None and kind not in have and found.gain > best.gain:
            best = Finding(found.gain, Location())
    if best.gain and shown.clipped is not None and best.gain == shown.clipped.gain:
        return Finding(best.gain, Location(value=(shown.clipped.limit.lo, shown.clipped.limit.hi)))
    return best


DIAGNOSTICS: Final[dict[str, Diagnostic]] = {
    "values": diagnose_values,
    "psd": diagnose_psd,
    "lines": diagnose_lines,
    "autocorrelation": diagnose_autocorrelation,
    "level": diagnose_level,
    "temperature": diagnose_temperature,
    "other_axes": diagnose_other_axes,
    "tails": diagnose_tails,
    "variance": diagnose_variance,
    "spectrogram": diagnose_spectrogram,
}
"""Diagnostics by name, in the order of the report."""
