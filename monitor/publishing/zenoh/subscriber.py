"""Subscriber to the results of other daemons over zenoh, for ``watch`` and ``view``.

Each endpoint has a separate zenoh session in client mode. Client mode is necessary because a router does not forward
data between two peers, and daemons are peers. Separate sessions are necessary because a client stays connected to the
first endpoint that answers. Samples and Allan deviations are received only for devices shown in detail.

A late subscriber receives the last values and events that daemons keep. After an interruption, the subscriber also
receives the events that it has missed. Memory use is bounded, because zenoh rejects messages above
``MAX_MESSAGE_BYTES`` and the queue drops the oldest messages.
"""

import itertools
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from drivers.errors import ConfigError
from drivers.secret_masking import mask_secrets
from drivers.zenoh.connection_diagnosis import explain_refusal
from drivers.zenoh.session_config import (
    DEFAULT_CONFIGURATION,
    build_session_config,
    find_connect_endpoints,
    format_zenoh_error,
    is_unconnected,
)
from monitor.common import topics
from monitor.publishing.bounded_queue import BoundedQueue
from monitor.publishing.zenoh.retried_session import REFUSAL_CHECK_S, RetriedSession
from monitor.settings import file_permissions

if TYPE_CHECKING:
    import zenoh

KEYEXPR: Final = "imu/**"
TOPICS: Final = (topics.STATUS, topics.COEFFICIENTS, topics.EVENT)
DETAIL_TOPICS: Final = (topics.SAMPLES, topics.ALLAN, topics.GAP)
"""Additional topics that are received for devices shown in detail."""
RING_MESSAGES: Final = 4096
BACKLOG_BYTES: Final = 16_000_000
MAX_MESSAGE_BYTES: Final = 4_000_000
"""Longest accepted message. The longest messages are sample batches of a fast replay."""
CONNECTION_CHECK_S: Final = 0.25
"""Interval between two checks that an endpoint is still connected [s]."""
MAX_TOKENS: Final = 20_000
"""Largest number of stored liveliness tokens for each endpoint."""
MAX_REMEMBERED_MESSAGES: Final = 20_000
"""Number of messages that are stored to detect duplicates, enough for two seconds of 1000 devices at 10 Hz."""


@dataclass(frozen=True, slots=True)
class ReceivedMessageOrLiveliness:
    """Message of a device, or notice that a liveliness token has appeared or disappeared."""

    key: str
    payload: bytes | None  # None for a liveliness token
    token_exists: bool = True  # False if a liveliness token has disappeared


