"""Watches over the samples of one device on their way to the estimate: is it at rest, has its noise changed?

Comes in: blocks in order. Goes out: the blocks for the estimate, those of moving stretches struck out where that is
wanted; and what was found, as events with the times of the samples. A change of noise names the axis whose estimate is
to begin anew, and with how many samples. The detector of changes never sees a moving stretch.
"""

from dataclasses import dataclass
from typing import Final

from drivers.sample import AXES, Event, SampleBlock
from monitor.estimation.detection.change_detection import Change, ChangeDetector
from monitor.estimation.detection.motion_detection import Motion, Rest

OTHER_RATE: Final = 0.02
"""A rate known better by less than this share is the same to blocks of a quarter of a second."""
LONGEST_HOLE: Final = 10_000_000
"""Samples missing at once, over which the detector of changes still passes, in 1.6 s; after more it learns anew."""


@dataclass(frozen=True, slots=True)
class Restart:
    """The estimate of one axis is to begin anew."""

    axis: int
    samples: int  # the newest that belong to the new noise, missing ones included


class Watch:
    """Motion and changes of one device.

    Args:
        rate_hz: samples a second
        leave_out: hand on moving stretches as missing; else all samples pass at once, as they are
        alarms_per_day: false alarms of changes to bear; 0 = do not look for changes
        keep_still: have ``take_still`` give the samples at rest, whatever is handed on
    """

    def __init__(
        self, rate_hz: float, leave_out: bool = False, alarms_per_day: float = 1.0 / 30.0, keep_still: bool = False
    ) -> None:
        self._rate_hz = rate_hz
        self._leave_out = leave_out
        self._alarms_per_day = alarms_per_day
        self._keep_still = keep_still
        self._still: list[SampleBlock] = []
        self.handled = 0
        """How often the device was left in another orientation."""
        self._came = 0  # samples since the start, missing ones included
        self._newest_ns = 0
        self._moved_before = 0
        self._events: list[Event] = []
        self._restarts: list[Restart] = []
        self._final: list[SampleBlock] = []  # held back at the rate before, to go out with the next
        self._begin()

    @property
    def moving(self) -> bool:
        """Whether the device is moved just now."""
        return self._rest.moving

    @property
    def moved_samples(self) -> int:
        """Samples of moving stretches so far."""
        return self._moved_before + self._rest.moved_samples

    def relabel(self, rate_hz: float) -> None:
        """The rate is known better; if it is another one, what was learned was of other times."""
        if abs(rate_hz / self._rate_hz - 1.0) > OTHER_RATE:
            self._final = self.flush()
            self._moved_before += self._rest.moved_samples
            self._rate_hz = rate_hz
            self._begin()

    def update(self, samples: SampleBlock) -> list[SampleBlock]:
        """The blocks that are to be estimated now."""
        self._came += samples.lost + len(samples)
        self._newest_ns = int(samples.t_ns[-1])
        still = self._rest.update(samples)
        self._look(still)
        return self._let_go(still) if self._leave_out else [samples]

    def flush(self) -> list[SampleBlock]:
        """What was held back, when no more will come."""
        still = self._rest.flush()
        self._look(still)
        return self._let_go(still) if self._leave_out else []

    def take_events(self) -> list[Event]:
        """What was found since the last call."""
        events, self._events = self._events, []
        return events

    def take_restarts(self) -> list[Restart]:
        """Which axes are to begin anew, since the last call."""
        restarts, self._restarts = self._restarts, []
        return restarts

    def take_still(self) -> list[SampleBlock]:
        """Samples that are judged, those of moving stretches struck out, since the last call; 0.5 s late."""
        still, self._still = self._still, []
        return still

    def _begin(self) -> None:
        self._began = self._came
        self._rest = Rest(self._rate_hz)
        self._first = 0  # of the samples since then, the first that the detector of changes has seen
        self._changes = self._detector() if self._alarms_per_day > 0.0 else None

    def _detector(self) -> ChangeDetector:
        return ChangeDetector(self._rate_hz, self._alarms_per_day)

    def _let_go(self, still: list[SampleBlock]) -> list[SampleBlock]:
        earlier, self._final = self._final, []
        return earlier + still

    def _look(self, still: list[SampleBlock]) -> None:
        if self._keep_still:
            self._still += still
        motions = self._rest.take()
        self.handled += sum(motion.kind == "handling/orientation" for motion in motions)
        self._events += [self._moved(motion) for motion in motions]
        if self._changes is None:
            return
        for samples in still:
            if samples.lost > LONGEST_HOLE:
                self._take(self._changes)
                self._changes, self._first = self._detector(), self._first + self._changes.samples + samples.lost
            elif samples.lost:
                self._changes.skip(samples.lost)
            self._changes.update(samples.values)
        self._take(self._changes)

    def _take(self, changes: ChangeDetector) -> None:
        """Tell what was found, and let axes begin anew."""
        for change in changes.take():
            self._events.append(self._changed(change))
            if change.kind == "noise_changed":
                handed_on = changes.samples if self._leave_out else self._came - self._began - self._first
                self._restarts.append(Restart(change.axis, handed_on - change.since))

    def _moved(self, motion: Motion) -> Event:
        what = {"moved": {"seconds": motion.seconds, "peak": motion.peak}}
        return Event("moved", self._t_ns(motion.until), motion.text, motion.axis, what, self._t_ns(motion.since))

    def _changed(self, change: Change) -> Event:
        what = {name: {"before": before, "after": after} for name, (before, after) in change.what.items()}
        found_ns, since_ns = self._t_ns(self._first + change.found), self._t_ns(self._first + change.since)
        return Event(change.kind, found_ns, change.text, AXES[change.axis], what, since_ns, change.sigma)

    def _t_ns(self, index: int) -> int:
        """Time of a sample by its number since the watch began, of the newest at the latest."""
        return self._newest_ns - round(max(self._came - self._began - 1 - index, 0) / self._rate_hz * 1e9)
