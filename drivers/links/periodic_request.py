"""Requests to a device that sends data only as an answer.

A separate thread writes the request at a fixed rate, so waiting for data does not delay a request. The request is
repeated whether or not the device has answered, so a lost request or answer costs only one sample.
"""

import contextlib
import threading
import time
from typing import TYPE_CHECKING, Final

from drivers.errors import ConfigError

if TYPE_CHECKING:
    import serial

MAX_REQUEST_BYTES: Final = 256
STOP_TIMEOUT_S: Final = 1.0
"""Longest time in s to wait for a write that is in progress."""


class PeriodicRequest:
    """Thread that writes a request to an open port until ``stop`` is called.

    Parameters
    ----------
    port
        Open port of pyserial.
    request
        Bytes of the request.
    rate_hz
        Number of requests per second.
    """

    def __init__(self, port: "serial.SerialBase", request: bytes, rate_hz: float) -> None:
        self._port = port
        self._request = request
        self._period_s = 1.0 / rate_hz
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._write_requests, name="requests", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread before the port is closed."""
        self._stopping.set()
        cancel = getattr(self._port, "cancel_write", None)  # some URL handlers lack this method
        if cancel is not None:
            cancel()
        self._thread.join(STOP_TIMEOUT_S)

    def _write_requests(self) -> None:
        due_s = time.monotonic() + self._period_s
        while not self._stopping.wait(max(due_s - time.monotonic(), 0.0)):
            # The thread that reads the port detects and reports a lost device.
            with contextlib.suppress(OSError):
                self._port.write(self._request)
            due_s = max(due_s + self._period_s, time.monotonic())


def parse_request(text: str) -> bytes:
    """Return the bytes of a request that is written in hexadecimal.

    >>> parse_request("AA 01 00 3C").hex()
    'aa01003c'

    Raises
    ------
    ConfigError
        If the text is not hexadecimal or too long.
    """
    try:
        request = bytes.fromhex(text)
    except ValueError:
        raise ConfigError(f'"{text[:60]}" is not hexadecimal; expected bytes such as "AA 01 00 3C"') from None
    if len(request) > MAX_REQUEST_BYTES:
        raise ConfigError(f"{len(request)} bytes; at most {MAX_REQUEST_BYTES} are possible")
    return request
