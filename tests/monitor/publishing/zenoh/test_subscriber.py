"""Tests of the Zenoh subscriber and ``watch`` with daemons that start late, end and return."""

import contextlib
import io
import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from rich.console import Console

from drivers.errors import ConfigError
from monitor.common import topics
from monitor.publishing.messages.results import CoefficientsMessage, StatusMessage
from monitor.publishing.terminal import watch
from monitor.publishing.zenoh.publisher import ZenohPublisher
from monitor.publishing.zenoh.subscriber import ReceivedMessageOrLiveliness, ZenohSubscriber
from monitor.settings.loading import ZenohTable
from tests.monitor.publishing import example_results
from tests.support.ports import free_endpoint
from tests.support.waiting import PATIENCE_S, stays_true, wait_for
from tests.support.zenoh_sessions import open_router, open_session, patient_file


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@contextlib.contextmanager
def run_daemon(endpoint: str, device: str, mode: str = "peer") -> Iterator[ZenohPublisher]:
    """Run a daemon's session that sends ten statuses per second and other topics."""
    settings = ZenohTable(listen=(endpoint,)) if mode == "peer" else ZenohTable(mode="client", connect=(endpoint,))
    publisher = ZenohPublisher(settings, [device])
    ending = threading.Event()

    def send_messages() -> None:
        while not ending.wait(0.1):
            publisher.put(
                topics.STATUS,
                device,
                StatusMessage.from_result(device, time.time(), 0, example_results.make_health()).encode(),
            )
            publisher.put(
                topics.COEFFICIENTS,
                device,
                CoefficientsMessage.from_result(device, time.time(), 0, example_results.make_estimate()).encode(),
            )
            publisher.put(topics.SAMPLES, device, b"raw")
            publisher.put(topics.ALLAN, device, b"curve")

    publisher.start()
    publisher.set_alive(device, True)
    sender = threading.Thread(target=send_messages)
    sender.start()
    try:
        yield publisher
    finally:
        ending.set()
        sender.join()
        publisher.close()


@contextlib.contextmanager
def start_subscriber(
    keyexpr: str, *connect: str
) -> Iterator[tuple[ZenohSubscriber, list[ReceivedMessageOrLiveliness]]]:
    with contextlib.closing(ZenohSubscriber(keyexpr, connect)) as subscriber:
        subscriber.start()
        yield subscriber, []


def collect_keys(subscriber: ZenohSubscriber, messages: list[ReceivedMessageOrLiveliness]) -> set[str]:
    messages += subscriber.take(0.1)
    return {m.key for m in messages}


EXPECTED_KEYS = {"imu/a/status", "imu/a/coefficients", "imu/a/alive"}


def test_results_and_liveliness_arrive_without_samples_and_curves(endpoint: str) -> None:
    with run_daemon(endpoint, "a"), start_subscriber("imu/**", endpoint) as (subscriber, messages):
        wait_for(lambda: collect_keys(subscriber, messages) >= EXPECTED_KEYS)
        wait_for(lambda: len([collect_keys(subscriber, messages) for _ in range(5)]))
        assert collect_keys(subscriber, messages) == EXPECTED_KEYS
        assert subscriber.state == "ok"
        status = next(m for m in messages if m.key == "imu/a/status")
        assert json.loads(status.payload or b"")["device"] == "a"
        assert [m for m in messages if m.payload is None] == [ReceivedMessageOrLiveliness("imu/a/alive", None, True)]


@pytest.mark.parametrize(
    ("keyexpr", "expected"),
    [
        ("imu/a", EXPECTED_KEYS),
        ("**", EXPECTED_KEYS),
        ("imu/*", EXPECTED_KEYS),
        ("*/*/*", EXPECTED_KEYS),
        ("imu/*/status", {"imu/a/status"}),
    ],
)
def test_key_expression_selects_the_messages(endpoint: str, keyexpr: str, expected: set[str]) -> None:
    with run_daemon(endpoint, "a"), start_subscriber(keyexpr, endpoint) as (subscriber, messages):
        wait_for(lambda: collect_keys(subscriber, messages) >= expected)
        assert collect_keys(subscriber, messages) == expected


def test_messages_of_other_devices_do_not_arrive(endpoint: str) -> None:
    with (
        run_daemon(endpoint, "a"),
        start_subscriber("imu/other/**", endpoint) as (subscriber, messages),
        start_subscriber("imu/**", endpoint) as (other, other_messages),
    ):
        wait_for(lambda: subscriber.state == "ok" and collect_keys(other, other_messages) >= EXPECTED_KEYS)
        assert stays_true(lambda: collect_keys(subscriber, messages) == set())


