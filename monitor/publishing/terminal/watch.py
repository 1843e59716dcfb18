"""Command ``imu-monitor watch``, which shows a live table of devices, or prints the messages of daemons as JSON.

With ``--json``, each line is an object with the keys ``key`` (zenoh key), ``topic`` and ``message``. ``message`` is the
payload as ``docs/reference/messages.md`` describes it. Messages with samples are msgpack on the wire. Each column
becomes an array.
"""

import contextlib
import math
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, TextIO, cast

import msgspec

from drivers.data_types import AXES, ns_to_seconds
from drivers.errors import DecodeError
from drivers.zenoh.sample_message import TEMPERATURE, decode_samples
from monitor.common import topics
from monitor.common.unit_formatting import DEFAULT_UNITS, UnitSystem
from monitor.publishing.messages.message import MAX_PAYLOAD_BYTES, decode_message, encode_json
from monitor.publishing.messages.results import AllanMessage
from monitor.publishing.remote_device_states import RemoteDeviceRegistry, split_device_and_topic
from monitor.publishing.terminal.console import Console
from monitor.publishing.terminal.live_device_table import LiveTable, device_overview
from monitor.publishing.terminal.queued_writer import QueuedWriter, reader_is_gone
from monitor.publishing.zenoh.subscriber import (
    BACKLOG_BYTES,
    KEYEXPR,
    TOPICS,
    ReceivedMessageOrLiveliness,
    ZenohSubscriber,
)

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

    If the key expression has no wildcard, the Allan deviations of the device are drawn below the table. They are the
    largest results, and are therefore not received from many devices.

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
    received = TOPICS if "*" in keyexpr else (*TOPICS, topics.ALLAN)
    with (
        contextlib.closing(ZenohSubscriber(keyexpr, connect, file, received=received)) as subscriber,
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
        elif (split := split_device_and_topic(message.key)) and split[1] is topics.ALLAN:
            _store_allan_curve(states, split[0], message.payload)
        else:
            states.process_message(message.key, message.payload)
    states.note = connection_note(states, subscriber)


def _store_allan_curve(states: RemoteDeviceRegistry, device: str, payload: bytes) -> None:
    known = states.device_coefficients(device)
    if known is None:
        return
    try:
        estimate = decode_message(AllanMessage, payload).to_estimate(known.coefficients, known.k_or_r)
    except ValueError:
        states.malformed += 1
    else:
        states.set_allan_curve(device, estimate.curve)


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


RESULT_TOPICS: Final = tuple(one for one in topics.TOPICS if one.encoding == topics.JSON and one.when != "query")
SAMPLE_TOPICS: Final = tuple(one for one in topics.TOPICS if one.encoding == topics.MSGPACK)
"""Topics that contain most of the data. They are printed only if the key expression names them."""
WAIT_S: Final = 0.25
"""Longest time [s] until the function notices that it must stop, or that nobody reads its output."""


def print_messages_as_json(
    keyexpr: str,
    connect: Sequence[str],
    stop: threading.Event,
    stream: TextIO,
    errors: TextIO,
    duration_s: float | None = None,
    file: Path | None = None,
) -> None:
    """Print each message as one line of JSON, until ``stop`` is set or the reader closes the pipe.

    A separate thread writes the lines. If the reader is too slow, the oldest lines are dropped and counted.

    Parameters
    ----------
    keyexpr
        Pattern of zenoh keys (key expression) that selects devices or topics.
    connect
        Endpoints of daemons or routers.
    stop
        Event that ends the function when it is set.
    stream
        Stream that receives the lines.
    errors
        Stream that receives notes about the connection and about lost messages.
    duration_s
        Time [s] after which the function ends. By default, there is no limit.
    file
        zenoh configuration file.

    Raises
    ------
    ConfigError
        If zenoh rejects the key expression, an endpoint or the configuration file.
    OSError
        If the stream cannot be written, for example because the disk is full.
    """
    name = keyexpr.rpartition("/")[2]
    received = (*RESULT_TOPICS, *(topic for topic in SAMPLE_TOPICS if topic.name == name))
    end_s = math.inf if duration_s is None else time.monotonic() + duration_s
    problem, messages, malformed = "", 0, 0
    with (
        contextlib.closing(ZenohSubscriber(keyexpr, connect, file, received=received)) as subscriber,
        contextlib.suppress(BrokenPipeError, KeyboardInterrupt),
        QueuedWriter(stream, STDOUT, limit=BACKLOG_BYTES) as writer,
    ):
        subscriber.start()
        while not (stop.is_set() or time.monotonic() > end_s or reader_is_gone(stream)):
            if (error := writer.error) is not None:
                raise error
            for message in subscriber.take(WAIT_S):
                messages += 1
                line = json_line(message)
                malformed += not line
                writer.put(line)
            before, problem = problem, connection_problem(subscriber, messages > 0)
            if problem != before:
                _report(errors, problem or "connected")
    dropped = subscriber.dropped + writer.dropped_lines
    if dropped and not reader_is_gone(stream):
        _report(errors, f"{dropped:,} messages dropped: this computer or the reader of {STDOUT} is too slow")
    if malformed:
        _report(errors, f"{malformed:,} malformed messages left out")


def _report(errors: TextIO, text: str) -> None:
    with contextlib.suppress(OSError, ValueError):  # the stream is closed, or the disk is full
        print(f"imu-monitor: {text}", file=errors, flush=True)


def json_line(received: ReceivedMessageOrLiveliness) -> str:
    """Return a message as one line of JSON, or an empty string if the message is malformed.

    >>> json_line(ReceivedMessageOrLiveliness("imu/bench-1/alive", None))
    '{"key":"imu/bench-1/alive","topic":"alive","message":{"device":"bench-1","alive":true}}\\n'

    Parameters
    ----------
    received
        Message of a device, or notice about a liveliness token.
    """
    split = split_device_and_topic(received.key)
    if split is None:
        return ""
    device, topic = split
    try:
        message = _decode(received, device, topic)
        line = encode_json({"key": received.key, "topic": topic.name, "message": message})
    except (ValueError, RecursionError, DecodeError):  # msgspec reports decoding errors as ValueError
        return ""
    return line.decode() + "\n"


def _decode(received: ReceivedMessageOrLiveliness, device: str, topic: topics.ZenohTopic) -> dict[str, Any]:
    """Return the payload of a message. Raise an exception if the payload is malformed."""
    if received.payload is None:
        return {"device": device.rpartition("/")[2], "alive": received.token_exists}
    if topic in SAMPLE_TOPICS:
        return _decode_sample_columns(received.payload, topic)
    if len(received.payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"the payload has {len(received.payload)} bytes; at most {MAX_PAYLOAD_BYTES} are read")
    return msgspec.json.decode(received.payload, type=dict[str, Any])


def _decode_sample_columns(payload: bytes, topic: topics.ZenohTopic) -> dict[str, Any]:
    found = decode_samples(payload)
    block = found.block
    columns = {axis: block.values[:, i] for i, axis in enumerate(AXES)} | {TEMPERATURE: block.temperature_c}
    return {
        "schema": topic.schema_name(),
        "device": found.device,
        "samples": found.total_samples,
        "lost": block.lost,
        "t": ns_to_seconds(block.t_ns),
        **columns,
    }
