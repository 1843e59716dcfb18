"""One viewer for many daemons: ``imu-monitor view``.

In come messages from zenoh, out go pictures: of all devices one table, those in trouble first, and the events of all;
of devices in detail what the daemon's own viewer shows: samples, Allan plots, coefficients and their courses. Samples
and curves are subscribed to for those alone, so that a fleet costs its status and coefficients. Message by message this
decides nothing: ``Board`` knows the devices, ``rebuilt`` makes results of messages, ``RerunView`` draws in its thread.
"""

import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

from drivers.errors import DecodeError
from drivers.zenoh.sample_message import unpack
from monitor.common import topics
from monitor.publishing.messages import decoding, remote_device
from monitor.publishing.rerun.panels import fleet_text
from monitor.publishing.rerun.view import RerunView
from monitor.publishing.terminal.live_table import Board, note
from monitor.publishing.zenoh.subscriber import Message, ZenohIn

TAKE_S: Final = 0.1
TABLE_S: Final = 1.0
ROWS: Final = 40
"""Of the table at most: what a screen holds; those left out have least trouble."""


def detail_key(device: str, keyexpr: str) -> str:
    """The key of a device as it was named: whole, or below what the key expression begins with.

    >>> detail_key("nose", "imu/**"), detail_key("fleet/a7/nose", "fleet/**"), detail_key("a7/nose", "fleet/**")
    ('imu/nose', 'fleet/a7/nose', 'fleet/a7/nose')
    """
    fixed = []
    for part in keyexpr.split("/"):
        if "*" in part or part == device:
            break
        fixed.append(part)
    head = "/".join(fixed)
    return device if not head or device == head or device.startswith(f"{head}/") else f"{head}/{device}"


class FleetView:
    """What is heard of all devices, and drawn.

    Args:
        arriving: subscriptions, those of the devices in detail among them
        viewer: draws, its devices are those in detail, by their keys
        detail: keys of devices in detail
    """

    def __init__(self, arriving: ZenohIn, viewer: RerunView, detail: Sequence[str]) -> None:
        self._arriving = arriving
        self._viewer = viewer
        self._detail = frozenset(detail)
        self._noise: dict[str, remote_device.Noise] = {}  # newest of the devices in detail
        self.board = Board()
        self.malformed = 0  # messages of devices in detail that are not what their key says

    def run(self, stop: threading.Event, tell: Callable[[str], None], seconds: float | None = None) -> None:
        """Until ``stop``; ``tell`` is told where the page is and what is wrong, whenever that changes."""
        end_s = None if seconds is None else time.monotonic() + seconds
        table_s, told = 0.0, ""
        while not stop.is_set() and (end_s is None or time.monotonic() < end_s):
            for message in self._arriving.take(TAKE_S):
                self.take(message)
            now_s = time.monotonic()
            if now_s - table_s < TABLE_S:
                continue
            table_s = now_s
            self.draw(time.time(), now_s)
            page = self._viewer.url if self._viewer.url.startswith("http") else ""
            said = "; ".join(part for part in (page, self._trouble()) if part)
            if said != told:
                told = said
                tell(said)

    def take(self, message: Message) -> None:
        """One message: to the table, and to the viewer where its device is in detail."""
        if message.payload is None:
            self.board.alive(message.key, message.there)
            return
        self.board.take(message.key, message.payload)
        found = remote_device.split(message.key)
        if found is None:
            return
        device, topic = found
        try:
            if topic is topics.EVENT:
                happened = remote_device.event(message.payload)
                self._viewer.event(device, happened.t, decoding.event(happened))
            elif device in self._detail:
                self._show(device, topic, message.payload)
        except (ValueError, DecodeError):
            self.malformed += topic not in (topics.STATUS, topics.COEFFICIENTS, topics.GAP)

    def draw(self, wall_s: float, now_s: float) -> None:
        """The table of all devices as it is now."""
        devices = self.board.devices(now_s)
        self._viewer.overview(wall_s, fleet_text(devices, now_s, ROWS, note(self.board, self._arriving)))

    def _show(self, device: str, topic: topics.Topic, payload: bytes) -> None:
        if topic is topics.SAMPLES:
            rows = unpack(payload).block
            self._viewer.samples(device, rows.t_ns / 1e9, rows.values, rows.temperature_c)
        elif topic is topics.COEFFICIENTS:
            self._noise[device] = remote_device.noise(
                remote_device.read(remote_device.CoefficientsMessage, topic, payload)
            )
        elif topic is topics.ALLAN and device in self._noise:
            allan = remote_device.read(remote_device.AllanMessage, topic, payload)
            self._viewer.estimate(device, allan.t, decoding.estimate(allan, self._noise[device]))
        elif topic is topics.STATUS:
            status = remote_device.status(payload)
            if status.t is not None:
                self._viewer.health(device, status.t, decoding.health(status))

    def _trouble(self) -> str:
        viewer = self._viewer.state
        said = [] if viewer in ("ok", "starting") else [f"viewer: {viewer}"]
        if self._arriving.state != "ok":
            said.append(self._arriving.state)
        return "; ".join(said)
