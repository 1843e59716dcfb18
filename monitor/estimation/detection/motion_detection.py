"""Detection of motion, knocks and handling of the sensor, and removal of these samples from the stream.

The detector replaces samples in motion by NaN, so that all later statistics treat them as missing. It also returns a
``Motion`` for each episode. The noise at rest is learned from the samples of each axis and updated continuously, so no
noise level has to be configured. ``motion_kernel`` describes the method. One block before the first moving block of an
episode and two blocks after the last moving block are removed as well.

Samples are delayed by two blocks, because the decision for a block needs the following block. Two blocks take 0.5 s, or
16 samples at sample rates below 32 Hz. After 60 s, a constant disturbance counts as rest and is left to the change
detector. The first reference is learned in eight blocks. During these blocks, only signals that are too strong for any
MEMS sensor at rest count as motion.

Rotation at a constant rate below 2 °/s is not detected. Motion below the noise is not detected either.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats, Ints, SampleBlock, make_block
from monitor.common.units import format_axis_value
from monitor.estimation.detection.motion_kernel import (
    AXIS,
    BEGAN,
    CHANGED,
    FIRST,
    LAST,
    PEAK,
    REMOVED_AFTER,
    advance,
    make_state,
)

BLOCK_S: Final = 0.25
"""Length of a block in seconds."""
MIN_BLOCK_SAMPLES: Final = 8
"""Minimum number of samples in a block. With fewer samples, the variance is too uncertain."""
MAX_KNOCK_BLOCKS: Final = 2
"""Largest number of moving blocks of a knock, if the orientation of the sensor did not change."""

Kind = Literal["knock", "motion", "handling/orientation"]


@dataclass(frozen=True, slots=True)
class Motion:
    """One episode of motion."""

    kind: Kind
    since: int  # index of the first removed sample, including missing samples
    until: int  # index after the last removed sample
    seconds: float  # duration of the motion, without the additional blocks before and after
    axis: str  # axis with the largest excursion relative to the noise
    peak: float  # excursion from the mean at rest, rad/s or m/s²
    text: str  # description for users


class MotionDetector:
    """Motion detector that removes the samples in motion from a stream.

    Parameters
    ----------
    rate_hz : float
        Sample rate in Hz.

    >>> rest = MotionDetector(100.0)
    >>> still = np.random.default_rng(0).normal(0.0, 1e-3, (2000, 6))
    >>> still[1000:1200, 0] += np.sin(np.arange(200) / 20)
    >>> out = rest.advance_and_take_decided(make_block(np.arange(2000), still)) + rest.flush()
    >>> [motion.text for motion in rest.take()]
    ['moved for 2.0 s: gx up to 57 °/s']
    >>> rest.moved_samples, sum(int(np.isnan(one.values[:, 0]).sum()) for one in out)
    (275, 275)
    """

    def __init__(self, rate_hz: float) -> None:
        self.moved_samples = 0
        self.episodes = 0
        self._rate_hz = rate_hz
        self._size = block_size(rate_hz)
        self._state = make_state()
        self._held: deque[tuple[int, SampleBlock]] = deque()  # blocks with the index of their first row
        self._index = 0  # index of the next sample
        self._motions: list[Motion] = []

    @property
    def moving(self) -> bool:
        """True if the newest decided block belongs to an episode of motion."""
        return bool(self._state.place[BEGAN] >= 0)

    def advance_and_take_decided(self, samples: SampleBlock) -> list[SampleBlock]:
        """Process a block, and return the samples for which motion has been decided, oldest first."""
        first = self._index + samples.lost
        self._held.append((first, samples))
        self._index = first + len(samples)
        blocks, moving, episodes = _allocate_output(len(samples), self._size)
        filled = advance(samples.values, first, self._size, False, self._state, blocks, moving, episodes)
        return self._release(blocks[: filled[0]], moving[: filled[0]], episodes[: filled[1]])

    def flush(self) -> list[SampleBlock]:
        """Return the delayed samples and end the current episode, because the stream has ended."""
        blocks, moving, episodes = _allocate_output(0, self._size)
        filled = advance(
            _read_only(np.empty((0, len(AXES)))), 0, self._size, True, self._state, blocks, moving, episodes
        )
        return self._release(blocks[: filled[0]], moving[: filled[0]], episodes[: filled[1]])

    def take(self) -> list[Motion]:
        """Return the episodes that ended since the last call."""
        motions, self._motions = self._motions, []
        return motions

    def _release(self, blocks: Ints, moving: Ints, episodes: Floats) -> list[SampleBlock]:
        """Store the finished episodes, and return the samples of the blocks for which motion has been decided."""
        motions = [_make_motion(episode, self._size, self._rate_hz) for episode in episodes]
        self._motions += motions
        self.episodes += len(motions)
        out: list[SampleBlock] = []
        end = (int(blocks[-1]) + 1) * self._size if blocks.size else 0
        while self._held and self._held[0][0] < end:
            first, samples = self._held.popleft()
            if first + len(samples) > end:
                self._held.appendleft((end, samples[end - first :]))
                samples = samples[: end - first]
            rows = (first + np.arange(len(samples))) // self._size
            struck = moving[np.searchsorted(blocks, rows)].astype(bool)
            self.moved_samples += int(struck.sum())
            out.append(_remove_moving(samples, struck))
        return out


def detect_motion(values: Floats, rate_hz: float) -> tuple[NDArray[np.bool_], list[Motion]]:
    """Find motion in a whole recording on a regular grid.

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
    motions : list of Motion
        Episodes of motion.
    """
    size = block_size(rate_hz)
    kernel_state = make_state()
    blocks, moving, episodes = _allocate_output(len(values), size)
    verdicts, stretches = advance(_read_only(values), 0, size, True, kernel_state, blocks, moving, episodes)
    mask = np.repeat(moving[:verdicts].astype(bool), size)[: len(values)]
    return mask, [_make_motion(episode, size, rate_hz) for episode in episodes[:stretches]]


def block_size(rate_hz: float) -> int:
    """Return the number of samples in a block."""
    return max(round(BLOCK_S * rate_hz), MIN_BLOCK_SAMPLES)


def _read_only(values: Floats) -> Floats:
    """Return the samples as a contiguous read-only array, like those of a ``SampleBlock``.

    Numba compiles a kernel again for each memory layout and access flag.
    """
    view = np.ascontiguousarray(values, np.float64).view()
    view.flags.writeable = False
    return view


def _allocate_output(rows: int, size: int) -> tuple[Ints, Ints, Floats]:
    """Allocate the output arrays of the kernel."""
    n = rows // size + 4
    return np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros((n, 5))


def _remove_moving(samples: SampleBlock, struck: NDArray[np.bool_]) -> SampleBlock:
    """Replace the samples in motion by NaN."""
    if not struck.any():
        return samples
    values = np.where(struck[:, None], np.nan, samples.values)
    return make_block(samples.t_ns, values, samples.temperature_c, samples.ticks, samples.lost)


def _make_motion(episode: Floats, size: int, rate_hz: float) -> Motion:
    """Convert a row of the kernel's output to a ``Motion``."""
    first, last = int(episode[FIRST]), int(episode[LAST])
    axis, peak = AXES[int(episode[AXIS])], float(episode[PEAK])
    moving = last - first + 1
    seconds = moving * size / rate_hz
    kind: Kind = "handling/orientation" if episode[CHANGED] else "knock" if moving <= MAX_KNOCK_BLOCKS else "motion"
    size_text = f"{axis} up to {format_axis_value(axis, peak)}"
    verb = {"knock": "knocked", "motion": "moved", "handling/orientation": "handled, and left in another orientation,"}
    text = f"{verb[kind]} for {seconds:.1f} s: {size_text}"
    if kind == "knock":
        text = f"knocked: {size_text}"
    return Motion(kind, max(first - 1, 0) * size, (last + 1 + REMOVED_AFTER) * size, seconds, axis, peak, text)
