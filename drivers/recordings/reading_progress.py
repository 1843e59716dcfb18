"""Progress of reading a recording, which the readers of the file formats report to the command that reads the file."""

import io
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import IO, Any

from drivers.host.safe_file_reading import open_regular_file

_listener: ContextVar[Callable[[float], None] | None] = ContextVar("reading_progress", default=None)


@contextmanager
def listen_to_reading_progress(listener: Callable[[float], None]) -> Iterator[None]:
    """Call ``listener`` with the share of the file that has been read, from 0 to 1, until the context ends."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def report_read_share(done: float, total: float) -> None:
    """Report that ``done`` of ``total`` rows or bytes have been read. Nothing happens if nobody listens."""
    if (listener := _listener.get()) is not None and total > 0:
        listener(min(done / total, 1.0))


class _ReportingFile(io.FileIO):
    """File that reports its position after each read."""

    def readinto(self, buffer: Any) -> int | None:
        count = super().readinto(buffer)
        report_read_share(self.tell(), self.size_bytes)
        return count

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor, "rb")
        self.size_bytes = os.fstat(descriptor).st_size


def open_file_and_report_position(path: Path) -> IO[bytes]:
    """Open a regular file that is read from the beginning to the end, and report the position after each read."""
    with open_regular_file(path) as file:
        return io.BufferedReader(_ReportingFile(os.dup(file.fileno())))
