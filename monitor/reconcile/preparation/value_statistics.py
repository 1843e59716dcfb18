"""What the values of one axis show by themselves: the steps they come in, the ends they pile up at, the repeats.

In comes one axis as measured, NaN where nothing was; out goes what was found, or None. Evidence is a gain in
log-likelihood, nats, of values that are so made over values that are not.

Values lie on a grid when every one of them is a whole number of steps from the others; steps far finer than the noise
count too. Numbers have steps of their own, which say nothing of a sensor: the spacing of float32 or float64, or the
last decimal of a text, in SI or in degrees or g. A grid that is no coarser than that is told only where it is as coarse
as a tenth of the noise, when it shapes the spectrum whoever made it.

A continuous quantity never meets its largest value twice; a stepped one meets its last step less often than the form
of the steps before lets expect, and nobody misses what should have come beyond. Repeats of continuous values are each
known; of stepped ones only their number is, by what zero has too much among the differences. Steps larger than the
noise leave repeats untold, and steps of two deviations also the ends.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr, xlogy

from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.estimation.detection.resolution import GAUSSIAN, ON_GRID

Mask = NDArray[np.bool_]

FEW: Final = 16
"""Samples that say anything."""
PART: Final = 4096
"""Samples among which a grid is sought; all are asked whether they lie on it."""
APART: Final = 25.0
"""Of the rounding of the values: finer steps are not told from none."""
SHAPING: Final = 0.1
"""Of the noise: steps as coarse as that are told whoever made them."""
SMOOTH: Final = 0.5
"""Of a step: noise below it leaves to the level between two steps what the ends look like."""
SMOOTHER: Final = 0.9
"""Of a step: with noise above it the level moves the chance of repeats by less than exp(−π²·0.8) = 4·10⁻⁴."""
PERCENT: Final = 0.01
"""To which the share of neighbours that are equal by chance is known, as noise is nearly Gaussian at best."""
CHANCE: Final = 1e-3
"""Expected coincidences are never taken for fewer."""
UNITS: Final = (1.0, np.pi / 180.0, np.pi / 180.0 / 3600.0, 9.80665)
"""Of the texts that values may come from: SI, °/s, °/h, g."""
SAID: Final = 8
"""Different decimals that tell a text from chance; one that has fewer is coarse anyway."""
TAPS: Final = 8
"""Neighbours on each side that a sample is expected from."""
Z95: Final = 1.959964


@dataclass(frozen=True, slots=True)
class Size:
    """A number with its 95 % interval."""

    value: float
    lo: float
    hi: float


@dataclass(frozen=True, slots=True)
class Levels:
    """The grid that all values lie on."""

    step: Size
    offset: float  # of the grid from zero, in [−step/2, step/2]
    levels: int  # from the smallest value to the largest
    noise: float  # σ from sample to sample, steps included
    gain: float  # nats over continuous values

    @property
    def coarse(self) -> float:
        """Step over noise."""
        return self.step.value / self.noise if self.noise > 0.0 else np.inf


@dataclass(frozen=True, slots=True)
class Clipped:
    """Values piled up at an end."""

    limit: Size
    count: int  # samples at the ends that pile up
    upper: bool  # piled up at the largest value
    lower: bool  # at the smallest
    symmetric: bool  # nothing lies beyond ± limit, as y = clip(x, ± limit) has it
    gain: float  # nats over values without an end


@dataclass(frozen=True, slots=True)
class Repeats:
    """Samples that repeat the one before."""

    fraction: Size
    count: float  # in excess of chance
    mask: Mask  # [n] each of them where values are continuous; nowhere where they come in steps
    gain: float  # nats over chance


def levels(y: Floats) -> Levels | None:
    """The grid that all values [n] lie on, if there is one that numbers do not have of themselves.

    >>> x = np.random.default_rng(0).standard_normal(10_000)
    >>> round(levels(0.013 * np.rint(x / 0.013) + 9.81).step.value, 9)
    0.013
    >>> levels(x), levels(x.astype(np.float32).astype(float)), levels(x.round(4))
    (None, None, None)
    """
    values = _finite(y)
    if values.size < FEW:
        return None
    noise = _noise(values)
    part = np.unique(values[np.linspace(0, values.size - 1, min(PART, values.size)).astype(np.int64)])
    if part.size < FEW:
        part = np.unique(values)
    rounding, last = _spacing(part), _last_decimal(part)
    for blur, own in ((rounding, max(rounding, last)), (0.5 * last, last)):
        step = _common(np.unique(np.diff(part)), blur) if blur > 0.0 else None
        if step is not None and (step > 1.5 * own or step >= SHAPING * noise):
            return _on_grid(values, step, blur, noise)
    return None


def clipped(y: Floats, step: float = 0.0) -> Clipped | None:
    """The ends of the range, if values [n] pile up at the largest or the smallest one.

    Args:
        y: values [n]
        step: of the grid that they lie on; 0 = none

    >>> x = np.random.default_rng(0).standard_normal(10_000)
    >>> found = clipped(np.clip(x, -2.5, 2.5))
    >>> round(found.limit.value, 3), found.count, clipped(x)
    (2.5, 131, None)
    """
    values = _finite(y)
    if values.size < FEW:
        return None
    ends = np.array([values.max(), -values.min()])
    if step == 0.0 and max(np.count_nonzero(values == ends[0]), np.count_nonzero(values == -ends[1])) < 2:
        return None  # as of nearly all, and soon said
    noise = _noise(values)
    pile = _stepped_pile if step >= 0.5 * SHAPING * noise > 0.0 else _tied_pile
    gains = np.array([pile(sign * values, end, step, noise) for sign, end in zip((1.0, -1.0), ends, strict=True)])
    if ends.sum() == 0.0 or not gains.max() > 0.0:
        return None
    limit = float(ends[gains.argmax()])
    near = max(0.5 * step, 2.0 * _spacing(values))
    piled = (gains > 0.0) & (np.abs(ends - limit) <= near)
    at = [int(np.count_nonzero(sign * values >= end - near)) for sign, end in zip((1, -1), ends, strict=True)]
    return Clipped(
        limit=Size(abs(limit), abs(limit) - near, abs(limit) + near),
        count=int(np.dot(at, piled)),
        upper=bool(piled[0]),
        lower=bool(piled[1]),
        symmetric=bool(limit > 0.0 and ends.max() <= limit + near),
        gain=float(gains[piled].sum()),
    )


def repeats(y: Floats, step: float = 0.0, limit: float = np.inf) -> Repeats | None:
    """Samples that repeat the one before more often than chance has it.

    None where there are none, and where a stepped axis is too quiet to tell.

    Args:
        y: values [n]
        step: of the grid that they lie on; 0 = none
        limit: of the range; samples at it are left out

    >>> x = np.random.default_rng(0).standard_normal(10_000)
    >>> x[5000] = x[4999]
    >>> repeats(x).count
    1.0
    """
    if step == 0.0 and not (y[1:] == y[:-1]).any():
        return None  # as above
    good = np.isfinite(y) & (np.abs(y) < limit - max(0.5 * step, 1e-9 * abs(limit)) if np.isfinite(limit) else True)
    pairs = good[1:] & good[:-1]
    apart = np.diff(y)[pairs]
    noise = GAUSSIAN * float(np.abs(apart).mean()) if apart.size >= FEW else 0.0
    if not noise > 0.0:
        return None
    if step < 1e-6 * noise:
        return _known_repeats(y, pairs, apart, noise)
    twice = (y[2:] - y[:-2])[good[2:] & good[1:-1] & good[:-2]]
    quiet = GAUSSIAN * float(np.abs(twice).mean()) < SMOOTHER * step  # over two samples repeats matter less
    return None if quiet else _counted_repeats(np.abs(apart) / step, np.abs(twice) / step, y.size)


def _finite(y: Floats) -> Floats:
    return y if np.isfinite(y.sum()) else y[np.isfinite(y)]


def _noise(values: Floats) -> float:
    """σ from sample to sample, by the mean distance of neighbours."""
    return GAUSSIAN * float(_moved(values)) / (values.size - 1)


@compiled
def _moved(values):  # type: ignore[no-untyped-def]
    """Sum of the distances of neighbours."""
    total = 0.0
    for k in range(1, values.size):
        total += abs(values[k] - values[k - 1])
    return total


def _spacing(values: Floats) -> float:
    """Of the largest of these numbers: as float32 where all of them (a few thousand are asked) are."""
    values = values[:: max(1, values.size // PART)]
    largest = float(np.abs(values).max())
    narrow = values.astype(np.float32)
    return float(np.spacing(narrow.dtype.type(largest)) if (narrow == values).all() else np.spacing(largest))


def _last_decimal(levels: Floats) -> float:
    """The last decimal of a text that says all of these values, in the unit it is in; 0 = no text does."""
    some = levels[np.linspace(0, levels.size - 1, min(256, levels.size)).astype(np.int64)]
    some = np.abs(some[some != 0.0])
    if not some.size:
        return 0.0
    most = 6 if _spacing(some) > 1e-9 * some.max() else 13  # float32, float64
    found = 0.0
    for unit in UNITS:
        before = np.floor(np.log10(some / unit) + 1e-12)  # exponent of the first digit
        for digits in range(1, most + 1):
            whole = some / unit * 10.0 ** (digits - 1 - before)
            if (np.abs(whole - np.rint(whole)) < 0.1).all() and np.unique(np.rint(whole)).size > SAID:
                found = max(found, unit * 10.0 ** float(before.max() - digits + 1))
                break
    return found


def _common(gaps: Floats, blur: float) -> float | None:
    """The greatest common divisor of distances (ascending) of values known to ``blur``: Euclid's, with its errors."""
    gaps = gaps[gaps > 2.0 * blur]
    if not gaps.size:
        return None
    step, error, reached = float(gaps[0]), 2.0 * blur, 1.0
    for _ in range(300):
        if step < APART * blur:
            return None
        most = max(1.5, min(0.2 * step / error, 8.0 * reached))  # multiples that the error of the step leaves certain
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


