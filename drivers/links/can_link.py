"""CAN buses through python-can: one frame a chunk, as many as are there.

Identifiers that the decoder names are filtered in the hardware or the kernel where the interface can,
in python-can elsewhere. The first frame is waited for, what queued up behind it is drained with it.

``Chunk.t_ns`` is the host's monotonic clock at receipt. A reader that was held up finds many frames
waiting, which must not all bear the time of its waking: interfaces that stamp a frame with the host's
system clock as it arrives (``HOST_STAMPED``) tell each frame's age, which is taken off. The age is a
difference over milliseconds, so a step of the system clock shifts at most the frames then waiting; an age
outside 0 to 1 s is not believed. Other interfaces stamp with clocks of their own that drift against the
host's: there the moment of reading counts, and its jitter is the regression's work.

A bus that goes off, an interface set down and an adapter unplugged are ``LinkLost``; other error frames
and remote frames are counted and left aside. Nothing is sent, beyond what an adapter's own set-up needs.
"""

import contextlib
import errno
import importlib.util
import logging
import math
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import msgspec

from drivers.discovery import possible
from drivers.errors import ConfigError, LinkLost, LinkUnavailable
from drivers.extras import check_extra
from drivers.links.base import Carrier, Link, LinkSettings
from drivers.quantities import BIT_RATE, check_settings
from drivers.sample import ANY_SOURCE, EXTENDED_ID, Chunk

if TYPE_CHECKING:
    import can

DEFAULT_DECODER: Final = "dbc"
BATCH: Final = 1000
"""Frames; 65 ms of a fully loaded bus at 1 Mbit/s, so that no read is without end."""
GAP_S: Final = 0.0005
"""Wait for a frame behind another. Not 0: python-can, where it filters itself, then gives up at the first
frame that nobody asked for, though wanted ones may stand behind it."""
LINGER_S: Final = 0.01
"""A read gives its frames at the latest so long after the first of them, however many go on coming."""
SLICE_S: Final = 0.1
"""Longest single wait on the bus: a closed link is noticed within it."""
HOST_STAMPED: Final = ("socketcan", "virtual", "udp_multicast")
"""Interfaces whose time stamps are the host's system clock when the frame came in."""
OLDEST_S: Final = 1.0
CLOCK_PAIRS: Final = 3
"""Readings of both clocks, of which the closest counts."""
PROBE_S: Final = 2.0
SAY_BUS_OFF: Final = ("socketcan", "virtual", "udp_multicast")
"""Interfaces whose error frames have SocketCAN's classes in their identifier."""
PACKAGES: Final[Mapping[str, tuple[str, str, str]]] = {
    "udp_multicast": ("msgpack", "msgpack", "imu-monitor[multicast]"),
    "canalystii": ("canalystii", "canalystii", "python-can[canalystii]"),
    "cantact": ("cantact", "cantact", "python-can[cantact]"),
    "gs_usb": ("gs_usb", "gs-usb", "python-can[gs-usb]"),
    "neovi": ("ics", "python-ics", "python-can[neovi]"),
    "nixnet": ("nixnet", "nixnet", "python-can[nixnet]"),
}
"""Interfaces that need a package which neither this project nor python-can requires: module, package, what to install.

pyserial, for slcan, robotell, seeedstudio and serial, is required by this project. socketcan, socketcand and virtual
need no package. The other interfaces need a library of the adapter's maker.
"""
BUS_OFF: Final = 0x40
"""CAN_ERR_BUSOFF of linux/can/error.h, in the identifier of a socketcan error frame."""
ID_MASK: Final = 0x1FFF_FFFF


class Settings(LinkSettings, frozen=True, kw_only=True):
    """Keys of a CAN link."""

    interface: str = "socketcan"
    channel: str | int = "can0"
    bitrate: Annotated[int, BIT_RATE.meta] | None = None
    """bit/s; for socketcan it is set with the interface: ip link set can0 up type can bitrate 500000."""
    fd: bool = False
    data_bitrate: Annotated[int, BIT_RATE.meta] | None = None
    receive_own_messages: bool = False
    options: dict[str, Any] = msgspec.field(default_factory=dict)
    """Further keys of python-can's Bus for this interface."""


