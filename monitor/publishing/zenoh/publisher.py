"""Publisher of results over zenoh: the topics of ``monitor.common.topics``, liveliness tokens and commands.

By default the session is closed to other hosts: a peer without scouting that listens on the loopback interface only. If
the port is in use, a free port is used and reported. If the session cannot be opened for another reason, the attempt is
repeated. ``state`` reports the reason, and messages are dropped meanwhile. The processing of samples continues. zenoh
queues outgoing messages and drops those of a slow subscriber, so ``put`` never waits. Advanced publishers keep the last
values for late subscribers, and plain subscribers are not affected.

Each device has a thread that answers queries of ``history``, because these read a file. A second thread takes commands
from a queryable and passes them through a queue to the main loop of the service, which answers them. Both threads read
from channels of zenoh, because a Python callback that is alive at exit would hang the process.
"""

import atexit
import contextlib
import json
import queue
import re
import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from drivers.credential_masking import mask_secrets
from drivers.errors import ConfigError, ImuError, NotReady
from drivers.zenoh.connection_errors import explain_refusals
from drivers.zenoh.session_config import (
    DEFAULT_CONFIGURATION,
    build_session_config,
    find_connect_endpoints,
    format_zenoh_error,
    is_unconnected,
)
from monitor.common import topics
from monitor.settings.loading import ZenohTable

if TYPE_CHECKING:
    import zenoh
    from zenoh.ext import AdvancedPublisher

RETRY_S: Final = 2.0
MAX_QUEUED_QUERIES: Final = 64
"""Capacity of the queue of commands and of each channel of queries."""
REFUSAL_CHECK_S: Final = 3.0
"""Interval between two checks of why a router refuses the connection."""
DUPLICATE_REPORT_S: Final = 10.0
"""Time for which another program that publishes under the key of a device is reported after its last message."""


@dataclass(frozen=True, slots=True)
class Command:
    """Query on ``command/<verb>``; it must be answered exactly once, by ``reply_result`` or ``reply_refusal``."""

    device: str
    verb: str
    reply_result: Callable[[bytes], None]
    reply_refusal: Callable[[str], None]


HistoryFunction = Callable[[str, str], bytes]
"""Function that returns the history of a device as a payload, given its name and the parameters of a selector; it
raises ImuError if there is none."""


