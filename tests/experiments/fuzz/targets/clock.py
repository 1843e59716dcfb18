"""Fuzz target of ``SampleClock``: irregular counters, irregular arrival times and repeated rows."""

from typing import Final

import numpy as np

from drivers.data_types import (
    NO_TICK,
    ArrivalTimedFormat,
    CounterTimedFormat,
    SampleBlock,
    SenderTimedFormat,
    Timing,
    make_block,
)
from tests.experiments.fuzz.checked_clock import CheckedClock
from tests.experiments.fuzz.input_reader import InputReader
from tests.experiments.fuzz.target import target

TIMINGS: Final[tuple[Timing, ...]] = (
    ArrivalTimedFormat(),
    SenderTimedFormat(),
    CounterTimedFormat(256, 1.0 / 2000.0),
    CounterTimedFormat(1 << 16),
    CounterTimedFormat(1 << 32, 1e-4),
    CounterTimedFormat(1 << 62, 1e-9),
    CounterTimedFormat((1 << 32) * 1_000_000, 1e-9),
    CounterTimedFormat(1 << 32),
    CounterTimedFormat(2),
)
RATES_HZ: Final = (None, 100.0, 1.0, 8000.0, 1e-3)
STEPS: Final = (0, 1, 1_000, 1_000_000, 10_000_000, 10_000_000, 1_000_000_000, 3_600_000_000_000, -1, -1_000_000_000)
"""Steps of times in ns, or of counters in ticks."""
MAX_TIME_NS: Final = 1 << 62
"""Limit of all times from links and decoders, in ns."""


def _build_sequence(reader: InputReader, n: int, start: int, modulus: int) -> list[int]:
    """Return ``n`` numbers that follow ``start``, mostly in equal steps."""
    kind = reader.read_byte()
    step = STEPS[kind % len(STEPS)]
    rows = []
    for i in range(n):
        if kind & 64:
            step = STEPS[reader.read_byte() % len(STEPS)]
        if kind & 128 and i == n // 2:
            start = reader.read_int64()
        start += step
        rows.append(start % modulus if modulus else max(-MAX_TIME_NS + 1, min(start, MAX_TIME_NS - 1)))
    return rows


@target("clock", [bytes(range(64)), bytes([2, 1, *[3, 4, 8, 1] * 30]), bytes([1, 0, *[40, 4, 4] * 30])], 256)
def clock(data: bytes) -> None:
    """Check that times increase, no row is lost, and the number of missing samples is possible."""
    reader = InputReader(data)
    timing = reader.choose(TIMINGS)
    checked_clock = CheckedClock(timing, reader.choose(RATES_HZ))
    t_ns, tick, i = 1_000_000_000, 0, 0
    while reader and i < 25:
        i += 1
        kind = reader.read_byte()
        if kind % 16 == 15:
            checked_clock.clock.count_next_gap_by_arrival()
            continue
        n = 1 + kind % 8
        given = isinstance(timing, SenderTimedFormat)
        times = _build_sequence(reader, n if given else 1, t_ns, 0)
        t_ns = times[-1]
        ticks = [NO_TICK] * n
        if isinstance(timing, CounterTimedFormat) and kind & 64 == 0:
            ticks = _build_sequence(reader, n, tick, timing.modulus)
            tick = ticks[-1]
        checked_clock.assign_times(
            _build_block(times if given else times * n, ticks, i if kind & 128 == 0 else 0, kind // 16 % 4)
        )


def _build_block(times: list[int], ticks: list[int], number: int, lost: int) -> SampleBlock:
    values = np.zeros((len(times), 6))
    values[:, 0] = number + np.arange(len(times)) * (number > 0)
    return make_block(np.array(times, np.int64), values, None, np.array(ticks, np.int64), lost)