class CanLink:
    """One CAN bus."""

    carrier: Carrier = "frames"
    epoch: Literal["monotonic", "unix"] = "monotonic"

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._filters: list[dict[str, Any]] | None = None
        self._bus: can.BusABC | None = None
        self._closing = threading.Event()
        self._in_use = threading.Lock()  # held while the bus is read, opened or closed
        self.name = f"CAN {settings.interface} {settings.channel}"
        self.error_frames = 0
        self.garbled = 0  # adapter answers that were no frame

    def accept(self, addresses: Sequence[int]) -> None:
        """Receive only these identifiers from the next ``open`` on; none given: all.

        ``EXTENDED_ID`` marks 29-bit identifiers; with ``ANY_SOURCE`` only the J1939 parameter group of
        the identifier counts.
        """
        self._filters = [_filter(address) for address in addresses] or None

    def open(self) -> None:
        """Open the bus; ``LinkUnavailable`` says why it cannot be, and what to do."""
        import can

        # python-can reports vendor libraries that are not there as warnings of its own
        logging.getLogger("can").setLevel(logging.ERROR)
        with self._in_use:
            if self._bus is not None:
                return
            s = self._settings
            if missing := missing_package(s.interface):
                raise LinkUnavailable(missing)
            try:
                _probe(s)
                self._bus = can.Bus(
                    channel=s.channel,
                    interface=s.interface,
                    can_filters=self._filters,
                    ignore_config=True,
                    **self._keys(),
                )
            except (
                can.CanError,
                OSError,
                ImportError,
                # what python-can's own modules raise when a vendor's library or a key is missing
                NameError,
                AttributeError,
                TypeError,
                ValueError,
                ArithmeticError,
                NotImplementedError,
            ) as error:
                raise LinkUnavailable(_why_not_open(s, error)) from error
            self._closing.clear()

    def read(self, timeout_s: float) -> list[Chunk] | None:
        """The frames that are there, waiting up to ``timeout_s`` for the first."""
        deadline = time.monotonic() + timeout_s
        with self._in_use:
            while self._bus is not None and not self._closing.is_set():
                left = deadline - time.monotonic()
                chunks = self._drain(min(max(left, 0.0), SLICE_S))
                if chunks:
                    return chunks
                if time.monotonic() >= deadline:
                    return None
        raise LinkLost(f"{self.name}: the link is closed")

    def close(self) -> None:
        """Shut the bus down, once a waiting ``read`` has ended (within 0.1 s)."""
        self._closing.set()
        with self._in_use:
            self._shut_down()

    def _keys(self) -> dict[str, Any]:
        s = self._settings
        keys: dict[str, Any] = {"receive_own_messages": s.receive_own_messages}
        if s.bitrate is not None:
            keys["bitrate"] = s.bitrate
        if s.fd:
            keys["fd"] = True
        if s.data_bitrate is not None:
            keys["data_bitrate"] = s.data_bitrate
        return keys | s.options

    def _drain(self, wait_s: float) -> list[Chunk]:
        """Frames that are there, the first of them waited for."""
        chunks: list[Chunk] = []
        until = math.inf
        for _ in range(BATCH):
            message = self._receive(GAP_S if chunks else wait_s)
            if message is None:
                break
            if message.is_error_frame:
                self._note_error(message)
            elif not message.is_remote_frame:
                chunks.append(self._chunk(message))
            now = time.monotonic()
            until = min(until, now + LINGER_S)
            if now >= until:
                break
        return chunks

    def _receive(self, wait_s: float) -> "can.Message | None":
        import can

        bus = self._bus
        assert bus is not None
        try:
            try:
                return bus.recv(wait_s)
            except (can.CanOperationError, ValueError) as error:
                if not isinstance(error, ValueError) and not isinstance(error.__cause__, ValueError):
                    raise
                # a text adapter's line that is no frame; slcan keeps a line with bytes beyond ASCII in
                # its buffer, where it would fail for ever, unless that is flushed
                self.garbled += 1
                flush = getattr(bus, "flush", None)
                if flush is not None:
                    flush()
                return None
        except (can.CanError, OSError) as error:
            self._shut_down()
            reason = error.__cause__ if isinstance(error.__cause__, Exception) else error
            raise LinkLost(
                f"{self.name}: the bus is gone (interface down or adapter unplugged): {_plain(reason)}"
            ) from error

    def _chunk(self, message: "can.Message") -> Chunk:
        address = message.arbitration_id | (EXTENDED_ID if message.is_extended_id else 0)
        return Chunk(bytes(message.data), self._arrival_ns(message), address)

    def _arrival_ns(self, message: "can.Message") -> int:
        """Return the host's monotonic time at which the frame came in, or the present if its stamp is implausible."""
        now_ns = time.monotonic_ns()
        if self._settings.interface not in HOST_STAMPED:
            return now_ns
        age_ns = now_ns + _unix_minus_monotonic_ns() - round(message.timestamp * 1e9)
        return now_ns - age_ns if 0 <= age_ns <= OLDEST_S * 1e9 else now_ns

    def _note_error(self, message: "can.Message") -> None:
        self.error_frames += 1
        if self._settings.interface in SAY_BUS_OFF and message.arbitration_id & BUS_OFF:
            self._shut_down()
            raise LinkLost(f"{self.name}: bus off; check the bit rate, the wiring and the terminators")

    def _shut_down(self) -> None:
        import can

        bus, self._bus = self._bus, None
        if bus is None:
            return
        # an unplugged adapter cannot be told to close its channel; it is gone all the same
        with contextlib.suppress(can.CanError, OSError):
            bus.shutdown()


