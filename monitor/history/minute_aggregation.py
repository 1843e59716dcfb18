"""Aggregation of the results of a device into history rows of one minute.

Results are assigned to minutes by the time of the samples. A row is returned when the first result of the next minute
arrives. A result that is up to LATE_TOLERANCE_S late is added to the current row. An even earlier result begins a new
row, for example after the clock has been set back. ``HistoryFileWriter`` merges that row with the stored row. If the
process is killed, at most one minute of results is lost.
"""

from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.device_health import Health
from monitor.estimation.estimate import Estimate
from monitor.history.estimate_to_columns import HEALTH_COLUMNS, TEMPERATURE_COLUMNS, EstimateToColumnsConverter
from monitor.history.history_row import STATES, HistoryRow, RunningMinMaxLast

MINUTE_S: Final = 60
LATE_TOLERANCE_S: Final = 5.0
"""Tolerance in seconds for results that arrive out of order.

Temperatures and estimates are reported separately, so their order may differ from the order of the samples.
"""


class MinuteAggregator:
    """Aggregator of the results of a device in the current minute."""

    def __init__(self) -> None:
        self._numbers: EstimateToColumnsConverter | None = None
        self._start_s: int | None = None
        self._newest_s = 0.0
        self._estimates: RunningMinMaxLast | None = None
        self._health = RunningMinMaxLast(HEALTH_COLUMNS)
        self._temperature = RunningMinMaxLast(TEMPERATURE_COLUMNS)
        self._previous_counters = (0, 0, 0, 0)  # counters in the last health report
        self._counts = (0, 0, 0, 0)  # increments of the counters in this minute
        self._state = 0

    def add_estimate(self, unix_s: float, estimate: Estimate) -> HistoryRow | None:
        """Add an estimate. If it begins a new row, return the previous row, otherwise None.

        Parameters
        ----------
        unix_s
            Unix time of the estimate [s].
        estimate
            Estimate to add.
        """
        full = self._advance(unix_s)
        if self._numbers is None or not self._numbers.matches_axes_and_taus(estimate):
            self._numbers = EstimateToColumnsConverter(estimate)
        if self._estimates is not None and self._estimates.names != self._numbers.names:
            start_s = self._start_s
            full = self._close_row()  # ``HistoryFileWriter`` merges both rows of this minute
            self._start_s, self._newest_s = start_s, unix_s
        if self._estimates is None:
            self._estimates = RunningMinMaxLast(self._numbers.names)
        self._estimates.add_value_per_column(self._numbers.convert_estimate(estimate))
        return full

    def add_temperature(self, unix_s: float, temperature_c: Floats) -> HistoryRow | None:
        """Add the mean temperature of a batch of samples.

        If the batch begins a new row, return the previous row, otherwise None.

        Parameters
        ----------
        unix_s
            Unix time of the batch [s].
        temperature_c
            Temperatures [n] of the samples in °C; NaN means not measured.
        """
        there = temperature_c[~np.isnan(temperature_c)]
        if not there.size:
            return None
        full = self._advance(unix_s)
        self._temperature.add_value_per_column(np.array([there.mean()]))
        return full

    def add_health(self, unix_s: float, health: Health) -> HistoryRow | None:
        """Add a health report. If it begins a new row, return the previous row, otherwise None.

        Parameters
        ----------
        unix_s
            Unix time of the report [s].
        health
            Health report of the device, whose counters are added as increments since the last report.
        """
        full = self._advance(unix_s)
        known = [np.nan if one is None else float(one) for one in (health.rate_hz, health.latency_p99_s)]
        self._health.add_value_per_column(np.array([*known, float(health.memory_bytes)]))
        counted = (health.received, health.lost, health.bad, health.overflowed)
        # A counter that is below its previous value has been restarted from zero.
        more = tuple(
            now - old if now >= old else now for now, old in zip(counted, self._previous_counters, strict=True)
        )
        self._counts = tuple(a + b for a, b in zip(self._counts, more, strict=True))  # type: ignore[assignment]
        self._previous_counters = counted
        worst = STATES.index(health.state) if health.state in STATES else 0
        self._state = max(self._state, worst)
        return full

    def flush(self) -> HistoryRow | None:
        """Close and return the current incomplete row, or return None if there are no results."""
        return self._close_row() if self._start_s is not None else None

    def _advance(self, unix_s: float) -> HistoryRow | None:
        """Advance to the minute of ``unix_s``. If a new row begins, return the previous row, otherwise None."""
        start_s = int(unix_s // MINUTE_S) * MINUTE_S
        if self._start_s is not None and self._start_s - LATE_TOLERANCE_S <= unix_s < self._start_s + MINUTE_S:
            self._newest_s = max(self._newest_s, min(unix_s, self._start_s + MINUTE_S))
            return None
        full = self.flush()
        self._start_s, self._newest_s = start_s, unix_s
        return full

    def _close_row(self) -> HistoryRow:
        sources = (self._estimates, self._health, self._temperature)
        parts = [one for one in sources if one is not None and one.count.any()] or [self._health]
        assert self._start_s is not None
        row = HistoryRow(
            self._start_s,
            MINUTE_S,
            self._newest_s,
            tuple(name for part in parts for name in part.names),
            np.concatenate([part.count for part in parts]),
            np.concatenate([part.minimum for part in parts]),
            np.concatenate([part.maximum for part in parts]),
            np.concatenate([part.last for part in parts]),
            self._counts,
            self._state,
        )
        self._estimates, self._health = None, RunningMinMaxLast(HEALTH_COLUMNS)
        self._temperature = RunningMinMaxLast(TEMPERATURE_COLUMNS)
        self._counts, self._state, self._start_s = (0, 0, 0, 0), 0, None
        return row
