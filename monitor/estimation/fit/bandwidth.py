"""The sensor's own bandwidth: which low-pass explains the shortest τ of a curve, and what the coefficients then are.

A sensor that ends below half the sample rate has less noise at the shortest τ than N²/τ says. A day's curve knows them
to 0.04 %, so that a shape which is 1 % off there spoils N. Here N's column is that of white noise through a Butterworth
low-pass, of a few orders, as a digital filter at the sample rate or as an analogue one that was sampled; cutoff and
order are those with the least misfit. The cutoff is not known better than the data tell it: its direction is projected
out of the fit, so that no interval is too narrow by it. If no such filter explains the curve, the answer of ``fit``
stands: the shortest τ left out.

Every filter has a flat bottom, so N is the level of the white noise inside the band. Q is left out and only bounded:
beside it almost any filter explains almost any curve. A filter must also be seen in the spectrum: where that does not
fall beyond the cutoff, something else bent the curve.
"""

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final, Literal

import numpy as np

from drivers.sample import Floats, Ints
from monitor.common.minimization import golden_section
from monitor.estimation.allan.batch import PRESENT
from monitor.estimation.allan.uncertainty import Table
from monitor.estimation.fit.coefficient_fit import Design, Fit, Looks, fit_columns, replaced
from monitor.estimation.fit.coefficients import Status
from monitor.estimation.fit.confidence_bounds import BOUND, highest
from monitor.estimation.fit.least_squares import N, Q

Kind = Literal["digital", "sampled"]
FAMILIES: Final[tuple[tuple[Kind, int], ...]] = tuple(
    (kind, order) for order in (1, 2, 3, 4) for kind in ("digital", "sampled")
)
CUTOFFS: Final = np.geomspace(0.005, 0.49, 56)
"""Of the sample rate."""
BINS: Final = 1 << 13
"""Of the spectrum from zero to half the sample rate: a filter forgets within so many samples."""
REFINED: Final = 3
"""Families, of those nearest on the grid, whose cutoff is sought to the end."""
PIECE: Final = 8
"""Cutoffs tried in one piece of a search."""
REFINEMENT_PIECE: Final = 10
"""Cutoffs between those of the grid that are tried in one piece; each needs a spectrum of its own."""
CUTOFF_TOLERANCE: Final = 1e-4
"""Of the logarithm of a cutoff, at the end of a search."""
ALIASES: Final = 8
AGREES: Final = 2.0
"""Variance about the fit over that of noise, up to which a filter explains a curve."""
POWER_BINS: Final = 1024
MOST_STRETCHES: Final = 64
FEWEST_STRETCHES: Final = 4
BEYOND: Final = 1.2
"""Cutoffs, from which on a spectrum is asked whether it falls."""
FALLS: Final = 2.0
RESIDUE: Final = 0.05
"""A spectrum may lie so many times above the filter's, and by this share of its own bottom."""
STEP: Final = 1.01
"""Of a cutoff, for the derivative by it."""
WIDE: Final = 3.0
"""Standard deviation of ln cutoff that is granted before the data are seen: any."""


@dataclass(frozen=True, slots=True)
class LowPass:
    """A Butterworth low-pass."""

    kind: Kind
    order: int
    cutoff: float  # of the sample rate

    def avar(self, factors: Ints) -> Floats:
        """Allan variance [m] of white noise of one through it, τ0 = 1.

        With V(m) the variance of a sum of m samples, from their autocovariance, σ² = (4 V(m) − V(2m)) / 2m².

        >>> LowPass("digital", 2, 0.1).avar(np.array([1, 1000])).round(6).tolist()
        [0.024355, 0.000998]
        """
        m = np.asarray(factors, np.int64)
        return (4.0 * self._sums(m) - self._sums(2 * m)) / (2.0 * m.astype(np.float64) ** 2)

    def _sums(self, m: Ints) -> Floats:
        level, first = _moments(self.kind, self.order, self.cutoff)
        k = np.minimum(m, level.size) - 1
        return np.asarray(m * level[k] - first[k])


