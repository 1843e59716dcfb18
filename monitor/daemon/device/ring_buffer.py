"""Ring buffer for samples between the reader thread and the worker of a device.

The writer never waits, and a full buffer overwrites the oldest samples. ``RingBuffer.overflowed`` counts the
overwritten samples. The field ``lost`` of the next block also includes the overwritten samples.
"""

import threading
from collections import deque
from dataclasses import replace
from typing import Final

from drivers.data_types import SampleBlock, concatenate_blocks, merge_contiguous_blocks

MIN_BLOCK_SAMPLES: Final = 256
"""Number of samples below which waiting blocks are merged, because each block needs a kilobyte of memory."""


class RingBuffer:
    """Ring buffer for samples, with one writer and one reader.

    Parameters
    ----------
    capacity : int
        Maximum number of samples in the buffer.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.overflowed = 0  # samples overwritten since the start
        self._blocks: deque[SampleBlock] = deque()
        self._waiting = 0  # number of samples in the buffer
        self._lock = threading.Lock()

    @property
    def is_empty(self) -> bool:
        """True if the buffer contains no samples."""
        return self._waiting == 0

    @property
    def free_capacity(self) -> int:
        """Number of samples that can be added without overwriting older samples."""
        return self.capacity - self._waiting

    def push_samples(self, samples: SampleBlock) -> None:
        """Add samples, and overwrite the oldest samples if the buffer is full."""
        with self._lock:
            self._waiting += len(samples)
            if self._blocks and len(self._blocks[-1]) < MIN_BLOCK_SAMPLES and not samples.lost:
                samples = concatenate_blocks([self._blocks.pop(), samples])
            self._blocks.append(samples)
            if self._waiting > self.capacity:
                self._overwrite_oldest(self._waiting - self.capacity)

    def take_samples(self) -> list[SampleBlock]:
        """Remove and return all samples, split into blocks at missing samples."""
        with self._lock:
            blocks = list(self._blocks)
            self._blocks.clear()
            self._waiting = 0
        return merge_contiguous_blocks(blocks)

    def _overwrite_oldest(self, n: int) -> None:
        self._waiting -= n
        self.overflowed += n
        missing = 0
        while n > 0:
            oldest = self._blocks.popleft()
            overwritten = min(n, len(oldest))
            n -= overwritten
            missing += oldest.lost + overwritten
            if overwritten < len(oldest):
                self._blocks.appendleft(oldest[overwritten:])
        oldest = self._blocks.popleft()
        self._blocks.appendleft(replace(oldest, lost=oldest.lost + missing))
