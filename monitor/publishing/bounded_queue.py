"""Thread-safe queue of limited size that drops its oldest items instead of blocking the thread that adds items."""

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class BoundedQueue(Generic[T]):
    """Thread-safe queue that limits the total weight of its items, for example their size in bytes.

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
        self.dropped = 0  # number of items dropped since the queue was created
        self.dropped_weight = 0

    def push(self, item: T, weight: int) -> None:
        """Add an item, and drop the oldest items while the total weight exceeds the limit.

        The newest item is never dropped.

        Parameters
        ----------
        item
            Item to append.
        weight
            Weight of the item, in the same unit as the limit of the queue.
        """
        with self._ready:
            self._items.append((item, weight))
            self._weight += weight
            while self._weight > self._limit and len(self._items) > 1:
                _, oldest_weight = self._items.popleft()
                self._weight -= oldest_weight
                self.dropped_weight += oldest_weight
                self.dropped += 1
            self._ready.notify()

    def take(self, timeout_s: float) -> list[T]:
        """Remove and return all items, oldest first. Wait up to ``timeout_s`` seconds if the queue is empty."""
        with self._ready:
            if not self._items and timeout_s > 0:
                self._ready.wait(timeout_s)
            items = [item for item, _ in self._items]
            self._items.clear()
            self._weight = 0
            return items

    def wake(self) -> None:
        """Wake a thread that waits for items in ``take``."""
        with self._ready:
            self._ready.notify_all()
