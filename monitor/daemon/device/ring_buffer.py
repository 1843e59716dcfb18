"""Ring buffer for samples between the reader thread and the worker of a device.

The writer never waits, and a full buffer overwrites the oldest samples. ``RingBuffer.overflowed`` counts the
overwritten samples. The field ``lost`` of the next block also includes the overwritten samples.
"""

import threading
from dataclasses import replace
from itertools import pairwise

import numpy as np

from drivers.data_types import SampleBlock, make_block


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
        self._t_ns = np.zeros(capacity, np.int64)
        self._values = np.zeros((capacity, 6))
        self._temperature_c = np.zeros(capacity)
        self._ticks = np.zeros(capacity, np.int64)
        self._lost = np.zeros(capacity, np.int64)  # number of missing samples just before each sample
        self._read = self._written = 0  # samples read and written since the start
        self._lock = threading.Lock()

    @property
    def is_empty(self) -> bool:
        """True if the buffer contains no samples."""
        return self._read == self._written

    @property
    def free_capacity(self) -> int:
        """Number of samples that can be added without overwriting older samples."""
        return self.capacity - (self._written - self._read)

    def push_samples(self, samples: SampleBlock) -> None:
        """Add samples, and overwrite the oldest samples if the buffer is full."""
        with self._lock:
            for start in range(0, len(samples), self.capacity):
                self._write(samples[start : start + self.capacity])

    def take_samples(self) -> list[SampleBlock]:
        """Remove and return all samples, split into blocks at missing samples."""
        with self._lock:
            n = self._written - self._read
            if n == 0:
                return []
            at = np.arange(self._read, self._written) % self.capacity
            self._read = self._written
            taken = make_block(self._t_ns[at], self._values[at], self._temperature_c[at], self._ticks[at])
            lost = self._lost[at]
        edges = [0, *(np.flatnonzero(lost[1:]) + 1).tolist(), n]
        return [replace(taken[a:b], lost=int(lost[a])) for a, b in pairwise(edges)]

    def _write(self, samples: SampleBlock) -> None:
        n = len(samples)
        overwritten = max(0, self._written + n - self._read - self.capacity)
        if overwritten:
            gone = np.arange(self._read, self._read + overwritten) % self.capacity
            missing = overwritten + int(self._lost[gone].sum())
            self._read += overwritten
            self.overflowed += overwritten
        at = np.arange(self._written, self._written + n) % self.capacity
        self._t_ns[at] = samples.t_ns
        self._values[at] = samples.values
        self._temperature_c[at] = samples.temperature_c
        self._ticks[at] = samples.ticks
        self._lost[at] = 0
        self._lost[at[0]] = samples.lost
        self._written += n
        if overwritten:
            self._lost[self._read % self.capacity] += missing
