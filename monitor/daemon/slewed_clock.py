"""Unix time of samples: the host clock read once, carried on by the monotonic clock, eased back if the host is set.

A host clock that NTP or an operator sets must not tear a hole into a recording, so a difference is taken out by at
most EASE of the time that passes.
"""

from typing import Final

EASE: Final = 5e-4
"""A correction runs at no more than 0.5 ms a second."""


class WallClock:
    """Monotonic nanoseconds -> Unix nanoseconds.

    >>> wall = WallClock(monotonic_ns=5_000_000_000, unix_ns=1_700_000_000_000_000_000)
    >>> wall.unix_ns(6_000_000_000)
    1700000001000000000
    >>> wall.follow(6_000_000_000, 1_700_000_003_000_000_000)   # the host was set on by two seconds
    2000000000
    >>> wall.unix_ns(6_000_000_000)
    1700000001000500000
    """

    def __init__(self, monotonic_ns: int, unix_ns: int) -> None:
        self.offset_ns = unix_ns - monotonic_ns
        self._host_ns = self.offset_ns  # the host's, when it was last followed
        self._followed_ns = monotonic_ns

    @property
    def behind_ns(self) -> int:
        """How far the host's clock is ahead of these times."""
        return self._host_ns - self.offset_ns

    def follow(self, monotonic_ns: int, unix_ns: int) -> int:
        """Ease towards the host's clock; to be called about once a second. By how much that was set since [ns]."""
        most = int(EASE * max(monotonic_ns - self._followed_ns, 0))
        before_ns, self._host_ns = self._host_ns, unix_ns - monotonic_ns
        self.offset_ns += max(-most, min(most, self.behind_ns))
        self._followed_ns = monotonic_ns
        return self._host_ns - before_ns

    def unix_ns(self, monotonic_ns: int) -> int:
        """Unix time of a monotonic time."""
        return monotonic_ns + self.offset_ns
