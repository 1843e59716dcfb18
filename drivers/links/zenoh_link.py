"""Link that receives messages over zenoh. Each chunk contains one message and its attachment.

Each link opens its own zenoh session. The session connects only to the configured endpoints, without discovering other
programs or accepting connections. A session with one endpoint is a zenoh client, because a router does not forward data
from one peer to another peer. A client session can be opened only if the endpoint answers. A session with several
endpoints is a zenoh peer, because a client would use only the first endpoint that answers. A peer session opens
immediately, and zenoh connects in the background. While there is no publisher, no messages arrive, but ``LinkLost`` is
not raised.

zenoh writes messages to a ring channel, which overwrites the oldest message when the channel is full. The decoder
detects lost messages from the sequence numbers. A thread takes the messages from the channel and adds the arrival
times, because the channels of zenoh have no timeout. The link registers no Python callback with zenoh, because a
callback that still exists at exit blocks the process. A session that is still open at exit is closed by ``atexit``,
because a thread that waits in zenoh would abort the process.
"""

import atexit
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final, Literal

from pydantic import Field

from drivers.data_types import Chunk
from drivers.errors import ConfigError, LinkLost, LinkUnavailable
from drivers.links.base import Carrier, Link, LinkSettings
from drivers.secret_masking import mask_secrets
from drivers.validation.settings_model import FilePath, ListOf
from drivers.zenoh.connection_diagnosis import explain_refusals
from drivers.zenoh.session_config import (
    DEFAULT_CONFIGURATION,
    build_session_config,
    find_connect_endpoints,
    format_zenoh_error,
)

if TYPE_CHECKING:
    import zenoh

DEFAULT_DECODER: Final = "samples"
MAX_MESSAGES: Final = 4096
"""Maximum number of queued messages (four seconds at 1 kHz)."""
MAX_QUEUED_BYTES: Final = 128_000_000
"""Maximum total size of the queued messages in bytes.

The value is twice the size of the longest message that a session accepts.
"""


class Settings(LinkSettings):
    """Configuration keys of a zenoh link."""

    key: str = Field(
        examples=["imu/bench-1/samples"],
        description='key expression, such as "0/imu/data/sensor_msgs::msg::dds_::Imu_/**" for ROS 2',
    )
    mode: Literal["peer", "client"] | None = Field(
        None,
        examples=["client"],
        description="mode of the session; absent: as in the zenoh file, or client if there is one endpoint, else peer",
    )
    connect: ListOf[str] = Field((), examples=[["tcp/127.0.0.1:7447"]], description="endpoints to connect to")
    listen: ListOf[str] = Field(
        (), examples=[["tcp/127.0.0.1:7460"]], description="endpoints for publishers that connect to this process"
    )
    config: FilePath = Field(
        "",
        examples=["zenoh.json5"],
        description="zenoh file for all other settings (TLS, access control); the keys above take precedence",
    )


