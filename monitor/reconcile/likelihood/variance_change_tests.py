"""Changes of the variance of white residuals over time, in the whole spectrum and in frequency bands.

``compare_variance_change_forms`` fits a step, a trend, a periodic variation and a slow random variation of the
variance. ``find_spectrogram_change`` searches the spectrogram for a change of power.

The spectrogram consists of Fourier transforms of short pieces of the recording. A **tile** is a rectangle of 2^a pieces
by 2^b frequencies, and a **row** contains all tiles of the same frequencies. Each tile is compared with the other tiles
of the row, so that a coloured spectrum has no influence. Bartlett's test detects rows with a varying power.

Outliers must be replaced before these tests, because outliers change the null distributions.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from scipy.fft import dct, fft, idct
from scipy.special import gammaincc, gammaln, polygamma, psi

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled
from monitor.common.distributions import Z95
from monitor.reconcile.preparation.value_artifacts import ValueWithInterval

MIN_SEGMENT_SAMPLES: Final = 16
"""Smallest number of samples on each side of a step."""
STEP_SEARCH_STRIDE: Final = 8
"""Distance in samples between the times of the first search for a step."""
FINE_SEARCH_SAMPLES: Final = 20_000
"""Largest range, in samples, of the second search."""
MIN_BLOCK_SAMPLES: Final = 32
"""Smallest number of samples in a block."""
MAX_VARIANCE_BLOCKS: Final = 4096
MIN_VARIANCE_BLOCKS: Final = 8
"""Smallest number of blocks or pieces for a test of the variance."""
MIN_CYCLES: Final = 2
"""Smallest number of periods of a periodic variance in the recording."""
PIECE_SAMPLES: Final = (256, 2048)
"""Piece lengths of the spectrogram, in samples."""
MIN_SQUARES_PER_CELL: Final = 64
"""Smallest number of squares per tile in a test of a row for constant power."""
MIN_SQUARES_FOR_DECREASE: Final = 8
"""Smallest number of squares in a tile for which a low power is evidence."""


@dataclass(frozen=True, slots=True)
class FittedVarianceStep:
    """Single step of the noise variance."""

    gain: float  # log-likelihood gain over a constant variance, nats
    time: ValueWithInterval  # s from the first sample
    ratio: ValueWithInterval  # standard deviation after the step over the one before it


@dataclass(frozen=True, slots=True)
class PeriodicVariation:
    """Periodic variation of the noise variance σ² (1 + depth sin(2πt/period + phase))."""

    gain: float  # of ln σ² = a + b cos(2πft) + c sin(2πft) over a constant variance, nats
    depth: ValueWithInterval
    period: ValueWithInterval  # s
    phase: float  # rad


@dataclass(frozen=True, slots=True)
class VarianceChangeGains:
    """Log-likelihood gains of a step and of three other changes over a constant variance."""

    step: FittedVarianceStep
    trend_gain: float  # of ln σ² = a + b t + c t², nats
    periodic: PeriodicVariation
    slow_variation_gain: float  # of a slow random variation, nats

    @property
    def largest_gain_other_than_step(self) -> float:
        """Largest log-likelihood gain of the three changes other than a step, in nats."""
        return max(self.trend_gain, self.periodic.gain, self.slow_variation_gain)


@dataclass(frozen=True, slots=True)
class SpectrogramChange:
    """Tile and row of a spectrogram with the largest change of power over time."""

    gain: float  # log-likelihood gain from fitting a separate power to the tile, nats
    time: tuple[float, float]  # time range of the tile, s from the first sample
    frequency: tuple[float, float]  # frequency range of the tile, Hz
    row_gain: float  # −ln of the probability that a row of constant power varies as much, nats
    row: tuple[float, float]  # frequency range of the row, Hz


def compare_variance_change_forms(residuals: Floats, tau0_s: float) -> VarianceChangeGains:
    """Fit a step and three other changes of the variance to white residuals.

    Parameters
    ----------
    residuals : ndarray of float64, shape (n,)
        White residuals without missing samples.
    tau0_s : float
        Sample period in seconds.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> w = rng.standard_normal(60_000)
    >>> w[20_000:] *= 1.2
    >>> found = compare_variance_change_forms(w, 0.01)
    >>> print(f"{found.step.gain > 100} {found.step.time.value:.1f} {found.step.ratio.value:.1f}")
    True 200.5 1.2
    """
    squares = residuals * residuals
    count = count_variance_blocks(residuals.size)
    length = residuals.size // count
    energy = squares[: count * length].reshape(count, length).mean(axis=1)
    scores = energy / energy.mean() - 1.0
    time = np.linspace(-1.0, 1.0, count)
    return VarianceChangeGains(
        step=_best_step(squares, tau0_s),
        trend_gain=_log_linear_gain(energy, length, np.stack([time, time**2 - 1.0 / 3.0])),
        periodic=_fit_periodic_variation(energy, scores, length, tau0_s),
        slow_variation_gain=_slow_variation_gain(scores, length),
    )


def gains_in_frequency_bands(residuals: Floats, variance: Floats, bands: int) -> Floats:
    """Return the log-likelihood gain of a known change of the variance in each of several frequency bands, in nats.

    Parameters
    ----------
    residuals : ndarray of float64, shape (n,)
        White residuals without missing samples.
    variance : ndarray of float64, shape (n,)
        Variance over time, with the mean 1.
    bands : int
        Number of frequency bands of equal width.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> variance = np.repeat([0.5, 1.5], 30_000)
    >>> gains = gains_in_frequency_bands(rng.standard_normal(60_000) * np.sqrt(variance), variance, 4)
    >>> (gains > 0.2 * gains.sum()).all()
    np.True_
    """
    coefficients = dct(residuals, norm="ortho")
    edges = np.linspace(0, residuals.size, bands + 1).astype(np.int64)
    gains = np.empty(bands)
    for k, (first, last) in enumerate(pairwise(edges.tolist())):
        # a transform of the band alone has the power of the band over time, at fewer times
        squares = idct(coefficients[first:last], norm="ortho") ** 2
        there = variance[((np.arange(squares.size) + 0.5) * variance.size / squares.size).astype(np.int64)]
        change = squares / squares.mean() * (1.0 - 1.0 / there) - np.log(there)
        gains[k] = 0.5 * float(change.sum())
    return gains


def count_variance_blocks(sample_count: int) -> int:
    """Return the number of blocks in which the variance is computed."""
    return sample_count // max(MIN_BLOCK_SAMPLES, -(-sample_count // MAX_VARIANCE_BLOCKS))


def find_spectrogram_change(residuals: Floats, tau0_s: float) -> SpectrogramChange:
    """Find the tile and the row of the spectrogram with the largest change of power.

    Parameters
    ----------
    residuals : ndarray of float64, shape (n,)
        White residuals without missing samples.
    tau0_s : float
        Sample period in seconds.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> w, t = rng.standard_normal(60_000), 0.01 * np.arange(60_000)
    >>> w[30_000:40_000] += 0.3 * np.sin(2.0 * np.pi * 17.3 * t[30_000:40_000])
    >>> found = find_spectrogram_change(w, 0.01)
    >>> found.gain > 50.0, found.frequency[0] < 17.3 < found.frequency[1]
    (True, True)
    """
    pieces = [piece for piece in PIECE_SAMPLES if residuals.size >= MIN_VARIANCE_BLOCKS * piece]
    tiles, rows = zip(*(_best_tiles(_piece_spectra(residuals, piece), piece) for piece in pieces), strict=True)
    best, row = max(tiles), max(rows)
    return SpectrogramChange(
        best.gain, best.time_range_s(tau0_s), best.frequency_range_hz(tau0_s), row.gain, row.frequency_range_hz(tau0_s)
    )


def _best_step(squares: Floats, tau0_s: float) -> FittedVarianceStep:
    """Return the most likely step of the variance from the squares of the residuals.

    The step time is first searched at every ``STEP_SEARCH_STRIDE``-th sample, and then at all samples near the maximum.
    """
    sums = np.cumsum(squares)
    k = np.arange(MIN_SEGMENT_SAMPLES, sums.size - MIN_SEGMENT_SAMPLES + 1, STEP_SEARCH_STRIDE)
    gains = _step_gains(sums, k)
    likely = k[gains > gains.max() - 10.0]
    stride = STEP_SEARCH_STRIDE
    if likely[-1] - likely[0] < FINE_SEARCH_SAMPLES:
        stride = 1
        k = np.arange(
            max(likely[0] - STEP_SEARCH_STRIDE, MIN_SEGMENT_SAMPLES),
            min(likely[-1] + STEP_SEARCH_STRIDE, sums.size - MIN_SEGMENT_SAMPLES) + 1,
        )
        gains = _step_gains(sums, k)
    best = int(gains.argmax())
    chance = np.cumsum(np.exp(gains - gains[best]))
    lo, hi = np.searchsorted(chance, np.array([0.025, 0.975]) * chance[-1])
    at = int(k[best])
    after = sums.size - at
    ratio = float(((sums[-1] / sums[at - 1] - 1.0) * at / after) ** 0.5)
    half = float(np.exp(Z95 * (0.5 / at + 0.5 / after) ** 0.5))
    ends = (at, min(int(k[lo]), at) - stride + 1, max(int(k[hi]), at) + stride - 1)
    return FittedVarianceStep(
        float(gains[best]),
        ValueWithInterval(*(one * tau0_s for one in ends)),
        ValueWithInterval(ratio, ratio / half, ratio * half),
    )


def _step_gains(sums: Floats, k: Ints) -> Floats:
    n, before, after = sums.size, sums[k - 1], sums[-1] - sums[k - 1]
    return np.asarray(0.5 * (n * np.log(sums[-1] / n) - k * np.log(before / k) - (n - k) * np.log(after / (n - k))))


def _log_linear_gain(energy: Floats, length: int, rows: Floats) -> float:
    """Return the log-likelihood gain of the variance model ln σ² = a + Σ b_i row_i over a constant variance.

    Fisher scoring fits a Gamma model with logarithmic link to means of ``length`` squares (McCullagh & Nelder 1989).
    """
    x = np.vstack([np.ones(energy.size), rows])
    normal = np.linalg.inv(x @ x.T)
    b = np.zeros(x.shape[0])
    b[0] = np.log(energy.mean())
    for _ in range(20):
        move = normal @ (x @ (energy * np.exp(-(b @ x)) - 1.0))
        b += np.clip(move, -1.0, 1.0)
        if np.abs(move).max() < 1e-6:
            break
    level = b @ x
    constant = energy.size * (np.log(energy.mean()) + 1.0)
    return max(0.5 * length * float(constant - (level + energy * np.exp(-level)).sum()), 0.0)


def _fit_periodic_variation(energy: Floats, scores: Floats, length: int, tau0_s: float) -> PeriodicVariation:
    """Fit a periodic variance at the strongest frequency.

    The errors are those of a sinusoid in white noise (Rife & Boorstyn 1974). The squares have the relative variance 2.
    """
    power = np.abs(np.fft.rfft(scores, 2 * scores.size)) ** 2
    power[: 2 * MIN_CYCLES] = 0.0
    best = int(power[:-1].argmax())
    first = max(8 * best - 8, 16 * MIN_CYCLES)
    around = np.fft.rfft(scores, 16 * scores.size)[first : 8 * best + 9]
    frequency = (first + int(np.abs(around).argmax())) / (16.0 * scores.size)  # cycles per block
    angle = 2.0 * np.pi * frequency * np.arange(scores.size, dtype=np.float64)
    gain = _log_linear_gain(energy, length, np.stack([np.cos(angle), np.sin(angle)]))
    sine, cosine = _fit_modulation(energy, angle) / np.sinc(frequency)  # the blocks average over their length
    depth, error = float(np.hypot(sine, cosine)), 2.0 / float(energy.size * length) ** 0.5
    period_s = length * tau0_s / frequency
    # the phase at the first sample; the first block is centred at half its length
    phase = float(np.arctan2(cosine, sine) - np.pi * frequency * (length - 1) / length)
    relative = 3.0**0.5 * error / (np.pi * max(depth, error) * frequency * energy.size)
    return PeriodicVariation(
        gain,
        ValueWithInterval(min(depth, 1.0), max(depth - Z95 * error, 0.0), depth + Z95 * error),
        ValueWithInterval(period_s, period_s * (1.0 - Z95 * relative), period_s * (1.0 + Z95 * relative)),
        phase % (2.0 * np.pi),
    )


def _fit_modulation(energy: Floats, angle: Floats) -> Floats:
    """Return b/a and c/a of the variance model a + b sin + c cos, by iteratively weighted least squares."""
    x = np.stack([np.ones(angle.size), np.sin(angle), np.cos(angle)])
    level = np.full(angle.size, energy.mean())
    beta = np.zeros(3)
    for _ in range(8):
        weight = 1.0 / level**2
        beta = np.linalg.solve((x * weight) @ x.T, (x * weight) @ energy)
        level = np.maximum(beta @ x, 0.05 * beta[0])
    return np.asarray(beta[1:] / beta[0])


def _slow_variation_gain(scores: Floats, length: int) -> float:
    """Return the log-likelihood gain of a slow random variation of the variance.

    Let p be the mean power of the K lowest frequencies. Fitting a separate variance to these frequencies has the gain K
    (p − 1 − ln p). The result is the largest gain of all K = 2^j with p > 1.
    """
    ordinates = np.abs(np.fft.rfft(scores)[1 : scores.size // 2]) ** 2 * length / (2.0 * scores.size)
    ends = 2 ** np.arange(2, int(np.log2(max(ordinates.size, 4))) + 1)
    means = np.cumsum(ordinates)[np.minimum(ends, ordinates.size) - 1] / ends
    gains = ends * (means - 1.0 - np.log(means))
    return float(np.where(means > 1.0, gains, 0.0).max())


class _TileScore(NamedTuple):
    """Spectrogram tile with the log-likelihood gain from fitting a separate power to the tile."""

    gain: float  # nats
    piece_samples: int
    pieces: int  # number of pieces in the tile
    time_index: int
    frequencies: int  # number of frequencies in the tile
    frequency_index: int

    def time_range_s(self, tau0_s: float) -> tuple[float, float]:
        """Return the time range of the tile in seconds."""
        length = self.pieces * self.piece_samples
        return self.time_index * length * tau0_s, (self.time_index + 1) * length * tau0_s

    def frequency_range_hz(self, tau0_s: float) -> tuple[float, float]:
        """Return the frequency range of the tile in Hz."""
        first, step = self.frequency_index, self.piece_samples * tau0_s
        return first * self.frequencies / step, (first + 1) * self.frequencies / step


def _piece_spectra(w: Floats, piece: int) -> Floats:
    """Return the powers, shape (pieces, piece/2), of all pieces at the frequencies (k + ½)/piece.

    With N samples x_j in a piece, the Fourier transform of (x_j − i x_{j+N/2}) exp(−iπj/N), j < N/2, contains the
    frequencies with even k from 0 to N − 2. The power at an odd k equals the power at N − 1 − k.
    """
    half = piece // 2
    parts = w[: w.size // piece * piece].astype(np.float32).reshape(-1, piece)
    turned = np.exp(-1j * np.pi / piece * np.arange(half)).astype(np.complex64)
    lines = fft((parts[:, :half] - 1j * parts[:, half:]) * turned, axis=1, overwrite_x=True)
    power = np.empty(lines.shape)
    for first, part in ((0, lines[:, : half // 2]), (1, lines[:, : half // 2 - 1 : -1])):
        power[:, first::2] = part.real**2 + part.imag**2
    return power


def _best_tiles(power: Floats, piece: int) -> tuple[_TileScore, _TileScore]:
    best = row = _TileScore(-1.0, piece, 1, 0, 1, 0)
    b, total = 1, power.sum(axis=0)
    while True:
        tall, a = power, 1
        while tall.shape[0] >= 2:
            low, low_at, high, high_at, logs = _column_extremes(tall)
            for x, at in ((low, low_at), (high, high_at)):
                gain, j = _best_contrast(x, total, 2 * a * b, 2 * power.shape[0] * b)
                best = max(best, _TileScore(gain, piece, a, int(at[j]), b, j))
            if 2 * a * b >= MIN_SQUARES_PER_CELL or a == 1:
                gain, j = _bartlett_test(tall.sum(axis=0), logs, tall.shape[0], 2 * a * b)
                row = max(row, _TileScore(gain, piece, a, 0, b, j))
            even = tall.shape[0] // 2 * 2
            tall, a = tall[0:even:2] + tall[1:even:2], 2 * a
        if power.shape[1] == 1:
            return best, row
        power, total, b = power[:, ::2] + power[:, 1::2], total[::2] + total[1::2], 2 * b


@compiled
def _column_extremes(power: Floats) -> tuple[Floats, Ints, Floats, Ints, Floats]:
    """Return the minimum, the maximum, their rows, and the sum of the logarithms of each column.

    For speed, the logarithm is computed for products of eight values.
    """
    rows, columns = power.shape
    low, high, logs = power[0].copy(), power[0].copy(), np.zeros(columns)
    low_at, high_at = np.zeros(columns, np.int64), np.zeros(columns, np.int64)
    product = np.ones(columns)
    for i in range(rows):
        for j in range(columns):
            x = power[i, j]
            product[j] *= max(x, 1e-30)
            if x < low[j]:
                low[j], low_at[j] = x, i
            if x > high[j]:
                high[j], high_at[j] = x, i
        if i % 8 == 7 or i == rows - 1:
            for j in range(columns):
                logs[j] += np.log(product[j])
                product[j] = 1.0
    return low, low_at, high, high_at, logs


@compiled
def _best_contrast(x: Floats, total: Floats, inside: int, whole: int) -> tuple[float, int]:
    """Fit a separate power to one tile of each row, and return the largest gain and the index of its row.

    Let x be the sum of c squares in the tile, and R the sum of the other d squares of the row. The gain is (c+d)/2
    ln((x+R)/(c+d)) − c/2 ln(x/c) − d/2 ln(R/d). A tile with low power is ignored if it has fewer than
    ``MIN_SQUARES_FOR_DECREASE`` squares.
    """
    outside = whole - inside
    best, place = -1.0, 0
    for j in range(x.size):
        u = max(x[j] * whole / (inside * total[j]), 1e-30)
        if u < 1.0 and inside < MIN_SQUARES_FOR_DECREASE:
            gain = 0.0
        else:
            v = max((total[j] - x[j]) * whole / (outside * total[j]), 1e-30)
            gain = -0.5 * (inside * np.log(u) + outside * np.log(v))
        if gain > best:
            best, place = gain, j
    return best, place


def _bartlett_test(total: Floats, logs: Floats, count: int, squares: int) -> tuple[float, int]:
    """Return −ln p of the row with the least constant power, and the index of the row.

    Bartlett's statistic (1937) is c/2 Σ (ln m − ln x_i), with c squares in each power x_i and the mean power m. A Gamma
    distribution with the same mean and variance approximates the distribution.
    """
    uneven = 0.5 * squares * (count * np.log(total / count) - logs)
    j = int(uneven.argmax())
    expected, variance = _bartlett_moments(count, 0.5 * squares)
    shape, x = expected**2 / variance, float(uneven[j]) * expected / variance
    chance = float(gammaincc(shape, x))
    # first term of the asymptotic series, used if the probability underflows
    far = x - (shape - 1.0) * float(np.log(x)) + float(gammaln(shape))
    return -float(np.log(chance)) if chance > 1e-300 else far, j


@lru_cache(maxsize=1024)
def _bartlett_moments(count: int, half: float) -> tuple[float, float]:
    """Return the mean and variance of Bartlett's statistic for ``count`` sums, each of ``2 * half`` squared values."""
    expected = half * count * (float(psi(count * half)) - float(np.log(count)) - float(psi(half)))
    return expected, half**2 * (count * float(polygamma(1, half)) - count**2 * float(polygamma(1, count * half)))
