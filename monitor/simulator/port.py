"""Ports of simulated sensors: the far end of the link that the service reads, one module for each carrier.

``link`` is an ordinary link, as for a real sensor. The port exists from ``plug`` to ``unplug``. Both methods may be
called from any thread, and repeated calls have no effect.
"""

from collections.abc import Sequence
from typing import Protocol

from drivers.links.base import Link
from drivers.sample import Chunk


class Port(Protocol):
    """Interface of the port to which a simulated sensor sends."""

    link: Link

    def plug(self) -> None:
        """Connect the sensor.

        Raises
        ------
        LinkUnavailable
            The port cannot be opened.
        """

    def unplug(self) -> None:
        """Disconnect the sensor, as a pulled cable does."""

    def send_chunks(self, chunks: Sequence[Chunk]) -> int:
        """Send chunks without waiting for a reader; return the number of complete chunks, counted from the first."""

    def close(self) -> None:
        """Disconnect the sensor permanently and remove all files of the port."""


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
