"""Selection and fit of a thermal model, which describes the bias as a function of temperature.

Polynomials and difference equations are fitted to interval means of bias and temperature by least squares. Difference
equations are evaluated with predicted values, because noise in measured values would bias the roots towards zero.
Successive residuals may be correlated: r_n = φ r_{n−1} + e_n.

The model with the smallest AICc is selected (Hurvich & Tsai, Biometrika 76, 1989). Asymptotically, the AICc agrees with
cross-validation (Stone, J. R. Stat. Soc. B, 1977). Lags and powers above the third must improve the AICc by a margin. A
model is rejected if its cross-validated error exceeds that of a constant, because slow heating leaves one end of a
polynomial unconstrained. The selection takes 50 ms to 1 s.

The method follows Wang et al., who modelled the bias of MEMS gyroscopes with 72 hourly means and small temperature
changes. The constant term and the use of predicted values extend that method.
"""

from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from math import log
from typing import Final, TypeVar

import numpy as np

from drivers.data_types import Floats
from drivers.errors import NotReady
from drivers.validation.number_ranges import HOUR_S
from monitor.drift.thermal.bias_temperature_tests import find_hysteresis, temperature_noise_c
from monitor.drift.thermal.interval_means import IntervalMeans
from monitor.drift.thermal.thermal_model import (
    ThermalModel,
    bias_derivatives_by_log_time_constant,
    coefficient_covariance,
    interpolate_missing_temperatures,
)
from monitor.drift.thermal.thermal_response import ThermalModelForm, build_regressors, solve_least_squares

MIN_INTERVALS: Final = 12
MAX_POWER: Final = 5
CUBIC: Final = 3
"""Highest order of a polynomial that is accepted without a margin in the AICc."""
MAX_LAGS: Final = 3
INTERVALS_PER_SQUARED_LAGS: Final = 8
"""Minimum number of intervals for a model with k lags, divided by k².

With fewer intervals, the lags would follow a random walk of the bias.
"""
MAX_TIME_CONSTANT_SHARE: Final = 0.25
"""Maximum time constant as a fraction of the recording. Longer time constants would resemble a drift."""
MIN_TIME_CONSTANT_INTERVALS: Final = 0.5
"""Minimum time constant in intervals. Shorter time constants would have no effect."""
MIN_TIME_CONSTANT_RATIO: Final = 2.0
"""Minimum ratio of two time constants. Closer time constants would get large coefficients that cancel each other."""
GRID_POINTS: Final = 20
PHI_VALUES: Final = (0.0, 0.3, 0.6, 0.8, 0.9, 0.97)
FOLDS: Final = 6
"""Number of parts into which the recording is divided for cross-validation."""
MAX_ERROR_RATIO: Final = 1.05
"""Maximum cross-validated error of an accepted model, relative to the error of a constant."""
LAG_AICC_MARGIN: Final = 6.0
"""Minimum AICc improvement of a model with lags. With few intervals, noise can resemble a lag."""
CURVE_AICC_MARGIN: Final = 10.0
"""Minimum AICc improvement of a power above the third, because noise can resemble a higher power."""
MIN_SWING_C: Final = 0.1
"""Minimum temperature range for a fit, °C."""
MIN_SWING_SIGMAS: Final = 5.0
"""Minimum temperature range for a fit, in standard errors of a mean temperature."""
MIN_REVERSE_SHARE: Final = 0.1
"""The temperature counts as having risen and fallen if rises and falls each exceed this share of the total change."""
GOLDEN_STEPS: Final = 10
GOLDEN_RATIO: Final = 0.6180339887498949


@dataclass(frozen=True, slots=True)
class CandidateModel:
    """Fitted thermal model that was considered in a model selection."""

    shape: ThermalModelForm
    aicc: float  # AICc minus the AICc of the selected form; negative if a form with a lower AICc was rejected
    rms: float  # rms residual of the multi-step prediction, rad/s or m/s²
    validated: float  # cross-validated rms error, rad/s or m/s²


