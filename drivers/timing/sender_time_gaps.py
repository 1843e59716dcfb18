"""Detect missing, late and reordered rows from sender times.

If sender times are irregular, a long step does not necessarily mean that samples are missing. Samples therefore count
as missing only if most of the time steps are regular.

Samples are sorted by time only if sorting makes the times evenly spaced. Late samples that were already counted as
missing are dropped.
"""

from collections import deque
from typing import Final

import numpy as np

from drivers.data_types import NS_PER_S, Floats, Ints, SampleBlock
from drivers.timing.arrival_regression import MIN_SPAN_S
from drivers.timing.arrival_timeline import JUMP_S, MAX_GAP_SAMPLES, ArrivalTimeline, retime_and_split_at_gaps
from drivers.timing.duplicate_rows import SEARCH_ROWS, RowFilter
from drivers.timing.event_rate_limiter import EventRateLimiter
from drivers.timing.rate_change import count_false_losses

FORWARD_JUMP_S: Final = 3600.0
"""Forward step of the sender time in s above which a clock jump is reported."""
STEP_HISTORY: Final = 255
"""Number of recent time steps from which the typical deviation is determined."""
RATE_CHANGE_STEPS: Final = 16
"""Number of recent time steps in which a change of the sample rate is detected."""
MIN_NEW_STEPS: Final = 12
"""Minimum number of the recent time steps that agree on the new sample period."""
STEP_TOLERANCE: Final = 0.25
"""Maximum deviation of a time step from a whole number of sample periods, in periods."""
CERTAIN_GAP_PERIODS: Final = 4.0
"""Time step in sample periods above which samples are missing, even if the step is not a whole number of periods."""
MAX_LATENESS_RATIO: Final = 8.0
"""Maximum deviation of a time step that is not a gap, as a multiple of the upper quartile of the deviations."""
MAX_PERIOD_NS: Final = float(1 << 54)
"""Longest sample period in ns (about 200 days) for which the times of missing samples fit into int64."""


