"""Aggregation of the results of a device into history rows of one minute.

Results are assigned to minutes by the time of the samples. A row is returned when the first result of the next minute
arrives. A result that is up to LATE_TOLERANCE_S late is added to the current row. An even earlier result begins a new
row, for example after the clock has been set back. ``HistoryFileWriter`` merges that row with the stored row. If the
process is killed, at most one minute of results is lost.

Each noise coefficient of a measured axis has four columns. For example, the column ``gz.N`` contains the estimated
value of N on axis gz. The columns ``gz.N.lo`` and ``gz.N.hi`` contain the ends of the confidence interval. If only an
upper bound of N is known, it is stored in ``gz.N.bound``.

Allan deviations are stored in columns such as ``gz.sigma.0.3``, for averaging times of 10ⁿ and 3·10ⁿ seconds. They are
interpolated between the neighbouring averaging times of the estimate, linearly on logarithmic scales. For a noise model
with five terms and averaging times in octaves, the interpolation error is below 1 %.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats
from monitor.common.device_health import Health
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.history.history_row import STATES, HistoryRow, RunningMinMaxLast

TAU_S: Final = tuple(float(f"{one}e{power}") for power in range(-4, 6) for one in (1, 3))
"""Averaging times at which Allan deviations are stored [s], from 0.1 ms to 300 000 s.

A sliding window covers only a part of this range.
"""
HEALTH_COLUMNS: Final = ("rate", "latency", "memory")
"""Columns for the sample rate [Hz], the latency [s] and the memory of the process [bytes].

The latency is the 99th percentile of the time from receipt to publication.
"""
TEMPERATURE_COLUMNS: Final = ("temperature",)
"""Column for the mean temperature of a batch of samples [°C]."""
VALUE_SUFFIXES: Final = ("", ".lo", ".hi", ".bound")
TAU_MATCH_RATIO: Final = 1.02
"""Factor by which the averaging time of an estimate may differ from a stored averaging time without interpolation."""
MAX_TAU_RATIO: Final = 2.5
"""Maximum ratio of neighbouring averaging times between which Allan deviations are interpolated."""


class EstimateToColumnsConverter:
    """Converter from estimates with the same axes and averaging times to column values.

    Parameters
    ----------
    estimate
        First estimate, which determines the axes and the averaging times.
    """

    def __init__(self, estimate: Estimate) -> None:
        self._measured = _measured(estimate)
        self._axes = np.flatnonzero(self._measured)
        self._tau_s = estimate.curve.tau_s
        at, below, above, share = _interpolation_points(self._tau_s)
        self._below, self._above = np.array(below, np.intp), np.array(above, np.intp)
        self._share = share[:, None]
        columns, rows = len(AXES), len(SYMBOLS)
        self._coefficient_indices = np.array(
            [row * columns + axis for row in range(rows) for axis in self._axes], np.intp
        )
        axes = [AXES[i] for i in self._axes]
        self.names = (
            *(f"{axis}.{symbol}{part}" for part in VALUE_SUFFIXES for symbol in SYMBOLS for axis in axes),
            *(f"{axis}.sigma.{TAU_S[i]:g}" for i in at for axis in axes),
        )
        self._coefficient_count = len(self._coefficient_indices)

    def matches_axes_and_taus(self, estimate: Estimate) -> bool:
        """Return True if an estimate has the same measured axes and averaging times as the first estimate."""
        tau_s = estimate.curve.tau_s
        same = tau_s is self._tau_s or np.array_equal(tau_s, self._tau_s)
        return same and bool((_measured(estimate) == self._measured).all())

    def convert_estimate(self, estimate: Estimate) -> Floats:
        """Return the column values of an estimate ([k], SI units) in the order of ``names``; NaN means missing."""
        c, m = estimate.coefficients, self._coefficient_count
        status, hi = c.status.take(self._coefficient_indices), c.hi.take(self._coefficient_indices)
        estimated = status == Status.ESTIMATED.value
        numbers = np.full(len(self.names), np.nan)
        np.copyto(numbers[:m], c.value.take(self._coefficient_indices), where=estimated)
        np.copyto(numbers[m : 2 * m], c.lo.take(self._coefficient_indices), where=estimated)
        np.copyto(numbers[2 * m : 3 * m], hi, where=estimated)
        np.copyto(numbers[3 * m : 4 * m], hi, where=status == Status.UPPER_BOUND.value)
        numbers[4 * m :] = self._deviations(estimate).ravel()
        return numbers

    def _deviations(self, estimate: Estimate) -> Floats:
        with np.errstate(divide="ignore"):  # the Allan deviation of an axis without noise is 0
            log = np.log(estimate.curve.avar[:, self._axes])
        below, above = log[self._below], log[self._above]
        with np.errstate(invalid="ignore"):  # interpolation next to an Allan deviation of 0 gives NaN
            return np.asarray(np.exp(0.5 * (below + self._share * np.where(self._share > 0.0, above - below, 0.0))))


def _measured(estimate: Estimate) -> NDArray[np.bool_]:
    """Return a mask that is True for axes with an Allan deviation at the shortest averaging time."""
    shortest = estimate.curve.avar[0]
    return np.asarray(~np.isnan(shortest))


def _interpolation_points(tau_s: Floats) -> "tuple[list[int], list[int], list[int], Floats]":
    """Return the indices of available times in TAU_S, the indices of neighbouring times, and the weights."""
    at, below, above, share = [], [], [], []
    for i, wanted in enumerate(TAU_S):
        near = int(np.argmin(np.abs(np.log(tau_s / wanted)))) if tau_s.size else 0
        if tau_s.size and 1.0 / TAU_MATCH_RATIO < tau_s[near] / wanted < TAU_MATCH_RATIO:
            low, high, part = near, near, 0.0
        else:
            high = int(np.searchsorted(tau_s, wanted))
            low = high - 1
            if low < 0 or high >= tau_s.size or tau_s[high] > MAX_TAU_RATIO * tau_s[low]:
                continue
            part = float(np.log(wanted / tau_s[low]) / np.log(tau_s[high] / tau_s[low]))
        at.append(i)
        below.append(low)
        above.append(high)
        share.append(part)
    return at, below, above, np.array(share)


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
