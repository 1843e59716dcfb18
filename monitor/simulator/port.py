"""Ports of simulated sensors. A port is the sensor side of a link.

``Port.link`` is an ordinary link, as for a real sensor.
"""

import threading
from collections.abc import Sequence

from drivers.data_types import Chunk
from drivers.links.base import Link


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
        from monitor.simulator.can_port import CanPort

        return CanPort(link_lost_after_s)
    if carrier == "messages":
        from monitor.simulator.zenoh_port import ZenohPort

        return ZenohPort(link_lost_after_s)
    from monitor.simulator.pty_port import PtyPort

    return PtyPort(link_lost_after_s)