class SenderTimeGapDetector:
    """Detector of missing, late and reordered samples from sender times.

    Parameters
    ----------
    timeline : ArrivalTimeline
        Regression line of sender time on sample index.
    rows : RowFilter
        Filter that removes rows.
    events : EventRateLimiter
        Queue for events about clock jumps and reordered samples.
    """

    def __init__(self, timeline: ArrivalTimeline, rows: RowFilter, events: EventRateLimiter) -> None:
        self.dropped_late_rows = 0
        """Number of samples that were dropped because they arrived after having been counted as missing."""
        self._timeline = timeline
        self._rows = rows
        self._events = events
        self._missing_t_ns: deque[int] = deque(maxlen=SEARCH_ROWS)  # times of samples that were counted as missing
        self._went_back = False
        self._steps_s: deque[float] = deque(maxlen=STEP_HISTORY)

    def sort_rows(self, samples: SampleBlock) -> SampleBlock | None:
        """Sort the samples of a block by time, and remove late samples. Return None if no sample remains."""
        t, last_ns = samples.t_ns, self._timeline.last_t_ns
        in_order = t[0] >= last_ns and (len(t) == 1 or (np.diff(t) >= 0).all())
        if not self._timeline.line.count or in_order:
            return samples
        period_s = self._period_s(np.diff(t))
        if not period_s:
            return samples
        kept = self._remove_late_rows(samples, period_s) if self._missing_t_ns else samples
        if kept is None:
            return None
        steps = np.diff(kept.t_ns)
        order = None if (steps < -JUMP_S * NS_PER_S).any() else find_evenly_spaced_order(kept.t_ns, period_s)
        if order is None:
            return kept
        n = int((steps < 0).sum())
        self._events.report_event("clock_jumped", int(kept.t_ns[-1]), "rows out of order: {n}; sorted by time", n)
        return self._rows.select_rows(kept, order)

    def split_at_missing_samples(self, samples: SampleBlock) -> list[SampleBlock]:
        """Split a sample block where samples are missing, without changing the sample times."""
        t, timeline = samples.t_ns, self._timeline
        steps = np.empty(len(samples), np.int64)
        steps[0] = t[0] - timeline.last_t_ns if timeline.line.count else 0
        np.subtract(t[1:], t[:-1], out=steps[1:])
        jumps = np.zeros(0, np.int64)
        if int(steps.min()) < 0 or int(steps.max()) > FORWARD_JUMP_S * NS_PER_S:
            self._report_jumps(t, steps)
            jumps = np.flatnonzero((steps < -JUMP_S * NS_PER_S) | (steps > FORWARD_JUMP_S * NS_PER_S))
        period_s = self._period_s(steps)
        if period_s and not jumps.size and steps[-1] / NS_PER_S / period_s > 1.0 + STEP_TOLERANCE:
            period_s = self._adopt_longer_period(steps, period_s)
        missing = self._count_missing(steps / NS_PER_S, period_s) if period_s else np.zeros(len(samples), np.int64)
        missing[0] = max(int(missing[0]), samples.lost)
        index = timeline.index + np.cumsum(missing + 1)
        first = 0
        if jumps.size:  # start a new regression line after the last jump
            first = int(jumps[-1])
            timeline.restart_line()
        for row in (first, len(samples) - 1):
            timeline.line.add_point(float(index[row]), timeline.seconds_since_origin(int(t[row])))
        timeline.find_rate_change(float(index[-1]), timeline.seconds_since_origin(int(t[-1])))
        timeline.index, timeline.last_t_ns = float(index[-1]), int(t[-1])
        if period_s:
            self._keep_missing_times(t, missing, period_s)
        return retime_and_split_at_gaps(samples, t, missing)

    def _adopt_longer_period(self, steps: Ints, period_s: float) -> float:
        """Return the sample period in s, which changes if most of the recent time steps agree on a longer period.

        Otherwise, the regression would see no change, because the steps would count as missing samples.
        """
        timeline = self._timeline
        recent = np.concatenate([np.array(self._steps_s), steps / NS_PER_S])[-RATE_CHANGE_STEPS:]
        new_s = float(np.median(recent))
        near = np.count_nonzero(np.abs(recent / new_s - 1.0) < STEP_TOLERANCE) if new_s > 0.0 else 0
        regular = recent.size == RATE_CHANGE_STEPS and near >= MIN_NEW_STEPS
        if not regular or new_s / period_s < 1.0 + STEP_TOLERANCE or not timeline.line.has_enough_points_for_gaps:
            return period_s
        counted = recent[: max(recent.size - len(steps), 0)]
        self._timeline.false_losses += count_false_losses(counted / period_s, counted / new_s)
        timeline.change_rate(1.0 / new_s)
        return new_s

    def _remove_late_rows(self, samples: SampleBlock, period_s: float) -> SampleBlock | None:
        """Remove samples that were already counted as missing. Return None if no sample remains."""
        distance_ns = np.abs(samples.t_ns[:, None] - np.array(self._missing_t_ns))
        late = samples.t_ns < self._timeline.last_t_ns
        late &= distance_ns.min(axis=1) < STEP_TOLERANCE * period_s * NS_PER_S
        if not late.any():
            return samples
        filled = set(distance_ns[late].argmin(axis=1).tolist())
        self._missing_t_ns = deque((t for i, t in enumerate(self._missing_t_ns) if i not in filled), maxlen=SEARCH_ROWS)
        n = int(late.sum())
        self.dropped_late_rows += n
        text = "{n} samples arrived after they had been counted as missing, and are left out"
        self._events.report_event("clock_jumped", int(samples.t_ns[-1]), text, n)
        return self._rows.select_rows(samples, np.flatnonzero(~late))

    def _keep_missing_times(self, t: Ints, missing: Ints, period_s: float) -> None:
        """Store the times of missing samples, because these samples may arrive later."""
        period_ns = min(period_s * NS_PER_S, MAX_PERIOD_NS)
        for row in np.flatnonzero((missing > 0) & (missing <= SEARCH_ROWS)).tolist():
            before_ns = np.rint(np.arange(1, missing[row] + 1) * period_ns)
            self._missing_t_ns.extend((t[row] - before_ns).astype(np.int64).tolist())

    def _period_s(self, steps: Ints) -> float | None:
        """Return the sample period in s that is used to detect missing samples, or None if unknown."""
        if self._timeline.line.has_enough_points_for_gaps:
            return self._timeline.line.period_s()
        if self._timeline.assumed_hz:
            return 1.0 / self._timeline.assumed_hz
        return _typical_period_s(steps) if steps.sum() > MIN_SPAN_S * NS_PER_S else None

    def _report_jumps(self, t: Ints, steps: Ints) -> None:
        """Report backward and forward jumps of the sender time."""
        back = steps < (-JUMP_S * NS_PER_S if self._went_back else 0.0)  # report a small backward step only once
        if back.any():
            at = int(np.argmax(back))
            self._events.report_event("clock_jumped", int(t[at]), f"time went back by {-steps[at] / NS_PER_S:.6g} s")
            self._went_back = True
        if (steps > FORWARD_JUMP_S * NS_PER_S).any():
            at = int(np.argmax(steps))
            self._events.report_event("clock_jumped", int(t[at]), f"time jumped ahead by {steps[at] / NS_PER_S:.6g} s")

    def _count_missing(self, steps_s: Floats, period_s: float) -> Ints:
        """Return the number of missing samples before each sample [n], or zeros if most time steps are irregular.

        Time steps below CERTAIN_GAP_PERIODS must be a whole number of periods. A long step next to a short step means
        that a sample was late and that no sample is missing.
        """
        last_s = self._steps_s[-1] if self._steps_s else period_s
        self._steps_s.extend(steps_s[-STEP_HISTORY:].tolist())
        periods = steps_s / period_s
        if periods.max() < 1.5:
            return np.zeros(steps_s.size, np.int64)
        before = np.concatenate([[last_s], steps_s[:-1]])
        after = np.concatenate([steps_s[1:], [period_s]])
        deviation = np.abs(np.array(self._steps_s) / period_s - 1.0)
        if np.median(deviation) > STEP_TOLERANCE:
            return np.zeros(steps_s.size, np.int64)
        gap = np.rint(np.clip(periods, 0.0, MAX_GAP_SAMPLES)).astype(np.int64) - 1
        late = (periods < CERTAIN_GAP_PERIODS) & (np.abs(periods - np.rint(periods)) > STEP_TOLERANCE)
        late |= periods < 1.0 + max(0.5, MAX_LATENESS_RATIO * float(np.quantile(deviation, 0.75)))
        late |= steps_s + np.minimum(before, after) < 2.5 * period_s
        gap[late] = 0
        return gap


