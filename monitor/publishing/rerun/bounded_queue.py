"""A bounded queue between the service and a slow output: never blocks, drops its oldest, counts them."""

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Backlog(Generic[T]):
    """Holds at most ``limit`` units of weight (bytes); safe between threads.

    >>> backlog = Backlog[str](limit=2)
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
        self.dropped = 0  # since it was made

    def push(self, item: T, weight: int) -> None:
        """Add the newest; the oldest give way. Returns at once."""
        with self._ready:
            self._items.append((item, weight))
            self._weight += weight
            while self._weight > self._limit and len(self._items) > 1:
                self._weight -= self._items.popleft()[1]
                self.dropped += 1
            self._ready.notify()

    def take(self, timeout_s: float) -> list[T]:
        """All there is, oldest first; an empty list when nothing came in time."""
        with self._ready:
            if not self._items and timeout_s > 0:
                self._ready.wait(timeout_s)
            items = [item for item, _ in self._items]
            self._items.clear()
            self._weight = 0
            return items

    def wake(self) -> None:
        """End a waiting ``take``."""
        with self._ready:
            self._ready.notify_all()
