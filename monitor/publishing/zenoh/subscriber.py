"""Subscriber to the results of other daemons over zenoh, as used by ``watch``.

Each endpoint has its own session: a client that does not listen and does not scout. A client is used because a router
does not forward data between two peers, and daemons are peers. One session per endpoint is needed because a client
stays with the first endpoint that answers. A connection that fails is tried again. A zenoh file may supply
certificates, user and password. Raw samples and curves, the bulk of the data, are subscribed to only for devices
shown in detail.

A late subscriber receives the last values and last events that daemons keep for this purpose. After a broken
connection, it also receives the missed events. Each subscription ends in a ring of zenoh that drops its oldest
entries. A thread moves the entries to one common queue, because a Python callback that is registered at exit would
block the process. ``take`` returns messages in order of arrival within a topic; payloads are not decoded here. Memory
is bounded: zenoh rejects messages above ``MAX_MESSAGE_BYTES``, and the queue drops its oldest entries.
"""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from drivers.credential_masking import mask_secrets
from drivers.errors import ConfigError
from drivers.zenoh.connection_errors import explain_refusal
from drivers.zenoh.session_config import (
    DEFAULT_CONFIGURATION,
    build_session_config,
    find_connect_endpoints,
    format_zenoh_error,
    is_unconnected,
)
from monitor.common import topics
from monitor.publishing.bounded_queue import BoundedQueue
from monitor.settings import file_permissions

if TYPE_CHECKING:
    import zenoh

KEYEXPR: Final = "imu/**"
TOPICS: Final = (topics.STATUS, topics.COEFFICIENTS, topics.EVENT)
DETAIL_TOPICS: Final = (topics.SAMPLES, topics.ALLAN, topics.GAP)
"""Topics of devices shown in detail, in addition to TOPICS."""
RING_MESSAGES: Final = 4096
BACKLOG_BYTES: Final = 16_000_000
MAX_MESSAGE_BYTES: Final = 4_000_000
"""Longest accepted message; batches of samples of a fast replay are the longest, all others have a few kilobytes."""
CONNECTION_CHECK_S: Final = 0.25
"""Interval between two checks that an endpoint is still connected."""
MAX_TOKENS: Final = 20_000
"""Largest number of liveliness tokens that are remembered per endpoint."""
REFUSAL_CHECK_S: Final = 3.0
"""Interval between two checks of why an endpoint refuses the connection."""
RETRY_S: Final = 1.0
CLOSE_TIMEOUT_S: Final = 5.0
"""Longest time that ``close`` waits for a session that is being opened."""
MAX_REMEMBERED_MESSAGES: Final = 20_000
"""Number of messages remembered to remove duplicates from several endpoints: two seconds of 1000 devices at 10 Hz."""


@dataclass(frozen=True, slots=True)
class Message:
    """A received payload; if ``payload`` is None, the change of a liveliness token to ``there``."""

    key: str
    payload: bytes | None
    there: bool = True


class ZenohSubscriber:
    """Subscriber to the results of any number of daemons.

    Parameters
    ----------
    keyexpr
        Key expression that selects devices or topics, e.g. ``imu/**``, ``imu/bench-1``, ``*/*/status``.
    connect
        Endpoints of daemons or routers. Empty: those of the file, or the default endpoint of a daemon.
    file
        Configuration file of zenoh for all other settings (TLS, user and password).
    detail
        Keys of devices whose samples and curves are also received, e.g. ``imu/bench-1``.

    Raises
    ------
    ConfigError
        If zenoh rejects the key expression, an endpoint or the file, or other users may modify the file.
    """

    def __init__(
        self,
        keyexpr: str = KEYEXPR,
        connect: Sequence[str] = (),
        file: Path | None = None,
        detail: Sequence[str] = (),
    ) -> None:
        keys = {topic: topic_keys(keyexpr, topic) for topic in (*TOPICS, topics.ALIVE)}
        _check_keys(keyexpr, [key for part in keys.values() for key in part])
        keys |= {topic: tuple(f"{device}/{topic.name}" for device in detail) for topic in DETAIL_TOPICS}
        self._backlog: BoundedQueue[Message] = BoundedQueue(BACKLOG_BYTES)
        found = client_configurations(connect, file)
        self._duplicate_filter = _DuplicateFilter() if len(found) > 1 else None
        self._sessions = [_EndpointSession(endpoint, config, keys, self._push) for endpoint, config in found.items()]

    @property
    def dropped(self) -> int:
        """Number of messages dropped because ``take`` was not called in time."""
        return self._backlog.dropped

    @property
    def state(self) -> str:
        """``ok``, or a description of the endpoints that are not connected."""
        absent = {session.endpoint: session.why for session in self._sessions if not session.is_connected}
        if not absent:
            return "ok"
        every = ", ".join(session.endpoint for session in self._sessions)
        reasons = "; ".join(f"{endpoint}: {why}" for endpoint, why in absent.items() if why)
        if len(absent) == len(self._sessions):
            return f"{reasons or 'nobody at ' + every}; trying again"
        there = f"{len(self._sessions) - len(absent)} of {len(self._sessions)} there ({every})"
        return f"{there}; {reasons + '; ' if reasons else ''}trying the rest again"

    @property
    def all_connected_s(self) -> float:
        """Time since which all endpoints have been connected [s]; 0 if one is not."""
        return min(session.connected_s for session in self._sessions)

    def start(self) -> None:
        """Open the sessions in separate threads and return at once."""
        for session in self._sessions:
            session.start()

    def take(self, timeout_s: float) -> list[Message]:
        """Return the messages received since the last call; wait up to ``timeout_s`` if there are none."""
        return self._backlog.take(timeout_s)

    def close(self) -> None:
        """Close the sessions and stop the threads."""
        for session in self._sessions:
            session.closing.set()
        for session in self._sessions:
            session.close()
        self._backlog.wake()

    def _push(self, message: Message, stamp: str) -> None:
        """Add a message to the queue, unless it is a duplicate."""
        if self._duplicate_filter is None or self._duplicate_filter.is_unseen(message.key, stamp):
            self._backlog.push(message, 100 + len(message.payload or b""))