class ZenohPublisher:
    """Publisher: the zenoh session of the daemon and all its declarations for each device.

    Parameters
    ----------
    settings
        Settings of the session.
    devices
        Names of the devices.
    read_history
        Function that answers queries of ``history``; None if no history is stored.
    """

    def __init__(
        self, settings: ZenohTable, devices: Sequence[str], read_history: HistoryFunction | None = None
    ) -> None:
        self.settings = settings
        self._read_history = read_history
        self._session_state = "off" if settings.mode == "none" else "not open yet"
        self._unsent = ""  # reason why the newest message could not be sent
        self.commands: queue.Queue[Command] = queue.Queue(MAX_QUEUED_QUERIES)
        self._devices = tuple(devices)
        self._alive: dict[str, bool] = dict.fromkeys(devices, False)
        self._session: zenoh.Session | None = None
        self._refusal = ""  # reason found by the newest check why the connection is refused
        self._connect: tuple[str, ...] = settings.connect
        self._publishers: dict[str, zenoh.Publisher | AdvancedPublisher] = {}
        self._tokens: dict[str, Any] = {}
        self._queryables: dict[str, list[Any]] = {}
        self._duplicates = _DuplicatePublishers(settings.prefix)
        self._declaring = threading.Lock()  # the opener declares all devices; the main loop adds and removes devices
        self._showing = threading.Lock()  # the opener and the main loop both declare liveliness tokens
        self._opener = threading.Thread(target=self._keep_open, name="zenoh open", daemon=True)
        self._query_threads: list[threading.Thread] = []
        self._closing = threading.Event()

    @property
    def state(self) -> str:
        """``ok``, or a description of the problem; part of the status message."""
        session = self._session
        if self._unsent or session is None:
            return self._unsent or self._session_state
        if self._connect and is_unconnected(session):
            return f"{self._refusal or 'nobody at ' + mask_secrets(', '.join(self._connect))}; trying again"
        duplicates = self._duplicates.duplicate_publisher_message(time.monotonic())
        if not duplicates:
            return self._session_state
        return f"{self._session_state}{'; ' if self._session_state != 'ok' else ', but '}{duplicates}"

    def start(self) -> None:
        """Open the session in a separate thread, so that a missing router does not delay the samples."""
        if self.settings.mode == "none":
            return
        # A thread that still receives from zenoh while the interpreter exits would abort the process.
        atexit.register(self.close)
        self._opener.start()

    def put(self, topic: topics.Topic, device: str, payload: bytes) -> None:
        """Publish a message; it is dropped if there is no session.

        Parameters
        ----------
        topic
            Topic of the message.
        device
            Name of the device.
        payload
            Encoded message.
        """
        import zenoh

        publisher = self._publishers.get(topic.key(self.settings.prefix, device))
        if publisher is None:
            return
        try:
            publisher.put(payload)
        except zenoh.ZError as error:
            self._unsent = f"cannot send: {format_zenoh_error(error)}"
        else:
            self._unsent = ""

    def put_key(self, key: str, payload: bytes) -> str:
        """Publish JSON under a key that the user has chosen; return "" or the reason why it was not sent.

        Parameters
        ----------
        key
            Key expression.
        payload
            JSON text.
        """
        import zenoh

        session = self._session
        if session is None:
            return f"not sent: zenoh: {self._session_state}"
        try:
            session.put(key, payload, encoding=zenoh.Encoding(topics.JSON), express=True)
        except zenoh.ZError as error:
            return f"not sent: zenoh: {format_zenoh_error(error)}"
        return ""

    def set_alive(self, device: str, flowing: bool) -> None:
        """Declare or remove the liveliness token of a device.

        Parameters
        ----------
        device
            Name of the device.
        flowing
            True if samples of the device arrive.
        """
        if self._alive[device] != flowing:
            self._alive[device] = flowing
            self._update_token(device)

    def add_device(self, device: str) -> None:
        """Add a device and declare its keys."""
        with self._declaring:
            self._devices += (device,)
            self._alive[device] = False
            if self._session is not None:
                with contextlib.suppress(*_zenoh_errors()):  # the session may be closing
                    self._declare(self._session, device)

    def remove_device(self, device: str) -> None:
        """Remove a device and undeclare its keys."""
        self.set_alive(device, False)
        with self._declaring, contextlib.suppress(*_zenoh_errors()):  # the session may be closing
            self._devices = tuple(one for one in self._devices if one != device)
            del self._alive[device]
            keys = {topic.key(self.settings.prefix, device) for topic in topics.TOPICS}
            removed = [self._publishers[key] for key in keys & self._publishers.keys()]
            self._publishers = {key: one for key, one in self._publishers.items() if key not in keys}
            for one in [*removed, *self._queryables.pop(device, []), *self._duplicates.forget_device(device)]:
                one.undeclare()

    def close(self) -> None:
        """Close the session, which removes its liveliness tokens, and stop the threads."""
        atexit.unregister(self.close)
        self._closing.set()
        if self._opener.is_alive():
            self._opener.join(RETRY_S)
        self._close_session()

    # --- opening of the session

    def _keep_open(self) -> None:
        """Open the session, then check at intervals why the connection is refused (runs in a thread)."""
        errors: tuple[type[Exception], ...] = (*_zenoh_errors(), OSError)
        while not self._closing.is_set():
            try:
                self._open()
            except errors as error:
                self._session_state = f"{self._find_refusal() or format_zenoh_error(error)}; trying again"
                self._close_session()
                self._closing.wait(RETRY_S)
            else:
                break
        while self._connect and not self._closing.wait(REFUSAL_CHECK_S):
            session = self._session
            self._refusal = self._find_refusal() if session is not None and is_unconnected(session) else ""
        if self._closing.is_set():  # close() may have stopped waiting before the session was open
            self._close_session()

    def _find_refusal(self) -> str:
        """Return why the endpoints refuse the connection; "" if no program listens there."""
        with contextlib.suppress(*_zenoh_errors()):  # zenoh has reported an invalid file already
            return explain_refusals(self._connect, self._configuration(None))
        return ""

    def _close_session(self) -> None:
        """Close the session, which stops the threads that receive from it."""
        session, self._session = self._session, None
        self._publishers, self._queryables = {}, {}
        self._duplicates.forget_devices()
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]
        with self._showing:
            self._tokens = {}  # they were removed with the session
        threads, self._query_threads = self._query_threads, []
        for thread in threads:
            thread.join(RETRY_S)

    def _open(self) -> None:
        """Open the session and declare all devices."""
        session, state = self._open_session()
        with self._declaring:
            self._session = session
            for device in self._devices:
                self._declare(session, device)
            self._session_state = state

    def _declare(self, session: "zenoh.Session", device: str) -> None:
        """Declare all keys of a device."""
        keys = {topic: topic.key(self.settings.prefix, device) for topic in topics.TOPICS}
        published = {topic: key for topic, key in keys.items() if topic.when not in ("presence", "query")}
        new = {key: self._publisher(session, topic, key) for topic, key in published.items()}
        command_key = f"{self.settings.prefix}/{device}/command/*"
        self._declare_queryable(session, device, command_key, partial(self._queue_command, device))
        self._duplicates.watch_other_publishers(session, device)
        if self._read_history is not None:
            answer = partial(self._answer_history, device, self._read_history)
            self._declare_queryable(session, device, keys[topics.HISTORY], answer)
        self._publishers = {**self._publishers, **new}
        self._update_token(device)

    def _open_session(self) -> tuple["zenoh.Session", str]:
        """Open the session, on a free port if the configured port is in use. Return the session and its state."""
        import zenoh

        listen = self.settings.listen
        config = self._configuration(listen)
        self._connect = find_connect_endpoints(config)
        try:
            return zenoh.open(config), "ok"
        except zenoh.ZError as error:
            if "in use" not in str(error) or listen is None:
                raise
            free = tuple(_free_port(endpoint) for endpoint in listen)
            session = zenoh.open(self._configuration(free))
            return session, f"ok, but {', '.join(listen)} is busy: listening on {', '.join(free)}"

    def _configuration(self, listen: tuple[str, ...] | None) -> "zenoh.Config":
        """Return the configuration of zenoh. The settings override the file, and the file overrides the defaults."""
        own = self.settings
        keys: dict[str, Any] = {
            "mode": own.mode,
            "listen/endpoints": [] if own.mode == "client" else listen,  # a client does not listen
            "connect/endpoints": own.connect or None,
        }
        defaults = {**DEFAULT_CONFIGURATION, "listen/endpoints": [topics.ENDPOINT], "timestamping/enabled": True}
        return build_session_config(keys, own.config, defaults)

    def _publisher(
        self, session: "zenoh.Session", topic: topics.Topic, key: str
    ) -> "zenoh.Publisher | AdvancedPublisher":
        """Declare the publisher of a key; an advanced publisher if the topic keeps values."""
        import zenoh
        from zenoh import ext

        encoding, drop = zenoh.Encoding(topic.encoding), zenoh.CongestionControl.DROP
        express = topic.when != "batches"  # results are sent at once; batches of samples may share a packet
        if not topic.kept:
            return session.declare_publisher(key, encoding=encoding, congestion_control=drop, express=express)
        return ext.declare_advanced_publisher(
            session,
            key,
            encoding=encoding,
            congestion_control=drop,
            express=express,
            cache=ext.CacheConfig(topic.kept),
            publisher_detection=topic is topics.EVENT,
        )

    # --- liveliness and commands

    def _update_token(self, device: str) -> None:
        """Declare or remove the liveliness token of a device to match its state."""
        session = self._session
        if session is None:
            return
        key = topics.ALIVE.key(self.settings.prefix, device)
        # An error here means that the session is closing, which removes the token.
        with self._showing, contextlib.suppress(*_zenoh_errors()):
            if self._alive[device] and device not in self._tokens:
                self._tokens[device] = session.liveliness().declare_token(key)
            elif not self._alive[device] and device in self._tokens:
                self._tokens.pop(device).undeclare()

    def _declare_queryable(
        self, session: "zenoh.Session", device: str, key: str, handle: Callable[[Any], None]
    ) -> None:
        """Declare a queryable of a device, and start the thread that handles its queries."""
        import zenoh

        queryable = session.declare_queryable(key, zenoh.handlers.FifoChannel(MAX_QUEUED_QUERIES))
        name = f"queries of {key}"
        thread = threading.Thread(target=self._handle_queries, args=(queryable, handle), name=name, daemon=True)
        thread.start()
        self._queryables.setdefault(device, []).append(queryable)
        self._query_threads = [*(one for one in self._query_threads if one.is_alive()), thread]

    def _handle_queries(self, queryable: Any, handle: Callable[[Any], None]) -> None:
        """Handle queries until the session is closed (runs in a thread)."""
        handler = queryable.handler
        while not self._closing.is_set():
            try:
                query = handler.recv()
            except _zenoh_errors():
                return
            handle(query)

    def _answer_history(self, device: str, read_history: HistoryFunction, query: Any) -> None:
        """Answer a query of ``history``."""
        reply_result, _ = _reply_functions(query, topics.HISTORY.key(self.settings.prefix, device))
        with contextlib.suppress(*_zenoh_errors()):  # the session may have been closed meanwhile
            try:
                payload = read_history(device, str(query.parameters))
            except ImuError as error:
                _reply_error(query, error)
            else:
                reply_result(payload)

    def _queue_command(self, device: str, query: Any) -> None:
        """Pass a command to the queue."""
        verb = str(query.key_expr).rsplit("/", 1)[-1]
        key = f"{self.settings.prefix}/{device}/command/{verb}"  # the key of the query may match several devices
        command = Command(device, verb, *_reply_functions(query, key))
        try:
            self.commands.put_nowait(command)
        except queue.Full:
            command.reply_refusal("busy: too many commands wait")