def _on_grid(values: Floats, step: float, blur: float, noise: float) -> Levels | None:
    """The grid with that step, if every value is on it."""
    middle = float(values[values.size // 2])
    for _ in range(2):  # the step from the ends once they are counted
        counts = np.rint((values - middle) / step)
        low, high = values.argmin(), values.argmax()
        between = float(counts[high] - counts[low])
        step = float(values[high] - values[low]) / between if between else step
    left = values - middle
    left -= counts * step
    most = max(float(np.ptp(left)) / 2.0, blur)
    if not (between and most < ON_GRID * step):
        return None
    offset = middle + 0.5 * float(left.max() + left.min())
    told = np.count_nonzero(np.diff(values)) - 1  # a held sample is no evidence
    gain = told * np.log(step / (2.0 * most)) - 2.0 * np.log(between + 1.0)
    error = 2.0 * most / between
    return Levels(
        step=Size(step, step - error, step + error),
        offset=offset - step * float(np.rint(offset / step)),
        levels=int(between) + 1,
        noise=noise,
        gain=float(gain),
    )


def _tied_pile(values: Floats, end: float, step: float, noise: float) -> float:
    """Gain of an end at the largest of continuous values: it is met again and again, and stays."""
    at = values == end
    count = int(np.count_nonzero(at))
    visits = int(np.count_nonzero(at[1:] & ~at[:-1])) + int(at[0])
    if count < 2 or not noise > 0.0:
        return 0.0
    below = values[~at]
    top = np.partition(below, -20)[-20:] if below.size > 20 else below
    ties = max(CHANCE, step * top.size / max(float(end - top.min()), step)) if top.size else CHANCE
    same = np.count_nonzero(values[1:] == values[:-1]) - (count - visits)
    stay = (same + 0.5) / (values.size + 1.0)
    stays = float(count - visits)
    return _poisson_gain(visits - 1, ties) + (
        stays * float(np.log(stays / count / stay)) if stays > stay * count else 0.0
    )


def _stepped_pile(values: Floats, end: float, step: float, noise: float) -> float:
    """Gain of an end at the largest of stepped values.

    Two things must hold, and the lesser gain counts: the last step is met more often than those before it let expect,
    and more samples are missing beyond it than their neighbours, by the best linear interpolation, let expect.
    """
    if noise < SMOOTH * step:
        return 0.0
    counts = np.array([np.count_nonzero(np.abs(values - end + k * step) < 0.5 * step) for k in range(4)], dtype=float)
    pile = max(_not_gaussian(counts), _larger(counts[0], counts[1]))
    if not pile > 0.0:
        return 0.0
    expected, deviation = _from_neighbours(values)
    away = (end + 0.5 * step - expected) / deviation
    return min(pile, -float(log_ndtr(away[away < 7.0]).sum()))


def _not_gaussian(counts: Floats) -> float:
    """Gain of the first of four counts over the parabola that goes through the logarithms of the others."""
    if not counts[1:].all():
        return 0.0
    above = float(np.log(counts) @ np.array([1.0, -3.0, 3.0, -1.0]))
    return 0.5 * above**2 / float((1.0 / counts) @ np.array([1.0, 9.0, 9.0, 1.0])) if above > 0.0 else 0.0


def _larger(one: float, other: float) -> float:
    """Likelihood gain of two counts as they are over equal ones, where the first is larger."""
    half = 0.5 * (one + other)
    return float(xlogy(one, one / half) + xlogy(other, other / half)) if one > other else 0.0


def _from_neighbours(values: Floats) -> tuple[Floats, float]:
    """What TAPS neighbours on each side let expect of every sample, and the deviation from that: linear, symmetric."""
    z = values - values.mean()
    lags = np.array([np.dot(z[: z.size - k], z[k:]) for k in range(2 * TAPS + 1)]) / z.size
    k = np.arange(1, TAPS + 1)
    both = 2.0 * (lags[np.abs(k[:, None] - k)] + lags[k[:, None] + k])
    weights = np.linalg.lstsq(both, 2.0 * lags[k], rcond=1e-10)[0]
    taps = np.concatenate([weights[::-1], [0.0], weights])
    expected = np.convolve(np.pad(z, TAPS, mode="reflect"), taps, mode="valid")
    return expected + values.mean(), float((z - expected).std())


def _known_repeats(y: Floats, pairs: Mask, apart: Floats, noise: float) -> Repeats | None:
    """Of values without a step that is known.

    Where values come back after another one between them they stand on steps all the same: then neighbours are equal by
    chance as often as every other sample is, but for those that were repeated twice.
    """
    mask = np.zeros(y.size, dtype=np.bool_)
    mask[1:] = pairs & (y[1:] == y[:-1])
    count = int(mask.sum())
    later = (y[2:] == y[:-2]) & pairs[1:] & pairs[:-1]
    if np.count_nonzero(later & ~mask[2:]):
        n = float(apart.size)
        again = int(np.count_nonzero(later)) / n
        share = 0.0
        for _ in range(3):
            chance = max(again - share**2, 0.0)
            share = max(count / n - chance, 0.0) / (1.0 - chance)
        gain = min(_larger_share(np.array([count, n * chance]), np.full(2, n)), _beyond(count, n * chance, 0.0))
        error = Z95 * (count + n * again) ** 0.5 / n
        size = Size(share, max(share - error, 0.0), share + error)
        return Repeats(size, n * share, np.zeros_like(mask), gain) if gain > 0.0 else None
    chance = max(CHANCE, apart.size * _spacing(_finite(y)) / (noise * 2.0 * np.pi**0.5))  # density at 0 of a difference
    gain = _poisson_gain(count, chance)
    return Repeats(_wilson(count, apart.size), float(count), mask, gain) if gain > 0.0 else None


def _counted_repeats(apart: Floats, twice: Floats, n: int) -> Repeats | None:
    """Of stepped values, from distances in steps of samples that follow each other, and of every other one.

    Differences of stepped values with a Gaussian difference behind them have a known form (``_steps_apart``): zero has
    too many. Outliers, modulated noise and a level that stays between two steps make too many as well, but then over
    two samples too, where repeats of a share h have h² only. So the lesser gain counts.
    """
    most = int(np.clip(np.ceil(GAUSSIAN * 2.0**0.5 * apart.mean()), 2, 64))
    counts, chance, gain = _beside_form(apart, most)
    _, chance_of_two, _ = _beside_form(twice, most)
    of_two = float(np.count_nonzero(twice < 0.5)) - chance_of_two
    excess = float(counts[0] - chance)
    gain = min(gain, _beyond(float(counts[0]), chance + max(of_two, 0.0), 3.0 * chance**2 / max(counts[1:].sum(), 1.0)))
    if not (excess > 0.0 and gain > 0.0):
        return None
    error = (counts[0] + 3.0 * chance**2 / max(counts[1:].sum(), 1.0)) ** 0.5
    lo, hi = ((excess + sign * Z95 * error) / apart.size for sign in (-1.0, 1.0))
    fraction = Size(excess / apart.size, max(float(lo), 0.0), float(hi))
    return Repeats(fraction, excess, np.zeros(n, dtype=np.bool_), gain)


def _beside_form(apart: Floats, most: int) -> tuple[Floats, float, float]:
    """Counts of 0, 1, … ``most`` steps apart; the zeros that the form of the others lets expect; nats for their own."""
    counts = np.bincount(np.minimum(np.rint(apart), most + 1).astype(np.int64), minlength=most + 2)[:-1].astype(float)
    alone, _ = _best_spread(counts, 0)
    others, spread = _best_spread(counts, 1)
    form = _steps_apart(spread, most)
    chance = float(form[0] / form[1:].sum() * counts[1:].sum())
    free = others + xlogy(counts[0], counts[0] / counts.sum())
    free += xlogy(counts[1:].sum(), counts[1:].sum() / counts.sum())
    return counts, chance, float(free - alone)


def _beyond(count: float, chance: float, variance: float) -> float:
    """Gain of a count over what chance lets expect, known to ``variance`` and to a PERCENT of itself."""
    excess = count - chance
    return 0.5 * excess**2 / (count + chance + variance + (PERCENT * chance) ** 2) if excess > 0.0 else 0.0


def _best_spread(counts: Floats, first: int) -> tuple[float, float]:
    """Largest log-likelihood of counts of 0, 1, … steps apart, from ``first`` on, and the deviation that has it."""
    kept = counts[first:]

    def cost(log_spread: float) -> float:
        form = _steps_apart(float(np.exp(log_spread)), counts.size - 1)[first:]
        return -float(xlogy(kept, form / form.sum()).sum())

    from scipy.optimize import minimize_scalar

    best = minimize_scalar(cost, bounds=(np.log(0.2), np.log(4.0 * counts.size)), method="bounded")
    return -float(best.fun), float(np.exp(best.x))


def _steps_apart(spread: float, most: int) -> Floats:
    """Chances that two stepped values are 0 … ``most`` steps apart, either way, ``spread`` steps the deviation behind.

    With the level anywhere between two steps, the second difference of ∫∫ of the Gaussian (a triangle of two steps
    on it).
    """
    x = np.arange(-1.0, most + 2.0)
    twice = x * ndtr(x / spread) + spread * np.exp(-0.5 * (x / spread) ** 2) / np.sqrt(2.0 * np.pi)
    form = np.maximum(twice[2:] - 2.0 * twice[1:-1] + twice[:-2], 1e-300)
    form[1:] *= 2.0
    return np.asarray(form)


def _larger_share(counts: Floats, trials: Floats) -> float:
    """Likelihood gain of two shares over one, where the first is larger."""
    share, same = counts / trials, counts.sum() / trials.sum()
    if share[0] <= share[1]:
        return 0.0
    return float((xlogy(counts, share / same) + xlogy(trials - counts, (1.0 - share) / (1.0 - same))).sum())


def _poisson_gain(count: float, expected: float) -> float:
    """Likelihood gain of a count over its expectation, where it is larger."""
    return float(count * np.log(count / expected) - count + expected) if count > expected else 0.0


def _wilson(count: int, trials: int) -> Size:
    """A share with its 95 % interval (Wilson 1927)."""
    share, extra = count / trials, Z95**2 / trials
    middle = (share + 0.5 * extra) / (1.0 + extra)
    half = Z95 / (1.0 + extra) * (share * (1.0 - share) / trials + 0.25 * extra / trials) ** 0.5
    return Size(share, max(middle - half, 0.0), middle + half)