class _DuplicateFilter:
    """Filter for messages that arrive over several endpoints; duplicates are found by their unique zenoh timestamps."""

    def __init__(self) -> None:
        self._seen: OrderedDict[tuple[str, str], None] = OrderedDict()
        self._lock = threading.Lock()

    def is_unseen(self, key: str, stamp: str) -> bool:
        """Return True if the message has not been seen before, or has no timestamp."""
        if not stamp:
            return True
        with self._lock:
            if (key, stamp) in self._seen:
                return False
            self._seen[key, stamp] = None
            if len(self._seen) > MAX_REMEMBERED_MESSAGES:
                self._seen.popitem(last=False)
            return True


class _EndpointSession:
    """Session with one endpoint; a thread opens it and repeats failed attempts."""

    def __init__(
        self,
        endpoint: str,
        config: "zenoh.Config",
        keys: Mapping[topics.Topic, Sequence[str]],
        push: Callable[[Message, str], None],
    ) -> None:
        self.endpoint = mask_secrets(endpoint)
        self.why = ""  # reason found by the newest check why the connection is refused; "" if no program listens there
        self.closing = threading.Event()
        self._endpoint, self._config, self._keys, self._push = endpoint, config, keys, push
        self._session: zenoh.Session | None = None
        self._opener = threading.Thread(target=self._keep_open, name=f"zenoh {self.endpoint}", daemon=True)
        self._receiver_threads: list[threading.Thread] = []
        self._tokens: set[str] = set()  # keys of existing liveliness tokens
        self._since_s: float | None = None  # monotonic time at which the connection was established [s]

    @property
    def is_connected(self) -> bool:
        """True if the session is open and connected."""
        session = self._session
        return session is not None and not is_unconnected(session)

    @property
    def connected_s(self) -> float:
        """Time since which the endpoint has been connected [s]; 0 if it is not."""
        since_s = self._since_s
        return 0.0 if since_s is None else time.monotonic() - since_s

    def start(self) -> None:
        """Start the thread that opens the session."""
        self._opener.start()

    def close(self) -> None:
        """Close the session and stop the threads."""
        self.closing.set()
        if self._opener.is_alive():
            self._opener.join(CLOSE_TIMEOUT_S)
        self._close_session()

    def _keep_open(self) -> None:
        """Open the session, then monitor the connection until closed (runs in a thread)."""
        import zenoh

        while not self.closing.is_set():
            try:
                session = self._session = zenoh.open(self._config)
                self._subscribe(session)
            except zenoh.ZError:
                self._close_session()
                self.why = explain_refusal(self._endpoint, self._config)
                self.closing.wait(RETRY_S)
            else:
                break
        self._monitor()

    def _monitor(self) -> None:
        """Monitor the connection until closed. zenoh reconnects by itself, but keeps the tokens of a lost endpoint."""
        asked_s = -REFUSAL_CHECK_S
        while not self.closing.wait(CONNECTION_CHECK_S):
            if self.is_connected:
                self.why, self._since_s = "", self._since_s or time.monotonic()
                continue
            self._since_s = None
            while self._tokens:
                self._push(Message(self._tokens.pop(), None, there=False), "")
            if time.monotonic() - asked_s >= REFUSAL_CHECK_S:
                self.why = explain_refusal(self._endpoint, self._config)
                asked_s = time.monotonic()

    def _close_session(self) -> None:
        """Close the session, which stops the threads that receive from it."""
        session, self._session = self._session, None
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]
        threads, self._receiver_threads = self._receiver_threads, []
        for thread in threads:
            thread.join(RETRY_S)

    def _subscribe(self, session: "zenoh.Session") -> None:
        """Subscribe to all keys, each with its own thread."""
        for topic, keys in self._keys.items():
            for key in keys:
                subscriber = _subscriber(session, topic, key)
                thread = threading.Thread(
                    target=self._receive, args=(subscriber, topic is topics.ALIVE), name=f"zenoh {key}", daemon=True
                )
                thread.start()
                self._receiver_threads.append(thread)

    def _receive(self, subscriber: Any, liveliness: bool) -> None:
        """Move messages from the ring to the queue until the session is closed (runs in a thread)."""
        import zenoh

        handler = subscriber.handler  # while a thread waits on the subscriber itself, it cannot be undeclared
        while not self.closing.is_set():
            try:
                sample = handler.recv()
            except zenoh.ZError:
                return  # the session is closed
            key, there = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            if liveliness:
                if not there:
                    self._tokens.discard(key)
                elif len(self._tokens) < MAX_TOKENS:
                    self._tokens.add(key)
            stamp = "" if liveliness or sample.timestamp is None else str(sample.timestamp)
            self._push(Message(key, None if liveliness else bytes(sample.payload), there), stamp)


