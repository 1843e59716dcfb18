"""``watch`` against daemons on loopback: those that are there, come late, go, and come back."""

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
from tests.monitor.publishing import made
from tests.support.ports import free_endpoint
from tests.support.waiting import PATIENCE_S, stays_true, wait_for
from tests.support.zenoh_sessions import open_router, open_session, patient_file


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@contextlib.contextmanager
def daemon(endpoint: str, device: str, mode: str = "peer") -> Iterator[ZenohPublisher]:
    """A daemon's session that sends status ten times a second, and what no watcher needs beside it."""
    settings = ZenohTable(listen=(endpoint,)) if mode == "peer" else ZenohTable(mode="client", connect=(endpoint,))
    out = ZenohPublisher(settings, [device])
    ending = threading.Event()

    def talk() -> None:
        while not ending.wait(0.1):
            out.put(topics.STATUS, device, StatusMessage.from_result(device, time.time(), 0, made.health()).encode())
            out.put(
                topics.COEFFICIENTS,
                device,
                CoefficientsMessage.from_result(device, time.time(), 0, made.estimate()).encode(),
            )
            out.put(topics.SAMPLES, device, b"raw")
            out.put(topics.ALLAN, device, b"curve")

    out.start()
    out.set_alive(device, True)
    talker = threading.Thread(target=talk)
    talker.start()
    try:
        yield out
    finally:
        ending.set()
        talker.join()
        out.close()


@contextlib.contextmanager
def listening(keyexpr: str, *connect: str) -> Iterator[tuple[ZenohSubscriber, list[ReceivedMessageOrLiveliness]]]:
    with contextlib.closing(ZenohSubscriber(keyexpr, connect)) as arriving:
        arriving.start()
        yield arriving, []


def keys(arriving: ZenohSubscriber, so_far: list[ReceivedMessageOrLiveliness]) -> set[str]:
    so_far += arriving.take(0.1)
    return {one.key for one in so_far}


EVERYTHING = {"imu/a/status", "imu/a/coefficients", "imu/a/alive"}


def test_results_and_presence_arrive_but_not_the_bulk(endpoint: str) -> None:
    with daemon(endpoint, "a"), listening("imu/**", endpoint) as (arriving, got):
        wait_for(lambda: keys(arriving, got) >= EVERYTHING)
        wait_for(lambda: len([keys(arriving, got) for _ in range(5)]))
        assert keys(arriving, got) == EVERYTHING
        assert arriving.state == "ok"
        status = next(one for one in got if one.key == "imu/a/status")
        assert json.loads(status.payload or b"")["device"] == "a"
        assert [one for one in got if one.payload is None] == [ReceivedMessageOrLiveliness("imu/a/alive", None, True)]


@pytest.mark.parametrize(
    ("keyexpr", "expected"),
    [
        ("imu/a", EVERYTHING),
        ("**", EVERYTHING),
        ("imu/*", EVERYTHING),
        ("*/*/*", EVERYTHING),
        ("imu/*/status", {"imu/a/status"}),
    ],
)
def test_key_expressions(endpoint: str, keyexpr: str, expected: set[str]) -> None:
    with daemon(endpoint, "a"), listening(keyexpr, endpoint) as (arriving, got):
        wait_for(lambda: keys(arriving, got) >= expected)
        assert keys(arriving, got) == expected


def test_another_device_is_not_heard(endpoint: str) -> None:
    with (
        daemon(endpoint, "a"),
        listening("imu/other/**", endpoint) as (arriving, got),
        listening("imu/**", endpoint) as (beside, heard),
    ):
        wait_for(lambda: arriving.state == "ok" and keys(beside, heard) >= EVERYTHING)
        assert stays_true(lambda: keys(arriving, got) == set())


def test_daemons_that_come_late_go_and_come_back() -> None:
    first, second = free_endpoint(), free_endpoint()
    with listening("imu/**", first, second) as (arriving, got):
        wait_for(lambda: arriving.state == f"nobody at {first}, {second}; trying again")
        with daemon(second, "b"):
            wait_for(lambda: keys(arriving, got) >= {"imu/b/status", "imu/b/alive"})
            assert arriving.state.startswith("1 of 2 there")
            with daemon(first, "a"):
                wait_for(lambda: keys(arriving, got) >= {"imu/a/status", "imu/a/alive"})
                assert arriving.state == "ok"
            wait_for(lambda: keys(arriving, got) and ReceivedMessageOrLiveliness("imu/a/alive", None, False) in got)
            assert ReceivedMessageOrLiveliness("imu/b/alive", None, False) not in got
            got.clear()
            with daemon(first, "a"):
                wait_for(lambda: keys(arriving, got) and ReceivedMessageOrLiveliness("imu/a/alive", None, True) in got)


def test_through_a_router(endpoint: str) -> None:
    with open_router(endpoint), daemon(endpoint, "a", mode="client"), listening("imu/**", endpoint) as (arriving, got):
        wait_for(lambda: keys(arriving, got) >= EVERYTHING)
        assert arriving.state == "ok"


def test_a_daemon_that_is_a_peer_is_heard_through_a_router(endpoint: str) -> None:
    """A router passes nothing on from a peer to a peer."""
    out = ZenohPublisher(ZenohTable(listen=(free_endpoint(),), connect=(endpoint,)), ["a"])
    with open_router(endpoint), contextlib.closing(out), listening("imu/**", endpoint) as (arriving, got):
        out.start()
        out.set_alive("a", True)

        def both() -> bool:
            out.put(topics.STATUS, "a", StatusMessage.from_result("a", time.time(), 0, made.health()).encode())
            return keys(arriving, got) >= {"imu/a/status", "imu/a/alive"}

        wait_for(both)


