"""Bias against temperature: which model, how large, how sure.

Polynomials and difference equations (``heat``) are fitted to interval means by least squares of the whole course: an
equation's own outputs are fed back, never measured ones, so that noise in the means does not pull its roots towards
zero. What the model leaves, r_n, may know of the one before: r_n = φ r_{n−1} + e_n. Among all forms the one with the
least AICc (Hurvich & Tsai, Biometrika 76, 1989) is taken; it is what leave-one-out validation tends to (Stone, J. R.
Stat. Soc. B 39, 1977) and needs no samples set aside, of which there are few. A validated error stands beside: that of
BLOCKS parts of the record, each predicted from the others. A form that predicts them worse than a constant is not
taken, as slow heating leaves one end of a polynomial to itself; lags and high powers have to win by a margin.

The search takes some 50 ms to a second, and ``fitting`` does it in pieces of less than a millisecond.

After Wang et al., bias modelling of MEMS gyroscopes under small temperature changes (72 h, means of 1 h), with a
constant, which the paper has not, and fed-back outputs.
"""

from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from math import log
from typing import Final, TypeVar

import numpy as np

from drivers.errors import NotReady
from drivers.sample import Floats
from monitor.drift.thermal.interval_means import Means
from monitor.drift.thermal.temperature_dependence import find_hysteresis
from monitor.drift.thermal.thermal_model import ThermalModel, covariance, slopes, whole
from monitor.drift.thermal.thermal_response import Shape, responses, solved

FEWEST: Final = 12
"""Intervals that anything can be said of."""
POWERS: Final = 5
"""Highest order of a polynomial."""
CUBIC: Final = 3
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
LAG_WINS: Final = 6.0
CURVE_WINS: Final = 10.0
"""AICc by which a lag, and a power beyond the third, have to win: of so few means noise looks like either now and then,
and both are wrong by much where they are."""
LEAST_C: Final = 0.1
"""Swing of temperature that anything can be said of."""
CLEAR: Final = 5.0
"""Standard errors of a mean of temperature: less has hardly moved."""
ONE_WAY: Final = 0.1
"""Of all movement: if less goes the other way, temperature only rose, or only fell."""
GOLDEN: Final = 0.6180339887498949


@dataclass(frozen=True, slots=True)
class Candidate:
    """One form that was tried."""

    shape: Shape
    aicc: float  # above that of the one that was taken; below it where a margin was not reached
    rms: float  # of what it leaves, multi-step, rad/s or m/s²
    validated: float  # the same on parts that were predicted from the others


@dataclass(frozen=True, slots=True)
class ThermalFit:
    """The model of one axis, and what it was chosen from."""

    model: ThermalModel
    candidates: tuple[Candidate, ...]  # the one that was taken, and the others by their AICc
    both_ways: bool  # temperature rose and fell
    explained: float  # share of the variance of the means
    aicc: float  # of the model; only differences between fits of the same means say anything
    step: float = 0.0  # of the offset, where one was asked for: after it less before
    hysteresis: float | None = None  # largest difference between heating and cooling at one temperature, rad/s or m/s²;
    # 0 if noise explains the difference; None if temperature went one way, or if the test was not made
    hysteresis_p: float | None = None  # p-value of no difference between heating and cooling


T = TypeVar("T")
Pieces = Generator[None, None, T]
"""Work that pauses: each ``next`` does one piece, and what it makes comes with the end."""


def fitted(means: Means) -> ThermalFit:
    """Choose and fit a model, and test whether heating and cooling differ.

    Raises:
        NotReady: too few intervals, or temperature hardly moved
    """
    found = finished(fitting(means))
    loop = find_hysteresis(means) if found.both_ways else None
    if loop is None:
        return found
    return replace(found, hysteresis=loop.size if loop.significant else 0.0, hysteresis_p=loop.p_value)


def finished(pieces: Pieces[T]) -> T:
    """All of the work at once."""
    try:
        while True:
            next(pieces)
    except StopIteration as end:
        made: T = end.value
        return made


def fitting(means: Means, since: int | None = None, lags: bool = False) -> Pieces[ThermalFit]:
    """Choose and fit, one least squares at a time.

    Args:
        since: from this interval on the bias may have another offset, which is one size more
        lags: look for them also where temperature went one way
    Raises:
        NotReady: too few intervals, or temperature hardly moved; with the first piece
    """
    check(means)
    excess, reference_c = _excess(means)
    both_ways = _both_ways(means.temperature_c)
    tried = []
    for shape in _shapes(means, both_ways or lags):
        tried.append((yield from _best(means, excess, shape, since)))
    tried.sort(key=lambda one: one.aicc + _margin(one.shape))
    errors = []
    for one in tried:
        yield
        errors.append(_validated(_less(means, since, one.step), excess, one))
    alone = next(error for one, error in zip(tried, errors, strict=True) if one.shape == Shape(0, ()))
    at = next(i for i, error in enumerate(errors) if error <= WORSE * alone)
    best = tried.pop(at)
    kept = [(best, errors.pop(at)), *zip(tried, errors, strict=True)]
    candidates = tuple(Candidate(one.shape, one.aicc - best.aicc, one.rms, error) for one, error in kept)
    yield
    means = _less(means, since, best.step)
    model = _model(means, excess, reference_c, best)
    known = means.known
    left = means.bias[known] - (best.columns @ best.sizes)[known]
    explained = 1.0 - float(np.var(left) / np.var(means.bias[known]))
    return ThermalFit(model, candidates, both_ways, explained, best.aicc, best.step)


@dataclass(frozen=True, slots=True)
class _Tried:
    shape: Shape
    columns: Floats  # [n, terms + k]
    sizes: Floats  # [terms + k]
    phi: float
    sigma: float
    rms: float
    aicc: float
    step: float