def topic_keys(keyexpr: str, topic: topics.Topic) -> tuple[str, ...]:
    """Return the key expressions for the messages of ``topic`` that a key expression selects; a device selects all.

    >>> topic_keys("imu/**", topics.STATUS), topic_keys("imu/bench-1", topics.STATUS)
    (('imu/**/status',), ('imu/bench-1/**/status',))
    >>> topic_keys("imu/*/*", topics.STATUS), topic_keys("imu/*/status", topics.EVENT)
    (('imu/*/status', 'imu/*/*/**/status'), ())

    Parameters
    ----------
    keyexpr
        Key expression that selects devices or topics.
    topic
        Topic of interest.
    """
    parts = keyexpr.split("/")
    if parts[-1] in {known.name for known in topics.TOPICS}:
        return (keyexpr,) if parts[-1] == topic.name else ()
    if parts[-1] == "**":
        return (f"{keyexpr}/{topic.name}",)
    below = f"{keyexpr}/**/{topic.name}"
    return ("/".join([*parts[:-1], topic.name]), below) if parts[-1] == "*" else (below,)


def client_configurations(connect: Sequence[str], file: Path | None) -> dict[str, "zenoh.Config"]:
    """Return the zenoh configuration of a client session for each endpoint (see ``ZenohSubscriber``).

    Parameters
    ----------
    connect
        Endpoints. Empty: those of the file, or the default endpoint of a daemon.
    file
        Configuration file of zenoh.

    Raises
    ------
    ConfigError
        If an endpoint or the file is not valid, or other users may modify the file.
    """
    import zenoh

    if file is not None and (line := file_permissions.explain_untrusted_file(file)):
        raise ConfigError(f"{file}: {line}")
    try:
        file_endpoints = find_connect_endpoints(build_session_config({}, file))
    except zenoh.ZError as error:
        text = format_zenoh_error(error)
        raise ConfigError(text if text.startswith(str(file)) else f"{file}: {text}") from error
    defaults = {**DEFAULT_CONFIGURATION, "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES}
    found = {}
    for endpoint in dict.fromkeys(connect or file_endpoints or (topics.ENDPOINT,)):
        own = {"mode": "client", "connect/endpoints": [endpoint], "listen/endpoints": []}
        try:
            found[endpoint] = build_session_config(own, file, defaults)
        except (zenoh.ZError, UnicodeEncodeError) as error:
            raise ConfigError(
                f'connect "{mask_secrets(endpoint)}": no endpoint; write e.g. {topics.ENDPOINT}'
            ) from error
    return found


def _subscriber(session: "zenoh.Session", topic: topics.Topic, key: str) -> Any:
    """Subscribe to a key, including the values that daemons keep for late subscribers and missed events."""
    import zenoh
    from zenoh import ext

    ring: Any = zenoh.handlers.RingChannel(RING_MESSAGES)
    if topic is topics.ALIVE:
        return session.liveliness().declare_subscriber(key, ring, history=True)
    if not topic.kept:
        return session.declare_subscriber(key, ring)
    history = ext.HistoryConfig(detect_late_publishers=topic is topics.EVENT)
    return ext.declare_advanced_subscriber(session, key, ring, history=history)


def _check_keys(keyexpr: str, keys: list[str]) -> None:
    """Raise ConfigError if a key expression is not valid, or if no topic matches it."""
    import zenoh

    try:
        for key in keys:
            zenoh.KeyExpr(key)
    except UnicodeEncodeError as error:
        raise ConfigError(f'key expression "{keyexpr!a}": no UTF-8') from error
    except zenoh.ZError as error:
        raise ConfigError(f'key expression "{keyexpr}": {format_zenoh_error(error)}') from error
    if not keys:
        shown = ", ".join(topic.name for topic in (*TOPICS, topics.ALIVE))
        raise ConfigError(f'key expression "{keyexpr}": nothing to show of it; shown are {shown}')
