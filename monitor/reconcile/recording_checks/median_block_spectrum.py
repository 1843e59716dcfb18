"""Robust spectrum of one axis: the median over blocks of the power in frequency bands.

A knock, a spike or a gap changes only a few blocks and therefore has little effect on the median. The median of the
power is smaller than the mean. The ratio of median and mean is the same for a recording and a simulation, so the ratio
cancels in the comparison.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import Floats

MIN_BLOCKS: Final = 48
"""Approximate number of blocks of a recording. With fewer blocks, the blocks are longer and the bands narrower."""
BLOCK_SAMPLES: Final = (64, 2048)
"""Smallest and largest number of samples in a block."""
FIRST_USED_BIN: Final = 2
"""First bin of a block spectrum that is used. Lower bins contain the drift."""
MAX_BANDS: Final = 60
"""Largest number of frequency bands. Bands without a bin are removed."""
MAX_MISSING_SHARE: Final = 0.1
"""Largest fraction of missing samples in a block that is used."""
MIN_USED_BLOCKS: Final = 8
"""Smallest number of complete blocks for a spectrum."""
WINDOW_BINS: Final = 2.0
"""Half width of the main lobe of the Hann window in bins."""
MEDIAN_ERROR: Final = 1.2533
"""Standard error of the median relative to the standard error of the mean."""


@dataclass(frozen=True, slots=True)
class RobustBandSpectrum:
    """Spectrum of one axis in frequency bands."""

    f_hz: Floats  # [m] centre frequency, Hz
    reach_hz: Floats  # [m] largest distance from the centre at which a line changes the band, Hz
    log_power: Floats  # [m] logarithm of the median power of the blocks, relative to unit²
    error: Floats  # [m] standard error of ``log_power``


def compute_robust_spectrum(y: Floats, rate_hz: float) -> RobustBandSpectrum | None:
    """Compute the robust spectrum of one axis, or return None if there is no noise or too few complete blocks.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Samples of the axis; NaN means missing.
    rate_hz : float
        Sample rate in Hz.

    Examples
    --------
    >>> noise = np.random.default_rng(0).standard_normal(20_000)
    >>> one, two = compute_robust_spectrum(noise, 100.0), compute_robust_spectrum(3.0 * noise, 100.0)
    >>> print(f"{np.exp(0.5 * (two.log_power - one.log_power)).mean():.3f}")
    3.000
    """
    size = int(np.clip(2 ** int(np.log2(max(y.size / MIN_BLOCKS, 1.0))), *BLOCK_SAMPLES))
    blocks = y[: y.size // size * size].reshape(-1, size)
    missing = ~np.isfinite(blocks)
    used = missing.mean(axis=1) <= MAX_MISSING_SHARE
    if used.sum() < MIN_USED_BLOCKS:
        return None
    blocks = _interpolate_missing(blocks[used], missing[used])
    t = np.linspace(-1.0, 1.0, size)
    blocks = blocks - blocks.mean(axis=1, keepdims=True)
    blocks = blocks - np.outer(blocks @ t / (t @ t), t)
    power = np.abs(np.fft.rfft(blocks * np.hanning(size), axis=1)) ** 2
    edges = np.unique(np.rint(np.geomspace(FIRST_USED_BIN, size // 2 + 1, MAX_BANDS)).astype(np.int64))
    bands = np.add.reduceat(power, edges[:-1], axis=1)[:, : edges.size - 1] / np.diff(edges)
    middle = np.median(bands, axis=0)
    if not (middle > 0.0).all():
        return None
    # The 16 % and 84 % quantiles of a normal distribution are two standard deviations apart.
    low, high = np.quantile(np.log(np.maximum(bands, 1e-300)), [0.1587, 0.8413], axis=0)
    error = MEDIAN_ERROR * 0.5 * (high - low) / np.sqrt(len(blocks))
    bin_hz = rate_hz / size
    reach_hz = (0.5 * np.diff(edges) + WINDOW_BINS) * bin_hz
    f_hz = np.asarray(0.5 * bin_hz * (edges[:-1] + edges[1:] - 1.0), np.float64)
    return RobustBandSpectrum(f_hz, reach_hz, np.log(middle), error)


def _interpolate_missing(blocks: Floats, missing: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> Floats:
    """Interpolate the missing samples of each block linearly."""
    filled = blocks.copy()
    at = np.arange(blocks.shape[1])
    for k in np.flatnonzero(missing.any(axis=1)):
        there = ~missing[k]
        filled[k] = np.interp(at, at[there], blocks[k, there])
    return filled
