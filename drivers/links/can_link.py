"""Link to CAN buses through python-can. Each chunk contains one frame.

The hardware, the kernel or python-can passes on only frames with the identifiers that the decoder needs.

``Chunk.t_ns`` is the arrival time on the monotonic clock of the host. If a read is delayed, the queued frames arrived
some time before the read. The interfaces in ``HOST_STAMPED_INTERFACES`` stamp each frame on arrival with the system
clock of the host, which ``drivers.links.unix_to_monotonic_arrival`` converts. Other interfaces stamp frames with a
clock that drifts relative to the clock of the host. For other interfaces, ``Chunk.t_ns`` is the time of the read, and
the sample clock removes the jitter by regression.

``LinkLost`` is raised if the bus is off, the interface is down or the adapter is unplugged. Other error frames are
counted and ignored. Remote frames are ignored. The link sends nothing except commands that configure an adapter.
"""

import contextlib
import errno
import importlib.util
import logging
import math
import socket
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from pydantic import Field, SkipValidation

from drivers.data_types import ANY_SOURCE, EXTENDED_ID, Chunk
from drivers.errors import ConfigError, LinkLost, LinkUnavailable, describe_error
from drivers.host.extras import install_command, require_extra
from drivers.links.base import Carrier, Link, LinkSettings, PolledLink
from drivers.links.unix_to_monotonic_arrival import monotonic_arrival_ns
from drivers.validation.module_lookup import format_choices_by_similarity
from drivers.validation.number_ranges import BIT_RATE, format_value
from drivers.validation.settings_model import checked_by

if TYPE_CHECKING:
    import can

DEFAULT_DECODER: Final = "dbc"
MAX_FRAMES: Final = 1000
"""Maximum number of frames per read, equivalent to 65 ms on a fully loaded bus at 1 Mbit/s."""
NEXT_FRAME_WAIT_S: Final = 0.0005
"""Time in s to wait for another frame after a frame has been received.

With a timeout of 0, python-can would stop at the first rejected frame, although more frames may follow.
"""
MAX_READ_S: Final = 0.01
"""Longest time in s from the arrival of the first frame to the end of a read."""
MAX_WAIT_S: Final = 0.1
"""Longest single wait for a frame in s. A blocked read returns within this time after the link has been closed."""
HOST_STAMPED_INTERFACES: Final = ("socketcan", "virtual", "udp_multicast")
"""Interfaces that stamp a frame with the system clock of the host when the frame arrives."""
PROBE_TIMEOUT_S: Final = 2.0
BUS_OFF_INTERFACES: Final = ("socketcan", "virtual", "udp_multicast")
"""Interfaces whose error frames contain the SocketCAN error classes in the identifier."""
PACKAGES: Final[Mapping[str, tuple[str, str, str]]] = {
    "udp_multicast": ("msgpack", "msgpack", "imu-monitor[multicast]"),
    "canalystii": ("canalystii", "canalystii", "python-can[canalystii]"),
    "cantact": ("cantact", "cantact", "python-can[cantact]"),
    "gs_usb": ("gs_usb", "gs-usb", "python-can[gs-usb]"),
    "neovi": ("ics", "python-ics", "python-can[neovi]"),
    "nixnet": ("nixnet", "nixnet", "python-can[nixnet]"),
}
"""Module, package and pip requirement of each interface that needs an optional package.

The interfaces slcan, robotell, seeedstudio and serial need pyserial, which is always installed. The interfaces
socketcan, socketcand and virtual need no package. The other interfaces need a library of the adapter's manufacturer.
"""
BUS_OFF: Final = 0x40
"""Bit CAN_ERR_BUSOFF (linux/can/error.h) in the identifier of a SocketCAN error frame."""
ID_MASK: Final = 0x1FFF_FFFF


def _check_channel(channel: object) -> None:
    if not isinstance(channel, str | int) or isinstance(channel, bool):
        raise ConfigError(f"expected text in quotes or a whole number, got {format_value(channel)}")


