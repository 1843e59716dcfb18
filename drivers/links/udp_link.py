"""Link that receives UDP datagrams. Each chunk contains one datagram.

The decoder joins the datagrams to one byte stream. A lost datagram therefore damages at most the frame that begins in
the previous datagram. The kernel keeps at most RECEIVE_BUFFER_BYTES of unread datagrams and drops any others. Linux
reports the number of dropped datagrams and the arrival time of each datagram. On other systems, ``dropped_datagrams``
stays 0, and ``Chunk.t_ns`` is the time of the read.

After the first datagram, a read waits for BATCH_WAIT_S and then returns all datagrams that have arrived. One read per
datagram would take more processor time. UDP has no connections, so a sender that disappears causes only silence
(``LinkSettings.silence``). Any program that can reach the port can send datagrams. The link sends nothing.
"""

import contextlib
import errno
import socket
import struct
import sys
import time
from typing import Annotated, Final, Literal

from pydantic import Field

from drivers.data_types import Chunk
from drivers.errors import LinkLost, LinkUnavailable, describe_error
from drivers.links.base import Carrier, Link, LinkSettings, PolledLink
from drivers.links.unix_to_monotonic_arrival import monotonic_arrival_ns
from drivers.validation.number_ranges import PORT

DEFAULT_DECODER: Final = ""
RECEIVE_BUFFER_BYTES: Final = 1 << 20
"""Size in bytes of the receive buffer that is requested from the kernel, which may grant less."""
MAX_DATAGRAM_BYTES: Final = 65_535
MAX_DATAGRAMS: Final = 256
"""Maximum number of datagrams per read, which limits the memory of a read to 17 MB."""
BATCH_WAIT_S: Final = 0.01
"""Time in s that a read waits for more datagrams after the first one."""
MAX_WAIT_S: Final = 0.1
"""Longest single wait for a datagram in s. A blocked read returns within this time after the link has been closed."""

# Constants of Linux (asm-generic/socket.h), which Python does not define.
SO_TIMESTAMPNS: Final = 35
SO_RXQ_OVFL: Final = 40
TIMESPEC: Final = struct.Struct("@ll")
DROP_COUNT: Final = struct.Struct("@I")
ANCILLARY_BYTES: Final = socket.CMSG_SPACE(TIMESPEC.size) + socket.CMSG_SPACE(DROP_COUNT.size)


class Settings(LinkSettings):
    """Keys of a UDP link."""

    host: str = Field(
        "127.0.0.1",
        description='local address on which data are received; "0.0.0.0" = all, so that other computers can send',
    )
    port: Annotated[int, PORT] = Field(examples=[14550], description="UDP port on which data are received")


class UdpLink(PolledLink):
    """Link to one UDP port of this computer."""

    carrier: Carrier = "bytes"
    epoch: Literal["monotonic", "unix"] = "monotonic"

    def __init__(self, settings: Settings) -> None:
        super().__init__(f"UDP port {settings.port} of {settings.host}")
        self._settings = settings
        self._socket: socket.socket | None = None
        self._buffer = bytearray(MAX_DATAGRAM_BYTES)
        self._dropped_by_socket = 0  # number of datagrams that the kernel has dropped since the socket was opened

    def _is_open(self) -> bool:
        return self._socket is not None

    def _open_source(self) -> None:
        s = self._settings
        opened = None
        try:
            family, *_, address = socket.getaddrinfo(s.host, s.port, type=socket.SOCK_DGRAM)[0]
            opened = socket.socket(family, socket.SOCK_DGRAM)
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
            if sys.platform == "linux":
                with contextlib.suppress(OSError):  # an old kernel gives neither arrival times nor dropped datagrams
                    opened.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
                    opened.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
            opened.bind(address)
        except (OSError, UnicodeError) as error:
            if opened is not None:
                opened.close()
            raise LinkUnavailable(f"{self.name}: {_why_not_open(s, error)}") from error
        self._socket, self._dropped_by_socket = opened, 0

    def _poll_source(self, deadline: float) -> list[Chunk]:
        chunk = self._receive_datagram(min(max(deadline - time.monotonic(), 0.0), MAX_WAIT_S))
        if chunk is None:
            return []
        chunks = [chunk]
        self._closing.wait(BATCH_WAIT_S)
        while len(chunks) < MAX_DATAGRAMS and (chunk := self._receive_datagram(0.0)) is not None:
            chunks.append(chunk)
        return [chunk for chunk in chunks if chunk.data]

    def _receive_datagram(self, wait_s: float) -> Chunk | None:
        """Return one datagram, or None if no datagram arrives within ``wait_s``. Raise LinkLost if the socket fails."""
        assert self._socket is not None
        asked_ns = time.monotonic_ns()
        try:
            self._socket.settimeout(wait_s)
            size, ancillary, _, _ = self._socket.recvmsg_into([self._buffer], ANCILLARY_BYTES)
        except (TimeoutError, BlockingIOError):
            self.empty_ns = asked_ns
            return None
        except OSError as error:
            self._close_source()
            raise LinkLost(f"{self.name}: the network interface is gone: {describe_error(error)}") from error
        t_ns = time.monotonic_ns()
        for level, kind, data in ancillary:
            if (level, kind, len(data)) == (socket.SOL_SOCKET, SO_TIMESTAMPNS, TIMESPEC.size):
                seconds, nanoseconds = TIMESPEC.unpack(data)
                t_ns = monotonic_arrival_ns(seconds * 1_000_000_000 + nanoseconds, self.empty_ns)
            elif (level, kind, len(data)) == (socket.SOL_SOCKET, SO_RXQ_OVFL, DROP_COUNT.size):
                (dropped,) = DROP_COUNT.unpack(data)
                self.dropped_datagrams += (dropped - self._dropped_by_socket) % (1 << 32)
                self._dropped_by_socket = dropped
        return Chunk(bytes(memoryview(self._buffer)[:size]), t_ns)

    def _close_source(self) -> None:
        opened, self._socket = self._socket, None
        if opened is not None:
            opened.close()


def _why_not_open(settings: Settings, error: Exception) -> str:
    number = getattr(error, "errno", None)
    if number == errno.EADDRINUSE:
        return f"used by another program; find it with: ss -ulpn sport = :{settings.port}"
    if number == errno.EADDRNOTAVAIL:
        return 'host is no address of this computer; ip -brief address lists them, and "0.0.0.0" means all of them'
    if number in (errno.EACCES, errno.EPERM):
        return "no permission; choose a port above 1023"
    if number in (errno.EMFILE, errno.ENFILE):
        return "too many open files; raise the limit (ulimit -n, or LimitNOFILE of the systemd unit)"
    return f"cannot be opened; host must be an address of this computer: {describe_error(error)}"


def build(settings: Settings) -> Link:
    """Return the link without opening the port."""
    return UdpLink(settings)
