"""Tests of the Zenoh publisher through a router on loopback."""

import contextlib
import json
import re
import socket
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from monitor.common import topics
from monitor.publishing.zenoh.publisher import Command, ZenohPublisher
from monitor.settings.loading import ZenohTable
from tests.support.ports import free_endpoint
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.zenoh_sessions import open_router, open_session

DEVICES = ("bench-1", "bench-2")
PUBLISHED = [topic for topic in topics.TOPICS if topic.when not in ("presence", "query")]


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@contextlib.contextmanager
def start_publisher(**settings: Any) -> Iterator[ZenohPublisher]:
    publisher = ZenohPublisher(ZenohTable(**settings), DEVICES)
    publisher.start()
    try:
        yield publisher
    finally:
        publisher.close()


@contextlib.contextmanager
def connect_through_router(endpoint: str) -> Iterator[tuple[ZenohPublisher, Any]]:
    """Yield a connected publisher and a client."""
    with (
        open_router(endpoint),
        open_session(connect=[endpoint]) as client,
        start_publisher(mode="client", connect=(endpoint,)) as publisher,
    ):
        wait_for(lambda: publisher.state == "ok")
        yield publisher, client


def receive_all(subscriber: Any) -> list[Any]:
    return list(iter(subscriber.try_recv, None))


def test_every_topic_arrives_with_its_key_encoding_and_bytes(endpoint: str) -> None:
    with connect_through_router(endpoint) as (publisher, client):
        subscriber = client.declare_subscriber("imu/**", zenoh.handlers.FifoChannel(1000))
        expected = {
            (topic.key("imu", device), topic.encoding, f"{topic.name} of {device}".encode())
            for topic in PUBLISHED
            for device in DEVICES
        }
        got: set[tuple[str, str, bytes]] = set()

        def publish_and_check_all() -> bool:
            for topic in PUBLISHED:
                for device in DEVICES:
                    publisher.put(topic, device, f"{topic.name} of {device}".encode())
            got.update((str(s.key_expr), str(s.encoding), bytes(s.payload)) for s in receive_all(subscriber))
            return got >= expected

        wait_for(publish_and_check_all)
        assert got == expected


def test_samples_have_a_time_and_arrive_in_order(endpoint: str) -> None:
    with connect_through_router(endpoint) as (publisher, client):
        subscriber = client.declare_subscriber("imu/bench-1/status", zenoh.handlers.FifoChannel(1000))
        samples: list[Any] = []

        def publish_and_check_count() -> bool:
            publisher.put(topics.STATUS, "bench-1", str(time.monotonic_ns()).encode())
            samples.extend(receive_all(subscriber))
            return len(samples) >= 20

        wait_for(publish_and_check_count)
        assert all(sample.timestamp is not None for sample in samples)
        sent = [int(bytes(sample.payload)) for sample in samples]
        assert sent == sorted(sent)


def test_liveliness_follows_the_devices(endpoint: str) -> None:
    with connect_through_router(endpoint) as (publisher, client):
        subscriber = client.liveliness().declare_subscriber("imu/**", zenoh.handlers.FifoChannel(100), history=True)
        seen: list[tuple[str, bool]] = []

        def expect_changes(*expected: tuple[str, bool]) -> None:
            def receive_changes() -> bool:
                seen.extend((str(s.key_expr), s.kind == zenoh.SampleKind.PUT) for s in receive_all(subscriber))
                return len(seen) >= len(expected)

            wait_for(receive_changes)
            assert tuple(seen) == expected
            seen.clear()

        publisher.set_alive("bench-1", True)
        expect_changes(("imu/bench-1/alive", True))
        publisher.set_alive("bench-1", True)  # a repeated value is not sent again
        publisher.set_alive("bench-2", True)
        expect_changes(("imu/bench-2/alive", True))
        publisher.set_alive("bench-1", False)
        expect_changes(("imu/bench-1/alive", False))
        publisher.close()
        expect_changes(("imu/bench-2/alive", False))