@dataclass(frozen=True, slots=True)
class ThermalFit:
    """Selected thermal model of an axis, with all candidate models."""

    model: ThermalModel
    candidates: tuple[CandidateModel, ...]  # the selected form, followed by the others in the order of their AICc
    temperature_rose_and_fell: bool
    explained: float  # share of the variance of the interval means that the model explains
    aicc: float  # AICc, only comparable between fits to the same interval means
    step: float = 0.0  # fitted bias step (after minus before), rad/s or m/s²
    hysteresis: float | None = None  # largest difference between heating and cooling at one temperature, rad/s or m/s²;
    # 0 if noise explains the difference; None if temperature did not both rise and fall, or if there was no test
    hysteresis_p: float | None = None  # p-value of the null hypothesis that heating and cooling do not differ


T = TypeVar("T")
StepwiseWork = Generator[None, None, T]
"""Generator that runs one step of a computation at each call of ``next``, and finally returns the result."""


def fit_thermal_model(means: IntervalMeans) -> ThermalFit:
    """Select and fit a thermal model, and test for hysteresis between heating and cooling.

    Raises
    ------
    NotReady
        If there are too few intervals, or if the temperature hardly changed.
    """
    found = _run_all_steps(fit_thermal_model_stepwise(means))
    loop = find_hysteresis(means) if found.temperature_rose_and_fell else None
    if loop is None:
        return found
    return replace(found, hysteresis=loop.size if loop.hysteresis_is_significant else 0.0, hysteresis_p=loop.p_value)


def _run_all_steps(pieces: StepwiseWork[T]) -> T:
    try:
        while True:
            next(pieces)
    except StopIteration as end:
        made: T = end.value
        return made


def fit_thermal_model_stepwise(
    means: IntervalMeans, first_after_step: int | None = None, always_try_lags: bool = False
) -> StepwiseWork[ThermalFit]:
    """Select and fit a thermal model in steps of less than a millisecond.

    Each call of ``next`` on the generator runs one least-squares fit.

    Parameters
    ----------
    means : IntervalMeans
        Interval means of the bias (rad/s or m/s²) and of the temperature (°C).
    first_after_step : int or None
        Index of the first interval after a possible bias step, which is fitted as an additional coefficient.
    always_try_lags : bool
        True to fit models with lags even if the temperature only rose or only fell.

    Raises
    ------
    NotReady
        If there are too few intervals, or if the temperature hardly changed.
    """
    check_means_suffice_for_fit(means)
    excess, reference_c = _temperature_difference(means)
    temperature_rose_and_fell = _both_ways(means.temperature_c)
    tried = []
    for shape in _shapes(means, temperature_rose_and_fell or always_try_lags):
        tried.append((yield from _fit_shape(means, excess, shape, first_after_step)))
    tried.sort(key=lambda one: one.aicc + _aicc_margin(one.shape))
    errors = []
    for one in tried:
        yield
        errors.append(_cross_validated_error(_without_step(means, first_after_step, one.step), excess, one))
    alone = next(error for one, error in zip(tried, errors, strict=True) if one.shape == ThermalModelForm(0, ()))
    at = next(i for i, error in enumerate(errors) if error <= MAX_ERROR_RATIO * alone)
    best = tried.pop(at)
    kept = [(best, errors.pop(at)), *zip(tried, errors, strict=True)]
    candidates = tuple(CandidateModel(one.shape, one.aicc - best.aicc, one.rms, error) for one, error in kept)
    yield
    means = _without_step(means, first_after_step, best.step)
    model = _to_model(means, excess, reference_c, best)
    known = means.both_known
    left = means.bias[known] - (best.columns @ best.sizes)[known]
    explained = 1.0 - float(np.var(left) / np.var(means.bias[known]))
    return ThermalFit(model, candidates, temperature_rose_and_fell, explained, best.aicc, best.step)


@dataclass(frozen=True, slots=True)
class _ShapeFit:
    """Least-squares fit of one model form."""

    shape: ThermalModelForm
    columns: Floats  # [n, terms + k] regressors
    sizes: Floats  # [terms + k] coefficients
    phi: float
    sigma: float
    rms: float
    aicc: float
    step: float


def check_means_suffice_for_fit(means: IntervalMeans) -> None:
    """Check whether the interval means suffice to fit a thermal model.

    Raises
    ------
    NotReady
        If there are too few interval means, if the temperature hardly changed, or if the bias is constant.
    """
    count = int(means.both_known.sum())
    if count < MIN_INTERVALS:
        raise NotReady(
            f"{count} intervals of {means.interval_s:g} s with bias and temperature; at least {MIN_INTERVALS} are "
            f"needed: record longer, or use a shorter interval"
        )
    known_temperature_c = means.temperature_c[means.both_known]
    swing = float(np.ptp(known_temperature_c))
    least = max(MIN_SWING_C, MIN_SWING_SIGMAS * temperature_noise_c(known_temperature_c))
    if swing < least:
        raise NotReady(
            f"temperature hardly changed: by {swing:.2g} °C in {count * means.interval_s / HOUR_S:.3g} h; "
            f"at least {least:.2g} °C are needed"
        )
    if not np.ptp(means.bias[means.both_known]) > 0.0:
        raise NotReady("the bias is the same in all intervals")


