"""One axis whose model follows its intervals: predicted before it is believed, chosen anew as the record grows.

Each interval is predicted by the model that knows those before it, multi-step and one-step, and only then enters the
fit: ``Recursion`` renews the sizes. Form and time constants are chosen anew whenever GROWN times as many intervals are
known as at the last choice; that takes up to a second, so ``step`` does a piece of it at a time, on the intervals that
were there when it began.

Intervals that stay outside of what was expected of them are a doubt, and while they do no choice is begun: a form that
makes room for them would explain them away; nor do those far outside enter the fit. A doubt is settled by two choices,
without and with a step of the offset where it began, and lags are looked for in any case: late heat is what a first
turn of temperature looks like. If temperature explains the same without a step, the model is the new one and nothing is
told. If not, that is told, and the bias before counts from then on as if it had had the new offset all along: what is
known of temperature stays, and the new level is what is expected. In the same way a new offset is learned where the
sensor was laid down another way or started anew, and nothing is told.
"""

from collections import deque
from dataclasses import dataclass, replace
from itertools import islice
from math import ceil
from typing import Final

import numpy as np

from drivers.errors import NotReady
from monitor.drift.thermal.interval_means import Means
from monitor.drift.thermal.recursive_least_squares import Band, Recursion
from monitor.drift.thermal.residual_alarm import Suspicion, Unexplained
from monitor.drift.thermal.thermal_fit import Pieces, fitting
from monitor.drift.thermal.thermal_model import ThermalModel

KEPT: Final = 1000
"""Intervals: a week of ten minutes each."""
GROWN: Final = 1.25
"""Times as many intervals as at the last choice."""
LEARNED: Final = 3
"""Intervals that tell a new offset."""
SURE: Final = 10.0
"""Of AICc, that a step must gain before it is one: where it began was picked by its intervals."""
NEW_OFFSET: Final = "it was handled, or started anew: its new offset is being learned"


@dataclass(frozen=True, slots=True)
class AxisThermal:
    """One interval of one axis."""

    bias: float  # rad/s or m/s²; NaN where too little was there
    error: float  # its standard error
    multi_step: Band | None  # from temperature alone; None where there is no model yet
    one_step: Band | None  # and from the bias before
    model: str  # its form
    slope: float  # bias per °C, in the end; NaN without a model
    text: str  # why nothing was expected


@dataclass(frozen=True, slots=True)
class _Row:
    bias: float
    error: float
    temperature_c: float

    @property
    def known(self) -> bool:
        return bool(np.isfinite(self.bias) and np.isfinite(self.temperature_c))


