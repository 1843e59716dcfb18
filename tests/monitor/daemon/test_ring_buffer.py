"""Tests of the ring buffer: order, and overwritten samples counted as lost at their position."""

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.data_types import make_block
from monitor.daemon.device.ring_buffer import RingBuffer


def make_numbered_block(first, n, lost=0):
    """Return samples numbered from ``first``, with the number in every column."""
    t_ns = np.arange(first, first + n, dtype=np.int64)
    return make_block(t_ns, np.repeat(t_ns[:, None].astype(float), 6, axis=1), t_ns + 0.5, t_ns % 256, lost)


def list_numbers(blocks):
    return [int(t) for block in blocks for t in block.t_ns]


def test_pushed_samples_are_taken_unchanged():
    ring = RingBuffer(10)
    assert ring.take_samples() == []
    ring.push_samples(make_numbered_block(0, 3))
    ring.push_samples(make_numbered_block(3, 2))
    (taken,) = ring.take_samples()
    assert taken.t_ns.tolist() == [0, 1, 2, 3, 4]
    assert taken.values[:, 5].tolist() == [0, 1, 2, 3, 4]
    assert taken.temperature_c.tolist() == [0.5, 1.5, 2.5, 3.5, 4.5]
    assert taken.ticks.tolist() == [0, 1, 2, 3, 4]
    assert taken.lost == 0
    assert ring.take_samples() == []


def test_loss_separates_blocks_at_its_position():
    ring = RingBuffer(10)
    ring.push_samples(make_numbered_block(2, 2, lost=2))
    ring.push_samples(make_numbered_block(4, 1))
    ring.push_samples(make_numbered_block(8, 2, lost=3))
    taken = ring.take_samples()
    assert [(block.lost, block.t_ns.tolist()) for block in taken] == [(2, [2, 3, 4]), (3, [8, 9])]


def test_taken_block_does_not_change_when_the_ring_is_reused():
    ring = RingBuffer(4)
    ring.push_samples(make_numbered_block(0, 4))
    (taken,) = ring.take_samples()
    ring.push_samples(make_numbered_block(4, 4))
    assert taken.t_ns.tolist() == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="read-only"):
        taken.values[0] = 1.0


@pytest.mark.parametrize("sizes", [[4, 4], [3, 5], [1] * 8, [8], [9], [2, 7], [4, 1, 1, 30]])
def test_full_ring_overwrites_its_oldest_samples_and_counts_them(sizes):
    ring = RingBuffer(4)
    total = 0
    for n in sizes:
        ring.push_samples(make_numbered_block(total, n))
        total += n
    taken = ring.take_samples()
    assert list_numbers(taken) == list(range(total - 4, total))
    assert [block.lost for block in taken] == [total - 4]
    assert ring.overflowed == total - 4


def test_loss_before_overwritten_samples_is_kept():
    ring = RingBuffer(4)
    ring.push_samples(make_numbered_block(5, 2, lost=5))
    ring.push_samples(make_numbered_block(10, 2, lost=3))
    ring.push_samples(make_numbered_block(13, 3, lost=1))
    taken = ring.take_samples()
    assert sum(block.lost for block in taken) + len(list_numbers(taken)) == 16
    assert [(block.lost, block.t_ns.tolist()) for block in taken] == [(11, [11]), (1, [13, 14, 15])]
    assert ring.overflowed == 3


@settings(max_examples=200, deadline=None)
@given(
    capacity=st.integers(1, 12),
    steps=st.lists(st.one_of(st.none(), st.tuples(st.integers(0, 5), st.integers(1, 30))), max_size=30),
)
def test_received_and_lost_samples_add_up_to_all_sent(capacity, steps):
    """In ``steps``, None takes the samples and (lost, n) pushes n samples after a loss."""
    ring = RingBuffer(capacity)
    at = lost_total = received_total = 0
    seen = []
    for step in [*steps, None]:
        if step is None:
            for block in ring.take_samples():
                lost_total += block.lost
                received_total += len(block)
                seen += block.t_ns.tolist()
                # The number of the first sample equals the count of samples before it.
                assert int(block.t_ns[0]) == lost_total + received_total - len(block)
        else:
            lost, n = step
            ring.push_samples(make_numbered_block(at + lost, n, lost))
            at += lost + n
    assert lost_total + received_total == at
    assert seen == sorted(set(seen))


@pytest.mark.parametrize("capacity", [64, 100_000])
def test_concurrent_writer_and_reader_lose_nothing_uncounted(capacity):
    ring, pushes, stopped = RingBuffer(capacity), 3000, threading.Event()
    taken = []

    def write():
        at = 0
        for i in range(pushes):
            n, lost = 1 + i % 37, i % 5 == 0
            ring.push_samples(make_numbered_block(at + lost, n, int(lost)))
            at += n + lost
        stopped.set()

    writer = threading.Thread(target=write)
    writer.start()
    while not stopped.is_set():
        taken += ring.take_samples()
    writer.join()
    taken += ring.take_samples()
    sent = sum(1 + i % 37 + (i % 5 == 0) for i in range(pushes))
    assert sum(len(block) + block.lost for block in taken) == sent
    assert ring.overflowed + len(list_numbers(taken)) == sum(1 + i % 37 for i in range(pushes))
    at = 0
    for block in taken:
        at += block.lost
        assert block.t_ns.tolist() == list(range(at, at + len(block)))
        assert np.array_equal(block.values[:, 3], block.t_ns)
        at += len(block)
