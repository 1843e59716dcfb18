"""Detect motion, knocks and handling of the sensor.

The detector replaces samples in motion by NaN and reports each episode of motion. It continuously learns the noise at
rest from the samples, see ``motion_kernel``. The samples are processed in blocks. One block before and two blocks after
each episode are replaced as well.

The detector delays samples by two blocks, which take 0.5 s, or 16 samples at sample rates below 32 Hz. A disturbance
that stays constant for 60 s counts as rest. During the first eight blocks, only signals that no sensor shows at rest
count as motion. Rotation at a constant rate below 2 °/s and motion below the noise are not detected.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats, Ints, SampleBlock
from monitor.common.unit_formatting import format_axis_value
from monitor.estimation.detection.motion_kernel import (
    AXIS,
    BEGAN,
    FIRST,
    KIND,
    LAST,
    MOTION,
    PEAK,
    REMOVED_AFTER,
    TURN,
    MotionState,
    advance_motion_detection,
    make_motion_state,
)

BLOCK_S: Final = 0.25
"""Length of a block of samples in seconds."""
MIN_BLOCK_SAMPLES: Final = 8
"""Minimum number of samples in a block."""
MAX_KNOCK_BLOCKS: Final = 2
"""Maximum number of moving blocks in an episode that counts as a knock, if the orientation does not change."""

Kind = Literal["knock", "motion", "handling/orientation", "noise"]


@dataclass(frozen=True, slots=True)
class MotionEpisode:
    """Detected episode of motion, or of noise that is not motion."""

    kind: Kind  # "noise" if the noise level rose and the sensor did not move
    since: int  # index of the first replaced sample, counting missing samples
    until: int  # index after the last replaced sample
    seconds: float  # duration of the motion in seconds
    axis: str  # axis with the largest deviation relative to the noise
    peak: float  # largest deviation from the mean at rest, rad/s or m/s²
    text: str  # description for users


class MotionDetector:
    """Detector that replaces samples in motion by NaN.

    Parameters
    ----------
    rate_hz : float
        Sample rate in Hz.

    >>> from drivers.data_types import make_block
    >>> rest = MotionDetector(100.0)
    >>> still = np.random.default_rng(0).normal(0.0, 1e-3, (2000, 6))
    >>> still[1000:1200, 0] += np.sin(np.arange(200) / 20)
    >>> out = rest.advance_and_take_decided(make_block(np.arange(2000), still)) + rest.flush_delayed_samples()
    >>> [motion.text for motion in rest.take_motions()]
    ['moved for 2.0 s: gx up to 57 °/s']
    >>> rest.samples_in_motion, sum(int(np.isnan(one.values[:, 0]).sum()) for one in out)
    (275, 275)
    """

    def __init__(self, rate_hz: float) -> None:
        self.samples_in_motion = 0
        self._rate_hz = rate_hz
        self._size = samples_per_block(rate_hz)
        self._state = make_motion_state()
        self._held: deque[tuple[int, SampleBlock]] = deque()  # delayed blocks, with the index of the first sample
        self._index = 0  # index of the next sample
        self._motions: list[MotionEpisode] = []

    @property
    def is_moving(self) -> bool:
        """True if the newest decided block is in motion."""
        return bool(self._state.place[BEGAN] >= 0)

    def advance_and_take_decided(self, samples: SampleBlock) -> list[SampleBlock]:
        """Process a block of samples, and return the samples for which the decision is final, oldest first."""
        first = self._index + samples.lost
        self._held.append((first, samples))
        self._index = first + len(samples)
        return self._release(*_decide_blocks(samples.values, first, self._size, False, self._state))

    def flush_delayed_samples(self) -> list[SampleBlock]:
        """Return the delayed samples at the end of the stream, and end the current episode of motion."""
        return self._release(*_decide_blocks(_read_only(np.empty((0, len(AXES)))), 0, self._size, True, self._state))

    def take_motions(self) -> list[MotionEpisode]:
        """Return the episodes of motion that have ended since the last call."""
        motions, self._motions = self._motions, []
        return motions

    def _release(self, blocks: Ints, moving: Ints, episodes: Floats) -> list[SampleBlock]:
        self._motions += [_make_motion(episode, self._size, self._rate_hz) for episode in episodes]
        out: list[SampleBlock] = []
        end = (int(blocks[-1]) + 1) * self._size if blocks.size else 0
        moves = bool(moving.any())
        while self._held and self._held[0][0] < end:
            first, samples = self._held.popleft()
            if first + len(samples) > end:
                self._held.appendleft((end, samples[end - first :]))
                samples = samples[: end - first]
            out.append(self._remove_moving(samples, first, blocks, moving) if moves else samples)
        return out

    def _remove_moving(self, samples: SampleBlock, first: int, blocks: Ints, moving: Ints) -> SampleBlock:
        rows = (first + np.arange(len(samples))) // self._size
        struck = moving[np.searchsorted(blocks, rows)].astype(bool)
        if not struck.any():
            return samples
        self.samples_in_motion += int(struck.sum())
        values = np.where(struck[:, None], np.nan, samples.values)
        return samples.with_values(values)


def detect_motion(values: Floats, rate_hz: float) -> tuple[NDArray[np.bool_], list[MotionEpisode]]:
    """Detect motion in a whole recording on a regular time grid.

    Parameters
    ----------
    values : ndarray of float64, shape (n, 6)
        Samples in rad/s and m/s²; NaN means missing.
    rate_hz : float
        Sample rate in Hz.

    Returns
    -------
    moving : ndarray of bool, shape (n,)
        True for samples in motion.
    motions : list of MotionEpisode
        Detected episodes of motion.
    """
    size = samples_per_block(rate_hz)
    _, moving, episodes = _decide_blocks(_read_only(values), 0, size, True, make_motion_state())
    mask = np.repeat(moving.astype(bool), size)[: len(values)]
    motions = []
    for motion in (_make_motion(episode, size, rate_hz) for episode in episodes):
        if motion.kind == "noise":
            mask[motion.since : motion.until] = False
        else:
            motions.append(motion)
    return mask, motions


def samples_per_block(rate_hz: float) -> int:
    """Return the number of samples in a block at a given sample rate."""
    return max(round(BLOCK_S * rate_hz), MIN_BLOCK_SAMPLES)


def _read_only(values: Floats) -> Floats:
    """Return the samples as a contiguous read-only array.

    For each other memory layout, and for writable arrays, Numba would compile the kernel again.
    """
    view = np.ascontiguousarray(values, np.float64).view()
    view.flags.writeable = False
    return view


def _decide_blocks(
    values: Floats, first_index: int, size: int, stream_ends: bool, state: MotionState
) -> tuple[Ints, Ints, Floats]:
    """Return the numbers of the newly decided blocks, a flag for each (1 if in motion), and the completed episodes."""
    n = len(values) // size + 4
    blocks, moving, episodes = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros((n, 5))
    decided, ended = advance_motion_detection(values, first_index, size, stream_ends, state, blocks, moving, episodes)
    return blocks[:decided], moving[:decided], episodes[:ended]


def _make_motion(episode: Floats, size: int, rate_hz: float) -> MotionEpisode:
    first, last = int(episode[FIRST]), int(episode[LAST])
    axis, peak = AXES[int(episode[AXIS])], float(episode[PEAK])
    moving = last - first + 1
    seconds = moving * size / rate_hz
    kind: Kind = "knock" if moving <= MAX_KNOCK_BLOCKS else "motion"
    if episode[KIND] != MOTION:
        kind = "handling/orientation" if episode[KIND] == TURN else "noise"
    verb = {
        "knock": "knocked",
        "motion": f"moved for {seconds:.1f} s",
        "handling/orientation": f"handled, and left in another orientation, for {seconds:.1f} s",
        "noise": f"louder for {seconds:.1f} s",
    }
    text = f"{verb[kind]}: {axis} up to {format_axis_value(axis, peak)}"
    return MotionEpisode(kind, max(first - 1, 0) * size, (last + 1 + REMOVED_AFTER) * size, seconds, axis, peak, text)
