"""Command ``imu-monitor watch``, which shows a live table of all devices whose results daemons publish over zenoh."""

import contextlib
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final, TextIO, cast

from rich.console import Console

from monitor.common.unit_formatting import DEFAULT_UNITS, UnitSystem
from monitor.publishing.remote_device_states import RemoteDeviceRegistry
from monitor.publishing.terminal.live_device_table import LiveTable, device_overview
from monitor.publishing.terminal.queued_writer import QueuedWriter
from monitor.publishing.zenoh.subscriber import KEYEXPR, ZenohSubscriber

REFRESH_PERIOD_S: Final = 0.5
PLAIN_PERIOD_S: Final = 1.0
"""Interval between two tables if the output is not a terminal [s]."""
SILENCE_NOTE_S: Final = 5.0
"""Time without messages [s] after which a note is shown, because zenoh reports no error if access is denied."""
STDOUT: Final = "standard output"


def watch(
    keyexpr: str = KEYEXPR,
    connect: Sequence[str] = (),
    stop: threading.Event | None = None,
    console: Console | None = None,
    once_s: float | None = None,
    file: Path | None = None,
    units: UnitSystem = DEFAULT_UNITS,
) -> None:
    """Show the table of devices until ``stop`` is set or Ctrl-C is pressed.

    A separate thread writes the table, so that a blocked terminal or pipe delays neither messages nor the exit.

    Parameters
    ----------
    keyexpr
                Pattern of zenoh keys (key expression) that selects the devices.
    connect
        Endpoints of daemons or routers.
    stop
        Event that ends the function when it is set.
    console
        Console that formats the table.
    once_s
        Time [s] for which messages are collected before the table is printed once. By default, the table is updated.
    file
        zenoh configuration file.
    units
        Units of the table.

    Raises
    ------
    ConfigError
        If zenoh rejects the key expression, an endpoint or the configuration file.
    OSError
        If standard output cannot be written.
    """
    stop, console = stop or threading.Event(), console or Console()
    stream, states = cast("TextIO", console.file), RemoteDeviceRegistry()
    with (
        contextlib.closing(ZenohSubscriber(keyexpr, connect, file)) as subscriber,
        contextlib.suppress(KeyboardInterrupt),
    ):
        subscriber.start()
        if once_s is not None:
            stop.wait(once_s)
            _receive_messages(states, subscriber)
            with QueuedWriter(stream, STDOUT, LiveTable(console, states, units).render) as writer:
                writer.wait_until_written(stop)
        elif console.is_terminal:
            with QueuedWriter(stream, STDOUT, LiveTable(console, states, units).render, REFRESH_PERIOD_S) as writer:
                while not stop.wait(REFRESH_PERIOD_S) and writer.error is None:
                    _receive_messages(states, subscriber)
                    writer.request_redraw()
        else:
            with QueuedWriter(stream, STDOUT, limit=1) as writer:  # at most one table is queued
                while not stop.wait(PLAIN_PERIOD_S) and writer.error is None:
                    _receive_messages(states, subscriber)
                    with console.capture() as captured:
                        console.print(device_overview(states, time.monotonic(), units))
                    writer.put(captured.get())


def _receive_messages(states: RemoteDeviceRegistry, subscriber: ZenohSubscriber) -> None:
    for message in subscriber.take(0.0):
        if message.payload is None:
            states.set_liveliness_token(message.key, message.token_exists)
        else:
            states.process_message(message.key, message.payload)
    states.note = connection_note(states, subscriber)


def connection_note(states: RemoteDeviceRegistry, subscriber: ZenohSubscriber) -> str:
    """Describe problems of the connection and lost messages, or return an empty string if there are none.

    Parameters
    ----------
    states
        State of all devices.
    subscriber
        Subscriber that receives the messages.
    """
    problem = connection_problem(subscriber, bool(states.devices_with_problems_first(time.monotonic())))
    dropped = subscriber.dropped
    notes = [problem, f"{dropped:,} messages dropped: this computer is too slow" if dropped else ""]
    return "; ".join(filter(None, notes))


def connection_problem(subscriber: ZenohSubscriber, any_message: bool) -> str:
    """Describe the problem of the connection to the daemons, or return an empty string if there is none.

    Parameters
    ----------
    subscriber
        Subscriber that receives the messages.
    any_message
        True if a message has been received.
    """
    if subscriber.state != "ok":
        return subscriber.state
    if subscriber.all_connected_duration_s > SILENCE_NOTE_S and not any_message:
        return "connected, but no messages: no daemon is there, or access control refuses them"
    return ""