def answer_one_command(publisher: ZenohPublisher, known: str = "reset") -> threading.Thread:
    """Answer one command as the main loop of the service does."""

    def answer() -> None:
        command: Command = publisher.commands.get(timeout=PATIENCE_S)
        if command.verb == known:
            command.reply_result(json.dumps({"of": command.device}).encode())
        else:
            command.reply_refusal(f'unknown command "{command.verb}"')

    thread = threading.Thread(target=answer)
    thread.start()
    return thread


def get_replies(client: Any, key: str) -> list[Any]:
    def ask() -> list[Any]:
        return list(client.get(key, timeout=PATIENCE_S))

    return list(wait_for(ask))


def test_command_is_answered(endpoint: str) -> None:
    with connect_through_router(endpoint) as (publisher, client):
        thread = answer_one_command(publisher)
        (reply,) = get_replies(client, "imu/bench-2/command/reset")
        thread.join()
        assert json.loads(bytes(reply.ok.payload)) == {"of": "bench-2"}
        assert str(reply.ok.encoding) == topics.JSON


def test_command_to_all_devices_is_answered_by_each(endpoint: str) -> None:
    with connect_through_router(endpoint) as (publisher, client):
        threads = [answer_one_command(publisher), answer_one_command(publisher)]
        found = [json.loads(bytes(reply.ok.payload))["of"] for reply in get_replies(client, "imu/*/command/reset")]
        for thread in threads:
            thread.join()
        assert sorted(found) == sorted(DEVICES)


def test_unknown_command_is_refused(endpoint: str) -> None:
    with connect_through_router(endpoint) as (publisher, client):
        thread = answer_one_command(publisher)
        (reply,) = get_replies(client, "imu/bench-1/command/explode")
        thread.join()
        assert reply.ok is None
        assert json.loads(bytes(reply.err.payload)) == {"error": 'unknown command "explode"'}


def test_excess_commands_are_refused(endpoint: str) -> None:
    with connect_through_router(endpoint) as (publisher, client):
        handlers = [
            client.get("imu/bench-1/command/reset", timeout=PATIENCE_S) for _ in range(publisher.commands.maxsize + 3)
        ]
        wait_for(publisher.commands.full)
        refused: list[Any] = []

        def collect_refusals() -> bool:
            refused.extend(reply for handler in handlers if (reply := _try_receive(handler)) is not None)
            return len(refused) >= 3

        wait_for(collect_refusals)
        assert all("busy" in json.loads(bytes(reply.err.payload))["error"] for reply in refused)
        while not publisher.commands.empty():
            publisher.commands.get_nowait().reply_refusal("the test is over")


def _try_receive(handler: Any) -> Any:
    try:
        return handler.try_recv()
    except zenoh.ZError:
        return None  # the query has been answered already


def test_busy_port_is_replaced_and_reported(endpoint: str) -> None:
    port = int(endpoint.rsplit(":", 1)[1])
    with socket.create_server(("127.0.0.1", port)), start_publisher(listen=(endpoint,)) as publisher:
        wait_for(lambda: publisher.state != "not open yet")
        assert publisher.state.startswith(f"ok, but {endpoint} is busy: listening on tcp/127.0.0.1:")
        found = publisher.state.rpartition(" ")[2]
        assert found != endpoint
        with open_session(connect=[found]) as client:
            subscriber = client.declare_subscriber("imu/**", zenoh.handlers.FifoChannel(100))

            def publish_and_receive() -> bool:
                publisher.put(topics.STATUS, "bench-1", b"x")
                return bool(receive_all(subscriber))

            wait_for(publish_and_receive)