class _DuplicatePublishers:
    """Detector of other sessions that publish the status of a device under the same key.

    A subscriber would receive both mixed, and a command would reach both.

    Parameters
    ----------
    prefix
        Prefix of the keys.
    """

    def __init__(self, prefix: str) -> None:
        self._prefix = prefix
        self._subscribers: dict[str, Any] = {}
        self._heard_s: dict[str, float] = {}

    def watch_other_publishers(self, session: "zenoh.Session", device: str) -> None:
        """Subscribe to the status that other sessions publish for a device; the own messages are excluded."""
        import zenoh

        key = topics.STATUS.key(self._prefix, device)
        ring: Any = zenoh.handlers.RingChannel(1)
        one = session.declare_subscriber(key, ring, allowed_origin=zenoh.Locality.REMOTE)
        self._subscribers = {**self._subscribers, device: one}

    def forget_device(self, device: str) -> list[Any]:
        """Forget a device; return the subscribers to undeclare."""
        self._heard_s.pop(device, None)
        removed = [one for name, one in self._subscribers.items() if name == device]
        self._subscribers = {name: one for name, one in self._subscribers.items() if name != device}
        return removed

    def forget_devices(self) -> None:
        """Forget all devices; their subscribers are closed with the session."""
        self._subscribers, self._heard_s = {}, {}

    def duplicate_publisher_message(self, now_s: float) -> str:
        """Return a message if another program published a device's status within DUPLICATE_REPORT_S; else ""."""
        for device, one in self._subscribers.items():
            with contextlib.suppress(*_zenoh_errors()):  # the session is being closed
                if one.handler.try_recv() is not None:
                    self._heard_s[device] = now_s
        keys = [f"{self._prefix}/{one}" for one, at_s in self._heard_s.items() if now_s - at_s < DUPLICATE_REPORT_S]
        if not keys:
            return ""
        return f"another program publishes {', '.join(sorted(keys))} too; change a device's name, or zenoh.prefix"


