"""zenoh: a router in this process, everything on loopback, no scouting."""

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
from drivers.errors import ConfigError, LinkUnavailable
from drivers.links import zenoh_link
from drivers.links.base import Link
from tests.support.ports import free_endpoint
from tests.support.settings import read_settings
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.zenoh_sessions import router as open_router
from tests.support.zenoh_sessions import session


def build(**keys: Any) -> Link:
    return zenoh_link.build(read_settings(zenoh_link.Settings, keys))


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def router(endpoint: str) -> Iterator[Any]:
    with open_router(endpoint) as opened:
        yield opened


def until_it_comes(link: Link, put: Any) -> list[Chunk]:
    return wait_for(lambda: put() or link.wait_for_chunks_or_timeout(0.05), "a message") or []


def test_payload_and_attachment(router: Any, endpoint: str) -> None:
    link = build(key="imu/*/samples", connect=[endpoint])
    link.open()
    with_attachment = until_it_comes(link, lambda: router.put("imu/a/samples", b"payload", attachment=b"attached"))
    assert (with_attachment[0].data, with_attachment[0].attachment) == (b"payload", b"attached")
    while link.wait_for_chunks_or_timeout(0.1):
        pass
    bare = until_it_comes(link, lambda: router.put("imu/b/samples", b"payload"))
    assert bare[0].attachment == b""
    link.close()


def test_messages_come_in_order_and_none_is_lost(router: Any, endpoint: str) -> None:
    link = build(key="k", connect=[endpoint])
    link.open()
    until_it_comes(link, lambda: router.put("k", b"ready"))
    for i in range(1000):
        router.put("k", i.to_bytes(4, "little"), congestion_control=zenoh.CongestionControl.BLOCK)
    got: list[bytes] = []

    def read() -> bool:
        got.extend(c.data for c in link.wait_for_chunks_or_timeout(0.1) or () if c.data != b"ready")
        return len(got) >= 1000

    wait_for(read, lambda: f"1000 messages, {len(got)} came")
    link.close()
    assert got == [i.to_bytes(4, "little") for i in range(1000)]


def test_a_peer_finds_a_router_that_comes_later(endpoint: str) -> None:
    link = build(key="k", mode="peer", connect=[endpoint])
    link.open()
    assert link.wait_for_chunks_or_timeout(0.1) is None
    with open_router(endpoint) as opened:
        assert until_it_comes(link, lambda: opened.put("k", b"x"))
    link.close()


def test_a_client_needs_its_router(endpoint: str) -> None:
    with pytest.raises(LinkUnavailable, match="nobody at") as raised:
        build(key="k", mode="client", connect=[endpoint]).open()
    # where in its own source code zenoh failed is nobody's business here
    assert ".rs" not in str(raised.value)


def test_a_busy_listening_port(router: Any, endpoint: str) -> None:
    with pytest.raises(LinkUnavailable, match="listen"):
        build(key="k", listen=[endpoint]).open()


def test_a_peer_behind_the_same_router_is_heard(router: Any, endpoint: str) -> None:
    link = build(key="k", connect=[endpoint])
    link.open()
    with session(mode="peer", connect=[endpoint]) as publisher:
        assert until_it_comes(link, lambda: publisher.put("k", b"x"))[0].data == b"x"
    link.close()


def test_long_messages_that_nobody_reads_give_way(router: Any, endpoint: str) -> None:
    link = build(key="k", connect=[endpoint])
    link.open()
    until_it_comes(link, lambda: router.put("k", b"ready"))
    for i in range(12):
        router.put("k", bytes([i]) * 20_000_000, congestion_control=zenoh.CongestionControl.BLOCK)
        time.sleep(0.05)
    wait_for(lambda: link._waiting[-1].data[:1] == b"\x0b", "the last message")
    held = sum(len(chunk.data) for chunk in link._waiting)
    assert held <= zenoh_link.MAX_QUEUED_BYTES
    assert link.wait_for_chunks_or_timeout(0.1)
    link.close()


def configured(**keys: Any) -> Any:
    return zenoh_link._configuration(read_settings(zenoh_link.Settings, {"key": "k", **keys}))


def test_a_session_starts_closed() -> None:
    config = configured()
    assert json.loads(config.get_json("scouting/multicast/enabled")) is False
    assert json.loads(config.get_json("scouting/gossip/enabled")) is False
    assert json.loads(config.get_json("listen/endpoints")) == []
    assert json.loads(config.get_json("mode")) == "peer"


def test_a_file_opens_only_what_it_names(tmp_path: Path) -> None:
    path = tmp_path / "z.json5"
    path.write_text('{mode: "client", connect: {endpoints: ["tcp/127.0.0.1:1"]}, scouting: {gossip: {enabled: true}}}')
    config = configured(config=str(path))
    assert json.loads(config.get_json("mode")) == "client"
    assert json.loads(config.get_json("connect/endpoints")) == ["tcp/127.0.0.1:1"]
    assert json.loads(config.get_json("scouting/gossip/enabled")) is True
    assert json.loads(config.get_json("scouting/multicast/enabled")) is False
    assert json.loads(config.get_json("listen/endpoints")) == []
    own = configured(config=str(path), mode="peer", connect=["tcp/127.0.0.1:2"])
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
def test_wrong_settings_refuse_to_start(keys: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as raised:
        build(**keys)
    assert "\n" not in str(raised.value)
    assert ".rs" not in str(raised.value)


def test_a_process_that_forgets_to_close_still_ends(endpoint: str) -> None:
    program = f"""
        from drivers.links import zenoh_link
        link = zenoh_link.build(zenoh_link.Settings(key="k", mode="peer", connect=["{endpoint}"]))
        link.open()
        assert link.wait_for_chunks_or_timeout(0.1) is None
        print("done", flush=True)
    """
    ran = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)],
        cwd=Path(zenoh_link.__file__).parents[2],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=True,
    )
    assert ran.stdout == "done\n"
