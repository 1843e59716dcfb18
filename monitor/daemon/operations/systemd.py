"""Notification of systemd by datagrams on NOTIFY_SOCKET: ready, status, watchdog, reloading and stopping.

Without the variable NOTIFY_SOCKET, no message is sent. The protocol is described in sd_notify(3) and
sd_watchdog_enabled(3).

``send_watchdog`` sends WATCHDOG=1 while every reader makes progress, which includes timeouts and attempts to open a
missing device. If the main loop hangs or a reader is stuck, no watchdog message is sent, and systemd restarts the
service.
"""

import contextlib
import os
import socket
import time
from collections.abc import Mapping, MutableMapping
from typing import Final

MIN_STUCK_S: Final = 20.0
"""Minimum time without progress after which a reader counts as stuck."""
BEATS_PER_TIMEOUT: Final = 3.0
"""Number of watchdog messages per watchdog timeout of systemd."""
VARIABLES: Final = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
"""Environment variables that systemd sets."""


class SystemdNotifier:
    """Notifier that sends messages of this process to systemd.

    Parameters
    ----------
    address : str, optional
        Address of the socket, which is a path or "@name". If the address is "", no message is sent.
    watchdog_s : float, optional
        Watchdog timeout of systemd in seconds, or None if the watchdog is off.
    stuck_s : float, optional
        Time in seconds without progress after which a reader counts as stuck. The default depends on ``watchdog_s``.
    """

    def __init__(self, address: str = "", watchdog_s: float | None = None, stuck_s: float | None = None) -> None:
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self.watchdog_s = watchdog_s
        self._stuck_s = stuck_s or max(MIN_STUCK_S, 0.5 * (watchdog_s or 0.0))
        self._said = ""
        self.ready_sent = False
        self._next_beat_s = 0.0
        self._turns: dict[str, tuple[int, float]] = {}  # read attempts of each reader, and the time of the last change

    @classmethod
    def from_environment(cls, environment: MutableMapping[str, str]) -> "SystemdNotifier":
        """Create a notifier from the environment variables of systemd, and remove these variables.

        Examples
        --------
        >>> environment = {"NOTIFY_SOCKET": "/run/notify", "WATCHDOG_USEC": "60000000", "HOME": "/"}
        >>> SystemdNotifier.from_environment(environment).watchdog_s, environment
        (60.0, {'HOME': '/'})
        """
        address, usec, pid = (environment.pop(name, "") for name in VARIABLES)
        watched = usec.isdecimal() and int(usec) > 0 and pid in ("", str(os.getpid()))
        known = address.startswith(("/", "@"))
        return cls(address if known else "", int(usec) / 1e6 if known and watched else None)

    def send_ready(self) -> None:
        """Send the message that the service has started or that a reload has finished."""
        self.ready_sent = True
        self._send("READY=1")

    def send_status(self, sentence: str) -> None:
        """Send the status in one sentence if the status has changed."""
        line = " ".join(sentence.split())
        if line != self._said:
            self._said = line
            self._send(f"STATUS={line}")

    def send_reloading(self) -> None:
        """Send the message that a reload has begun; ``send_ready`` reports the end."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def send_stopping(self) -> None:
        """Send the message that the service is stopping."""
        self._send("STOPPING=1")

    def send_watchdog(self, reader_progress_count: Mapping[str, int], now_s: float) -> list[str]:
        """Send a watchdog message if a message is due and no reader is stuck.

        Parameters
        ----------
        reader_progress_count : mapping of str to int
            Number of read attempts of each reader.
        now_s : float
            Present time on the monotonic clock, in seconds.

        Returns
        -------
        list of str
            Names of the stuck readers.
        """
        self._turns = {
            name: self._turns[name] if self._turns.get(name, (-1, 0.0))[0] == count else (count, now_s)
            for name, count in reader_progress_count.items()
        }
        stuck = [name for name, (_, since_s) in self._turns.items() if now_s - since_s > self._stuck_s]
        if self.watchdog_s is not None and not stuck and now_s >= self._next_beat_s:
            self._next_beat_s = now_s + self.watchdog_s / BEATS_PER_TIMEOUT
            self._send("WATCHDOG=1")
        return stuck

    def _send(self, text: str) -> None:
        if not self._address:
            return
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
            notify.setblocking(False)
            notify.connect(self._address)
            notify.send(text.encode())