def _spectrum(kind: Kind, order: int, cutoff: float, bins: int = BINS) -> Floats:
    """Squared response [bins + 1] from zero to half the sample rate."""
    f = np.arange(bins + 1) / (2.0 * bins)
    if kind == "digital":
        with np.errstate(over="ignore"):
            return np.asarray(1.0 / (1.0 + (np.tan(np.pi * f) / np.tan(np.pi * cutoff)) ** (2 * order)))
    bands = np.abs(f[:, None] + np.arange(-ALIASES, ALIASES + 1))
    return np.asarray((1.0 / (1.0 + (bands / cutoff) ** (2 * order))).sum(axis=1))


@lru_cache(1024)
def _column(low_pass: LowPass, factors: bytes) -> Floats:
    return low_pass.avar(np.frombuffer(factors, np.int64))


def _moments(kind: Kind, order: int, cutoff: float) -> tuple[Floats, Floats]:
    """Σ r over |k| < n, and Σ |k| r, for n = 1, 2, …; the white noise inside the band has Σ r = 1."""
    r = np.fft.irfft(_spectrum(kind, order, cutoff))[:BINS]
    both = np.where(np.arange(BINS) > 0, 2.0, 1.0) * r
    level, first = np.cumsum(both), np.cumsum(both * np.arange(BINS))
    return level / level[-1], first / level[-1]


def power(rates: Floats) -> Floats:
    """Spectrum [POWER_BINS + 1] of one axis [n], in no unit: the mean of stretches spread over it that lack little.

    Empty where there are too few.
    """
    rows = 2 * POWER_BINS
    begins = np.unique(np.linspace(0, len(rates) - rows, MOST_STRETCHES).astype(np.int64))
    if begins[0] < 0 or len(rates) < FEWEST_STRETCHES * rows:
        return np.empty(0)
    parts = np.stack([rates[begin : begin + rows] for begin in begins])
    parts = parts[np.isfinite(parts).mean(axis=1) >= PRESENT]
    if len(parts) < FEWEST_STRETCHES:
        return np.empty(0)
    parts = parts - np.nanmean(parts, axis=1, keepdims=True)
    turned = np.fft.rfft(np.nan_to_num(parts) * np.hanning(rows), axis=1)
    return np.asarray((turned.real**2 + turned.imag**2).mean(axis=0))


def seen(low_pass: LowPass, power: Floats) -> bool:
    """Whether a spectrum falls beyond the cutoff as it would behind the filter; medians, so that no line matters."""
    f = np.arange(power.size) / (2.0 * max(power.size - 1, 1))
    below = (f >= low_pass.cutoff / 4.0) & (f <= low_pass.cutoff / 2.0) & (f >= 3.0 / (2.0 * POWER_BINS))
    beyond = f >= min(BEYOND * low_pass.cutoff, 0.49)
    if not below.any():
        return False
    filtered = _spectrum(low_pass.kind, low_pass.order, low_pass.cutoff, POWER_BINS)
    expected = np.median(filtered[beyond]) / np.median(filtered[below])
    return bool(np.median(power[beyond]) <= (FALLS * expected + RESIDUE) * np.median(power[below]))


def with_bandwidth(
    design: Design, table: Table, looks: Looks, found: Fit, filters: Sequence[LowPass | None]
) -> tuple[Fit, list[LowPass | None]]:
    """The fit with the low-pass of each axis where that explains what contradicted it, and those that do.

    Args:
        design, table, looks: what ``fit`` was given
        found: what it gave
        filters: of ``sought``, or None, for each axis
    """
    used: list[LowPass | None] = [None] * len(filters)
    for axis, low_pass in enumerate(filters):
        if low_pass is not None and contradicted(found, axis):
            better = _fitted(design, table, looks.axis(axis), low_pass)
            if better.scatter[0] < AGREES:
                _bound(design, better, looks.axis(axis))
                found = replaced(found, axis, better)
                used[axis] = low_pass
    return found, used