def _reply_functions(query: Any, key: str) -> tuple[Callable[[bytes], None], Callable[[str], None]]:
    """Return functions that end a query with a result or with an error."""
    import zenoh

    def reply_result(payload: bytes) -> None:
        with query:
            query.reply(key, payload, encoding=zenoh.Encoding(topics.JSON))

    def reply_refusal(reason: str) -> None:
        with query:
            query.reply_err(json.dumps({"error": reason}).encode(), encoding=zenoh.Encoding(topics.JSON))

    return reply_result, reply_refusal


def _reply_error(query: Any, error: ImuError) -> None:
    """End a query with an error message and the exit status that a command would have."""
    import zenoh

    status = 3 if isinstance(error, NotReady) else 2 if isinstance(error, ConfigError) else 1
    with query:
        payload = json.dumps({"error": str(error), "exit": status}).encode()
        query.reply_err(payload, encoding=zenoh.Encoding(topics.JSON))


def _free_port(endpoint: str) -> str:
    """Return the endpoint with a port that is free now; endpoints other than tcp/host:port are not changed."""
    match = re.fullmatch(r"tcp/\[?([^\]]+?)\]?:\d+", endpoint)
    if match is None:
        return endpoint
    family = socket.AF_INET6 if ":" in match[1] else socket.AF_INET
    with socket.create_server((match[1], 0), family=family) as server:
        return re.sub(r":\d+$", f":{server.getsockname()[1]}", endpoint)


def _zenoh_errors() -> tuple[type[Exception], ...]:
    """Return the exceptions of zenoh, which is imported only when needed."""
    import zenoh

    return (zenoh.ZError,)
