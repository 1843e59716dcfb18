"""Unix time of samples: the host clock read once, carried on by the monotonic clock, eased back if the host is set.

A host clock that NTP or an operator sets must not tear a hole into a recording. A difference is therefore taken out
at a rate of at most EASE. The offset between the two clocks is a continuous, piecewise linear function of the monotonic
time with slopes of at most EASE. So Unix times increase from sample to sample, whenever and in whatever order they are
asked for.
"""

from typing import Final

import numpy as np

from drivers.sample import Ints

EASE: Final = 5e-4
"""A correction runs at no more than 0.5 ms a second."""
MAX_KNOTS: Final = 100
"""Number of corrections that are kept. With one per second, they cover the samples of the last minute."""


class WallClock:
    """Monotonic nanoseconds -> Unix nanoseconds.

    Parameters
    ----------
    monotonic_ns, unix_ns
        Both clocks at the same moment.

    Examples
    --------
    >>> wall = WallClock(monotonic_ns=5_000_000_000, unix_ns=1_700_000_000_000_000_000)
    >>> wall.unix_ns(6_000_000_000)
    1700000001000000000
    >>> wall.follow(6_000_000_000, 1_700_000_003_000_000_000)   # the host was set on by two seconds
    2000000000
    >>> wall.unix_ns(7_000_000_000)
    1700000002000500000
    """

    def __init__(self, monotonic_ns: int, unix_ns: int) -> None:
        self._host_ns = unix_ns - monotonic_ns  # offset of the host's clock, when it was last followed
        self._followed_ns = monotonic_ns
        # [n, 3] where each correction begins, the offset there, and what is still to be corrected from there on;
        # replaced as a whole, as threads of readers use it too
        self._knots: Ints = np.array([[monotonic_ns, self._host_ns, 0]], np.int64)

    @property
    def behind_ns(self) -> int:
        """How far the host's clock is ahead of these times."""
        return self._host_ns - self.offset_ns(self._followed_ns)

    def follow(self, monotonic_ns: int, unix_ns: int) -> int:
        """Ease towards the host's clock from now on; to be called about once a second.

        Returns
        -------
        int
            Step of the host's clock since the last call, in nanoseconds.
        """
        before_ns, self._host_ns = self._host_ns, unix_ns - monotonic_ns
        begun_ns, offset_ns, correction_ns = self._knots[-1].tolist()
        self._followed_ns = max(monotonic_ns, begun_ns)
        if offset_ns + correction_ns != self._host_ns:
            now_ns = self.offset_ns(self._followed_ns)
            knot = np.array([[self._followed_ns, now_ns, self._host_ns - now_ns]], np.int64)
            kept = self._knots[:-1] if self._followed_ns == begun_ns else self._knots
            self._knots = np.concatenate([kept[1 - MAX_KNOTS :], knot])
        return self._host_ns - before_ns

    def offset_ns(self, monotonic_ns: int) -> int:
        """Return Unix time less monotonic time at a monotonic time."""
        return int(self.offsets_ns(np.array([monotonic_ns], np.int64))[0])

    def offsets_ns(self, monotonic_ns: Ints) -> Ints:
        """Return Unix time less monotonic time at each of the monotonic times [n]."""
        knots = self._knots
        begun_ns, offset_ns, correction_ns = knots[np.searchsorted(knots[1:, 0], monotonic_ns, side="right")].T
        most_ns = (EASE * np.maximum(monotonic_ns - begun_ns, 0)).astype(np.int64)
        offsets: Ints = offset_ns + np.clip(correction_ns, -most_ns, most_ns)
        return offsets

    def unix_ns(self, monotonic_ns: int) -> int:
        """Unix time of a monotonic time."""
        return monotonic_ns + self.offset_ns(monotonic_ns)