class ZenohSubscriber:
    """Subscriber to the results of any number of daemons.

    Parameters
    ----------
    keyexpr
        Pattern of zenoh keys (key expression) that selects devices or topics, such as ``imu/**`` or ``*/*/status``.
    connect
        Endpoints of daemons or routers. By default, the endpoints in ``file`` or the default endpoint.
    file
        zenoh configuration file with certificates or a password.
    detail
        Keys of devices whose samples and Allan deviations are received, such as ``imu/bench-1``.
    received
        Topics that are received from all selected devices, in addition to the liveliness tokens.

    Raises
    ------
    ConfigError
        If zenoh rejects the key expression, an endpoint or the file, or if other users may modify the file.
    """

    def __init__(
        self,
        keyexpr: str = KEYEXPR,
        connect: Sequence[str] = (),
        file: Path | None = None,
        detail: Sequence[str] = (),
        received: Sequence[topics.ZenohTopic] = TOPICS,
    ) -> None:
        keys = {topic: topic_keys(keyexpr, topic) for topic in (*received, topics.ALIVE)}
        _check_keys(keyexpr, keys)
        for topic in DETAIL_TOPICS:
            keys[topic] = (*keys.get(topic, ()), *(f"{device}/{topic.name}" for device in detail))
        self._backlog: BoundedQueue[ReceivedMessageOrLiveliness] = BoundedQueue(BACKLOG_BYTES)
        found = client_configurations(connect, file)
        self._duplicate_filter = _DuplicateFilter() if len(found) > 1 else None
        self._sessions = [_EndpointSession(endpoint, config, keys, self._push) for endpoint, config in found.items()]

    @property
    def dropped(self) -> int:
        """Number of messages that were dropped because ``take`` was called too late."""
        return self._backlog.dropped

    @property
    def state(self) -> str:
        """``ok`` or a description of the endpoints that are not connected."""
        if failure := next((session.failure for session in self._sessions if session.failure), ""):
            return failure
        absent = {session.endpoint: session.refusal for session in self._sessions if not session.is_connected}
        if not absent:
            return "ok"
        every = ", ".join(session.endpoint for session in self._sessions)
        reasons = "; ".join(f"{endpoint}: {refusal}" for endpoint, refusal in absent.items() if refusal)
        if len(absent) == len(self._sessions):
            return f"{reasons or 'nobody at ' + every}; trying again"
        connected = f"connected to {len(self._sessions) - len(absent)} of {len(self._sessions)}"
        missing = ", ".join(f"{endpoint} ({refusal})" if refusal else endpoint for endpoint, refusal in absent.items())
        return f"{connected}; missing: {missing}; trying again"

    @property
    def all_connected_duration_s(self) -> float:
        """Time [s] for which all endpoints have been connected, or 0 if any endpoint is not connected."""
        return min(session.connected_duration_s for session in self._sessions)

    def start(self) -> None:
        """Start the threads that open the sessions, and return at once."""
        for session in self._sessions:
            session.start()

    def take(self, timeout_s: float) -> list[ReceivedMessageOrLiveliness]:
        """Return all messages since the last call, after waiting up to ``timeout_s`` seconds for the first message."""
        return self._backlog.take(timeout_s)

    def close(self) -> None:
        """Close the sessions and stop the threads."""
        for session in self._sessions:
            session.closing.set()
        for session in self._sessions:
            session.close()
        self._backlog.wake()

    def _push(self, message: ReceivedMessageOrLiveliness, stamp: str) -> None:
        if self._duplicate_filter is None or self._duplicate_filter.is_unseen(message.key, stamp):
            self._backlog.push(message, 100 + len(message.payload or b""))


class _DuplicateFilter:
    """Filter that removes copies of a message from other endpoints, identified by key and zenoh timestamp."""

    def __init__(self) -> None:
        self._seen: OrderedDict[tuple[str, str], None] = OrderedDict()
        self._lock = threading.Lock()

    def is_unseen(self, key: str, stamp: str) -> bool:
        """Return True if the message is new or has no timestamp."""
        if not stamp:
            return True
        with self._lock:
            if (key, stamp) in self._seen:
                return False
            self._seen[key, stamp] = None
            if len(self._seen) > MAX_REMEMBERED_MESSAGES:
                self._seen.popitem(last=False)
            return True


class _EndpointSession(RetriedSession):
    """Client session with one endpoint, which passes messages and changes of liveliness tokens to a function."""

    close_timeout_s = 5.0

    def __init__(
        self,
        endpoint: str,
        config: "zenoh.Config",
        keys: Mapping[topics.ZenohTopic, Sequence[str]],
        push: Callable[[ReceivedMessageOrLiveliness, str], None],
    ) -> None:
        self.endpoint = mask_secrets(endpoint)
        super().__init__(self.endpoint)
        self.refusal = ""  # reason why the endpoint refuses the connection; empty if no program listens
        self._endpoint, self._config, self._keys, self._push = endpoint, config, keys, push
        self._tokens: set[str] = set()  # keys of existing liveliness tokens
        self._since_s: float | None = None  # monotonic time at which the connection was established [s]

    @property
    def is_connected(self) -> bool:
        session = self._session
        return session is not None and not is_unconnected(session)

    @property
    def connected_duration_s(self) -> float:
        """Duration of the current connection [s], or 0 without a connection."""
        since_s = self._since_s
        return 0.0 if since_s is None else time.monotonic() - since_s

    def _open_session(self) -> None:
        import zenoh

        session = self._session = zenoh.open(self._config)
        for topic, keys in self._keys.items():
            process = self._process_token if topic is topics.ALIVE else self._process_message
            for key in keys:
                self._start_receiving(key, _declare_subscriber(session, topic, key), process)

    def _report_failure(self, _error: Exception) -> None:
        self.refusal = explain_refusal(self._endpoint, self._config)

    def _work_until_closed(self) -> None:
        """Report all liveliness tokens as lost if the endpoint is lost, because zenoh does not report them."""
        checked_s = -REFUSAL_CHECK_S
        while not self.closing.wait(CONNECTION_CHECK_S):
            if self.is_connected:
                self.refusal, self._since_s = "", self._since_s or time.monotonic()
                continue
            self._since_s = None
            while self._tokens:
                self._push(ReceivedMessageOrLiveliness(self._tokens.pop(), None, token_exists=False), "")
            if time.monotonic() - checked_s >= REFUSAL_CHECK_S:
                self.refusal = explain_refusal(self._endpoint, self._config)
                checked_s = time.monotonic()

    def _process_message(self, sample: Any) -> None:
        stamp = "" if sample.timestamp is None else str(sample.timestamp)
        self._push(ReceivedMessageOrLiveliness(str(sample.key_expr), bytes(sample.payload)), stamp)

    def _process_token(self, sample: Any) -> None:
        import zenoh

        key, exists = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
        if not exists:
            self._tokens.discard(key)
        elif len(self._tokens) < MAX_TOKENS:
            self._tokens.add(key)
        self._push(ReceivedMessageOrLiveliness(key, None, exists), "")


