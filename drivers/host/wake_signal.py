"""Signal that wakes a waiting thread.

``threading.Event`` does the same, but is written in Python and calls about ten functions for each wait.
"""

import threading


class WakeSignal:
    """Signal that any thread sets, and that one thread waits for.

    >>> signal = WakeSignal()
    >>> signal.set()
    >>> signal.set()
    >>> signal.wait_and_clear(0.0), signal.wait_and_clear(0.0)
    (True, False)
    """

    def __init__(self) -> None:
        self._is_cleared = threading.Lock()  # locked while the signal is not set
        self._is_cleared.acquire()

    def set(self) -> None:
        """Set the signal, and wake the waiting thread."""
        try:
            self._is_cleared.release()
        except RuntimeError:  # the signal is set already
            return

    def wait_and_clear(self, timeout_s: float) -> bool:
        """Wait until the signal is set or a timeout has passed, clear the signal, and return True if it was set."""
        return self._is_cleared.acquire(timeout=timeout_s)
