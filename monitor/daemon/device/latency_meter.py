"""Time from the reception of samples to the publication of the results that contain them."""

import time

import numpy as np


class LatencyMeter:
    """Latency of the published results of one device.

    ``note_samples_arrived`` is called by the reader thread, and all other methods are called by the main loop.
    """

    def __init__(self) -> None:
        self._arrived_ns = 0  # arrival of the oldest sample in the ring buffer; 0 if the buffer is empty
        self._taken_ns = 0  # arrival of the oldest sample that was taken and not published; 0 if there is none
        self._latencies_s: list[float] = []

    def note_samples_arrived(self) -> None:
        """Note that samples have been put into the ring buffer."""
        self._arrived_ns = self._arrived_ns or time.monotonic_ns()

    def note_samples_taken(self) -> None:
        """Note that all samples have been taken from the ring buffer."""
        arrived_ns, self._arrived_ns = self._arrived_ns, 0
        self._taken_ns = self._taken_ns or arrived_ns

    def note_publication(self) -> None:
        """Note that results with all taken samples have been published."""
        if self._taken_ns:
            self._latencies_s.append((time.monotonic_ns() - self._taken_ns) / 1e9)
            self._taken_ns = 0

    def take_quantiles(self) -> tuple[float | None, float | None]:
        """Return the median and the 99 % quantile in seconds since the last call; None without a publication."""
        latencies_s, self._latencies_s = self._latencies_s, []
        if not latencies_s:
            return None, None
        median, high = np.quantile(latencies_s, [0.5, 0.99]).tolist()
        return median, high
