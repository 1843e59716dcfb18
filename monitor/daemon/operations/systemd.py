"""What systemd is told: ready, how it goes, still alive, reloading, stopping; by datagrams on NOTIFY_SOCKET.

Without that variable nothing is told and nothing is different. A datagram that cannot be sent is dropped: systemd's
watchdog is the one who acts on silence.

``alive`` is the point: WATCHDOG=1 goes out only from the loop, and only while every reader of a sensor moves on: it
reads, times out or tries to open its link. A loop that hangs or a reader that is stuck in a driver ends the beat, and
systemd restarts the service. A device that is not there does not: its reader tries again and again. Protocol:
sd_notify(3), sd_watchdog_enabled(3).
"""

import contextlib
import os
import socket
import time
from collections.abc import Mapping, MutableMapping
from typing import Final

STUCK_S: Final = 20.0
"""That a reader may stand still at the least: pauses between attempts last 5 s, and an attempt may wait for a host."""
BEATS: Final = 3.0
"""In the time after which systemd gives up."""
VARIABLES: Final = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")


class Unit:
    """This process as a unit of systemd.

    Args:
        address: of the socket, a path or "@name"; "": none
        watchdog_s: systemd gives up after so long without a sign; None: it does not watch
        stuck_s: a reader that stands still for longer is stuck; STUCK_S or half of ``watchdog_s``
    """

    def __init__(self, address: str = "", watchdog_s: float | None = None, stuck_s: float | None = None) -> None:
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._watchdog_s = watchdog_s
        self._stuck_s = stuck_s or max(STUCK_S, 0.5 * (watchdog_s or 0.0))
        self._said = ""
        self._ready = False
        self._next_beat_s = 0.0
        self._turns: dict[str, tuple[int, float]] = {}  # of each reader, and since when it has had so many

    @classmethod
    def of(cls, environment: MutableMapping[str, str]) -> "Unit":
        """As the environment says; its variables are taken out, as they are not meant for children.

        >>> environment = {"NOTIFY_SOCKET": "/run/notify", "WATCHDOG_USEC": "60000000", "HOME": "/"}
        >>> Unit.of(environment).watched, environment
        (True, {'HOME': '/'})
        """
        address, usec, pid = (environment.pop(name, "") for name in VARIABLES)
        watched = usec.isdecimal() and int(usec) > 0 and pid in ("", str(os.getpid()))
        known = address.startswith(("/", "@"))
        return cls(address if known else "", int(usec) / 1e6 if known and watched else None)

    @property
    def watched(self) -> bool:
        """Whether systemd waits for signs of life."""
        return self._watchdog_s is not None

    @property
    def told_ready(self) -> bool:
        """Whether it has been told that the service is up."""
        return self._ready

    def ready(self) -> None:
        """The service is up, or has reloaded."""
        self._ready = True
        self._send("READY=1")

    def status(self, sentence: str) -> None:
        """How it goes, in one sentence; said again only when it is another one."""
        line = " ".join(sentence.split())
        if line != self._said:
            self._said = line
            self._send(f"STATUS={line}")

    def reloading(self) -> None:
        """The configuration is read again; ``ready`` ends it."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        """The service ends."""
        self._send("STOPPING=1")

    def alive(self, turns: Mapping[str, int], now_s: float) -> list[str]:
        """A sign of life if one is due and every reader moves on; those that are stuck.

        Args:
            turns: of each reader, how often it has read or tried to
            now_s: monotonic
        """
        self._turns = {
            name: self._turns[name] if self._turns.get(name, (-1, 0.0))[0] == count else (count, now_s)
            for name, count in turns.items()
        }
        stuck = [name for name, (_, since_s) in self._turns.items() if now_s - since_s > self._stuck_s]
        if self._watchdog_s is not None and not stuck and now_s >= self._next_beat_s:
            self._next_beat_s = now_s + self._watchdog_s / BEATS
            self._send("WATCHDOG=1")
        return stuck

    def _send(self, text: str) -> None:
        if not self._address:
            return
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
            notify.setblocking(False)
            notify.connect(self._address)
            notify.send(text.encode())
