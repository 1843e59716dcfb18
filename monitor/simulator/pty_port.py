"""Port of a simulated sensor on a pseudo-terminal, which replaces a serial port.

A symbolic link keeps the path of the port constant. Bytes that do not fit into the buffer of the pseudo-terminal are
dropped.
"""

import contextlib
import os
import select
import shutil
import tempfile
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path
from typing import Final

from drivers.data_types import Chunk
from drivers.links import serial_link
from monitor.simulator.port import Port

WAIT_S: Final = 0.01
"""Maximum waiting time for space in the buffer of the pseudo-terminal."""


class PtyPort(Port):
    """Port of a simulated sensor on a pseudo-terminal.

    The link is lost after ``link_lost_after_s`` seconds without data.
    """

    def __init__(self, link_lost_after_s: float) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="imu-monitor-"))
        self.path = self._folder / "tty"
        settings = serial_link.Settings(port=str(self.path), baudrate=921600, silence=link_lost_after_s)
        super().__init__(serial_link.build(settings))
        self._master: int | None = None

    def plug(self) -> None:
        """Create the pseudo-terminal and the symbolic link."""
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
        """Close the pseudo-terminal, and remove the symbolic link."""
        with self._plugging:
            master, self._master = self._master, None
            self.path.unlink(missing_ok=True)
            if master is not None:
                os.close(master)

    def send_and_count_chunks(self, chunks: Sequence[Chunk]) -> int:
        """Write chunks to the pseudo-terminal until the buffer is full. Return the number of completely written
        chunks."""
        data = b"".join(chunk.data for chunk in chunks)
        view = memoryview(data)
        with self._plugging, contextlib.suppress(BlockingIOError):
            while view and self._master is not None:
                if not select.select([], [self._master], [], WAIT_S)[1]:
                    break
                view = view[os.write(self._master, view) :]
        written = len(data) - len(view)
        return sum(end <= written for end in accumulate(len(chunk.data) for chunk in chunks))

    def close(self) -> None:
        """Disconnect the simulated sensor, and remove the folder of the symbolic link."""
        self.unplug()
        shutil.rmtree(self._folder, ignore_errors=True)
