"""What must hold of samples, wherever they come from."""

import numpy as np

from drivers.data_types import NO_TICK, Chunk, CounterTimedFormat, SampleBlock, SenderTimedFormat
from drivers.decoders.base import MAX_ACCEL_M_S2, MAX_GYRO_RAD_S, TEMPERATURE_LIMITS_C, Decoder

LIMITS = (MAX_GYRO_RAD_S,) * 3 + (MAX_ACCEL_M_S2,) * 3
LARGEST_LOSS = 10**10
"""Samples: ten days at 10 kHz; more at one place is no loss that a decoder can know of."""


def sound(block: SampleBlock) -> None:
    """Shapes and types; each value a measurement or NaN."""
    n = len(block)
    assert n >= 1
    assert block.values.shape == (n, 6)
    assert block.values.dtype == block.temperature_c.dtype == np.float64
    assert block.temperature_c.shape == block.t_ns.shape == block.ticks.shape == (n,)
    assert block.t_ns.dtype == block.ticks.dtype == np.int64
    assert isinstance(block.lost, int), type(block.lost)
    assert 0 <= block.lost <= LARGEST_LOSS, block.lost
    assert not any(a.flags.writeable for a in (block.values, block.t_ns, block.ticks, block.temperature_c))
    for row in block.values.tolist():
        numbers = [(abs(x), limit) for x, limit in zip(row, LIMITS, strict=True) if x == x]
        assert numbers, "a sample without a value"
        assert all(x <= limit for x, limit in numbers), "a value that no sensor can show"
    low, high = TEMPERATURE_LIMITS_C
    assert all(low <= t <= high for t in block.temperature_c.tolist() if t == t), "an impossible temperature"


def fed(decoder: Decoder, calls: list[list[Chunk]]) -> list[SampleBlock]:
    """All blocks of a decoder, each of them sound."""
    out = []
    arrivals: set[int] = set()
    for chunks in calls:
        arrivals |= {chunk.t_ns for chunk in chunks}
        bad = decoder.bad
        for block in decoder.feed(chunks):
            sound(block)
            if isinstance(decoder.timing, CounterTimedFormat):
                known = block.ticks[block.ticks != NO_TICK]
                assert ((known >= 0) & (known < decoder.timing.modulus)).all(), "a count outside its turn"
            if not isinstance(decoder.timing, SenderTimedFormat):
                assert set(block.t_ns.tolist()) <= arrivals, "a time at which nothing arrived"
            out.append(block)
        assert decoder.bad >= bad
        assert isinstance(decoder.recent_problem, str)
        assert len(decoder.recent_problem) < 1000
    return out


Seen = tuple[list[tuple[float | None, ...]], list[str], list[int], int]


def seen(blocks: list[SampleBlock]) -> Seen:
    """What no cut of the same bytes may change: values, temperatures, counts, how many are missing in all."""
    rows = [tuple(None if x != x else x for x in row) for block in blocks for row in block.values.tolist()]
    warm = [repr(t) for block in blocks for t in block.temperature_c.tolist()]
    return rows, warm, [t for block in blocks for t in block.ticks.tolist()], sum(block.lost for block in blocks)


def one_line(error: BaseException) -> None:
    """An error for people: one line, not endless."""
    text = str(error)
    assert text.strip(), "an error without a word"
    assert "\n" not in text, "an error of several lines"
    assert len(text) < 3000, "an endless error"
