"""Check whether the axes of a triad are in a different order than in the model.

The spectrum of each recorded axis is compared with the spectrum of each axis of a simulation. One common factor of the
three axes is fitted, because the unit may also be wrong. The noise of a real sensor varies from run to run, so the
noise level of each axis and the power in each band may differ from the model. A permutation is reported if the
permuted axes fit clearly better than the axes in the order of the file, and if the permutation explains most of their
differences. With additional noise, a recorded axis may fit another axis of the model slightly better, but not well. Two
axes with the same spectrum cannot be distinguished and keep their order. Noise spectra do not show the sign of an axis.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import Effect
from monitor.noise.effects import Narrowband
from monitor.reconcile.result import ParameterInterval, RecordingFinding

LEVEL_LOG_SIGMA: Final = 0.12
"""Standard deviation of the logarithm of the noise power of an axis between runs (empirical)."""
BAND_LOG_SIGMA: Final = 0.2
"""Standard deviation of the logarithm of the power in one band, relative to the axis, between runs (empirical)."""
MAX_BAND_COST_NATS: Final = 10.0
"""Upper limit of the cost of a power difference in one band, in nats. It keeps the cost of a moved line small."""
MAX_AXIS_COST_NATS: Final = 32.0
"""Upper limit of the cost of a different noise level on one axis, in nats."""
CORRELATED_BANDS: Final = 3.0
"""Number of neighbouring bands with correlated deviations (empirical)."""
PENALTIES_NATS: Final = {
    order: {0: 0.0, 2: 1.0, 3: 8.0}[sum(at != to for at, to in enumerate(order))] for order in permutations(range(3))
}
"""Penalty in nats for each permutation. If two axes are similar, a permutation of three axes fits as well as a swap."""
MIN_GAIN_NATS: Final = 6.0
"""Smallest gain in nats of a permutation over the order of the file.

