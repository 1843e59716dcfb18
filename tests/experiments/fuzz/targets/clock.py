"""``SampleClock`` by itself: counters that jump and stand, arrivals that jitter, pause and go back, repeated rows."""

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
from tests.experiments.fuzz.stamped import Stamped
from tests.experiments.fuzz.tape import Tape
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
"""ns, or ticks."""
LARGEST: Final = 1 << 62
"""Links and decoders bring no time beyond it."""


def _walk(tape: Tape, n: int, start: int, modulus: int) -> list[int]:
    """So many numbers, from a start on, mostly in even steps."""
    kind = tape.byte()
    step = STEPS[kind % len(STEPS)]
    rows = []
    for i in range(n):
        if kind & 64:
            step = STEPS[tape.byte() % len(STEPS)]
        if kind & 128 and i == n // 2:
            start = tape.int64()
        start += step
        rows.append(start % modulus if modulus else max(-LARGEST + 1, min(start, LARGEST - 1)))
    return rows


@target("clock", [bytes(range(64)), bytes([2, 1, *[3, 4, 8, 1] * 30]), bytes([1, 0, *[40, 4, 4] * 30])], 256)
def clock(data: bytes) -> None:
    """Any course of events gives times in order, keeps every row and calls no more missing than can be."""
    tape = Tape(data)
    timing = tape.choice(TIMINGS)
    stamped = Stamped(timing, tape.choice(RATES_HZ))
    t_ns, tick, i = 1_000_000_000, 0, 0
    while tape and i < 25:
        i += 1
        kind = tape.byte()
        if kind % 16 == 15:
            stamped.clock.count_next_gap_by_arrival()
            continue
        n = 1 + kind % 8
        given = isinstance(timing, SenderTimedFormat)
        times = _walk(tape, n if given else 1, t_ns, 0)
        t_ns = times[-1]
        ticks = [NO_TICK] * n
        if isinstance(timing, CounterTimedFormat) and kind & 64 == 0:
            ticks = _walk(tape, n, tick, timing.modulus)
            tick = ticks[-1]
        stamped.put(_rows(times if given else times * n, ticks, i if kind & 128 == 0 else 0, kind // 16 % 4))


def _rows(times: list[int], ticks: list[int], number: int, lost: int) -> SampleBlock:
    values = np.zeros((len(times), 6))
    values[:, 0] = number + np.arange(len(times)) * (number > 0)
    return make_block(np.array(times, np.int64), values, None, np.array(ticks, np.int64), lost)
