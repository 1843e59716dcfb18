"""Selection and fit of a thermal model, which describes the bias as a function of temperature.

The simplest model wins. The search starts with a constant bias. A term is added only if an F test in a generalised
least-squares regression finds it significant beside the slow noise of the axis (``interval_regression``):

1. Powers of the temperature are added in ascending order. If the next power alone is not significant, it is tested
   together with the following ones.
2. If the temperature rose and fell, first-order lags are added one by one. The time constant comes from a search, for
   which the p-value is corrected. Powers that are not significant beside the lag are dropped again.
3. The terms are kept only if they reduce the variance of the interval means. Otherwise, the constant predicts better.

If the temperature rose and fell, a linear drift of the bias with time is part of the null hypothesis. If the
temperature only rose or only fell, a drift with time cannot be distinguished from a dependence on temperature.

The difference equation follows Wang et al., who modelled the bias of MEMS gyroscopes with 72 hourly means and small
temperature changes. The constant term and the tests extend that method.
"""

from collections.abc import Generator
from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf
from typing import Final, TypeVar

import numpy as np

from drivers.data_types import Floats
from drivers.errors import NotReady
from drivers.validation.number_ranges import HOUR_S
from monitor.common.distributions import student_quantile
from monitor.drift.thermal.hysteresis import (
    Hysteresis,
    find_hysteresis,
    heating_direction,
    rose_and_fell,
    temperature_noise_c,
)
from monitor.drift.thermal.interval_means import Grouping, IntervalMeans, interpolate_missing_temperatures
from monitor.drift.thermal.interval_regression import (
    CoefficientEstimate,
    RegressorTest,
    estimate_coefficients,
    f_test,
    max_log_likelihood,
)
from monitor.drift.thermal.thermal_model import (
    ThermalModel,
    bias_derivatives_by_log_time_constant,
)
from monitor.drift.thermal.thermal_response import ThermalModelForm, build_regressors

MIN_INTERVALS: Final = 12
SIGNIFICANCE: Final = 0.02
"""Maximum p-value at which a term is added, after Bonferroni correction."""
CUBIC: Final = 3
HIGH_POWER_SIGNIFICANCE: Final = 0.001
"""Maximum p-value of powers above the third."""
MAX_POWER: Final = 5
MAX_LAGS: Final = 3
CONSTANT: Final = ThermalModelForm(0, ())
LAG_TRIALS: Final = 5
"""Number of independent tests to which the search for a time constant corresponds.

Regressors with neighbouring time constants are correlated.
"""
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
MIN_SWING_C: Final = 0.1
"""Minimum temperature range for a fit, °C."""
MIN_SWING_SIGMAS: Final = 5.0
"""Minimum temperature range for a fit, in standard errors of a mean temperature."""
GOLDEN_STEPS: Final = 10
GOLDEN_RATIO: Final = 0.6180339887498949
MAX_PHI: Final = 0.99
"""Maximum correlation of the residuals of successive intervals, because a larger one would give no finite variance."""


@dataclass(frozen=True, slots=True)
class TermTest:
    """Test of whether a thermal model needs more terms."""

    shape: ThermalModelForm  # form with the additional terms
    p_value: float  # p-value after Bonferroni correction of the hypothesis that the simpler form suffices


