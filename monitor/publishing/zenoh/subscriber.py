"""Other daemons' results from zenoh: what ``watch`` listens to.

Each endpoint given has a session of its own, closed to all else: a client that listens nowhere and scouts nobody. A
client and not a peer, as a router passes nothing on between two peers, and daemons are peers; one for each endpoint, as
a client stays with the first that answers. An endpoint that is not there is tried again. A zenoh file may bring
certificates, user and password. Raw samples and curves, the bulk of what daemons send, are subscribed to for devices in
detail alone.

Who comes late gets the last values that daemons keep for that, and their last events; of events those too that a
broken connection kept away. Each subscription ends in a ring of zenoh's that drops its oldest, and a thread of this
class moves what comes to one backlog (a Python callback that is alive at exit would hang the process). ``take`` gives
what came, in order of arrival within a topic; nothing here reads a payload. Memory is bounded whatever is sent: zenoh
takes in no message above ``MESSAGE_BYTES``, and the backlog drops its oldest.
"""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from drivers.credential_masking import masked
from drivers.errors import ConfigError
from drivers.zenoh.connection_errors import why
from drivers.zenoh.session import CLOSED, alone, configuration, endpoints, plain
from monitor.common import topics
from monitor.publishing.rerun.bounded_queue import Backlog
from monitor.settings import file_permissions

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
BEAT_S: Final = 0.25
"""Between two looks whether an endpoint has gone."""
TOKENS: Final = 20_000
LOOK_S: Final = 3.0
"""Between two looks why an endpoint does not let us in."""
RETRY_S: Final = 1.0
OPENING_S: Final = 5.0
"""An endpoint that does not answer is waited for so long at most."""
REMEMBERED: Final = 20_000
"""Messages, to know those that come by several endpoints: two seconds of a thousand devices at 10 Hz."""


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
        keys = {topic: narrowed(keyexpr, topic) for topic in (*TOPICS, topics.ALIVE)}
        _check_keys(keyexpr, [key for part in keys.values() for key in part])
        keys |= {topic: tuple(f"{device}/{topic.name}" for device in detail) for topic in DETAIL}
        self._backlog: Backlog[Message] = Backlog(BACKLOG_BYTES)
        found = listeners(connect, file)
        self._once = _Once() if len(found) > 1 else None
        self._doors = [_Door(endpoint, config, keys, self._push) for endpoint, config in found.items()]

    @property
    def dropped(self) -> int:
        """Messages that came while nobody took any."""
        return self._backlog.dropped

    @property
    def state(self) -> str:
        """``ok``, or in a few words who is not there."""
        absent = {door.endpoint: door.why for door in self._doors if not door.open}
        if not absent:
            return "ok"
        every = ", ".join(door.endpoint for door in self._doors)
        reasons = "; ".join(f"{endpoint}: {why}" for endpoint, why in absent.items() if why)
        if len(absent) == len(self._doors):
            return f"{reasons or 'nobody at ' + every}; trying again"
        there = f"{len(self._doors) - len(absent)} of {len(self._doors)} there ({every})"
        return f"{there}; {reasons + '; ' if reasons else ''}trying the rest again"

    @property
    def open_s(self) -> float:
        """For how long every endpoint has been there."""
        return min(door.open_s for door in self._doors)

    def start(self) -> None:
        """Open in threads of their own; returns at once."""
        for door in self._doors:
            door.start()

    def take(self, timeout_s: float) -> list[Message]:
        """What came since the last call; waits up to ``timeout_s`` when nothing did."""
        return self._backlog.take(timeout_s)

    def close(self) -> None:
        """Close the sessions and end the threads."""
        for door in self._doors:
            door.closing.set()
        for door in self._doors:
            door.close()
        self._backlog.wake()

    def _push(self, message: Message, stamp: str) -> None:
        if self._once is None or self._once.is_new(message.key, stamp):
            self._backlog.push(message, 100 + len(message.payload or b""))


class _Once:
    """What several endpoints of one network bring twice, passed on once: by zenoh's time stamps, which are unique."""

    def __init__(self) -> None:
        self._seen: OrderedDict[tuple[str, str], None] = OrderedDict()
        self._lock = threading.Lock()

    def is_new(self, key: str, stamp: str) -> bool:
        if not stamp:
            return True
        with self._lock:
            if (key, stamp) in self._seen:
                return False
            self._seen[key, stamp] = None
            if len(self._seen) > REMEMBERED:
                self._seen.popitem(last=False)
            return True


