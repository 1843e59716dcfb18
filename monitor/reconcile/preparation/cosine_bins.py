"""One axis by frequency: its orthonormal cosine transform (DCT-II), and sums of it over bins.

The transform needs no window. Its coefficients Y_k, k = 1 … n − 1 at f_k = k·rate/2n, of a stationary series are nearly
independent, with variance S(f_k)/τ0; of white noise and random walk exactly. A slope or a step leaks nothing from its
ends, as it does in a periodogram, since the series is continued as in a mirror. The mean is Y_0, and is left out: a
model's mean is always free.

All that the likelihood asks of a recording are sums over bins narrow enough for the spectrum to be even within each:
the first SINGLE coefficients by themselves, then PER_OCTAVE bins an octave, none wider than WIDEST_HZ, and finer ones
round narrow peaks and towards half the rate. An hour at 100 Hz comes to some 850 numbers a product.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.fft import dct, idct

from drivers.sample import Floats, Ints

SINGLE: Final = 48
PER_OCTAVE: Final = 16
WIDEST_HZ: Final = 0.1
WIDEST_SHARE: Final = 0.002
"""Of the band: a slow recording has no bin wider than this either."""
PEAK_STEPS: Final = 24
"""Bins from the middle of a peak to where it no longer matters, on each side."""
PEAK_REACH: Final = 30.0
"""Half widths of a peak that get finer bins."""


@dataclass(frozen=True, slots=True)
class Bins:
    """Which coefficients are summed together."""

    first: Ints  # [m] k of the first coefficient of each bin, minus 1
    count: Floats  # [m] coefficients
    f_hz: Floats  # [m] middle
    n: int  # samples of the series
    rate_hz: float

    def sums(self, products: Floats) -> Floats:
        """Sum [m] over bins of something [n − 1] that each coefficient has."""
        return np.asarray(np.add.reduceat(products, self.first))

    def spread(self, of_bins: Floats) -> Floats:
        """The value [n − 1] of each coefficient's bin."""
        return np.repeat(of_bins, self.count.astype(np.int64))


def bins(n: int, rate_hz: float, peaks: Sequence[tuple[float, float]] = ()) -> Bins:
    """Bins of a series of ``n`` samples.

    Args:
        peaks: (middle, full width) in Hz of narrow peaks

    >>> found = bins(360_000, 100.0)
    >>> int(found.count.sum()), 700 < found.count.size < 1000
    (359999, True)
    """
    step_hz = 0.5 * rate_hz / n
    widest = min(WIDEST_HZ, WIDEST_SHARE * 0.5 * rate_hz) / step_hz
    ratio = 2.0 ** (1.0 / PER_OCTAVE) - 1.0
    edges = list(range(1, min(SINGLE, n - 1) + 1))
    at = float(edges[-1])
    while at < n:
        # towards half the rate as towards zero: there the null of a digital filter is a power law of the distance
        at += max(min(at * ratio, (n - at) * ratio, widest), 1.0)
        edges.append(round(at))
    parts = [np.asarray(edges, np.int64)]
    for middle, width in peaks:
        away = np.geomspace(0.1, PEAK_REACH, PEAK_STEPS) * 0.5 * width
        at_hz = np.concatenate([middle - away, [middle], middle + away])
        parts.append(np.rint(at_hz / step_hz).astype(np.int64))
    k = np.unique(np.concatenate(parts))
    first = k[(k >= 1) & (k < n)]
    last = np.append(first[1:], n)
    return Bins(first - 1, (last - first).astype(np.float64), np.sqrt(first * (last - 1.0)) * step_hz, n, rate_hz)


def transform(y: Floats) -> Floats:
    """Coefficients [n − 1] of a series [n] without missing samples, in its own unit."""
    return np.asarray(dct(y - y.mean(), norm="ortho")[1:])


def series(coefficients: Floats) -> Floats:
    """The series [n] of coefficients [n − 1], its mean zero.

    >>> y = np.array([1.0, 4.0, -5.0])
    >>> bool(np.allclose(series(transform(y)), y))
    True
    """
    return np.asarray(idct(np.concatenate([[0.0], coefficients]), norm="ortho"))
