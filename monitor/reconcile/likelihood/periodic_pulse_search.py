"""Search for periodic pulses in a whitened series.

The powers of the harmonics of each possible fundamental frequency are added (Taylor & Huguenin 1969). At the best
frequency, the series is folded, and the best rectangular pulse is fitted to the mean period (epoch folding, Leahy et
al. 1983).
"""

from dataclasses import dataclass
from math import ceil, lgamma, log
from typing import Final

import numpy as np
from scipy.special import gammaincc

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled

HARMONICS: Final = (4, 16, 32)
"""Numbers of harmonics that are added, which are powers of two."""
HARMONIC_SUM_BLOCK: Final = 4096
"""Number of fundamental frequencies whose harmonics are added together."""
MIN_PERIODS: Final = 16
"""Smallest number of periods in the recording."""
MIN_PERIOD_SAMPLES: Final = 4.0
MAX_FOLD_BINS: Final = 4096
MAX_PULSE_BINS: Final = 512
BINS_PER_SAMPLE: Final = 4
"""Number of bins per sample, if the period is not a whole number of samples."""
MULTIPLES: Final = (1, 2, 3, 4)
"""Multiples of the fundamental frequency at which the pulses may repeat. Their harmonics are harmonics too."""
PERIOD_STEPS: Final = 9
"""Number of periods in each refinement."""
MAX_DUTY: Final = 0.5
MAX_MISFIT_SHARE: Final = 0.1
"""Largest gain of a free pulse shape over the rectangular pulse, relative to the gain of the rectangular pulse."""
MAX_MISFIT_Z: Final = 4.0


@dataclass(frozen=True, slots=True)
class HarmonicSeries:
    """Fundamental frequency with the most significant harmonics."""

    gain: float  # −ln of the probability of the summed power in white noise, nats
    f_hz: float
    step_hz: float  # resolution of the frequency


@dataclass(frozen=True, slots=True)
class Pulses:
    """Rectangular pulses that fit the whitened series best."""

    gain: float  # log-likelihood gain in white noise, nats
    period_s: float
    width_s: float
    delay_s: float  # start of the first pulse after the first sample
    is_rectangular: bool  # False if another shape of the pulses fits clearly better


def find_harmonic_series(periodogram: Floats, n: int, rate_hz: float) -> HarmonicSeries:
    """Find the fundamental frequency with the most significant sum of harmonics.

    Parameters
    ----------
    periodogram : ndarray of float64, shape (m + 1,)
        Log-likelihood gain of a line at each frequency from 0 to half the sample rate, in nats.
    n : int
        Number of samples.
    rate_hz : float
        Sample rate in Hz.
    """
    m = periodogram.size - 1
    last = m - 2  # the gains at the highest frequencies are those of one real coefficient
    step_hz = 0.5 * rate_hz / m
    best = HarmonicSeries(0.0, 0.0, step_hz)
    lowest, highest = ceil(MIN_PERIODS * rate_hz / n / step_hz), int(2.0 * m / MIN_PERIOD_SAMPLES)
    if lowest >= highest:
        return best
    powers, places = _largest_harmonic_sums(periodogram, lowest, highest, last)
    for count, power, at in zip(HARMONICS, powers.tolist(), places.tolist(), strict=True):
        gain = _gamma_tail_nats(power, count)
        if gain > best.gain:
            best = HarmonicSeries(gain, at * step_hz / count, step_hz / count)
    return best


def fit_pulses(series: Floats, rate_hz: float, found: HarmonicSeries) -> Pulses | None:
    """Fit rectangular pulses to a whitened series near a fundamental frequency.

    Parameters
    ----------
    series : ndarray of float64, shape (n,)
        White series with a variance of one.
    rate_hz : float
        Sample rate in Hz.
    found : HarmonicSeries
        Approximate fundamental frequency.

    Examples
    --------
    >>> y = np.random.default_rng(1).standard_normal(60_000) + 0.6 * (np.arange(60_000) % 100 < 4)
    >>> pulses = fit_pulses(y, 100.0, HarmonicSeries(50.0, 1.0, 1e-4))
    >>> f"{pulses.period_s:.4f} {pulses.width_s:.3f}"
    '1.0000 0.040'
    """
    if not 0.0 < found.f_hz * MIN_PERIOD_SAMPLES <= rate_hz:
        return None
    multiples = [k for k in MULTIPLES if found.f_hz * k * MIN_PERIOD_SAMPLES <= rate_hz]
    multiple = max(multiples, key=lambda k: _fold_and_fit(series, rate_hz / (k * found.f_hz)).gain)
    centre, half = multiple * found.f_hz, multiple * found.step_hz
    best = _fold_and_fit(series, rate_hz / centre)
    for _ in range(3):
        trials = [(_fold_and_fit(series, rate_hz / f), f) for f in centre + half * np.linspace(-1.0, 1.0, PERIOD_STEPS)]
        better, f_hz = max(trials, key=lambda one: one[0].gain)
        if better.gain > best.gain:
            best, centre = better, f_hz
        half *= 2.0 / (PERIOD_STEPS - 1)
    # the free shape has the fundamental period, because a multiple leaves out harmonics of other shapes
    fundamental = _fold_and_fit(series, multiple * best.period)
    misfit = fundamental.gain + fundamental.misfit - best.gain
    bin_s = best.period / best.bins / rate_hz
    return Pulses(
        best.gain,
        best.period / rate_hz,
        best.width * bin_s,
        best.first * bin_s,
        misfit < MAX_MISFIT_SHARE * best.gain + MAX_MISFIT_Z * (0.5 * fundamental.bins) ** 0.5,
    )


