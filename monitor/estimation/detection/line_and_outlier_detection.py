"""Detect spectral lines, resonances and outliers in a recording.

At most ``MAX_STRETCHES`` segments of ``ROWS`` samples are searched, so the search takes less than a second even for
long recordings. Segments in which more than ``MAX_MISSING_SHARE`` of the samples are missing are skipped.

- **Spectral lines.** The periodograms of all segments are computed with a Hann window and averaged (Welch 1967). A peak
  must exceed the medians of the neighbouring bins on both sides by ``MIN_PEAK_SIGMA`` standard deviations and by the
  factor ``MIN_PEAK_RATIO``. Single bins are searched for lines, and bins that are ``WIDE_BINS`` times wider are
  searched for resonances. A line of amplitude A contributes A² sin⁴(πfτ) / (m sin(πf/rate))² to the Allan variance
  (IEEE Std 952 annex C, for a mean of m samples). A peak is not reported if its share of the Allan variance is below
  ``MIN_LINE_SHARE`` at every averaging time.
- **Outliers.** An outlier deviates by more than ``OUTLIER_SIGMA`` σ from the median of a block of ``BLOCK`` samples. To
  exclude slopes, an outlier must also deviate by ``OUTLIER_SIGMA``/2 σ from the median of the neighbouring samples. The
  standard deviation σ is computed from the median absolute deviation, and is at least one quantization step.

Lines with fewer than ``FIRST_BIN`` cycles per segment and lines of short duration are not detected. The command
``reconcile`` does not use this module, because it tests lines and outliers by log-likelihood.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats
from monitor.common.distributions import NORMAL_QUARTILE
from monitor.estimation.allan.curve import AllanCurve

Mask = NDArray[np.bool_]

ROWS: Final = 4096
"""Maximum number of samples in a segment of the recording."""
MIN_ROWS: Final = 256
"""Minimum number of samples in a segment of the recording."""
MIN_STRETCHES: Final = 8
"""Minimum number of segments over which a spectrum is averaged."""
MAX_STRETCHES: Final = 128
"""Maximum number of segments over which a spectrum is averaged."""
MAX_OUTLIER_STRETCHES: Final = 32
"""Maximum number of segments that are searched for outliers.

With these 131 072 samples, an outlier share of 0.001 is measured with a relative error of 10 %.
"""
MAX_MISSING_SHARE: Final = 0.3
"""Maximum share of missing samples in a segment."""
MAX_LEAKAGE: Final = 0.05
"""Minimum power of a peak, relative to the power of the strongest line that missing samples spread over the spectrum.

Bursts of loss of equal length spread the power unevenly, which resembles resonances beside the line.
"""
MIN_PEAK_SIGMA: Final = 6.5
"""Minimum height of a spectral peak in standard deviations.

With this limit, no false line was found in 1000 simulated recordings of each type of noise. The types were white,
flicker, quantization and low-pass filtered noise, random walk, coarse resolution and repeated samples. Each recording
had 2048 or 20 000 samples.
"""
MIN_PEAK_RATIO: Final = 1.6
"""Minimum ratio of a spectral peak to the neighbouring bins.

A sloping spectrum or the edge of a filter has a smaller ratio.
"""
WIDE_BINS: Final = 16
"""Width of the bins that are searched for resonances, in bins of the spectrum."""
FIRST_BIN: Final = 6
"""First bin of the spectrum that is searched for peaks."""
MIN_BINS: Final = 64
"""Minimum number of bins in a spectrum. With fewer bins, quantization noise resembles a peak."""
NEAR_BINS: Final = 3
"""Number of bins on each side of a line that contain spectral leakage of the Hann window."""
SIDE_BINS: Final = 16
"""Number of neighbouring bins on each side with which a peak is compared. Wide bins use a quarter of this number."""
FOOT_SIGMA: Final = 2.0
"""Minimum decrease, in standard deviations, over ``NEAR_BINS`` bins at the flank of a peak."""
MIN_LINE_SHARE: Final = 0.002
"""Minimum share of the Allan variance that a reported line contributes."""
MAX_LINES: Final = 3
"""Maximum number of lines that are reported per axis."""
OUTLIER_SIGMA: Final = 5.0
"""Minimum deviation of an outlier in standard deviations."""
BLOCK: Final = 63
"""Number of samples in a block from which a median is computed.

