"""Serial ports, local or networked, by any URL that pyserial supports.

Bytes are returned as they arrive, without regard to frames. The reader waits for the first byte, then for a short time
(``read_timeout``, 10 ms) for more bytes, and takes all bytes that have arrived. The short wait needs a tenth of the
processor time of a wake-up per frame, and no byte waits longer than ``read_timeout``. URL handlers without a file
descriptor wake up at every arrival instead.

``close`` sets a flag and ends a waiting read. The port itself is closed after the read has ended. If the descriptor
were closed while a reader waits, its number could already belong to another file.

``open`` succeeds or raises ``LinkUnavailable``. The text names the cause and the remedy, such as a list of the existing
ports, a missing permission, or another program that uses the port. ``read`` returns bytes or None, or raises
``LinkLost`` if the device was unplugged or the other end closed the connection. Nothing is ever written to the device.
"""

import contextlib
import errno
import importlib.util
import os
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from drivers.credential_masking import mask_secrets
from drivers.discovery import format_choices
from drivers.errors import ConfigError, LinkLost, LinkUnavailable, describe_error
from drivers.links.base import Carrier, Link, LinkSettings, PolledLink
from drivers.quantities import BIT_RATE, READ_TIMEOUT_S, describe_range_errors
from drivers.sample import Chunk

if TYPE_CHECKING:
    import serial

DEFAULT_DECODER: Final = ""
READ_BYTES: Final = 4096
"""Maximum number of bytes per read, more than 10 ms at 3 Mbit/s. At higher rates the reader does not wait."""
STOP_BITS: Final = (1.0, 1.5, 2.0)
SCHEMES: Final = ("socket", "rfc2217", "loop", "spy", "alt", "hwgrep", "cp2110")
"""URL schemes that are part of pyserial."""


class Settings(LinkSettings, frozen=True, kw_only=True):
    """Keys of a serial link."""

    port: str
    """Device or URL: /dev/ttyUSB0, COM3, socket://host:port, rfc2217://host:port, hwgrep://REGEX."""
    baudrate: Annotated[int, BIT_RATE.meta] = 115200
    bytesize: Literal[5, 6, 7, 8] = 8
    parity: Literal["N", "E", "O", "M", "S"] = "N"
    stopbits: float = 1.0
    rtscts: bool = False
    xonxoff: bool = False
    exclusive: bool = True
    """True if other programs are prevented from reading the same port, where the system supports this."""
    read_timeout: Annotated[float, READ_TIMEOUT_S.meta] = 0.01
    """Time in s that bytes may wait for more bytes; at most 0.1."""


