"""The ring keeps order, and what it could not keep is told as missing at its place."""

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.data_types import make_block
from monitor.daemon.device.ring_buffer import RingBuffer


def made(first, n, lost=0):
    """Samples numbered from ``first`` on, the number in every column."""
    t_ns = np.arange(first, first + n, dtype=np.int64)
    return make_block(t_ns, np.repeat(t_ns[:, None].astype(float), 6, axis=1), t_ns + 0.5, t_ns % 256, lost)


def numbers(blocks):
    return [int(t) for one in blocks for t in one.t_ns]


def test_what_goes_in_comes_out():
    ring = RingBuffer(10)
    assert ring.take_samples() == []
    ring.push_samples(made(0, 3))
    ring.push_samples(made(3, 2))
    (taken,) = ring.take_samples()
    assert taken.t_ns.tolist() == [0, 1, 2, 3, 4]
    assert taken.values[:, 5].tolist() == [0, 1, 2, 3, 4]
    assert taken.temperature_c.tolist() == [0.5, 1.5, 2.5, 3.5, 4.5]
    assert taken.ticks.tolist() == [0, 1, 2, 3, 4]
    assert taken.lost == 0
    assert ring.take_samples() == []


def test_loss_cuts_blocks_where_it_stood():
    ring = RingBuffer(10)
    ring.push_samples(made(2, 2, lost=2))
    ring.push_samples(made(4, 1))
    ring.push_samples(made(8, 2, lost=3))
    taken = ring.take_samples()
    assert [(one.lost, one.t_ns.tolist()) for one in taken] == [(2, [2, 3, 4]), (3, [8, 9])]


def test_what_was_taken_does_not_change_when_the_ring_goes_on():
    ring = RingBuffer(4)
    ring.push_samples(made(0, 4))
    (taken,) = ring.take_samples()
    ring.push_samples(made(4, 4))
    assert taken.t_ns.tolist() == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="read-only"):
        taken.values[0] = 1.0


@pytest.mark.parametrize("sizes", [[4, 4], [3, 5], [1] * 8, [8], [9], [2, 7], [4, 1, 1, 30]])
def test_a_full_ring_overwrites_its_oldest_and_tells(sizes):
    ring = RingBuffer(4)
    total = 0
    for n in sizes:
        ring.push_samples(made(total, n))
        total += n
    taken = ring.take_samples()
    assert numbers(taken) == list(range(total - 4, total))
    assert [one.lost for one in taken] == [total - 4]
    assert ring.overflowed == total - 4


def test_loss_of_overwritten_samples_travels_on():
    ring = RingBuffer(4)
    ring.push_samples(made(5, 2, lost=5))
    ring.push_samples(made(10, 2, lost=3))
    ring.push_samples(made(13, 3, lost=1))
    taken = ring.take_samples()
    assert sum(one.lost for one in taken) + len(numbers(taken)) == 16
    assert [(one.lost, one.t_ns.tolist()) for one in taken] == [(11, [11]), (1, [13, 14, 15])]
    assert ring.overflowed == 3


@settings(max_examples=200, deadline=None)
@given(
    capacity=st.integers(1, 12),
    steps=st.lists(st.one_of(st.none(), st.tuples(st.integers(0, 5), st.integers(1, 30))), max_size=30),
)
def test_received_and_lost_are_all_that_was_sent(capacity, steps):
    """None = the reader takes; else (lost, n) is pushed."""
    ring = RingBuffer(capacity)
    at = told = came = 0
    seen = []
    for step in [*steps, None]:
        if step is None:
            for one in ring.take_samples():
                told += one.lost
                came += len(one)
                seen += one.t_ns.tolist()
                # the number of the first sample says how many must have been before it
                assert int(one.t_ns[0]) == told + came - len(one)
        else:
            lost, n = step
            ring.push_samples(made(at + lost, n, lost))
            at += lost + n
    assert told + came == at
    assert seen == sorted(set(seen))


@pytest.mark.parametrize("capacity", [64, 100_000])
def test_a_writer_and_a_reader_at_once(capacity):
    ring, pushes, stopped = RingBuffer(capacity), 3000, threading.Event()
    taken = []

    def write():
        at = 0
        for i in range(pushes):
            n, lost = 1 + i % 37, i % 5 == 0
            ring.push_samples(made(at + lost, n, int(lost)))
            at += n + lost
        stopped.set()

    writer = threading.Thread(target=write)
    writer.start()
    while not stopped.is_set():
        taken += ring.take_samples()
    writer.join()
    taken += ring.take_samples()
    sent = sum(1 + i % 37 + (i % 5 == 0) for i in range(pushes))
    assert sum(len(one) + one.lost for one in taken) == sent
    assert ring.overflowed + len(numbers(taken)) == sum(1 + i % 37 for i in range(pushes))
    at = 0
    for one in taken:
        at += one.lost
        assert one.t_ns.tolist() == list(range(at, at + len(one)))
        assert np.array_equal(one.values[:, 3], one.t_ns)
        at += len(one)
