"""History of the Allan deviations of a device, in a table of limited size for the live viewer.

Each column contains the mean logarithm of the Allan deviations of all estimates in a time interval. When the table has
COLUMNS columns, neighbouring columns are averaged in pairs, and later columns cover twice the time. The table therefore
covers the whole history with constant memory.
"""

import numpy as np

from drivers.data_types import AXES, Floats, Ints
from monitor.estimation.estimate import Estimate

COLUMNS = 300
"""Largest number of columns. The number must be even, because columns are averaged in pairs."""
INITIAL_COLUMN_S = 2.0
"""Initial time span of a column [s]."""


class AllanHistory:
    """Allan deviations of one device over time.

    A new history starts if an estimate is earlier than the previous estimate, or has different averaging times.
    """

    def __init__(self, column_s: float = INITIAL_COLUMN_S) -> None:
        """Create an empty history whose columns initially cover ``column_s`` seconds."""
        self._first_s = column_s
        self._reset(np.empty(0), 0.0)

    def _reset(self, tau_s: Floats, wall_s: float) -> None:
        self.column_s = self._first_s
        self.tau_s = tau_s  # [m]
        self.ends_s: list[float] = []  # Unix time [s] of the newest estimate in each column
        self._columns: list[Floats] = []  # [m, 6] natural logarithm of the Allan deviation
        self._begin_column(wall_s)

    def _begin_column(self, wall_s: float) -> None:
        self._since_s = self._newest_s = wall_s
        self._sums: Floats = np.zeros((self.tau_s.size, len(AXES)))
        self._counts: Ints = np.zeros((self.tau_s.size, len(AXES)), np.int64)

    def add_estimate_and_check_column_complete(self, wall_s: float, estimate: Estimate) -> bool:
        """Add an estimate. Return True if the estimate completes a column.

        Parameters
        ----------
        wall_s
            Unix time of the estimate [s].
        estimate
            Estimate with the Allan deviations to add.
        """
        if wall_s < self._newest_s or not np.array_equal(self.tau_s, estimate.curve.tau_s):
            self._reset(estimate.curve.tau_s, wall_s)
        # Recent Allan deviations use only the newest samples, so that a change of the noise appears without delay.
        avar = (estimate.display_curve or estimate.curve).avar
        there = np.isfinite(avar) & (avar > 0.0)
        self._sums[there] += 0.5 * np.log(avar[there])
        self._counts += there
        self._newest_s = wall_s
        if wall_s - self._since_s < self.column_s:
            return False
        self.ends_s.append(wall_s)
        self._columns.append(np.where(self._counts > 0, self._sums / np.maximum(self._counts, 1), np.nan))
        self._begin_column(wall_s)
        if len(self._columns) >= COLUMNS:
            self._merge_pairs()
        return True

    def _merge_pairs(self) -> None:
        pairs = np.stack(self._columns).reshape(COLUMNS // 2, 2, self.tau_s.size, len(AXES))
        there = np.isfinite(pairs)
        means = np.where(there, pairs, 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1)
        self._columns = list(np.where(there.any(axis=1), means, np.nan))
        self.ends_s = self.ends_s[1::2]
        self.column_s *= 2.0

    def log_ratio_to_median(self) -> Floats:
        """Return the logarithm of each Allan deviation divided by its median over time, shape [columns, m, 6].

        The values are NaN where Allan deviations are missing.
        """
        whole = np.stack(self._columns) if self._columns else np.empty((0, self.tau_s.size, len(AXES)))
        there = np.isfinite(whole).any(axis=0)
        median = np.full(there.shape, np.nan)
        median[there] = np.nanmedian(whole[:, there], axis=0)
        return np.asarray(whole - median)