class SerialLink(PolledLink):
    """Link to one serial port."""

    carrier: Carrier = "bytes"
    epoch: Literal["monotonic", "unix"] = "monotonic"

    def __init__(self, settings: Settings) -> None:
        self._shown_port = mask_secrets(settings.port)
        super().__init__(f"{self._shown_port} at {settings.baudrate} baud")
        self._settings = settings
        self._port: serial.SerialBase | None = None
        self._buffer_filling = False  # True if the last read was so large that the next one must not wait

    def close(self) -> None:
        """Close the port after a waiting ``read`` has ended."""
        self._closing.set()
        cancel = getattr(self._port, "cancel_read", None)  # not every URL handler has it
        if cancel is not None:
            # cancelling fails if the reader has just closed the port; then no read is waiting
            with contextlib.suppress(OSError, TypeError):
                cancel()
        super().close()

    def _is_open(self) -> bool:
        return self._port is not None

    def _open_source(self) -> None:
        import serial

        s = self._settings
        try:
            self._port = serial.serial_for_url(
                s.port,
                baudrate=s.baudrate,
                bytesize=s.bytesize,
                parity=s.parity,
                stopbits=s.stopbits,
                rtscts=s.rtscts,
                xonxoff=s.xonxoff,
                timeout=s.read_timeout,
                # URL handlers without a lock ignore this key
                **({"exclusive": True} if s.exclusive else {}),
            )
        except (OSError, ValueError, NotImplementedError) as error:
            raise LinkUnavailable(mask_secrets(_why_not_open(s.port, error))) from error

    def _poll_source(self, deadline: float) -> list[Chunk]:
        data = self._read_available()
        return [Chunk(data, time.monotonic_ns())] if data else []

    def _read_available(self) -> bytes:
        """Read the bytes that arrive within the read timeout. Raise LinkLost if the device is gone."""
        port = self._port
        assert port is not None
        try:
            if not _has_file_number(port):
                data: bytes = port.read(READ_BYTES)
                return data
            until_s = time.monotonic() + self._settings.read_timeout
            data = port.read(1)
            if data:
                if not self._buffer_filling:
                    self._closing.wait(max(0.0, until_s - time.monotonic()))
                with contextlib.suppress(BlockingIOError):  # no more bytes have arrived
                    data += os.read(port.fileno(), READ_BYTES)
            self._buffer_filling = len(data) > READ_BYTES // 2
        except OSError as error:
            self._close_source()
            raise LinkLost(
                f"{self._shown_port}: the device is gone (unplugged, switched off, or read by another program): "
                f"{describe_error(error)}"
            ) from error
        return data

    def _close_source(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            port.close()


def _has_file_number(port: "serial.SerialBase") -> bool:
    """Return True if the port can be read by its file descriptor: it is pyserial's own non-blocking POSIX port."""
    import serial

    return os.name == "posix" and type(port).read is serial.Serial.read


def _why_not_open(port: str, error: Exception) -> str:
    """Return one line with the reason why a port cannot be opened, and the remedy."""
    number = getattr(error, "errno", None)
    if number == errno.ENOENT:
        return f"{port}: no such port; {_list_ports()}"
    if number in (errno.EACCES, errno.EPERM):
        return f"{port}: no permission; add the user to the group dialout (sudo usermod -aG dialout $USER)"
    if number in (errno.EAGAIN, errno.EBUSY):
        return f"{port}: held by another program; close the program, which this command finds: fuser {port}"
    if number in (errno.ENODEV, errno.ENXIO, errno.EIO):
        return f"{port}: no device behind this port; is it plugged in and switched on? {_list_ports()}"
    if number in (errno.ENOTTY, errno.EINVAL, errno.EISDIR):
        return f"{port}: not a serial port; {_list_ports()}"
    return f"{port}: cannot be opened: {describe_error(error)}"


def _list_ports() -> str:
    """Return a list of the existing ports for a message."""
    from serial.tools import list_ports

    found = sorted(info.device for info in list_ports.comports())
    return f"ports here: {', '.join(found)}" if found else "this computer has no serial port"


def build(settings: Settings) -> Link:
    """Return the link of these settings without opening it.

    Raises
    ------
    ConfigError
        The URL scheme is unknown, the number of stop bits is invalid, or a number is out of range.
    """
    if wrong := list(_problems(settings)):
        raise ConfigError(*wrong)
    return SerialLink(settings)


def _problems(settings: Settings) -> Iterator[str]:
    """Yield a line for each mistake in the settings."""
    scheme, found, _ = settings.port.partition("://")
    if not settings.port:
        yield 'port: empty; it is a port ("/dev/ttyUSB0") or a URL ("socket://host:port")'
    elif found and scheme.lower() not in SCHEMES and not _has_handler(scheme.lower()):
        yield f'port: "{settings.port}" has an unknown kind of URL "{scheme}"{format_choices(scheme, SCHEMES)}'
    if settings.stopbits not in STOP_BITS:
        yield f"stopbits: {settings.stopbits:g}; possible are 1, 1.5, 2"
    yield from describe_range_errors(settings)


def _has_handler(scheme: str) -> bool:
    """Return True if pyserial, or a package that extends it, has a handler for this URL scheme."""
    import serial

    packages: Any = serial.protocol_handler_packages
    return any(
        importlib.util.find_spec(f"{package}.protocol_{scheme}") is not None
        for package in packages
        if scheme.isidentifier() and importlib.util.find_spec(package) is not None
    )
