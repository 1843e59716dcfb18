"""Port of a simulated sensor on a virtual CAN bus (python-can).

The virtual bus has a random channel name, so that no other program uses the bus.
"""

import secrets
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from drivers.data_types import EXTENDED_ID, Chunk
from drivers.links import can_link
from monitor.simulator.port import Port

if TYPE_CHECKING:
    import can

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
