"""Tests of sample times after a stall of the reader, with simulated buffers that keep the oldest data and overflow."""

import time

import numpy as np
import pytest

from drivers.data_types import NS_PER_S, ArrivalTimedFormat, Chunk, CounterTimedFormat, Timing, make_block
from drivers.decoders.text_lines import text
from drivers.decoders.text_lines.text.settings import Settings
from drivers.driver import Driver
from drivers.errors import LinkEnded
from drivers.links import unix_to_monotonic_arrival
from drivers.links.base import PolledLink
from drivers.timing.sample_clock import SampleClock
from tests.support.loopback_link import LoopbackLink
from tests.support.settings import read_settings

RATE_HZ = 100.0
START_S = 1e5
STALL_AT_S = 12.0
SENSORS = {
    "no counter": ArrivalTimedFormat(),
    "device clock": CounterTimedFormat(1 << 62, 1e-9),
    "16-bit counter": CounterTimedFormat(1 << 16),
    "8-bit counter": CounterTimedFormat(1 << 8),
}


def read_through_buffer(taken_s: np.ndarray, stall_s: float, capacity: int, most: int, stamped: bool) -> list:
    """Return the reads: time of the read, sample numbers, and arrival times that the link states."""
    reads, waiting, sent, t_s, stalled = [], [], 0, taken_s[0], False
    while sent < taken_s.size or waiting:
        t_s += 0.02
        if not stalled and t_s > START_S + STALL_AT_S:
            t_s, stalled = t_s + stall_s, True
        while sent < taken_s.size and taken_s[sent] <= t_s:
            waiting += [sent] if len(waiting) < capacity else []
            sent += 1
        now, waiting = np.array(waiting[:most], int), waiting[most:]
        if now.size:
            reads.append((t_s, now, taken_s[now] if stamped else np.full(now.size, t_s)))
    return reads


@pytest.mark.parametrize("stamped", [True, False])
@pytest.mark.parametrize(("stall_s", "capacity"), [(2.0, 277), (20.0, 277), (20.0, 10_000)])
@pytest.mark.parametrize("configured", [True, False])
@pytest.mark.parametrize("timing", SENSORS.values(), ids=SENSORS)
def test_stall_neither_bends_times_nor_miscounts(
    timing: Timing, configured: bool, stall_s: float, capacity: int, stamped: bool
) -> None:
    taken_s = START_S + np.arange(round((STALL_AT_S + stall_s + 10.0) * RATE_HZ)) / RATE_HZ
    clock = SampleClock(timing, RATE_HZ if configured else None)
    blocks, before_s = [], START_S
    for read_s, index, arrived_s in read_through_buffer(taken_s, stall_s, capacity, 256, stamped):
        if read_s - before_s > 0.7:
            clock.note_stall(round((read_s if not stamped else read_s - 0.005) * NS_PER_S))
        before_s = read_s
        ticks = None
        if isinstance(timing, CounterTimedFormat):
            ticks = np.rint(index / RATE_HZ / (timing.tick_s or 1.0 / RATE_HZ)).astype(np.int64) % timing.modulus
        values = np.repeat(index[:, None].astype(np.float64), 6, axis=1)
        blocks += clock.assign_times(make_block(np.rint(arrived_s * NS_PER_S).astype(np.int64), values, None, ticks))
    t_ns = np.concatenate([block.t_ns for block in blocks])
    index = np.concatenate([block.values[:, 0] for block in blocks]).astype(int)
    error_s = (t_ns / NS_PER_S - taken_s[index])[index > 300]
    assert (np.diff(t_ns) > 0).all()
    assert sum(block.lost for block in blocks) == pytest.approx(len(taken_s) - len(t_ns), abs=2)
    # The last read of the backlog also contains samples that were sent after the overflow.
    assert np.count_nonzero(np.abs(error_s - np.median(error_s)) > 0.02) <= 2
    assert clock.measured_hz == pytest.approx(RATE_HZ, rel=1e-4)
    assert clock.take_events() == []


