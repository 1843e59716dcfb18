"""Results over zenoh: the keys of ``monitor.common.topics``, presence, commands.

The session is closed unless the configuration says otherwise: a peer without scouting that listens on loopback only.
If it cannot open (port busy: any free one is taken and said; anything else: tried again), ``state`` says so, and what
was to be put is dropped: samples go on. zenoh queues what it sends and drops for a subscriber that does not keep up,
so ``put`` does not wait for anyone. Who subscribes late can ask for the last values: an advanced publisher keeps them,
and plain subscribers notice nothing of it.

Queries of ``history`` are answered by the thread that takes them, one a device: a file is read, nothing here waits.

Commands arrive on a queryable whose queries a thread of this class takes from zenoh's channel (a Python callback that
is alive at exit would hang the process) and hands to the service by a queue; the service's loop answers them.
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
from typing import TYPE_CHECKING, Any, Final

from drivers.credential_masking import masked
from drivers.errors import ConfigError, ImuError, NotReady
from drivers.zenoh.connection_errors import refused
from drivers.zenoh.session import CLOSED, alone, configuration, endpoints, plain
from monitor.common import topics
from monitor.settings.loading import ZenohTable

if TYPE_CHECKING:
    import zenoh
    from zenoh.ext import AdvancedPublisher

RETRY_S: Final = 2.0
QUERIES_WAITING: Final = 64
LOOK_S: Final = 3.0
"""Between two looks why a router does not let us in."""
TWIN_S: Final = 10.0
"""After the last status that another program published under our key, this is said."""


@dataclass(frozen=True, slots=True)
class Command:
    """One query on ``command/<verb>``: to be answered exactly once."""

    device: str
    verb: str
    answer: Callable[[bytes], None]
    refuse: Callable[[str], None]


Recall = Callable[[str, str], bytes]
"""Device and a selector's parameters in, past results out; ImuError says why there are none."""


