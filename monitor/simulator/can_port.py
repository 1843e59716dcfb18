"""A CAN bus of python-can in this process, whose channel nobody else knows.

As on a real bus, pulling the sensor off leaves the bus: the link notices by its silence.
"""

import secrets
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from drivers.links import can_link
from drivers.sample import EXTENDED_ID, Chunk

if TYPE_CHECKING:
    import can

ID_MASK: Final = 0x1FFF_FFFF
CLASSIC_BYTES: Final = 8


class CanPort:
    """A controller on a bus of its own."""

    def __init__(self, silence_s: float) -> None:
        self._channel = f"imu-monitor-{secrets.token_hex(8)}"
        self.link = can_link.build(can_link.Settings(interface="virtual", channel=self._channel, silence=silence_s))
        self._bus: can.BusABC | None = None
        self._plugging = threading.Lock()

    def plug(self) -> None:
        """Join the bus."""
        import can

        with self._plugging:
            if self._bus is None:
                self._bus = can.Bus(interface="virtual", channel=self._channel, ignore_config=True)

    def unplug(self) -> None:
        """Leave the bus."""
        with self._plugging:
            bus, self._bus = self._bus, None
            if bus is not None:
                bus.shutdown()

    def send(self, chunks: Sequence[Chunk]) -> int:
        """One frame a chunk."""
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

    def close(self) -> None:
        """Leave the bus for good."""
        self.unplug()
