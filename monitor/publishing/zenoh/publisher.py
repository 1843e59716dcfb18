"""Publisher of results over zenoh, with liveliness tokens, commands and history queries.

By default, the zenoh session is a peer that listens only on the loopback interface and does not search for other
programs. If the port is in use, the session listens on a free port. If the session cannot be opened for another reason,
the publisher repeats the attempt. Messages are dropped until the session is open. ``put`` never waits, because zenoh
queues outgoing messages and drops messages for a slow subscriber. Advanced publishers of zenoh keep the last values for
late subscribers.

For each device, one thread answers history queries, because an answer requires reading a file. A second thread passes
commands to the main loop of the service.
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

from drivers.errors import ConfigError, ImuError, NotReady
from drivers.secret_masking import mask_secrets
from drivers.zenoh.connection_diagnosis import explain_refusals
from drivers.zenoh.session_config import (
    DEFAULT_CONFIGURATION,
    build_session_config,
    find_connect_endpoints,
    format_zenoh_error,
    is_unconnected,
)
from monitor.common import topics
from monitor.publishing.zenoh.retried_session import REFUSAL_CHECK_S, RetriedSession, zenoh_errors
from monitor.settings.loading import ZenohTable

if TYPE_CHECKING:
    import zenoh
    from zenoh.ext import AdvancedPublisher

MAX_QUEUED_QUERIES: Final = 64
"""Capacity of the command queue and of each zenoh channel that receives queries."""
DUPLICATE_REPORT_S: Final = 10.0
"""Time [s] for which another program with the same key is still reported after its last message."""


@dataclass(frozen=True, slots=True)
class Command:
    """Query on the key ``command/<verb>``. Each command must be answered exactly once with a result or a refusal."""

    device: str
    verb: str
    reply_result: Callable[[bytes], None]
    reply_refusal: Callable[[str], None]


HistoryFunction = Callable[[str, str], bytes]
"""Function that returns the encoded history for a device name and selector parameters. It raises ImuError if no
history is stored."""


class ZenohPublisher(RetriedSession):
    """zenoh session of the daemon, which publishes the results of all devices and answers queries.

    Parameters
    ----------
    settings
        Settings of the zenoh session.
    devices
        Names of the devices.
    read_history
        Function that returns the reply to a history query, or None if no history is stored.
    """

    def __init__(
        self, settings: ZenohTable, devices: Sequence[str], read_history: HistoryFunction | None = None
    ) -> None:
        super().__init__("open")
        self.settings = settings
        self._read_history = read_history
        self._session_state = "off" if settings.mode == "none" else "not open yet"
        self._unsent = ""  # reason why the newest message could not be sent
        self.commands: queue.Queue[Command] = queue.Queue(MAX_QUEUED_QUERIES)
        self._devices = tuple(devices)
        self._alive: dict[str, bool] = dict.fromkeys(devices, False)
        self._refusal = ""  # reason why the endpoints refuse the connection
        self._connect: tuple[str, ...] = settings.connect
        self._publishers: dict[str, zenoh.Publisher | AdvancedPublisher] = {}
        self._tokens: dict[str, Any] = {}
        self._queryables: dict[str, list[Any]] = {}
        self._duplicates = _DuplicatePublishers(settings.prefix)
        # The thread that opens the session and the main loop both declare the keys of devices.
        self._declaring = threading.Lock()
        self._token_lock = threading.Lock()  # liveliness tokens are declared by the same two threads

    @property
    def state(self) -> str:
        """``ok`` or a description of the problem, for the status message."""
        session = self._session
        if wrong := self.failure or self._unsent:
            return wrong
        if session is None:
            return self._session_state
        if self._connect and is_unconnected(session):
            return f"{self._refusal or 'nobody at ' + mask_secrets(', '.join(self._connect))}; trying again"
        duplicates = self._duplicates.duplicate_publisher_message(time.monotonic())
        if not duplicates:
            return self._session_state
        return f"{self._session_state}{'; ' if self._session_state != 'ok' else ', but '}{duplicates}"

    def start(self) -> None:
        """Open the session in a separate thread, unless the mode is ``none``."""
        if self.settings.mode == "none":
            return
        # if a thread still receives zenoh messages while Python exits, the process aborts
        atexit.register(self.close)
        super().start()

    def put(self, topic: topics.ZenohTopic, device: str, payload: bytes) -> None:
        """Publish a message. The message is dropped if no session is open.

        Parameters
        ----------
        topic
            Topic of the message.
        device
            Name of the device.
        payload
            Encoded message.
        """
        publisher = self._publishers.get(topic.key(self.settings.prefix, device))
        if publisher is None:
            return
        try:
            publisher.put(payload)
        except zenoh_errors() as error:
            self._unsent = f"cannot send: {format_zenoh_error(error)}"
        else:
            self._unsent = ""

    def publish_json_return_error(self, key: str, payload: bytes) -> str:
        """Publish JSON under a user-defined key, and return the reason for a failure or an empty string.

        Parameters
        ----------
        key
            zenoh key of the message.
        payload
            JSON text of the message.
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

    def set_alive(self, device: str, samples_arrive: bool) -> None:
        """Declare or remove the liveliness token of a device.

        Parameters
        ----------
        device
            Name of the device.
        samples_arrive
            True if samples of the device arrive.
        """
        if self._alive[device] != samples_arrive:
            self._alive[device] = samples_arrive
            self._update_token(device)

    def add_device(self, device: str) -> None:
        """Add a device and declare its zenoh keys."""
        with self._declaring:
            self._devices += (device,)
            self._alive[device] = False
            if self._session is not None:
                with contextlib.suppress(*zenoh_errors()):  # the session may be closing
                    self._declare(self._session, device)

    def remove_device(self, device: str) -> None:
        """Remove a device and undeclare its zenoh keys."""
        self.set_alive(device, False)
        with self._declaring, contextlib.suppress(*zenoh_errors()):  # the session may be closing
            self._devices = tuple(one for one in self._devices if one != device)
            del self._alive[device]
            keys = {topic.key(self.settings.prefix, device) for topic in topics.TOPICS}
            removed = [self._publishers[key] for key in keys & self._publishers.keys()]
            self._publishers = {key: one for key, one in self._publishers.items() if key not in keys}
            for one in [*removed, *self._queryables.pop(device, []), *self._duplicates.forget_device(device)]:
                one.undeclare()

    def close(self) -> None:
        """Close the session, remove all liveliness tokens and stop the threads."""
        atexit.unregister(self.close)
        super().close()

    # --- opening of the session

    def _open_session(self) -> None:
        session, state = self._open_on_free_port()
        with self._declaring:
            self._session = session
            for device in self._devices:
                self._declare(session, device)
            self._session_state = state

    def _report_failure(self, error: Exception) -> None:
        self._session_state = f"{self._find_refusal() or format_zenoh_error(error)}; trying again"

    def _work_until_closed(self) -> None:
        while self._connect and not self.closing.wait(REFUSAL_CHECK_S):
            session = self._session
            self._refusal = self._find_refusal() if session is not None and is_unconnected(session) else ""

    def _find_refusal(self) -> str:
        """Return the reason why the endpoints refuse the connection, or an empty string if no program listens there."""
        with contextlib.suppress(*zenoh_errors()):  # zenoh has already reported an invalid configuration file
            return explain_refusals(self._connect, self._configuration(None))
        return ""

    def _close_session(self) -> None:
        self._publishers, self._queryables = {}, {}
        self._duplicates.forget_devices()
        super()._close_session()
        with self._token_lock:
            self._tokens = {}

    def _declare(self, session: "zenoh.Session", device: str) -> None:
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

    def _open_on_free_port(self) -> tuple["zenoh.Session", str]:
        """Open the session on the configured port, or on a free port if the configured port is in use."""
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
        """Return the zenoh configuration. The settings override the zenoh file, which overrides the defaults."""
        own = self.settings
        keys: dict[str, Any] = {
            "mode": own.mode,
            "listen/endpoints": [] if own.mode == "client" else listen,  # a zenoh client cannot listen
            "connect/endpoints": own.connect or None,
        }
        defaults = {**DEFAULT_CONFIGURATION, "listen/endpoints": [topics.ENDPOINT], "timestamping/enabled": True}
        return build_session_config(keys, own.config, defaults)

    def _publisher(
        self, session: "zenoh.Session", topic: topics.ZenohTopic, key: str
    ) -> "zenoh.Publisher | AdvancedPublisher":
        """Declare a publisher for a key. It is an advanced publisher if the topic keeps values for late subscribers."""
        import zenoh
        from zenoh import ext

        encoding, drop = zenoh.Encoding(topic.encoding), zenoh.CongestionControl.DROP
        express = topic.when != "batches"  # results are sent immediately; batches of samples may share a packet
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
        session = self._session
        if session is None:
            return
        key = topics.ALIVE.key(self.settings.prefix, device)
        # This error occurs only while the session is closing, which also removes the token.
        with self._token_lock, contextlib.suppress(*zenoh_errors()):
            if self._alive[device] and device not in self._tokens:
                self._tokens[device] = session.liveliness().declare_token(key)
            elif not self._alive[device] and device in self._tokens:
                self._tokens.pop(device).undeclare()

    def _declare_queryable(
        self, session: "zenoh.Session", device: str, key: str, process: Callable[[Any], None]
    ) -> None:
        import zenoh

        queryable = session.declare_queryable(key, zenoh.handlers.FifoChannel(MAX_QUEUED_QUERIES))
        self._start_receiving(key, queryable, process)
        self._queryables.setdefault(device, []).append(queryable)

    def _answer_history(self, device: str, read_history: HistoryFunction, query: Any) -> None:
        reply_result, _ = _reply_functions(query, topics.HISTORY.key(self.settings.prefix, device))
        with contextlib.suppress(*zenoh_errors()):  # the session may have been closed meanwhile
            try:
                payload = read_history(device, str(query.parameters))
            except ImuError as error:
                _reply_error(query, error)
            else:
                reply_result(payload)

    def _queue_command(self, device: str, query: Any) -> None:
        verb = str(query.key_expr).rsplit("/", 1)[-1]
        key = f"{self.settings.prefix}/{device}/command/{verb}"  # the key of the query may select several devices
        command = Command(device, verb, *_reply_functions(query, key))
        try:
            self.commands.put_nowait(command)
        except queue.Full:
            command.reply_refusal("busy: too many commands are waiting")