class Following:
    """The model of one axis and the intervals that it is made from.

    Args:
        interval_s: their length
    """

    def __init__(self, interval_s: float) -> None:
        self._interval_s = interval_s
        self._rows: deque[_Row] = deque(maxlen=KEPT)
        self._recursion: Recursion | None = None
        self._suspicion = Suspicion()
        self._work: Pieces[None] | None = None
        self._came = 0  # intervals since the start
        self._known = 0  # those of them that were measured
        self._next = 0  # so many at the next choice
        self._learning: list[float] | None = None  # what intervals are off by, since the offset is another
        self._since = 0  # intervals that had come when it became so
        self._told: list[Unexplained] = []
        self._why = ""  # there is no model

    def update(self, bias: float, error: float, temperature_c: float) -> AxisThermal:
        """The next interval, and what was expected of it."""
        row = _Row(bias, error, temperature_c)
        self._came += 1
        self._known += row.known
        self._rows.append(row)
        if self._recursion is None:
            if self._work is None:
                self._begin(self._choose())
            return AxisThermal(bias, error, None, None, "", np.nan, self._why)
        multi_step, one_step = self._recursion.expect(temperature_c)
        model = self._recursion.model
        if self._learning is not None:
            self._recursion.update(temperature_c, np.nan)
            if row.known:
                self._learn(self._learning, bias - multi_step.bias)
            return AxisThermal(bias, error, None, None, model.shape.name, model.slope, NEW_OFFSET)
        found = self._suspicion.update(bias if row.known else np.nan, multi_step, one_step)
        self._recursion.update(temperature_c, np.nan if row.known and self._suspicion.far else bias)
        if found is not None:
            self._begin(self._settle(found))
        elif self._known >= self._next and self._work is None and self._suspicion.clear:
            self._begin(self._choose())
        return AxisThermal(bias, error, multi_step, one_step, model.shape.name, model.slope, "")

    @property
    def choosing(self) -> bool:
        """Whether ``step`` has something to do."""
        return self._work is not None

    def step(self) -> bool:
        """One piece of a choice, about a ms; False when there is nothing to choose."""
        if self._work is None:
            return False
        try:
            next(self._work)
        except StopIteration:
            self._work = None
        return True

    def take(self) -> list[Unexplained]:
        """What temperature does not explain, settled since the last call."""
        told, self._told = self._told, []
        return told

    def offset_is_new(self) -> None:
        """What comes has an offset that says nothing of temperature: learn it."""
        self._work = None
        self._suspicion.forget()
        if self._recursion is None:
            self._rows.clear()  # nothing to tell the new level by
        else:
            self._learning, self._since = [], self._came

    def _begin(self, work: Pieces[None]) -> None:
        """What was begun before knew less, and is left."""
        self._work = work
        self.step()

    def _choose(self) -> Pieces[None]:
        """The model anew; where nothing can be chosen, what is there stays."""
        self._next = ceil(GROWN * self._known)
        self._why = "the model is being chosen"
        try:
            chosen = yield from fitting(self._means())
        except NotReady as error:
            self._why = str(error)
        else:
            self._recursion = Recursion(chosen.model, self._means())

    def _settle(self, doubt: Unexplained) -> Pieces[None]:
        """Whether it is temperature, by another model, or a step of the offset."""
        means, came, since = self._means(), self._came, len(self._rows) - doubt.since
        self._next = ceil(GROWN * self._known)
        size, model = doubt.size, None
        try:
            without = yield from fitting(means, lags=True)
            stepped = yield from fitting(means, since, lags=True)
        except NotReady:
            pass  # of these alone nothing can be chosen: what was there before stays
        else:
            if without.aicc - stepped.aicc < SURE:
                self._recursion = Recursion(without.model, self._means())
                return
            size, model = stepped.step, stepped.model
        since = doubt.since + self._came - came
        self._shift(size, since, model)
        self._told.append(replace(doubt, size=size, since=since))

    def _learn(self, apart: list[float], by: float) -> None:
        apart.append(by)
        if len(apart) == LEARNED:
            self._begin(self._settle_offset(float(np.mean(apart))))

    def _settle_offset(self, size: float) -> Pieces[None]:
        """The new offset: as a model of all intervals has it, or as the one before does."""
        model = None
        try:
            stepped = yield from fitting(self._means(), len(self._rows) - (self._came - self._since))
        except NotReady:
            pass  # the size that the mean told stays
        else:
            size, model = stepped.step, stepped.model
        self._learning = None
        self._shift(size, self._came - self._since, model)

    def _shift(self, by: float, last: int, model: ThermalModel | None) -> None:
        """Rows before the last so many as if they had had the offset of these; the model anew, or another one."""
        before = max(len(self._rows) - last, 0)
        moved = [_Row(row.bias + by, row.error, row.temperature_c) for row in islice(self._rows, before)]
        self._rows = deque([*moved, *islice(self._rows, before, None)], maxlen=KEPT)
        if self._recursion is not None:
            self._recursion = Recursion(model or self._recursion.model, self._means())

    def _means(self) -> Means:
        bias, error, temperature_c = np.array([(r.bias, r.error, r.temperature_c) for r in self._rows]).T
        return Means(self._interval_s, bias, error, temperature_c)
