"""Tests of the ROS 2 publisher through a router on loopback."""

import contextlib
import struct
import threading
from collections.abc import Iterator
from typing import Any

import pytest
import zenoh

from monitor.publishing.ros2 import publisher as ros2_publisher
from monitor.publishing.ros2.publisher import Ros2Publisher
from monitor.publishing.ros2.rmw_zenoh_names import DIAGNOSTICS, imu_topic, node_token, publisher_token
from tests.support.ports import free_endpoint
from tests.support.waiting import FOREVER_S, wait_for
from tests.support.zenoh_sessions import open_router, open_session

DOMAIN = 7
NAMESPACE = "/robot1"
SAMPLES = imu_topic(NAMESPACE, "bench-1", "raw")


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@contextlib.contextmanager
def start_publisher(endpoint: str) -> Iterator[Ros2Publisher]:
    publisher = Ros2Publisher((endpoint,), DOMAIN, NAMESPACE)
    publisher.add_topic(DIAGNOSTICS)
    publisher.start()
    try:
        yield publisher
    finally:
        publisher.close()


@contextlib.contextmanager
def connect_through_router(endpoint: str) -> Iterator[tuple[Ros2Publisher, Any]]:
    """Yield a connected publisher and a client."""
    with open_router(endpoint), open_session(connect=[endpoint]) as client, start_publisher(endpoint) as publisher:
        wait_for(lambda: publisher.state == "ok")
        yield publisher, client


def receive_all(subscriber: Any) -> list[Any]:
    return list(iter(subscriber.try_recv, None))


class TokenListener:
    """Set of the liveliness tokens of the domain that exist now."""

    def __init__(self, client: Any) -> None:
        channel: Any = zenoh.handlers.FifoChannel(100)
        self._subscriber = client.liveliness().declare_subscriber(f"@ros2_lv/{DOMAIN}/**", channel, history=True)
        self._tokens: set[str] = set()

    def read(self) -> set[str]:
        for sample in receive_all(self._subscriber):
            change = self._tokens.add if sample.kind == zenoh.SampleKind.PUT else self._tokens.discard
            change(str(sample.key_expr))
        return self._tokens


def test_tokens_follow_the_topics(endpoint: str) -> None:
    with connect_through_router(endpoint) as (publisher, client):
        listener = TokenListener(client)
        wait_for(lambda: len(listener.read()) == 2)
        session_id = next(iter(listener.read())).split("/")[2]
        node = node_token(DOMAIN, session_id, NAMESPACE)
        diagnostics = publisher_token(DOMAIN, session_id, NAMESPACE, 1, DIAGNOSTICS)
        samples = publisher_token(DOMAIN, session_id, NAMESPACE, 2, SAMPLES)
        assert listener.read() == {node, diagnostics}
        publisher.add_topic(SAMPLES)
        wait_for(lambda: listener.read() == {node, diagnostics, samples})
        publisher.remove_topic(SAMPLES)
        wait_for(lambda: listener.read() == {node, diagnostics})
        publisher.close()
        wait_for(lambda: listener.read() == set())


def test_messages_arrive_in_order_with_sequence_number_and_identifier(endpoint: str) -> None:
    with connect_through_router(endpoint) as (publisher, client):
        subscriber = client.declare_subscriber(SAMPLES.zenoh_key(DOMAIN), zenoh.handlers.FifoChannel(1000))
        publisher.add_topic(SAMPLES)
        got: list[Any] = []

        def publish_and_check_count() -> bool:
            publisher.publish(SAMPLES, 2, lambda: [b"first", b"second"])
            publisher.publish(DIAGNOSTICS, 1, lambda: [b"status"])
            got.extend(receive_all(subscriber))
            return len(got) >= 10

        wait_for(publish_and_check_count)
    attachments = [struct.unpack("<qqB16s", bytes(one.attachment)) for one in got]
    sequences = [sequence for sequence, *_ in attachments]
    assert sequences == list(range(sequences[0], sequences[0] + len(got)))
    assert [bytes(one.payload) for one in got] == [b"second" if number % 2 == 0 else b"first" for number in sequences]
    assert len({gid for *_, gid in attachments}) == 1
    assert {length for _, _, length, _ in attachments} == {16}


