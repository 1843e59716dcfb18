"""Detect quantization, clipping and repeated samples in the values of one axis.

Each function returns the detected artifact, or None. The evidence is the log-likelihood gain, in nats, over a series
without the artifact.

A quantization step can be a hundredth of the noise. A step of the number format, such as float32 or decimal text, is
reported only if the step is at least a tenth of the noise. Repeated samples cannot be detected if the step exceeds the
noise. Clipping cannot be detected if the step exceeds two standard deviations. Outliers are not tested if the step
exceeds 1.25 standard deviations.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr, xlogy

from drivers.data_types import Floats
from drivers.units import DEGREE, G0
from drivers.validation.number_ranges import HOUR_S
from monitor.common.distributions import Z95
from monitor.estimation.detection.coarse_quantization import GRID_TOLERANCE, SIGMA_PER_MEAN_DISTANCE

Mask = NDArray[np.bool_]

MIN_SAMPLES: Final = 16
GRID_SEARCH_SAMPLES: Final = 4096
"""Number of samples in the search for a grid."""
MIN_STEP_TO_ROUNDING: Final = 25.0
"""Smallest detectable step, as a multiple of the rounding of the values."""
MIN_STEP_TO_NOISE: Final = 0.1
"""Smallest ratio of step to noise at which a step of the number format is reported."""
MIN_INFLUENTIAL_STEP_TO_NOISE: Final = 0.01
"""Smallest ratio of step to noise at which a grid is an artifact. Smaller steps add less than 10⁻⁵ of the variance."""
MIN_NOISE_TO_STEP_CLIPPING: Final = 0.5
"""Smallest ratio of noise to step at which clipping is tested.
"""
MIN_NOISE_TO_STEP_REPEATS: Final = 0.9
"""Smallest ratio of noise to step at which repeats are tested.
"""
MIN_NOISE_TO_STEP_OUTLIERS: Final = 0.8
"""Smallest ratio of noise to step at which outliers are tested. Below 0.74, most samples can have the same value."""
CHANCE_RELATIVE_ERROR: Final = 0.01
"""Relative uncertainty of the expected number of equal neighbours, because the noise is only nearly Gaussian."""
MIN_EXPECTED_COINCIDENCES: Final = 1e-3
TEXT_UNITS: Final = (1.0, DEGREE, DEGREE / HOUR_S, G0)
"""Possible units of values in a text file: SI, °/s, °/h and g."""
MIN_DISTINCT_DECIMALS: Final = 8
"""Smallest number of different decimal numbers that cannot be due to chance."""
PREDICTOR_TAPS: Final = 8


@dataclass(frozen=True, slots=True)
class ValueWithInterval:
    """Value with the 95 % interval."""

    value: float
    lo: float
    hi: float


@dataclass(frozen=True, slots=True)
class QuantizationGrid:
    """Quantization grid of all values."""

    step: ValueWithInterval
    levels: int  # number of grid levels from the smallest to the largest value
    gain: float  # log-likelihood gain over continuous values, nats


@dataclass(frozen=True, slots=True)
class Clipping:
    """Clipping of the values at an end of the measuring range."""

    limit: ValueWithInterval
    count: int  # number of clipped samples
    symmetric: bool  # True if the values are clipped at ± limit
    gain: float  # log-likelihood gain over values without clipping, nats


@dataclass(frozen=True, slots=True)
class RepeatedSamples:
    """Samples that repeat the previous sample."""

    fraction: ValueWithInterval
    count: float  # number of repeats beyond the number expected by chance
    mask: Mask  # [n] True for each repeat of a continuous value; all False for values on a grid
    gain: float  # log-likelihood gain over chance, nats


class ValueArtifacts:
    """Quantization, clipping and repeated samples of an axis, detected on first use.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Measured values in the unit of the axis. NaN marks a missing sample.
    """

    def __init__(self, y: Floats) -> None:
        self._y = y

    @cached_property
    def quantization(self) -> QuantizationGrid | None:
        """Quantization grid, or None if no grid is detected or its step is much smaller than the noise."""
        grid = self._grid
        if grid is None or grid.step.value < MIN_INFLUENTIAL_STEP_TO_NOISE * _sample_noise(_finite_values(self._y)):
            return None
        return grid

    @cached_property
    def _grid(self) -> QuantizationGrid | None:
        return detect_quantization(self._y)

    @cached_property
    def clipping(self) -> Clipping | None:
        """Clipping, or None if no clipping is detected."""
        return detect_clipping(self._y, self._step)

    @cached_property
    def repeats(self) -> RepeatedSamples | None:
        """Repeated samples, or None if no repeats are detected."""
        ends = self.clipping
        return detect_repeats(self._y, self._step, ends.limit.value if ends and ends.symmetric else np.inf)

    @cached_property
    def is_too_coarse_for_outliers(self) -> bool:
        """True if the step is so large that all samples beside the most frequent value would appear as outliers."""
        return self._step > 0.0 and _noise_despite_repeats(_finite_values(self._y)) < (
            MIN_NOISE_TO_STEP_OUTLIERS * self._step
        )

    @property
    def _step(self) -> float:
        return self._grid.step.value if self._grid else 0.0


def detect_quantization(y: Floats) -> QuantizationGrid | None:
    """Detect the quantization grid of the values.

    A fine grid due to the number format is not reported.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Values in the unit of the axis. NaN marks a missing sample.

    Returns
    -------
    QuantizationGrid or None
        Quantization grid, or None if no grid is detected.

    Examples
    --------
    >>> x = np.random.default_rng(0).standard_normal(10_000)
    >>> round(detect_quantization(0.013 * np.rint(x / 0.013) + 9.81).step.value, 9)
    0.013
    >>> detect_quantization(x), detect_quantization(x.astype(np.float32).astype(float)), detect_quantization(x.round(4))
    (None, None, None)
    """
    values = _finite_values(y)
    if values.size < MIN_SAMPLES:
        return None
    noise = _sample_noise(values)
    part = np.unique(values[np.linspace(0, values.size - 1, min(GRID_SEARCH_SAMPLES, values.size)).astype(np.int64)])
    if part.size < MIN_SAMPLES:
        part = np.unique(values)
    rounding, last = _float_spacing(part), _last_decimal(part)
    gaps = np.unique(np.diff(part))
    for blur, own in ((rounding, max(rounding, last)), (0.5 * last, last)):
        step = _common_divisor(gaps, blur) if blur > 0.0 else None
        if step is not None and (step > 1.5 * own or step >= MIN_STEP_TO_NOISE * noise):
            return _fit_coarser_grid(values, gaps, step) or _fit_grid(values, step, blur)
    return None


def detect_clipping(y: Floats, step: float = 0.0) -> Clipping | None:
    """Detect clipping at the largest or smallest value.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Values in the unit of the axis. NaN marks a missing sample.
    step : float, optional
        Step of the grid that the values lie on, in the unit of ``y``. Zero means no grid.

    Returns
    -------
    Clipping or None
        Detected clipping, or None if no clipping is detected.

    Examples
    --------
    >>> x = np.random.default_rng(0).standard_normal(10_000)
    >>> found = detect_clipping(np.clip(x, -2.5, 2.5))
    >>> round(found.limit.value, 3), found.count, detect_clipping(x)
    (2.5, 131, None)
    """
    values = _finite_values(y)
    if values.size < MIN_SAMPLES:
        return None
    ends = np.array([values.max(), -values.min()])
    if step == 0.0 and max(np.count_nonzero(values == ends[0]), np.count_nonzero(values == -ends[1])) < 2:
        return None  # most recordings end here
    noise = _sample_noise(values)
    pile = _stepped_clipping_gain if step >= 0.5 * MIN_STEP_TO_NOISE * noise > 0.0 else _continuous_clipping_gain
    gains = np.array([pile(sign * values, end, step, noise) for sign, end in zip((1.0, -1.0), ends, strict=True)])
    if ends.sum() == 0.0 or not gains.max() > 0.0:
        return None
    limit = float(ends[gains.argmax()])
    near = max(0.5 * step, 2.0 * _float_spacing(values))
    piled = (gains > 0.0) & (np.abs(ends - limit) <= near)
    at = [int(np.count_nonzero(sign * values >= end - near)) for sign, end in zip((1, -1), ends, strict=True)]
    return Clipping(
        limit=ValueWithInterval(abs(limit), abs(limit) - near, abs(limit) + near),
        count=int(np.dot(at, piled)),
        symmetric=bool(limit > 0.0 and ends.max() <= limit + near),
        gain=float(gains[piled].sum()),
    )


def detect_repeats(y: Floats, step: float = 0.0, limit: float = np.inf) -> RepeatedSamples | None:
    """Detect repeated samples that are more frequent than expected by chance.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Values in the unit of the axis. NaN marks a missing sample.
    step : float, optional
        Step of the grid that the values lie on, in the unit of ``y``. Zero means no grid.
    limit : float, optional
        Limit of the measuring range, in the unit of ``y``. Samples at the limit are not tested.

    Returns
    -------
    RepeatedSamples or None
        Repeated samples, or None if no repeats are detected or the step is too coarse.

    Examples
    --------
    >>> x = np.random.default_rng(0).standard_normal(10_000)
    >>> x[5000] = x[4999]
    >>> detect_repeats(x).count
    1.0
    """
    if step == 0.0 and not (y[1:] == y[:-1]).any():
        return None  # most recordings end here
    good = np.isfinite(y) & (np.abs(y) < limit - max(0.5 * step, 1e-9 * abs(limit)) if np.isfinite(limit) else True)
    pairs = good[1:] & good[:-1]
    apart = np.diff(y)[pairs]
    noise = SIGMA_PER_MEAN_DISTANCE * float(np.abs(apart).mean()) if apart.size >= MIN_SAMPLES else 0.0
    if not noise > 0.0:
        return None
    if step < 1e-6 * noise:
        return _repeats_of_continuous(y, pairs, apart, noise)
    twice = (y[2:] - y[:-2])[good[2:] & good[1:-1] & good[:-2]]
    # repeated samples have less influence on differences over two samples
    quiet = SIGMA_PER_MEAN_DISTANCE * float(np.abs(twice).mean()) < MIN_NOISE_TO_STEP_REPEATS * step
    return None if quiet else _repeats_of_stepped(np.abs(apart) / step, np.abs(twice) / step, y.size)


def _finite_values(y: Floats) -> Floats:
    return y if np.isfinite(y.sum()) else y[np.isfinite(y)]


def _sample_noise(values: Floats) -> float:
    return SIGMA_PER_MEAN_DISTANCE * float(np.abs(np.diff(values)).mean())


def _noise_despite_repeats(values: Floats) -> float:
    """Return the noise from differences over two samples, on which repeated samples have less influence."""
    return SIGMA_PER_MEAN_DISTANCE * float(np.abs(values[2:] - values[:-2]).mean())


def _float_spacing(values: Floats) -> float:
    """Return the spacing of float32 or float64 numbers at the largest value."""
    values = values[:: max(1, values.size // GRID_SEARCH_SAMPLES)]
    largest = float(np.abs(values).max())
    narrow = values.astype(np.float32)
    return float(np.spacing(narrow.dtype.type(largest)) if (narrow == values).all() else np.spacing(largest))


def _last_decimal(levels: Floats) -> float:
    """Return the unit of the last decimal place, in SI units, or 0 if the values are not decimal numbers."""
    some = levels[np.linspace(0, levels.size - 1, min(256, levels.size)).astype(np.int64)]
    some = np.abs(some[some != 0.0])
    if not some.size:
        return 0.0
    most = 6 if _float_spacing(some) > 1e-9 * some.max() else 13  # float32, float64
    found = 0.0
    for unit in TEXT_UNITS:
        before = np.floor(np.log10(some / unit) + 1e-12)  # exponent of the first digit
        for digits in range(1, most + 1):
            whole = some / unit * 10.0 ** (digits - 1 - before)
            if (np.abs(whole - np.rint(whole)) < 0.1).all() and np.unique(np.rint(whole)).size > MIN_DISTINCT_DECIMALS:
                found = max(found, unit * 10.0 ** float(before.max() - digits + 1))
                break
    return found


def _common_divisor(gaps: Floats, blur: float) -> float | None:
    """Return the greatest common divisor of distances with errors up to ``blur``, by Euclid's algorithm."""
    gaps = gaps[gaps > 2.0 * blur]
    if not gaps.size:
        return None
    step, error, reached = float(gaps[0]), 2.0 * blur, 1.0
    for _ in range(300):
        if step < MIN_STEP_TO_ROUNDING * blur:
            return None
        most = max(1.5, min(0.2 * step / error, 8.0 * reached))  # largest multiple that the error allows to determine
        near = gaps[: max(1, np.searchsorted(gaps, most * step))]
        counts = np.rint(near / step)
        if counts[0] * error > 0.25 * step:
            return None
        off = np.abs(near - counts * step)
        allowed = 2.0 * blur + counts * error
        wrong = off > allowed
        if wrong.any():
            least = np.flatnonzero(wrong)[off[wrong].argmin()]
            step, error, reached = float(off[least]), float(allowed[least]), 1.0
        elif near.size == gaps.size or counts[-1] <= reached:
            return float(near[-1] / counts[-1])
        else:
            reached = float(counts[-1])
            step, error = float(near[-1] / reached), 2.0 * blur / reached
    return None


