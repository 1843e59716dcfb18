"""Checks of decoded samples and of error messages, for all fuzz targets."""

import numpy as np

from drivers.data_types import NO_TICK, Chunk, CounterTimedFormat, SampleBlock, SenderTimedFormat
from drivers.decoders.base import MAX_ACCEL_M_S2, MAX_GYRO_RAD_S, TEMPERATURE_LIMITS_C, Decoder

LIMITS = (MAX_GYRO_RAD_S,) * 3 + (MAX_ACCEL_M_S2,) * 3
MAX_LOST_SAMPLES = 10**10
"""Number of samples in ten days at 10 kHz. No decoder can detect a larger loss in one place."""


def check_block(block: SampleBlock) -> None:
    """Check shapes and types of a block, and that each value is a possible measurement or NaN."""
    n = len(block)
    assert n >= 1
    assert block.values.shape == (n, 6)
    assert block.values.dtype == block.temperature_c.dtype == np.float64
    assert block.temperature_c.shape == block.t_ns.shape == block.ticks.shape == (n,)
    assert block.t_ns.dtype == block.ticks.dtype == np.int64
    assert isinstance(block.lost, int), type(block.lost)
    assert 0 <= block.lost <= MAX_LOST_SAMPLES, block.lost
    assert not any(a.flags.writeable for a in (block.values, block.t_ns, block.ticks, block.temperature_c))
    for row in block.values.tolist():
        numbers = [(abs(x), limit) for x, limit in zip(row, LIMITS, strict=True) if x == x]
        assert numbers, "a sample without a value"
        assert all(x <= limit for x, limit in numbers), "a value outside the range of all sensors"
    low, high = TEMPERATURE_LIMITS_C
    assert all(low <= t <= high for t in block.temperature_c.tolist() if t == t), "an impossible temperature"


def feed_and_check(decoder: Decoder, calls: list[list[Chunk]]) -> list[SampleBlock]:
    """Feed the chunks to a decoder, check each block, and return all blocks."""
    out = []
    arrivals: set[int] = set()
    for chunks in calls:
        arrivals |= {chunk.t_ns for chunk in chunks}
        bad = decoder.bad
        for block in decoder.feed(chunks):
            check_block(block)
            if isinstance(decoder.timing, CounterTimedFormat):
                known = block.ticks[block.ticks != NO_TICK]
                assert ((known >= 0) & (known < decoder.timing.modulus)).all(), "a counter outside its range"
            if not isinstance(decoder.timing, SenderTimedFormat):
                assert set(block.t_ns.tolist()) <= arrivals, "a time at which nothing arrived"
            out.append(block)
        assert decoder.bad >= bad
        assert isinstance(decoder.recent_problem, str)
        assert len(decoder.recent_problem) < 1000
    return out


BlockSummary = tuple[list[tuple[float | None, ...]], list[str], list[int], int]


def summarize_blocks(blocks: list[SampleBlock]) -> BlockSummary:
    """Return values, temperatures, counters and number of lost samples, which must not depend on the chunks."""
    rows = [tuple(None if x != x else x for x in row) for block in blocks for row in block.values.tolist()]
    temperatures = [repr(t) for block in blocks for t in block.temperature_c.tolist()]
    return (
        rows,
        temperatures,
        [t for block in blocks for t in block.ticks.tolist()],
        sum(block.lost for block in blocks),
    )


def check_error_message(error: BaseException) -> None:
    """Check that the message of an error is a single line of limited length."""
    text = str(error)
    assert text.strip(), "an error without a message"
    assert "\n" not in text, "an error message of several lines"
    assert len(text) < 3000, "an error message that is too long"
