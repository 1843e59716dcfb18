"""Diagnostic tests for departures of a whitened axis from white noise.

Each diagnostic returns a ``Finding``, which contains the location and the log-likelihood gain of the strongest
departure. If the noise model is true, the gain has nearly the same distribution for every model and recording length.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import ceil
from typing import Final

import numpy as np
from scipy.fft import rfft

from drivers.data_types import Floats
from monitor.common.compiled import compiled
from monitor.noise.effects import (
    BiasCurve,
    CommonVibration,
    CrossAxis,
    PoissonSteps,
    RandomSampleHold,
    RandomTelegraph,
    RateRamp,
    Resolution,
    Saturation,
    TemperatureBias,
    TemperatureHysteresis,
    TemperatureLag,
    TurnOnTransient,
)
from monitor.reconcile.likelihood.axis_fit import Regressor
from monitor.reconcile.likelihood.effect_roles import regressor_count
from monitor.reconcile.likelihood.variance_change_tests import count_variance_blocks
from monitor.reconcile.likelihood.whitening import WhitenedAxis
from monitor.reconcile.preparation.cosine_bins import SMOOTHING_BINS, build_frequency_bins, inverse_cosine_transform
from monitor.reconcile.result import Location

MAX_LAG_SAMPLES: Final = 64
"""Largest lag of the autocorrelation, in samples."""
AUTOCORRELATION_BANDS: Final = 4096
"""Largest number of frequency bands from which the autocorrelation is computed."""
FIRST_LINE_BIN: Final = 4
"""First bin of the periodogram that is searched for lines. Lower bins have less than two cycles in the recording."""
TRANSIENT_TIME_FRACTIONS: Final = 0.3 / 3.0 ** np.arange(6)
TEMPERATURE_DELAYS_S: Final = (10.0, 30.0, 90.0, 270.0, 810.0)
HYSTERESIS_FRACTIONS: Final = (0.05, 0.2)
"""Values of the parameter ``reversal`` of the tested hysteresis, as fractions of the temperature range."""
MAX_STEP_GRID: Final = 1 << 15
"""Number of times on a coarse grid for the weights of steps in a long recording."""
MAX_STEP_DIFFERENCE: Final = 0.01
"""Largest relative difference between the quantization step of the recording and of the model."""
STEP_MARGIN_FRACTION: Final = 0.001
"""Fraction of the recording, at each end, in which steps are not detected.
"""
CURVE_PENALTY_NATS: Final = 1.0
"""Penalty for each additional coefficient of a polynomial, in nats."""


@dataclass(frozen=True, slots=True)
class WhitenessDeparture:
    """Strongest departure from white noise that a diagnostic finds."""

    gain: float  # log-likelihood gain, nats
    where: Location
    places: float = 1.0  # effective number of independent places that were searched


NO_DEPARTURE: Final = WhitenessDeparture(0.0, Location())
"""Finding of a diagnostic that cannot be applied to an axis."""
Diagnostic = Callable[[WhitenedAxis], WhitenessDeparture]
"""Function that tests a whitened axis for one kind of departure from white noise."""


def diagnose_psd(whitened: WhitenedAxis) -> WhitenessDeparture:
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
    return WhitenessDeparture(best, Location(frequency=(float(lo), float(hi))), bins.count.size)


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


def diagnose_spectral_lines(whitened: WhitenedAxis) -> WhitenessDeparture:
    """Find the strongest line, or the strongest harmonics of one frequency, in the periodogram."""
    gain, f_hz = find_peak_gains_and_frequencies(whitened.periodogram, whitened.axis.rate_hz, 1)[0]
    if whitened.harmonic_series.gain > gain:
        gain, f_hz = whitened.harmonic_series.gain, whitened.harmonic_series.f_hz
    half = whitened.axis.rate_hz / whitened.axis.n
    return WhitenessDeparture(gain, Location(frequency=(f_hz - half, f_hz + half)), whitened.axis.n)


def find_peak_gains_and_frequencies(periodogram: Floats, rate_hz: float, max_peaks: int) -> list[tuple[float, float]]:
    """Find the largest separate peaks of a periodogram, in descending order.

    Parameters
    ----------
    periodogram : ndarray of float64, shape (m + 1,)
        Result of ``compute_periodogram``.
    rate_hz : float
        Sample rate in Hz.
    max_peaks : int
        Largest number of peaks.

    Returns
    -------
    list of tuple of float
        Log-likelihood gain in nats and frequency in Hz of each peak.
    """
    power = periodogram.copy()
    power[:FIRST_LINE_BIN] = power[-2:] = 0.0
    size = 2 * (power.size - 1)
    found = []
    for _ in range(max_peaks):
        at = int(np.argmax(power))
        if power[at] <= 0.0:
            break
        found.append((float(power[at]), at * rate_hz / size))
        power[max(at - 12, 0) : at + 13] = 0.0
    return found


def diagnose_mean_level_change(whitened: WhitenedAxis) -> WhitenessDeparture:
    """Find a change of the mean level: a step, a slope, or a transient at the start.

    A model with random jumps is not tested, because whitening does not remove the jumps.
    """
    if any(isinstance(effect, (PoissonSteps, RandomTelegraph)) for effect in whitened.effects):
        return NO_DEPARTURE
    axis = whitened.axis
    gains, times_s, places = compute_level_step_gains(whitened)
    at = int(np.argmax(gains))
    found = [WhitenessDeparture(float(gains[at]), Location(time=(float(times_s[at]), float(times_s[at]))))]
    for fraction in TRANSIENT_TIME_FRACTIONS:
        effect = TurnOnTransient(amplitude=1.0, time_constant=float(fraction * axis.length_s))
        found.append(
            WhitenessDeparture(
                _regressor_gain(whitened, [(effect, 0)]),
                Location(time=(0.0, effect.time_constant)),
            )
        )
    curve = BiasCurve(slope=1.0, curvature=1.0)
    curved = _regressor_gain(whitened, [(curve, 0), (curve, 1)]) - CURVE_PENALTY_NATS
    ramp = _regressor_gain(whitened, [(RateRamp(R=1.0), 0)])
    found.append(WhitenessDeparture(max(ramp, curved), Location(time=(0.0, axis.length_s))))
    best = max(found, key=lambda one: one.gain)
    return WhitenessDeparture(best.gain, best.where, places)


def compute_level_step_gains(whitened: WhitenedAxis) -> tuple[Floats, Floats, float]:
    """Compute the log-likelihood gain of a step of the mean level at each time.

    A unit step at sample s has the cosine transform X_k = −√(2/n) sin(πks/n)/(2 sin(πk/2n)). A Fourier transform
    computes the weighted sums Σ W_k X_k² = Σ W_k (1 − cos(2πks/n))/(4n sin²(πk/2n)) for all s.

    Between successive samples, the product of data and step changes by a random amount. If the gains at both times are
    independent, this change has the same variance as the product. The ratio of the two variances, summed over all
    times, is the effective number of independent times.

    Returns
    -------
    gains : ndarray of float64, shape (k,)
        Log-likelihood gain of a step at each time, in nats.
    times_s : ndarray of float64, shape (k,)
        Time of the step in seconds from the start.
    places : float
        Effective number of independent times.
    """
    axis = whitened.axis
    n = axis.n
    weighted = inverse_cosine_transform(whitened.coefficients * whitened.weights)
    margin = ceil(STEP_MARGIN_FRACTION * n)
    squares = whitened.weights**2
    step_power = 0.25 / n / axis.regressors.half_sines**2  # mean square of each coefficient of a step over all times
    gains, places = _step_gains(weighted, _sum_squares_of_steps(squares * step_power), squares.mean(), margin)
    return gains, np.arange(margin, n - margin) / axis.rate_hz, places


@compiled
def _step_gains(weighted: Floats, grid: Floats, mean_square: float, margin: int) -> tuple[Floats, float]:
    """Return the gains at all times inside the margins, and the effective number of independent times.

    The sums of squares are interpolated from ``grid``, which has the first time at both ends.
    """
    n = weighted.size
    gains, places, product = np.empty(n - 2 * margin), 0.0, 0.0
    for s in range(n - 1, margin - 1, -1):
        product += weighted[s]  # of the data with a step at sample s
        if s < n - margin:
            at = s * ((grid.size - 1) / n)
            low = int(at)
            square = max(grid[low] + (at - low) * (grid[low + 1] - grid[low]), 1e-300)
            gains[s - margin] = 0.5 * product * product / square
            places += min(mean_square / square, 1.0)
    return gains, places


def _sum_squares_of_steps(power: Floats) -> Floats:
    """Return Σ_k p_k (1 − cos(2πks/n)) at the times s = jn/m, j = 0 … m, for the powers p_k, k = 1 … n − 1.

    In a long recording, m is smaller than n. On this grid, the cosines of k and k + m are equal.
    """
    n = power.size + 1
    m = n if n <= 2 * MAX_STEP_GRID else MAX_STEP_GRID
    folded = np.pad(power, (1, -n % m)).reshape(-1, m).sum(axis=0)
    cosines = rfft(folded).real  # for the first half of the times; the values beyond are the mirror image
    return np.asarray(power.sum() - np.concatenate([cosines, cosines[: m - cosines.size + 1][::-1]]))


def _regressor_gain(whitened: WhitenedAxis, regressors: Sequence[Regressor]) -> float:
    """Return the log-likelihood gain of fitted regressors, from the sums over frequency bins."""
    cross, gram = whitened.fit.sum_residual_products_over_bins(regressors)
    normal, right = gram @ (1.0 / whitened.fit.whittle.variance), cross @ (1.0 / whitened.fit.whittle.variance)
    return _gain_of_normal_equations(normal, right)


def _gain_of_normal_equations(normal: Floats, right: Floats) -> float:
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    solved, *_ = np.linalg.lstsq(normal / np.outer(scale, scale), right / scale, rcond=1e-9)
    return float(0.5 * solved @ (right / scale))


def diagnose_autocorrelation(whitened: WhitenedAxis) -> WhitenessDeparture:
    """Find the lag with the strongest autocorrelation of the whitened series."""
    gains = 0.5 * compute_autocorrelation(whitened.periodogram) ** 2 * whitened.axis.n
    at = int(np.argmax(gains))
    lag_s = (at + 1) / whitened.axis.rate_hz
    return WhitenessDeparture(float(gains[at]), Location(tau=(lag_s, lag_s)))  # the number of lags is constant


def compute_autocorrelation(periodogram: Floats) -> Floats:
    """Compute the autocorrelation of a series at lags from 1 to ``MAX_LAG_SAMPLES`` samples.

    The autocorrelation is the inverse Fourier transform of the periodogram. For these short lags, sums over at most
    4096 frequency bands are sufficient. The relative error is about 10⁻⁴.

    Parameters
    ----------
    periodogram : ndarray, shape (m + 1,)
        Periodogram of the series, with zero padding to at least twice the length.
    """
    m = periodogram.size - 1
    first = np.arange(0, m + 1, -(-m // AUTOCORRELATION_BANDS))
    sums = np.add.reduceat(periodogram, first, dtype=np.float64)
    sums[0] -= 0.5 * periodogram[0]
    sums[-1] -= 0.5 * periodogram[-1]
    return np.asarray(_lag_cosines(m) @ sums / m)


@lru_cache(2)
def _lag_cosines(m: int) -> Floats:
    """Return the cosine of each lag at the centre of each frequency band."""
    first = np.arange(0, m + 1, -(-m // AUTOCORRELATION_BANDS))
    centre = 0.5 * (first + np.append(first[1:] - 1, m))
    lags = np.arange(1, MAX_LAG_SAMPLES + 1)
    return np.asarray(np.cos(np.pi / m * lags[:, None] * centre))


def diagnose_temperature_dependence(whitened: WhitenedAxis) -> WhitenessDeparture:
    """Find a polynomial, delayed or hysteretic dependence of the sensor output on the temperature."""
    temperature_c = whitened.axis.temperature_c
    if temperature_c is None:
        return NO_DEPARTURE
    reference = float(temperature_c.mean())

    def temperature_effect_gain(effect: TemperatureBias | TemperatureLag | TemperatureHysteresis) -> float:
        return _regressor_gain(whitened, [(effect, at) for at in range(regressor_count(effect))])

    gains = [
        temperature_effect_gain(TemperatureBias(coefficient=1.0, reference=reference, quadratic=1.0, cubic=1.0))
        - 2.0 * CURVE_PENALTY_NATS,
        temperature_effect_gain(TemperatureBias(coefficient=1.0, reference=reference, quadratic=1.0))
        - CURVE_PENALTY_NATS,
        temperature_effect_gain(TemperatureBias(coefficient=1.0, reference=reference)),
        *(
            temperature_effect_gain(TemperatureLag(coefficient=1.0, reference=reference, time_constant=t))
            for t in TEMPERATURE_DELAYS_S
        ),
        *(
            temperature_effect_gain(TemperatureHysteresis(height=1.0, reversal=float(share * np.ptp(temperature_c))))
            for share in HYSTERESIS_FRACTIONS
            if np.ptp(temperature_c) > 0.0
        ),
    ]
    return WhitenessDeparture(
        max(gains), Location(temperature=(float(temperature_c.min()), float(temperature_c.max())))
    )


def diagnose_leaks_from_other_axes(whitened: WhitenedAxis) -> WhitenessDeparture:
    """Find the axis that leaks most strongly into the whitened axis, besides the common vibration of both axes."""
    best = NO_DEPARTURE
    for name, coefficients in whitened.axis.leak_sources.items():
        common = _common_vibration_columns(whitened, coefficients)
        if common:
            columns = np.stack([column * whitened.weights for column in (coefficients, *common)])
            normal, right = columns @ columns.T, columns @ whitened.coefficients
            gain = _gain_of_normal_equations(normal, right) - _gain_of_normal_equations(normal[1:, 1:], right[1:])
        else:
            gain = _regressor_gain(whitened, [(CrossAxis(source=name, coefficient=1.0), 0)])
        if gain > best.gain:
            best = WhitenessDeparture(gain, Location(source=name), len(whitened.axis.leak_sources))
    return best


def _common_vibration_columns(whitened: WhitenedAxis, source: Floats) -> list[Floats]:
    """Return the best prediction of each common vibration of the axis from another axis, up to a constant factor.

    Let c be the variance of a coefficient of the vibration, Y the coefficient of the other axis, and v the variance of
    Y. If both axes contain the vibration, the prediction is proportional to Y c/v. The variance v is estimated from the
    other coefficients nearby, because the ratio Y/v would otherwise be biased.
    """
    vibrations = [at for at, effect in enumerate(whitened.effects) if isinstance(effect, CommonVibration)]
    if not vibrations:
        return []
    bins, window = whitened.axis.bins, np.ones(SMOOTHING_BINS)
    sums = bins.expand_to_coefficients(np.convolve(bins.sum_over_bins(source**2), window, "same"))
    count = bins.expand_to_coefficients(np.convolve(bins.count, window, "same"))
    relative = source * (count - 1.0) / np.maximum(sums - source**2, 1e-300)
    return [relative * bins.expand_to_coefficients(whitened.fit.noise_variance(at)) for at in vibrations]


def diagnose_variance_change(whitened: WhitenedAxis) -> WhitenessDeparture:
    """Find a change of the noise variance over time."""
    found = whitened.variance_changes
    gain = max(found.step.gain, found.largest_gain_other_than_step)
    return WhitenessDeparture(
        gain, Location(time=(found.step.time.lo, found.step.time.hi)), count_variance_blocks(whitened.axis.n)
    )


def diagnose_spectrogram_change(whitened: WhitenedAxis) -> WhitenessDeparture:
    """Find the part of the spectrogram with the largest change of power over time."""
    found = whitened.unexplained_spectrogram_change
    if found.gain >= found.row_gain:
        return WhitenessDeparture(found.gain, Location(time=found.time, frequency=found.frequency), whitened.axis.n)
    return WhitenessDeparture(found.row_gain, Location(frequency=found.row), whitened.axis.n)


def diagnose_outliers(whitened: WhitenedAxis) -> WhitenessDeparture:
    """Find outliers among the samples of the whitened series."""
    found = whitened.outlier_fit
    return WhitenessDeparture(found.gain if found else 0.0, Location())


def diagnose_quantization_clipping_repeats(whitened: WhitenedAxis) -> WhitenessDeparture:
    """Find quantization, clipping or repeated samples that the noise model does not contain."""
    statistics = whitened.axis.value_artifacts
    best = NO_DEPARTURE
    for kind, found in (
        (Resolution, statistics.quantization),
        (Saturation, statistics.clipping),
        (RandomSampleHold, statistics.repeats),
    ):
        is_known = kind in whitened.effect_types
        if kind is Resolution and is_known:
            is_known = find_changed_resolution(whitened) is None
        if found is not None and not is_known and found.gain > best.gain:
            best = WhitenessDeparture(found.gain, Location())
    if best.gain and statistics.clipping is not None and best.gain == statistics.clipping.gain:
        return WhitenessDeparture(
            best.gain, Location(value=(statistics.clipping.limit.lo, statistics.clipping.limit.hi))
        )
    return best


def find_changed_resolution(whitened: WhitenedAxis) -> int | None:
    """Return the index of the quantization of the model if the recorded values have another step, or None."""
    quantization = whitened.axis.value_artifacts.quantization
    if quantization is None:
        return None
    for at, effect in enumerate(whitened.effects):
        if isinstance(effect, Resolution):
            same = abs(quantization.step.value / effect.step - 1.0) < MAX_STEP_DIFFERENCE
            return None if same else at
    return None


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
