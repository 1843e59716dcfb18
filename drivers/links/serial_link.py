"""Link to local or networked serial ports, which are addressed by any URL that pyserial supports.

A read waits for ``read_timeout`` and returns all bytes received. If there are none, it waits for the next byte. Waiting
for more bytes takes much less processor time than one read per frame, and delays bytes by at most ``read_timeout``. If
the configuration states no ``read_timeout``, the daemon sets it according to the interval at which results are
published. If a URL handler has no file descriptor, a read returns as soon as bytes arrive.

``close`` closes the port only after a waiting read has ended. Otherwise, the system could assign the file descriptor to
another file during the read. If the port cannot be opened, the text of ``LinkUnavailable`` states the reason and a
remedy. ``LinkLost`` is raised if the device is unplugged or the connection is closed.

The link writes to the device only if the key ``first_request`` or ``request`` is set
(``drivers.links.periodic_request``).
"""

import contextlib
import errno
import importlib.util
import os
import time
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from pydantic import Field

from drivers.data_types import Chunk
from drivers.errors import ConfigError, LinkLost, LinkUnavailable, describe_error
from drivers.host.wake_signal import WakeSignal
from drivers.links.base import Carrier, Link, LinkSettings, PolledLink
from drivers.links.periodic_request import PeriodicRequest, parse_request
from drivers.secret_masking import mask_secrets
from drivers.validation.module_lookup import format_choices_by_similarity
from drivers.validation.number_ranges import BIT_RATE, READ_TIMEOUT_S, REQUEST_RATE_HZ
from drivers.validation.settings_model import checked_by

if TYPE_CHECKING:
    import serial

DEFAULT_DECODER: Final = ""
READ_BYTES: Final = 4096
"""Maximum number of bytes per system call. The buffer of a terminal in the Linux kernel has the same size."""
MAX_WAITING_BYTES: Final = 131_072
"""Number of bytes above which a read returns, and the next read does not wait.

Linux stores 64 KiB before bytes are lost. A read therefore empties the buffer, however long the reader was delayed.
"""
DEFAULT_READ_TIMEOUT_S: Final = 0.01
STOP_BITS: Final = (1.0, 1.5, 2.0)
SCHEMES: Final = ("socket", "rfc2217", "loop", "spy", "alt", "hwgrep", "cp2110")
"""URL schemes that pyserial supports without extensions."""


def _check_port(port: str) -> None:
    scheme, found, _ = port.partition("://")
    if not port:
        raise ConfigError('empty; it is a port ("/dev/ttyUSB0") or a URL ("socket://host:port")')
    if found and scheme.lower() not in SCHEMES and not _has_handler(scheme.lower()):
        raise ConfigError(
            f'"{port}" has an unknown kind of URL "{scheme}"{format_choices_by_similarity(scheme, SCHEMES)}'
        )


def _check_stop_bits(number: float) -> None:
    if number not in STOP_BITS:
        raise ConfigError(f"{number:g}; possible are 1, 1.5, 2")


class Settings(LinkSettings):
    """Keys of a serial link."""

    port: Annotated[str, checked_by(_check_port)] = Field(
        examples=["/dev/ttyUSB0"],
        description="device, or URL of pyserial: /dev/ttyUSB0, COM3, socket://host:port, rfc2217://host:port",
    )
    baudrate: Annotated[int, BIT_RATE] = Field(115200, description="baud rate")
    bytesize: Literal[5, 6, 7, 8] = Field(8, description="data bits")
    parity: Literal["N", "E", "O", "M", "S"] = Field("N", description="parity: none, even, odd, mark or space")
    stopbits: Annotated[float, checked_by(_check_stop_bits)] = Field(1.0, description="stop bits: 1, 1.5 or 2")
    rtscts: bool = Field(False, description="true: use hardware flow control")
    xonxoff: bool = Field(False, description="true: use software flow control")
    exclusive: bool = Field(True, description="true: other programs cannot open the port")
    read_timeout: Annotated[float, READ_TIMEOUT_S] | None = Field(
        None,
        examples=[0.01],
        description="time in s that received bytes may wait for more bytes; absent: interval of `publish`, 4 to 100 ms",
    )
    first_request: Annotated[str, checked_by(parse_request)] = Field(
        "", description="bytes in hexadecimal that are written once after the port has been opened; empty: none"
    )
    request: Annotated[str, checked_by(parse_request)] = Field(
        "",
        description="bytes in hexadecimal that are written repeatedly if the sensor only answers requests; empty: none",
    )
    request_rate: Annotated[float, REQUEST_RATE_HZ] = Field(100.0, description="number of requests per second")


