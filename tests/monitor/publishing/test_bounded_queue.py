"""The queue before a slow output."""

import threading

from monitor.publishing.bounded_queue import BoundedQueue
from tests.support.waiting import FOREVER_S


def test_the_oldest_give_way_and_are_counted():
    backlog = BoundedQueue[int](limit=10)
    for i in range(25):
        backlog.push(i, 1)
    assert backlog.dropped == 15
    assert backlog.take(0.0) == list(range(15, 25))
    assert backlog.take(0.0) == []


def test_one_message_heavier_than_the_limit_is_kept():
    backlog = BoundedQueue[str](limit=10)
    backlog.push("a", 3)
    backlog.push("heavy", 99)
    assert backlog.take(0.0) == ["heavy"]


def test_taking_waits_for_a_message():
    backlog = BoundedQueue[str](limit=10)
    threading.Timer(0.05, backlog.push, ("late", 1)).start()
    assert backlog.take(FOREVER_S) == ["late"]
