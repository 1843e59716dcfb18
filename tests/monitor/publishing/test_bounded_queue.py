"""Tests of the bounded queue before a slow output."""

import threading

from monitor.publishing.bounded_queue import BoundedQueue
from tests.support.waiting import FOREVER_S


def test_oldest_messages_are_dropped_and_counted():
    queue = BoundedQueue[int](limit=10)
    for i in range(25):
        queue.push(i, 1)
    assert queue.dropped == 15
    assert queue.take(0.0) == list(range(15, 25))
    assert queue.take(0.0) == []


def test_message_larger_than_the_limit_is_kept():
    queue = BoundedQueue[str](limit=10)
    queue.push("a", 3)
    queue.push("heavy", 99)
    assert queue.take(0.0) == ["heavy"]


def test_taking_waits_for_a_message():
    queue = BoundedQueue[str](limit=10)
    threading.Timer(0.05, queue.push, ("late", 1)).start()
    assert queue.take(FOREVER_S) == ["late"]