def test_two_ways_to_the_same_daemon_bring_each_message_once(tmp_path: Path) -> None:
    first, second, patient = free_endpoint(), free_endpoint(), patient_file(tmp_path)
    with (
        open_session(mode="router", listen=[first]),
        open_session(mode="router", listen=[second], connect=[first]),
        contextlib.closing(ZenohPublisher(ZenohTable(config=patient, mode="client", connect=(first,)), ["a"])) as out,
        listening("imu/**", first, second) as (arriving, got),
    ):
        out.start()
        wait_for(lambda: out.state == arriving.state == "ok")
        sent = [f"{i}".encode() for i in range(20)]
        wait_for(lambda: out.put(topics.EVENT, "a", b"ready") or keys(arriving, got))
        wait_for(lambda: not keys(arriving, []))
        got.clear()
        for payload in sent:
            out.put(topics.EVENT, "a", payload)
        wait_for(lambda: keys(arriving, got) and got[-1].payload == sent[-1])

        def each_once() -> bool:
            keys(arriving, got)
            return [one.payload for one in got if one.payload != b"ready"] == sent  # some of these come late

        assert stays_true(each_once, 0.3)


def test_who_comes_late_gets_the_last_values_and_events(endpoint: str) -> None:
    kept = {topic: topic.kept for topic in (topics.STATUS, topics.COEFFICIENTS, topics.EVENT)}
    far = free_endpoint()
    with (
        open_session(mode="router", listen=[endpoint]) as near,
        open_session(mode="router", listen=[far], connect=[endpoint]) as beyond,
        contextlib.closing(ZenohPublisher(ZenohTable(listen=(), connect=(endpoint,)), ["a"])) as out,
    ):
        out.start()
        wait_for(lambda: out.state == "ok")
        with near.declare_queryable("linked", lambda query: query.reply("linked", b"")):
            wait_for(lambda: any(reply.ok for reply in beyond.get("linked")), "the link between the routers")
        for i in range(15):
            for topic in kept:
                out.put(topic, "a", f"{topic.name} {i}".encode())
        with listening("imu/**", far) as (arriving, got):
            expected = {f"{topic.name} {i}".encode() for topic, n in kept.items() for i in range(15 - n, 15)}
            wait_for(lambda: keys(arriving, got) and {one.payload for one in got} >= expected)
            assert {one.payload for one in got} == expected


def test_a_message_that_is_too_long_does_not_arrive_and_those_after_it_do(endpoint: str) -> None:
    with open_session(mode="router", listen=[endpoint]) as sender, listening("imu/**", endpoint) as (arriving, got):

        def send(payload: bytes) -> None:
            sender.put("imu/a/status", payload, congestion_control=zenoh.CongestionControl.BLOCK)

        wait_for(lambda: send(b"ready") or keys(arriving, got))
        send(b"x" * 100_000_000)
        wait_for(lambda: send(b"after") or (keys(arriving, got) and got[-1].payload == b"after"))
        assert max(len(one.payload or b"") for one in got) < 10
        assert arriving.state == "ok"


def test_closing_at_any_moment_leaves_no_thread(endpoint: str) -> None:
    before = threading.active_count()
    for wait_s in (0.0, 0.3, 0.8):
        arriving = ZenohSubscriber("imu/**", [endpoint])
        arriving.start()
        time.sleep(wait_s)
        arriving.close()
        assert threading.active_count() == before
    ZenohSubscriber().close()  # never started


@pytest.mark.parametrize("keyexpr", ["", "imu//a", "/imu", "imu/**x", "a?b"])
def test_no_key_expression(keyexpr: str) -> None:
    with pytest.raises(ConfigError, match="key expression") as raised:
        ZenohSubscriber(keyexpr)
    assert ".rs" not in str(raised.value)


def test_a_topic_that_is_not_shown() -> None:
    with pytest.raises(ConfigError, match="no topic to show; possible topics are status, coefficients, event, alive"):
        ZenohSubscriber("imu/a/samples")


def test_no_endpoint() -> None:
    with pytest.raises(ConfigError, match='connect "localhost:7450": not a valid endpoint'):
        ZenohSubscriber("imu/**", ["tcp/127.0.0.1:1", "localhost:7450"])


# --- watch


def test_watch_once(endpoint: str) -> None:
    console = Console(width=120, file=io.StringIO())
    with daemon(endpoint, "a"):
        watch.watch(connect=[endpoint], console=console, once_s=2.0)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert text.count("imu-monitor  1 device") == 1
    assert re.search(r"^a +● running +99\.98 +360,000 ", text, re.MULTILINE)
    assert "[95 % interval]" in text


def test_watch_prints_plain_tables_where_there_is_no_terminal(endpoint: str) -> None:
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
def test_watch_on_a_terminal_ends_with_ctrl_c_and_exit_0(endpoint: str) -> None:
    code = f"""
        from rich.console import Console
        from monitor.publishing.terminal.watch import watch
        watch(connect=["{endpoint}"], console=Console(force_terminal=True, width=120))
    """
    with daemon(endpoint, "a"):
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
