"""The fading window: Allan variance under weights that decay with age, in a few kilobytes for any memory.

Comes in: samples, missing ones as NaN in their places. Goes out: for every cluster size m and axis the weighted mean
of squared second differences, σ²(m) = Σ w d² / (2 m² Σ w), where w decays with age a by one pole, e^(-a/T), or by two,
(1 + a) e^(-a/T). Nothing is evicted, so no sample is remembered: months fit where ``window`` would need gigabytes.

- Phase is the integer of ``window``, modulo 2⁶⁴ and with each rounding carried on, so offsets do not matter.
- A term is taken every ``stride`` samples, the power of two in (m/16, m/8]: of the degrees of freedom this loses 1.9 %
  under white noise, less under any other (by ``edf``). So a cluster is 8 to 15 strides, and 31 phase points 2^j samples
  apart serve all m of that octave. An octave works half as often as the one before: all τ together cost a constant.
- Σ w fades with the sums: the mean is unbiased from the first term on. A term that touches a missing sample adds to
  neither, while time, and with it fading, goes on.
- Rounding errors fade like what they came with: never more than memory/stride · 2⁻⁵³ of σ².

``memory`` is the length of the rectangle whose deviation has the same variance: T is memory/2 for one pole, memory/4
for two. Beside that rectangle one pole is 99 % through a step after 2.3 memories, two poles after 1.7.
"""

from typing import Final, Literal

import numpy as np

from drivers.errors import ConfigError
from drivers.sample import Floats, Ints
from monitor.common.compiled import compiled
from monitor.estimation.allan.window import MIN_LENGTH, phase_scale
from monitor.estimation.allan.window_kernel import AXES, STAGE_SAMPLES

Noise = Literal["white", "flicker", "walk"]

STEPS: Final = 8
"""Strides in a cluster of 8 samples and more, at least; at most one less than twice as many."""
POINTS: Final = 32
"""Phase points kept an octave: two clusters of 15 strides and both ends, as a power of two."""
MAX_MEMORY: Final = 1 << 40
"""Samples: 35 years at 1 kHz."""
GONE: Final = 1e-280
"""A sum of weights below this has been fading for 600 T and more, and holds no digits."""
TAIL: Final = 16
"""Clusters after which flicker's second differences are taken for uncorrelated: ρ² < 1e-7 there."""
LEVEL, REACH = 0, 1
"""Of a row: stride = 2^level, m = reach · stride."""
D2, WEIGHT, SQUARE = 0, 1, 2
"""Of a row's sums: Σ λ^a d², Σ λ^a, Σ λ^2a over its terms of age a strides."""
D2_LATE, WEIGHT_LATE, SQUARE_LATE, SQUARE_LATER = 3, 4, 5, 6
"""With two poles also Σ (1 + a) λ^a d², Σ (1 + a) λ^a, Σ (1 + a) λ^2a and Σ (1 + a)(2 + a)/2 λ^2a: each fades and takes
in the one before."""
CASCADES: Final = {1: ((D2,), (WEIGHT,), (SQUARE,)),
                   2: ((D2, D2_LATE), (WEIGHT, WEIGHT_LATE), (SQUARE, SQUARE_LATE, SQUARE_LATER))}  # fmt: skip


