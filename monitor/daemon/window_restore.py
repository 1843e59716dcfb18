"""Restore of the estimation window after a restart of the program, from the end of the recording.

The recorded samples of the last window pass through the same pipeline again, without events. The other values come from
the state that was recorded with the samples (``segment.State``): the start of each axis, and the values of the iterated
fit.
"""

from typing import Final

import msgspec
import numpy as np

from drivers.recordings.segment import DaemonState
from drivers.sample import AXES, Ints, SampleBlock, make_block
from monitor.daemon.pipeline import DevicePipeline
from monitor.daemon.storage.recorder import RecordingTail

MIN_REPLAY_S: Final = 600.0
"""Shortest part of the recording that is replayed, however short the window is, because change detection needs history.
"""


def restore_window(chain: DevicePipeline, tail: RecordingTail, rate_hz: float, window_s: float, offset_ns: int) -> str:
    """Fill the pipeline with the end of a recording.

    Parameters
    ----------
    chain : Chain
        Pipeline of the device.
    tail : Tail
        End of the recording.
    rate_hz : float
        Sample rate.
    window_s : float
        Length of the window.
    offset_ns : int
        Offset that converts the times to Unix time, in nanoseconds.

    Returns
    -------
    str
        A sentence that describes the result.

    Raises
    ------
    RecordingError, OSError
        A segment can no longer be read.
    """
    state = tail.newest.state
    counted = np.zeros(len(AXES), np.int64)
    for piece in tail.pieces(max(window_s, MIN_REPLAY_S)):
        samples = piece.samples
        counted += _count_since_restart(samples, state)
        t_ns = samples.t_ns - offset_ns
        chain.replay(make_block(t_ns, samples.values, samples.temperature_c, lost=samples.lost), rate_hz)
    if chain.estimator is None:
        return chain.refusal_reason or "nothing could be rebuilt from the recording"
    for axis, unix_s in enumerate(state.since):
        # changes that are detected in the replay were already known before the restart
        chain.since_ns[axis] = None if unix_s is None else round(unix_s * 1e9) - offset_ns
        if unix_s is not None:
            chain.estimator.restart(axis, int(counted[axis]))
    if state.theta:
        shape = (-1, len(AXES))
        theta = np.array(state.theta, np.float64).reshape(shape)
        chain.estimator.restore_fit(np.array(state.entered).reshape(shape), theta)
    filled_s = chain.estimator.filled / chain.estimator.rate_hz
    return f"{filled_s:.6g} s of the window were rebuilt from the recording"


def known(
    chain: DevicePipeline, before: DaemonState, rate_hz: float | None, tick_step: float | None, offset_ns: int
) -> DaemonState:
    """Return the state that is to be recorded with the samples now.

    Parameters
    ----------
    chain : Chain
        Pipeline of the device.
    before : State
        State at the start of the program. It is returned with new rates while there is no estimator.
    rate_hz : float or None
        Sample rate.
    tick_step : float or None
        Counter ticks from one sample to the next.
    offset_ns : int
        Offset that converts the times to Unix time, in nanoseconds.
    """
    tick_step = tick_step or before.tick_step
    if chain.estimator is None:
        return msgspec.structs.replace(before, rate=rate_hz or before.rate, tick_step=tick_step)
    entered, theta = chain.estimator.fit_state()
    since = tuple(None if t_ns is None else (t_ns + offset_ns) / 1e9 for t_ns in chain.since_ns)
    sizes = tuple(None if np.isnan(size) else float(size) for size in theta.ravel())
    return DaemonState(chain.estimator.rate_hz, since, tick_step, sizes, tuple(entered.ravel().tolist()))


def _count_since_restart(samples: SampleBlock, state: DaemonState) -> Ints:
    """Return the number of samples in a block since the restart of each axis, int64 [6], missing ones included."""
    counting = np.zeros(len(AXES), np.int64)
    for axis, unix_s in enumerate(state.since):
        if unix_s is not None:
            late = samples.t_ns / 1e9 >= unix_s
            counting[axis] = np.count_nonzero(late) + (samples.lost if late[0] else 0)
    return counting