class SerialLink(PolledLink):
    """Link to one serial port."""

    carrier: Carrier = "bytes"
    epoch: Literal["monotonic", "unix"] = "monotonic"

    def __init__(self, settings: Settings) -> None:
        self._shown_port = mask_secrets(settings.port)
        super().__init__(f"{self._shown_port} at {settings.baudrate} baud")
        self._settings = settings
        self._read_timeout_s = settings.read_timeout or DEFAULT_READ_TIMEOUT_S
        self._port: serial.SerialBase | None = None
        self._requests: PeriodicRequest | None = None
        self._file_number: int | None = None  # None if the port cannot be read through a file descriptor
        self._interrupt = WakeSignal()  # interrupts the wait for more bytes
        self._buffer_filling = False  # True if the last read returned so many bytes that the next read must not wait

    def set_default_read_timeout(self, timeout_s: float) -> None:
        """Set the time in s that received bytes may wait, unless the configuration states ``read_timeout``."""
        self._read_timeout_s = self._settings.read_timeout or timeout_s

    def close(self) -> None:
        """Interrupt a waiting call of ``wait_for_chunks_or_timeout``, then close the port."""
        self._closing.set()
        self._interrupt.set()
        cancel = getattr(self._port, "cancel_read", None)  # some URL handlers lack this method
        if cancel is not None:
            # An error means that the port has just been closed, so no read is waiting.
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
                timeout=self._read_timeout_s,
                # URL handlers that cannot lock a port ignore this key.
                **({"exclusive": True} if s.exclusive else {}),
            )
            self._file_number = self._port.fileno() if _has_file_number(self._port) else None
            self._interrupt.wait_and_clear(0.0)
            if s.first_request:
                self._port.write(parse_request(s.first_request))
        except (OSError, ValueError, NotImplementedError) as error:
            self._close_source()
            raise LinkUnavailable(mask_secrets(_why_not_open(s.port, error))) from error
        if s.request:
            self._requests = PeriodicRequest(self._port, parse_request(s.request), s.request_rate)

    def _poll_source(self, deadline: float) -> list[Chunk]:
        data = self._read_available()
        return [Chunk(data, time.monotonic_ns())] if data else []

    def _read_available(self) -> bytes:
        port = self._port
        assert port is not None
        try:
            if self._file_number is None:
                data: bytes = port.read(READ_BYTES)
                return data
            if not self._buffer_filling and self._interrupt.wait_and_clear(self._read_timeout_s):
                return b""
            data = b""
            try:
                while len(data) <= MAX_WAITING_BYTES:
                    asked_ns = time.monotonic_ns()
                    more = os.read(self._file_number, READ_BYTES)
                    data += more
                    if not more:
                        break
                    if len(data) < READ_BYTES // 2:  # the buffer of the terminal has not been full
                        self.empty_ns = asked_ns
                        break
            except BlockingIOError:  # no more bytes have arrived
                self.empty_ns = asked_ns
            self._buffer_filling = len(data) > MAX_WAITING_BYTES
            if not data:
                data = port.read(1)
        except OSError as error:
            self._close_source()
            raise LinkLost(
                f"{self._shown_port}: the device is gone (unplugged, switched off, or read by another program): "
                f"{describe_error(error)}"
            ) from error
        return data

    def _close_source(self) -> None:
        port, self._port = self._port, None
        requests, self._requests = self._requests, None
        if requests is not None:
            requests.stop()
        if port is not None:
            port.close()


def _has_file_number(port: "serial.SerialBase") -> bool:
    """Return True if the port can be read through a file descriptor."""
    import serial

    return os.name == "posix" and type(port).read is serial.Serial.read


def _why_not_open(port: str, error: Exception) -> str:
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
    from serial.tools import list_ports

    found = sorted(info.device for info in list_ports.comports())
    return f"ports here: {', '.join(found)}" if found else "this computer has no serial port"


def build(settings: Settings) -> Link:
    """Return the link without opening the port."""
    return SerialLink(settings)


def _has_handler(scheme: str) -> bool:
    """Return True if pyserial or an extension of pyserial has a handler for this URL scheme."""
    import serial

    packages: Any = serial.protocol_handler_packages
    return any(
        importlib.util.find_spec(f"{package}.protocol_{scheme}") is not None
        for package in packages
        if scheme.isidentifier() and importlib.util.find_spec(package) is not None
    )
