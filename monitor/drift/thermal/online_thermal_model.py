"""Online model of bias against temperature for one axis: each interval is predicted before it is used for the fit.

The model of the earlier intervals predicts each interval, multi-step and one-step. Only then is the interval used, and
``RecursiveThermalFit`` updates the coefficients. Form and time constants are chosen again when the number of known
intervals has grown by the factor REFIT_GROWTH. A choice takes up to a second. ``step`` therefore does
one piece of the choice at a time, on the intervals that were known at the start.

Intervals that stay outside their prediction are a suspected change (``residual_alarm``). Until it is resolved, no
routine choice is started, because a new form could fit the change and hide it. Intervals far outside their prediction
are not used for the fit either. Two fits resolve the suspicion, without and with a step of the offset at its beginning.
Both include lags, because delayed heat looks like a change at the first reversal of temperature. If temperature
explains the intervals without a step, the new model is used and nothing is reported. Otherwise the change is reported.
The earlier intervals are then shifted to the new offset, so that the known dependence on temperature is kept and the
new level is expected. After the sensor has been moved or restarted, the new offset is learned in the same way, but not
reported.
"""

from collections import deque
from dataclasses import dataclass, replace
from itertools import islice
from math import ceil
from typing import Final

import numpy as np

from drivers.errors import NotReady
from monitor.drift.thermal.interval_means import IntervalMeans
from monitor.drift.thermal.recursive_least_squares import PredictionInterval, RecursiveThermalFit
from monitor.drift.thermal.residual_alarm import ResidualAlarm, UnexplainedChange
from monitor.drift.thermal.thermal_fit import StepwiseWork, fit_in_steps
from monitor.drift.thermal.thermal_model import ThermalModel

MAX_INTERVALS: Final = 1000
"""Largest number of intervals that are kept: a week of ten minutes each."""
REFIT_GROWTH: Final = 1.25
"""Growth of the number of known intervals after which the model is chosen again."""
OFFSET_INTERVALS: Final = 3
"""Intervals that determine a new offset."""
STEP_AICC_MARGIN: Final = 10.0
"""Gain in AICc above which a step is accepted. The margin is needed because the intervals themselves determined the
position of the step."""
NEW_OFFSET: Final = "it was handled, or started anew: its new offset is being learned"
"""Text for intervals without a prediction after a change of the offset."""


@dataclass(frozen=True, slots=True)
class PredictedAxisInterval:
    """One interval of one axis, with its prediction."""

    bias: float  # rad/s or m/s²; NaN if too few samples are known
    error: float  # standard error of ``bias``
    multi_step: PredictionInterval | None  # prediction from temperature only; None if there is no model yet
    one_step: PredictionInterval | None  # prediction from temperature and from the bias before
    model: str  # name of the form of the model
    slope: float  # bias per °C after all lags have settled; NaN without a model
    text: str  # reason why there is no prediction


@dataclass(frozen=True, slots=True)
class _Row:
    """Bias, standard error and temperature of one interval."""

    bias: float
    error: float
    temperature_c: float

    @property
    def has_bias_and_temperature(self) -> bool:
        """True if bias and temperature are both known."""
        return bool(np.isfinite(self.bias) and np.isfinite(self.temperature_c))