class _DuplicatePublishers:
    """Detector of other programs that publish the status of a device under the same key."""

    def __init__(self, prefix: str) -> None:
        self._prefix = prefix
        self._subscribers: dict[str, Any] = {}
        self._heard_s: dict[str, float] = {}

    def watch_other_publishers(self, session: "zenoh.Session", device: str) -> None:
        import zenoh

        key = topics.STATUS.key(self._prefix, device)
        ring: Any = zenoh.handlers.RingChannel(1)
        one = session.declare_subscriber(key, ring, allowed_origin=zenoh.Locality.REMOTE)
        self._subscribers = {**self._subscribers, device: one}

    def forget_device(self, device: str) -> list[Any]:
        self._heard_s.pop(device, None)
        removed = [one for name, one in self._subscribers.items() if name == device]
        self._subscribers = {name: one for name, one in self._subscribers.items() if name != device}
        return removed

    def forget_devices(self) -> None:
        self._subscribers, self._heard_s = {}, {}

    def duplicate_publisher_message(self, now_s: float) -> str:
        """Return a warning if another program published a device's status in the last DUPLICATE_REPORT_S seconds."""
        for device, one in self._subscribers.items():
            with contextlib.suppress(*zenoh_errors()):  # the session is being closed
                if one.handler.try_recv() is not None:
                    self._heard_s[device] = now_s
        keys = [f"{self._prefix}/{one}" for one, at_s in self._heard_s.items() if now_s - at_s < DUPLICATE_REPORT_S]
        if not keys:
            return ""
        return f"another program publishes {', '.join(sorted(keys))} too; change a device's name, or zenoh.prefix"


