"""A ``SampleClock`` under watch: what must hold of the times it gives and of what it calls missing."""

from drivers.data_types import SampleBlock, SenderTimedFormat, Timing
from drivers.timing.arrival_timeline import JUMP_S
from drivers.timing.sample_clock import SampleClock
from tests.experiments.fuzz.checks import LARGEST_LOSS

FASTEST_HZ = 32_000.0
"""No inertial sensor is read faster: more samples than this cannot be missing in the time that passed."""


class Stamped:
    """Stamps blocks, and checks each result."""

    def __init__(self, timing: Timing, rate_hz: float | None) -> None:
        self.clock = SampleClock(timing, rate_hz)
        self._given = isinstance(timing, SenderTimedFormat)
        self._rows = self._passed = 0
        self._told = self._missing = 0  # by the decoder; by the clock
        self._first_ns: int | None = None
        self._newest_ns = -(1 << 63)
        self._last_ns = -(1 << 63)

    def put(self, block: SampleBlock) -> list[SampleBlock]:
        """The stamped samples."""
        out = self.clock.assign_times(block)
        self._rows += len(block)
        self._told += block.lost
        first, newest = int(block.t_ns.min()), int(block.t_ns.max())
        self._first_ns = first if self._first_ns is None else min(first, self._first_ns)
        self._newest_ns = max(newest, self._newest_ns)
        for one in out:
            assert 0 <= one.lost <= LARGEST_LOSS + self._told, one.lost
            self._passed += len(one)
            self._missing += one.lost
            self._times(block, one)
        kept_out = self.clock.dropped_repeated_rows + self.clock.dropped_late_rows
        assert self._passed + kept_out == self._rows, "a row is gone, or came twice"
        self._missing_is_possible()
        rate = self.clock.configured_or_measured_rate_hz
        assert rate is None or 0.0 < rate < float("inf"), rate
        for event in self.clock.take_events():
            assert event.text
            assert "\n" not in event.text
        return out

    def _times(self, block: SampleBlock, one: SampleBlock) -> None:
        times = one.t_ns.tolist()
        if self._given:
            assert set(times) <= set(block.t_ns.tolist()), "a given time was changed"
            return
        assert all(a < b for a, b in zip([self._last_ns, *times], times, strict=False)), "times go back"
        self._last_ns = times[-1]
        newest_ns = self._newest_ns + round(JUMP_S * 1e9) + self._rows
        assert times[-1] <= newest_ns + 1000, "a sample is newer than its arrival"

    def _missing_is_possible(self) -> None:
        assert self._missing <= self._told + LARGEST_LOSS * 1000
        if self._given:
            return
        passed_s = (self._newest_ns - (self._first_ns or 0)) * 1e-9
        most = self._told + FASTEST_HZ * (passed_s + 2.0 * JUMP_S)
        assert self._missing <= most, "more is missing than the time allows"