class _Door:
    """The session at one endpoint: opened until it opens, in a thread of its own."""

    def __init__(
        self,
        endpoint: str,
        config: "zenoh.Config",
        keys: Mapping[topics.Topic, Sequence[str]],
        push: Callable[[Message, str], None],
    ) -> None:
        self.endpoint = masked(endpoint)
        self.why = ""  # why it does not let us in, as it was found last; "": nobody is there
        self.closing = threading.Event()
        self._endpoint, self._config, self._keys, self._push = endpoint, config, keys, push
        self._session: zenoh.Session | None = None
        self._opener = threading.Thread(target=self._keep_open, name=f"zenoh {self.endpoint}", daemon=True)
        self._takers: list[threading.Thread] = []
        self._there: set[str] = set()  # keys of tokens
        self._since_s: float | None = None  # monotonic s since which it is open

    @property
    def open(self) -> bool:
        session = self._session
        return session is not None and not alone(session)

    @property
    def open_s(self) -> float:
        since_s = self._since_s
        return 0.0 if since_s is None else time.monotonic() - since_s

    def start(self) -> None:
        self._opener.start()

    def close(self) -> None:
        self.closing.set()
        if self._opener.is_alive():
            self._opener.join(OPENING_S)
        self._end()

    def _keep_open(self) -> None:
        """Thread: open, and then find out why nobody is there whenever nobody is."""
        import zenoh

        while not self.closing.is_set():
            try:
                session = self._session = zenoh.open(self._config)
                self._subscribe(session)
            except zenoh.ZError:
                self._end()
                self.why = why(self._endpoint, self._config)
                self.closing.wait(RETRY_S)
            else:
                break
        self._look_after()

    def _look_after(self) -> None:
        """Until closed: zenoh reconnects by itself, but takes away no token when it is the endpoint that went."""
        asked_s = -LOOK_S
        while not self.closing.wait(BEAT_S):
            if self.open:
                self.why, self._since_s = "", self._since_s or time.monotonic()
                continue
            self._since_s = None
            while self._there:
                self._push(Message(self._there.pop(), None, there=False), "")
            if time.monotonic() - asked_s >= LOOK_S:
                self.why = why(self._endpoint, self._config)
                asked_s = time.monotonic()

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
        while not self.closing.is_set():
            try:
                sample = handler.recv()
            except zenoh.ZError:
                return  # closed
            key, there = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            if liveliness:
                if not there:
                    self._there.discard(key)
                elif len(self._there) < TOKENS:
                    self._there.add(key)
            stamp = "" if liveliness or sample.timestamp is None else str(sample.timestamp)
            self._push(Message(key, None if liveliness else bytes(sample.payload), there), stamp)


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


def listeners(connect: Sequence[str], file: Path | None) -> dict[str, "zenoh.Config"]:
    """Endpoint -> zenoh's configuration of a session there that only listens and asks, see ``ZenohIn``."""
    import zenoh

    if file is not None and (line := file_permissions.changeable(file)):
        raise ConfigError(f"{file}: {line}")
    try:
        theirs = endpoints(configuration({}, file))
    except zenoh.ZError as error:
        text = plain(error)
        raise ConfigError(text if text.startswith(str(file)) else f"{file}: {text}") from error
    unsaid = {**CLOSED, "transport/link/rx/max_message_size": MESSAGE_BYTES}
    found = {}
    for endpoint in dict.fromkeys(connect or theirs or (topics.ENDPOINT,)):
        own = {"mode": "client", "connect/endpoints": [endpoint], "listen/endpoints": []}
        try:
            found[endpoint] = configuration(own, file, unsaid)
        except (zenoh.ZError, UnicodeEncodeError) as error:
            raise ConfigError(f'connect "{masked(endpoint)}": no endpoint; write e.g. {topics.ENDPOINT}') from error
    return found


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
    except UnicodeEncodeError as error:
        raise ConfigError(f'key expression "{keyexpr!a}": no UTF-8') from error
    except zenoh.ZError as error:
        raise ConfigError(f'key expression "{keyexpr}": {plain(error)}') from error
    if not keys:
        shown = ", ".join(topic.name for topic in (*TOPICS, topics.ALIVE))
        raise ConfigError(f'key expression "{keyexpr}": nothing to show of it; shown are {shown}')
