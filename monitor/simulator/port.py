"""The far end of a link: where a simulated sensor is plugged in. One file a carrier, chosen by the wire format.

``link`` is the ordinary link that the service reads, and cannot tell from one to a sensor. Nothing is there before
``plug``; ``plug`` and ``unplug`` may be called from any thread, and twice without harm.
"""

from collections.abc import Sequence
from typing import Protocol

from drivers.links.base import Link
from drivers.sample import Chunk


class Port(Protocol):
    """Where a simulated sensor sends to."""

    link: Link

    def plug(self) -> None:
        """Be there; ``LinkUnavailable`` where that cannot be."""

    def unplug(self) -> None:
        """Be gone, as after a pulled cable."""

    def send(self, chunks: Sequence[Chunk]) -> int:
        """Send without waiting for any reader; how many of the chunks, from the first on, went out whole."""

    def close(self) -> None:
        """Be gone for good, and leave nothing."""


def port_of(carrier: str, silence_s: float) -> Port:
    """The far end of the link that brings such a carrier."""
    if carrier == "frames":
        from monitor.simulator.can_port import CanPort

        return CanPort(silence_s)
    if carrier == "messages":
        from monitor.simulator.zenoh_port import ZenohPort

        return ZenohPort(silence_s)
    from monitor.simulator.pty_port import PtyPort

    return PtyPort(silence_s)