def _reply_functions(query: Any, key: str) -> tuple[Callable[[bytes], None], Callable[[str], None]]:
    """Return two functions that answer a query, one with a result and one with an error."""
    import zenoh

    def reply_result(payload: bytes) -> None:
        with query:
            query.reply(key, payload, encoding=zenoh.Encoding(topics.JSON))

    def reply_refusal(reason: str) -> None:
        with query:
            query.reply_err(json.dumps({"error": reason}).encode(), encoding=zenoh.Encoding(topics.JSON))

    return reply_result, reply_refusal


def _reply_error(query: Any, error: ImuError) -> None:
    """Reply to a query with an error message and the exit status of the corresponding command."""
    import zenoh

    status = 3 if isinstance(error, NotReady) else 2 if isinstance(error, ConfigError) else 1
    with query:
        payload = json.dumps({"error": str(error), "exit": status}).encode()
        query.reply_err(payload, encoding=zenoh.Encoding(topics.JSON))


def _free_port(endpoint: str) -> str:
    """Return a TCP endpoint with its port replaced by a free port. Other endpoints are returned unchanged."""
    match = re.fullmatch(r"tcp/\[?([^\]]+?)\]?:\d+", endpoint)
    if match is None:
        return endpoint
    family = socket.AF_INET6 if ":" in match[1] else socket.AF_INET
    with socket.create_server((match[1], 0), family=family) as server:
        return re.sub(r":\d+$", f":{server.getsockname()[1]}", endpoint)
