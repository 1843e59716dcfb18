"""Online model of the bias of one axis as a function of temperature.

The mean bias of each interval is predicted before the interval is used to fit the model. A multi-step prediction uses
only the temperature. A one-step prediction also uses the bias of the previous interval. After each interval, the
coefficients are fitted again. A new form of the model is selected when the number of intervals has grown by the factor
REFIT_GROWTH. The form is a constant until a dependence on temperature is significant. Because a selection takes up to a
second, ``run_selection_step_if_active`` runs one short step at a time.

If the bias lies outside the prediction interval several times, ``residual_alarm`` suspects a change of the bias. A
measured bias far outside the prediction interval is not used to fit the model. To test the suspicion, a model with a
bias step is fitted. If the step is significant beside the slow noise of the axis, the change is reported, and the
earlier intervals are shifted to the new offset. Otherwise, a model without a step replaces the previous model.
After the sensor has been moved or restarted, the new offset is learned but not reported.
"""

from collections import deque
from dataclasses import dataclass, replace
from itertools import islice
from math import ceil
from typing import Final

import numpy as np

from drivers.errors import NotReady
from monitor.common.distributions import Z95, student_quantile
from monitor.drift.thermal.interval_means import IntervalMeans
from monitor.drift.thermal.residual_alarm import PredictionInterval, UnexplainedBiasChangeDetector, UnexplainedChange
from monitor.drift.thermal.thermal_fit import (
    StepwiseWork,
    ThermalFit,
    fit_thermal_model_stepwise,
    refit_coefficients,
)
from monitor.drift.thermal.thermal_model import predict_interval_means

MAX_INTERVALS: Final = 1000
"""Maximum number of stored intervals. A thousand intervals of ten minutes cover a week."""
REFIT_GROWTH: Final = 1.25
"""Factor by which the number of known intervals must grow before a new model is selected."""
OFFSET_INTERVALS: Final = 3
"""Number of intervals from which a new bias offset is determined."""
STEP_SIGNIFICANCE: Final = 1e-3
"""Maximum p-value at which a bias step is accepted.

The value is small because the same intervals determine the position of the step.
"""
NEW_OFFSET: Final = "the sensor was moved or restarted: the new offset is being learned"
"""Message that explains why there is no prediction after a change of the offset."""


@dataclass(frozen=True, slots=True)
class MeasuredAndPredictedMean:
    """Measured and predicted mean bias of one axis in an interval."""

    bias: float  # measured mean bias, rad/s or m/s²; NaN if too few samples are known
    error: float  # standard error of ``bias``
    multi_step: PredictionInterval | None  # prediction from the temperature alone; None if there is no model yet
    one_step: PredictionInterval | None  # prediction from the temperature and the previous bias
    model: str  # name of the model form
    slope: float  # change of the bias per °C after all lags have settled; NaN without a model
    text: str  # reason why there is no prediction, or empty


@dataclass(frozen=True, slots=True)
class _Row:
    bias: float
    error: float
    temperature_c: float
    excluded: bool = False  # True if the bias is excluded from the fit until the next selection

    @property
    def has_bias_and_temperature(self) -> bool:
        """Return True if both the bias and the temperature are known."""
        return bool(np.isfinite(self.bias) and np.isfinite(self.temperature_c))