class StarvedLink(PolledLink):
    """Link of a process that seldom runs for two minutes, so that the buffer overflows repeatedly.

    If ``stamped`` is True, the kernel states the arrival time of each sample and counts the dropped samples.
    """

    carrier = "bytes"
    epoch = "monotonic"
    _open_source = _poll_source = _close_source = lambda self: None
    _is_open = lambda self: True  # noqa: E731

    def __init__(self, taken_s: np.ndarray, capacity: int, most: int, stamped: bool) -> None:
        super().__init__("starved")
        self.now_s = START_S
        self._taken_s, self._capacity, self._most, self._stamped = taken_s, capacity, most, stamped
        self._rng = np.random.default_rng(3)
        self._waiting: list[tuple[int, int]] = []  # sample, and number of samples that had been dropped before it
        self._sent = self._dropped = 0

    def wait_for_chunks_or_timeout(self, timeout_s: float) -> list[Chunk] | None:
        self.now_s += self._rng.exponential(8.0) if 40.0 < self.now_s - START_S < 160.0 else 0.02
        arrived = int(np.searchsorted(self._taken_s, self.now_s, side="right"))
        free = min(self._capacity - len(self._waiting), arrived - self._sent)
        self._waiting += [(i, self._dropped) for i in range(self._sent, self._sent + free)]
        self._dropped += arrived - self._sent - free
        self._sent = arrived
        if not self._waiting and arrived == self._taken_s.size:
            raise LinkEnded("end")
        read, self._waiting = self._waiting[: self._most], self._waiting[self._most :]
        if read and self._stamped:
            self.dropped_datagrams = read[-1][1]
        if not self._waiting:
            self.empty_ns = round(self.now_s * NS_PER_S)
        times_s = [self._taken_s[i] if self._stamped else self.now_s for i, _ in read]
        lines = [b"%d,%.3f\n" % (i % 256, i * 1e-3) for i, _ in read]
        return [Chunk(line, round(t_s * NS_PER_S)) for line, t_s in zip(lines, times_s, strict=True)] or None


