"""Conversion of time stamps of the kernel to arrival times on the monotonic clock."""

import time
from typing import Final

TOLERANCE_NS: Final = 1_000_000_000
"""Time in ns by which a time stamp may precede the time at which the link was empty."""
CLOCK_PAIRS: Final = 3
"""Number of times that the Unix clock and the monotonic clock are read. The fastest reading is used."""


def monotonic_arrival_ns(unix_ns: int, empty_ns: int) -> int:
    """Return the monotonic arrival time of data with a Unix time stamp, or the current time if the stamp is unusable.

    A stamp in the future, or from before the link was last empty, shows that the Unix clock was set. Such a stamp is
    unusable.

    Parameters
    ----------
    unix_ns
        Unix time stamp in ns from the clock of this computer.
    empty_ns
        Monotonic time in ns at which the link last held no unread data.
    """
    now_ns = time.monotonic_ns()
    arrival_ns = unix_ns - _unix_minus_monotonic_ns()
    return arrival_ns if empty_ns - TOLERANCE_NS <= arrival_ns <= now_ns else now_ns


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