def _bound(design: Design, found: Fit, looks: Looks) -> None:
    """Q of the one axis, which no fit beside a filter can tell: no more than the whole of the first point."""
    c, first = found.coefficients, int(np.argmax(looks.avar[:, 0] > 0.0))
    most = highest(looks.avar[first, 0], found.edf[first, 0], BOUND) / design.columns[first, Q]
    if np.isfinite(most):
        c.status[Q], c.lo[Q], c.hi[Q] = Status.UPPER_BOUND, 0.0, most**0.5 / design.rate_hz


def contradicted(found: Fit, axis: int) -> bool:
    """Whether the shortest τ, or others, are not what the five terms say."""
    return bool(found.left_out[axis] > 0 or found.theta[0, axis] < 0.0 or found.misfit[axis] > 1.0)


def sought(design: Design, table: Table, looks: Looks, power: Floats) -> LowPass | None:
    """The low-pass with the least misfit for the one axis of ``looks``; None where none explains its curve.

    ``power``: its spectrum, of ``power``.
    """
    search = searching(design, table, looks, power)
    while True:
        try:
            next(search)
        except StopIteration as end:
            found: LowPass | None = end.value
            return found


def searching(design: Design, table: Table, looks: Looks, power: Floats) -> Generator[None, None, LowPass | None]:
    """``sought`` in pieces of a few milliseconds, for who must not be kept waiting."""
    factors = np.ascontiguousarray(design.factors, np.int64).tobytes()
    grids: list[list[float]] = []
    for kind, order in FAMILIES:
        grids.append([])
        for number, cutoff in enumerate(CUTOFFS):
            column = _column(LowPass(kind, order, float(cutoff)), factors)
            grids[-1].append(float(fit_columns(_with(design, column), table, looks).scatter[0]))
            if number % PIECE == PIECE - 1:
                yield
    found = []
    for family in np.argsort([min(grid) for grid in grids])[:REFINED]:
        kind, order = FAMILIES[family]
        at = int(np.argmin(grids[family]))
        ends = np.log(CUTOFFS[[max(at - 1, 0), min(at + 1, CUTOFFS.size - 1)]])

        def of(log_cutoff: float, kind: Kind = kind, order: int = order) -> float:
            column = LowPass(kind, order, float(np.exp(log_cutoff))).avar(design.factors)
            return float(fit_columns(_with(design, column), table, looks).scatter[0])

        least, log_cutoff = yield from in_pieces(golden_section(of, float(ends[0]), float(ends[1]), CUTOFF_TOLERANCE))
        found.append((least, LowPass(kind, order, float(np.exp(log_cutoff)))))
        yield
    least, low_pass = min(found, key=lambda one: one[0])
    return low_pass if least < AGREES and seen(low_pass, power) else None


def in_pieces(search: Generator[None, None, tuple[float, float]]) -> Generator[None, None, tuple[float, float]]:
    """Run a search, and yield after each REFINEMENT_PIECE of its steps."""
    steps = 0
    while True:
        try:
            next(search)
        except StopIteration as end:
            found: tuple[float, float] = end.value
            return found
        steps += 1
        if steps % REFINEMENT_PIECE == 0:
            yield


def _with(design: Design, column: Floats) -> Design:
    columns = design.columns.copy()
    columns[:, N], columns[:, Q] = column, 0.0
    return replace(design, columns=columns)


def _fitted(design: Design, table: Table, looks: Looks, low_pass: LowPass) -> Fit:
    """The fit with this filter, blind to a change of its cutoff."""
    factors = np.ascontiguousarray(design.factors, np.int64).tobytes()
    up, down = (_column(replace(low_pass, cutoff=low_pass.cutoff * by), factors) for by in (STEP, 1.0 / STEP))
    own = _with(design, _column(low_pass, factors))
    rough = fit_columns(own, table, looks)
    level = max(float(rough.theta[N, 0]) * design.rate_hz, 0.0)
    return fit_columns(own, table, looks, full=True, blind=level * WIDE * (up - down) / (2.0 * np.log(STEP)))