@pytest.mark.parametrize("configured", [True, False])
@pytest.mark.parametrize(
    ("columns", "capacity", "most", "stamped"),
    [
        (["-", "gx"], 1300, 2600, False),
        (["counter", "gx"], 1300, 2600, False),
        (["-", "gx"], 280, 256, True),
        (["counter", "gx"], 280, 256, True),
    ],
    ids=["terminal", "terminal, 8-bit counter", "datagrams", "datagrams, 8-bit counter"],
)
def test_starved_process_does_not_move_samples_beside_an_overflow(
    columns: list[str], capacity: int, most: int, stamped: bool, configured: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken_s = START_S + np.arange(20_000) / RATE_HZ
    link, blocks = StarvedLink(taken_s, capacity, most, stamped), []
    for name in ("time.monotonic", "_read_suspend_aware_clock_s"):
        monkeypatch.setattr(f"drivers.driver.{name}", lambda: link.now_s)
    monkeypatch.setattr("drivers.driver.time.monotonic_ns", lambda: round(link.now_s * NS_PER_S))
    counter = {"counter_modulus": 256} if "counter" in columns else {}
    decoder = text.build(read_settings(Settings, {"columns": columns, "first_line": "keep"} | counter))
    driver = Driver("a", link, decoder, SampleClock(decoder.timing, RATE_HZ if configured else None), blocks.append)
    driver.run()
    t_ns = np.concatenate([block.t_ns for block in blocks])
    index = np.rint(np.concatenate([block.values[:, 0] for block in blocks]) * 1e3).astype(int)
    error_s = (t_ns / NS_PER_S - taken_s[index])[index > 300]
    assert taken_s.size - index.size > 2_000
    assert driver.counts.lost == pytest.approx(taken_s.size - index.size, abs=2)
    assert (np.diff(t_ns) > 0).all()
    # A read may end between an overflow and the count of missing samples.
    assert np.count_nonzero(np.abs(error_s - np.median(error_s)) > 0.02) <= 10
    assert driver.clock.measured_hz == pytest.approx(RATE_HZ, rel=2e-4)
    assert {event.kind for event in driver.take_events()} == {"samples_lost"}


@pytest.mark.parametrize("configured", [True, False])
@pytest.mark.parametrize("backlog_reads", [0, 1, 4])
def test_data_that_waited_before_the_link_was_opened_do_not_bend_the_rate(
    backlog_reads: int, configured: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoder = text.build(read_settings(Settings, {"columns": ["gx"], "first_line": "keep"}))
    link, blocks, opened_s = LoopbackLink(), [], time.monotonic()
    clock = SampleClock(decoder.timing, RATE_HZ if configured else None)
    driver = Driver("a", link, decoder, clock, blocks.append)
    reads = [(opened_s + 0.002 * i, 300) for i in range(backlog_reads)]
    reads += [(opened_s + 0.04 * i, 4) for i in range(1, 500)]

    def read(timeout_s: float) -> list[Chunk]:
        if not reads:
            raise LinkEnded("end")
        t_s, n = reads.pop(0)
        return [Chunk(b"0.1\n" * n, round(t_s * NS_PER_S))]

    monkeypatch.setattr(link, "wait_for_chunks_or_timeout", read)
    driver.run()
    newest_s = np.concatenate([block.t_ns for block in blocks])[-1996 + round(RATE_HZ) :: 4] / NS_PER_S
    assert clock.measured_hz == pytest.approx(RATE_HZ, rel=1e-4)
    assert np.ptp(newest_s - np.arange(newest_s.size) * 0.04) < 0.005
    assert driver.counts.lost == 0
    assert [event.kind for event in driver.take_events()] == []


def test_stopped_driver_reports_no_lost_link(monkeypatch: pytest.MonkeyPatch) -> None:
    """A read may time out after the process was stopped, although data are waiting."""
    decoder = text.build(read_settings(Settings, {"columns": ["gx"], "first_line": "keep"}))
    link, rows, now_s = LoopbackLink(), [], [START_S]
    for name in ("time.monotonic", "_read_suspend_aware_clock_s"):
        monkeypatch.setattr(f"drivers.driver.{name}", lambda: now_s[0])
    monkeypatch.setattr("drivers.driver.time.monotonic_ns", lambda: round(now_s[0] * NS_PER_S))
    driver = Driver("a", link, decoder, SampleClock(decoder.timing, RATE_HZ), rows.append, silence_s=3.0)
    link.open()

    def read(chunks: list[Chunk]) -> None:
        monkeypatch.setattr(link, "wait_for_chunks_or_timeout", lambda timeout_s: chunks or None)
        driver.read_and_push_once()

    for i in range(5):
        now_s[0] = START_S + 0.01 * i
        read([Chunk(b"0.1\n", round(now_s[0] * NS_PER_S))])
    now_s[0] += 20.0
    read([])
    read([Chunk(b"0.1\n" * 100, round(now_s[0] * NS_PER_S))])
    assert driver.counts.received == 105
    assert driver.take_events() == []


@pytest.mark.parametrize("age_s", [0.1, 15.0])
def test_kernel_stamp_of_data_that_waited_is_kept(age_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unix_to_monotonic_arrival.time, "monotonic_ns", lambda: 10**14)
    monkeypatch.setattr(unix_to_monotonic_arrival.time, "time_ns", lambda: 17 * 10**17)
    stamp_ns = 17 * 10**17 - round(age_s * NS_PER_S)
    convert = unix_to_monotonic_arrival.monotonic_arrival_ns
    assert convert(stamp_ns, 10**14 - 20 * 10**9) == 10**14 - round(age_s * NS_PER_S)
    assert convert(stamp_ns - 30 * 10**9, 10**14 - 20 * 10**9) == 10**14  # the clock of the host was set