@dataclass(frozen=True, slots=True)
class _FoldedPulse:
    gain: float
    period: float  # samples
    bins: int
    first: int  # first bin of the pulse
    width: int  # bins
    misfit: float  # gain of a free shape over the rectangular pulse less the expected gain, nats


def _fold_and_fit(series: Floats, period: float) -> _FoldedPulse:
    bins = _fold_bin_count(series.size, period)
    sums, counts = _fold(series, period, bins)
    gain, first, width = _best_rectangle(sums, counts, 1, min(max(int(MAX_DUTY * bins), 1), MAX_PULSE_BINS))
    mean = sums.sum() / counts.sum()
    free = 0.5 * float((counts * (sums / np.maximum(counts, 1.0) - mean) ** 2).sum())
    return _FoldedPulse(gain, period, bins, first, width, free - gain - 0.5 * (bins - 2))


def _fold_bin_count(n: int, period: float) -> int:
    """Return a number of bins such that all bins contain nearly equally many samples. ``period`` is in samples."""
    whole = max(round(period), 2)
    drift = abs(period - whole) * n / period  # in samples, until the end of the recording
    return int(min(whole if drift < 1.0 else BINS_PER_SAMPLE * whole, MAX_FOLD_BINS))


def find_pulse_delay(series: Floats, rate_hz: float, period_s: float, width_s: float) -> float:
    """Find the delay in seconds of the first pulse, for pulses with a known period and width.

    Parameters
    ----------
    series : ndarray of float64, shape (n,)
        White series with a variance of one.
    rate_hz : float
        Sample rate in Hz.
    period_s, width_s : float
        Period and width of the pulses in seconds.
    """
    period = period_s * rate_hz
    bins = _fold_bin_count(series.size, period)
    width = max(round(width_s / period_s * bins), 1)
    _, first, _ = _best_rectangle(*_fold(series, period, bins), width, width)
    return first * period_s / bins


def _gamma_tail_nats(power: float, count: int) -> float:
    """Return −ln of the probability that the sum of ``count`` exponential variables exceeds ``power``."""
    chance = float(gammaincc(count, power))
    # first term of the asymptotic series, used if the probability underflows
    return -log(chance) if chance > 1e-300 else power - (count - 1) * log(power) + lgamma(count)


@compiled
def _largest_harmonic_sums(power: Floats, lowest: int, highest: int, last: int) -> tuple[Floats, Ints]:
    """Return the largest sum for each number of harmonics in ``HARMONICS``, and the index of the highest harmonic.

    The fundamental frequencies have indices from ``lowest`` to ``highest``, and the highest harmonic has an index below
    ``last``. Let j be the index of the highest of n harmonics. Harmonic k has the index kj/n, rounded. With 2n
    harmonics and the same j, the even harmonics therefore have the indices of the n harmonics, and only the odd
    harmonics are added. The harmonics are added in blocks of indices j.
    """
    best, places = np.full(len(HARMONICS), -1.0), np.zeros(len(HARMONICS), np.int64)
    sums = np.empty(HARMONIC_SUM_BLOCK)
    for start in range(lowest * HARMONICS[0], min(highest * HARMONICS[-1], last), HARMONIC_SUM_BLOCK):
        size = min(HARMONIC_SUM_BLOCK, last - start)
        sums[:size] = 0.0
        count, shift, step, rank = 1, 1, 1, 0
        while rank < len(HARMONICS):
            for k in range(1, count + 1, step):
                for i in range(size):
                    sums[i] += power[(2 * k * (start + i) + count) >> shift]
            if count == HARMONICS[rank]:
                for at in range(max(lowest * count, start), min(highest * count, start + size)):
                    if sums[at - start] > best[rank]:
                        best[rank], places[rank] = sums[at - start], at
                rank += 1
            count, shift, step = 2 * count, shift + 1, 2
    return best, places


@compiled
def _fold(series: Floats, period: float, bins: int) -> tuple[Floats, Floats]:
    """Return the sum and the number of the samples in each bin of the period."""
    sums, counts = np.zeros(bins), np.zeros(bins)
    step, place = bins / period, 1e-6
    for k in range(series.size):
        sums[int(place)] += series[k]
        counts[int(place)] += 1.0
        place += step
        while place >= bins:
            place -= bins
    return sums, counts


@compiled
def _best_rectangle(sums: Floats, counts: Floats, shortest: int, longest: int) -> tuple[float, int, int]:
    """Return the largest log-likelihood gain of a rectangular pulse, the first bin and the width in bins."""
    bins, total, whole = sums.size, sums.sum(), counts.sum()
    mean, share = total / whole, 1.0 / whole
    best, place, length = 0.0, 0, 1
    for first in range(bins):
        inside, number, at = 0.0, 0.0, first
        for width in range(1, longest + 1):
            inside += sums[at]
            number += counts[at]
            at += 1
            if at == bins:
                at = 0
            if width < shortest or number < 1.0 or number >= whole:
                continue
            gain = 0.5 * (inside - number * mean) ** 2 / (number * (1.0 - number * share))
            if gain > best:
                best, place, length = gain, first, width
    return best, place, length
