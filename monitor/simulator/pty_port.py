"""Port of a simulated sensor on a pseudo-terminal: the sensor writes to the master side, the serial link reads the
slave.

A symbolic link in a temporary folder keeps the name of the port the same across disconnections. Data that does not fit
into the buffer of the terminal is dropped.
"""

import contextlib
import os
import select
import shutil
import tempfile
import threading
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path
from typing import Final

from drivers.links import serial_link
from drivers.sample import Chunk

WAIT_S: Final = 0.01
"""Longest wait for space in the buffer of the terminal."""


class PtyPort:
    """Serial port that exists while it is connected.

    Parameters
    ----------
    silence_s : float
        Time in seconds without data after which the link counts as lost.
    """

    def __init__(self, silence_s: float) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="imu-monitor-"))
        self.path = self._folder / "tty"
        self.link = serial_link.build(serial_link.Settings(port=str(self.path), baudrate=921600, silence=silence_s))
        self._master: int | None = None
        self._plugging = threading.Lock()

    def plug(self) -> None:
        """Create the pseudo-terminal and the symbolic link to it."""
        import tty

        with self._plugging:
            if self._master is not None:
                return
            master, slave = os.openpty()
            tty.setraw(master)
            tty.setraw(slave)
            os.set_blocking(master, False)
            self.path.unlink(missing_ok=True)
            self.path.symlink_to(os.ttyname(slave))
            os.close(slave)
            self._master = master

    def unplug(self) -> None:
        """Remove the port, as a pulled cable does."""
        with self._plugging:
            master, self._master = self._master, None
            self.path.unlink(missing_ok=True)
            if master is not None:
                os.close(master)

    def send_chunks(self, chunks: Sequence[Chunk]) -> int:
        """Write chunks; return the number of complete chunks, counted from the first.

        Writing continues as long as the reader empties the buffer.
        """
        written = self._write(b"".join(chunk.data for chunk in chunks))
        return sum(end <= written for end in accumulate(len(chunk.data) for chunk in chunks))

    def close(self) -> None:
        """Remove the port and its folder."""
        self.unplug()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _write(self, data: bytes) -> int:
        """Write bytes until the buffer stays full; return the number of written bytes."""
        view = memoryview(data)
        with self._plugging, contextlib.suppress(BlockingIOError):
            while view and self._master is not None:
                if not select.select([], [self._master], [], WAIT_S)[1]:
                    break
                view = view[os.write(self._master, view) :]
        return len(data) - len(view)
