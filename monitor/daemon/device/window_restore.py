"""Restore the estimation window from the end of the recording after the program restarts.

The pipeline processes the recorded samples of the last window again, without reporting events. The start of each axis
and the fitted values are read from the recorded state (``segment_file.DaemonState``).
"""

import time
from typing import Final

import msgspec
import numpy as np

from drivers.data_types import AXES, Event, Ints, SampleBlock, make_block
from drivers.recordings.segment_file import DaemonState
from drivers.timing.sample_clock import LastSample, SampleClock
from monitor.daemon.device.pipeline import DevicePipeline
from monitor.daemon.device.unix_timeline import DeviceTimeline
from monitor.daemon.storage.last_recorded_samples import LastRecordedSamples
from monitor.settings.loading import Device

MIN_RATE_SAMPLES: Final = 5
"""Minimum number of newest samples from which the recorded rate is checked."""
MAX_RATE_RATIO: Final = 2.0
"""Maximum ratio of the recorded rate and the rate of the newest samples, whose times have jitter."""
MIN_REPLAY_S: Final = 600.0
"""Minimum duration in s of the replayed recording. Change detection needs this duration."""


class WindowRestore:
    """Restores the estimation window of one device after the program restarts.

    Parameters
    ----------
    device : Device
        Settings of the device.
    pipeline : DevicePipeline
        Pipeline of the device. While ``active`` is True, only ``refill_window_from_recording`` may use the pipeline.
    clock : SampleClock
        Sample clock of the device.
    timeline : DeviceTimeline
        Timeline that receives the event ``window_rebuilt``.
    """

    def __init__(self, device: Device, pipeline: DevicePipeline, clock: SampleClock, timeline: DeviceTimeline) -> None:
        self._device = device
        self._pipeline = pipeline
        self._clock = clock
        self._timeline = timeline
        self._tail: LastRecordedSamples | None = None  # end of the recording, until the window is rebuilt
        self._state_before = DaemonState()  # state of the estimate before the restart

    @property
    def active(self) -> bool:
        """True until the window has been rebuilt from the recording."""
        return self._tail is not None

    def resume_from(self, tail: LastRecordedSamples | None) -> None:
        """Prepare to rebuild the window from a recording that ended less than one window ago."""
        if tail is None:
            return
        newest, state = tail.newest.samples, tail.newest.state
        t_ns = int(newest.t_ns[-1]) - self._timeline.unix_offset_ns(time.monotonic_ns())
        ago_s = (time.time_ns() - int(newest.t_ns[-1])) / 1e9
        rate_hz = self._device.rate_hz or state.rate
        reason = tail.newest.state_error or _contradiction(newest, state)
        if ago_s < 0.0:
            reason = "the recording ends later than the present time of the host clock"
        elif not reason and (rate_hz is None or ago_s > self._device.window_s):
            reason = f"the recording ended {ago_s:.4g} s ago"
        if reason or rate_hz is None:
            self._timeline.add_event_now("window_rebuilt", f"{reason}; the window starts empty")
            return
        self._clock.resume_after_restart(LastSample(t_ns, int(newest.ticks[-1]), rate_hz, state.tick_step))
        self._tail, self._state_before = tail, state

    def refill_window_from_recording(self) -> None:
        """Fill the window from the recording, while new samples wait in the ring buffer.

        Raises
        ------
        ImuError or OSError
            If the recording cannot be read. The pipeline then contains a part of the recording and must be replaced.
        """
        tail = self._tail
        if tail is None:
            return
        offset_ns = self._timeline.unix_offset_ns(time.monotonic_ns())
        text = self._replay(tail, offset_ns)
        t_ns = int(tail.newest.samples.t_ns[-1]) - offset_ns
        self._timeline.add_event(Event("window_rebuilt", t_ns, text))
        self._tail = None

    def state_to_record(self) -> DaemonState:
        """Return the current state of the estimate, which is recorded with the samples."""
        before, estimator = self._state_before, self._pipeline.estimator
        if self.active:
            return before
        tick_step = self._clock.ticks_per_sample or before.tick_step
        if estimator is None:
            return msgspec.structs.replace(
                before, rate=self._clock.configured_or_measured_rate_hz or before.rate, tick_step=tick_step
            )
        offset_ns = self._timeline.unix_offset_ns(self._pipeline.newest_ns)
        entered, theta = estimator.copy_terms_and_squared_coefficients()
        since = tuple(None if t_ns is None else (t_ns + offset_ns) / 1e9 for t_ns in self._pipeline.since_ns)
        parameters = tuple(None if np.isnan(value) else float(value) for value in theta.ravel())
        return DaemonState(estimator.rate_hz, since, tick_step, parameters, tuple(entered.ravel().tolist()))

    def _replay(self, tail: LastRecordedSamples, offset_ns: int) -> str:
        pipeline, state = self._pipeline, tail.newest.state
        rate_hz = self._clock.configured_or_measured_rate_hz or state.rate or 0.0
        counted = np.zeros(len(AXES), np.int64)
        for piece in tail.read_pieces(max(self._device.window_s, MIN_REPLAY_S)):
            samples = piece.samples
            counted += _count_since_restart(samples, state)
            t_ns = samples.t_ns - offset_ns
            pipeline.replay_samples(make_block(t_ns, samples.values, samples.temperature_c, lost=samples.lost), rate_hz)
        if pipeline.estimator is None:
            return pipeline.refusal_reason or "the recording holds no samples for the window"
        for axis, unix_s in enumerate(state.since):
            # the recorded start of each axis replaces the start that was detected in the replay
            pipeline.since_ns[axis] = None if unix_s is None else round(unix_s * 1e9) - offset_ns
            if unix_s is not None:
                pipeline.estimator.restart_axis(axis, int(counted[axis]))
        if state.theta:
            shape = (-1, len(AXES))
            theta = np.array(state.theta, np.float64).reshape(shape)
            pipeline.estimator.restore_fit(np.array(state.entered).reshape(shape), theta)
        filled_s = pipeline.estimator.samples_in_window / pipeline.estimator.rate_hz
        return f"{filled_s:.6g} s of the window were rebuilt from the recording"


def _contradiction(newest: SampleBlock, state: DaemonState) -> str:
    """Return the reason why a recorded state cannot belong to the newest samples of the recording, or ""."""
    if any(unix_s is not None and unix_s > time.time() + 1.0 for unix_s in state.since):
        return "the recorded state is damaged (since is later than the present time of the host clock)"
    span_s = int(newest.t_ns[-1] - newest.t_ns[0]) / 1e9
    if state.rate is None or len(newest) < MIN_RATE_SAMPLES or span_s <= 0.0:
        return ""
    rate_hz = (len(newest) - 1) / span_s
    if rate_hz / MAX_RATE_RATIO < state.rate < rate_hz * MAX_RATE_RATIO:
        return ""
    return f"the recorded state is damaged (rate {state.rate:g} Hz, but the samples have {rate_hz:.4g} Hz)"


def _count_since_restart(samples: SampleBlock, state: DaemonState) -> Ints:
    """Return the number of samples [6] in a block since the restart of each axis, including missing samples."""
    counting = np.zeros(len(AXES), np.int64)
    for axis, unix_s in enumerate(state.since):
        if unix_s is not None:
            late = samples.t_ns / 1e9 >= unix_s
            counting[axis] = np.count_nonzero(late) + (samples.lost if late[0] else 0)
    return counting