def _aicc_margin(shape: ThermalModelForm) -> float:
    """Return the AICc improvement that is required to select a model form."""
    if shape.difference_equation_order:
        return LAG_AICC_MARGIN
    return CURVE_AICC_MARGIN if shape.powers > CUBIC else 0.0


def _temperature_difference(means: IntervalMeans) -> tuple[Floats, float]:
    """Return the temperatures [n] relative to the reference temperature, and the reference temperature, in °C."""
    known = interpolate_missing_temperatures(means.temperature_c)
    reference_c = round(float(known.mean()), 2)
    return known - reference_c, reference_c


def _both_ways(temperature_c: Floats) -> bool:
    """Return True if the temperature both rose and fell by more than MIN_REVERSE_SHARE of the total change."""
    smooth = np.convolve(
        np.pad(interpolate_missing_temperatures(temperature_c), 1, mode="edge"), np.full(3, 1.0 / 3.0), mode="valid"
    )
    moved = np.diff(smooth)
    up, down = float(moved[moved > 0.0].sum()), float(-moved[moved < 0.0].sum())
    return min(up, down) > MIN_REVERSE_SHARE * (up + down)


def _shapes(means: IntervalMeans, lags: bool) -> Iterator[ThermalModelForm]:
    """Yield the model forms for which there are enough intervals."""
    count = int(means.both_known.sum())
    for powers in range(MAX_POWER + 1):
        if powers + 3 < count / 2:
            yield ThermalModelForm(powers, ())
    for k in range(1, MAX_LAGS + 1):
        for powers in (0, 1):
            if lags and INTERVALS_PER_SQUARED_LAGS * k**2 < count:
                yield ThermalModelForm(powers, tuple(means.interval_s * 2.0**i for i in range(k)))


def _fit_shape(
    means: IntervalMeans, excess: Floats, shape: ThermalModelForm, since: int | None
) -> StepwiseWork[_ShapeFit]:
    """Find the best time constants and the best residual correlation φ of a model form."""
    best = yield from _TimeConstantSearch(means, excess, shape, PHI_VALUES[0], since).find_best_time_constants()
    for phi in PHI_VALUES[1:]:
        other = yield from _TimeConstantSearch(means, excess, shape, phi, since).find_best_time_constants()
        best = min(best, other, key=lambda one: one.aicc)
    return best


