"""Latency from the arrival of samples to the publication of results."""

import time

import numpy as np


class LatencyMeter:
    """Meter of the latency from the arrival of samples to the publication of results.

    The reader thread calls ``note_samples_arrived``, and the main loop calls the other methods.
    """

    def __init__(self) -> None:
        self._arrived_ns = 0  # arrival of the oldest sample in the ring buffer; 0 if the buffer is empty
        self._taken_ns = 0  # arrival of the oldest unpublished sample that was taken; 0 if there is none
        self._latencies_s: list[float] = []

    def note_samples_arrived(self) -> None:
        """Record the time at which samples arrive in the ring buffer."""
        self._arrived_ns = self._arrived_ns or time.monotonic_ns()

    def note_ring_buffer_emptied(self) -> None:
        """Record that all samples have been taken from the ring buffer."""
        arrived_ns, self._arrived_ns = self._arrived_ns, 0
        self._taken_ns = self._taken_ns or arrived_ns

    def note_publication(self) -> None:
        """Record the latency of the results that have just been published."""
        if self._taken_ns:
            self._latencies_s.append((time.monotonic_ns() - self._taken_ns) / 1e9)
            self._taken_ns = 0

    def take_latency_quantiles(self) -> tuple[float | None, float | None]:
        """Return the median and the 99 % quantile of the latency since the last call, in seconds or None."""
        latencies_s, self._latencies_s = self._latencies_s, []
        if not latencies_s:
            return None, None
        median, high = np.quantile(latencies_s, [0.5, 0.99]).tolist()
        return median, high
