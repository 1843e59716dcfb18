"""Allan curve in, coefficients Q N B K R out, six axes at a time.

The curve is linear in θ = (Q², N², B², K², R²). Each axis is fitted by non-negative least squares, weighted by the
covariance of the τ under the model itself, or by its diagonal alone where time is short, and re-weighted a few times
(such weights come within a few percent of the Cramér–Rao limit). The unconstrained solution û beside it decides what
a coefficient is worth: its variance were v(t) = c0 + c1 t + c2 t² if the true θ_a were t, from the
covariances of ``uncertainty``. A term is in when û_a/√c0, the variance taken as if it were absent,
passes a threshold; its interval is the set of t that û does not contradict; a term that is not in
has a one-sided bound, never tighter than an estimate of zero would give.

A ramp cannot be told from random walk by the curve alone. Given the window's slope s, the fit is to the curve
that the samples have without that line, so that K is unbiased whether or not there is a ramp, and R is in when s is
more than noise makes with K at the upper end of its interval. Else K or R may be its cause, and
both are bounded. Without a slope, R is only bounded, and a ramp does pass as K.

Real sensors end below half the sample rate. White noise through a low-pass looks, beyond the
filter's memory, like N²/τ − c/τ²: exactly the column of Q with a negative sign. So when the
shortest τ contradict the fit, Q² may turn negative (it then stands for the band limit and Q is only
bounded by the first point of the curve); while they still do, the shortest τ is left out. If no
filter explains it, as with a line or motion, nothing is left out, and the misfit is there to see.

A fit refuses nothing: an axis with too few τ, or without noise at all, is UNESTIMATED.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Floats, Ints
from monitor.estimation.allan.uncertainty import NOISES, Table
from monitor.estimation.fit.coefficients import Coefficients, Status
from monitor.estimation.fit.fit_kernel import WHITE, fit_axes
from monitor.estimation.fit.least_squares import N, R
from monitor.estimation.fit.term_selection import Known, answer, gains
from monitor.noise.effect import Source
from monitor.noise.effects.angle_random_walk import AngleRandomWalk
from monitor.noise.effects.bias_instability import BiasInstability
from monitor.noise.effects.quantization_noise import QuantizationNoise
from monitor.noise.effects.rate_ramp import RateRamp
from monitor.noise.effects.rate_random_walk import RateRandomWalk

UNIT_SOURCES: Final[tuple[Source, ...]] = (
    QuantizationNoise(Q=1.0),
    AngleRandomWalk(N=1.0),
    BiasInstability(B=1.0),
    RateRandomWalk(K=1.0),
    RateRamp(R=1.0),
)
"""Rows of the coefficients; their Allan variances are the columns of the fit."""

TO_SI: Final = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
"""Powers of the sample rate that bring Q N B K R from τ0 = 1 to SI."""

ENTER_ONCE: Final = 2.33  # σ: one look at one curve, 1 % of absent terms enter
ENTER_WATCHED: Final = 3.0  # σ: looked at again and again
LEAVE_WATCHED: Final = 1.5  # σ
FIELDS: Final = ("theta", "fitted", "edf", "entered", "left_out", "scatter", "misfit", "k_or_r")
"""Of a Fit, what is by the axis, beside the coefficients."""
THRESHOLDS_ONCE: Final = (ENTER_ONCE, ENTER_ONCE)
THRESHOLDS_WATCHED: Final = (ENTER_WATCHED, LEAVE_WATCHED)


@dataclass(frozen=True, slots=True)
class Design:
    """The columns of the fit for one list of cluster sizes."""

    factors: Ints  # [m]
    rate_hz: float
    columns: Floats  # [m, 5] Allan variance at τ0 = 1 of coefficients of one


@dataclass(frozen=True, slots=True)
class Fit:
    """One fit of six axes."""

    coefficients: Coefficients
    theta: Floats  # [5, 6] Q² N² B² K² R² of the fitted curve, SI; Q² < 0 stands for a band limit
    fitted: Floats  # [m, 6] unit², Allan variance of the fitted model; NaN where there is none or left_out
    edf: Floats  # [m, 6] equivalent degrees of freedom of the measured curve; NaN as the curve
    entered: NDArray[np.bool_]  # [5, 6] terms that are in: hand them to the next fit
    left_out: Ints  # [6] shortest τ that contradicted every fit
    scatter: Floats  # [6] variance of the curve about the fit over that of noise of the five terms
    misfit: Floats  # [6] the same where it is more than chance makes, else 1
    k_or_r: NDArray[np.bool_]  # [6] the window drifts, by random walk or by a ramp: which of them, it does not tell


def design(factors: Ints, rate_hz: float) -> Design:
    """The columns of the fit, from the effects' own Allan variances."""
    m = np.asarray(factors, np.float64)
    columns = np.ascontiguousarray(np.stack([source.avar(m, 1.0) for source in UNIT_SOURCES], axis=1))
    return Design(factors, rate_hz, columns)


