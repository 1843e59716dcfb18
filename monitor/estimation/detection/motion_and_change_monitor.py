"""Detect motion and noise changes in the samples of one device, before the samples reach the estimator.

Motion and noise changes are reported as events. After a noise change, the monitor requests that the estimator discards
the old samples of the axis. The change detector ignores samples in motion.
"""

from dataclasses import dataclass, replace
from typing import Final

from drivers.data_types import AXES, Event, SampleBlock
from monitor.estimation.detection.change_detection import Change, NoiseAndBiasChangeDetector
from monitor.estimation.detection.motion_detection import MotionDetector, MotionEpisode

MAX_RATE_CHANGE: Final = 0.02
"""Maximum relative change of the sample rate for which the detectors continue without a restart."""
MAX_SKIPPED_SAMPLES: Final = 10_000_000
"""Maximum number of successive missing samples that the change detector processes, which takes 1.6 s.

After a longer gap, the change detector is restarted.
"""


@dataclass(frozen=True, slots=True)
class AxisRestartRequest:
    """Request to discard the old samples of one axis after a noise change."""

    axis: int  # index into AXES
    samples: int  # number of samples since the noise change, including missing samples


class MotionAndChangeMonitor:
    """Detector of motion and noise changes for one device.

    Parameters
    ----------
    rate_hz : float
        Sample rate in Hz.
    remove_motion : bool
        True to replace samples in motion by NaN, False to return all samples unchanged and without delay.
    alarms_per_day : float
        Accepted number of false alarms of the change detector per day. The value 0 disables the change detector.
    keep_samples_at_rest : bool
        True to store the samples that ``take_samples_with_motion_masked`` returns.
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
        """Number of times the orientation has changed."""
        self._received = 0  # number of samples since the start, including missing samples
        self._newest_ns = 0
        self._moved_before = 0
        self._events: list[Event] = []
        self._restarts: list[AxisRestartRequest] = []
        self._pending: list[SampleBlock] = []  # delayed blocks that were received at the previous sample rate
        self._begin()

    @property
    def is_moving(self) -> bool:
        """True if the device is in motion."""
        return self._rest.is_moving

    @property
    def samples_in_motion(self) -> int:
        """Number of samples in motion since the start."""
        return self._moved_before + self._rest.samples_in_motion

    def set_rate(self, rate_hz: float) -> None:
        """Set a more accurate value of the sample rate.

        The detectors are restarted if the relative change of the rate exceeds ``MAX_RATE_CHANGE``.
        """
        if abs(rate_hz / self._rate_hz - 1.0) > MAX_RATE_CHANGE:
            self._pending = self.flush_delayed_samples()
            self._moved_before += self._rest.samples_in_motion
            self._rate_hz = rate_hz
            self._begin()

    def process_samples(self, samples: SampleBlock) -> list[SampleBlock]:
        """Process a block of samples, and return the blocks that are ready for the estimator."""
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
        """Return the events of motion and changes since the last call."""
        events, self._events = self._events, []
        return events

    def take_restart_requests(self) -> list[AxisRestartRequest]:
        """Return the restart requests since the last call."""
        restarts, self._restarts = self._restarts, []
        return restarts

    def take_samples_with_motion_masked(self) -> list[SampleBlock]:
        """Return the samples since the last call, with NaN for samples in motion."""
        still, self._still = self._still, []
        return still

    def _begin(self) -> None:
        self._began = self._received
        self._rest = MotionDetector(self._rate_hz)
        self._first = 0  # index of the first sample that the change detector received, relative to ``_began``
        self._louder: MotionEpisode | None = None  # newest rise of the noise that the change detector received masked
        self._changes = (
            NoiseAndBiasChangeDetector(self._rate_hz, self._alarms_per_day) if self._alarms_per_day > 0.0 else None
        )

    def _with_pending(self, still: list[SampleBlock]) -> list[SampleBlock]:
        earlier, self._pending = self._pending, []
        return earlier + still

    def _search(self, still: list[SampleBlock]) -> None:
        if self._keep_samples_at_rest:
            self._still += still
        for motion in self._rest.take_motions():
            if motion.kind == "noise":
                self._louder = motion
                continue
            self.orientation_changes += motion.kind == "handling/orientation"
            self._events.append(self._motion_event(motion))
        if self._changes is None:
            return
        for samples in still:
            if samples.lost > MAX_SKIPPED_SAMPLES:
                self._report_changes(self._changes)
                self._first += self._changes.samples_since_start + samples.lost
                self._changes = NoiseAndBiasChangeDetector(self._rate_hz, self._alarms_per_day)
            elif samples.lost:
                self._changes.skip_missing_samples(samples.lost)
            self._changes.process_samples(samples.values)
        self._report_changes(self._changes)

    def _report_changes(self, changes: NoiseAndBiasChangeDetector) -> None:
        for change in changes.take_changes():
            louder, since = self._louder, self._first + change.since
            if change.kind == "noise_changed" and louder and louder.since <= since <= louder.until + self._rate_hz:
                change = replace(change, since=max(louder.since - self._first, 0))
            self._events.append(self._change_event(change))
            if change.kind == "noise_changed":
                handed_on = (
                    changes.samples_since_start if self._remove_motion else self._received - self._began - self._first
                )
                self._restarts.append(AxisRestartRequest(change.axis, handed_on - change.since))

    def _motion_event(self, motion: MotionEpisode) -> Event:
        what = {"moved": {"seconds": motion.seconds, "peak": motion.peak}}
        return Event("moved", self._t_ns(motion.until), motion.text, motion.axis, what, self._t_ns(motion.since))

    def _change_event(self, change: Change) -> Event:
        what = {name: {"before": before, "after": after} for name, (before, after) in change.what.items()}
        found_ns, since_ns = self._t_ns(self._first + change.found), self._t_ns(self._first + change.since)
        return Event(change.kind, found_ns, change.text, AXES[change.axis], what, since_ns, change.sigma)

    def _t_ns(self, index: int) -> int:
        """Return the time of a sample from its index since the restart, no later than the time of the newest sample."""
        return self._newest_ns - round(max(self._received - self._began - 1 - index, 0) / self._rate_hz * 1e9)