If the number is odd, the median is one of the samples, and the deviations are whole quantization steps.
"""
NEIGHBOURS: Final = 3
"""Number of samples on each side with which an outlier is compared. Up to three successive outliers are detected."""


@dataclass(frozen=True, slots=True)
class SpectralLine:
    """Spectral line or resonance of one axis."""

    axis: int  # index into AXES
    frequency_hz: float  # frequency after sampling, possibly an alias
    amplitude: float  # amplitude of a sinusoid with the same power, rad/s or m/s²
    share: float  # largest share of the Allan variance over all averaging times
    wide: bool  # True for a resonance


@dataclass(frozen=True, slots=True)
class _Peak:
    """Peak in the spectrum of one axis."""

    middle: float  # centre of the peak in bins
    power: float  # mean square in excess of the neighbouring bins, squared unit of the axis
    wide: bool  # True for a resonance


def detect_spectral_lines_per_axis(
    values: Floats, in_motion: Mask, rate_hz: float, curve: AllanCurve
) -> list[SpectralLine]:
    """Return the spectral lines of all axes. The lines of each axis are sorted from strong to weak.

    Parameters
    ----------
    values : ndarray of float64, shape (n, 6)
        Samples in rad/s and m/s²; NaN means missing.
    in_motion : ndarray of bool, shape (n,)
        True for samples in motion, which are ignored.
    rate_hz : float
        Sample rate in Hz.
    curve : AllanCurve
        Allan curve of the recording.
    """
    rows = min(ROWS, 1 << (len(values) // MIN_STRETCHES).bit_length() >> 1)
    if rows < MIN_ROWS:
        return []
    found = []
    for axis in range(len(AXES)):
        stretches = list(_stretches(values[:, axis], in_motion, rows, MAX_STRETCHES))
        if len(stretches) < MIN_STRETCHES:
            continue
        parts = np.stack(stretches)
        present = float(np.isfinite(parts).mean())  # missing samples reduce a line relative to the noise
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # for constant axes and extreme values
            peaks = _peaks(_spectrum(parts), len(parts))
            leakage = MAX_LEAKAGE * (1.0 - present) * max((peak.power for peak in peaks), default=0.0)
            of_axis = [
                _make_line(axis, peak, present, rate_hz / rows, rate_hz, curve)
                for peak in peaks
                if peak.power >= leakage
            ]
        strong = sorted((one for one in of_axis if one.share >= MIN_LINE_SHARE), key=lambda one: -one.share)
        found += strong[:MAX_LINES]
    return found


def outlier_share_of_axes(values: Floats, in_motion: Mask) -> Floats:
    """Return the share of outliers of each axis.

    Parameters
    ----------
    values : ndarray of float64, shape (n, 6)
        Samples in rad/s and m/s²; NaN means missing.
    in_motion : ndarray of bool, shape (n,)
        True for samples in motion, which are ignored.

    Returns
    -------
    ndarray of float64, shape (6,)
        Share of outliers of each axis; NaN if there are too few samples.

    >>> noise = np.random.default_rng(0).standard_normal((20_000, 6))
    >>> noise[::50, 2] = 30.0
    >>> outlier_share_of_axes(noise, np.zeros(20_000, bool)).round(3).tolist()
    [0.0, 0.0, 0.02, 0.0, 0.0, 0.0]
    """
    shares = np.full(len(AXES), np.nan)
    rows = min(ROWS, len(values) // BLOCK * BLOCK)
    for axis in range(len(AXES)) if rows else ():
        far = [
            _outlier_share(part[np.isfinite(part)])
            for part in _stretches(values[:, axis], in_motion, rows, MAX_OUTLIER_STRETCHES)
        ]
        if far:
            shares[axis] = np.mean(far)
    return shares


def allan_variance_share_of_line(line: SpectralLine, curve: AllanCurve) -> Floats:
    """Return the share [m] of the Allan variance that a spectral line contributes at each averaging time.

    Parameters
    ----------
    line : SpectralLine
        Spectral line.
    curve : AllanCurve
        Allan curve of the recording.
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return _allan_share(line.axis, line.frequency_hz * curve.tau_s[0] / curve.factors[0], line.amplitude, curve)