@dataclass(frozen=True, slots=True)
class ThermalFit:
    """Selected thermal model of an axis, with the tests that selected it."""

    model: ThermalModel
    tests: tuple[TermTest, ...]  # in the order of the search
    temperature_rose_and_fell: bool
    explained: float  # share of the variance of the interval means that the model explains
    rms: float  # rms residual of the multi-step prediction, rad/s or m/s²
    degrees_of_freedom: int
    p_value: float = 1.0  # p-value of the null hypothesis that the bias does not depend on temperature
    step: float = 0.0  # fitted bias step (after minus before), rad/s or m/s²
    step_p: float = 1.0  # p-value of the null hypothesis that there is no bias step
    hysteresis: Hysteresis | None = None  # None if temperature did not both rise and fall, or if there was no test

    @property
    def slope_interval(self) -> tuple[float, float]:
        """Return the 95 % interval of the mean slope, in rad/s or m/s² per °C."""
        slope, half = self.model.mean_bias_slope, float(self.half_widths(self.model.slope_gradient))
        return slope - half, slope + half

    @property
    def time_constant_intervals_s(self) -> list[tuple[float, float]]:
        """Return the 95 % interval of each time constant in seconds."""
        constants = self.model.shape.constants_s
        size = self.model.covariance.shape[0]
        widths = np.exp(self.half_widths(np.eye(size)[size - len(constants) :])).tolist()
        return [(constant / width, constant * width) for constant, width in zip(constants, widths, strict=True)]

    def half_widths(self, gradients: Floats) -> Floats:
        """Return half the width of the 95 % interval [m] of linear combinations [m, parameters] of the parameters."""
        variance = np.einsum("...i,ij,...j->...", gradients, self.model.covariance, gradients)
        return np.asarray(student_quantile(self.degrees_of_freedom, 0.975) * np.sqrt(variance))


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
    return replace(found, hysteresis=find_hysteresis(means))


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
    """Select and fit a thermal model in steps of a few milliseconds.

    Each call of ``next`` on the generator runs one test.

    Parameters
    ----------
    means : IntervalMeans
        Interval means of the bias (rad/s or m/s²) and of the temperature (°C).
    first_after_step : int or None
        Index of the first interval after a possible bias step, which is fitted as an additional coefficient.
    always_try_lags : bool
        True to test lags even if the temperature only rose or only fell.

    Raises
    ------
    NotReady
        If there are too few intervals, or if the temperature hardly changed.
    """
    check_means_suffice_for_fit(means)
    search = _FormSearch(means, first_after_step)
    yield from search.add_powers()
    if search.temperature_rose_and_fell or always_try_lags:
        yield from search.add_lags()
    found = search.fit()
    # Beside a strong random walk, a significant term may still predict worse than none.
    if found.explained == 0.0 and not search.shape.is_constant:
        search.shape = CONSTANT
        found = search.fit()
    return found


def refit_coefficients(model: ThermalModel, means: IntervalMeans) -> ThermalFit:
    """Fit the coefficients of a thermal model with known form and time constants."""
    return _FormSearch(means, None, model.shape).fit()


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