class FadingWindow:
    """Exponentially weighted Allan variance of six axes at many cluster sizes.

    Args:
        factors: cluster sizes m in samples, ascending, 2m ≤ memory; from 16 on multiples of the power of two
            in (m/16, m/8], as those of the octave grid are
        memory: samples of the rectangle of equal variance, MIN_LENGTH … MAX_MEMORY
        poles: 1, or 2 for weights that begin to fall later and then fall faster

    >>> window = FadingWindow(np.array([1, 2]), memory=100)
    >>> window.update(np.tile([[1.0], [2.0]], (50, 6)))   # 1, 2, 1, 2, … : σ²(1) = 1/2, σ²(2) = 0
    >>> window.avar()[:, 0].round(12).tolist()
    [0.5, 0.0]
    """

    def __init__(self, factors: Ints, memory: float, poles: Literal[1, 2] = 1) -> None:
        if not MIN_LENGTH <= memory <= MAX_MEMORY:
            raise ConfigError(f"memory of {memory:g} samples; possible are {MIN_LENGTH} to {MAX_MEMORY}")
        if poles not in (1, 2):
            raise ConfigError(f"{poles} poles; possible are 1 and 2")
        self.factors = factors.astype(np.int64)
        self.strides = _strides(self.factors, memory)
        self.memory = memory
        self.poles = poles
        levels = np.log2(self.strides).astype(np.int64)
        self._rows = np.stack([levels, self.factors // self.strides], axis=1)
        self._fades = np.exp(-2.0 * poles * self.strides / memory)
        self._scale = phase_scale(int(self.factors[-1]))[:AXES]
        self._scaling = np.zeros((2, AXES))  # units of phase, and what rounding left of the sample before
        self._rings = np.zeros((int(levels[-1]) + 1, POINTS, 2, AXES), np.int64)
        self._now = np.zeros((2, AXES), np.int64)  # phase, and how many samples have been missing
        self._total = np.zeros(1, np.int64)
        self._sums = np.zeros((self.factors.size, sum(map(len, CASCADES[poles])), AXES))
        self._stage = np.zeros((STAGE_SAMPLES, AXES))
        self.reset()

    @property
    def total(self) -> int:
        """Samples since the last reset, missing ones included."""
        return int(self._total[0])

    def reset(self) -> None:
        """Forget all samples."""
        for array in (self._scaling, self._rings, self._now, self._total, self._sums):
            array[:] = 0
        self._scaling[0] = self._scale

    def update(self, values: Floats) -> None:
        """Advance by samples [n, 6], one by one; NaN, and what no phase can hold (``phase_scale``), = missing."""
        rows = np.asarray(values)
        if rows.ndim != 2 or rows.shape[1] != AXES:
            raise ValueError(f"samples of shape {rows.shape}; expected is [n, {AXES}]")
        for start in range(0, len(rows), STAGE_SAMPLES):
            part = rows[start : start + STAGE_SAMPLES]
            self._stage[: len(part)] = part
            _advance(
                len(part), self._stage, self._scaling, self._total, self._now, self._rings,
                self._rows, self._fades, self._sums,
            )  # fmt: skip

    def skip(self, n: int) -> None:
        """Advance by n missing samples at the cost of one: points in their places, weights faded."""
        before = self.total
        self._total += n
        for level, ring in enumerate(self._rings):
            newest = self.total >> level
            places = np.arange(max(before >> level, newest - POINTS) + 1, newest + 1)
            ring[places % POINTS] = self._now
            ring[places % POINTS, 1] += ((places << level) - before)[:, None]
        self._now[1] += n
        steps = self.total // self.strides - before // self.strides
        for cascade, fades in zip(CASCADES[self.poles], (self._fades, self._fades, self._fades**2), strict=True):
            self._sums[:, cascade] = _faded(self._sums[:, cascade], fades, steps)

    def avar(self) -> Floats:
        """Allan variance [m, 6] in unit² of the axis; NaN where no term is complete."""
        sums, weights = self._sums[:, D2 if self.poles == 1 else D2_LATE], self._weights()
        # a constant axis shows second differences of up to one unit, the rounding of its phase: no noise at all
        sums = np.where(sums <= weights, 0.0, sums)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.where(weights > GONE, sums / weights, np.nan)
        return np.asarray(mean / (2.0 * (self.factors[:, None] * self._scale) ** 2))

    def terms(self) -> Floats:
        """Effective number of second differences averaged, (Σ w)² / Σ w² [m, 6]; 0 where there is none."""
        weights, squares = self._weights(), self._sums[:, SQUARE]
        if self.poles == 2:  # (1 + a)² = 2 (1 + a)(2 + a)/2 - (1 + a)
            squares = 2.0 * self._sums[:, SQUARE_LATER] - self._sums[:, SQUARE_LATE]
        there = weights > GONE
        return np.where(there, weights * (weights / np.where(there, squares, 1.0)), 0.0)

    def edf(self, noise: Noise) -> Floats:
        """Equivalent degrees of freedom [m, 6] of σ² under one kind of noise, for χ² intervals; NaN without terms.

        Exact for a window without gaps once it has run for three memories. At the start the weights' correlation
        stands for that of the fewer terms there are: up to 15 % too few where there are several clusters, never below
        one. Simulated: 6,000 records, ratios 0.93 to 1.05 at five τ and three noises, after five memories.
        """
        terms = self.terms()
        rows = zip(self.factors, self.strides, self._fades, strict=True)
        shared = np.array([_shared(float(m), float(stride), fade, self.poles, noise) for m, stride, fade in rows])
        return np.where(terms > 0.0, np.maximum(terms / shared[:, None], 1.0), np.nan)

    def _weights(self) -> Floats:
        """Σ w of each row and axis."""
        return self._sums[:, WEIGHT if self.poles == 1 else WEIGHT_LATE]


def _strides(factors: Ints, memory: float) -> Ints:
    """Samples between terms of each row; ConfigError where a row has none."""
    if factors.size == 0 or factors[0] < 1 or 2 * factors[-1] > memory or (np.diff(factors) <= 0).any():
        raise ConfigError(f"cluster sizes {factors.tolist()} must ascend within 1 and {memory / 2:g}")
    strides: Ints = 2 ** np.array([max(0, int(m // STEPS).bit_length() - 1) for m in factors], np.int64)
    for m, stride in zip(factors, strides, strict=True):
        if m % stride:
            raise ConfigError(
                f"cluster size {m} is no multiple of {stride}; the nearest is {round(m / stride) * stride}"
            )
    return strides


def _shared(m: float, stride: float, fade: float, poles: int, noise: Noise) -> float:
    """By how much correlation lowers the number of terms: Σ_c ρ(c)² Σ w(a) w(a + c) / Σ w².

    As in ``uncertainty``: Var(Σ w d²) = 2 Σ_c r(c)² Σ_a w(a) w(a + c), r the second differences in both clusters of
    the autocovariance of phase; and Σ_a (1 + a)(1 + a + c) λ^(2a + c) = λ^c [(1 + λ²)/(1 - λ²)³ + c/(1 - λ²)²].
    """
    lag = np.arange(TAIL * m / stride)
    weights = fade**lag
    if poles == 2:
        weights *= 1.0 + lag * (1.0 - fade**2) / (1.0 + fade**2)
    t = np.abs(lag * stride + m * np.arange(-2.0, 3.0)[:, None])
    phase = {
        "white": -t,
        "flicker": t**2 * np.log(np.where(t > 0.0, t, 1.0)),
        "walk": t**3 - t,
    }[noise]
    r = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) @ phase
    if noise != "flicker":
        r[lag * stride >= 2.0 * m] = 0.0  # by algebra; rounding would leave something
    shares = weights * (r / r[0]) ** 2
    return float(2.0 * shares.sum() - 1.0)


def _faded(cascade: Floats, fades: Floats, steps: Ints) -> Floats:
    """A cascade [m, order, 6] after ``steps`` steps [m] in which nothing enters."""
    p = steps[:, None].astype(np.float64)
    later = cascade.copy()
    if cascade.shape[1] > 1:
        later[:, 1] += p * cascade[:, 0]
    if cascade.shape[1] > 2:
        later[:, 2] += p * cascade[:, 1] + 0.5 * p * (p + 1.0) * cascade[:, 0]
    return np.asarray(later * (fades**steps)[:, None, None])


@compiled
def _advance(
    n: int, stage: Floats, scaling: Floats, total: Ints, now: Ints, rings: Ints, rows: Ints, fades: Floats, sums: Floats
) -> None:
    """Advance by the first n staged samples: each octave whose stride is full takes a point, and its rows a term.

    Arrays go down whole, with indices, and lanes are few: views and vector loops cost more than the work.
    """
    for sample in range(n):
        total[0] += 1
        _append(stage, sample, scaling, now)
        i = 0
        for level in range(rings.shape[0]):
            if total[0] & ((1 << level) - 1):
                break
            at = total[0] >> level
            place = at & (POINTS - 1)
            for lane in range(AXES):
                rings[level, place, 0, lane] = now[0, lane]
                rings[level, place, 1, lane] = now[1, lane]
            while i < rows.shape[0] and rows[i, LEVEL] == level:
                reach = rows[i, REACH]
                if at >= 2 * reach:
                    middle, first = (at - reach) & (POINTS - 1), (at - 2 * reach) & (POINTS - 1)
                    _take(now, rings, level, middle, first, fades[i], i, sums)
                i += 1


@compiled
def _append(stage: Floats, sample: int, scaling: Floats, now: Ints) -> None:
    """Add one sample to phase, or to the count of missing ones."""
    for lane in range(AXES):
        y = stage[sample, lane] * scaling[0, lane] + scaling[1, lane]
        if abs(y) < 4.0e18:  # false for NaN too
            step = np.rint(y)
            scaling[1, lane] = y - step
            now[0, lane] += np.int64(step)
        else:
            now[1, lane] += 1


@compiled
def _take(now: Ints, rings: Ints, level: int, middle: int, first: int, fade: float, row: int, sums: Floats) -> None:
    """Fade a row's sums and add the newest squared second difference, or nothing where a sample is missing within."""
    power = fade * fade
    for lane in range(AXES):
        d = float(now[0, lane] - 2 * rings[level, middle, 0, lane] + rings[level, first, 0, lane])
        weight = 1.0 if now[1, lane] == rings[level, first, 1, lane] else 0.0
        sums[row, D2, lane] = fade * sums[row, D2, lane] + weight * d * d
        sums[row, WEIGHT, lane] = fade * sums[row, WEIGHT, lane] + weight
        sums[row, SQUARE, lane] = power * sums[row, SQUARE, lane] + weight
        if sums.shape[1] > SQUARE_LATER:
            sums[row, D2_LATE, lane] = fade * sums[row, D2_LATE, lane] + sums[row, D2, lane]
            sums[row, WEIGHT_LATE, lane] = fade * sums[row, WEIGHT_LATE, lane] + sums[row, WEIGHT, lane]
            sums[row, SQUARE_LATE, lane] = power * sums[row, SQUARE_LATE, lane] + sums[row, SQUARE, lane]
            sums[row, SQUARE_LATER, lane] = power * sums[row, SQUARE_LATER, lane] + sums[row, SQUARE_LATE, lane]