def topic_keys(keyexpr: str, topic: topics.ZenohTopic) -> tuple[str, ...]:
    """Return the patterns of zenoh keys (key expressions) that select the messages of one topic.

    If the key expression names a device but no topic, the given topic is appended.

    >>> topic_keys("imu/**", topics.STATUS), topic_keys("imu/bench-1", topics.STATUS)
    (('imu/**/status',), ('imu/bench-1/**/status',))
    >>> topic_keys("imu/*/*", topics.STATUS), topic_keys("imu/*/status", topics.EVENT)
    (('imu/*/status', 'imu/*/*/**/status'), ())

    Parameters
    ----------
    keyexpr
        Key expression that selects devices or topics.
    topic
        Topic whose messages are selected.
    """
    parts = keyexpr.split("/")
    if parts[-1] in {known.name for known in topics.TOPICS}:
        return (keyexpr,) if parts[-1] == topic.name else ()
    if parts[-1] == "**":
        return (f"{keyexpr}/{topic.name}",)
    below = f"{keyexpr}/**/{topic.name}"
    return ("/".join([*parts[:-1], topic.name]), below) if parts[-1] == "*" else (below,)


def client_configurations(connect: Sequence[str], file: Path | None) -> dict[str, "zenoh.Config"]:
    """Return the zenoh configuration of a client session for each endpoint.

    Parameters
    ----------
    connect
        Endpoints of daemons or routers. By default, the endpoints in ``file`` or the default endpoint.
    file
        zenoh configuration file.

    Raises
    ------
    ConfigError
        If an endpoint or the file is invalid, or if other users may modify the file.
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
                f'connect "{mask_secrets(endpoint)}": not a valid endpoint; an example is {topics.ENDPOINT}'
            ) from error
    return found


def _declare_subscriber(session: "zenoh.Session", topic: topics.ZenohTopic, key: str) -> Any:
    """Subscribe to a key and request the last messages that daemons keep."""
    import zenoh
    from zenoh import ext

    ring: Any = zenoh.handlers.RingChannel(RING_MESSAGES)
    if topic is topics.ALIVE:
        return session.liveliness().declare_subscriber(key, ring, history=True)
    if not topic.kept:
        return session.declare_subscriber(key, ring)
    history = ext.HistoryConfig(detect_late_publishers=topic is topics.EVENT)
    return ext.declare_advanced_subscriber(session, key, ring, history=history)


def _check_keys(keyexpr: str, keys: Mapping[topics.ZenohTopic, Sequence[str]]) -> None:
    """Raise ConfigError if a key expression is invalid or matches no topic."""
    import zenoh

    try:
        for key in itertools.chain(*keys.values()):
            zenoh.KeyExpr(key)
    except UnicodeEncodeError as error:
        raise ConfigError(f'key expression "{keyexpr!a}": not valid UTF-8') from error
    except zenoh.ZError as error:
        raise ConfigError(f'key expression "{keyexpr}": {format_zenoh_error(error)}') from error
    if not any(keys.values()):
        shown = ", ".join(topic.name for topic in keys)
        raise ConfigError(f'key expression "{keyexpr}": no topic to show; possible topics are {shown}')