def missing_package(interface: str) -> str:
    """Return which package an interface of python-can lacks and how to install it; "" if none is missing."""
    module, package, requirement = PACKAGES.get(interface, ("", "", ""))
    if not module or importlib.util.find_spec(module) is not None:
        return ""
    return f'CAN interface {interface} needs the package {package}: pip install "{requirement}"'


def _unix_minus_monotonic_ns() -> int:
    """Return the difference of the host's two clocks in nanoseconds.

    On a loaded machine the thread may be interrupted between the two readings, so the closest of a few pairs counts.
    """
    pairs = []
    for _ in range(CLOCK_PAIRS):
        before_ns, unix_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        pairs.append((after_ns - before_ns, unix_ns - (before_ns + after_ns) // 2))
    return min(pairs)[1]


def _probe(s: Settings) -> None:
    """python-can tries a socketcand that is not there for 10 s: ask once whether anybody answers."""
    if s.interface == "socketcand":
        host, port = str(s.options.get("host", "127.0.0.1")), int(s.options.get("port", 29536))
        socket.create_connection((host, port), timeout=PROBE_S).close()


def _filter(address: int) -> dict[str, Any]:
    extended = bool(address & EXTENDED_ID)
    mask = ID_MASK if extended else 0x7FF
    if address & ANY_SOURCE:
        # SAE J1939-21: below PDU format 240 the third byte is a destination, not part of the group
        broadcast = (address >> 16 & 0xFF) >= 240
        mask = 0x03FF_FF00 if broadcast else 0x03FF_0000
    return {"can_id": address & mask, "can_mask": mask, "extended": extended}


def _why_not_open(s: Settings, error: Exception) -> str:
    """One line: what is wrong with the bus, and what would help."""
    import can

    name = f"CAN {s.interface} {s.channel}"
    number = getattr(error, "errno", None)
    if number == errno.EAFNOSUPPORT:
        return f"{name}: this kernel has no CAN (AF_CAN); sudo modprobe can_raw, or use slcan"
    if number == errno.ENODEV:
        return f"{name}: no such network interface; see: ip -brief link show type can"
    if number == errno.ENETDOWN:
        return f"{name}: the interface is down; sudo ip link set {s.channel} up type can bitrate 500000"
    if number in (errno.EACCES, errno.EPERM):
        return f"{name}: no permission; for a serial adapter, add the user to the group dialout"
    if isinstance(error, ImportError | NameError | can.CanInterfaceNotImplementedError):
        return f"{name}: the vendor's library or driver is not installed: {_plain(error)}"
    if isinstance(error, TypeError | ValueError | ArithmeticError):
        return f"{name}: python-can refuses these settings: {_plain(error)}"
    return f"{name}: cannot be opened: {_plain(error)}"


def _plain(error: Exception) -> str:
    return " ".join(str(error).split())


def build(settings: Settings) -> Link:
    """The link of these settings; opens nothing.

    Raises ``ConfigError`` for an interface that python-can does not know, for a number outside its range, and where
    python-can is not installed.
    """
    check_settings(settings)
    check_extra("can", "a CAN bus")
    from can.interfaces import VALID_INTERFACES

    if settings.interface not in VALID_INTERFACES:
        known = sorted(VALID_INTERFACES)
        raise ConfigError(f'interface: "{settings.interface}"{possible(settings.interface, known)}')
    return CanLink(settings)
