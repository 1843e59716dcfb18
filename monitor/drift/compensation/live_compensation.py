"""The compensation of one device while its samples come: blocks in, the same blocks without their gyros' drift out.

What every interval at rest has taught is told as a ``DriftLook``; a model that no longer holds, and a bias that
stepped, as an event. Models are identified by the caller, beside the stream, as that takes some 50 ms: the
compensator's ``due`` says of which axes, ``adopt`` takes them over.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.sample import AXES, Event, Floats, SampleBlock, block
from monitor.common.rates import amount
from monitor.drift.compensation.arma import Arma
from monitor.drift.compensation.compensator import GYROS, Compensator, Interval
from monitor.drift.compensation.innovation_test import INTERVALS, Innovations
from monitor.drift.compensation.sage_husa import STEPPED, USED
from monitor.estimation.detection.signal_monitor import OTHER_RATE

KIND: Final = "drift_unexplained"


@dataclass(frozen=True, slots=True)
class DriftLook:
    """One interval, of three gyro axes, rad/s."""

    t_ns: int  # of its last sample
    interval_s: float
    mean: Floats  # [3] measured at rest; NaN = in motion, or left out
    expected: Floats  # [3] the drift that was taken out; NaN = not known yet
    error: Floats  # [3] standard error of that
    innovation: Floats  # [3] ε/√S
    models: tuple[Arma | None, ...]


class LiveCompensation:
    """The gyros of one device.

    Args:
        rate_hz: samples a second
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._events: list[Event] = []
        self._looks: list[DriftLook] = []
        self._begin()

    def update(self, samples: SampleBlock) -> SampleBlock:
        """The block, drift taken out; times, temperature and accelerometers as they are."""
        values = self.compensator.update(samples.values, samples.lost)
        newest_ns = int(samples.t_ns[-1])
        for interval in self.compensator.take():
            t_ns = newest_ns - round((self.compensator.came - interval.end) / self._rate_hz * 1e9)
            self._look(interval, t_ns)
        return block(samples.t_ns, values, samples.temperature_c, samples.ticks, samples.lost)

    def take(self) -> list[DriftLook]:
        """Intervals since the last call."""
        looks, self._looks = self._looks, []
        return looks

    def take_events(self) -> list[Event]:
        """What no model explains, since the last call."""
        events, self._events = self._events, []
        return events

    def adopt(self, axis: int, model: Arma | None) -> None:
        """A model that was identified; None: none was found."""
        self.compensator.adopt(axis, model)
        if model is not None:
            self._innovations[axis].forget()

    def relabel(self, rate_hz: float) -> None:
        """The rate is known better; if it is another one, all that was learned was of other times."""
        if abs(rate_hz / self._rate_hz - 1.0) > OTHER_RATE:
            self._rate_hz = rate_hz
            self._begin()

    def _begin(self) -> None:
        self.compensator = Compensator(self._rate_hz)
        self._innovations = [Innovations() for _ in range(GYROS)]

    def _look(self, interval: Interval, t_ns: int) -> None:
        used = interval.became == USED
        self._looks.append(
            DriftLook(
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
            if interval.became[at] == STEPPED:
                self._innovations[at].forget()
                self._events.append(_stepped(AXES[at], float(interval.mean[at] - interval.expected[at]), t_ns))
                continue
            known = used[at] and np.isfinite(interval.expected[at])
            if known and self._innovations[at].update(float(interval.innovation[at])):
                since_ns = t_ns - round(INTERVALS * self.compensator.interval_s * 1e9)
                self._events.append(_left(AXES[at], self._innovations[at].mean_square, t_ns, since_ns))


def _stepped(axis: str, size: float, t_ns: int) -> Event:
    text = f"{axis}: the bias has stepped by {amount(axis, size, sign=True)} and stayed; it is taken out from now on"
    return Event(KIND, t_ns, text, axis, {"bias": {"size": size}})


def _left(axis: str, mean_square: float, t_ns: int, since_ns: int) -> Event:
    text = (
        f"{axis}: the drift does not go as its model lets expect: squared innovations are {mean_square:.1f} times as "
        f"large as they should be"
    )
    return Event(KIND, t_ns, text, axis, {"innovation": {"mean_square": mean_square}}, since_ns, mean_square**0.5)
