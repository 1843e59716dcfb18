"""Other daemons' results from zenoh: what ``watch`` listens to.

The session is closed but for the endpoints given: a peer that listens nowhere and scouts nobody. A peer and not a
client, as a client stays with the first endpoint that answers, while a peer goes to all of them, waits for those that
are not there yet and goes back to those that went. Raw samples and curves, the bulk of what daemons send, are not
subscribed to.

Each subscription ends in a ring of zenoh's that drops its oldest, and a thread of this class moves what comes to one
backlog (a Python callback that is alive at exit would hang the process). ``take`` gives what came, in order of arrival
within a topic; nothing here reads a payload.
"""

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from drivers.errors import ConfigError
from drivers.zenoh_session import configuration, plain
from monitor import topics
from monitor.publish.backlog import Backlog

if TYPE_CHECKING:
    import zenoh

KEYEXPR: Final = "imu/**"
TOPICS: Final = (topics.STATUS, topics.COEFFICIENTS, topics.EVENT)
RING_MESSAGES: Final = 4096
BACKLOG_BYTES: Final = 16_000_000
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
        connect: endpoints of daemons or routers

    Raises:
        ConfigError: zenoh refuses the key expression or an endpoint
    """

    def __init__(self, keyexpr: str = KEYEXPR, connect: Sequence[str] = (topics.ENDPOINT,)) -> None:
        self._keys = {topic: narrowed(keyexpr, topic) for topic in (*TOPICS, topics.ALIVE)}
        self._connect = tuple(connect)
        self._config = _configuration(self._connect)
        self._said = "not open yet"
        self._backlog: Backlog[Message] = Backlog(BACKLOG_BYTES)
        self._session: zenoh.Session | None = None
        self._closing = threading.Event()
        self._opener = threading.Thread(target=self._open_until_open, name="zenoh open", daemon=True)
        self._takers: list[threading.Thread] = []
        _check_keys(keyexpr, [key for keys in self._keys.values() for key in keys])

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
            return f"nobody at {', '.join(self._connect)}; trying again"
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

    def _open_until_open(self) -> None:
        import zenoh

        while not self._closing.is_set():
            try:
                session = zenoh.open(self._config)
                self._session = session
                self._subscribe(session)
            except zenoh.ZError as error:
                self._said = f"{plain(error)}; trying again"
                self._end()
                self._closing.wait(RETRY_S)
            else:
                return

    def _end(self) -> None:
        """Close the session, which ends the threads that take from it."""
        session, self._session = self._session, None
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]
        takers, self._takers = self._takers, []
        for taker in takers:
            taker.join(RETRY_S)

    def _subscribe(self, session: "zenoh.Session") -> None:
        import zenoh

        for topic, keys in self._keys.items():
            for key in keys:
                ring: Any = zenoh.handlers.RingChannel(RING_MESSAGES)
                if topic is topics.ALIVE:
                    subscriber: Any = session.liveliness().declare_subscriber(key, ring, history=True)
                else:
                    subscriber = session.declare_subscriber(key, ring)
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


def _check_keys(keyexpr: str, keys: list[str]) -> None:
    import zenoh

    try:
        for key in keys:
            zenoh.KeyExpr(key)
    except UnicodeEncodeError as error:
        raise ConfigError(f'key expression "{keyexpr!a}": no UTF-8') from error
    except zenoh.ZError as error:
        raise ConfigError(f'key expression "{keyexpr}": {plain(error)}') from error
    if not keys:
        shown = ", ".join(topic.name for topic in (*TOPICS, topics.ALIVE))
        raise ConfigError(f'key expression "{keyexpr}": nothing to show of it; shown are {shown}')


def _configuration(connect: tuple[str, ...]) -> "zenoh.Config":
    import zenoh

    for endpoint in connect:
        try:
            configuration({"connect/endpoints": [endpoint]})
        except (zenoh.ZError, UnicodeEncodeError) as error:
            raise ConfigError(f'connect "{endpoint}": no endpoint; write e.g. {topics.ENDPOINT}') from error
    return configuration({"connect/endpoints": connect})
