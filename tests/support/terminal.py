"""A pseudo-terminal for a simulated sensor that prints lines and waits for nobody."""

import os
import select
import tty
from pathlib import Path
from typing import Final

WAIT_S: Final = 0.005
"""For room in the terminal's buffer."""


class LineTerminal:
    """The sensor's end of a pseudo-terminal at ``port``.

    A line that finds no room is dropped and counted. A line that has been written in part is finished by the next
    call, so that a reader never sees two lines glued together.
    """

    def __init__(self, port: Path) -> None:
        self.port = port
        self.dropped = 0  # lines that were written in part or not at all
        self._master = -1
        self._rest = b""  # of a line that is in the terminal in part
        self.plug()

    def plug(self) -> None:
        """Make the port appear."""
        self._master, slave = os.openpty()
        tty.setraw(self._master)
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        self.port.unlink(missing_ok=True)
        self.port.symlink_to(os.ttyname(slave))
        os.close(slave)

    def pull(self) -> None:
        """Make the port go away, as a pulled cable does."""
        self.port.unlink(missing_ok=True)
        if self._master >= 0:
            os.close(self._master)
        self._master = -1
        self.dropped += bool(self._rest)
        self._rest = b""

    def write(self, lines: bytes) -> None:
        """Write whole lines as far as there is room."""
        data, partial = self._rest + lines, bool(self._rest)
        while data and self._master >= 0 and select.select([], [self._master], [], WAIT_S)[1]:
            try:
                n = os.write(self._master, data)
            except OSError:  # no room after all, or nobody at the other end
                break
            partial = not data[:n].endswith(b"\n")
            data = data[n:]
        end = data.find(b"\n") + 1 if partial else 0
        self._rest = data[:end]
        self.dropped += data.count(b"\n", end)
