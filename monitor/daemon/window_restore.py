"""The window after a restart of the program, from the tail of the recording; and what is recorded for that.

The samples of the last window go through the same chain again, silently. What cannot be had from them comes from what
was recorded beside the last ones (``segment.State``): from when on the samples of each axis count, and where the
iterated fit stood.
"""

from typing import Final

import msgspec
import numpy as np

from drivers.recordings.segment import State
from drivers.sample import AXES, Ints, SampleBlock, block
from monitor.daemon.pipeline import Chain
from monitor.daemon.storage.recorder import Tail

LEAST_S: Final = 600.0
"""Of the recording, lived through however short the window is: changes are looked for in what is known."""


def rebuild(chain: Chain, tail: Tail, rate_hz: float, window_s: float, offset_ns: int) -> str:
    """Fill the chain; ``offset_ns`` makes its times Unix time. Returns what was done, as a sentence.

    Raises:
        RecordingError, OSError: a segment that cannot be read any more
    """
    state = tail.newest.state
    counted = np.zeros(len(AXES), np.int64)
    for piece in tail.pieces(max(window_s, LEAST_S)):
        samples = piece.samples
        counted += _counting(samples, state)
        t_ns = samples.t_ns - offset_ns
        chain.relive(block(t_ns, samples.values, samples.temperature_c, lost=samples.lost), rate_hz)
    if chain.estimator is None:
        return chain.refused or "nothing could be rebuilt from the recording"
    for axis, unix_s in enumerate(state.since):
        # what the watch finds again now is what it knew before
        chain.since_ns[axis] = None if unix_s is None else round(unix_s * 1e9) - offset_ns
        if unix_s is not None:
            chain.estimator.restart(axis, int(counted[axis]))
    if state.theta:
        shape = (-1, len(AXES))
        theta = np.array(state.theta, np.float64).reshape(shape)
        chain.estimator.start_from(np.array(state.entered).reshape(shape), theta)
    filled_s = chain.estimator.filled / chain.estimator.rate_hz
    return f"{filled_s:.6g} s of the window were rebuilt from the recording"


def known(chain: Chain, before: State, rate_hz: float | None, tick_step: float | None, offset_ns: int) -> State:
    """What is to be recorded beside the samples now; ``before``: what was known at the start."""
    tick_step = tick_step or before.tick_step
    if chain.estimator is None:
        return msgspec.structs.replace(before, rate=rate_hz or before.rate, tick_step=tick_step)
    entered, theta = chain.estimator.fitted()
    since = tuple(None if t_ns is None else (t_ns + offset_ns) / 1e9 for t_ns in chain.since_ns)
    sizes = tuple(None if np.isnan(size) else float(size) for size in theta.ravel())
    return State(chain.estimator.rate_hz, since, tick_step, sizes, tuple(entered.ravel().tolist()))


def _counting(samples: SampleBlock, state: State) -> Ints:
    """How many samples of a block count for each axis that began anew [6], missing ones before it included."""
    counting = np.zeros(len(AXES), np.int64)
    for axis, unix_s in enumerate(state.since):
        if unix_s is not None:
            late = samples.t_ns / 1e9 >= unix_s
            counting[axis] = np.count_nonzero(late) + (samples.lost if late[0] else 0)
    return counting