def known(design: Design, table: Table, blind: Floats | None = None, ask: bool = True) -> Known:
    """What every fit at this length of the window shares."""
    flat = design.columns.copy()
    # what taking away the line costs each noise on average, see the level in ``fit_axis``
    flat[:, :NOISES] -= (2.0 * table.bend - table.slope) * design.columns[:, R, None]
    flat[:, ~design.columns.any(axis=0)] = 0.0  # not asked for
    blind = np.zeros(design.factors.size) if blind is None else blind
    whole = table.terms.astype(np.float64)
    return Known(design.columns, flat, table.covariance, whole, table.slope, blind, ask)


@dataclass(frozen=True, slots=True)
class Looks:
    """What is fitted: the curve of some axes, and the slopes of the same window."""

    avar: Floats  # [m, k] unit²; NaN where the window is too short
    terms: Ints  # [m, k] second differences behind each
    slope: Floats  # [k] unit/s, ``slope_of_thirds``; NaN = not measured: then a ramp is only bounded
    slopes: Floats  # [m, k] unit/s, the mean second difference of phase over τ² at each τ
    before: NDArray[np.bool_] | None = None  # [5, k] ``entered`` of the fit before, of who looks again and again

    def axis(self, column: int) -> "Looks":
        """One axis."""
        one = slice(column, column + 1)
        before = None if self.before is None else self.before[:, one]
        return Looks(self.avar[:, one], self.terms[:, one], self.slope[one], self.slopes[:, one], before)


def fit(
    design: Design,
    table: Table,
    avar: Floats,
    terms: Ints,
    before: NDArray[np.bool_] | None = None,
    slope: Floats | None = None,
    slopes: Floats | None = None,
    full: bool = True,
    start: Floats | None = None,
) -> Fit:
    """Coefficients of six axes from overlapping Allan variances.

    Args:
        design: columns for the cluster sizes of the curve
        table: covariances from ``uncertainty`` for the window's length
        avar: [m, 6] unit²; NaN where the window is too short
        terms: [m, 6] second differences behind each
        before: ``entered`` of the fit before, when one looks continuously: terms enter at 3 σ and leave at
            1.5 σ; without it, one look at 2.33 σ
        slope: [6] unit/s, ``slope_of_thirds`` of the same window, NaN = not measured; without it a ramp is
            never estimated, only bounded
        slopes: [m, 6] unit/s, the mean second difference of phase over τ² at each τ, of the same window; without it a
            strong ramp's products with the noise pull K
        full: weigh by the covariances of all τ, else by their variances alone
        start: [5, 6] ``theta`` of a fit a moment ago, to begin with its weights: a third of the work
    """
    m, axes = avar.shape
    slope = np.full(axes, np.nan) if slope is None else slope
    looks = Looks(avar, terms, slope, np.tile(slope, (m, 1)) if slopes is None else slopes, before)
    return _fit(design, table, looks, known(design, table), full, start)


def fit_columns(design: Design, table: Table, looks: Looks, full: bool = False, blind: Floats | None = None) -> Fit:
    """The same with the columns as they are: no τ is left out, and the fit does not look along ``blind`` [m]."""
    in_samples = np.zeros(design.factors.size) if blind is None else blind
    return _fit(design, table, looks, known(design, table, in_samples, ask=False), full)