class _FormSearch:
    """Search for the simplest form of the thermal model of one axis.

    Parameters
    ----------
    means : IntervalMeans
        Interval means.
    since : int or None
        Index of the first interval after a possible bias step.
    shape : ThermalModelForm
        Form with which the search begins.
    """

    def __init__(self, means: IntervalMeans, since: int | None, shape: ThermalModelForm = CONSTANT) -> None:
        self._means, self.shape, self._since = means, shape, since
        self._tests: list[TermTest] = []
        temperature_c = interpolate_missing_temperatures(means.temperature_c)
        self._reference_c = round(float(temperature_c.mean()), 2)
        self._excess = temperature_c - self._reference_c
        self._grouping = Grouping(means.both_known)
        self._y = self._grouping.average(means.bias[:, None])[:, 0]
        self.temperature_rose_and_fell = rose_and_fell(heating_direction(temperature_c))
        n = temperature_c.size
        nuisance = [np.linspace(-1.0, 1.0, n)] if self.temperature_rose_and_fell else []
        if since is not None:
            nuisance.append((np.arange(n) >= since).astype(np.float64))
        self._nuisance = np.reshape(nuisance, (len(nuisance), n)).T
        self._fastest = MIN_TIME_CONSTANT_INTERVALS * means.interval_s
        self._slowest = MAX_TIME_CONSTANT_SHARE * means.interval_s * n
        self._grid = np.geomspace(self._fastest, self._slowest, GRID_POINTS)

    def add_powers(self) -> StepwiseWork[None]:
        """Add powers of the temperature as long as they are significant."""
        added = True
        while added:
            added = False
            powers = self.shape.powers
            trials = MAX_POWER - powers
            for more in range(1, trials + 1):
                yield
                level = SIGNIFICANCE if powers + more <= CUBIC else HIGH_POWER_SIGNIFICANCE
                shape = replace(self.shape, powers=powers + more)
                if self._accept(shape, self._test_powers(shape, more), trials, level):
                    added = True
                    break

    def add_lags(self) -> StepwiseWork[None]:
        """Add lags as long as they are significant, and drop powers that are not significant beside a lag."""
        for k in range(1, MAX_LAGS + 1):
            if INTERVALS_PER_SQUARED_LAGS * k**2 >= int(self._means.both_known.sum()):
                return
            shape = yield from self._find_lag(self.shape)
            if shape is None or not self._accept(shape, self._test_lag(shape), LAG_TRIALS, SIGNIFICANCE):
                return
            yield from self._drop_powers()

    def fit(self) -> ThermalFit:
        """Fit the coefficients of the selected form."""
        means, shape, own = self._means, self.shape, self._nuisance.shape[1]
        columns = self._columns(shape)
        known = means.both_known
        estimate = self._estimate(columns)
        slopes = estimate.coefficients[own:]
        step = float(estimate.coefficients[own - 1]) if self._since is not None else 0.0
        bias = means.bias - (0.0 if self._since is None else step * self._nuisance[:, -1])
        constant = float((bias - columns @ slopes)[known].mean())
        terms = 1 + shape.powers + shape.difference_equation_order
        sizes = np.concatenate([[constant], slopes])
        residuals = np.where(known, bias - constant - columns @ slopes, np.nan)
        phi, sigma = _residual_correlation(residuals, estimate.degrees_of_freedom)
        model = ThermalModel(
            shape=shape,
            interval_s=means.interval_s,
            reference_c=self._reference_c,
            coefficients=sizes[:terms],
            initial_state=sizes[terms:],
            phi=phi,
            sigma=sigma,
            covariance=np.zeros((0, 0)),
            lowest_c=float(np.nanmin(means.temperature_c)),
            highest_c=float(np.nanmax(means.temperature_c)),
        )
        if shape.constants_s:
            columns = np.hstack([columns, bias_derivatives_by_log_time_constant(model, self._excess, sizes)])
            estimate = self._estimate(columns)
        covariance = estimate.covariance[own:, own:]
        # The constant is the mean of the bias minus the other terms.
        centre = -columns[known].mean(axis=0)
        whole = np.vstack([centre, np.eye(centre.size)]) @ covariance @ np.vstack([centre, np.eye(centre.size)]).T
        whole[0, 0] += model.residual_std**2 / known.sum()
        model = replace(model, covariance=whole)
        explained = max(1.0 - float(np.nanvar(residuals) / np.var(bias[known])), 0.0)
        return ThermalFit(
            model,
            tuple(self._tests),
            self.temperature_rose_and_fell,
            explained,
            float(np.sqrt(np.nanmean(residuals**2))),
            estimate.degrees_of_freedom,
            min((one.p_value for one in self._tests), default=1.0),
            step,
            1.0 if self._since is None else self._test_step(),
        )

    def _accept(self, shape: ThermalModelForm, test: RegressorTest | None, trials: int, level: float) -> bool:
        """Record a test, and select the tested form if it is significant."""
        p_value = 1.0 if test is None else min(trials * test.p_value, 1.0)
        self._tests.append(TermTest(shape, p_value))
        if p_value < level:
            self.shape = shape
        return p_value < level

    def _columns(self, shape: ThermalModelForm) -> Floats:
        """Return the powers, the lags and the initial-state responses of a form [n, terms - 1 + k]."""
        return build_regressors(shape, self._excess, self._means.interval_s, with_initial_state=True)[:, 1:]

    def _test(self, nuisance: Floats, tested: Floats) -> RegressorTest | None:
        average = self._grouping.average
        return f_test(self._y, average(np.hstack([self._nuisance, nuisance])), average(tested), self._grouping.known)

    def _estimate(self, columns: Floats) -> CoefficientEstimate:
        found = estimate_coefficients(
            self._y, self._grouping.average(np.hstack([self._nuisance, columns])), self._grouping.known
        )
        if found is None:
            raise NotReady("too few intervals with bias and temperature for the thermal model: record longer")
        return found

    def _test_powers(self, shape: ThermalModelForm, count: int) -> RegressorTest | None:
        """Test the highest ``count`` powers of a form."""
        columns = self._columns(shape)
        tested = np.arange(columns.shape[1])
        tested = tested[(tested >= shape.powers - count) & (tested < shape.powers)]
        return self._test(np.delete(columns, tested, axis=1), columns[:, tested])

    def _test_lag(self, shape: ThermalModelForm) -> RegressorTest | None:
        """Test the last lag of a form. The response to its initial state is part of the null hypothesis."""
        columns, at = self._columns(shape), shape.powers + shape.difference_equation_order - 1
        return self._test(np.delete(columns, at, axis=1), columns[:, [at]])

    def _test_step(self) -> float:
        """Return the p-value of the bias step."""
        average = self._grouping.average
        nuisance = np.hstack([self._nuisance[:, :-1], self._columns(self.shape)])
        found = f_test(self._y, average(nuisance), average(self._nuisance[:, -1:]), self._grouping.known)
        return 1.0 if found is None else found.p_value

    def _find_lag(self, shape: ThermalModelForm) -> StepwiseWork[ThermalModelForm | None]:
        """Return the form with the most likely additional lag, or None if no further time constant is possible."""
        grid = [
            one
            for one in self._grid.tolist()
            if all(max(one / c, c / one) >= MIN_TIME_CONSTANT_RATIO for c in shape.constants_s)
        ]
        scores = []
        for one in grid:
            scores.append((yield from self._likelihood(shape, one)))
        if not grid or max(scores) == -inf:
            return None
        best = grid[int(np.argmax(scores))]
        ratio = float(self._grid[1] / self._grid[0])
        lo, hi = max(best / ratio, self._fastest), min(best * ratio, self._slowest)
        for _ in range(GOLDEN_STEPS):
            a, b = hi * (lo / hi) ** GOLDEN_RATIO, lo * (hi / lo) ** GOLDEN_RATIO
            below = yield from self._likelihood(shape, a)
            above = yield from self._likelihood(shape, b)
            lo, hi = (lo, b) if below > above else (a, hi)
        return replace(shape, constants_s=(*shape.constants_s, (lo * hi) ** 0.5))

    def _likelihood(self, shape: ThermalModelForm, constant: float) -> StepwiseWork[float]:
        """Return the log-likelihood of a form with an additional lag."""
        yield
        columns = self._columns(replace(shape, constants_s=(*shape.constants_s, constant)))
        average = self._grouping.average
        return max_log_likelihood(self._y, average(np.hstack([self._nuisance, columns])), self._grouping.known)

    def _drop_powers(self) -> StepwiseWork[None]:
        """Drop the highest powers that are not significant beside the lags, and fit the last lag again."""
        powers = self.shape.powers
        while self.shape.powers:
            yield
            test = self._test_powers(self.shape, 1)
            if test is not None and test.p_value < SIGNIFICANCE:
                break
            self.shape = replace(self.shape, powers=self.shape.powers - 1)
        if self.shape.powers < powers:
            again = yield from self._find_lag(replace(self.shape, constants_s=self.shape.constants_s[:-1]))
            self.shape = again or self.shape


def _residual_correlation(residuals: Floats, degrees_of_freedom: int) -> tuple[float, float]:
    """Return the correlation φ of successive residuals, and the standard deviation of the one-step residuals."""
    pairs = np.array([(a, b) for a, b in pairwise(residuals.tolist())]).reshape(-1, 2)
    before, after = pairs[np.isfinite(pairs).all(axis=1)].T
    square = float(before @ before)
    phi = min(max(float(before @ after) / square, 0.0), MAX_PHI) if square > 0.0 else 0.0
    count = int(np.isfinite(residuals).sum())
    scatter = float(np.sum((after - phi * before) ** 2)) if phi else float(np.nansum(residuals**2))
    share = count / max(after.size if phi else count, 1)
    return phi, max(share * scatter / max(min(degrees_of_freedom, count), 1), 1e-300) ** 0.5
