"""Ring buffer for samples between the reader thread and the worker of a device.

The writer never waits, and a full buffer overwrites the oldest samples. ``RingBuffer.overflowed`` counts the
overwritten samples. The field ``lost`` of the next block also includes the overwritten samples.
"""

import threading
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
        self._columns = (self._t_ns, self._values, self._temperature_c, self._ticks, self._lost)
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
            parts = self._contiguous_rows(self._read, n)
            self._read = self._written
            t_ns, values, temperature_c, ticks, lost = (
                np.concatenate([column[rows] for rows in parts]) for column in self._columns
            )
        edges = [0, *(np.flatnonzero(lost[1:]) + 1).tolist(), n]
        return [
            make_block(t_ns[a:b], values[a:b], temperature_c[a:b], ticks[a:b], int(lost[a])) for a, b in pairwise(edges)
        ]

    def _contiguous_rows(self, first: int, n: int) -> list[slice]:
        """Return the rows of n samples as one range, or as two ranges if the samples reach the end of the buffer."""
        start = first % self.capacity
        end = start + n
        if end <= self.capacity:
            return [slice(start, end)]
        return [slice(start, self.capacity), slice(0, end - self.capacity)]

    def _write(self, samples: SampleBlock) -> None:
        n = len(samples)
        overwritten = max(0, self._written + n - self._read - self.capacity)
        if overwritten:
            gone = np.arange(self._read, self._read + overwritten) % self.capacity
            missing = overwritten + int(self._lost[gone].sum())
            self._read += overwritten
            self.overflowed += overwritten
        done = 0
        for rows in self._contiguous_rows(self._written, n):
            part = slice(done, done + rows.stop - rows.start)
            self._t_ns[rows] = samples.t_ns[part]
            self._values[rows] = samples.values[part]
            self._temperature_c[rows] = samples.temperature_c[part]
            self._ticks[rows] = samples.ticks[part]
            self._lost[rows] = 0
            done = part.stop
        self._lost[self._written % self.capacity] = samples.lost
        self._written += n
        if overwritten:
            self._lost[self._read % self.capacity] += missing
