"""Live compensation of the gyro drift of one device.

Identifying a drift model takes about 50 ms, so the caller should do it in another thread. Bias steps and drift models
that no longer fit are reported as events.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import AXES, Event, Floats, SampleBlock
from monitor.common.unit_formatting import format_axis_value
from monitor.drift.compensation.arma import ArmaModel
from monitor.drift.compensation.gyro_drift_compensator import GYROS, Compensator, MeasuredAndPredictedDrift
from monitor.drift.compensation.sage_husa import STEPPED, USED
from monitor.estimation.detection.motion_and_change_monitor import MAX_RATE_CHANGE

EVENT_KIND: Final = "drift_unexplained"
INTERVALS: Final = 64
"""Number of intervals over which the squared normalised innovations are averaged."""
FALSE_ALARM_PROBABILITY: Final = 1e-8
"""Probability that a correct model exceeds LIMIT in a single test."""
LIMIT: Final = 2.327393746165351
"""Quantile of χ²/n with n = INTERVALS degrees of freedom, for the probability 1 − FALSE_ALARM_PROBABILITY."""
RESET_LIMIT: Final = 1.3
"""Mean squared normalised innovation below which a drift model counts as fitting again."""


@dataclass(frozen=True, slots=True)
class MeasuredAndSubtractedDrift:
    """Measured and subtracted drift of three gyro axes in one interval, in rad/s."""

    t_ns: int  # time of the last sample in the interval
    interval_s: float
    mean: Floats  # [3] measured drift at rest; NaN if in motion or rejected
    expected: Floats  # [3] drift that was subtracted; NaN if not known yet
    error: Floats  # [3] standard error of ``expected``
    innovation: Floats  # [3] normalised innovation ε/√S; NaN if not used
    models: tuple[ArmaModel | None, ...]  # drift model of each axis; None if not identified yet


class LiveDriftCompensation:
    """Drift compensation for the gyro axes of one device.

    Parameters
    ----------
    rate_hz : float
        Sample rate in Hz.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._events: list[Event] = []
        self._updates: list[MeasuredAndSubtractedDrift] = []
        self._reset()

    def compensate_block(self, samples: SampleBlock) -> SampleBlock:
        """Remove the gyro drift from a block of samples."""
        values = self.compensator.compensate(samples.values, samples.lost)
        newest_ns = int(samples.t_ns[-1])
        for interval in self.compensator.take_finished_intervals():
            t_ns = newest_ns - round((self.compensator.sample_count - interval.end) / self._rate_hz * 1e9)
            self._publish(interval, t_ns)
        return samples.with_values(values)

    def take_drift_updates(self) -> list[MeasuredAndSubtractedDrift]:
        """Return the results of the intervals that have ended since the last call."""
        updates, self._updates = self._updates, []
        return updates

    def take_events(self) -> list[Event]:
        """Return the events since the last call, which report bias steps and drift models that no longer fit."""
        events, self._events = self._events, []
        return events

    def apply_identification_result(self, axis: int, identified_model: ArmaModel | None) -> None:
        """Replace the drift model of an axis with an identified model.

        Parameters
        ----------
        axis : int
            Index of the gyro axis, 0 to 2.
        identified_model : ArmaModel or None
            Identified drift model. None means that the identification has failed.
        """
        self.compensator.apply_identification_result(axis, identified_model)
        if identified_model is not None:
            self._innovations[axis].forget_innovations()

    def set_rate(self, rate_hz: float) -> None:
        """Set a more accurate value of the sample rate in Hz.

        The compensation is restarted if the relative change of the rate exceeds MAX_RATE_CHANGE.
        """
        if abs(rate_hz / self._rate_hz - 1.0) > MAX_RATE_CHANGE:
            self._rate_hz = rate_hz
            self._reset()

    def _reset(self) -> None:
        self.compensator = Compensator(self._rate_hz)
        self._innovations = [InnovationTest() for _ in range(GYROS)]

    def _publish(self, interval: MeasuredAndPredictedDrift, t_ns: int) -> None:
        used = interval.outcome == USED
        self._updates.append(
            MeasuredAndSubtractedDrift(
                t_ns,
                self.compensator.interval_s,
                np.where(used, interval.mean, np.nan),
                interval.expected,
                interval.known,
                np.where(used, interval.innovation, np.nan),
                tuple(self.compensator.models),
            )
        )
        for at in range(GYROS):
            if interval.outcome[at] == STEPPED:
                self._innovations[at].forget_innovations()
                self._events.append(_step_event(AXES[at], float(interval.mean[at] - interval.expected[at]), t_ns))
                continue
            known = used[at] and np.isfinite(interval.expected[at])
            if known and self._innovations[at].detect_new_misfit(float(interval.innovation[at])):
                since_ns = t_ns - round(INTERVALS * self.compensator.interval_s * 1e9)
                self._events.append(
                    _misfit_event(AXES[at], self._innovations[at].mean_square_innovation, t_ns, since_ns)
                )


def _step_event(axis: str, size: float, t_ns: int) -> Event:
    step = format_axis_value(axis, size, sign=True)
    text = f"{axis}: lasting step of the bias by {step}; the new bias is now compensated"
    return Event(EVENT_KIND, t_ns, text, axis, {"bias": {"size": size}})


def _misfit_event(axis: str, mean_square: float, t_ns: int, since_ns: int) -> Event:
    text = (
        f"{axis}: the drift does not follow its model: squared innovations are {mean_square:.1f} times as large as "
        f"expected"
    )
    return Event(EVENT_KIND, t_ns, text, axis, {"innovation": {"mean_square": mean_square}}, since_ns, mean_square**0.5)


class InnovationTest:
    """Test of the innovations of a drift model for one axis.

    If the drift model fits, the mean of the squared normalised innovations ε²/S over n intervals has the distribution
    χ²_n/n. When the mean exceeds LIMIT, a misfit is reported. The next misfit is reported only after the mean has
    fallen below RESET_LIMIT.
    """

    def __init__(self) -> None:
        self._squares: deque[float] = deque(maxlen=INTERVALS)
        self._exceeded = False

    @property
    def mean_square_innovation(self) -> float:
        """Return the mean of ε²/S over the last INTERVALS intervals, or NaN if there are fewer intervals."""
        return sum(self._squares) / INTERVALS if len(self._squares) == INTERVALS else float("nan")

    def detect_new_misfit(self, innovation: float) -> bool:
        """Add a normalised innovation ε/√S, and return True if the drift model has ceased to fit.

        The function returns True only once for each misfit.
        """
        self._squares.append(innovation**2)
        now = self.mean_square_innovation
        if self._exceeded and now < RESET_LIMIT:
            self._exceeded = False
        if self._exceeded or not now > LIMIT:
            return False
        self._exceeded = True
        return True

    def forget_innovations(self) -> None:
        """Discard all innovations, for example after a change of the drift model or a bias step."""
        self._squares.clear()
        self._exceeded = False