class Settings(LinkSettings):
    """Keys of a CAN link."""

    interface: str = Field(
        "socketcan", description="interface of python-can: socketcan, slcan, pcan, udp_multicast, virtual, ..."
    )
    channel: Annotated[str | int, SkipValidation, checked_by(_check_channel)] = Field(
        "can0", description="name or number of the bus, as python-can names it for this interface"
    )
    bitrate: Annotated[int, BIT_RATE] | None = Field(
        None,
        examples=[500_000],
        description="bit rate; absent: as set in the interface, e.g. by ip link set can0 up type can bitrate 500000",
    )
    fd: bool = Field(False, description="true: use CAN FD")
    data_bitrate: Annotated[int, BIT_RATE] | None = Field(
        None, examples=[2_000_000], description="bit rate of the data phase of CAN FD; absent: as set in the interface"
    )
    receive_own_messages: bool = Field(False, description="true: also receive the frames that this process sends")
    options: dict[str, Any] = Field({}, description="additional keys of python-can's Bus for this interface")


class CanLink(PolledLink):
    """Link to one CAN bus."""

    carrier: Carrier = "frames"
    epoch: Literal["monotonic", "unix"] = "monotonic"

    def __init__(self, settings: Settings) -> None:
        super().__init__(f"CAN {settings.interface} {settings.channel}")
        self._settings = settings
        self._filters: list[dict[str, Any]] | None = None
        self._bus: can.BusABC | None = None
        self.error_frames = 0
        self.garbled = 0  # number of lines from a text-based adapter that were not frames

    def set_address_filter(self, addresses: Sequence[int]) -> None:
        """Receive only frames with these addresses after the next call of ``open``. An empty sequence means all frames.

        ``EXTENDED_ID`` marks 29-bit identifiers. With ``ANY_SOURCE``, frames of a J1939 parameter group are received
        from any source address.
        """
        self._filters = [_filter_for_address(address) for address in addresses] or None

    def _is_open(self) -> bool:
        return self._bus is not None

    def _open_source(self) -> None:
        import can

        # Suppress the warnings that python-can logs for each missing vendor library.
        logging.getLogger("can").setLevel(logging.ERROR)
        s = self._settings
        if missing := describe_missing_package(s.interface):
            raise LinkUnavailable(missing)
        # python-can raises these exceptions if a vendor library or a key is missing.
        wrong_set_up = (NameError, AttributeError, TypeError, ValueError, ArithmeticError, NotImplementedError)
        try:
            _probe_server(s)
            self._bus = can.Bus(
                channel=s.channel,
                interface=s.interface,
                can_filters=self._filters,
                ignore_config=True,
                **self._bus_arguments(),
            )
        except (can.CanError, OSError, ImportError, *wrong_set_up) as error:
            raise LinkUnavailable(f"{self.name}: {_why_not_open(s, error)}") from error

    def _bus_arguments(self) -> dict[str, Any]:
        s = self._settings
        keys: dict[str, Any] = {"receive_own_messages": s.receive_own_messages}
        if s.bitrate is not None:
            keys["bitrate"] = s.bitrate
        if s.fd:
            keys["fd"] = True
        if s.data_bitrate is not None:
            keys["data_bitrate"] = s.data_bitrate
        return keys | s.options

    def _poll_source(self, deadline: float) -> list[Chunk]:
        wait_s = min(max(deadline - time.monotonic(), 0.0), MAX_WAIT_S)
        chunks: list[Chunk] = []
        until = math.inf
        for _ in range(MAX_FRAMES):
            message = self._receive_frame(NEXT_FRAME_WAIT_S if chunks else wait_s)
            if message is None:
                break
            if message.is_error_frame:
                self._count_error_frame(message)
            elif not message.is_remote_frame:
                chunks.append(self._to_chunk(message))
            now = time.monotonic()
            until = min(until, now + MAX_READ_S)
            if now >= until:
                break
        return chunks

    def _receive_frame(self, wait_s: float) -> "can.Message | None":
        """Return one CAN frame; None if no frame arrives within ``wait_s``. Raise LinkLost if the bus has failed."""
        import can

        bus = self._bus
        assert bus is not None
        asked_ns = time.monotonic_ns()
        try:
            try:
                message = bus.recv(wait_s)
            except (can.CanOperationError, ValueError) as error:
                if not isinstance(error, ValueError) and not isinstance(error.__cause__, ValueError):
                    raise
                # A text-based adapter has sent a line that is not a frame. slcan keeps a line with non-ASCII bytes in
                # a buffer, so every read would fail again unless the buffer is flushed.
                self.garbled += 1
                flush = getattr(bus, "flush", None)
                if flush is not None:
                    flush()
                return None
        except (can.CanError, OSError) as error:
            self._close_source()
            reason = error.__cause__ if isinstance(error.__cause__, Exception) else error
            raise LinkLost(
                f"{self.name}: the bus is gone (interface down or adapter unplugged): {describe_error(reason)}"
            ) from error
        if message is None:
            self.empty_ns = asked_ns
        return message

    def _to_chunk(self, message: "can.Message") -> Chunk:
        address = message.arbitration_id | (EXTENDED_ID if message.is_extended_id else 0)
        return Chunk(bytes(message.data), self._arrival_ns(message), address)

    def _arrival_ns(self, message: "can.Message") -> int:
        """Return the monotonic arrival time of a CAN frame, or the current time if the time stamp is unusable."""
        if self._settings.interface not in HOST_STAMPED_INTERFACES:
            return time.monotonic_ns()
        return monotonic_arrival_ns(round(message.timestamp * 1e9), self.empty_ns)

    def _count_error_frame(self, message: "can.Message") -> None:
        """Count an error frame. Raise LinkLost if the error frame reports bus-off."""
        self.error_frames += 1
        if self._settings.interface in BUS_OFF_INTERFACES and message.arbitration_id & BUS_OFF:
            self._close_source()
            raise LinkLost(f"{self.name}: bus off; check the bit rate, the wiring and the terminators")

    def _close_source(self) -> None:
        import can

        bus, self._bus = self._bus, None
        if bus is None:
            return
        # Closing the channel of an unplugged adapter fails, so errors are ignored.
        with contextlib.suppress(can.CanError, OSError):
            bus.shutdown()


