"""Ports of simulated sensors: pseudo-terminal, virtual CAN bus or zenoh key. A port is the sensor side of a link."""

import contextlib
import os
import secrets
import select
import shutil
import socket
import tempfile
import threading
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from drivers.data_types import EXTENDED_ID, Chunk
from drivers.errors import LinkUnavailable
from drivers.links import can_link, serial_link, zenoh_link
from drivers.links.base import Link
from drivers.zenoh.session_config import build_session_config, format_zenoh_error

if TYPE_CHECKING:
    import can
    import zenoh


class Port:
    """Base class of the ports of simulated sensors.

    ``plug`` and ``unplug`` are thread-safe. Repeated calls have no effect.

    Parameters
    ----------
    link : Link
        Link that receives the data of the simulated sensor.
    """

    def __init__(self, link: Link) -> None:
        self.link = link
        self._plugging = threading.Lock()

    def plug(self) -> None:
        """Connect the simulated sensor to the link.

        Raises
        ------
        LinkUnavailable
            If the port cannot be opened.
        """
        raise NotImplementedError

    def unplug(self) -> None:
        """Disconnect the simulated sensor from the link, as if a cable were pulled."""
        raise NotImplementedError

    def send_and_count_chunks(self, chunks: Sequence[Chunk]) -> int:
        """Send chunks without waiting for a reader, and return the number of completely sent chunks."""
        raise NotImplementedError

    def close(self) -> None:
        """Disconnect the simulated sensor permanently, and remove temporary files."""
        self.unplug()


def create_port(carrier: str, link_lost_after_s: float) -> Port:
    """Create the port of a simulated sensor for a carrier.

    Parameters
    ----------
    carrier : str
        Carrier of the wire format: "frames" for CAN, "messages" for zenoh, otherwise serial bytes.
    link_lost_after_s : float
        Time in seconds without data after which the link counts as lost.
    """
    if carrier == "frames":
        return CanPort(link_lost_after_s)
    if carrier == "messages":
        return ZenohPort(link_lost_after_s)
    return PtyPort(link_lost_after_s)


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


ID_MASK: Final = 0x1FFF_FFFF
"""Mask of the CAN identifier in the address of a chunk."""
CLASSIC_BYTES: Final = 8
"""Largest payload of a classic CAN frame in bytes. Longer frames are CAN FD frames."""


class CanPort(Port):
    """Port of a simulated sensor on a virtual CAN bus.

    The link is lost after ``link_lost_after_s`` seconds without frames.
    """

    def __init__(self, link_lost_after_s: float) -> None:
        self._channel = f"imu-monitor-{secrets.token_hex(8)}"
        settings = can_link.Settings(interface="virtual", channel=self._channel, silence=link_lost_after_s)
        super().__init__(can_link.build(settings))
        self._bus: can.BusABC | None = None

    def plug(self) -> None:
        """Connect the simulated sensor to the virtual CAN bus."""
        import can

        with self._plugging:
            if self._bus is None:
                self._bus = can.Bus(interface="virtual", channel=self._channel, ignore_config=True)

    def unplug(self) -> None:
        """Disconnect the simulated sensor from the virtual CAN bus."""
        with self._plugging:
            bus, self._bus = self._bus, None
            if bus is not None:
                bus.shutdown()

    def send_and_count_chunks(self, chunks: Sequence[Chunk]) -> int:
        """Send each chunk as one CAN frame, and return the number of sent chunks."""
        import can

        with self._plugging:
            if self._bus is None:
                return 0
            for chunk in chunks:
                self._bus.send(
                    can.Message(
                        arbitration_id=chunk.address & ID_MASK,
                        is_extended_id=bool(chunk.address & EXTENDED_ID),
                        is_fd=len(chunk.data) > CLASSIC_BYTES,
                        data=chunk.data,
                    )
                )
        return len(chunks)


KEY: Final = "imu-monitor/virtual/samples"
"""Zenoh key of the published samples."""


class ZenohPort(Port):
    """Port of a simulated sensor with a separate zenoh session.

    The link is lost after ``link_lost_after_s`` seconds without messages.
    """

    def __init__(self, link_lost_after_s: float) -> None:
        self._endpoint = f"tcp/127.0.0.1:{_free_port()}"
        settings = zenoh_link.Settings(key=KEY, connect=(self._endpoint,), silence=link_lost_after_s)
        super().__init__(zenoh_link.build(settings))
        self._session: zenoh.Session | None = None
        self._publisher: Any = None

    def plug(self) -> None:
        """Open the zenoh session of the simulated sensor."""
        import zenoh

        with self._plugging:
            if self._session is not None:
                return
            try:
                self._session = zenoh.open(build_session_config({"listen/endpoints": [self._endpoint]}))
                self._publisher = self._session.declare_publisher(KEY)
            except zenoh.ZError as error:
                raise LinkUnavailable(f"simulated sensor at {self._endpoint}: {format_zenoh_error(error)}") from error

    def unplug(self) -> None:
        """Close the zenoh session of the simulated sensor."""
        with self._plugging:
            session, self._session = self._session, None
            if session is not None:
                session.close()  # type: ignore[no-untyped-call]

    def send_and_count_chunks(self, chunks: Sequence[Chunk]) -> int:
        """Publish each chunk as one zenoh message, and return the number of published chunks."""
        with self._plugging:
            if self._session is None:
                return 0
            for chunk in chunks:
                self._publisher.put(chunk.data, attachment=chunk.attachment or None)
        return len(chunks)


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port: int = server.getsockname()[1]
        return port
