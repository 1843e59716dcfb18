"""The daemon's session as others see it, through a router on loopback."""

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
def started(**settings: Any) -> Iterator[ZenohPublisher]:
    out = ZenohPublisher(ZenohTable(**settings), DEVICES)
    out.start()
    try:
        yield out
    finally:
        out.close()


@contextlib.contextmanager
def through_a_router(endpoint: str) -> Iterator[tuple[ZenohPublisher, Any]]:
    """A daemon that is open, and a client beside it."""
    with (
        open_router(endpoint),
        open_session(connect=[endpoint]) as client,
        started(mode="client", connect=(endpoint,)) as out,
    ):
        wait_for(lambda: out.state == "ok")
        yield out, client


def received(subscriber: Any) -> list[Any]:
    return list(iter(subscriber.try_recv, None))


def test_every_topic_arrives_with_its_key_encoding_and_bytes(endpoint: str) -> None:
    with through_a_router(endpoint) as (out, client):
        subscriber = client.declare_subscriber("imu/**", zenoh.handlers.FifoChannel(1000))
        expected = {
            (topic.key("imu", device), topic.encoding, f"{topic.name} of {device}".encode())
            for topic in PUBLISHED
            for device in DEVICES
        }
        got: set[tuple[str, str, bytes]] = set()

        def all_there() -> bool:
            for topic in PUBLISHED:
                for device in DEVICES:
                    out.put(topic, device, f"{topic.name} of {device}".encode())
            got.update((str(s.key_expr), str(s.encoding), bytes(s.payload)) for s in received(subscriber))
            return got >= expected

        wait_for(all_there)
        assert got == expected


def test_puts_carry_a_time_and_come_in_order(endpoint: str) -> None:
    with through_a_router(endpoint) as (out, client):
        subscriber = client.declare_subscriber("imu/bench-1/status", zenoh.handlers.FifoChannel(1000))
        samples: list[Any] = []

        def some_there() -> bool:
            out.put(topics.STATUS, "bench-1", str(time.monotonic_ns()).encode())
            samples.extend(received(subscriber))
            return len(samples) >= 20

        wait_for(some_there)
        assert all(sample.timestamp is not None for sample in samples)
        sent = [int(bytes(sample.payload)) for sample in samples]
        assert sent == sorted(sent)


def test_presence_comes_and_goes_with_the_samples(endpoint: str) -> None:
    with through_a_router(endpoint) as (out, client):
        subscriber = client.liveliness().declare_subscriber("imu/**", zenoh.handlers.FifoChannel(100), history=True)
        seen: list[tuple[str, bool]] = []

        def follows(*expected: tuple[str, bool]) -> None:
            def come() -> bool:
                seen.extend((str(s.key_expr), s.kind == zenoh.SampleKind.PUT) for s in received(subscriber))
                return len(seen) >= len(expected)

            wait_for(come)
            assert tuple(seen) == expected
            seen.clear()

        out.set_alive("bench-1", True)
        follows(("imu/bench-1/alive", True))
        out.set_alive("bench-1", True)  # said twice, shown once
        out.set_alive("bench-2", True)
        follows(("imu/bench-2/alive", True))
        out.set_alive("bench-1", False)
        follows(("imu/bench-1/alive", False))
        out.close()
        follows(("imu/bench-2/alive", False))


def answering(out: ZenohPublisher, known: str = "reset") -> threading.Thread:
    """What the service's loop does with one command."""

    def answer() -> None:
        command: Command = out.commands.get(timeout=PATIENCE_S)
        if command.verb == known:
            command.reply_result(json.dumps({"of": command.device}).encode())
        else:
            command.reply_refusal(f'unknown command "{command.verb}"')

    thread = threading.Thread(target=answer)
    thread.start()
    return thread


def replies(client: Any, key: str) -> list[Any]:
    def ask() -> list[Any]:
        return list(client.get(key, timeout=PATIENCE_S))

    return list(wait_for(ask))


def test_a_command_is_answered(endpoint: str) -> None:
    with through_a_router(endpoint) as (out, client):
        thread = answering(out)
        (reply,) = replies(client, "imu/bench-2/command/reset")
        thread.join()
        assert json.loads(bytes(reply.ok.payload)) == {"of": "bench-2"}
        assert str(reply.ok.encoding) == topics.JSON


def test_a_command_to_all_devices_is_answered_by_each(endpoint: str) -> None:
    with through_a_router(endpoint) as (out, client):
        threads = [answering(out), answering(out)]
        found = [json.loads(bytes(reply.ok.payload))["of"] for reply in replies(client, "imu/*/command/reset")]
        for thread in threads:
            thread.join()
        assert sorted(found) == sorted(DEVICES)


def test_a_verb_that_is_not_known_is_refused(endpoint: str) -> None:
    with through_a_router(endpoint) as (out, client):
        thread = answering(out)
        (reply,) = replies(client, "imu/bench-1/command/explode")
        thread.join()
        assert reply.ok is None
        assert json.loads(bytes(reply.err.payload)) == {"error": 'unknown command "explode"'}


