"""At rest or not: motion, knocks and handling of the sensor are recognised, counted, and struck out of its samples.

Comes in: samples in order. Goes out: the same samples, those of moving stretches NaN in their places, so that every
statistic behind treats them as missing; and a ``Motion`` for each stretch. No noise figure is configured: what is usual
at rest is learned from the samples, axis by axis, and followed (``rest_kernel`` has the method). A moving stretch is
struck out from one block before its first moving block to two after its last.

Samples are held back until the block after theirs is judged: by two blocks, 0.5 s, or 16 samples of a sensor
slower than 32 Hz. What persists steadily for 60 s is rest from then on and left to the detector of changes. A first
reference takes eight blocks; until it stands, only what no MEMS sensor shows at rest is called motion.

Not found: rotation at a constant rate below 2 °/s, and motion that hides in the noise.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from drivers.sample import AXES, Floats, Ints, SampleBlock, block
from monitor.common.rates import amount
from monitor.estimation.detection.motion_kernel import AFTER, AXIS, BEGAN, CHANGED, FIRST, LAST, PEAK, advance, state

BLOCK_S: Final = 0.25
FEWEST: Final = 8
"""Samples a block at the least: with fewer its variance says nothing."""
KNOCK_BLOCKS: Final = 2
"""A stretch of so many moving blocks, with the sensor left as it lay, is a knock."""

Kind = Literal["knock", "motion", "handling/orientation"]


@dataclass(frozen=True, slots=True)
class Motion:
    """One moving stretch."""

    kind: Kind
    since: int  # index of the first sample struck out, missing ones counted
    until: int  # index after the last
    seconds: float  # moving, without what is struck out before and after
    axis: str  # where the excursion is largest against the noise
    peak: float  # the excursion from the mean at rest, rad/s or m/s²
    text: str


class Rest:
    """Finds and strikes out the moving stretches of a stream of samples.

    Args:
        rate_hz: samples a second

    >>> rest = Rest(100.0)
    >>> still = np.random.default_rng(0).normal(0.0, 1e-3, (2000, 6))
    >>> still[1000:1200, 0] += np.sin(np.arange(200) / 20)
    >>> out = rest.update(block(np.arange(2000), still)) + rest.flush()
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
        self._state = state()
        self._held: deque[tuple[int, SampleBlock]] = deque()  # with the index of their first rows
        self._index = 0  # of the next sample
        self._motions: list[Motion] = []

    @property
    def moving(self) -> bool:
        """Whether the newest judged block belongs to a moving stretch."""
        return bool(self._state.place[BEGAN] >= 0)

    @property
    def held_back_s(self) -> float:
        """Longest delay of a sample, s."""
        return 2 * self._size / self._rate_hz

    def update(self, samples: SampleBlock) -> list[SampleBlock]:
        """The samples that have become final, oldest first."""
        first = self._index + samples.lost
        self._held.append((first, samples))
        self._index = first + len(samples)
        blocks, moving, episodes = _room(len(samples), self._size)
        filled = advance(samples.values, first, self._size, False, self._state, blocks, moving, episodes)
        return self._let_go(blocks[: filled[0]], moving[: filled[0]], episodes[: filled[1]])

    def flush(self) -> list[SampleBlock]:
        """What is held back, judged as if the stream ended here; an open stretch ends too."""
        blocks, moving, episodes = _room(0, self._size)
        filled = advance(
            _read_only(np.empty((0, len(AXES)))), 0, self._size, True, self._state, blocks, moving, episodes
        )
        return self._let_go(blocks[: filled[0]], moving[: filled[0]], episodes[: filled[1]])

    def take(self) -> list[Motion]:
        """Stretches that ended since the last call."""
        motions, self._motions = self._motions, []
        return motions

    def _let_go(self, blocks: Ints, moving: Ints, episodes: Floats) -> list[SampleBlock]:
        motions = [_motion(episode, self._size, self._rate_hz) for episode in episodes]
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
            out.append(_strike(samples, struck))
        return out


def find(values: Floats, rate_hz: float) -> tuple[NDArray[np.bool_], list[Motion]]:
    """Moving samples [n] of a whole recording [n, 6] on its grid (NaN = missing), and the stretches they form."""
    size = block_size(rate_hz)
    known = state()
    blocks, moving, episodes = _room(len(values), size)
    verdicts, stretches = advance(_read_only(values), 0, size, True, known, blocks, moving, episodes)
    mask = np.repeat(moving[:verdicts].astype(bool), size)[: len(values)]
    return mask, [_motion(episode, size, rate_hz) for episode in episodes[:stretches]]


def block_size(rate_hz: float) -> int:
    """Samples of a block."""
    return max(round(BLOCK_S * rate_hz), FEWEST)


def _read_only(values: Floats) -> Floats:
    """Return the samples as those of a ``SampleBlock`` are: other layouts and access flags would be compiled anew."""
    view = np.ascontiguousarray(values, np.float64).view()
    view.flags.writeable = False
    return view


def _room(rows: int, size: int) -> tuple[Ints, Ints, Floats]:
    n = rows // size + 4
    return np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros((n, 5))


def _strike(samples: SampleBlock, struck: NDArray[np.bool_]) -> SampleBlock:
    if not struck.any():
        return samples
    values = np.where(struck[:, None], np.nan, samples.values)
    return block(samples.t_ns, values, samples.temperature_c, samples.ticks, samples.lost)


def _motion(episode: Floats, size: int, rate_hz: float) -> Motion:
    first, last = int(episode[FIRST]), int(episode[LAST])
    axis, peak = AXES[int(episode[AXIS])], float(episode[PEAK])
    moving = last - first + 1
    seconds = moving * size / rate_hz
    kind: Kind = "handling/orientation" if episode[CHANGED] else "knock" if moving <= KNOCK_BLOCKS else "motion"
    size_text = f"{axis} up to {amount(axis, peak)}"
    verb = {"knock": "knocked", "motion": "moved", "handling/orientation": "handled, and left in another orientation,"}
    text = f"{verb[kind]} for {seconds:.1f} s: {size_text}"
    if kind == "knock":
        text = f"knocked: {size_text}"
    return Motion(kind, max(first - 1, 0) * size, (last + 1 + AFTER) * size, seconds, axis, peak, text)