class ZenohOut:
    """The daemon's session and what it declares for each device.

    Args:
        settings: of the session
        devices: their names
        recall: answers queries of ``history``; None where none is kept
    """

    def __init__(self, settings: ZenohTable, devices: Sequence[str], recall: Recall | None = None) -> None:
        self.settings = settings
        self._recall = recall
        self._said = "off" if settings.mode == "none" else "not open yet"
        self._unsent = ""  # why the newest message did not go out
        self.commands: queue.Queue[Command] = queue.Queue(QUERIES_WAITING)
        self._devices = tuple(devices)
        self._alive: dict[str, bool] = dict.fromkeys(devices, False)
        self._session: zenoh.Session | None = None
        self._why = ""  # why nobody lets us in, as it was found last
        self._connect: tuple[str, ...] = settings.connect
        self._publishers: dict[str, zenoh.Publisher | AdvancedPublisher] = {}
        self._tokens: dict[str, Any] = {}
        self._queryables: dict[str, list[Any]] = {}
        self._twins = _Twins(settings.prefix)
        self._declaring = threading.Lock()  # the opener declares all devices, the loop those that come or go
        self._showing = threading.Lock()  # the opener and the loop both show who is alive
        self._opener = threading.Thread(target=self._keep_open, name="zenoh open", daemon=True)
        self._takers: list[threading.Thread] = []
        self._closing = threading.Event()

    @property
    def state(self) -> str:
        """``ok``, or what is wrong: for the status."""
        session = self._session
        if self._unsent or session is None:
            return self._unsent or self._said
        if self._connect and alone(session):
            return f"{self._why or 'nobody at ' + masked(', '.join(self._connect))}; trying again"
        twins = self._twins.found(time.monotonic())
        if not twins:
            return self._said
        return f"{self._said}{'; ' if self._said != 'ok' else ', but '}{twins}"

    def start(self) -> None:
        """Open in a thread of its own: a router that is not there must not hold up the samples."""
        if self.settings.mode == "none":
            return
        # a thread that still takes from zenoh while the interpreter ends would abort the process
        atexit.register(self.close)
        self._opener.start()

    def put(self, topic: topics.Topic, device: str, payload: bytes) -> None:
        """Send, or drop while there is no session."""
        import zenoh

        publisher = self._publishers.get(topic.key(self.settings.prefix, device))
        if publisher is None:
            return
        try:
            publisher.put(payload)
        except zenoh.ZError as error:
            self._unsent = f"cannot send: {plain(error)}"
        else:
            self._unsent = ""

    def put_on(self, key: str, payload: bytes) -> str:
        """Send JSON on a key of the user's; "" or why it did not go out."""
        import zenoh

        session = self._session
        if session is None:
            return f"not sent: zenoh: {self._said}"
        try:
            session.put(key, payload, encoding=zenoh.Encoding(topics.JSON), express=True)
        except zenoh.ZError as error:
            return f"not sent: zenoh: {plain(error)}"
        return ""

    def alive(self, device: str, flowing: bool) -> None:
        """Show or take away the device's liveliness token."""
        if self._alive[device] != flowing:
            self._alive[device] = flowing
            self._show_alive(device)

    def add(self, device: str) -> None:
        """Publish another device too."""
        with self._declaring:
            self._devices += (device,)
            self._alive[device] = False
            if self._session is not None:
                with contextlib.suppress(*_zenoh_errors()):  # the session is being closed
                    self._declare(self._session, device)

    def remove(self, device: str) -> None:
        """Take a device's keys away."""
        self.alive(device, False)
        with self._declaring, contextlib.suppress(*_zenoh_errors()):  # the session is being closed
            self._devices = tuple(one for one in self._devices if one != device)
            del self._alive[device]
            keys = {topic.key(self.settings.prefix, device) for topic in topics.TOPICS}
            gone = [self._publishers[key] for key in keys & self._publishers.keys()]
            self._publishers = {key: one for key, one in self._publishers.items() if key not in keys}
            for one in [*gone, *self._queryables.pop(device, []), *self._twins.remove(device)]:
                one.undeclare()

    def close(self) -> None:
        """Close the session, which takes away tokens, and end the threads."""
        atexit.unregister(self.close)
        self._closing.set()
        if self._opener.is_alive():
            self._opener.join(RETRY_S)
        self._end()

    # --- opening

    def _keep_open(self) -> None:
        """Thread: open, and then find out why nobody lets us in whenever nobody does."""
        errors: tuple[type[Exception], ...] = (*_zenoh_errors(), OSError)
        while not self._closing.is_set():
            try:
                self._open()
            except errors as error:
                self._said = f"{self._refused() or plain(error)}; trying again"
                self._end()
                self._closing.wait(RETRY_S)
            else:
                break
        while self._connect and not self._closing.wait(LOOK_S):
            session = self._session
            self._why = self._refused() if session is not None and alone(session) else ""
        if self._closing.is_set():  # opening took longer than close waits
            self._end()

    def _refused(self) -> str:
        """Why the endpoints do not let us in, "" where simply nobody is there."""
        with contextlib.suppress(*_zenoh_errors()):  # a file that zenoh refuses: it has said so itself
            return refused(self._connect, self._configuration(None))
        return ""

    def _end(self) -> None:
        """Close the session, which ends the threads that take from it."""
        session, self._session = self._session, None
        self._publishers, self._queryables = {}, {}
        self._twins.clear()
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]
        with self._showing:
            self._tokens = {}  # they went with the session
        takers, self._takers = self._takers, []
        for taker in takers:
            taker.join(RETRY_S)

    def _open(self) -> None:
        session, said = self._open_session()
        with self._declaring:
            self._session = session
            for device in self._devices:
                self._declare(session, device)
            self._said = said

    def _declare(self, session: "zenoh.Session", device: str) -> None:
        """All keys of a device."""
        keys = {topic: topic.key(self.settings.prefix, device) for topic in topics.TOPICS}
        published = {topic: key for topic, key in keys.items() if topic.when not in ("presence", "query")}
        new = {key: self._publisher(session, topic, key) for topic, key in published.items()}
        self._declare_commands(session, device)
        self._twins.add(session, device)
        if self._recall is not None:
            self._declare_history(session, device, self._recall)
        self._publishers = {**self._publishers, **new}
        self._show_alive(device)

    def _open_session(self) -> tuple["zenoh.Session", str]:
        """The session; on a busy port with any free one, and what to say of it."""
        import zenoh

        listen = self.settings.listen
        config = self._configuration(listen)
        self._connect = endpoints(config)
        try:
            return zenoh.open(config), "ok"
        except zenoh.ZError as error:
            if "in use" not in str(error) or listen is None:
                raise
            free = tuple(_free_port(endpoint) for endpoint in listen)
            session = zenoh.open(self._configuration(free))
            return session, f"ok, but {', '.join(listen)} is busy: listening on {', '.join(free)}"

    def _configuration(self, listen: tuple[str, ...] | None) -> "zenoh.Config":
        """Our keys, over the file's where there is one, over those of a closed session."""
        own = self.settings
        keys: dict[str, Any] = {
            "mode": own.mode,
            "listen/endpoints": [] if own.mode == "client" else listen,  # a client listens nowhere
            "connect/endpoints": own.connect or None,
        }
        unsaid = {**CLOSED, "listen/endpoints": [topics.ENDPOINT], "timestamping/enabled": True}
        return configuration(keys, own.config, unsaid)

    def _publisher(
        self, session: "zenoh.Session", topic: topics.Topic, key: str
    ) -> "zenoh.Publisher | AdvancedPublisher":
        import zenoh
        from zenoh import ext

        encoding, drop = zenoh.Encoding(topic.encoding), zenoh.CongestionControl.DROP
        express = topic.when != "batches"  # results are few and wanted soon; batches of samples may share a packet
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

    # --- presence and commands

    def _show_alive(self, device: str) -> None:
        session = self._session
        if session is None:
            return
        key = topics.ALIVE.key(self.settings.prefix, device)
        # an error here is the session being closed: the token goes with it
        with self._showing, contextlib.suppress(*_zenoh_errors()):
            if self._alive[device] and device not in self._tokens:
                self._tokens[device] = session.liveliness().declare_token(key)
            elif not self._alive[device] and device in self._tokens:
                self._tokens.pop(device).undeclare()

    def _declare_commands(self, session: "zenoh.Session", device: str) -> None:
        import zenoh

        key = f"{self.settings.prefix}/{device}/command/*"
        queryable = session.declare_queryable(key, zenoh.handlers.FifoChannel(QUERIES_WAITING))
        taker = threading.Thread(
            target=self._take_queries, args=(device, queryable), name=f"commands of {device}", daemon=True
        )
        taker.start()
        self._keep(device, queryable, taker)

    def _declare_history(self, session: "zenoh.Session", device: str, recall: Recall) -> None:
        import zenoh

        key = topics.HISTORY.key(self.settings.prefix, device)
        queryable = session.declare_queryable(key, zenoh.handlers.FifoChannel(QUERIES_WAITING))
        taker = threading.Thread(
            target=self._remember, args=(device, key, queryable, recall), name=f"history of {device}", daemon=True
        )
        taker.start()
        self._keep(device, queryable, taker)

    def _keep(self, device: str, queryable: Any, taker: threading.Thread) -> None:
        self._queryables.setdefault(device, []).append(queryable)
        self._takers = [*(one for one in self._takers if one.is_alive()), taker]

    def _remember(self, device: str, key: str, queryable: Any, recall: Recall) -> None:
        """Questions about the past, until the session is closed."""
        handler = queryable.handler
        while not self._closing.is_set():
            try:
                query = handler.recv()
            except _zenoh_errors():
                return
            answer, _ = _answers(query, key)
            with contextlib.suppress(*_zenoh_errors()):  # the session was closed meanwhile
                try:
                    payload = recall(device, str(query.parameters))
                except ImuError as error:
                    _no_answer(query, error)
                else:
                    answer(payload)

    def _take_queries(self, device: str, queryable: Any) -> None:
        """Queries until the session is closed."""
        handler = queryable.handler
        while not self._closing.is_set():
            try:
                query = handler.recv()
            except _zenoh_errors():
                return
            verb = str(query.key_expr).rsplit("/", 1)[-1]
            key = f"{self.settings.prefix}/{device}/command/{verb}"  # the query's own may stand for many devices
            command = Command(device, verb, *_answers(query, key))
            try:
                self.commands.put_nowait(command)
            except queue.Full:
                command.refuse("busy: too many commands wait")