def _stretches(column: Floats, moving: Mask, rows: int, most: int) -> Iterator[Floats]:
    """Yield segments [rows] with few missing samples, in which NaN means missing or in motion."""
    begins = np.linspace(0, len(column) - rows, min(most, max(2 * len(column) // rows - 1, 1))).astype(np.int64)
    for begin in begins:
        part = np.where(moving[begin : begin + rows], np.nan, column[begin : begin + rows])
        if np.isfinite(part).mean() >= 1.0 - MAX_MISSING_SHARE:
            yield part


def _spectrum(parts: Floats) -> Floats:
    """Return the mean square per bin [rows / 2] of segments [k, rows]. Missing samples do not change white noise."""
    present = np.isfinite(parts)
    window = np.hanning(parts.shape[1])
    mean = np.where(present, parts, 0.0).sum(axis=1, keepdims=True) / present.sum(axis=1, keepdims=True)
    turned = np.fft.rfft(np.where(present, parts - mean, 0.0) * window, axis=1)[
        :, :-1
    ]  # The bin at half the sample rate is left out, because it has only one degree of freedom.
    weight = parts.shape[1] * (present @ window**2)
    return np.asarray(2.0 * ((turned.real**2 + turned.imag**2) / weight[:, None]).mean(axis=0))


def _peaks(spectrum: Floats, parts: int) -> list[_Peak]:
    """Return the peaks of a spectrum, first the spectral lines and then the resonances."""
    taken = np.zeros(spectrum.size, np.bool_)
    found = []
    for width, side in ((1, SIDE_BINS), (WIDE_BINS, SIDE_BINS // 4)):
        power = spectrum[: spectrum.size // width * width].reshape(-1, width).mean(axis=1)
        if power.size < MIN_BINS:
            continue
        runs = _find_runs(_significant_bins(power, parts * width, side))
        # The highest peak comes first, because its flanks are excluded from the search for lower peaks.
        for first, last in sorted(runs, key=lambda run: -power[slice(*run)].max()):
            if first * width < FIRST_BIN or taken[first * width : last * width].any():
                continue
            begin, end = _find_feet(power, first, last, parts * width)
            taken[begin * width : end * width] = True
            sides = np.concatenate([power[max(begin - side, 0) : begin], power[end : end + side]])
            above = power[begin:end] - np.median(sides)
            if above.sum() > 0.0:
                weights = np.maximum(above, 0.0)
                middle = float((np.arange(begin, end) * weights).sum() / weights.sum())
                high = int((above > above.max() / 4.0).sum())
                wide = width > 1 or high > 2 * NEAR_BINS + 1
                found.append(_Peak(width * (middle + 0.5) - 0.5, width * float(above.sum()), wide))
    return found


def _significant_bins(power: Floats, averaged: int, side: int) -> Mask:
    bins, reach = power.size, NEAR_BINS + side
    padded = np.pad(power, reach, mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(padded, side)
    left, right = (np.median(around[at : at + bins], axis=1) for at in (0, reach + NEAR_BINS + 1))
    level = np.maximum(left, right)
    ratio = power / level
    chi = 2.0 / (9.0 * 2.0 * averaged)  # Wilson & Hilferty (1931), two degrees of freedom per periodogram
    sigma = (np.cbrt(ratio) - (1.0 - chi)) / np.sqrt(chi)
    return np.asarray((sigma > MIN_PEAK_SIGMA) & (ratio > MIN_PEAK_RATIO) & (level > 0.0))


def _find_feet(power: Floats, first: int, last: int, averaged: int) -> tuple[int, int]:
    falls, step = 1.0 - FOOT_SIGMA / (NEAR_BINS * averaged) ** 0.5, NEAR_BINS
    first, last = max(first - step, 0), min(last + step, power.size)
    while first >= step and power[first - step : first].sum() < falls * power[first : first + step].sum():
        first -= step
    while last + step <= power.size and power[last : last + step].sum() < falls * power[last - step : last].sum():
        last += step
    return first, last


def _find_runs(marks: Mask) -> list[tuple[int, int]]:
    """Return the start and the end of each range of consecutive True elements."""
    edges = np.flatnonzero(np.diff(marks.astype(np.int8), prepend=0, append=0)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def _make_line(
    axis: int, peak: _Peak, present: float, bin_hz: float, rate_hz: float, curve: AllanCurve
) -> SpectralLine:
    frequency, amplitude = peak.middle * bin_hz, (2.0 * peak.power / present) ** 0.5
    shares = _allan_share(axis, frequency / rate_hz, amplitude, curve)
    return SpectralLine(axis, frequency, amplitude, float(np.nanmax(shares, initial=0.0)), peak.wide)


def _allan_share(axis: int, turns: float, amplitude: float, curve: AllanCurve) -> Floats:
    half = np.pi * turns
    made = (amplitude * np.sin(curve.factors * half) ** 2 / np.sin(half)) ** 2 / curve.factors
    mean_square = (curve.avar + curve.excess)[:, axis]  # not zero because of missing samples alone
    return np.asarray(made / (curve.factors * mean_square))


def _outlier_share(part: Floats) -> float:
    steps = np.abs(np.diff(part))
    step = float(steps[steps > 0.0].min(initial=np.inf))
    part = part[: part.size // BLOCK * BLOCK]
    if not part.size or not np.isfinite(step):
        return 0.0
    blocks = part.reshape(-1, BLOCK)
    away = np.abs(blocks - np.median(blocks, axis=1, keepdims=True))
    least = OUTLIER_SIGMA * max(_interpolated_median(away, step) / NORMAL_QUARTILE, step)
    rows = np.flatnonzero(away > least)
    around = np.clip(rows[:, None] + np.arange(-NEIGHBOURS, NEIGHBOURS + 1), 0, part.size - 1)
    alone = np.abs(part[rows] - np.median(part[around], axis=1)) > least / 2.0
    return float(alone.sum()) / part.size


def _interpolated_median(away: Floats, step: float) -> float:
    """Return the median of quantized deviations, interpolated within a quantization step."""
    middle = float(np.median(away))
    below, upto = (away < middle - step / 4.0).mean(), (away < middle + step / 4.0).mean()
    return middle + step * float((0.5 - below) / max(upto - below, 1.0 / away.size) - 0.5)
