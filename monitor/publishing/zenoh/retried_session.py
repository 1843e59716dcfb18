"""zenoh session that is opened in a separate thread, so that an unreachable router does not block the caller.

Threads receive messages by reading zenoh channels. With Python callbacks instead, the process would not exit.
"""

import threading
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from monitor.common.unexpected_errors import RecentFailure, RestartedThread

if TYPE_CHECKING:
    import zenoh

REFUSAL_CHECK_S: Final = 3.0
"""Interval [s] at which the reason for a refused connection is checked."""
RETRY_S: Final = 1.0
JOIN_TIMEOUT_S: Final = 2.0


class RetriedSession:
    """Base class of zenoh sessions that repeat the attempt to connect until it succeeds."""

    close_timeout_s = 2.0
    """Longest time [s] that ``close`` waits while the session is being opened."""

    def __init__(self, name: str) -> None:
        self.closing = threading.Event()
        self._session: zenoh.Session | None = None
        self._opener = RestartedThread(self._keep_open, f"zenoh {name}", self.closing)
        self._receiver_failure = RecentFailure()
        self._receivers: list[threading.Thread] = []

    @property
    def failure(self) -> str:
        """Description of a recent unexpected exception in a thread of the session for the status, or ""."""
        return self._opener.failure or self._receiver_failure.text

    def start(self) -> None:
        """Start the thread that opens the session."""
        self._opener.start()

    def close(self) -> None:
        """Close the session and stop all threads."""
        self.closing.set()
        if self._opener.is_alive():
            self._opener.join(self.close_timeout_s)
        self._close_session()

    def _open_session(self) -> None:
        """Open the zenoh session and declare all keys."""
        raise NotImplementedError

    def _report_failure(self, error: Exception) -> None:
        """Store the reason why the session could not be opened."""
        raise NotImplementedError

    def _work_until_closed(self) -> None:
        """Monitor the connection or send messages until the session is closed."""
        raise NotImplementedError

    def _keep_open(self) -> None:
        """Open the session, retrying on failure, and then run until the session is closed."""
        errors: tuple[type[Exception], ...] = (*zenoh_errors(), OSError)
        while self._session is None and not self.closing.is_set():
            try:
                self._open_session()
            except errors as error:
                self._close_session()
                self._report_failure(error)
                self.closing.wait(RETRY_S)
            except Exception:
                self._close_session()
                raise
            else:
                break
        self._work_until_closed()
        if self.closing.is_set():  # close() may have returned before the session was open
            self._close_session()

    def _close_session(self) -> None:
        session, self._session = self._session, None
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]
        threads, self._receivers = self._receivers, []
        for thread in threads:
            thread.join(JOIN_TIMEOUT_S)

    def _start_receiving(self, key: str, source: Any, process: Callable[[Any], None]) -> None:
        args = (source, process)
        thread = threading.Thread(target=self._receive, args=args, name=f"zenoh {key}", daemon=True)
        thread.start()
        self._receivers = [*(one for one in self._receivers if one.is_alive()), thread]

    def _receive(self, source: Any, process: Callable[[Any], None]) -> None:
        handler = source.handler  # keeping only the handler allows zenoh to undeclare the source while a thread waits
        while not self.closing.is_set():
            try:
                received = handler.recv()
            except zenoh_errors():
                return
            try:
                process(received)
            except Exception as error:  # noqa: BLE001 - the status shows the error, and later messages are processed
                self._receiver_failure.note(threading.current_thread().name, error)


@cache
def zenoh_errors() -> tuple[type[Exception], ...]:
    """Return the exception classes of zenoh without importing zenoh at module level."""
    import zenoh

    return (zenoh.ZError,)