def _fit_coarser_grid(values: Floats, gaps: Floats, step: float) -> QuantizationGrid | None:
    """Fit a coarser grid whose levels were rounded to multiples of ``step``, as in a text file."""
    coarser = _common_divisor(gaps, 0.5 * step)
    return None if coarser is None else _fit_grid(values, coarser, 0.5 * step)


def _fit_grid(values: Floats, step: float, blur: float) -> QuantizationGrid | None:
    middle = float(values[values.size // 2])
    for _ in range(2):  # the second pass uses the step derived from the two extreme values
        counts = np.rint((values - middle) / step)
        low, high = values.argmin(), values.argmax()
        between = float(counts[high] - counts[low])
        step = float(values[high] - values[low]) / between if between else step
    left = values - middle
    left -= counts * step
    most = max(float(np.ptp(left)) / 2.0, blur)
    if not (between and most < GRID_TOLERANCE * step):
        return None
    informative = np.count_nonzero(np.diff(values)) - 1  # repeated samples contain no information about the grid
    gain = informative * np.log(step / (2.0 * most)) - 2.0 * np.log(between + 1.0)
    error = 2.0 * most / between
    return QuantizationGrid(
        step=ValueWithInterval(step, step - error, step + error),
        levels=int(between) + 1,
        gain=float(gain),
    )


def _continuous_clipping_gain(values: Floats, end: float, step: float, noise: float) -> float:
    """Return the gain of clipping at the maximum for continuous values."""
    at = values == end
    count = int(np.count_nonzero(at))
    visits = int(np.count_nonzero(at[1:] & ~at[:-1])) + int(at[0])
    if count < 2 or not noise > 0.0:
        return 0.0
    below = values[~at]
    top = np.partition(below, -20)[-20:] if below.size > 20 else below
    ties = (
        max(MIN_EXPECTED_COINCIDENCES, step * top.size / max(float(end - top.min()), step))
        if top.size
        else MIN_EXPECTED_COINCIDENCES
    )
    same = np.count_nonzero(values[1:] == values[:-1]) - (count - visits)
    stay = (same + 0.5) / (values.size + 1.0)
    stays = float(count - visits)
    return _poisson_gain(visits - 1, ties) + (
        stays * float(np.log(stays / count / stay)) if stays > stay * count else 0.0
    )


def _stepped_clipping_gain(values: Floats, end: float, step: float, noise: float) -> float:
    """Return the gain of clipping at the highest level for values on a grid.

    The gain is the smaller of the gains of two tests. The first test compares the counts of the highest levels. The
    second test predicts each sample from the neighbouring samples.
    """
    if noise < MIN_NOISE_TO_STEP_CLIPPING * step:
        return 0.0
    high = values[values > end - 4.0 * step]
    counts = np.array([np.count_nonzero(np.abs(high - end + k * step) < 0.5 * step) for k in range(4)], dtype=float)
    pile = max(_excess_over_parabola(counts), _count_difference_gain(counts[0], counts[1]))
    if not pile > 0.0:
        return 0.0
    expected, deviation = _predict_from_neighbours(values)
    away = (end + 0.5 * step - expected) / deviation
    return min(pile, -float(log_ndtr(away[away < 7.0]).sum()))


def _excess_over_parabola(counts: Floats) -> float:
    if not counts[1:].all():
        return 0.0
    above = float(np.log(counts) @ np.array([1.0, -3.0, 3.0, -1.0]))
    return 0.5 * above**2 / float((1.0 / counts) @ np.array([1.0, 9.0, 9.0, 1.0])) if above > 0.0 else 0.0


def _count_difference_gain(one: float, other: float) -> float:
    """Return the log-likelihood gain of two different expected counts over equal expected counts, or 0."""
    half = 0.5 * (one + other)
    return float(xlogy(one, one / half) + xlogy(other, other / half)) if one > other else 0.0


def _predict_from_neighbours(values: Floats) -> tuple[Floats, float]:
    """Return a linear prediction of every sample from neighbouring samples, and the standard deviation of the error."""
    z = values - values.mean()
    # einsum runs in one thread, and threads of np.dot would wait for each other
    lags = np.array([np.einsum("i,i->", z[: z.size - k], z[k:]) for k in range(2 * PREDICTOR_TAPS + 1)]) / z.size
    k = np.arange(1, PREDICTOR_TAPS + 1)
    both = 2.0 * (lags[np.abs(k[:, None] - k)] + lags[k[:, None] + k])
    weights = np.linalg.lstsq(both, 2.0 * lags[k], rcond=1e-10)[0]
    taps = np.concatenate([weights[::-1], [0.0], weights])
    expected = np.convolve(np.pad(z, PREDICTOR_TAPS, mode="reflect"), taps, mode="valid")
    return expected + values.mean(), float((z - expected).std())


def _repeats_of_continuous(y: Floats, pairs: Mask, differences: Floats, noise: float) -> RepeatedSamples | None:
    """Return the repeated samples in values without a detected grid.

    If samples two positions apart are equal, the values lie on an unknown grid, and some repeats are due to chance.
    """
    mask = np.zeros(y.size, dtype=np.bool_)
    mask[1:] = pairs & (y[1:] == y[:-1])
    count = int(mask.sum())
    later = (y[2:] == y[:-2]) & pairs[1:] & pairs[:-1]
    if np.count_nonzero(later & ~mask[2:]):
        n = float(differences.size)
        again = int(np.count_nonzero(later)) / n
        share = 0.0
        for _ in range(3):
            chance = max(again - share**2, 0.0)
            share = max(count / n - chance, 0.0) / (1.0 - chance)
        gain = min(
            _share_difference_gain(np.array([count, n * chance]), np.full(2, n)), _excess_gain(count, n * chance, 0.0)
        )
        error = Z95 * (count + n * again) ** 0.5 / n
        size = ValueWithInterval(share, max(share - error, 0.0), share + error)
        return RepeatedSamples(size, n * share, np.zeros_like(mask), gain) if gain > 0.0 else None
    # probability density of a zero difference, times the spacing of the numbers
    chance = max(
        MIN_EXPECTED_COINCIDENCES, differences.size * _float_spacing(_finite_values(y)) / (noise * 2.0 * np.pi**0.5)
    )
    gain = _poisson_gain(count, chance)
    return RepeatedSamples(_wilson_interval(count, differences.size), float(count), mask, gain) if gain > 0.0 else None


def _repeats_of_stepped(differences: Floats, differences_over_two: Floats, n: int) -> RepeatedSamples | None:
    """Return the repeated samples in values on a grid.

    Repeats, outliers and modulated noise all increase the number of zero differences between neighbours. Unlike
    outliers and modulated noise, repeats have little influence on the differences over two samples. The result has the
    smaller of the gains of two tests, with and without the differences over two samples.
    """
    most = int(np.clip(np.ceil(SIGMA_PER_MEAN_DISTANCE * 2.0**0.5 * differences.mean()), 2, 64))
    counts, chance, gain = _zero_difference_excess(differences, most)
    _, chance_of_two, _ = _zero_difference_excess(differences_over_two, most)
    of_two = float(np.count_nonzero(differences_over_two < 0.5)) - chance_of_two
    excess = float(counts[0] - chance)
    gain = min(
        gain, _excess_gain(float(counts[0]), chance + max(of_two, 0.0), 3.0 * chance**2 / max(counts[1:].sum(), 1.0))
    )
    if not (excess > 0.0 and gain > 0.0):
        return None
    error = (counts[0] + 3.0 * chance**2 / max(counts[1:].sum(), 1.0)) ** 0.5
    lo, hi = ((excess + sign * Z95 * error) / differences.size for sign in (-1.0, 1.0))
    fraction = ValueWithInterval(excess / differences.size, max(float(lo), 0.0), float(hi))
    return RepeatedSamples(fraction, excess, np.zeros(n, dtype=np.bool_), gain)


def _zero_difference_excess(differences: Floats, most: int) -> tuple[Floats, float, float]:
    """Compare the number of zero differences with the prediction from all other differences.

    Returns
    -------
    counts : ndarray of float64, shape (most + 1,)
        Counts of differences of 0, 1, … ``most`` steps.
    chance : float
        Predicted number of zero differences.
    gain : float
        Log-likelihood gain of a fitted number of zero differences, nats.
    """
    counts = np.bincount(np.minimum(np.rint(differences), most + 1).astype(np.int64), minlength=most + 2)[:-1].astype(
        float
    )
    alone, _ = _fit_difference_spread(counts, 0)
    others, spread = _fit_difference_spread(counts, 1)
    form = _step_difference_probabilities(spread, most)
    chance = float(form[0] / form[1:].sum() * counts[1:].sum())
    free = others + xlogy(counts[0], counts[0] / counts.sum())
    free += xlogy(counts[1:].sum(), counts[1:].sum() / counts.sum())
    return counts, chance, float(free - alone)


def _excess_gain(count: float, chance: float, variance: float) -> float:
    """Return the log-likelihood gain of a count over an uncertain expected count, or 0."""
    excess = count - chance
    return (
        0.5 * excess**2 / (count + chance + variance + (CHANCE_RELATIVE_ERROR * chance) ** 2) if excess > 0.0 else 0.0
    )


def _fit_difference_spread(counts: Floats, first: int) -> tuple[float, float]:
    """Fit Gaussian noise to a histogram of differences in quantization steps.

    Counts below ``first`` are ignored. Return the log-likelihood and the standard deviation.
    """
    kept = counts[first:]

    def negative_log_likelihood(log_spread: float) -> float:
        form = _step_difference_probabilities(float(np.exp(log_spread)), counts.size - 1)[first:]
        return -float(xlogy(kept, form / form.sum()).sum())

    from scipy.optimize import minimize_scalar

    best = minimize_scalar(negative_log_likelihood, bounds=(np.log(0.2), np.log(4.0 * counts.size)), method="bounded")
    return -float(best.fun), float(np.exp(best.x))


def _step_difference_probabilities(spread: float, most: int) -> Floats:
    """Return the probabilities that two values on a grid differ by 0 … ``most`` steps.

    Before rounding, the difference is Gaussian with the standard deviation ``spread``, in steps. Each probability is
    the integral of the Gaussian density times a triangle with a width of two steps.
    """
    x = np.arange(-1.0, most + 2.0)
    twice = x * ndtr(x / spread) + spread * np.exp(-0.5 * (x / spread) ** 2) / np.sqrt(2.0 * np.pi)
    form = np.maximum(twice[2:] - 2.0 * twice[1:-1] + twice[:-2], 1e-300)
    form[1:] *= 2.0
    return np.asarray(form)


def _share_difference_gain(counts: Floats, trials: Floats) -> float:
    """Return the log-likelihood gain of two different shares over a common share, or 0."""
    share, same = counts / trials, counts.sum() / trials.sum()
    if share[0] <= share[1]:
        return 0.0
    return float((xlogy(counts, share / same) + xlogy(trials - counts, (1.0 - share) / (1.0 - same))).sum())


def _poisson_gain(count: float, expected: float) -> float:
    """Return the log-likelihood gain of a Poisson count over the expected count, or 0."""
    return float(count * np.log(count / expected) - count + expected) if count > expected else 0.0


def _wilson_interval(count: int, trials: int) -> ValueWithInterval:
    share, extra = count / trials, Z95**2 / trials
    middle = (share + 0.5 * extra) / (1.0 + extra)
    half = Z95 / (1.0 + extra) * (share * (1.0 - share) / trials + 0.25 * extra / trials) ** 0.5
    return ValueWithInterval(share, max(middle - half, 0.0), middle + half)
