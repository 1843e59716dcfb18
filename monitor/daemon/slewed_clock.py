"""Unix time of samples from the monotonic clock, slewed when the host clock is set.

The host clock is read once, and the monotonic clock carries its time on. When NTP or an operator sets the host clock,
the recording must not get a gap. Therefore the difference is removed slowly, by at most EASE of the elapsed time.
"""

from typing import Final

EASE: Final = 5e-4
"""Largest slew rate: a correction of 0.5 ms per second."""


class WallClock:
    """Conversion from monotonic nanoseconds to Unix nanoseconds, with slewing.

    Parameters
    ----------
    monotonic_ns : int
        Present time of the monotonic clock.
    unix_ns : int
        Present Unix time of the host clock.

    Examples
    --------
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
        self._host_ns = self.offset_ns  # offset of the host clock at the last call of ``follow``
        self._followed_ns = monotonic_ns

    @property
    def behind_ns(self) -> int:
        """Offset of the host clock from these times, in nanoseconds; positive if the host clock is ahead."""
        return self._host_ns - self.offset_ns

    def follow(self, monotonic_ns: int, unix_ns: int) -> int:
        """Slew towards the host clock, and return the step of the host clock since the last call, in nanoseconds.

        This method should be called about once a second.

        Parameters
        ----------
        monotonic_ns : int
            Present time of the monotonic clock.
        unix_ns : int
            Present Unix time of the host clock.
        """
        most = int(EASE * max(monotonic_ns - self._followed_ns, 0))
        before_ns, self._host_ns = self._host_ns, unix_ns - monotonic_ns
        self.offset_ns += max(-most, min(most, self.behind_ns))
        self._followed_ns = monotonic_ns
        return self._host_ns - before_ns

    def unix_ns(self, monotonic_ns: int) -> int:
        """Return the Unix time of a monotonic time, in nanoseconds."""
        return monotonic_ns + self.offset_ns
