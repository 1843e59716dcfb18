"""Tests of the zenoh link with a router in this process, on loopback and without scouting."""

import json
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from drivers.data_types import Chunk
from drivers.errors import ConfigError, LinkLost, LinkUnavailable
from drivers.links import zenoh_link
from drivers.links.base import Link
from tests.support.ports import free_endpoint
from tests.support.settings import read_settings
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.zenoh_sessions import open_router, open_session


def build(**keys: Any) -> Link:
    return zenoh_link.build(read_settings(zenoh_link.Settings, keys))


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def router(endpoint: str) -> Iterator[Any]:
    with open_router(endpoint) as opened:
        yield opened


def put_until_received(link: Link, put: Any) -> list[Chunk]:
    """Call ``put`` until the link receives a message."""
    return wait_for(lambda: put() or link.wait_for_chunks_or_timeout(0.05), "a message") or []


def test_payload_and_attachment_are_received(router: Any, endpoint: str) -> None:
    link = build(key="imu/*/samples", connect=[endpoint])
    link.open()
    with_attachment = put_until_received(link, lambda: router.put("imu/a/samples", b"payload", attachment=b"attached"))
    assert (with_attachment[0].data, with_attachment[0].attachment) == (b"payload", b"attached")
    while link.wait_for_chunks_or_timeout(0.1):
        pass
    bare = put_until_received(link, lambda: router.put("imu/b/samples", b"payload"))
    assert bare[0].attachment == b""
    link.close()


def test_all_messages_are_received_in_order(router: Any, endpoint: str) -> None:
    link = build(key="k", connect=[endpoint])
    link.open()
    put_until_received(link, lambda: router.put("k", b"ready"))
    for i in range(1000):
        router.put("k", i.to_bytes(4, "little"), congestion_control=zenoh.CongestionControl.BLOCK)
    got: list[bytes] = []

    def read() -> bool:
        got.extend(c.data for c in link.wait_for_chunks_or_timeout(0.1) or () if c.data != b"ready")
        return len(got) >= 1000

    wait_for(read, lambda: f"1000 messages, {len(got)} received")
    link.close()
    assert got == [i.to_bytes(4, "little") for i in range(1000)]


def test_message_that_arrives_while_the_link_closes_is_not_received(router: Any, endpoint: str) -> None:
    """Closing drops the queue, so the decoder would count the dropped messages before a later message as lost."""
    link = build(key="k", connect=[endpoint])
    assert isinstance(link, zenoh_link.ZenohLink)
    link.open()
    put_until_received(link, lambda: router.put("k", b"ready"))
    session: Any = link._session

    class LateSession:
        def close(self) -> None:
            router.put("k", b"late", congestion_control=zenoh.CongestionControl.BLOCK)
            wait_for(lambda: link._waiting or not receiver.is_alive(), "the end of the receiver or a message")
            session.close()

    receiver = link._receiver
    assert receiver is not None
    link._session = LateSession()  # type: ignore[assignment]
    link.close()
    with pytest.raises(LinkLost):
        link.wait_for_chunks_or_timeout(0.1)


def test_peer_connects_to_a_router_that_starts_later(endpoint: str) -> None:
    link = build(key="k", mode="peer", connect=[endpoint])
    link.open()
    assert link.wait_for_chunks_or_timeout(0.1) is None
    with open_router(endpoint) as opened:
        assert put_until_received(link, lambda: opened.put("k", b"x"))
    link.close()


def test_client_without_router_raises_link_unavailable(endpoint: str) -> None:
    with pytest.raises(LinkUnavailable, match="nobody at") as raised:
        build(key="k", mode="client", connect=[endpoint]).open()
    # the message must not contain source files of zenoh
    assert ".rs" not in str(raised.value)


def test_used_listening_port_raises_link_unavailable(router: Any, endpoint: str) -> None:
    with pytest.raises(LinkUnavailable, match="listen"):
        build(key="k", listen=[endpoint]).open()


def test_message_of_a_peer_behind_the_same_router_is_received(router: Any, endpoint: str) -> None:
    link = build(key="k", connect=[endpoint])
    link.open()
    with open_session(mode="peer", connect=[endpoint]) as publisher:
        assert put_until_received(link, lambda: publisher.put("k", b"x"))[0].data == b"x"
    link.close()


def test_oldest_unread_messages_are_dropped_if_they_are_too_large(router: Any, endpoint: str) -> None:
    link = build(key="k", connect=[endpoint])
    link.open()
    put_until_received(link, lambda: router.put("k", b"ready"))
    for i in range(12):
        router.put("k", bytes([i]) * 20_000_000, congestion_control=zenoh.CongestionControl.BLOCK)
        time.sleep(0.05)
    wait_for(lambda: link._waiting[-1].data[:1] == b"\x0b", "the last message")
    queued_bytes = sum(len(chunk.data) for chunk in link._waiting)
    assert queued_bytes <= zenoh_link.MAX_QUEUED_BYTES
    assert link.wait_for_chunks_or_timeout(0.1)
    link.close()


def build_config(**keys: Any) -> Any:
    return zenoh_link._configuration(read_settings(zenoh_link.Settings, {"key": "k", **keys}))


def test_default_session_neither_scouts_nor_listens() -> None:
    config = build_config()
    assert json.loads(config.get_json("scouting/multicast/enabled")) is False
    assert json.loads(config.get_json("scouting/gossip/enabled")) is False
    assert json.loads(config.get_json("listen/endpoints")) == []
    assert json.loads(config.get_json("mode")) == "peer"


def test_configuration_file_changes_only_what_it_contains(tmp_path: Path) -> None:
    path = tmp_path / "z.json5"
    path.write_text('{mode: "client", connect: {endpoints: ["tcp/127.0.0.1:1"]}, scouting: {gossip: {enabled: true}}}')
    config = build_config(config=str(path))
    assert json.loads(config.get_json("mode")) == "client"
    assert json.loads(config.get_json("connect/endpoints")) == ["tcp/127.0.0.1:1"]
    assert json.loads(config.get_json("scouting/gossip/enabled")) is True
    assert json.loads(config.get_json("scouting/multicast/enabled")) is False
    assert json.loads(config.get_json("listen/endpoints")) == []
    own = build_config(config=str(path), mode="peer", connect=["tcp/127.0.0.1:2"])
    assert json.loads(own.get_json("mode")) == "peer"
    assert json.loads(own.get_json("connect/endpoints")) == ["tcp/127.0.0.1:2"]


@pytest.mark.parametrize(
    "keys",
    [
        {"key": ""},
        {"key": "/imu"},
        {"key": "a//b"},
        {"key": "k", "connect": ["localhost"]},
        {"key": "k", "config": "/nonesuch/z.json5"},
    ],
)
def test_wrong_settings_are_refused(keys: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as raised:
        build(**keys)
    assert "\n" not in str(raised.value)
    assert ".rs" not in str(raised.value)


def test_process_that_does_not_close_the_link_ends(endpoint: str) -> None:
    program = f"""
        from drivers.links import zenoh_link
        link = zenoh_link.build(zenoh_link.Settings(key="k", mode="peer", connect=["{endpoint}"]))
        link.open()
        assert link.wait_for_chunks_or_timeout(0.1) is None
        print("done", flush=True)
    """
    result = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)],
        cwd=Path(zenoh_link.__file__).parents[2],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=True,
    )
    assert result.stdout == "done\n"