def check(means: Means) -> None:
    """Raise NotReady if the means are too few, or if temperature or bias hardly moved."""
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


def _margin(shape: Shape) -> float:
    if shape.memory:
        return LAG_WINS
    return CURVE_WINS if shape.powers > CUBIC else 0.0


def _excess(means: Means) -> tuple[Floats, float]:
    known = whole(means.temperature_c)
    reference_c = round(float(known.mean()), 2)
    return known - reference_c, reference_c


def _both_ways(temperature_c: Floats) -> bool:
    """Whether temperature rose and fell by more than ONE_WAY of its movement, its noise apart."""
    smooth = np.convolve(np.pad(whole(temperature_c), 1, mode="edge"), np.full(3, 1.0 / 3.0), mode="valid")
    moved = np.diff(smooth)
    up, down = float(moved[moved > 0.0].sum()), float(-moved[moved < 0.0].sum())
    return min(up, down) > ONE_WAY * (up + down)


def _shapes(means: Means, lags: bool) -> Iterator[Shape]:
    """Forms that so many intervals can tell."""
    count = int(means.known.sum())
    for powers in range(POWERS + 1):
        if powers + 3 < count / 2:
            yield Shape(powers, ())
    for k in range(1, MEMORY + 1):
        for powers in (0, 1):
            if lags and ENOUGH * k**2 < count:
                yield Shape(powers, tuple(means.interval_s * 2.0**i for i in range(k)))


def _best(means: Means, excess: Floats, shape: Shape, since: int | None) -> Pieces[_Tried]:
    """The form with its best time constants and φ."""
    best = yield from _with_phi(means, excess, shape, PHI[0], since)
    for phi in PHI[1:]:
        other = yield from _with_phi(means, excess, shape, phi, since)
        best = min(best, other, key=lambda one: one.aicc)
    return best


def _with_phi(means: Means, excess: Floats, shape: Shape, phi: float, since: int | None) -> Pieces[_Tried]:
    """Time constants: from a grid one after the other, each beside those found, then once more between neighbours."""
    k = shape.memory
    fastest, slowest = FASTEST * means.interval_s, SLOWEST * means.interval_s * excess.size
    grid = np.geomspace(fastest, slowest, GRID)
    ratio = float(grid[1] / grid[0])
    constants: tuple[float, ...] = ()

    def of(each: tuple[float, ...]) -> Pieces[_Tried]:
        yield
        return _tried(means, excess, replace(shape, constants_s=tuple(sorted(each))), phi, since)

    def room(at: int) -> tuple[float, float]:
        """How far a time constant may go: to its neighbours on the grid, and not near the others."""
        one, others = constants[at], (*constants[:at], *constants[at + 1 :])
        below = max((APART * other for other in others if other < one), default=fastest)
        above = min((other / APART for other in others if other > one), default=slowest)
        return max(one / ratio, fastest, min(below, one)), min(one * ratio, slowest, max(above, one))

    for _ in range(k):
        free = [one for one in grid.tolist() if all(max(one / c, c / one) >= APART for c in constants)]
        looks = []
        for one in free:
            looks.append((yield from of((*constants, one))).aicc)
        constants = (*constants, free[int(np.argmin(looks))])
    for _ in range(2 if k > 1 else min(k, 1)):
        for at in range(k):
            lo, hi = room(at)
            for _ in range(10):
                a, b = hi * (lo / hi) ** GOLDEN, lo * (hi / lo) ** GOLDEN
                below = yield from of((*constants[:at], a, *constants[at + 1 :]))
                above = yield from of((*constants[:at], b, *constants[at + 1 :]))
                lo, hi = (lo, b) if below.aicc < above.aicc else (a, hi)
            constants = (*constants[:at], (lo * hi) ** 0.5, *constants[at + 1 :])
    return (yield from of(constants))


def _tried(means: Means, excess: Floats, shape: Shape, phi: float, since: int | None = None) -> _Tried:
    """Sizes by least squares of what is new in each interval."""
    known = means.known
    columns = responses(shape, excess, means.interval_s, began=True)
    own = columns.shape[1]
    if since is not None:
        columns = np.hstack([columns, (np.arange(excess.size) >= since)[:, None]])
    y = np.where(known, means.bias, 0.0)
    x, z, fresh = whitened(columns, y, known, phi)
    sizes = solved(x, z)
    count = x.shape[0]
    square = max(float(((z - x @ sizes) ** 2).sum()), 1e-300)
    free = sizes.size + shape.memory + (phi > 0.0) + 1
    likelihood = count * log(square / count) - fresh * log(1.0 - phi**2)
    aicc = likelihood + 2.0 * free * count / max(count - free - 1.0, 0.5)
    rms = float(np.sqrt(np.mean((y - columns @ sizes)[known] ** 2)))
    sigma = (square / max(count - free + 1, 1)) ** 0.5
    step = 0.0 if since is None else float(sizes[own])
    return _Tried(shape, columns[:, :own], sizes[:own], phi, sigma, rms, aicc, step)


def _less(means: Means, since: int | None, step: float) -> Means:
    """As if the offset had always been that of before."""
    if since is None:
        return means
    return replace(means, bias=means.bias - step * (np.arange(means.bias.size) >= since))


def whitened(columns: Floats, y: Floats, known: np.ndarray, phi: float) -> tuple[Floats, Floats, int]:
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
        x, z, _ = whitened(columns, np.where(used, means.bias, 0.0), used, one.phi)
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
    rows = np.hstack([one.columns, slopes(model, excess, one.sizes)])
    x, _, _ = whitened(rows, np.zeros(excess.size), means.known, one.phi)
    return replace(model, covariance=covariance(x, one.sigma))