class OnlineThermalModel:
    """Online thermal model of one axis, with the intervals to which it is fitted.

    Parameters
    ----------
    interval_s : float
        Length of an interval in seconds.
    """

    def __init__(self, interval_s: float) -> None:
        self._interval_s = interval_s
        self._rows: deque[_Row] = deque(maxlen=MAX_INTERVALS)
        self._fit: ThermalFit | None = None
        self._suspicion = UnexplainedBiasChangeDetector()
        self._work: StepwiseWork[None] | None = None
        self._interval_count = 0  # number of intervals since the start
        self._known_count = 0  # number of intervals with known bias and temperature
        self._next_choice = 0  # number of known intervals at which the next model is selected
        self._offset_differences: list[float] | None = None  # residuals since the offset changed; None otherwise
        self._new_offset_at = 0  # value of ``_interval_count`` when the offset changed
        self._settled: list[UnexplainedChange] = []
        self._missing_reason = ""  # reason why there is no model

    def predict_and_add_interval(
        self, bias: float, standard_error: float, temperature_c: float
    ) -> MeasuredAndPredictedMean:
        """Predict the bias in a new interval, and then update the model with the measured bias.

        Parameters
        ----------
        bias : float
            Mean bias in the interval, in rad/s or m/s²; NaN means not measured.
        standard_error : float
            Standard error of ``bias``.
        temperature_c : float
            Mean temperature in the interval, in °C; NaN means not measured.
        """
        row = _Row(bias, standard_error, temperature_c)
        self._interval_count += 1
        self._known_count += row.has_bias_and_temperature
        self._rows.append(row)
        if self._fit is None:
            if self._work is None:
                self._start_work(self._choose_model())
            return MeasuredAndPredictedMean(bias, standard_error, None, None, "", np.nan, self._missing_reason)
        name, slope = self._fit.model.shape.name, self._fit.model.mean_bias_slope
        multi_step, one_step = self._predict_last_interval(self._fit)
        if self._offset_differences is not None:
            self._rows[-1] = replace(row, excluded=True)
            if row.has_bias_and_temperature:
                self._add_offset_difference(self._offset_differences, bias - multi_step.bias)
            return MeasuredAndPredictedMean(bias, standard_error, None, None, name, slope, NEW_OFFSET)
        found = self._suspicion.check_interval(bias if row.has_bias_and_temperature else np.nan, multi_step, one_step)
        if row.has_bias_and_temperature and self._suspicion.last_interval_is_far_outside:
            self._rows[-1] = replace(row, excluded=True)
        elif row.has_bias_and_temperature:
            self._fit = refit_coefficients(self._fit.model, self._means(only_used=True))
        if found is not None:
            self._start_work(self._test_for_step(found))
        elif (
            self._known_count >= self._next_choice
            and self._work is None
            and self._suspicion.recent_intervals_fit_prediction
        ):
            self._start_work(self._choose_model())
        return MeasuredAndPredictedMean(bias, standard_error, multi_step, one_step, name, slope, "")

    @property
    def temperature_share(self) -> float | None:
        """Variance share of the interval means that the model explains, 0 for a constant, None without a model."""
        if self._fit is None:
            return None
        return 0.0 if self._fit.model.shape.is_constant else self._fit.explained

    @property
    def is_selecting_model(self) -> bool:
        """Return True if a model selection is in progress."""
        return self._work is not None

    def run_selection_step_if_active(self) -> bool:
        """Run one step of a model selection, which takes about 1 ms. Return False if no selection is in progress."""
        if self._work is None:
            return False
        try:
            next(self._work)
        except StopIteration:
            self._work = None
        return True

    def take_unexplained_changes(self) -> list[UnexplainedChange]:
        """Return the unexplained bias changes that have been confirmed since the last call."""
        told, self._settled = self._settled, []
        return told

    def learn_new_offset(self) -> None:
        """Learn a new bias offset, for example after the sensor has been moved."""
        self._work = None
        self._suspicion.forget_residuals()
        if self._fit is None:
            self._rows.clear()  # Without a model, the offset cannot be separated from the effect of temperature.
        else:
            self._offset_differences, self._new_offset_at = [], self._interval_count

    def _start_work(self, work: StepwiseWork[None]) -> None:
        """Start a model selection, and discard a selection that is still in progress."""
        self._work = work
        self.run_selection_step_if_active()

    def _choose_model(self) -> StepwiseWork[None]:
        """Select a new model, or keep the current model if there are too few intervals."""
        self._next_choice = ceil(REFIT_GROWTH * self._known_count)
        self._missing_reason = "the model is being selected"
        try:
            self._fit = yield from fit_thermal_model_stepwise(self._means())
        except NotReady as error:
            self._missing_reason = str(error)

    def _test_for_step(self, doubt: UnexplainedChange) -> StepwiseWork[None]:
        """Decide whether a suspected change is explained by a different thermal model or by a bias step."""
        means, came, since = self._means(), self._interval_count, len(self._rows) - doubt.since
        self._next_choice = ceil(REFIT_GROWTH * self._known_count)
        size, stepped = doubt.size, None
        try:
            stepped = yield from fit_thermal_model_stepwise(means, since, always_try_lags=True)
            if stepped.step_p >= STEP_SIGNIFICANCE:
                self._fit = yield from fit_thermal_model_stepwise(means, always_try_lags=True)
                return
        except NotReady:
            # Nothing is lost: the suspected size is reported below, and the current model stays in use.
            pass
        else:
            size = stepped.step
        since = doubt.since + self._interval_count - came
        self._shift_history(size, since, stepped)
        self._settled.append(replace(doubt, size=size, since=since))

    def _add_offset_difference(self, apart: list[float], by: float) -> None:
        """Store a residual, and determine the new offset after OFFSET_INTERVALS residuals."""
        apart.append(by)
        if len(apart) == OFFSET_INTERVALS:
            self._start_work(self._settle_offset(float(np.mean(apart))))

    def _settle_offset(self, size: float) -> StepwiseWork[None]:
        """Determine the new offset by a fit to all intervals, or from the mean residual if no fit is possible."""
        stepped = None
        try:
            stepped = yield from fit_thermal_model_stepwise(
                self._means(), len(self._rows) - (self._interval_count - self._new_offset_at)
            )
        except NotReady:
            # Nothing is lost: the mean residual is the new offset, and a later selection fits all intervals again.
            pass
        else:
            size = stepped.step
        self._offset_differences = None
        self._shift_history(size, self._interval_count - self._new_offset_at, stepped)

    def _shift_history(self, by: float, last: int, fit: ThermalFit | None) -> None:
        """Add a bias step to all intervals except the last ``last`` intervals, and fit the coefficients again."""
        before = max(len(self._rows) - last, 0)
        moved = [replace(row, bias=row.bias + by, excluded=False) for row in islice(self._rows, before)]
        kept = [replace(row, excluded=False) for row in islice(self._rows, before, None)]
        self._rows = deque([*moved, *kept], maxlen=MAX_INTERVALS)
        if (known := fit or self._fit) is not None:
            self._fit = refit_coefficients(known.model, self._means())

    def _predict_last_interval(self, fit: ThermalFit) -> tuple[PredictionInterval, PredictionInterval]:
        """Return the multi-step and the one-step prediction for the last interval, from the intervals before it.

        Because the number of intervals may be small, the prediction intervals are based on Student's t distribution.
        """
        means = self._means(only_used=True)
        wide = student_quantile(fit.degrees_of_freedom, 0.975) / Z95
        both = []
        for measured in (None, means.bias):
            made = predict_interval_means(fit.model, means.temperature_c, measured, starts_with_fit=True)
            bias, half = float(made.bias[-1]), wide * float(made.hi[-1] - made.bias[-1])
            both.append(PredictionInterval(bias, bias - half, bias + half))
        return both[0], both[1]

    def _means(self, only_used: bool = False) -> IntervalMeans:
        rows = [(np.nan if only_used and r.excluded else r.bias, r.error, r.temperature_c) for r in self._rows]
        return IntervalMeans(self._interval_s, *np.array(rows).T)
