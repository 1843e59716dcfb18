"""``SampleClock`` with checks of the times and of the numbers of missing samples that it returns."""

from drivers.data_types import SampleBlock, SenderTimedFormat, Timing
from drivers.timing.arrival_timeline import JUMP_S
from drivers.timing.sample_clock import SampleClock
from tests.experiments.fuzz.checks import MAX_LOST_SAMPLES

MAX_RATE_HZ = 32_000.0
"""Highest sample rate of an inertial sensor. It limits how many samples can be missing in the elapsed time."""


class CheckedClock:
    """Sample clock that checks each result."""

    def __init__(self, timing: Timing, rate_hz: float | None) -> None:
        self.clock = SampleClock(timing, rate_hz)
        self._sender_timed = isinstance(timing, SenderTimedFormat)
        self._received_rows = self._returned_rows = 0
        self._decoder_lost = self._clock_lost = 0  # lost samples that the decoder and the clock report
        self._first_ns: int | None = None
        self._newest_ns = -(1 << 63)
        self._last_ns = -(1 << 63)

    def assign_times(self, block: SampleBlock) -> list[SampleBlock]:
        """Assign times to the samples of a block and check the result."""
        out = self.clock.assign_times(block)
        self._received_rows += len(block)
        self._decoder_lost += block.lost
        first, newest = int(block.t_ns.min()), int(block.t_ns.max())
        self._first_ns = first if self._first_ns is None else min(first, self._first_ns)
        self._newest_ns = max(newest, self._newest_ns)
        for timed in out:
            assert 0 <= timed.lost <= MAX_LOST_SAMPLES + self._decoder_lost, timed.lost
            self._returned_rows += len(timed)
            self._clock_lost += timed.lost
            self._check_times(block, timed)
        dropped = self.clock.dropped_repeated_rows + self.clock.dropped_late_rows
        assert self._returned_rows + dropped == self._received_rows, "a row was lost or returned twice"
        self._check_lost_samples()
        rate = self.clock.configured_or_measured_rate_hz
        assert rate is None or 0.0 < rate < float("inf"), rate
        for event in self.clock.take_events():
            assert event.text
            assert "\n" not in event.text
        return out

    def _check_times(self, block: SampleBlock, timed: SampleBlock) -> None:
        times = timed.t_ns.tolist()
        if self._sender_timed:
            assert set(times) <= set(block.t_ns.tolist()), "a time of the sender was changed"
            return
        assert all(a < b for a, b in zip([self._last_ns, *times], times, strict=False)), "times decrease"
        self._last_ns = times[-1]
        newest_ns = self._newest_ns + round(JUMP_S * 1e9) + self._received_rows
        assert times[-1] <= newest_ns + 1000, "a sample is newer than its arrival"

    def _check_lost_samples(self) -> None:
        assert self._clock_lost <= self._decoder_lost + MAX_LOST_SAMPLES * 1000
        if self._sender_timed:
            return
        passed_s = (self._newest_ns - (self._first_ns or 0)) * 1e-9
        limit = self._decoder_lost + MAX_RATE_HZ * (passed_s + 2.0 * JUMP_S)
        assert self._clock_lost <= limit, "more samples are missing than the elapsed time allows"