def _fit(design: Design, table: Table, looks: Looks, shared: Known, full: bool, start: Floats | None = None) -> Fit:
    avar, terms, before = looks.avar, looks.terms, looks.before
    m, axes = avar.shape
    found = answer(axes, m, np.zeros((axes, 5), np.bool_) if before is None else np.array(before.T, order="C"))
    frozen = gains(axes, m)
    if start is not None:
        found.theta[:] = start.T / design.rate_hz ** (2.0 * TO_SI)
    curves, counts = np.ascontiguousarray(avar.T), np.ascontiguousarray(terms.T, np.float64)
    slope, slopes = looks.slope / design.rate_hz, np.ascontiguousarray(looks.slopes.T) / design.rate_hz
    thresholds, warm = THRESHOLDS_ONCE if before is None else THRESHOLDS_WATCHED, start is not None
    fit_axes(0, axes, shared, curves, counts, slope, slopes, thresholds, full, warm, found, frozen)
    to_si = design.rate_hz**TO_SI
    value = np.where(found.status == Status.ESTIMATED, np.sqrt(np.maximum(found.theta, 0.0)), np.nan)
    coefficients = Coefficients((value * to_si).T, (found.lo * to_si).T, (found.hi * to_si).T, found.status.T)
    edf = found.edf.T
    missing = np.isnan(edf) & (avar > 0.0)
    if missing.any():
        edf = np.where(missing, _white_edf(design, table, terms), edf)
    return Fit(
        coefficients, (found.theta * to_si**2).T, found.fitted.T, edf, found.entered.T, found.left_out,
        found.scatter, found.misfit, frozen.either,
    )  # fmt: skip


def replaced(whole: Fit, axis: int, one: Fit) -> Fit:
    """A fit with one axis of it from another fit, of that axis alone."""

    def put(into: NDArray[Any], part: NDArray[Any]) -> NDArray[Any]:
        result = into.copy()
        result[..., axis] = part[..., 0]
        return result

    names = ("value", "lo", "hi", "status")
    coefficients = [put(getattr(whole.coefficients, name), getattr(one.coefficients, name)) for name in names]
    fields: dict[str, Any] = {name: put(getattr(whole, name), getattr(one, name)) for name in FIELDS}
    return replace(whole, coefficients=Coefficients(*coefficients), **fields)


def joined(fits: Sequence[Fit], axes: Ints) -> Fit:
    """Fits of some axes each, as one of all: column ``axes[k]`` of the result is the k-th of theirs."""
    order = np.argsort(axes)

    def side_by_side(field: str, of: str = "") -> NDArray[Any]:
        parts = [getattr(getattr(one, of) if of else one, field) for one in fits]
        return np.concatenate(parts, axis=-1)[..., order]

    coefficients = Coefficients(*(side_by_side(field, "coefficients") for field in ("value", "lo", "hi", "status")))
    return Fit(coefficients, **{name: side_by_side(name) for name in FIELDS})


def nothing_fitted(avar: Floats) -> Fit:
    """What is said of a curve [m, 6] that has not been fitted: nothing."""
    nothing = np.full((5, avar.shape[1]), np.nan)
    status = np.full((5, avar.shape[1]), Status.UNESTIMATED, np.int8)
    return Fit(
        Coefficients(nothing, nothing, nothing, status),
        theta=nothing,
        fitted=np.full_like(avar, np.nan),
        edf=np.full_like(avar, np.nan),
        entered=np.zeros((5, avar.shape[1]), np.bool_),
        left_out=np.zeros(avar.shape[1], np.int64),
        scatter=np.full(avar.shape[1], np.nan),
        misfit=np.ones(avar.shape[1]),
        k_or_r=np.zeros(avar.shape[1], np.bool_),
    )


def slope_of_thirds(phase: Floats, seconds: float) -> Floats:
    """Slope of the rate over a window from its integral at the start, one third, two thirds and the end.

    ``phase`` [4, k] in unit·s, ``seconds`` the window's length; returns [k] unit/s: the mean of the last third
    less that of the first, over two thirds of the window. Under white noise its variance is 13.5 N²/T³, a
    regression's 12 N²/T³; under rate random walk 5/4 and 6/5 of K²/T.

    >>> t = np.array([[0.0], [30.0], [60.0], [90.0]])
    >>> slope_of_thirds(0.5 * 0.1 * t**2, 90.0).round(12).tolist()
    [0.1]
    """
    return np.asarray((phase[3] - phase[2] - phase[1] + phase[0]) / (2.0 / 9.0 * seconds**2))


def _white_edf(design: Design, table: Table, terms: Ints) -> Floats:
    """Degrees of freedom of white noise, for as long as there is no fit: so a sensor's first seconds are."""
    own = table.covariance[:, :, WHITE].diagonal()[:, None] * _ratio(table.terms[:, None], terms)
    return np.asarray(2.0 * design.columns[:, N, None] ** 2 / own)


def _ratio(whole: Ints, terms: Ints) -> Floats:
    """How many terms a window without gaps has for each that is there; NaN where there is none."""
    return np.where((whole > 0) & (terms > 0), whole / np.maximum(terms, 1), np.nan)
