"""Diagnostic tests for departures of a whitened axis from white noise.

Each diagnostic returns a ``Finding``, which contains the location and the log-likelihood gain of the strongest
departure. If the noise model is true, the gain has nearly the same distribution for every model and recording length.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from typing import Final

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from drivers.data_types import Floats
from monitor.noise.effects import (
    PoissonSteps,
    RandomSampleHold,
    RandomTelegraph,
    RateRamp,
    Resolution,
    Saturation,
    TemperatureBias,
    TemperatureLag,
    TurnOnTransient,
)
from monitor.reconcile.likelihood.whitening import WhitenedAxis
from monitor.reconcile.preparation.cosine_bins import build_frequency_bins, inverse_cosine_transform
from monitor.reconcile.result import Location

MAX_LAG_SAMPLES: Final = 64
"""Largest lag of the autocorrelation, in samples."""
TRANSIENT_TIME_FRACTIONS: Final = 0.3 / 3.0 ** np.arange(6)
TEMPERATURE_DELAYS_S: Final = (10.0, 30.0, 90.0, 270.0, 810.0)
STEP_MARGIN_FRACTION: Final = 0.001
"""Fraction of the recording, at each end, in which steps are not detected.
"""
CURVE_PENALTY_NATS: Final = 1.0
"""Penalty for the additional parameter of a quadratic term, in nats."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Strongest departure from white noise that a diagnostic finds."""

    gain: float  # log-likelihood gain, nats
    where: Location


NO_FINDING: Final = Finding(0.0, Location())
"""Finding of a diagnostic that cannot be applied to an axis."""
Diagnostic = Callable[[WhitenedAxis], Finding]
"""Function that tests a whitened axis for one kind of departure from white noise."""