class _TimeConstantSearch:
    """Search for the best time constants of a model form at a given residual correlation φ.

    The time constants are selected one by one from a grid, and then refined by golden-section search. Two successive
    evaluations differ in one time constant, so the whitened regressors of the others are kept.
    """

    def __init__(
        self, means: IntervalMeans, excess: Floats, shape: ThermalModelForm, phi: float, since: int | None
    ) -> None:
        self._means, self._excess, self._shape, self._phi, self._since = means, excess, shape, phi, since
        self._fastest = MIN_TIME_CONSTANT_INTERVALS * means.interval_s
        self._slowest = MAX_TIME_CONSTANT_SHARE * means.interval_s * excess.size
        self._grid = np.geomspace(self._fastest, self._slowest, GRID_POINTS)
        self._constants: tuple[float, ...] = ()
        self._whitening = Whitening(means.both_known, phi)
        self._values = self._whitening.whiten(np.where(means.both_known, means.bias, 0.0))
        self._fixed = self._whiten_columns(replace(shape, constants_s=()))
        self._step = [] if since is None else [self._whitening.whiten(_step_column(excess.size, since))]
        self._lag_columns = lru_cache(MAX_LAGS + 1)(self._whiten_lag_columns)

    def find_best_time_constants(self) -> StepwiseWork[_ShapeFit]:
        """Find the best time constants, and return the fit."""
        k = self._shape.difference_equation_order
        for _ in range(k):
            yield from self._add_from_grid()
        for _ in range(2 if k > 1 else min(k, 1)):
            for at in range(k):
                yield from self._refine(at)
        yield
        shape = replace(self._shape, constants_s=tuple(sorted(self._constants)))
        return _fit_sizes(self._means, self._excess, shape, self._phi, self._since)

    def _whiten_columns(self, shape: ThermalModelForm) -> list[Floats]:
        columns = build_regressors(shape, self._excess, self._means.interval_s, with_initial_state=True)
        return [self._whitening.whiten(column) for column in columns.T]

    def _whiten_lag_columns(self, constant: float) -> tuple[Floats, Floats]:
        """Return the whitened lag of a time constant, and the whitened response to its initial state."""
        _, lag, initial = self._whiten_columns(ThermalModelForm(0, (constant,)))
        return lag, initial

    def _evaluate(self, constants: tuple[float, ...]) -> StepwiseWork[float]:
        """Return the AICc of a fit."""
        yield
        lags, initials = zip(*map(self._lag_columns, sorted(constants)), strict=True)
        x = np.stack([*self._fixed, *lags, *initials, *self._step], axis=1)
        sizes = solve_least_squares(x, self._values)
        free = sizes.size + len(constants) + (self._phi > 0.0) + 1
        return _compute_aicc(_residual_square(x, self._values, sizes), free, self._phi, self._whitening)

    def _add_from_grid(self) -> StepwiseWork[None]:
        """Add the best time constant on the grid that differs from the others by MIN_TIME_CONSTANT_RATIO or more."""
        free = [
            one
            for one in self._grid.tolist()
            if all(max(one / c, c / one) >= MIN_TIME_CONSTANT_RATIO for c in self._constants)
        ]
        scores = []
        for one in free:
            scores.append((yield from self._evaluate((*self._constants, one))))
        self._constants = (*self._constants, free[int(np.argmin(scores))])

    def _refine(self, at: int) -> StepwiseWork[None]:
        lo, hi = self._bounds(at)
        a, b = hi * (lo / hi) ** GOLDEN_RATIO, lo * (hi / lo) ** GOLDEN_RATIO
        below = yield from self._evaluate(self._replaced(at, a))
        above = yield from self._evaluate(self._replaced(at, b))
        for _ in range(GOLDEN_STEPS - 1):
            if below < above:
                hi, b, above = b, a, below
                a = hi * (lo / hi) ** GOLDEN_RATIO
                below = yield from self._evaluate(self._replaced(at, a))
            else:
                lo, a, below = a, b, above
                b = lo * (hi / lo) ** GOLDEN_RATIO
                above = yield from self._evaluate(self._replaced(at, b))
        lo, hi = (lo, b) if below < above else (a, hi)
        self._constants = self._replaced(at, (lo * hi) ** 0.5)

    def _replaced(self, at: int, constant: float) -> tuple[float, ...]:
        return (*self._constants[:at], constant, *self._constants[at + 1 :])

    def _bounds(self, at: int) -> tuple[float, float]:
        """Return the limits within which a time constant is refined, at most one grid step away."""
        one, others = self._constants[at], (*self._constants[:at], *self._constants[at + 1 :])
        ratio = float(self._grid[1] / self._grid[0])
        below = max((MIN_TIME_CONSTANT_RATIO * other for other in others if other < one), default=self._fastest)
        above = min((other / MIN_TIME_CONSTANT_RATIO for other in others if other > one), default=self._slowest)
        return max(one / ratio, self._fastest, min(below, one)), min(one * ratio, self._slowest, max(above, one))


def _fit_sizes(
    means: IntervalMeans, excess: Floats, shape: ThermalModelForm, phi: float, since: int | None = None
) -> _ShapeFit:
    """Fit the coefficients of a model form by least squares with whitened regressors."""
    known = means.both_known
    columns = build_regressors(shape, excess, means.interval_s, with_initial_state=True)
    own = columns.shape[1]
    if since is not None:
        columns = np.hstack([columns, _step_column(excess.size, since)[:, None]])
    y = np.where(known, means.bias, 0.0)
    whitening = Whitening(known, phi)
    x, z = whitening.whiten(columns), whitening.whiten(y)
    sizes = solve_least_squares(x, z)
    square = _residual_square(x, z, sizes)
    free = sizes.size + shape.difference_equation_order + (phi > 0.0) + 1
    rms = float(np.sqrt(np.mean((y - columns @ sizes)[known] ** 2)))
    sigma = (square / max(len(z) - free + 1, 1)) ** 0.5
    step = 0.0 if since is None else float(sizes[own])
    aicc = _compute_aicc(square, free, phi, whitening)
    return _ShapeFit(shape, columns[:, :own], sizes[:own], phi, sigma, rms, aicc, step)