@pytest.mark.parametrize("listen", [None, ("tcp/127.0.0.1:1",)])
def test_client_does_not_listen(endpoint: str, monkeypatch: pytest.MonkeyPatch, listen: tuple[str, ...] | None) -> None:
    """The client opens although the default port is busy and the given port is not available."""
    with socket.create_server(("127.0.0.1", 0)) as busy, open_router(endpoint):
        monkeypatch.setattr(topics, "ENDPOINT", f"tcp/127.0.0.1:{busy.getsockname()[1]}")
        with start_publisher(mode="client", listen=listen, connect=(endpoint,)) as publisher:
            wait_for(lambda: publisher.state != "not open yet")
            assert publisher.state == "ok"


@pytest.mark.skipif(sys.platform != "linux", reason="reads the kernel's table of sockets")
def test_publisher_listens_on_loopback_only(endpoint: str) -> None:
    port = f":{int(endpoint.rsplit(':', 1)[1]):04X}"
    with start_publisher(listen=(endpoint,)) as publisher:
        wait_for(lambda: publisher.state == "ok")
        rows = [line.split() for line in Path("/proc/net/tcp").read_text("ascii").splitlines()]
        listening = [row[1] for row in rows if row[1].endswith(port) and row[3] == "0A"]
        assert listening == [f"0100007F{port}"]
        tcp6 = Path("/proc/net/tcp6")
        assert not tcp6.exists() or not re.search(rf"{port} \S+ 0A", tcp6.read_text("ascii"))


def test_publisher_connects_to_a_router_that_starts_later(endpoint: str) -> None:
    with start_publisher(mode="client", connect=(endpoint,)) as publisher:
        wait_for(lambda: publisher.state != "not open yet")
        assert publisher.state.startswith("Unable to connect")
        assert publisher.state.endswith("trying again")
        assert ".rs" not in publisher.state
        publisher.set_alive("bench-1", True)
        publisher.put(topics.STATUS, "bench-1", b"dropped, as nobody is there")
        with open_router(endpoint), open_session(connect=[endpoint]) as client:
            wait_for(lambda: publisher.state == "ok")
            tokens = wait_for(lambda: list(client.liveliness().get("imu/**", timeout=PATIENCE_S)))
            assert [str(token.ok.key_expr) for token in tokens] == ["imu/bench-1/alive"]
            publisher.close()


def test_publisher_can_be_closed_while_it_waits_for_a_router(endpoint: str) -> None:
    publisher = ZenohPublisher(ZenohTable(mode="client", connect=(endpoint,)), DEVICES)
    publisher.start()
    wait_for(lambda: publisher.state != "not open yet")
    publisher.close()
    assert not any(thread.name == "zenoh open" for thread in threading.enumerate())


def test_subscriber_that_takes_nothing_does_not_block_the_publisher(endpoint: str) -> None:
    with connect_through_router(endpoint) as (publisher, client):
        full = client.declare_subscriber("imu/**", zenoh.handlers.FifoChannel(1))  # a full channel blocks its session
        payload = bytes(100_000)
        for _ in range(2000):  # 200 MB exceed all buffers
            publisher.put(topics.SAMPLES, "bench-1", payload)
        publisher.close()
        while full.try_recv() is not None:
            pass
        full.undeclare()


def test_mode_none_opens_no_session() -> None:
    with start_publisher(mode="none") as publisher:
        assert publisher.state == "off"
        publisher.set_alive("bench-1", True)
        publisher.put(topics.STATUS, "bench-1", b"x")
    assert not any("commands of" in thread.name for thread in threading.enumerate())


def test_process_ends_without_closing_the_publisher(endpoint: str) -> None:
    code = f"""
        import time
        from monitor.publishing.zenoh.publisher import ZenohPublisher
        from monitor.settings.schema import ZenohTable
        out = ZenohPublisher(ZenohTable(listen=("{endpoint}",)), ["a"])
        out.start()
        while out.state != "ok":
            time.sleep(0.02)
        out.set_alive("a", True)
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(code)], timeout=PATIENCE_S, check=True)