def diagnose_psd(whitened: WhitenedAxis) -> Finding:
    """Find the frequency range in which the power differs most from the noise model."""
    bins = build_frequency_bins(
        whitened.axis.n, whitened.axis.rate_hz
    )  # the same bins for recordings with and without peaks
    power = np.concatenate([[0.0], np.cumsum(bins.sum_over_bins(whitened.coefficients**2))])
    count = np.concatenate([[0.0], np.cumsum(bins.count)])
    best, place = 0.0, (0, 1)
    width = 1
    while width <= bins.count.size:
        first = np.arange(0, bins.count.size - width + 1, max(1, width // 4))
        c = count[first + width] - count[first]
        gains = fitted_variance_gain_nats((power[first + width] - power[first]) / c, c)
        at = int(np.argmax(gains))
        if gains[at] > best:
            best, place = float(gains[at]), (int(first[at]), int(first[at]) + width)
        width *= 2
    lo, hi = bins.f_hz[place[0]], bins.f_hz[place[1] - 1]
    return Finding(best, Location(frequency=(float(lo), float(hi))))


def fitted_variance_gain_nats(mean_square: Floats, count: Floats) -> Floats:
    """Return the log-likelihood gain n/2 (ρ − 1 − ln ρ) of a fitted variance over a variance of one.

    Parameters
    ----------
    mean_square : ndarray of float64, shape (k,)
        Mean square ρ of the coefficients.
    count : ndarray of float64, shape (k,)
        Number n of coefficients.

    Returns
    -------
    ndarray of float64, shape (k,)
        Log-likelihood gain in nats.
    """
    safe = np.maximum(mean_square, 1e-300)
    return np.asarray(0.5 * count * (safe - 1.0 - np.log(safe)))


def diagnose_spectral_lines(whitened: WhitenedAxis) -> Finding:
    """Find the strongest spectral line in the periodogram of the whitened series."""
    found = find_periodogram_peaks(whitened.series, whitened.axis.rate_hz, 1)
    gain, f_hz = found[0]
    half = whitened.axis.rate_hz / whitened.axis.n
    return Finding(gain, Location(frequency=(f_hz - half, f_hz + half)))


def find_periodogram_peaks(whitened_series: Floats, rate_hz: float, max_peaks: int) -> list[tuple[float, float]]:
    """Find the largest separate peaks of the periodogram, in descending order.

    Parameters
    ----------
    whitened_series : ndarray of float64, shape (n,)
        Whitened series.
    rate_hz : float
        Sample rate in Hz.
    max_peaks : int
        Largest number of peaks.

    Returns
    -------
    list of tuple of float
        Log-likelihood gain in nats and frequency in Hz of each peak.
    """
    power = compute_periodogram(whitened_series)
    size = 2 * (power.size - 1)
    found = []
    for _ in range(max_peaks):
        at = int(np.argmax(power))
        if power[at] <= 0.0:
            break
        found.append((float(power[at]), at * rate_hz / size))
        power[max(at - 12, 0) : at + 13] = 0.0
    return found


def compute_periodogram(whitened_series: Floats) -> Floats:
    """Compute the periodogram of a whitened series, with zero padding to at least twice the length.

    Each value is the log-likelihood gain, in nats, of a spectral line. The m + 1 frequencies are equally spaced from 0
    to half the sample rate.
    """
    n = whitened_series.size
    size = next_fast_len(2 * n, real=True)
    size += size % 2
    turned = rfft(whitened_series, size)
    power = (turned.real**2 + turned.imag**2) / n
    power[: 2 * size // n] = 0.0  # less than one cycle in the recording
    power[-2:] = 0.0
    return np.asarray(power)


def diagnose_mean_level_change(whitened: WhitenedAxis) -> Finding:
    """Find a change of the mean level: a step, a slope, or a transient at the start.

    A model with random jumps is not tested, because whitening does not remove the jumps.
    """
    if any(isinstance(effect, (PoissonSteps, RandomTelegraph)) for effect in whitened.effects):
        return NO_FINDING
    axis = whitened.axis
    gains, times_s = compute_level_step_gains(whitened)
    at = int(np.argmax(gains))
    found = [Finding(float(gains[at]), Location(time=(float(times_s[at]), float(times_s[at]))))]
    for fraction in TRANSIENT_TIME_FRACTIONS:
        effect = TurnOnTransient(amplitude=1.0, time_constant=float(fraction * axis.length_s))
        found.append(
            Finding(
                _regressor_gain(whitened, axis.regressor_cosine_transforms(effect)),
                Location(time=(0.0, effect.time_constant)),
            )
        )
    ramp = axis.regressor_cosine_transforms(RateRamp(R=1.0))
    curved = _regressor_gain(whitened, [*ramp, axis.regressors.curvature]) - CURVE_PENALTY_NATS
    found.append(Finding(max(_regressor_gain(whitened, ramp), curved), Location(time=(0.0, axis.length_s))))
    return max(found, key=lambda one: one.gain)


def compute_level_step_gains(whitened: WhitenedAxis) -> tuple[Floats, Floats]:
    """Compute the log-likelihood gain of a step of the mean level at each time.

    A unit step at sample s has the cosine transform X_k = −√(2/n) sin(πks/n)/(2 sin(πk/2n)). A Fourier transform
    computes the weighted sums Σ W_k X_k² = Σ W_k (1 − cos(2πks/n))/(4n sin²(πk/2n)) for all s.

    Returns
    -------
        gains : ndarray of float64, shape (k,)
        Log-likelihood gain of a step at each time, in nats.
    times_s : ndarray of float64, shape (k,)
        Time of the step in seconds from the start.
    """
    axis = whitened.axis
    n = axis.n
    weighted = inverse_cosine_transform(whitened.coefficients * whitened.weights)
    product = np.cumsum(weighted[::-1])[::-1]  # [n] product of the data with a step at each sample
    u = np.zeros(n)
    u[1:] = whitened.weights**2 * axis.regressors.step_power
    cosines = rfft(u).real  # for s up to n/2; the values beyond are the mirror image
    square = u.sum() - np.concatenate([cosines, cosines[1 : n - cosines.size + 1][::-1]])
    margin = ceil(STEP_MARGIN_FRACTION * n)
    inside = slice(margin, n - margin)
    gains = 0.5 * product[inside] ** 2 / np.maximum(square[inside], 1e-300)
    return gains, np.arange(n)[inside] / axis.rate_hz


def _regressor_gain(whitened: WhitenedAxis, columns: list[Floats]) -> float:
    stacked = np.stack([column * whitened.weights for column in columns])
    normal, right = stacked @ stacked.T, stacked @ whitened.coefficients
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    solved, *_ = np.linalg.lstsq(normal / np.outer(scale, scale), right / scale, rcond=1e-9)
    return float(0.5 * solved @ (right / scale))


def diagnose_autocorrelation(whitened: WhitenedAxis) -> Finding:
    """Find the lag with the strongest autocorrelation of the whitened series."""
    gains = 0.5 * compute_autocorrelation(whitened.series) ** 2 * whitened.axis.n
    at = int(np.argmax(gains))
    lag_s = (at + 1) / whitened.axis.rate_hz
    return Finding(float(gains[at]), Location(tau=(lag_s, lag_s)))


def compute_autocorrelation(whitened_series: Floats) -> Floats:
    """Compute the autocorrelation of a whitened series at lags from 1 to ``MAX_LAG_SAMPLES`` samples."""
    size = next_fast_len(whitened_series.size + MAX_LAG_SAMPLES, real=True)
    transform = rfft(whitened_series, size)
    products = irfft(transform.real**2 + transform.imag**2, size)
    return np.asarray(products[1 : MAX_LAG_SAMPLES + 1] / whitened_series.size)


def diagnose_temperature_dependence(whitened: WhitenedAxis) -> Finding:
    """Find an immediate or delayed dependence of the sensor output on the temperature."""
    temperature_c = whitened.axis.temperature_c
    if temperature_c is None:
        return NO_FINDING
    reference = float(temperature_c.mean())

    def temperature_effect_gain(effect: TemperatureBias | TemperatureLag) -> float:
        return _regressor_gain(whitened, whitened.axis.regressor_cosine_transforms(effect))

    gains = [
        temperature_effect_gain(TemperatureBias(coefficient=1.0, reference=reference, quadratic=1.0))
        - CURVE_PENALTY_NATS,
        temperature_effect_gain(TemperatureBias(coefficient=1.0, reference=reference)),
        *(
            temperature_effect_gain(TemperatureLag(coefficient=1.0, reference=reference, time_constant=t))
            for t in TEMPERATURE_DELAYS_S
        ),
    ]
    return Finding(max(gains), Location(temperature=(float(temperature_c.min()), float(temperature_c.max()))))


def diagnose_leaks_from_other_axes(whitened: WhitenedAxis) -> Finding:
    """Find the axis that leaks most strongly into the whitened axis."""
    best = NO_FINDING
    for name, coefficients in whitened.axis.leak_sources.items():
        gain = _regressor_gain(whitened, [coefficients])
        if gain > best.gain:
            best = Finding(gain, Location(source=name))
    return best


def diagnose_variance_change(whitened: WhitenedAxis) -> Finding:
    """Find a change of the noise variance over time."""
    found = whitened.variance_changes
    gain = max(found.step.gain, found.largest_alternative_gain)
    return Finding(gain, Location(time=(found.step.time.lo, found.step.time.hi)))


def diagnose_spectrogram_change(whitened: WhitenedAxis) -> Finding:
    """Find the part of the spectrogram with the largest change of power over time."""
    found = whitened.spectrogram_change
    if found.gain >= found.row_gain:
        return Finding(found.gain, Location(time=found.time, frequency=found.frequency))
    return Finding(found.row_gain, Location(frequency=found.row))


def diagnose_outliers(whitened: WhitenedAxis) -> Finding:
    """Find outliers among the samples of the whitened series."""
    found = whitened.outlier_fit
    return Finding(found.gain if found else 0.0, Location())


def diagnose_quantization_clipping_repeats(whitened: WhitenedAxis) -> Finding:
    """Find quantization, clipping or repeated samples that the noise model does not contain."""
    statistics = whitened.axis.value_artifacts
    best = NO_FINDING
    for kind, found in (
        (Resolution, statistics.quantization),
        (Saturation, statistics.clipping),
        (RandomSampleHold, statistics.repeats),
    ):
        if found is not None and kind not in whitened.effect_types and found.gain > best.gain:
            best = Finding(found.gain, Location())
    if best.gain and statistics.clipping is not None and best.gain == statistics.clipping.gain:
        return Finding(best.gain, Location(value=(statistics.clipping.limit.lo, statistics.clipping.limit.hi)))
    return best


DIAGNOSTICS: Final[dict[str, Diagnostic]] = {
    "values": diagnose_quantization_clipping_repeats,
    "psd": diagnose_psd,
    "lines": diagnose_spectral_lines,
    "autocorrelation": diagnose_autocorrelation,
    "level": diagnose_mean_level_change,
    "temperature": diagnose_temperature_dependence,
    "other_axes": diagnose_leaks_from_other_axes,
    "tails": diagnose_outliers,
    "variance": diagnose_variance_change,
    "spectrogram": diagnose_spectrogram_change,
}
"""Diagnostics by name, in the order of the report."""