def find_evenly_spaced_order(t_ns: Ints, period_s: float) -> Ints | None:
    """Return the order of the samples in which the sender times are evenly spaced.

    Parameters
    ----------
    t_ns : array of int64, shape (n,)
        Times in ns in order of arrival.
    period_s : float
        Sample period in s.

    Returns
    -------
    array of int64, shape (n,), or None
        Index of the sample at each position, or None if the times are already sorted or are irregular.

    Examples
    --------
    >>> find_evenly_spaced_order(np.array([0, 10, 30, 20, 40]) * 10**6, 0.01).tolist()
    [0, 1, 3, 2, 4]
    >>> find_evenly_spaced_order(np.array([0, 10, 8, 20, 18]) * 10**6, 0.01) is None
    True
    """
    if (np.diff(t_ns) >= 0).all():
        return None
    order = np.argsort(t_ns, kind="stable")
    moved = np.flatnonzero(order != np.arange(len(order)))
    steps = np.diff(t_ns[order]) / (NS_PER_S * period_s)
    touched = np.unique(np.clip(np.concatenate([moved - 1, moved]), 0, len(steps) - 1))
    whole = np.rint(steps[touched])
    steady = (whole >= 1.0) & (np.abs(steps[touched] - whole) < STEP_TOLERANCE)
    return order if bool(steady.all()) else None


def _typical_period_s(steps: Ints) -> float | None:
    """Estimate the sample period in s from time steps. Return None if no step is positive.

    The estimate is the median if the steps are regular, and the mean if the steps are irregular.
    """
    forward = steps[steps > 0] / NS_PER_S
    if not forward.size:
        return None
    low, middle, high = np.quantile(forward, [0.1, 0.5, 0.9])
    return float(middle if high - low < 2.0 * STEP_TOLERANCE * middle else forward.mean())