def test_queued_messages_are_sent_before_the_topic_is_removed_and_the_session_closed(endpoint: str) -> None:
    with connect_through_router(endpoint) as (publisher, client):
        subscriber = client.declare_subscriber(f"{DOMAIN}/**", zenoh.handlers.FifoChannel(1000))
        publisher.add_topic(SAMPLES)
        keys: set[str] = set()
        got: list[bytes] = []

        def both_topics_arrive() -> bool:
            publisher.publish(DIAGNOSTICS, 1, lambda: [b""])
            publisher.publish(SAMPLES, 1, lambda: [b""])
            keys.update(str(one.key_expr) for one in receive_all(subscriber))
            return len(keys) == 2

        def receive_three() -> bool:
            got.extend(payload for one in receive_all(subscriber) if (payload := bytes(one.payload)))
            return len(got) >= 3

        wait_for(both_topics_arrive)
        may_encode = threading.Event()

        def encode_later() -> list[bytes]:
            may_encode.wait(FOREVER_S)
            return [b"status"]

        publisher.publish(DIAGNOSTICS, 1, encode_later)
        publisher.publish(SAMPLES, 1, lambda: [b"sample"])
        publisher.remove_topic(SAMPLES)
        publisher.publish(DIAGNOSTICS, 1, lambda: [b"last"])
        may_encode.set()
        publisher.close()
        wait_for(receive_three)
        assert got == [b"status", b"sample", b"last"]


def test_messages_that_wait_too_long_are_dropped_counted_and_skipped(
    endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros2_publisher, "MAX_QUEUED_MESSAGES", 4)
    with connect_through_router(endpoint) as (publisher, client):
        subscriber = client.declare_subscriber(DIAGNOSTICS.zenoh_key(DOMAIN), zenoh.handlers.FifoChannel(1000))

        def first_arrives() -> bool:
            publisher.publish(DIAGNOSTICS, 1, lambda: [b"0"])
            return bool(receive_all(subscriber))

        wait_for(first_arrives)
        wait_for(lambda: not publisher._queue._items)
        before = publisher._sequences[DIAGNOSTICS]
        encoding, may_encode = threading.Event(), threading.Event()

        def encode_later() -> list[bytes]:
            encoding.set()
            may_encode.wait(FOREVER_S)
            return [b"1"]

        publisher.publish(DIAGNOSTICS, 1, encode_later)
        wait_for(encoding.is_set)
        publisher.publish(DIAGNOSTICS, 3, lambda: [b"2", b"3", b"4"])
        publisher.publish(DIAGNOSTICS, 2, lambda: [b"5", b"6"])
        may_encode.set()
        got: list[Any] = []

        def receive_last() -> bool:
            got.extend(receive_all(subscriber))
            return bool(got) and bytes(got[-1].payload) == b"6"

        wait_for(receive_last)
        got = [one for one in got if bytes(one.payload) != b"0"]
        assert [bytes(one.payload) for one in got] == [b"1", b"5", b"6"]
        sequences = [struct.unpack_from("<q", bytes(one.attachment))[0] for one in got]
        assert [sequence - before for sequence in sequences] == [1, 5, 6]
        assert publisher.state == "ok, but 3 messages not sent"


def test_messages_that_cannot_be_encoded_are_counted(endpoint: str) -> None:
    def refuse() -> list[bytes]:
        raise ValueError("the time does not fit")

    with connect_through_router(endpoint) as (publisher, _):
        publisher.publish(DIAGNOSTICS, 2, refuse)
        wait_for(lambda: publisher.state == "cannot send: the time does not fit")
        publisher.publish(DIAGNOSTICS, 1, lambda: [b"status"])
        wait_for(lambda: publisher.state == "ok, but 2 messages not sent")


def test_missing_router_is_reported_and_nothing_is_queued(endpoint: str) -> None:
    with start_publisher(endpoint) as publisher:
        wait_for(lambda: publisher.state == f"no router of rmw_zenoh at {endpoint}; trying again")
        publisher.publish(DIAGNOSTICS, 1, list)
        assert publisher._queue.take(0.0) == []
        with open_router(endpoint):
            wait_for(lambda: publisher.state == "ok")


def test_invalid_endpoint_is_reported() -> None:
    with start_publisher("teapot/127.0.0.1:7447") as publisher:
        wait_for(lambda: "teapot" in publisher.state)
        assert publisher.state.endswith("; trying again")


def test_topics_return_with_a_restarted_router(endpoint: str) -> None:
    with start_publisher(endpoint) as publisher:
        with open_router(endpoint):
            wait_for(lambda: publisher.state == "ok")
        wait_for(lambda: publisher.state.startswith("no router"))
        with open_router(endpoint), open_session(connect=[endpoint]) as client:
            listener = TokenListener(client)
            subscriber = client.declare_subscriber(DIAGNOSTICS.zenoh_key(DOMAIN), zenoh.handlers.FifoChannel(1000))
            wait_for(lambda: len(listener.read()) == 2)

            def publish_and_receive() -> bool:
                publisher.publish(DIAGNOSTICS, 1, lambda: [b"status"])
                return bool(receive_all(subscriber))

            wait_for(publish_and_receive)