def test_daemons_that_start_late_end_and_return_are_followed() -> None:
    first, second = free_endpoint(), free_endpoint()
    with start_subscriber("imu/**", first, second) as (subscriber, messages):
        wait_for(lambda: subscriber.state == f"nobody at {first}, {second}; trying again")
        with run_daemon(second, "b"):
            wait_for(lambda: collect_keys(subscriber, messages) >= {"imu/b/status", "imu/b/alive"})
            assert subscriber.state == f"connected to 1 of 2; missing: {first}; trying again"
            with run_daemon(first, "a"):
                wait_for(lambda: collect_keys(subscriber, messages) >= {"imu/a/status", "imu/a/alive"})
                assert subscriber.state == "ok"
            wait_for(
                lambda: (
                    collect_keys(subscriber, messages)
                    and ReceivedMessageOrLiveliness("imu/a/alive", None, False) in messages
                )
            )
            assert ReceivedMessageOrLiveliness("imu/b/alive", None, False) not in messages
            messages.clear()
            with run_daemon(first, "a"):
                wait_for(
                    lambda: (
                        collect_keys(subscriber, messages)
                        and ReceivedMessageOrLiveliness("imu/a/alive", None, True) in messages
                    )
                )


def test_messages_arrive_through_a_router(endpoint: str) -> None:
    with (
        open_router(endpoint),
        run_daemon(endpoint, "a", mode="client"),
        start_subscriber("imu/**", endpoint) as (subscriber, messages),
    ):
        wait_for(lambda: collect_keys(subscriber, messages) >= EXPECTED_KEYS)
        assert subscriber.state == "ok"


def test_messages_of_a_peer_arrive_through_a_router(endpoint: str) -> None:
    """A router forwards nothing from a peer to a peer."""
    publisher = ZenohPublisher(ZenohTable(listen=(free_endpoint(),), connect=(endpoint,)), ["a"])
    with (
        open_router(endpoint),
        contextlib.closing(publisher),
        start_subscriber("imu/**", endpoint) as (subscriber, messages),
    ):
        publisher.start()
        publisher.set_alive("a", True)

        def publish_and_check_keys() -> bool:
            publisher.put(
                topics.STATUS,
                "a",
                StatusMessage.from_result("a", time.time(), 0, example_results.make_health()).encode(),
            )
            return collect_keys(subscriber, messages) >= {"imu/a/status", "imu/a/alive"}

        wait_for(publish_and_check_keys)


def test_two_routes_to_a_daemon_deliver_each_message_once(tmp_path: Path) -> None:
    first, second, patient = free_endpoint(), free_endpoint(), patient_file(tmp_path)
    with (
        open_session(mode="router", listen=[first]),
        open_session(mode="router", listen=[second], connect=[first]),
        contextlib.closing(
            ZenohPublisher(ZenohTable(config=patient, mode="client", connect=(first,)), ["a"])
        ) as publisher,
        start_subscriber("imu/**", first, second) as (subscriber, messages),
    ):
        publisher.start()
        wait_for(lambda: publisher.state == subscriber.state == "ok")
        sent = [f"{i}".encode() for i in range(20)]
        wait_for(lambda: publisher.put(topics.EVENT, "a", b"ready") or collect_keys(subscriber, messages))
        wait_for(lambda: not collect_keys(subscriber, []))
        messages.clear()
        for payload in sent:
            publisher.put(topics.EVENT, "a", payload)
        wait_for(lambda: collect_keys(subscriber, messages) and messages[-1].payload == sent[-1])

        def received_each_once() -> bool:
            collect_keys(subscriber, messages)
            return [m.payload for m in messages if m.payload != b"ready"] == sent  # some messages arrive late

        assert stays_true(received_each_once, 0.3)


def test_late_subscriber_gets_the_last_values_and_events(endpoint: str) -> None:
    kept = {topic: topic.kept for topic in (topics.STATUS, topics.COEFFICIENTS, topics.EVENT)}
    far = free_endpoint()
    with (
        open_session(mode="router", listen=[endpoint]) as near,
        open_session(mode="router", listen=[far], connect=[endpoint]) as beyond,
        contextlib.closing(ZenohPublisher(ZenohTable(listen=(), connect=(endpoint,)), ["a"])) as publisher,
    ):
        publisher.start()
        wait_for(lambda: publisher.state == "ok")
        with near.declare_queryable("linked", lambda query: query.reply("linked", b"")):
            wait_for(lambda: any(reply.ok for reply in beyond.get("linked")), "the link between the routers")
        for i in range(15):
            for topic in kept:
                publisher.put(topic, "a", f"{topic.name} {i}".encode())
        with start_subscriber("imu/**", far) as (subscriber, messages):
            expected = {f"{topic.name} {i}".encode() for topic, n in kept.items() for i in range(15 - n, 15)}
            wait_for(lambda: collect_keys(subscriber, messages) and {m.payload for m in messages} >= expected)
            assert {m.payload for m in messages} == expected


