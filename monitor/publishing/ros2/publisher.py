"""Publisher of ROS 2 messages over zenoh, as a node of rmw_zenoh.

The zenoh session is a client of the router of rmw_zenoh (``ros2 run rmw_zenoh_cpp rmw_zenohd``), because a router does
not forward data from one peer to another peer. A thread opens the session, encodes the messages and sends them. If the
queue of zenoh is full, each message blocks for a millisecond before it is dropped. Messages are therefore not sent by
the thread that processes samples. A bounded queue between the two threads drops the oldest messages and counts them.
"""

import contextlib
import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from drivers.secret_masking import mask_secrets
from drivers.zenoh.connection_diagnosis import explain_refusals
from drivers.zenoh.rmw_attachment import GID_BYTES, encode_attachment
from drivers.zenoh.session_config import build_session_config, format_zenoh_error, is_unconnected
from monitor.common.unit_formatting import format_count
from monitor.publishing.bounded_queue import BoundedQueue
from monitor.publishing.ros2.rmw_zenoh_names import NODE_ID, RosTopic, node_token, publisher_token
from monitor.publishing.zenoh.retried_session import RetriedSession, zenoh_errors

if TYPE_CHECKING:
    import zenoh

MAX_QUEUED_MESSAGES: Final = 20_000
"""Maximum number of queued messages (10 s of two devices at 1 kHz)."""
MAX_WAIT_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class _Batch:
    topic: RosTopic
    first_sequence: int
    count: int
    encode: Callable[[], Sequence[bytes]]


@dataclass(frozen=True, slots=True)
class _DeclaredPublisher:
    publisher: "zenoh.Publisher"
    token: Any
    gid: bytes


class Ros2Publisher(RetriedSession):
    """ROS 2 node that publishes messages on any number of topics.

    Parameters
    ----------
    connect
        Endpoints of the router of rmw_zenoh.
    domain
        Domain of ROS 2.
    namespace
        Namespace of the node, such as "/robot1", or "/".
    """

    def __init__(self, connect: Sequence[str], domain: int, namespace: str) -> None:
        super().__init__("ros2")
        self._connect = connect
        self._domain = domain
        self._namespace = namespace
        self._session_state = "not open yet"
        self._queue: BoundedQueue[_Batch] = BoundedQueue(MAX_QUEUED_MESSAGES)
        self._topics: frozenset[RosTopic] = frozenset()  # replaced as a whole, because two threads use it
        self._sequences: dict[RosTopic, int] = {}  # number of the last message of each topic
        # the following attributes belong to the thread that sends
        self._declared: dict[RosTopic, _DeclaredPublisher] = {}
        self._node_token: Any = None
        self._last_publisher_id = NODE_ID
        self._unsent_messages = 0
        self._error = ""  # reason why the newest messages could not be sent

    @property
    def state(self) -> str:
        """``ok`` or a description of the problem, for the status message."""
        session = self._session
        if wrong := self.failure or self._error:
            return wrong
        if session is None:
            return self._session_state
        if is_unconnected(session):
            return f"{self._missing_router_text()}; trying again"
        unsent = self._unsent_messages + self._queue.dropped_weight
        return f"ok, but {format_count(unsent, 'message')} not sent" if unsent else "ok"

    def add_topic(self, topic: RosTopic) -> None:
        """Declare a publisher of a topic."""
        self._topics |= {topic}
        self._queue.wake()

    def remove_topic(self, topic: RosTopic) -> None:
        """Remove the publisher of a topic after the queued messages have been sent."""
        self._topics -= {topic}
        self._sequences.pop(topic, None)
        self._queue.wake()

    def publish(self, topic: RosTopic, count: int, encode: Callable[[], Sequence[bytes]]) -> None:
        """Queue messages. The messages are dropped if no session is open.

        Parameters
        ----------
        topic
            Topic that has been added before.
        count
            Number of messages.
        encode
            Function that returns the payloads. Another thread calls the function. It raises ValueError if the messages
            cannot be encoded.
        """
        if self._session is None:
            return
        first = self._sequences.get(topic, 0) + 1
        self._sequences[topic] = first + count - 1
        self._queue.push(_Batch(topic, first, count, encode), count)

    def close(self) -> None:
        """Send the queued messages, remove the liveliness tokens and close the session."""
        self.closing.set()
        self._queue.wake()
        super().close()

    # --- methods of the thread

    def _open_session(self) -> None:
        import zenoh

        session = zenoh.open(self._configuration())
        self._session = session
        token = node_token(self._domain, str(session.info.zid()), self._namespace)
        self._node_token = session.liveliness().declare_token(token)
        self._session_state = "ok"

    def _report_failure(self, error: Exception) -> None:
        reason = ""
        with contextlib.suppress(*zenoh_errors()):  # an invalid endpoint
            reason = explain_refusals(self._connect, self._configuration()) or self._missing_router_text()
        self._session_state = f"{reason or format_zenoh_error(error)}; trying again"

    def _work_until_closed(self) -> None:
        """Send the queued messages until the session is closed."""
        while (session := self._session) is not None:
            closing, topics_before = self.closing.is_set(), self._topics
            batches = self._queue.take(0.0 if closing else MAX_WAIT_S)
            try:
                self._declare_publishers(session)
                for batch in batches:
                    self._send(batch)
                self._undeclare_publishers(topics_before | self._topics)
            except zenoh_errors() as error:
                self._error = f"cannot send: {format_zenoh_error(error)}"
            if closing:
                return

    def _declare_publishers(self, session: "zenoh.Session") -> None:
        import zenoh

        drop = zenoh.CongestionControl.DROP
        for topic in self._topics - self._declared.keys():
            self._last_publisher_id += 1
            identity = str(session.info.zid()), self._namespace, self._last_publisher_id, topic
            token = publisher_token(self._domain, *identity)
            publisher = session.declare_publisher(topic.zenoh_key(self._domain), congestion_control=drop)
            gid = hashlib.blake2b(token.encode(), digest_size=GID_BYTES).digest()
            self._declared[topic] = _DeclaredPublisher(publisher, session.liveliness().declare_token(token), gid)

    def _send(self, batch: _Batch) -> None:
        declared = self._declared.get(batch.topic)
        if declared is None:  # the topic was removed before it was declared
            return
        errors: tuple[type[Exception], ...] = (ValueError, *zenoh_errors())
        unsent, t_ns = batch.count, time.time_ns()
        try:
            for sequence, payload in enumerate(batch.encode(), batch.first_sequence):
                declared.publisher.put(payload, attachment=encode_attachment(sequence, t_ns, declared.gid))
                unsent -= 1
        except errors as error:
            self._error = f"cannot send: {format_zenoh_error(error)}"
        else:
            self._error = ""
        self._unsent_messages += unsent

    def _undeclare_publishers(self, kept: frozenset[RosTopic]) -> None:
        for topic in self._declared.keys() - kept:
            declared = self._declared.pop(topic)
            declared.token.undeclare()
            declared.publisher.undeclare()  # type: ignore[no-untyped-call]

    def _configuration(self) -> "zenoh.Config":
        return build_session_config({"mode": "client", "connect/endpoints": self._connect})

    def _missing_router_text(self) -> str:
        return f"no router of rmw_zenoh at {mask_secrets(', '.join(self._connect))}"
