"""Other daemons' results from zenoh: what ``watch`` listens to.

The session is closed but for the endpoints given: a peer that listens nowhere and scouts nobody. A peer and not a
client, as a client stays with the first endpoint that answers, while a peer goes to all of them, waits for those that
are not there yet and goes back to those that went. A zenoh file may bring certificates, user and password. Raw samples
and curves, the bulk of what daemons send, are subscribed to for devices in detail alone.

Who comes late gets the last values that daemons keep for that, and their last events; of events those too that a
broken connection kept away. Each subscription ends in a ring of zenoh's that drops its oldest, and a thread of this
class moves what comes to one backlog (a Python callback that is alive at exit would hang the process). ``take`` gives
what came, in order of arrival within a topic; nothing here reads a payload. Memory is bounded whatever is sent: zenoh
takes in no message above ``MESSAGE_BYTES``, and the backlog drops its oldest.
"""

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from drivers.errors import ConfigError
from drivers.zenoh_refusal import refused
from drivers.zenoh_session import CLOSED, alone, configuration, endpoints, plain
from monitor import permissions, topics
from monitor.publish.backlog import Backlog

if TYPE_CHECKING:
    import zenoh

KEYEXPR: Final = "imu/**"
TOPICS: Final = (topics.STATUS, topics.COEFFICIENTS, topics.EVENT)
DETAIL: Final = (topics.SAMPLES, topics.ALLAN, topics.GAP)
"""Of devices in detail, beside those of all."""
RING_MESSAGES: Final = 4096
BACKLOG_BYTES: Final = 16_000_000
MESSAGE_BYTES: Final = 4_000_000
"""Longest message taken in: batches of samples of a fast replay; all else is a few kilobytes."""
LOOK_S: Final = 3.0
"""Between two looks why an endpoint does not let us in."""
RETRY_S: Final = 2.0
OPENING_S: Final = 5.0
"""zenoh waits up to half a second for peers when a session opens; much longer is a fault of its own."""


@dataclass(frozen=True, slots=True)
class Message:
    """A payload, or (``payload`` None) that a liveliness token is ``there`` now or is not."""

    key: str
    payload: bytes | None
    there: bool = True


class ZenohIn:
    """Subscriptions to the results of any number of daemons.

    Args:
        keyexpr: whose results, e.g. ``imu/**``, ``imu/bench-1``, ``*/*/status``
        connect: endpoints of daemons or routers; none: the file's, else the one where a daemon listens by default
        file: a zenoh file for all else (TLS, user and password)
        detail: keys of devices whose samples and curves are wanted too, e.g. ``imu/bench-1``

    Raises:
        ConfigError: zenoh refuses the key expression, an endpoint or the file, or anyone may change the file
    """

    def __init__(
        self,
        keyexpr: str = KEYEXPR,
        connect: Sequence[str] = (),
        file: Path | None = None,
        detail: Sequence[str] = (),
    ) -> None:
        self._keys = {topic: narrowed(keyexpr, topic) for topic in (*TOPICS, topics.ALIVE)}
        _check_keys(keyexpr, [key for keys in self._keys.values() for key in keys])
        self._keys |= {topic: tuple(f"{device}/{topic.name}" for device in detail) for topic in DETAIL}
        self._config = listener(connect, file)
        self._connect = endpoints(self._config)
        self._said = "not open yet"
        self._why = ""  # why nobody lets us in, as it was found last
        self._backlog: Backlog[Message] = Backlog(BACKLOG_BYTES)
        self._session: zenoh.Session | None = None
        self._closing = threading.Event()
        self._opener = threading.Thread(target=self._keep_open, name="zenoh open", daemon=True)
        self._takers: list[threading.Thread] = []

    @property
    def dropped(self) -> int:
        """Messages that came while nobody took any."""
        return self._backlog.dropped

    @property
    def state(self) -> str:
        """``ok``, or in a few words who is not there."""
        session = self._session
        if session is None:
            return self._said
        connected = len(session.info.peers_zid()) + len(session.info.routers_zid())
        if connected >= len(self._connect):
            return "ok"
        if not connected:
            return f"{self._why or 'nobody at ' + ', '.join(self._connect)}; trying again"
        return f"{connected} of {len(self._connect)} there ({', '.join(self._connect)}); trying the rest again"

    def start(self) -> None:
        """Open in a thread of its own; returns at once."""
        self._opener.start()

    def take(self, timeout_s: float) -> list[Message]:
        """What came since the last call; waits up to ``timeout_s`` when nothing did."""
        return self._backlog.take(timeout_s)

    def close(self) -> None:
        """Close the session and end the threads."""
        self._closing.set()
        if self._opener.is_alive():
            self._opener.join(OPENING_S)
        self._end()
        self._backlog.wake()

    def _keep_open(self) -> None:
        """Thread: open, and then find out why nobody is there whenever nobody is."""
        import zenoh

        while not self._closing.is_set():
            try:
                session = zenoh.open(self._config)
                self._session = session
                self._subscribe(session)
            except zenoh.ZError as error:
                self._said = f"{refused(self._connect, self._config) or plain(error)}; trying again"
                self._end()
                self._closing.wait(RETRY_S)
            else:
                break
        wait_s = 0.0
        while not self._closing.wait(wait_s):
            self._why = refused(self._connect, self._config) if alone(session) else ""
            wait_s = LOOK_S

    def _end(self) -> None:
        """Close the session, which ends the threads that take from it."""
        session, self._session = self._session, None
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]
        takers, self._takers = self._takers, []
        for taker in takers:
            taker.join(RETRY_S)

    def _subscribe(self, session: "zenoh.Session") -> None:
        for topic, keys in self._keys.items():
            for key in keys:
                subscriber = _subscriber(session, topic, key)
                taker = threading.Thread(
                    target=self._take, args=(subscriber, topic is topics.ALIVE), name=f"zenoh {key}", daemon=True
                )
                taker.start()
                self._takers.append(taker)

    def _take(self, subscriber: Any, liveliness: bool) -> None:
        """Thread: ring -> backlog, until the session is closed."""
        import zenoh

        handler = subscriber.handler  # the subscriber itself could not be undeclared while it waits
        while not self._closing.is_set():
            try:
                sample = handler.recv()
            except zenoh.ZError:
                return  # closed
            payload = None if liveliness else bytes(sample.payload)
            there = sample.kind == zenoh.SampleKind.PUT
            self._backlog.push(Message(str(sample.key_expr), payload, there), 100 + len(payload or b""))


