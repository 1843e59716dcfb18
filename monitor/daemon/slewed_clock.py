"""Unix time of samples, from the monotonic clock, slewed towards the host clock.

If the host clock is set, the Unix time of the samples approaches the host clock gradually. The slope of the correction
is at most MAX_SLEW_RATE, so the Unix times increase from sample to sample.
"""

from typing import Final

import numpy as np

from drivers.data_types import Ints

MAX_SLEW_RATE: Final = 5e-4
"""Maximum rate of a correction, which is 0.5 ms per second."""
MAX_KNOTS: Final = 100
"""Number of stored corrections. Samples of the last minute can be converted with one correction per second."""


class SlewedClock:
    """Clock that converts monotonic time to slewed Unix time, in nanoseconds.

    Parameters
    ----------
    monotonic_ns, unix_ns : int
        Monotonic time and Unix time of the same moment.

    Examples
    --------
    >>> clock = SlewedClock(monotonic_ns=5_000_000_000, unix_ns=1_700_000_000_000_000_000)
    >>> clock.to_unix_ns(6_000_000_000)
    1700000001000000000
    >>> clock.slew_and_return_host_step(6_000_000_000, 1_700_000_003_000_000_000)  # set forward by 2 s
    2000000000
    >>> clock.to_unix_ns(7_000_000_000)
    1700000002000500000
    """

    def __init__(self, monotonic_ns: int, unix_ns: int) -> None:
        self._host_ns = unix_ns - monotonic_ns  # latest offset of the host clock
        self._slewed_at_ns = monotonic_ns
        # [n, 3] start, initial offset and remaining correction of each slew; replaced as a whole for the reader threads
        self._knots: Ints = np.array([[monotonic_ns, self._host_ns, 0]], np.int64)
        self._newest_knot = (monotonic_ns, self._host_ns, 0)

    @property
    def lag_behind_host_ns(self) -> int:
        """Time in nanoseconds by which the slewed Unix time lags behind the host clock."""
        return self._host_ns - self.unix_offset_ns(self._slewed_at_ns)

    def slew_and_return_host_step(self, monotonic_ns: int, unix_ns: int) -> int:
        """Start to slew towards the host clock, and return the last step of the host clock.

        Returns
        -------
        int
            Step of the host clock since the last call, in nanoseconds.
        """
        before_ns, self._host_ns = self._host_ns, unix_ns - monotonic_ns
        begun_ns, offset_ns, correction_ns = self._newest_knot
        self._slewed_at_ns = max(monotonic_ns, begun_ns)
        if offset_ns + correction_ns != self._host_ns:
            now_ns = self.unix_offset_ns(self._slewed_at_ns)
            knot = (self._slewed_at_ns, now_ns, self._host_ns - now_ns)
            kept = self._knots[:-1] if self._slewed_at_ns == begun_ns else self._knots
            self._knots = np.concatenate([kept[1 - MAX_KNOTS :], np.array([knot], np.int64)])
            self._newest_knot = knot
        return self._host_ns - before_ns

    def unix_offset_ns(self, monotonic_ns: int) -> int:
        """Return the offset from a monotonic time to the Unix time, in nanoseconds."""
        offset_ns = self._offset_after_correction_ns(monotonic_ns)
        if offset_ns is None:
            return int(self._slewed_offsets_ns(np.array([monotonic_ns], np.int64))[0])
        return offset_ns

    def unix_offsets_ns(self, monotonic_ns: Ints) -> Ints | int:
        """Return the offsets [n] from increasing monotonic times to Unix times in nanoseconds, or one common offset."""
        offset_ns = self._offset_after_correction_ns(int(monotonic_ns[0]))
        return self._slewed_offsets_ns(monotonic_ns) if offset_ns is None else offset_ns

    def _offset_after_correction_ns(self, first_ns: int) -> int | None:
        """Return the offset of all times from ``first_ns``, or None if the newest correction has not ended by then."""
        begun_ns, offset_ns, correction_ns = self._newest_knot
        ended = MAX_SLEW_RATE * (first_ns - begun_ns) >= abs(correction_ns) + 1
        return offset_ns + correction_ns if ended else None

    def _slewed_offsets_ns(self, monotonic_ns: Ints) -> Ints:
        knots = self._knots
        begun_ns, offset_ns, correction_ns = knots[np.searchsorted(knots[1:, 0], monotonic_ns, side="right")].T
        most_ns = (MAX_SLEW_RATE * np.maximum(monotonic_ns - begun_ns, 0)).astype(np.int64)
        offsets: Ints = offset_ns + np.clip(correction_ns, -most_ns, most_ns)
        return offsets

    def to_unix_ns(self, monotonic_ns: int) -> int:
        """Convert a monotonic time to Unix time, in nanoseconds."""
        return monotonic_ns + self.unix_offset_ns(monotonic_ns)
