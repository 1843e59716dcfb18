"""Viewer for the devices of many daemons, for the command ``imu-monitor view``.

The viewer shows a table of all devices and a list of all events. For devices shown in detail, the viewer also shows
samples, Allan plots and coefficients over time. Samples and Allan deviations are received only for these devices.
"""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

from drivers.errors import DecodeError
from drivers.zenoh.sample_message import decode_samples
from monitor.common import topics
from monitor.publishing.messages.message import decode_message
from monitor.publishing.messages.results import AllanMessage, EventMessage, StatusMessage
from monitor.publishing.remote_device_states import RemoteDevice, RemoteDeviceRegistry, split_device_and_topic
from monitor.publishing.rerun.panels.panel_text import fleet_text
from monitor.publishing.rerun.queued_view import RerunView
from monitor.publishing.result_kinds import AllDevicesTableText, SampleBatch
from monitor.publishing.terminal.watch import connection_note
from monitor.publishing.zenoh.subscriber import ReceivedMessageOrLiveliness, ZenohSubscriber

RECEIVE_TIMEOUT_S: Final = 0.1
TABLE_PERIOD_S: Final = 1.0
MAX_ROWS: Final = 40
"""Maximum number of rows in the device table. These rows fill about one screen."""


def full_device_key(device: str, keyexpr: str) -> str:
    """Return the full key of a device whose key may be relative to a key expression.

    >>> full_device_key("nose", "imu/**"), full_device_key("fleet/a7/nose", "fleet/**")
    ('imu/nose', 'fleet/a7/nose')

    Parameters
    ----------
    device
        Full key of the device, or the end of the key.
    keyexpr
        Pattern of zenoh keys (key expression) of the subscription.
    """
    fixed = []
    for part in keyexpr.split("/"):
        if "*" in part or part == device:
            break
        fixed.append(part)
    head = "/".join(fixed)
    return device if not head or device == head or device.startswith(f"{head}/") else f"{head}/{device}"


class FleetView:
    """Viewer of all devices that daemons publish.

    Parameters
    ----------
    subscriber
        Subscriber that receives the messages of all devices.
    viewer
        Viewer in which the results are drawn.
    detail
        Keys of the devices shown in detail.
    """

    def __init__(self, subscriber: ZenohSubscriber, viewer: RerunView, detail: Sequence[str]) -> None:
        self._subscriber = subscriber
        self._viewer = viewer
        self._detail = frozenset(detail)
        self.board = RemoteDeviceRegistry()
        self._silent: set[str] = set()  # devices shown in detail whose daemon sends nothing
        self.malformed = 0  # number of messages of devices shown in detail that could not be decoded

    def run(self, stop: threading.Event, report: Callable[[str], None], duration_s: float | None = None) -> None:
        """Process messages and draw the device table until ``stop`` is set.

        Parameters
        ----------
        stop
            Event that ends the method when it is set.
        report
            Function that receives the address of the web page and the problems after each change.
        duration_s
            Longest duration of the call [s], or None for no limit.
        """
        end_s = None if duration_s is None else time.monotonic() + duration_s
        table_s, reported = 0.0, ""
        while not stop.is_set() and (end_s is None or time.monotonic() < end_s):
            for message in self._subscriber.take(RECEIVE_TIMEOUT_S):
                self.process_message(message)
            now_s = time.monotonic()
            if now_s - table_s < TABLE_PERIOD_S:
                continue
            table_s = now_s
            self.draw_device_table(time.time(), now_s)
            page = self._viewer.url if self._viewer.url.startswith("http") else ""
            text = "; ".join(part for part in (page, self._problems()) if part)
            if text != reported:
                reported = text
                report(text)

    def process_message(self, message: ReceivedMessageOrLiveliness) -> None:
        """Update the device table from a message, and draw the results if the device is shown in detail."""
        if message.payload is None:
            self.board.set_liveliness_token(message.key, message.token_exists)
            return
        decoded = self.board.process_message(message.key, message.payload)
        device, topic = split_device_and_topic(message.key) or ("", topics.ALIVE)
        if isinstance(decoded, EventMessage) and decoded.t is not None:
            self._viewer.put(device, decoded.t, decoded.to_event())
        elif device not in self._detail:
            return
        elif isinstance(decoded, StatusMessage):
            if decoded.t is not None:
                self._viewer.put(device, decoded.t, decoded.to_health())
        elif decoded is None:
            try:
                self._show(device, topic, message.payload)
            except (ValueError, DecodeError):
                self.malformed += 1

    def draw_device_table(self, wall_s: float, now_s: float) -> None:
        """Draw the table of all devices.

        Parameters
        ----------
        wall_s
            Unix time at which the table is shown [s].
        now_s
            Current time [s] on the monotonic clock that gives the age of messages.
        """
        devices = self.board.devices_with_problems_first(now_s)
        note = connection_note(self.board, self._subscriber)
        self._viewer.put(
            "", wall_s, AllDevicesTableText(fleet_text(devices, now_s, MAX_ROWS, note, self._viewer.units))
        )
        silent = {one.key for one in devices if one.key in self._detail and one.sends_nothing(now_s)}
        for one in devices:
            if one.key in silent - self._silent:
                self._draw_silence(one, now_s - one.last_message_s)
        self._silent = silent

    def _draw_silence(self, device: RemoteDevice, silence_s: float) -> None:
        """Draw the state of a detailed device whose daemon sends nothing, because no status message contains it."""
        status = device.status
        if status is not None and status.t is not None:
            health = replace(status.to_health(), state="lost", rate_hz=None, text="the daemon sends no data")
            self._viewer.put(device.key, status.t + silence_s, health)

    def _show(self, device: str, topic: topics.ZenohTopic, payload: bytes) -> None:
        if topic is topics.SAMPLES:
            rows = decode_samples(payload).block
            unix_s = rows.t_ns / 1e9
            if unix_s.size:
                self._viewer.put(device, float(unix_s[-1]), SampleBatch(unix_s, rows.values, rows.temperature_c))
        elif topic is topics.ALLAN:
            message, known = decode_message(AllanMessage, payload), self.board.device_coefficients(device)
            if known is not None:
                estimate = message.to_estimate(known.coefficients, known.k_or_r)
                self._viewer.put(device, estimate.t_ns / 1e9, estimate)

    def _problems(self) -> str:
        viewer = self._viewer.state
        problems = [] if viewer in ("ok", "starting") else [f"viewer: {viewer}"]
        if self._subscriber.state != "ok":
            problems.append(self._subscriber.state)
        return "; ".join(problems)