The gain of 46 unchanged triads of real sensors was at most 4.0 nats (``tests/experiments/blind/corruptions``).
"""
MIN_EXPLAINED_SHARE: Final = 0.5
"""Smallest decrease of the cost of the permuted axes, relative to their cost in the order of the file."""
IDENTITY: Final = (0, 1, 2)
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


@dataclass(frozen=True, slots=True)
class TriadOrder:
    """Assignment of the recorded axes of a triad to the axes of the model."""

    order: tuple[int, ...]  # for each recorded axis, the index of the axis of the model
    gain: float  # gain in nats over the order of the file
    log_ratios: Floats  # [3] logarithm of the noise of each recorded axis relative to its axis of the model
    error: float  # standard error of the mean of ``log_ratios``, including the variation between runs


def find_axis_order(
    recorded: Sequence[RobustBandSpectrum],
    simulated: Sequence[RobustBandSpectrum],
    peaks: Sequence[tuple[float, float]] = (),
) -> TriadOrder:
    """Find the best assignment of the recorded axes of a triad to the axes of the model.

    Parameters
    ----------
    recorded, simulated : sequence of RobustBandSpectrum
        Spectra of the three recorded axes and of the three axes of a simulation, in the order of their columns.
    peaks : sequence of tuple of float
        Frequency in Hz, and variance of the logarithm of the power, of each resonance of the model.
    """
    cells = [[_compare_spectra(one, other, peaks) for other in simulated] for one in recorded]
    axis_costs = {
        order: _axis_costs([cells[at][to] for at, to in enumerate(order)]) for order in permutations(IDENTITY)
    }
    costs = {order: float(each.sum()) + PENALTIES_NATS[order] for order, each in axis_costs.items()}
    best = min(costs, key=lambda order: costs[order])
    gain, moved = costs[IDENTITY] - costs[best], np.array(best) != IDENTITY
    if gain < max(MIN_GAIN_NATS, MIN_EXPLAINED_SHARE * float(axis_costs[IDENTITY][moved].sum())):
        best, gain = IDENTITY, 0.0
    levels = np.array([cells[at][to][0] for at, to in enumerate(best)])
    return TriadOrder(best, gain, 0.5 * levels, 0.5 * LEVEL_LOG_SIGMA / float(np.sqrt(3.0)))


def compute_resonance_log_power_variances(effects: Iterable[Effect], duration_s: float) -> list[tuple[float, float]]:
    """Return the frequency in Hz of each resonance, and the variance of the logarithm of the resonance power.

    The power of a resonance of bandwidth b changes about π b times per second. In a recording of length T, the power
    is the mean of about 1 + π b T independent values with an exponential distribution.

    Parameters
    ----------
    effects : iterable of Effect
        Effects of the model.
    duration_s : float
        Length of the recording in seconds.
    """
    return [
        (one.frequency, 2.0 / (1.0 + np.pi * one.bandwidth * duration_s))
        for one in effects
        if isinstance(one, Narrowband)
    ]


def _compare_spectra(
    recorded: RobustBandSpectrum, simulated: RobustBandSpectrum, peaks: Sequence[tuple[float, float]]
) -> tuple[float, float]:
    """Return the logarithm of the ratio of the powers of two axes, and the cost in nats of their different shapes."""
    ratio = recorded.log_power - simulated.log_power
    level = float(np.median(ratio))
    variance = recorded.error**2 + simulated.error**2 + BAND_LOG_SIGMA**2
    for f_hz, peak_variance in peaks:  # in the recording and in the simulation
        variance = variance + np.where(np.abs(recorded.f_hz - f_hz) <= recorded.reach_hz, 2.0 * peak_variance, 0.0)
    cost = np.minimum(0.5 * (ratio - level) ** 2 / variance, MAX_BAND_COST_NATS)
    return level, max(float(cost.sum()) / CORRELATED_BANDS, float(cost.max()))  # one band contains a whole line


def _axis_costs(cells: Sequence[tuple[float, float]]) -> Floats:
    """Return the cost in nats of each axis, shape (3,), for one assignment with the best common factor."""
    levels, shape_costs = np.array(cells).T
    level_costs = 0.5 * ((levels - np.median(levels)) / LEVEL_LOG_SIGMA) ** 2
    return np.asarray(np.minimum(level_costs, MAX_AXIS_COST_NATS) + shape_costs)


def describe_axis_order(triad: Sequence[str], found: TriadOrder) -> RecordingFinding | None:
    """Describe permuted axes, or return None if the axes are in the order of the model.

    Parameters
    ----------
    triad : sequence of str
        Names of the three axes.
    found : TriadOrder
        Assignment of the axes.
    """
    moved = {triad[at]: triad[to] for at, to in enumerate(found.order) if at != to}
    if not moved:
        return None
    pairs = ", ".join(f"{column} is {axis}" for column, axis in moved.items())
    return RecordingFinding(
        "axes_permuted",
        tuple(moved),
        f"The columns of the {_sensor_name(triad)} are in a different order than in the model: {pairs}. "
        f"The columns were put in the order of the model.",
        {column: ParameterInterval(axis) for column, axis in moved.items()},
        {"gain_nats": found.gain},
        corrected=True,
    )


def reorder_axes(values: Mapping[str, Floats], triad: Sequence[str], order: Sequence[int]) -> dict[str, Floats]:
    """Return the values with the axes of a triad in the order of the model.

    Parameters
    ----------
    values : mapping of str to ndarray
        Values of all axes.
    triad : sequence of str
        Names of the three axes.
    order : sequence of int
        For each recorded axis, the index of the axis of the model.

    Examples
    --------
    >>> reorder_axes({"gx": 1, "gy": 2, "gz": 3}, ("gx", "gy", "gz"), (1, 2, 0))
    {'gx': 3, 'gy': 1, 'gz': 2}
    """
    moved = {triad[to]: values[triad[at]] for at, to in enumerate(order)}
    return {axis: moved.get(axis, y) for axis, y in values.items()}


def _sensor_name(triad: Sequence[str]) -> str:
    return "gyroscopes" if triad[0].startswith("g") else "accelerometers"


def compute_robust_spectrum(y: Floats, rate_hz: float) -> RobustBandSpectrum | None:
    """Compute the robust spectrum of one axis, or return None if there is no noise or too few complete blocks.

    The spectrum is the median over blocks of the power in frequency bands. A knock, a spike or a gap changes only a few
    blocks and therefore has little effect on the median. The median of the power is smaller than the mean. The ratio of
    median and mean is the same for a recording and a simulation, so the ratio cancels in the comparison.

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
