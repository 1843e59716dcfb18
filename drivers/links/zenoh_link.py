"""Messages of another system over zenoh: one message a chunk, with its attachment.

The session is the link's own, and closed: no scouting, no listening, only the endpoints that the
settings name. With one endpoint it is a client, which needs that to open: a router passes nothing on between two
peers, and publishers mostly are peers. With several it is a peer, as a client would stay with the first that
answers: it opens at once and zenoh itself goes on trying to connect in the background, so an absent publisher
shows as silence, not as ``LinkLost``.

zenoh fills a ring channel that overwrites its oldest when full (a decoder sees that in the sequence
numbers). A thread of the link's own takes from it and stamps each message, as zenoh's channels cannot be
waited on with a timeout; no Python callback is registered, since one that lives at exit hangs the
process. Closing the session ends that thread, and with it a waiting ``read``. A program that ends without
closing has it closed by ``atexit``: a thread that still waited in zenoh then would abort the process.
"""

import atexit
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec

from drivers.credential_masking import masked
from drivers.discovery import FilePath
from drivers.errors import ConfigError, LinkLost, LinkUnavailable
from drivers.links.base import Carrier, Link, LinkSettings
from drivers.sample import Chunk
from drivers.zenoh.connection_errors import refused
from drivers.zenoh.session import CLOSED, configuration, endpoints, plain

if TYPE_CHECKING:
    import zenoh

DEFAULT_DECODER: Final = "samples"
RING_SIZE: Final = 4096
"""Messages; four seconds at 1 kHz."""
WAITING_BYTES: Final = 128_000_000
"""Of all that wait to be read: twice the longest message that a session takes in."""


class Settings(LinkSettings, frozen=True, kw_only=True):
    """Keys of a zenoh link."""

    key: str
    """Key expression: "imu/bench-1/samples", "0/imu/data/sensor_msgs::msg::dds_::Imu_/**"."""
    mode: Literal["peer", "client"] | None = None
    """Absent: as the file says, else client where one endpoint is named, and peer where several are or none."""
    connect: list[str] = msgspec.field(default_factory=list)
    """Endpoints, "tcp/127.0.0.1:7447"."""
    listen: list[str] = msgspec.field(default_factory=list)
    config: FilePath = ""
    """A zenoh JSON5 file for all else (TLS, access control); the keys above win where they are given."""


class ZenohLink:
    """One subscription in a session of its own."""

    carrier: Carrier = "messages"
    epoch: Literal["monotonic", "unix"] = "monotonic"

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.name = f"zenoh {settings.key}"
        self._opening = threading.Lock()
        self._changed = threading.Condition()
        self._waiting: deque[Chunk] = deque()
        self._bytes = 0  # of all that wait
        self._session: zenoh.Session | None = None
        self._taker: threading.Thread | None = None
        self._running = False

    def open(self) -> None:
        """Open the session and subscribe; a client needs its router, a peer needs nobody."""
        import zenoh

        with self._opening:
            if self._session is not None:
                if self._running:
                    return
                self._close_session()
            try:
                session = zenoh.open(_configuration(self._settings))
            except zenoh.ZError as error:
                raise LinkUnavailable(self._why_not_open(error)) from error
            self._session = session
            try:
                channel: Any = zenoh.handlers.RingChannel(RING_SIZE)
                subscriber: Any = session.declare_subscriber(self._settings.key, channel)
            except zenoh.ZError as error:
                self._close_session()
                raise LinkUnavailable(f"{self.name}: cannot subscribe: {plain(error)}") from error
            self._forget()
            self._running = True
            self._taker = threading.Thread(
                target=self._take, args=(subscriber,), name=f"{self.name} taker", daemon=True
            )
            self._taker.start()
            atexit.register(self.close)

    def read(self, timeout_s: float) -> list[Chunk] | None:
        """Messages that came, waiting up to ``timeout_s`` for the first."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or not self._running, timeout_s)
            if self._waiting:
                chunks = list(self._waiting)
                self._forget()
                return chunks
            if not self._running:
                raise LinkLost(f"{self.name}: the session is closed")
            return None

    def close(self) -> None:
        """Close the session; ends a waiting ``read``."""
        with self._opening:
            self._close_session()

    def _take(self, subscriber: Any) -> None:
        """Thread: ring channel -> stamped chunks, until the session is closed."""
        import zenoh

        handler = subscriber.handler  # the subscriber itself cannot be undeclared while it waits
        try:
            while True:
                sample = handler.recv()
                chunk = _chunk(sample, time.monotonic_ns())
                with self._changed:
                    self._keep(chunk)
                    self._changed.notify_all()
        except zenoh.ZError:
            pass  # the channel was closed: by close(), or by a session that failed
        finally:
            with self._changed:
                self._running = False
                self._changed.notify_all()

    def _forget(self) -> None:
        self._waiting.clear()
        self._bytes = 0

    def _keep(self, chunk: Chunk) -> None:
        """The newest; the oldest give way."""
        self._waiting.append(chunk)
        self._bytes += len(chunk.data)
        while len(self._waiting) > 1 and (self._bytes > WAITING_BYTES or len(self._waiting) > RING_SIZE):
            self._bytes -= len(self._waiting.popleft().data)

    def _close_session(self) -> None:
        atexit.unregister(self.close)
        session, self._session = self._session, None
        taker, self._taker = self._taker, None
        with self._changed:
            self._running = False
            self._forget()
            self._changed.notify_all()
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]
        if taker is not None:
            taker.join()

    def _why_not_open(self, error: Exception) -> str:
        config = _configuration(self._settings)
        places = endpoints(config)
        nobody = (
            f"nobody at {masked(', '.join(places)) or '(connect is empty)'}; start the router or the publisher there"
        )
        if config.get_json("mode") == '"client"':
            return f"{self.name}: {refused(places, config) or nobody}"
        return f"{self.name}: check the endpoints of listen and connect: {plain(error)}"


def _chunk(sample: Any, t_ns: int) -> Chunk:
    attachment = sample.attachment
    return Chunk(bytes(sample.payload), t_ns, attachment=b"" if attachment is None else bytes(attachment))


def _configuration(settings: Settings) -> "zenoh.Config":
    own = {
        "mode": settings.mode,
        "connect/endpoints": settings.connect or None,
        "listen/endpoints": settings.listen or None,
    }
    config = configuration(own, settings.config)
    if settings.mode is None and not settings.listen and len(endpoints(config)) == 1:
        return configuration(own, settings.config, {**CLOSED, "mode": "client"})
    return config


def build(settings: Settings) -> Link:
    """The link of these settings; opens nothing.

    Raises ``ConfigError`` for a key expression, an endpoint or a configuration file that zenoh refuses.
    """
    import zenoh

    wrong = []
    try:
        zenoh.KeyExpr(settings.key)
    except zenoh.ZError as error:
        wrong.append(f'key: "{settings.key}": {plain(error)}')
    try:
        _configuration(settings)
    except zenoh.ZError as error:
        wrong.append(f"zenoh settings: {plain(error)}")
    if wrong:
        raise ConfigError(*wrong)
    return ZenohLink(settings)
