"""Orthonormal cosine transform (DCT-II) of an axis, and sums of coefficients over frequency bins.

A stationary series of n samples has nearly independent coefficients Y_k at the frequencies k·rate/2n. The variance of
Y_k is nearly S(f_k)/τ0. The transform continues the series as a mirror image. A slope or a step therefore does not leak
into other frequencies. The coefficient of the mean is not used, because the mean of an axis is always fitted.

The spectrum is nearly constant within a bin. The bins are finer around narrow peaks and near half the sample rate.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.fft import dct, idct

from drivers.data_types import Floats, Ints

SINGLE_COEFFICIENT_BINS: Final = 48
"""Number of bins at the lowest frequencies that contain one coefficient each."""
BINS_PER_OCTAVE: Final = 16
MAX_BIN_WIDTH_HZ: Final = 0.1
MAX_BIN_WIDTH_FRACTION: Final = 0.002
"""Largest width of a bin as a fraction of the frequency range."""
MAX_SMOOTH_COEFFICIENTS: Final = 1 << 15
"""Number of block means that represent a smooth series in a long recording."""
BINS_PER_PEAK_SIDE: Final = 24
"""Number of bins on each side of a narrow peak."""
PEAK_REACH_HALF_WIDTHS: Final = 30.0
"""Distance from a narrow peak, in half widths, up to which the bins are finer."""

MIN_COEFFICIENTS_PER_BIN: Final = 64
"""Smallest number of coefficients in a bin whose power is not smoothed. The standard error is 18 %.
"""
MIN_POWER: Final = 1e-300
"""Smallest mean square of a bin, so that a series without power can be divided by it."""
SMOOTHING_BINS: Final = 9
"""Number of neighbouring bins over which the power of a small bin is averaged."""


@dataclass(frozen=True, slots=True)
class FrequencyBins:
    """Assignment of cosine transform coefficients to frequency bins."""

    first: Ints  # [m] k of the first coefficient of each bin, minus 1
    count: Floats  # [m] number of coefficients
    f_hz: Floats  # [m] centre frequency
    rate_hz: float

    def sum_over_bins(self, products: Floats) -> Floats:
        """Sum coefficient values over each bin, shape (m,).

        The values have the shape (n − 1,). In a shorter array, the missing values at high frequencies are zero.
        """
        sums = np.zeros(self.first.size)
        used = int(np.searchsorted(self.first, products.size))
        sums[:used] = np.add.reduceat(products, self.first[:used])
        return sums

    def smoothed_mean_square(self, coefficients: Floats) -> Floats:
        """Return the mean square of coefficients, shape (n − 1,), in each bin, shape (m,).

        If a bin has few coefficients, the mean includes neighbouring bins. The mean is never zero.
        """
        sums, window = self.sum_over_bins(coefficients**2), np.ones(SMOOTHING_BINS)
        smoothed = np.convolve(sums, window, "same") / np.convolve(self.count, window, "same")
        return np.maximum(np.where(self.count >= MIN_COEFFICIENTS_PER_BIN, sums / self.count, smoothed), MIN_POWER)

    def expand_to_coefficients(self, bin_values: Floats) -> Floats:
        """Repeat the value of each bin, shape (m,), for all coefficients of the bin, shape (n − 1,)."""
        return np.repeat(bin_values, self.count.astype(np.int64))


def build_frequency_bins(n: int, rate_hz: float, peaks: Sequence[tuple[float, float]] = ()) -> FrequencyBins:
    """Build the frequency bins of a series.

    Parameters
    ----------
    n : int
        Number of samples.
    rate_hz : float
        Sample rate in Hz.
    peaks : sequence of tuple of float, optional
        Centre and full width, in Hz, of the narrow peaks around which the bins are finer.

    Returns
    -------
    FrequencyBins
        Bins of all n − 1 coefficients.

    Examples
    --------
    >>> found = build_frequency_bins(360_000, 100.0)
    >>> int(found.count.sum()), 700 < found.count.size < 1000
    (359999, True)
    """
    step_hz = 0.5 * rate_hz / n
    widest = min(MAX_BIN_WIDTH_HZ, MAX_BIN_WIDTH_FRACTION * 0.5 * rate_hz) / step_hz
    ratio = 2.0 ** (1.0 / BINS_PER_OCTAVE) - 1.0
    edges = list(range(1, min(SINGLE_COEFFICIENT_BINS, n - 1) + 1))
    at = float(edges[-1])
    while at < n:
        # near half the sample rate, the spectrum of a digital filter decreases to zero
        at += max(min(at * ratio, (n - at) * ratio, widest), 1.0)
        edges.append(round(at))
    parts = [np.asarray(edges, np.int64)]
    for middle, width in peaks:
        away = np.geomspace(0.1, PEAK_REACH_HALF_WIDTHS, BINS_PER_PEAK_SIDE) * 0.5 * width
        at_hz = np.concatenate([middle - away, [middle], middle + away])
        parts.append(np.rint(at_hz / step_hz).astype(np.int64))
    k = np.unique(np.concatenate(parts))
    first = k[(k >= 1) & (k < n)]
    last = np.append(first[1:], n)
    return FrequencyBins(first - 1, (last - first).astype(np.float64), np.sqrt(first * (last - 1.0)) * step_hz, rate_hz)


def cosine_transform(y: Floats) -> Floats:
    """Compute the orthonormal cosine transform of a series, without the coefficient of the mean.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Series without missing samples.

    Returns
    -------
    ndarray of float64, shape (n − 1,)
        Coefficients in the unit of ``y``.
    """
    return np.asarray(dct(y - y.mean(), norm="ortho")[1:])


def low_frequency_cosine_transform(y: Floats) -> Floats:
    """Compute the coefficients of a smooth series at low frequencies from block means.

    A short series is transformed completely.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Series that changes little within n/32768 samples.

    Returns
    -------
    ndarray of float64, shape (min(n, 32768) − 1,) or (n − 1,)
        First coefficients of ``cosine_transform(y)``. The other coefficients are nearly zero.

    Examples
    --------
    >>> y = np.exp(-np.arange(100_000) / 2e4)
    >>> found, exact = low_frequency_cosine_transform(y), cosine_transform(y)
    >>> found.size, bool(np.abs(found - exact[: found.size]).max() < 1e-5 * exact.max())
    (32767, True)
    """
    if y.size < 2 * MAX_SMOOTH_COEFFICIENTS:
        return cosine_transform(y)
    edges = np.rint(np.linspace(0.0, y.size, MAX_SMOOTH_COEFFICIENTS + 1)).astype(np.int64)
    means = np.add.reduceat(y, edges[:-1]) / np.diff(edges)
    return np.asarray((y.size / MAX_SMOOTH_COEFFICIENTS) ** 0.5 * cosine_transform(means))


def sinusoid_cosine_transforms(turns_per_sample: float, first_sample: int, half_sines: Floats) -> list[Floats]:
    """Compute the cosine transforms of a sine and a cosine from the closed form of the sums.

    Let θ = πk/n and ω the phase advance of a sample. The transform of exp(iωj) is proportional to
    (1 − (−1)ᵏ exp(iωn)) cos(θ/2)/(cos ω − cos θ), except at θ = ω, where it is the sum of two Dirichlet kernels.

    Parameters
    ----------
    turns_per_sample : float
        Frequency as a fraction of the sample rate. Frequencies above 1/2 are aliased.
    first_sample : int
        Index of the first sample. The phase is zero at the index 0.
    half_sines : ndarray of float64, shape (n − 1,)
        Values sin(πk/2n) for k = 1 … n − 1.

    Returns
    -------
    list of ndarray of float64, shape (n − 1,)
        Results of ``cosine_transform`` for the sine and the cosine.

    Examples
    --------
    >>> sines = np.sin(0.5 * np.pi * np.arange(1, 1000) / 1000)
    >>> exact = cosine_transform(np.sin(2.0 * np.pi * 0.12345 * np.arange(5, 1005)))
    >>> bool(np.allclose(sinusoid_cosine_transforms(0.12345, 5, sines)[0], exact))
    True
    """
    n = half_sines.size + 1
    alias = turns_per_sample - round(turns_per_sample)
    if alias != turns_per_sample:  # an error of the sample rate may move a line beyond half the stated rate
        sine, cosine = sinusoid_cosine_transforms(abs(alias), first_sample, half_sines)
        return [float(np.sign(alias)) * sine, cosine]
    omega, half_cosines = 2.0 * np.pi * turns_per_sample, half_sines[::-1]
    # two equal forms of (cos ω − cos θ)/2, of which the one with the smaller rounding error is used
    if turns_per_sample < 0.25:
        ratio = half_sines**2 - np.sin(0.5 * omega) ** 2
    else:
        ratio = np.cos(0.5 * omega) ** 2 - half_cosines**2
    nearest = min(max(round(2.0 * turns_per_sample * n), 1), n - 1)
    ratio[nearest - 1] = 1.0
    np.divide(half_cosines, ratio, out=ratio)
    start = np.exp(2j * np.pi * np.mod(turns_per_sample * first_sample, 1.0)) * (2.0 / n) ** 0.5
    factor = 0.25 * start * (np.exp(-1j * omega) - 1.0)
    turned = np.exp(2j * np.pi * np.mod(turns_per_sample * n, 1.0))
    factors = factor * (1.0 + turned), factor * (1.0 - turned)  # for odd and even k
    theta = np.pi * nearest / n
    at_nearest = start * sum(
        0.5 * np.exp(0.5j * (side * theta + (n - 1) * x)) * n * np.sinc(0.5 * n * x / np.pi) / np.sinc(0.5 * x / np.pi)
        for side, x in ((1.0, omega + theta), (-1.0, omega - theta))
    )
    transforms = []
    for part in (np.imag, np.real):
        found = np.empty(n - 1)
        for parity, one in enumerate(factors):
            np.multiply(ratio[parity::2], part(one), out=found[parity::2])
        found[nearest - 1] = part(at_nearest)
        transforms.append(found)
    return transforms


def inverse_cosine_transform(coefficients: Floats) -> Floats:
    """Compute the zero-mean series, shape (n,), from the cosine transform, shape (n − 1,).

    Examples
    --------
    >>> y = np.array([1.0, 4.0, -5.0])
    >>> bool(np.allclose(inverse_cosine_transform(cosine_transform(y)), y))
    True
    """
    return np.asarray(idct(np.concatenate([[0.0], coefficients]), norm="ortho"))
