"""Tests of the UDP link on loopback: datagrams, arrival times, dropped datagrams and ports that cannot be opened."""

import os
import socket
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from drivers.data_types import Chunk
from drivers.errors import LinkLost, LinkUnavailable
from drivers.links import udp_link
from drivers.links.udp_link import UdpLink
from tests.support.settings import read_settings

needs_linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux counts and stamps datagrams")


def build(**keys: Any) -> UdpLink:
    link = udp_link.build(read_settings(udp_link.Settings, {"port": 0, **keys}))
    assert isinstance(link, UdpLink)
    return link


@pytest.fixture
def link() -> Iterator[UdpLink]:
    opened = build()
    opened.open()
    yield opened
    opened.close()


@pytest.fixture
def send(link: UdpLink) -> Iterator[Callable[[bytes], int]]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect(link._socket.getsockname())
        yield sender.send


def read_all_chunks(link: UdpLink) -> list[Chunk]:
    chunks: list[Chunk] = []
    while more := link.wait_for_chunks_or_timeout(0.2):
        chunks += more
    return chunks


def test_each_datagram_is_a_chunk(link: UdpLink, send: Callable[[bytes], int]) -> None:
    sent = [b"a", b"", b"bc" * 100, bytes(65_507), b"\xff"]
    for data in sent:
        send(data)
    assert [chunk.data for chunk in read_all_chunks(link)] == [data for data in sent if data]
    assert link.dropped_datagrams == 0


def test_number_of_datagrams_per_read_is_limited(link: UdpLink, send: Callable, monkeypatch) -> None:
    monkeypatch.setattr(udp_link, "MAX_DATAGRAMS", 8)
    for i in range(20):
        send(bytes([i]))
    sizes = []
    while more := link.wait_for_chunks_or_timeout(0.2):
        sizes.append(len(more))
    assert sizes == [8, 8, 4]


@needs_linux
def test_late_read_keeps_the_arrival_time(link: UdpLink, send: Callable) -> None:
    send(b"x")  # after the port is opened, it takes a moment until the kernel stamps datagrams
    time.sleep(0.2)
    read_all_chunks(link)
    around = []
    for _ in range(3):
        before = time.monotonic_ns()
        send(b"x")
        around.append((before, time.monotonic_ns()))
        time.sleep(0.1)
    for chunk, (before, after) in zip(read_all_chunks(link), around, strict=True):
        assert before - 20e6 <= chunk.t_ns <= after + 20e6


@needs_linux
def test_dropped_datagrams_are_counted(link: UdpLink, send: Callable) -> None:
    total = 0
    for _ in range(2):  # the kernel counts from the time at which the port was opened
        for _ in range(3000):
            send(bytes(1000))
        total += 3000
        received = len(read_all_chunks(link))
        assert 0 < received < 3000
        send(b"x")  # the count arrives with the next datagram
        total += 1
        read_all_chunks(link)
    link.close()
    link.open()
    dropped = link.dropped_datagrams
    assert 0 < dropped < total


@needs_linux
def test_every_datagram_is_received_or_counted_as_dropped(link: UdpLink, send: Callable) -> None:
    received = 0
    for _ in range(3):
        for _ in range(2000):
            send(bytes(1000))
        received += len(read_all_chunks(link))
    send(b"x")
    received += len(read_all_chunks(link))
    assert link.dropped_datagrams > 0
    assert received + link.dropped_datagrams == 6001


def test_used_port_is_named(link: UdpLink) -> None:
    port = link._socket.getsockname()[1]
    with pytest.raises(LinkUnavailable, match=f"UDP port {port} of 127.0.0.1: used by another program; .*ss -ulpn"):
        build(port=port).open()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"host": "192.0.2.1"}, "host is no address of this computer"),
        ({"host": "256.1.1.1"}, "host must be an address of this computer"),
        ({"host": "a" * 70}, "host must be an address of this computer"),
    ],
)
def test_wrong_address_is_named(keys: dict, message: str) -> None:
    with pytest.raises(LinkUnavailable, match=message) as raised:
        build(**keys).open()
    assert "\n" not in str(raised.value)


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to root")
def test_privileged_port_is_named() -> None:
    with pytest.raises(LinkUnavailable, match="above 1023"):
        build(port=9).open()


def test_ipv6_address_can_be_opened() -> None:
    if not socket.has_ipv6:
        pytest.skip("no IPv6 here")
    link = build(host="::1")
    try:
        link.open()
    except LinkUnavailable as error:
        pytest.skip(str(error))
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as sender:
        sender.sendto(b"six", link._socket.getsockname())
    assert [chunk.data for chunk in read_all_chunks(link)] == [b"six"]
    link.close()


def test_failing_socket_raises_link_lost(link: UdpLink) -> None:
    class FailingSocket:
        def settimeout(self, wait_s: float) -> None: ...

        def recvmsg_into(self, *_: object) -> None:
            raise OSError(100, "Network is down")

        def close(self) -> None: ...

    link._socket.close()
    link._socket = FailingSocket()
    with pytest.raises(LinkLost, match="the network interface is gone: Network is down"):
        link.wait_for_chunks_or_timeout(0.1)