def narrowed(keyexpr: str, topic: topics.Topic) -> tuple[str, ...]:
    """The part of a key expression that ``topic`` of some device can match; a device's own key stands for all of it.

    >>> narrowed("imu/**", topics.STATUS), narrowed("imu/bench-1", topics.STATUS)
    (('imu/**/status',), ('imu/bench-1/**/status',))
    >>> narrowed("imu/*/*", topics.STATUS), narrowed("imu/*/status", topics.EVENT)
    (('imu/*/status', 'imu/*/*/**/status'), ())
    """
    parts = keyexpr.split("/")
    if parts[-1] in {known.name for known in topics.TOPICS}:
        return (keyexpr,) if parts[-1] == topic.name else ()
    if parts[-1] == "**":
        return (f"{keyexpr}/{topic.name}",)
    below = f"{keyexpr}/**/{topic.name}"
    return ("/".join([*parts[:-1], topic.name]), below) if parts[-1] == "*" else (below,)


def listener(connect: Sequence[str], file: Path | None) -> "zenoh.Config":
    """zenoh's configuration of a session that only listens to daemons, see ``ZenohIn``."""
    import zenoh

    try:
        own = endpoints(configuration({}, file))
    except zenoh.ZError as error:
        raise ConfigError(f"{file}: {plain(error)}") from error
    if file is not None and (line := permissions.changeable(file)):
        raise ConfigError(f"{file}: {line}")
    wanted = connect or own or (topics.ENDPOINT,)
    for endpoint in wanted:
        try:
            configuration({"connect/endpoints": [endpoint]})
        except zenoh.ZError as error:
            raise ConfigError(f'connect "{endpoint}": no endpoint; write e.g. {topics.ENDPOINT}') from error
    unsaid = {**CLOSED, "transport/link/rx/max_message_size": MESSAGE_BYTES}
    return configuration({"connect/endpoints": list(connect or wanted) if connect or not own else None}, file, unsaid)


def _subscriber(session: "zenoh.Session", topic: topics.Topic, key: str) -> Any:
    """With what daemons keep for those who come late; after a broken connection events that were missed come too."""
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
    import zenoh

    try:
        for key in keys:
            zenoh.KeyExpr(key)
    except zenoh.ZError as error:
        raise ConfigError(f'key expression "{keyexpr}": {plain(error)}') from error
    if not keys:
        shown = ", ".join(topic.name for topic in (*TOPICS, topics.ALIVE))
        raise ConfigError(f'key expression "{keyexpr}": nothing to show of it; shown are {shown}')
