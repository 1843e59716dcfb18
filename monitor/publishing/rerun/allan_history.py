"""The history of a device's Allan deviations, thinned as it grows: what a live view of them over time shows.

In come estimates; out goes a bounded table of columns, oldest first. A column is the mean (of logarithms) of the
estimates of a stretch of time. When COLUMNS are there, neighbours are averaged and every column stands for twice the
time from then on: the whole history stays in view at a cost that does not grow. Pure NumPy.
"""

import numpy as np

from drivers.sample import AXES, Floats, Ints
from monitor.estimation.estimate import Estimate

COLUMNS = 300
"""Even, so that they pair off."""
COLUMN_S = 2.0
"""Of sample time in a column, at first."""


class Surface:
    """The history of one device. Estimates with other τ, or from an earlier time, begin a new one."""

    def __init__(self, column_s: float = COLUMN_S) -> None:
        """``column_s``: seconds a column stands for at first."""
        self._first_s = column_s
        self._begin(np.empty(0), 0.0)

    def _begin(self, tau_s: Floats, wall_s: float) -> None:
        self.column_s = self._first_s
        self.tau_s = tau_s  # [m]
        self.ends_s: list[float] = []  # newest estimate of each column
        self._columns: list[Floats] = []  # [m, 6] ln of the deviation
        self._open(wall_s)

    def _open(self, wall_s: float) -> None:
        """A new column, from here on."""
        self._since_s = self._newest_s = wall_s
        self._sums: Floats = np.zeros((self.tau_s.size, len(AXES)))
        self._counts: Ints = np.zeros((self.tau_s.size, len(AXES)), np.int64)

    def add(self, wall_s: float, estimate: Estimate) -> bool:
        """Take one estimate; True when it completes a column."""
        if wall_s < self._newest_s or not np.array_equal(self.tau_s, estimate.curve.tau_s):
            self._begin(estimate.curve.tau_s, wall_s)
        # each τ over a span of its own, where there is such a curve: a change shows at once, and where it happened
        avar = (estimate.recent or estimate.curve).avar
        there = np.isfinite(avar) & (avar > 0.0)
        self._sums[there] += 0.5 * np.log(avar[there])
        self._counts += there
        self._newest_s = wall_s
        if wall_s - self._since_s < self.column_s:
            return False
        self.ends_s.append(wall_s)
        self._columns.append(np.where(self._counts > 0, self._sums / np.maximum(self._counts, 1), np.nan))
        self._open(wall_s)
        if len(self._columns) >= COLUMNS:
            self._halve()
        return True

    def _halve(self) -> None:
        pairs = np.stack(self._columns).reshape(COLUMNS // 2, 2, self.tau_s.size, len(AXES))
        there = np.isfinite(pairs)
        means = np.where(there, pairs, 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1)
        self._columns = list(np.where(there.any(axis=1), means, np.nan))
        self.ends_s = self.ends_s[1::2]
        self.column_s *= 2.0

    def relative(self) -> Floats:
        """ln of the deviation over its median over time [columns, m, 6]; NaN where there is none."""
        whole = np.stack(self._columns) if self._columns else np.empty((0, self.tau_s.size, len(AXES)))
        there = np.isfinite(whole).any(axis=0)
        median = np.full(there.shape, np.nan)
        median[there] = np.nanmedian(whole[:, there], axis=0)
        return np.asarray(whole - median)