def _step_column(n: int, since: int) -> Floats:
    return (np.arange(n) >= since).astype(np.float64)


def _residual_square(x: Floats, z: Floats, sizes: Floats) -> float:
    return max(float(((z - x @ sizes) ** 2).sum()), 1e-300)


def _compute_aicc(square: float, free: int, phi: float, whitening: "Whitening") -> float:
    """Return the AICc of a fit with ``free`` parameters and the sum of squares of the whitened residuals."""
    count = whitening.known_count
    likelihood = count * log(square / count) - whitening.fresh_count * log(1.0 - phi**2)
    return likelihood + 2.0 * free * count / max(count - free - 1.0, 0.5)


def _without_step(means: IntervalMeans, since: int | None, step: float) -> IntervalMeans:
    if since is None:
        return means
    return replace(means, bias=means.bias - step * (np.arange(means.bias.size) >= since))


class Whitening:
    """Filter that whitens residuals with the correlation φ between successive intervals.

    From each row, φ times the previous row is subtracted. If the previous row is unknown, the row is scaled instead, so
    that its residual has the same variance.

    Parameters
    ----------
    known : ndarray, shape (n,), bool
        True where the value is known.
    phi : float
        Correlation between successive residuals.
    """

    def __init__(self, known: np.ndarray, phi: float) -> None:
        follows = known[1:] & known[:-1]
        first = known.copy()
        first[1:] &= ~follows
        self._known = known
        self._previous_weight = phi * follows
        self._weight = np.where(first, (1.0 - phi**2) ** 0.5, 1.0)
        self.known_count = int(known.sum())  # number of rows with known values
        self.fresh_count = int(first.sum())  # number of known rows whose previous row is unknown

    def whiten(self, rows: Floats) -> Floats:
        """Whiten regressors [n, m] or values [n], and return the rows with known values."""
        columns = rows.T
        whitened = columns.copy()
        whitened[..., 1:] -= self._previous_weight * columns[..., :-1]
        return np.asarray(np.ascontiguousarray((whitened * self._weight).T)[self._known])


def _cross_validated_error(means: IntervalMeans, excess: Floats, one: _ShapeFit) -> float:
    """Return the rms error with which each part of the recording is predicted by a fit to the other parts.

    For the first part, the temperature before the recording is assumed to be constant, because the initial state of the
    lags is unknown.
    """
    edges = np.linspace(0, excess.size, FOLDS + 1).astype(np.int64)
    square = 0.0
    for lo, hi in pairwise(edges.tolist()):
        used = means.both_known.copy()
        used[lo:hi] = False
        columns = one.columns if lo else build_regressors(one.shape, excess, means.interval_s)
        whitening = Whitening(used, one.phi)
        x, z = whitening.whiten(columns), whitening.whiten(np.where(used, means.bias, 0.0))
        differences = (means.bias - columns @ solve_least_squares(x, z))[lo:hi]
        square += float((differences[means.both_known[lo:hi]] ** 2).sum())
    return float((square / means.both_known.sum()) ** 0.5)


def _to_model(means: IntervalMeans, excess: Floats, reference_c: float, one: _ShapeFit) -> ThermalModel:
    """Convert a fit to a thermal model with the covariance of the coefficients."""
    k = one.shape.difference_equation_order
    terms = one.sizes.size - k
    model = ThermalModel(
        shape=one.shape,
        interval_s=means.interval_s,
        reference_c=reference_c,
        coefficients=one.sizes[:terms],
        initial_state=one.sizes[terms:],
        phi=one.phi,
        sigma=one.sigma,
        covariance=np.zeros((0, 0)),
        lowest_c=float(np.nanmin(means.temperature_c)),
        highest_c=float(np.nanmax(means.temperature_c)),
    )
    rows = np.hstack([one.columns, bias_derivatives_by_log_time_constant(model, excess, one.sizes)])
    x = Whitening(means.both_known, one.phi).whiten(rows)
    return replace(model, covariance=coefficient_covariance(x, one.sigma))
