"""Containment of unexpected exceptions, so that an error in one device, output or thread does not stop the others.

The traceback of each exception is logged once. The status shows the exception for SHOWN_S.
"""

import threading
import time
import traceback
from collections.abc import Callable
from typing import Final

import structlog

from drivers.errors import describe_error, make_printable_and_shorten

SHOWN_S: Final = 60.0
"""Time for which the status shows an unexpected exception after its last occurrence."""
THREAD_RETRY_S: Final = 5.0
"""Pause before a thread begins its work again."""
MAX_LOGGED: Final = 1000
"""Maximum number of different exceptions whose traceback is logged."""

_log = structlog.get_logger("imu-monitor")
_logged: set[tuple[object, ...]] = set()


def log_unexpected_error(place: str, error: Exception) -> str:
    """Log an unexpected exception with its traceback, unless the same line has raised it before.

    Parameters
    ----------
    place : str
        Device, output or thread in which the exception was raised.
    error : Exception
        Unexpected exception.

    Returns
    -------
    str
        Description of the exception for the status.
    """
    text = make_printable_and_shorten(f"unexpected {type(error).__name__}: {describe_error(error)}".rstrip(": "))
    last = traceback.extract_tb(error.__traceback__)[-1:]
    key = (place, type(error), *((frame.filename, frame.lineno) for frame in last))
    if key not in _logged and len(_logged) < MAX_LOGGED:
        _logged.add(key)
        _log.error(place, text=text, exception="".join(traceback.format_exception(error)))
    return text


class RecentFailure:
    """Unexpected exception that the status shows for SHOWN_S after its last occurrence."""

    def __init__(self) -> None:
        self._text = ""
        self._failed_s = 0.0

    def note(self, place: str, error: Exception) -> None:
        """Log an exception and show it in the status."""
        self._text, self._failed_s = log_unexpected_error(place, error), time.monotonic()

    @property
    def text(self) -> str:
        """Description of the exception, or "" if there was none recently."""
        return self._text if time.monotonic() - self._failed_s < SHOWN_S else ""


class RestartedThread(threading.Thread):
    """Daemon thread that begins its work again after an unexpected exception.

    Parameters
    ----------
    work : callable
        Work of the thread. The thread ends when the work returns.
    name : str
        Name of the thread.
    closing : threading.Event
        Event that is set when the thread must end.
    """

    def __init__(self, work: Callable[[], None], name: str, closing: threading.Event) -> None:
        super().__init__(name=name, daemon=True)
        self._work = work
        self._closing = closing
        self._failure = RecentFailure()

    @property
    def failure(self) -> str:
        """Description of a recent unexpected exception for the status, or ""."""
        text = self._failure.text
        return f"{text}; trying again" if text else ""

    def run(self) -> None:
        """Do the work, and begin it again THREAD_RETRY_S after an unexpected exception."""
        while True:
            try:
                self._work()
            except Exception as error:  # noqa: BLE001 - the status shows the error
                self._failure.note(f"thread {self.name}", error)
            else:
                return
            if self._closing.wait(THREAD_RETRY_S):
                return
