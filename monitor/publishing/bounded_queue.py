"""Bounded queue between the service and a slow output. Adding an item never blocks. The oldest items are dropped."""

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class BoundedQueue(Generic[T]):
    """Thread-safe queue with a limit of the total weight of its items, such as their size in bytes.

    >>> backlog = BoundedQueue[str](limit=2)
    >>> for word in ("a", "b", "c"):
    ...     backlog.push(word, 1)
    >>> backlog.take(0.0), backlog.dropped
    (['b', 'c'], 1)
    """

    def __init__(self, limit: int) -> None:
        self._items: deque[tuple[T, int]] = deque()
        self._limit = limit
        self._weight = 0
        self._ready = threading.Condition()
        self.dropped = 0  # number of items dropped since creation

    def push(self, item: T, weight: int) -> None:
        """Add an item, and drop and count the oldest items beyond the limit. At least one item is kept.

        Parameters
        ----------
        item
            The item.
        weight
            Weight of the item, in the unit of the limit.
        """
        with self._ready:
            self._items.append((item, weight))
            self._weight += weight
            while self._weight > self._limit and len(self._items) > 1:
                self._weight -= self._items.popleft()[1]
                self.dropped += 1
            self._ready.notify()

    def take(self, timeout_s: float) -> list[T]:
        """Return and remove all items, oldest first. If the queue is empty, wait up to ``timeout_s`` seconds."""
        with self._ready:
            if not self._items and timeout_s > 0:
                self._ready.wait(timeout_s)
            items = [item for item, _ in self._items]
            self._items.clear()
            self._weight = 0
            return items

    def wake(self) -> None:
        """End the wait of a call of ``take``."""
        with self._ready:
            self._ready.notify_all()
