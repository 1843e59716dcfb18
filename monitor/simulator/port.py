"""Ports of simulated sensors. A port is the sensor's end of the link that the service reads.

Each carrier has a module with its port. ``Port.link`` is an ordinary link, as for a real sensor.
"""

import threading
from collections.abc import Sequence

from drivers.data_types import Chunk
from drivers.links.base import Link


class Port:
    """Base class of the ports.

    Any thread may call ``plug`` and ``unplug``. Repeated calls have no effect.

    Parameters
    ----------
    link : Link
        Link that reads the data of the sensor.
    """

    def __init__(self, link: Link) -> None:
        self.link = link
        self._plugging = threading.Lock()

    def plug(self) -> None:
        """Connect the sensor.

        Raises
        ------
        LinkUnavailable
            If the port cannot be opened.
        """
        raise NotImplementedError

    def unplug(self) -> None:
        """Disconnect the sensor, as if its cable was pulled."""
        raise NotImplementedError

    def send_chunks(self, chunks: Sequence[Chunk]) -> int:
        """Send chunks without waiting for a reader; return the number of chunks that were sent completely."""
        raise NotImplementedError

    def close(self) -> None:
        """Disconnect the sensor permanently, and remove the files of the port."""
        self.unplug()


def create_port(carrier: str, silence_s: float) -> Port:
    """Create the port for a carrier.

    Parameters
    ----------
    carrier : str
        Carrier of the wire format: "frames" (CAN), "messages" (zenoh), otherwise bytes (serial).
    silence_s : float
        Time in seconds without data after which the link counts as lost.
    """
    if carrier == "frames":
        from monitor.simulator.can_port import CanPort

        return CanPort(silence_s)
    if carrier == "messages":
        from monitor.simulator.zenoh_port import ZenohPort

        return ZenohPort(silence_s)
    from monitor.simulator.pty_port import PtyPort

    return PtyPort(silence_s)