class _Twins:
    """Other sessions that publish the status of a device under our key.

    Whoever subscribes would get both mixed, and a command would reach both.

    Parameters
    ----------
    prefix
        Prefix of the keys.
    """

    def __init__(self, prefix: str) -> None:
        self._prefix = prefix
        self._subscribers: dict[str, Any] = {}
        self._heard_s: dict[str, float] = {}

    def add(self, session: "zenoh.Session", device: str) -> None:
        """Listen to what others publish as the status of a device; our own messages do not come."""
        import zenoh

        key = topics.STATUS.key(self._prefix, device)
        ring: Any = zenoh.handlers.RingChannel(1)
        one = session.declare_subscriber(key, ring, allowed_origin=zenoh.Locality.REMOTE)
        self._subscribers = {**self._subscribers, device: one}

    def remove(self, device: str) -> list[Any]:
        """Forget a device; returns what is to be undeclared."""
        self._heard_s.pop(device, None)
        gone = [one for name, one in self._subscribers.items() if name == device]
        self._subscribers = {name: one for name, one in self._subscribers.items() if name != device}
        return gone

    def clear(self) -> None:
        """Forget all; they go with their session."""
        self._subscribers, self._heard_s = {}, {}

    def found(self, now_s: float) -> str:
        """Return one line if another program published a device's status within the last TWIN_S; else ""."""
        for device, one in self._subscribers.items():
            with contextlib.suppress(*_zenoh_errors()):  # the session is being closed
                if one.handler.try_recv() is not None:
                    self._heard_s[device] = now_s
        keys = [f"{self._prefix}/{one}" for one, at_s in self._heard_s.items() if now_s - at_s < TWIN_S]
        if not keys:
            return ""
        return f"another program publishes {', '.join(sorted(keys))} too; change a device's name, or zenoh.prefix"


