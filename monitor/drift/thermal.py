"""Bias against temperature: which model, how large, how sure; and what it expects next.

Polynomials and difference equations (``heat``) are fitted to interval means by least squares of the whole course: an
equation's own outputs are fed back, never measured ones, so that noise in the means does not pull its roots towards
zero. What the model leaves, r_n, may know of the one before: r_n = φ r_{n−1} + e_n. Among all forms the one with the
least AICc (Hurvich & Tsai, Biometrika 76, 1989) is taken; it is what leave-one-out validation tends to (Stone, J. R.
Stat. Soc. B 39, 1977) and needs no samples set aside, of which there are few. A validated error stands beside: that of
BLOCKS parts of the record, each predicted from the others. A form that predicts them worse than a constant is not
taken, as slow heating leaves one end of a polynomial to itself.

A multi-step estimate knows temperature alone; a one-step estimate also knows the bias measured one interval before.

After Wang et al., bias modelling of MEMS gyroscopes under small temperature changes (72 h, means of 1 h), with a
constant, which the paper has not, and fed-back outputs.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from math import log
from typing import Final

import numpy as np

from drivers.errors import NotReady
from drivers.sample import Floats
from monitor.drift.heat import Shape, outside, responses, solved
from monitor.drift.means import Means

FEWEST: Final = 12
"""Intervals that anything can be said of."""
POWERS: Final = 5
"""Highest order of a polynomial."""
MEMORY: Final = 3
"""Highest order of a difference equation."""
ENOUGH: Final = 8
"""Intervals for k² of memory: more lags than that follow what wanders by itself."""
SLOWEST: Final = 0.25
"""Of the record: a longer time constant is not told from a drift."""
FASTEST: Final = 0.5
"""Of an interval: a shorter one is none."""
APART: Final = 2.0
"""Ratio of two time constants: nearer ones only make a difference of two large sizes."""
GRID: Final = 20
"""Time constants of a first look."""
PHI: Final = (0.0, 0.3, 0.6, 0.8, 0.9, 0.97)
BLOCKS: Final = 6
"""Parts of the record that are predicted from the others."""
WORSE: Final = 1.05
"""Of the validated error of a constant: what chance lets a form be worse."""
LEAST_C: Final = 0.1
"""Swing of temperature that anything can be said of."""
CLEAR: Final = 5.0
"""Standard errors of a mean of temperature: less has hardly moved."""
ONE_WAY: Final = 0.1
"""Of all movement: if less goes the other way, temperature only rose, or only fell."""
STEP: Final = 1e-3
"""Of the logarithm of a time constant, for its derivative."""
Z95: Final = 1.959964
GOLDEN: Final = 0.6180339887498949


@dataclass(frozen=True, slots=True)
class ThermalModel:
    """The bias of one axis as a function of temperature and its past."""

    shape: Shape
    interval_s: float
    reference_c: float  # temperature at which the constant holds
    sizes: Floats  # [terms] constant, powers, lags: rad/s (m/s²) by powers of °C
    start: Floats  # [k] what each lag had left behind when the fit began
    phi: float  # of what is left, from one interval to the next
    sigma: float  # rad/s (m/s²): deviation of what no interval knows before
    covariance: Floats  # of sizes, start and logarithms of the time constants
    lowest_c: float
    highest_c: float

    @property
    def spread(self) -> float:
        """Deviation of what the model leaves of a mean."""
        return float(self.sigma / (1.0 - self.phi**2) ** 0.5)

    @property
    def slope(self) -> float:
        """Bias per °C, in the end, from the coldest to the warmest of the fit."""
        (lo, hi), powers = self.ends, np.arange(1, self.shape.powers + 1)
        chords = (hi**powers - lo**powers) / (hi - lo)
        return float(self.sizes[1 : 1 + self.shape.powers] @ chords + self.sizes[1 + self.shape.powers :].sum())

    @property
    def ends(self) -> tuple[float, float]:
        """The coldest and the warmest of the fit less the reference, °C."""
        return self.lowest_c - self.reference_c, self.highest_c - self.reference_c


@dataclass(frozen=True, slots=True)
class Prediction:
    """What a model expects of each interval."""

    bias: Floats  # [n] rad/s or m/s²
    lo: Floats  # [n] 95 % interval of the mean that is measured
    hi: Floats


@dataclass(frozen=True, slots=True)
class Candidate:
    """One form that was tried."""

    shape: Shape
    aicc: float  # above that of the one that was taken
    rms: float  # of what it leaves, multi-step, rad/s or m/s²
    validated: float  # the same on parts that were predicted from the others


@dataclass(frozen=True, slots=True)
class ThermalFit:
    """The model of one axis, and what it was chosen from."""

    model: ThermalModel
    candidates: tuple[Candidate, ...]  # the one that was taken, and the others by their AICc
    both_ways: bool  # temperature rose and fell
    hysteresis: float | None  # largest difference of rising and falling at one temperature; None if it went one way
    explained: float  # share of the variance of the means


def fitted(means: Means) -> ThermalFit:
    """Choose and fit.

    Raises:
        NotReady: too few intervals, or temperature hardly moved
    """
    _check(means)
    excess, reference_c = _excess(means)
    both_ways = _both_ways(means.temperature_c)
    tried = sorted((_best(means, excess, shape) for shape in _shapes(means, both_ways)), key=lambda one: one.aicc)
    errors = [_validated(means, excess, one) for one in tried]
    alone = next(error for one, error in zip(tried, errors, strict=True) if one.shape == Shape(0, ()))
    at = next(i for i, error in enumerate(errors) if error <= WORSE * alone)
    best = tried.pop(at)
    kept = [(best, errors.pop(at)), *zip(tried, errors, strict=True)]
    candidates = tuple(Candidate(one.shape, one.aicc - best.aicc, one.rms, error) for one, error in kept)
    model = _model(means, excess, reference_c, best)
    known = means.known
    left = means.bias[known] - (best.columns @ best.sizes)[known]
    explained = 1.0 - float(np.var(left) / np.var(means.bias[known]))
    loop = _loop(means.temperature_c, best.columns @ best.sizes) if model.shape.memory else 0.0
    return ThermalFit(model, candidates, both_ways, loop if both_ways else None, explained)


def predicted(
    model: ThermalModel, temperature_c: Floats, measured: Floats | None = None, began: bool = False
) -> Prediction:
    """Multi-step from temperature [n] alone, or one-step beside the biases measured [n] until the interval before.

    Args:
        began: the first interval is the first of the fit, whose start is known; else temperature is taken to have been
            long what it is at first, and intervals are as wide as not knowing that asks for

    Beyond the temperatures of the fit nothing is known: the model goes on along its chord, and as much as that changes
    it by is added to the interval.
    """
    excess = _whole(temperature_c) - model.reference_c
    columns = responses(model.shape, excess, model.interval_s, began=True, ends=model.ends)
    k = model.shape.memory
    if not began:
        columns[:, columns.shape[1] - k :] = 0.0
    sizes = np.concatenate([model.sizes, model.start if began else np.zeros(k)])
    bias = columns @ sizes
    rows = np.hstack([columns, _slopes(model, excess, sizes)])
    sigma = np.full(excess.size, model.spread)
    if measured is not None:
        known = np.isfinite(measured[:-1])
        last = np.where(known, measured[:-1] - bias[:-1], 0.0)
        rows[1:] -= model.phi * known[:, None] * rows[:-1]
        bias = bias.copy()
        bias[1:] += model.phi * last
        sigma[1:][known] = model.sigma
    variance = np.einsum("ij,jk,ik->i", rows, model.covariance, rows) + sigma**2
    variance += (model.slope * outside(excess, model.ends)) ** 2
    if not began and k:
        swing = (model.highest_c - model.lowest_c) / 12.0**0.5
        lags = model.sizes[1 + model.shape.powers :]
        p = np.exp(-model.interval_s / np.asarray(model.shape.constants_s))
        variance += ((lags * swing) ** 2 * p ** (2.0 * np.arange(excess.size)[:, None])).sum(axis=1)
    half = Z95 * np.sqrt(variance)
    return Prediction(bias, bias - half, bias + half)


@dataclass(frozen=True, slots=True)
class _Tried:
    shape: Shape
    columns: Floats  # [n, terms + k]
    sizes: Floats  # [terms + k]
    phi: float
    sigma: float
    rms: float
    aicc: float


def _check(means: Means) -> None:
    count = int(means.known.sum())
    if count < FEWEST:
        raise NotReady(
            f"{count} intervals of {means.interval_s:g} s with bias and temperature; {FEWEST} are the least that "
            f"anything can be said of: record longer, or take a shorter interval"
        )
    warmth = means.temperature_c[means.known]
    swing = float(np.ptp(warmth))
    noise = float(np.median(np.abs(np.diff(warmth, 2)))) / 6.0**0.5 / 0.6745 if warmth.size > 2 else 0.0
    least = max(LEAST_C, CLEAR * noise)
    if swing < least:
        raise NotReady(
            f"temperature hardly moved: by {swing:.2g} °C in {count * means.interval_s / 3600.0:.3g} h, and "
            f"{least:.2g} °C are the least that anything can be said of"
        )
    if not np.ptp(means.bias[means.known]) > 0.0:
        raise NotReady("the bias is the same in all intervals")


def _excess(means: Means) -> tuple[Floats, float]:
    whole = _whole(means.temperature_c)
    reference_c = round(float(whole.mean()), 2)
    return whole - reference_c, reference_c


def _whole(temperature_c: Floats) -> Floats:
    """Without holes: lags need to know what temperature was meanwhile."""
    there = np.flatnonzero(np.isfinite(temperature_c))
    return np.interp(np.arange(temperature_c.size), there, temperature_c[there])


def _both_ways(temperature_c: Floats) -> bool:
    """Whether temperature rose and fell by more than ONE_WAY of its movement, its noise apart."""
    whole = _whole(temperature_c)
    smooth = np.convolve(np.pad(whole, 1, mode="edge"), np.full(3, 1.0 / 3.0), mode="valid")
    moved = np.diff(smooth)
    up, down = float(moved[moved > 0.0].sum()), float(-moved[moved < 0.0].sum())
    return min(up, down) > ONE_WAY * (up + down)


def _shapes(means: Means, both_ways: bool) -> Iterator[Shape]:
    """Forms that so many intervals can tell; how late heat is, only where temperature went both ways."""
    count = int(means.known.sum())
    for powers in range(POWERS + 1):
        if powers + 3 < count / 2:
            yield Shape(powers, ())
    for k in range(1, MEMORY + 1):
        for powers in (0, 1):
            if both_ways and ENOUGH * k**2 < count:
                yield Shape(powers, tuple(means.interval_s * 2.0**i for i in range(k)))


def _best(means: Means, excess: Floats, shape: Shape) -> _Tried:
    """The form with its best time constants and φ."""
    return min((_with_phi(means, excess, shape, phi) for phi in PHI), key=lambda one: one.aicc)


def _with_phi(means: Means, excess: Floats, shape: Shape, phi: float) -> _Tried:
    """Time constants: from a grid one after the other, each beside those found, then once more between neighbours."""
    k = shape.memory
    if not k:
        return _tried(means, excess, shape, phi)
    fastest, slowest = FASTEST * means.interval_s, SLOWEST * means.interval_s * excess.size
    grid = np.geomspace(fastest, slowest, GRID)
    ratio = float(grid[1] / grid[0])
    constants: tuple[float, ...] = ()

    def of(each: tuple[float, ...]) -> _Tried:
        return _tried(means, excess, replace(shape, constants_s=tuple(sorted(each))), phi)

    def room(at: int) -> tuple[float, float]:
        """How far a time constant may go: to its neighbours on the grid, and not near the others."""
        one, others = constants[at], (*constants[:at], *constants[at + 1 :])
        below = max((APART * other for other in others if other < one), default=fastest)
        above = min((other / APART for other in others if other > one), default=slowest)
        return max(one / ratio, fastest, min(below, one)), min(one * ratio, slowest, max(above, one))

    for _ in range(k):
        free = [one for one in grid.tolist() if all(max(one / c, c / one) >= APART for c in constants)]
        constants = min(((*constants, one) for one in free), key=lambda each: of(each).aicc)
    for _ in range(2 if k > 1 else 1):
        for at in range(k):
            lo, hi = room(at)
            for _ in range(10):
                a, b = hi * (lo / hi) ** GOLDEN, lo * (hi / lo) ** GOLDEN
                less = (
                    of((*constants[:at], a, *constants[at + 1 :])).aicc
                    < of((*constants[:at], b, *constants[at + 1 :])).aicc
                )
                lo, hi = (lo, b) if less else (a, hi)
            constants = (*constants[:at], (lo * hi) ** 0.5, *constants[at + 1 :])
    return of(constants)


def _tried(means: Means, excess: Floats, shape: Shape, phi: float) -> _Tried:
    """Sizes by least squares of what is new in each interval."""
    known = means.known
    columns = responses(shape, excess, means.interval_s, began=True)
    y = np.where(known, means.bias, 0.0)
    x, z, fresh = _whitened(columns, y, known, phi)
    sizes = solved(x, z)
    count = x.shape[0]
    square = max(float(((z - x @ sizes) ** 2).sum()), 1e-300)
    free = sizes.size + shape.memory + (phi > 0.0) + 1
    likelihood = count * log(square / count) - fresh * log(1.0 - phi**2)
    aicc = likelihood + 2.0 * free * count / max(count - free - 1.0, 0.5)
    rms = float(np.sqrt(np.mean((y - columns @ sizes)[known] ** 2)))
    sigma = (square / max(count - free + 1, 1)) ** 0.5
    return _Tried(shape, columns, sizes, phi, sigma, rms, aicc)


def _whitened(columns: Floats, y: Floats, known: np.ndarray, phi: float) -> tuple[Floats, Floats, int]:
    """Rows less φ times the row before where that is known; the first after a hole in the measure of the others."""
    follows = known[1:] & known[:-1]
    x, z = columns.copy(), y.copy()
    x[1:] -= phi * follows[:, None] * columns[:-1]
    z[1:] -= phi * follows * y[:-1]
    first = known.copy()
    first[1:] &= ~follows
    weight = np.where(first, (1.0 - phi**2) ** 0.5, 1.0)
    return (x * weight[:, None])[known], (z * weight)[known], int(first.sum())


def _validated(means: Means, excess: Floats, one: _Tried) -> float:
    """Deviation of parts of the record from what the others let expect, the form and its time constants as they are.

    What lags had left behind at the start, only the first part knows: it is predicted as if there were nothing.
    """
    edges = np.linspace(0, excess.size, BLOCKS + 1).astype(np.int64)
    square = 0.0
    for lo, hi in pairwise(edges.tolist()):
        used = means.known.copy()
        used[lo:hi] = False
        columns = one.columns if lo else responses(one.shape, excess, means.interval_s)
        x, z, _ = _whitened(columns, np.where(used, means.bias, 0.0), used, one.phi)
        apart = (means.bias - columns @ solved(x, z))[lo:hi]
        square += float((apart[means.known[lo:hi]] ** 2).sum())
    return float((square / means.known.sum()) ** 0.5)


def _model(means: Means, excess: Floats, reference_c: float, one: _Tried) -> ThermalModel:
    k = one.shape.memory
    terms = one.sizes.size - k
    model = ThermalModel(
        shape=one.shape,
        interval_s=means.interval_s,
        reference_c=reference_c,
        sizes=one.sizes[:terms],
        start=one.sizes[terms:],
        phi=one.phi,
        sigma=one.sigma,
        covariance=np.zeros((0, 0)),
        lowest_c=float(np.nanmin(means.temperature_c)),
        highest_c=float(np.nanmax(means.temperature_c)),
    )
    rows = np.hstack([one.columns, _slopes(model, excess, one.sizes)])
    x, _, _ = _whitened(rows, np.zeros(excess.size), means.known, one.phi)
    scale = np.maximum(np.linalg.norm(x, axis=0), 1e-300)
    inverse = np.linalg.pinv((x / scale).T @ (x / scale), rcond=1e-10) / np.outer(scale, scale)
    return replace(model, covariance=one.sigma**2 * inverse)


def _slopes(model: ThermalModel, excess: Floats, sizes: Floats) -> Floats:
    """Derivatives [n, k] of the bias by the logarithm of each time constant."""
    constants = model.shape.constants_s
    out = np.zeros((excess.size, len(constants)))
    for at, one in enumerate(constants):
        moved = [
            responses(
                replace(model.shape, constants_s=(*constants[:at], one * np.exp(by), *constants[at + 1 :])),
                excess,
                model.interval_s,
                began=True,
                ends=model.ends,
            )
            for by in (-STEP, STEP)
        ]
        out[:, at] = (moved[1] - moved[0]) @ sizes / (2.0 * STEP)
    return out


def _loop(temperature_c: Floats, bias: Floats) -> float:
    """Largest difference of the modelled bias between rising and falling, at one temperature."""
    whole = _whole(temperature_c)
    rising = np.gradient(whole) > 0.0
    edges = np.linspace(whole.min(), whole.max(), 9)
    place = np.clip(np.searchsorted(edges, whole) - 1, 0, 7)
    worst = 0.0
    for at in range(8):
        up, down = bias[(place == at) & rising], bias[(place == at) & ~rising]
        if up.size and down.size:
            worst = max(worst, abs(float(up.mean() - down.mean())))
    return worst