def describe_missing_package(interface: str) -> str:
    """Return an error message if a python-can interface needs a missing package; otherwise return ""."""
    module, package, requirement = PACKAGES.get(interface, ("", "", ""))
    if not module or importlib.util.find_spec(module) is not None:
        return ""
    return f"CAN interface {interface} needs the package {package}: {install_command(requirement)}"


def _probe_server(s: Settings) -> None:
    """Raise OSError if a socketcand server does not answer. python-can would try for 10 s to reach the server."""
    if s.interface == "socketcand":
        host, port = str(s.options.get("host", "127.0.0.1")), int(s.options.get("port", 29536))
        socket.create_connection((host, port), timeout=PROBE_TIMEOUT_S).close()


def _filter_for_address(address: int) -> dict[str, Any]:
    mask = identifier_mask(address)
    return {"can_id": address & mask, "can_mask": mask, "extended": bool(address & EXTENDED_ID)}


def identifier_mask(address: int) -> int:
    """Return the bits of the CAN identifier that a frame has in common with an address of a decoder."""
    if address & ANY_SOURCE:
        # SAE J1939-21: if the PDU format is below 240, the PDU-specific byte is a destination and not part of the
        # group.
        return 0x03FF_FF00 if (address >> 16 & 0xFF) >= 240 else 0x03FF_0000
    return ID_MASK if address & EXTENDED_ID else 0x7FF


def _why_not_open(s: Settings, error: Exception) -> str:
    import can

    number = getattr(error, "errno", None)
    if number == errno.EAFNOSUPPORT:
        return "this kernel has no CAN (AF_CAN); sudo modprobe can_raw, or use slcan"
    if number == errno.ENODEV:
        return "no such network interface; see: ip -brief link show type can"
    if number == errno.ENETDOWN:
        return f"the interface is down; sudo ip link set {s.channel} up type can bitrate 500000"
    if number in (errno.EACCES, errno.EPERM):
        return "no permission; for a serial adapter, add the user to the group dialout"
    if isinstance(error, ImportError | NameError | can.CanInterfaceNotImplementedError):
        return f"the vendor's library or driver is not installed: {describe_error(error)}"
    if isinstance(error, TypeError | ValueError | ArithmeticError):
        return f"python-can refuses these settings: {describe_error(error)}"
    return f"cannot be opened: {describe_error(error)}"


def build(settings: Settings) -> Link:
    """Return the link without opening the bus.

    Raises
    ------
    ConfigError
        If python-can is not installed or does not know the interface.
    """
    require_extra("can", "a CAN bus")
    from can.interfaces import VALID_INTERFACES

    if settings.interface not in VALID_INTERFACES:
        known = sorted(VALID_INTERFACES)
        raise ConfigError(f'interface: "{settings.interface}"{format_choices_by_similarity(settings.interface, known)}')
    return CanLink(settings)
