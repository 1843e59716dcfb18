"""Waiting for a condition, with one deadline for all tests.

A test never assumes how fast the machine is. It waits for a condition, and the deadline only ends a test whose
condition never comes true. ``IMU_MONITOR_TEST_PATIENCE`` multiplies the deadline on a very slow machine.
"""

import os
import time
from collections.abc import Callable
from typing import Final, TypeVar

T = TypeVar("T")

PATIENCE_S: Final = 300.0 * float(os.environ.get("IMU_MONITOR_TEST_PATIENCE", "1"))
"""Deadline of every wait in a test, in seconds. It is far beyond the time that any condition takes."""
FOREVER_S: Final = 86_400.0
"""Timeout for a call that must return early. A call that waits for it runs into the time limit of its test."""
POLL_S: Final = 0.01


def wait_for(
    condition: Callable[[], T], what: str | Callable[[], object] = "the condition", patience_s: float = PATIENCE_S
) -> T:
    """Return the first true result of ``condition``.

    Parameters
    ----------
    condition
        Called until its result is true, with pauses of at least 10 ms and at least three times as long as the call.
    what
        Describes the condition in the error message. A callable is evaluated when the deadline has passed.
    patience_s
        Deadline in seconds.

    Raises
    ------
    AssertionError
        If the condition is still false after ``patience_s``.
    """
    deadline_s = time.monotonic() + patience_s
    while True:
        called_s = time.monotonic()
        if found := condition():
            return found
        now_s = time.monotonic()
        if now_s > deadline_s:
            raise AssertionError(f"waited {patience_s:g} s for {what() if callable(what) else what}")
        time.sleep(max(POLL_S, 3.0 * (now_s - called_s)))  # leaves the processor to the program that is waited for


def stays_true(condition: Callable[[], object], seconds: float = 0.5) -> bool:
    """Return True if ``condition`` is true now and at every look during the next ``seconds``.

    This is for a check that something does not happen. A slow machine can only make it less strict.
    """
    end_s = time.monotonic() + seconds
    while condition():
        if time.monotonic() > end_s:
            return True
        time.sleep(POLL_S)
    return False
