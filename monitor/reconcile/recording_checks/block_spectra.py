"""Robust spectrum of one axis: medians over blocks of the power in frequency bands.

A knock, a spike or a hole changes a few blocks, and the median ignores them. The median of a power is smaller than its
mean. The factor is the same for a recording and for a simulation of the model, so it cancels in their ratio.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.sample import Floats

MIN_BLOCKS: Final = 48
"""Approximate number of blocks of a recording. Fewer blocks give longer blocks and finer bands."""
BLOCK_SAMPLES: Final = (64, 2048)
"""Smallest and largest number of samples of a block."""
FIRST_BIN: Final = 2
"""First bin of the spectrum of a block that is used. Lower bins contain the drift."""
BANDS: Final = 60
"""Number of bands before bands without a bin are dropped."""
MAX_MISSING_SHARE: Final = 0.1
"""Largest share of missing samples of a block that is used."""
MIN_USED_BLOCKS: Final = 8
"""Smallest number of complete blocks for a spectrum."""
WINDOW_BINS: Final = 2.0
"""Half width of the main lobe of the Hann window in bins."""
MEDIAN_ERROR: Final = 1.2533
"""Standard error of the median relative to the standard error of the mean."""


@dataclass(frozen=True, slots=True)
class BlockSpectrum:
    """Spectrum of one axis in bands."""

    f_hz: Floats  # [m] centre frequency, Hz
    reach_hz: Floats  # [m] distance from the centre up to which a line changes the band, Hz
    log_power: Floats  # [m] logarithm of the median power of the blocks, relative to unit²
    error: Floats  # [m] standard error of ``log_power``


def block_spectrum(y: Floats, rate_hz: float) -> BlockSpectrum | None:
    """Return the robust spectrum of one axis, or None if it has too few complete blocks or no noise.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Samples of the axis; NaN means missing.
    rate_hz : float
        Sample rate in Hz.

    Examples
    --------
    >>> noise = np.random.default_rng(0).standard_normal(20_000)
    >>> one, two = block_spectrum(noise, 100.0), block_spectrum(3.0 * noise, 100.0)
    >>> print(f"{np.exp(0.5 * (two.log_power - one.log_power)).mean():.3f}")
    3.000
    """
    size = int(np.clip(2 ** int(np.log2(max(y.size / MIN_BLOCKS, 1.0))), *BLOCK_SAMPLES))
    blocks = y[: y.size // size * size].reshape(-1, size)
    missing = ~np.isfinite(blocks)
    used = missing.mean(axis=1) <= MAX_MISSING_SHARE
    if used.sum() < MIN_USED_BLOCKS:
        return None
    blocks = _fill_with_lines(blocks[used], missing[used])
    t = np.linspace(-1.0, 1.0, size)
    blocks = blocks - blocks.mean(axis=1, keepdims=True)
    blocks = blocks - np.outer(blocks @ t / (t @ t), t)
    power = np.abs(np.fft.rfft(blocks * np.hanning(size), axis=1)) ** 2
    edges = np.unique(np.rint(np.geomspace(FIRST_BIN, size // 2 + 1, BANDS)).astype(np.int64))
    bands = np.add.reduceat(power, edges[:-1], axis=1)[:, : edges.size - 1] / np.diff(edges)
    middle = np.median(bands, axis=0)
    if not (middle > 0.0).all():
        return None
    # half the distance between the quantiles at ±1 standard deviation, of the logarithms of the blocks
    low, high = np.quantile(np.log(np.maximum(bands, 1e-300)), [0.1587, 0.8413], axis=0)
    error = MEDIAN_ERROR * 0.5 * (high - low) / np.sqrt(len(blocks))
    bin_hz = rate_hz / size
    reach_hz = (0.5 * np.diff(edges) + WINDOW_BINS) * bin_hz
    f_hz = np.asarray(0.5 * bin_hz * (edges[:-1] + edges[1:] - 1.0), np.float64)
    return BlockSpectrum(f_hz, reach_hz, np.log(middle), error)


def _fill_with_lines(blocks: Floats, missing: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> Floats:
    """Return the blocks with missing samples interpolated linearly."""
    filled = blocks.copy()
    at = np.arange(blocks.shape[1])
    for k in np.flatnonzero(missing.any(axis=1)):
        there = ~missing[k]
        filled[k] = np.interp(at, at[there], blocks[k, there])
    return filled
