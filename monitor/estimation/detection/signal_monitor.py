"""Motion and change detection on the samples of one device, before the estimator receives the samples.

The monitor receives blocks in order and returns the blocks for the estimator. If requested, it replaces samples in
motion by missing samples. Motion and changes are reported as events with the times of the samples. A noise change also
requests a restart of the estimate of one axis. The change detector never receives samples in motion.
"""

from dataclasses import dataclass
from typing import Final

from drivers.data_types import AXES, Event, SampleBlock
from monitor.estimation.detection.change_detection import Change, ChangeDetector
from monitor.estimation.detection.motion_detection import Motion, MotionDetector

MAX_RATE_CHANGE: Final = 0.02
"""Largest relative change of the sample rate for which the detectors continue with the same block length."""
MAX_SKIPPED_SAMPLES: Final = 10_000_000
"""Largest gap that the change detector processes as missing samples, which takes 1.6 s.

After a longer gap, the detector starts again.
"""


@dataclass(frozen=True, slots=True)
class AxisRestartRequest:
    """Request to restart the estimate of one axis."""

    axis: int  # index into AXES
    samples: int  # number of newest samples that belong to the new noise, including missing ones


class SignalMonitor:
    """Motion and change detection for one device.

    Parameters
    ----------
    rate_hz : float
        Sample rate in Hz.
    remove_motion : bool
        True to replace samples in motion by missing samples. False to return all samples unchanged and without delay.
    alarms_per_day : float
        Accepted false alarms of the change detector per day. 0 disables the change detection.
    keep_samples_at_rest : bool
        True to make the samples at rest available from ``take_samples_at_rest``, independent of ``remove_motion``.
    """

    def __init__(
        self,
        rate_hz: float,
        remove_motion: bool = False,
        alarms_per_day: float = 1.0 / 30.0,
        keep_samples_at_rest: bool = False,
    ) -> None:
        self._rate_hz = rate_hz
        self._remove_motion = remove_motion
        self._alarms_per_day = alarms_per_day
        self._keep_samples_at_rest = keep_samples_at_rest
        self._still: list[SampleBlock] = []
        self.orientation_changes = 0
        """Number of times that the device was left in another orientation."""
        self._received = 0  # samples since the start, including missing ones
        self._newest_ns = 0
        self._moved_before = 0
        self._events: list[Event] = []
        self._restarts: list[AxisRestartRequest] = []
        self._pending: list[SampleBlock] = []  # delayed at the previous rate, returned with the next block
        self._begin()

    @property
    def is_moving(self) -> bool:
        """True if the device is being moved."""
        return self._rest.is_moving

    @property
    def samples_in_motion(self) -> int:
        """Number of samples in motion so far."""
        return self._moved_before + self._rest.samples_in_motion

    def set_rate(self, rate_hz: float) -> None:
        """Set a more accurate sample rate.

        If the rate differs by more than ``MAX_RATE_CHANGE``, the detectors start again.
        """
        if abs(rate_hz / self._rate_hz - 1.0) > MAX_RATE_CHANGE:
            self._pending = self.flush_delayed_samples()
            self._moved_before += self._rest.samples_in_motion
            self._rate_hz = rate_hz
            self._begin()

    def process_samples(self, samples: SampleBlock) -> list[SampleBlock]:
        """Process a block, and return the blocks to be estimated now."""
        self._received += samples.lost + len(samples)
        self._newest_ns = int(samples.t_ns[-1])
        still = self._rest.advance_and_take_decided(samples)
        self._search(still)
        return self._with_pending(still) if self._remove_motion else [samples]

    def flush_delayed_samples(self) -> list[SampleBlock]:
        """Return the delayed samples at the end of the stream."""
        still = self._rest.flush_delayed_samples()
        self._search(still)
        return self._with_pending(still) if self._remove_motion else []

    def take_events(self) -> list[Event]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def take_restart_requests(self) -> list[AxisRestartRequest]:
        """Return the restart requests that were made since the last call."""
        restarts, self._restarts = self._restarts, []
        return restarts

    def take_samples_at_rest(self) -> list[SampleBlock]:
        """Return the samples since the last call with a delay of 0.5 s.

        Samples in motion are replaced by missing samples.
        """
        still, self._still = self._still, []
        return still

    def _begin(self) -> None:
        """Start new detectors at the current rate."""
        self._began = self._received
        self._rest = MotionDetector(self._rate_hz)
        self._first = 0  # index of the first sample that the change detector received, counted from ``_began``
        self._changes = ChangeDetector(self._rate_hz, self._alarms_per_day) if self._alarms_per_day > 0.0 else None

    def _with_pending(self, still: list[SampleBlock]) -> list[SampleBlock]:
        """Return the pending blocks of the previous rate, followed by the given blocks."""
        earlier, self._pending = self._pending, []
        return earlier + still

    def _search(self, still: list[SampleBlock]) -> None:
        """Collect the episodes of motion, and pass the samples at rest to the change detector."""
        if self._keep_samples_at_rest:
            self._still += still
        motions = self._rest.take_motions()
        self.orientation_changes += sum(motion.kind == "handling/orientation" for motion in motions)
        self._events += [self._motion_event(motion) for motion in motions]
        if self._changes is None:
            return
        for samples in still:
            if samples.lost > MAX_SKIPPED_SAMPLES:
                self._report_changes(self._changes)
                self._first += self._changes.samples_since_start + samples.lost
                self._changes = ChangeDetector(self._rate_hz, self._alarms_per_day)
            elif samples.lost:
                self._changes.skip_missing_samples(samples.lost)
            self._changes.process_samples(samples.values)
        self._report_changes(self._changes)

    def _report_changes(self, changes: ChangeDetector) -> None:
        """Report the changes found, and request restarts of axes whose noise changed."""
        for change in changes.take_changes():
            self._events.append(self._change_event(change))
            if change.kind == "noise_changed":
                handed_on = (
                    changes.samples_since_start if self._remove_motion else self._received - self._began - self._first
                )
                self._restarts.append(AxisRestartRequest(change.axis, handed_on - change.since))

    def _motion_event(self, motion: Motion) -> Event:
        """Convert an episode of motion to an event."""
        what = {"moved": {"seconds": motion.seconds, "peak": motion.peak}}
        return Event("moved", self._t_ns(motion.until), motion.text, motion.axis, what, self._t_ns(motion.since))

    def _change_event(self, change: Change) -> Event:
        """Convert a change to an event."""
        what = {name: {"before": before, "after": after} for name, (before, after) in change.what.items()}
        found_ns, since_ns = self._t_ns(self._first + change.found), self._t_ns(self._first + change.since)
        return Event(change.kind, found_ns, change.text, AXES[change.axis], what, since_ns, change.sigma)

    def _t_ns(self, index: int) -> int:
        """Return the time of a sample, given its index since the last start.

        The time is at most that of the newest sample.
        """
        return self._newest_ns - round(max(self._received - self._began - 1 - index, 0) / self._rate_hz * 1e9)