class OnlineThermalModel:
    """Online model of one axis and the intervals from which it is fitted.

    Parameters
    ----------
    interval_s : float
        Length of an interval in seconds.
    """

    def __init__(self, interval_s: float) -> None:
        self._interval_s = interval_s
        self._rows: deque[_Row] = deque(maxlen=MAX_INTERVALS)
        self._recursion: RecursiveThermalFit | None = None
        self._suspicion = ResidualAlarm()
        self._work: StepwiseWork[None] | None = None
        self._interval_count = 0  # intervals since the start
        self._known_count = 0  # intervals with a known bias and temperature
        self._next_choice = 0  # number of known intervals at the next choice
        self._offset_differences: list[float] | None = None  # residuals since the offset changed; None if it did not
        self._new_offset_at = 0  # number of intervals at the change of the offset
        self._settled: list[UnexplainedChange] = []
        self._missing_reason = ""  # reason why there is no model

    def update(self, bias: float, error: float, temperature_c: float) -> PredictedAxisInterval:
        """Add an interval, and return it with its prediction.

        Parameters
        ----------
        bias : float
            Mean of the interval in rad/s or m/s²; NaN = not measured.
        error : float
            Standard error of ``bias``.
        temperature_c : float
            Mean temperature of the interval in °C; NaN = not measured.
        """
        row = _Row(bias, error, temperature_c)
        self._interval_count += 1
        self._known_count += row.has_bias_and_temperature
        self._rows.append(row)
        if self._recursion is None:
            if self._work is None:
                self._start_work(self._choose_model())
            return PredictedAxisInterval(bias, error, None, None, "", np.nan, self._missing_reason)
        multi_step, one_step = self._recursion.predict_multi_and_one_step(temperature_c)
        model = self._recursion.model
        if self._offset_differences is not None:
            self._recursion.update(temperature_c, np.nan)
            if row.has_bias_and_temperature:
                self._add_offset_difference(self._offset_differences, bias - multi_step.bias)
            return PredictedAxisInterval(bias, error, None, None, model.shape.name, model.mean_slope, NEW_OFFSET)
        found = self._suspicion.update(bias if row.has_bias_and_temperature else np.nan, multi_step, one_step)
        self._recursion.update(
            temperature_c, np.nan if row.has_bias_and_temperature and self._suspicion.is_unfit_for_update else bias
        )
        if found is not None:
            self._start_work(self._test_for_step(found))
        elif self._known_count >= self._next_choice and self._work is None and self._suspicion.is_within_prediction:
            self._start_work(self._choose_model())
        return PredictedAxisInterval(bias, error, multi_step, one_step, model.shape.name, model.mean_slope, "")

    @property
    def choosing(self) -> bool:
        """True if ``step`` has work to do."""
        return self._work is not None

    def step(self) -> bool:
        """Do one piece of a choice, about 1 ms, and return False if there is nothing to do."""
        if self._work is None:
            return False
        try:
            next(self._work)
        except StopIteration:
            self._work = None
        return True

    def take_unexplained_changes(self) -> list[UnexplainedChange]:
        """Return the changes that temperature does not explain, confirmed since the last call."""
        told, self._settled = self._settled, []
        return told

    def learn_new_offset(self) -> None:
        """Learn a new offset of the bias, because the old one no longer applies."""
        self._work = None
        self._suspicion.forget_residuals()
        if self._recursion is None:
            self._rows.clear()  # Without a model, the new offset cannot be determined.
        else:
            self._offset_differences, self._new_offset_at = [], self._interval_count

    def _start_work(self, work: StepwiseWork[None]) -> None:
        """Start new work. Unfinished earlier work is discarded, because it used fewer intervals."""
        self._work = work
        self.step()

    def _choose_model(self) -> StepwiseWork[None]:
        """Choose the model again, and keep the present one if the intervals do not suffice."""
        self._next_choice = ceil(REFIT_GROWTH * self._known_count)
        self._missing_reason = "the model is being chosen"
        try:
            chosen = yield from fit_in_steps(self._means())
        except NotReady as error:
            self._missing_reason = str(error)
        else:
            self._recursion = RecursiveThermalFit(chosen.model, self._means())

    def _test_for_step(self, doubt: UnexplainedChange) -> StepwiseWork[None]:
        """Decide whether another model of temperature or a step of the offset explains a suspected change."""
        means, came, since = self._means(), self._interval_count, len(self._rows) - doubt.since
        self._next_choice = ceil(REFIT_GROWTH * self._known_count)
        size, model = doubt.size, None
        try:
            without = yield from fit_in_steps(means, lags=True)
            stepped = yield from fit_in_steps(means, since, lags=True)
        except NotReady:
            pass  # The intervals do not suffice for a choice. The present model is kept.
        else:
            if without.aicc - stepped.aicc < STEP_AICC_MARGIN:
                self._recursion = RecursiveThermalFit(without.model, self._means())
                return
            size, model = stepped.step, stepped.model
        since = doubt.since + self._interval_count - came
        self._shift_history(size, since, model)
        self._settled.append(replace(doubt, size=size, since=since))

    def _add_offset_difference(self, apart: list[float], by: float) -> None:
        """Add a residual, and determine the new offset when there are enough."""
        apart.append(by)
        if len(apart) == OFFSET_INTERVALS:
            self._start_work(self._settle_offset(float(np.mean(apart))))

    def _settle_offset(self, size: float) -> StepwiseWork[None]:
        """Determine the new offset, by a fit to all intervals if possible, else by the mean residual."""
        model = None
        try:
            stepped = yield from fit_in_steps(
                self._means(), len(self._rows) - (self._interval_count - self._new_offset_at)
            )
        except NotReady:
            pass  # The mean residual is used.
        else:
            size, model = stepped.step, stepped.model
        self._offset_differences = None
        self._shift_history(size, self._interval_count - self._new_offset_at, model)

    def _shift_history(self, by: float, last: int, model: ThermalModel | None) -> None:
        """Shift the bias of all but the last intervals by the step of the offset, and fit the model again."""
        before = max(len(self._rows) - last, 0)
        moved = [_Row(row.bias + by, row.error, row.temperature_c) for row in islice(self._rows, before)]
        self._rows = deque([*moved, *islice(self._rows, before, None)], maxlen=MAX_INTERVALS)
        if self._recursion is not None:
            self._recursion = RecursiveThermalFit(model or self._recursion.model, self._means())

    def _means(self) -> IntervalMeans:
        """Return the kept intervals as arrays."""
        bias, error, temperature_c = np.array([(r.bias, r.error, r.temperature_c) for r in self._rows]).T
        return IntervalMeans(self._interval_s, bias, error, temperature_c)