class ZenohLink:
    """Link that receives the messages of one zenoh subscription."""

    carrier: Carrier = "messages"
    epoch: Literal["monotonic", "unix"] = "monotonic"

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.name = f"zenoh {settings.key}"
        self._opening = threading.Lock()
        self._changed = threading.Condition()
        self._waiting: deque[Chunk] = deque()
        self._waiting_bytes = 0  # total size of the waiting messages
        self._session: zenoh.Session | None = None
        self._receiver: threading.Thread | None = None
        self._running = False

    def open(self) -> None:
        """Open the session and subscribe.

        A client session requires a running router, and a peer session opens immediately.
        """
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
                channel: Any = zenoh.handlers.RingChannel(MAX_MESSAGES)
                subscriber: Any = session.declare_subscriber(self._settings.key, channel)
            except zenoh.ZError as error:
                self._close_session()
                raise LinkUnavailable(f"{self.name}: cannot subscribe: {format_zenoh_error(error)}") from error
            self._clear_waiting()
            self._running = True
            self._receiver = threading.Thread(
                target=self._receive, args=(subscriber,), name=f"{self.name} receiver", daemon=True
            )
            self._receiver.start()
            atexit.register(self.close)

    def wait_for_chunks_or_timeout(self, timeout_s: float) -> list[Chunk] | None:
        """Return the received messages, or None if nothing arrives within ``timeout_s`` seconds."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or not self._running, timeout_s)
            if self._waiting:
                chunks = list(self._waiting)
                self._clear_waiting()
                return chunks
            if not self._running:
                raise LinkLost(f"{self.name}: the session is closed")
            return None

    def close(self) -> None:
        """Close the session, and interrupt a waiting call of ``wait_for_chunks_or_timeout``."""
        with self._opening:
            self._close_session()

    def _receive(self, subscriber: Any) -> None:
        """Move messages from the ring channel to the queue until the session is closed."""
        import zenoh

        handler = subscriber.handler  # a subscriber that waits for messages cannot be closed
        try:
            while True:
                sample = handler.recv()
                chunk = _to_chunk(sample, time.monotonic_ns())
                with self._changed:
                    if not self._running:
                        return  # ``close`` dropped the queue, so a later message would follow a gap
                    self._enqueue(chunk)
                    self._changed.notify_all()
        except zenoh.ZError:
            pass  # the session is closed: the reader gets the queued messages, and then LinkLost
        finally:
            with self._changed:
                self._running = False
                self._changed.notify_all()

    def _clear_waiting(self) -> None:
        self._waiting.clear()
        self._waiting_bytes = 0

    def _enqueue(self, chunk: Chunk) -> None:
        """Append a chunk to the queue, and drop the oldest chunks if the queue is full."""
        self._waiting.append(chunk)
        self._waiting_bytes += len(chunk.data)
        while len(self._waiting) > 1 and (self._waiting_bytes > MAX_QUEUED_BYTES or len(self._waiting) > MAX_MESSAGES):
            self._waiting_bytes -= len(self._waiting.popleft().data)

    def _close_session(self) -> None:
        atexit.unregister(self.close)
        session, self._session = self._session, None
        receiver, self._receiver = self._receiver, None
        with self._changed:
            self._running = False
            self._clear_waiting()
            self._changed.notify_all()
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]
        if receiver is not None:
            receiver.join()

    def _why_not_open(self, error: Exception) -> str:
        config = _configuration(self._settings)
        endpoints = find_connect_endpoints(config)
        shown = mask_secrets(", ".join(endpoints)) or "(connect is empty)"
        nobody = f"nobody at {shown}; start the router or the publisher there"
        if config.get_json("mode") == '"client"':
            return f"{self.name}: {explain_refusals(endpoints, config) or nobody}"
        return f"{self.name}: check the endpoints of listen and connect: {format_zenoh_error(error)}"


def _to_chunk(sample: Any, t_ns: int) -> Chunk:
    attachment = sample.attachment
    return Chunk(bytes(sample.payload), t_ns, attachment=b"" if attachment is None else bytes(attachment))


def _configuration(settings: Settings) -> "zenoh.Config":
    own = {
        "mode": settings.mode,
        "connect/endpoints": settings.connect or None,
        "listen/endpoints": settings.listen or None,
    }
    config = build_session_config(own, settings.config)
    if settings.mode is None and not settings.listen and len(find_connect_endpoints(config)) == 1:
        return build_session_config(own, settings.config, {**DEFAULT_CONFIGURATION, "mode": "client"})
    return config


def build(settings: Settings) -> Link:
    """Return the link without opening the session.

    Raises
    ------
    ConfigError
        If zenoh rejects the key expression (topic pattern), an endpoint or the configuration file.
    """
    import zenoh

    wrong = []
    try:
        zenoh.KeyExpr(settings.key)
    except zenoh.ZError as error:
        wrong.append(f'key: "{settings.key}": {format_zenoh_error(error)}')
    try:
        _configuration(settings)
    except zenoh.ZError as error:
        wrong.append(f"zenoh settings: {format_zenoh_error(error)}")
    if wrong:
        raise ConfigError(*wrong)
    return ZenohLink(settings)