def test_too_long_message_is_dropped_and_later_ones_arrive(endpoint: str) -> None:
    with (
        open_session(mode="router", listen=[endpoint]) as sender,
        start_subscriber("imu/**", endpoint) as (subscriber, messages),
    ):

        def send_payload(payload: bytes) -> None:
            sender.put("imu/a/status", payload, congestion_control=zenoh.CongestionControl.BLOCK)

        wait_for(lambda: send_payload(b"ready") or collect_keys(subscriber, messages))
        send_payload(b"x" * 100_000_000)
        wait_for(
            lambda: send_payload(b"after") or (collect_keys(subscriber, messages) and messages[-1].payload == b"after")
        )
        assert max(len(m.payload or b"") for m in messages) < 10
        assert subscriber.state == "ok"


def test_closing_at_any_time_leaves_no_thread(endpoint: str) -> None:
    before = threading.active_count()
    for wait_s in (0.0, 0.3, 0.8):
        subscriber = ZenohSubscriber("imu/**", [endpoint])
        subscriber.start()
        time.sleep(wait_s)
        subscriber.close()
        assert threading.active_count() == before
    ZenohSubscriber().close()  # this subscriber was never started


@pytest.mark.parametrize("keyexpr", ["", "imu//a", "/imu", "imu/**x", "a?b"])
def test_invalid_key_expression_is_refused(keyexpr: str) -> None:
    with pytest.raises(ConfigError, match="key expression") as raised:
        ZenohSubscriber(keyexpr)
    assert ".rs" not in str(raised.value)


def test_topic_that_cannot_be_shown_is_refused() -> None:
    with pytest.raises(ConfigError, match="no topic to show; possible topics are status, coefficients, event, alive"):
        ZenohSubscriber("imu/a/samples")


def test_invalid_endpoint_is_refused() -> None:
    with pytest.raises(ConfigError, match='connect "localhost:7450": not a valid endpoint'):
        ZenohSubscriber("imu/**", ["tcp/127.0.0.1:1", "localhost:7450"])


# --- watch


def test_watch_once_prints_one_table(endpoint: str) -> None:
    console = Console(width=120, file=io.StringIO())
    with run_daemon(endpoint, "a"):
        watch.watch(connect=[endpoint], console=console, once_s=2.0)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert text.count("imu-monitor  1 device") == 1
    assert re.search(r"^a +● running +99\.98 +360,000 ", text, re.MULTILINE)
    assert "[95 % interval]" in text


def test_watch_prints_plain_tables_without_a_terminal(endpoint: str) -> None:
    console, stop = Console(width=120, file=io.StringIO()), threading.Event()
    watcher = threading.Thread(target=watch.watch, args=("imu/**", [endpoint], stop, console))
    watcher.start()
    text = wait_for(lambda: console.file.getvalue() if console.file.getvalue().count("device") > 2 else "")  # type: ignore[attr-defined]
    stop.set()
    watcher.join(PATIENCE_S)
    assert not watcher.is_alive()
    assert f"nobody at {endpoint}; trying again" in text
    assert "\x1b" not in text


@pytest.mark.long
def test_watch_on_a_terminal_ends_with_ctrl_c_and_status_0(endpoint: str) -> None:
    code = f"""
        from rich.console import Console
        from monitor.publishing.terminal.watch import watch
        watch(connect=["{endpoint}"], console=Console(force_terminal=True, width=120))
    """
    with run_daemon(endpoint, "a"):
        child = subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(code)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=os.environ | {"TERM": "xterm-256color"},
        )
        assert child.stdout is not None
        assert child.stderr is not None
        seen = b""
        while "● running".encode() not in seen:
            seen += os.read(child.stdout.fileno(), 65536)
        child.send_signal(signal.SIGINT)
        assert child.wait(PATIENCE_S) == 0
        rest = child.stdout.read()
        assert b"\x1b[?25l" in seen  # the cursor was hidden …
        assert b"\x1b[?25h" in rest  # … and is shown again
        assert child.stderr.read() == b""
        child.stdout.close()
        child.stderr.close()
