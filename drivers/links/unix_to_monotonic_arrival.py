"""Conversion of time stamps of the kernel to arrival times on the monotonic clock."""

import time
from typing import Final

MAX_AGE_S: Final = 1.0
"""Largest age in s of received data. A time stamp with a larger or negative age is ignored."""
CLOCK_PAIRS: Final = 3
"""Number of times that the Unix clock and the monotonic clock are read. The fastest reading is used."""


def monotonic_arrival_ns(unix_ns: int) -> int:
    """Return the monotonic arrival time of data with a Unix time stamp, or the current time if the stamp is unusable.

    Both times are in ns. The stamp must come from the clock of this computer.
    """
    now_ns = time.monotonic_ns()
    age_ns = now_ns + _unix_minus_monotonic_ns() - unix_ns
    return now_ns - age_ns if 0 <= age_ns <= MAX_AGE_S * 1e9 else now_ns


def _unix_minus_monotonic_ns() -> int:
    """Return Unix time minus monotonic time in ns.

    Both clocks are read several times, because the thread may be interrupted between two readings. The fastest pair of
    readings is used.
    """
    pairs = []
    for _ in range(CLOCK_PAIRS):
        before_ns, unix_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        pairs.append((after_ns - before_ns, unix_ns - (before_ns + after_ns) // 2))
    return min(pairs)[1]