def test_commands_that_nobody_takes_are_refused_not_kept_without_end(endpoint: str) -> None:
    with through_a_router(endpoint) as (out, client):
        handlers = [
            client.get("imu/bench-1/command/reset", timeout=PATIENCE_S) for _ in range(out.commands.maxsize + 3)
        ]
        wait_for(out.commands.full)
        refused: list[Any] = []

        def come() -> bool:
            refused.extend(reply for handler in handlers if (reply := _try(handler)) is not None)
            return len(refused) >= 3

        wait_for(come)
        assert all("busy" in json.loads(bytes(reply.err.payload))["error"] for reply in refused)
        while not out.commands.empty():
            out.commands.get_nowait().reply_refusal("the test is over")


def _try(handler: Any) -> Any:
    try:
        return handler.try_recv()
    except zenoh.ZError:
        return None  # answered before


def test_a_busy_port_is_left_and_said(endpoint: str) -> None:
    port = int(endpoint.rsplit(":", 1)[1])
    with socket.create_server(("127.0.0.1", port)), started(listen=(endpoint,)) as out:
        wait_for(lambda: out.state != "not open yet")
        assert out.state.startswith(f"ok, but {endpoint} is busy: listening on tcp/127.0.0.1:")
        found = out.state.rpartition(" ")[2]
        assert found != endpoint
        with open_session(connect=[found]) as client:
            subscriber = client.declare_subscriber("imu/**", zenoh.handlers.FifoChannel(100))

            def comes() -> bool:
                out.put(topics.STATUS, "bench-1", b"x")
                return bool(received(subscriber))

            wait_for(comes)


@pytest.mark.parametrize("listen", [None, ("tcp/127.0.0.1:1",)])
def test_a_client_listens_nowhere(
    endpoint: str, monkeypatch: pytest.MonkeyPatch, listen: tuple[str, ...] | None
) -> None:
    """It opens although the default port is busy and the given one is not to be had."""
    with socket.create_server(("127.0.0.1", 0)) as busy, open_router(endpoint):
        monkeypatch.setattr(topics, "ENDPOINT", f"tcp/127.0.0.1:{busy.getsockname()[1]}")
        with started(mode="client", listen=listen, connect=(endpoint,)) as out:
            wait_for(lambda: out.state != "not open yet")
            assert out.state == "ok"


@pytest.mark.skipif(sys.platform != "linux", reason="reads the kernel's table of sockets")
def test_it_listens_on_loopback_only(endpoint: str) -> None:
    port = f":{int(endpoint.rsplit(':', 1)[1]):04X}"
    with started(listen=(endpoint,)) as out:
        wait_for(lambda: out.state == "ok")
        rows = [line.split() for line in Path("/proc/net/tcp").read_text("ascii").splitlines()]
        listening = [row[1] for row in rows if row[1].endswith(port) and row[3] == "0A"]
        assert listening == [f"0100007F{port}"]
        tcp6 = Path("/proc/net/tcp6")
        assert not tcp6.exists() or not re.search(rf"{port} \S+ 0A", tcp6.read_text("ascii"))


def test_a_router_that_comes_later(endpoint: str) -> None:
    with started(mode="client", connect=(endpoint,)) as out:
        wait_for(lambda: out.state != "not open yet")
        assert out.state.startswith("Unable to connect")
        assert out.state.endswith("trying again")
        assert ".rs" not in out.state
        out.set_alive("bench-1", True)
        out.put(topics.STATUS, "bench-1", b"dropped, as nobody is there")
        with open_router(endpoint), open_session(connect=[endpoint]) as client:
            wait_for(lambda: out.state == "ok")
            tokens = wait_for(lambda: list(client.liveliness().get("imu/**", timeout=PATIENCE_S)))
            assert [str(token.ok.key_expr) for token in tokens] == ["imu/bench-1/alive"]
            out.close()


def test_closing_while_it_waits_for_a_router(endpoint: str) -> None:
    out = ZenohPublisher(ZenohTable(mode="client", connect=(endpoint,)), DEVICES)
    out.start()
    wait_for(lambda: out.state != "not open yet")
    out.close()
    assert not any(thread.name == "zenoh open" for thread in threading.enumerate())


def test_a_subscriber_that_takes_nothing_holds_nobody_up(endpoint: str) -> None:
    with through_a_router(endpoint) as (out, client):
        full = client.declare_subscriber("imu/**", zenoh.handlers.FifoChannel(1))  # blocks its session when full
        payload = bytes(100_000)
        for _ in range(2000):  # 200 MB, more than any buffer between them; the subscriber takes one of them at most
            out.put(topics.SAMPLES, "bench-1", payload)
        out.close()
        while full.try_recv() is not None:
            pass
        full.undeclare()


def test_no_session_at_all() -> None:
    with started(mode="none") as out:
        assert out.state == "off"
        out.set_alive("bench-1", True)
        out.put(topics.STATUS, "bench-1", b"x")
    assert not any("commands of" in thread.name for thread in threading.enumerate())


def test_a_process_that_forgets_to_close_still_ends(endpoint: str) -> None:
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