def _answers(query: Any, key: str) -> tuple[Callable[[bytes], None], Callable[[str], None]]:
    """Functions that end a query with a result, or with an error."""
    import zenoh

    def answer(payload: bytes) -> None:
        with query:
            query.reply(key, payload, encoding=zenoh.Encoding(topics.JSON))

    def refuse(why: str) -> None:
        with query:
            query.reply_err(json.dumps({"error": why}).encode(), encoding=zenoh.Encoding(topics.JSON))

    return answer, refuse


def _no_answer(query: Any, error: ImuError) -> None:
    """End a query with what is wrong, and with the exit status that a command would have."""
    import zenoh

    status = 3 if isinstance(error, NotReady) else 2 if isinstance(error, ConfigError) else 1
    with query:
        said = json.dumps({"error": str(error), "exit": status}).encode()
        query.reply_err(said, encoding=zenoh.Encoding(topics.JSON))


def _free_port(endpoint: str) -> str:
    """The same endpoint on a port that is free now; others than tcp/host:port stay as they are."""
    match = re.fullmatch(r"tcp/\[?([^\]]+?)\]?:\d+", endpoint)
    if match is None:
        return endpoint
    family = socket.AF_INET6 if ":" in match[1] else socket.AF_INET
    with socket.create_server((match[1], 0), family=family) as server:
        return re.sub(r":\d+$", f":{server.getsockname()[1]}", endpoint)


def _zenoh_errors() -> tuple[type[Exception], ...]:
    import zenoh

    return (zenoh.ZError,)
