"""Tests that every link in the folder ``drivers/links`` has to pass.

A test fails if a link has no rig in ``RIGS``.
"""

import contextlib
import itertools
import os
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from drivers import links
from drivers.data_types import Chunk
from drivers.errors import ConfigError, LinkLost, LinkUnavailable
from drivers.links import iio_link
from drivers.links.base import Link, LinkSettings
from drivers.validation import module_lookup
from tests.support.fake_iio_device import FakeIioDevice
from tests.support.loopback_link import LoopbackLink
from tests.support.ports import free_endpoint
from tests.support.settings import read_settings
from tests.support.waiting import FOREVER_S, PATIENCE_S
from tests.support.zenoh_sessions import open_router

UNIQUE = itertools.count()
DATA = b"12345678"


@dataclass
class LinkRig:
    """A link, and functions that act at its other end."""

    link: Link
    send: Callable[[], None]  # sends DATA to the link
    lose: Callable[[], None] | None  # disconnects the peer; None if that is impossible, see ``why_not_lost``
    absent: Link  # a link whose target does not exist
    why_not_lost: str = ""
    quiet_s: float = 0.3  # no data arrive within this time unless the test sends them


def build(name: str, **keys: Any) -> Link:
    module = module_lookup.import_module(links, name, "_link")
    link: Link = module.build(read_settings(module.Settings, keys))
    return link


class PseudoTerminal:
    """A pseudo-terminal, whose other end the test reads and writes."""

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(self.master)
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        os.close(slave)

    def write(self, data: bytes) -> None:
        os.write(self.master, data)

    def close(self) -> None:
        if self.master >= 0:
            os.close(self.master)
        self.master = -1


@contextlib.contextmanager
def serial_rig(tmp_path: Path) -> Iterator[LinkRig]:
    pty = PseudoTerminal()
    link = build("serial", port=pty.port)
    absent = build("serial", port=str(tmp_path / "ttyNONE"))
    yield LinkRig(link, lambda: pty.write(DATA), pty.close, absent)
    link.close()
    pty.close()


@contextlib.contextmanager
def can_virtual_rig(tmp_path: Path) -> Iterator[LinkRig]:
    import can

    channel = f"contract-{next(UNIQUE)}"
    with can.Bus(interface="virtual", channel=channel) as peer:
        message = can.Message(arbitration_id=9, is_extended_id=False, data=DATA)
        link = build("can", interface="virtual", channel=channel)
        absent = build("can", interface="socketcan", channel="nonesuch0")
        why_not_lost = "a virtual bus exists whether or not anybody sends"
        yield LinkRig(link, lambda: peer.send(message), None, absent, why_not_lost)
        link.close()


@contextlib.contextmanager
def can_slcan_rig(tmp_path: Path) -> Iterator[LinkRig]:
    pty = PseudoTerminal()
    options = {"sleep_after_open": 0.0}
    link = build("can", interface="slcan", channel=pty.port, options=options)
    absent = build("can", interface="slcan", channel=str(tmp_path / "ttyNONE"), options=options)
    line = b"t0098" + DATA.hex().encode() + b"\r"
    yield LinkRig(link, lambda: pty.write(line), pty.close, absent)
    link.close()
    pty.close()


@contextlib.contextmanager
def start_router() -> Iterator[tuple[str, Callable[[str, bytes], None]]]:
    """Open a zenoh router in this process. Yield its endpoint and its function ``put``."""
    endpoint = free_endpoint()
    with open_router(endpoint) as session:
        yield endpoint, session.put


@contextlib.contextmanager
def zenoh_rig(tmp_path: Path) -> Iterator[LinkRig]:
    with start_router() as (endpoint, put):
        link = build("zenoh", key="contract/**", connect=[endpoint])
        absent = build("zenoh", key="a/b", mode="client", connect=[free_endpoint()])
        why_not_lost = "zenoh reconnects by itself, so a lost publisher only causes silence, see LinkSettings.silence"
        yield LinkRig(link, lambda: put("contract/a", DATA), None, absent, why_not_lost)
        link.close()


@contextlib.contextmanager
def udp_rig(tmp_path: Path) -> Iterator[LinkRig]:
    link = build("udp", port=0)
    absent = build("udp", host="192.0.2.1", port=9)  # an address that is reserved for documentation
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def send() -> None:
            sender.sendto(DATA, link._socket.getsockname())  # type: ignore[attr-defined]

        why_not_lost = "UDP has no connections, so a lost sender only causes silence, see LinkSettings.silence"
        yield LinkRig(link, send, None, absent, why_not_lost)
        link.close()


@contextlib.contextmanager
def replay_rig(tmp_path: Path) -> Iterator[LinkRig]:
    path = tmp_path / "frames.csv"
    path.write_text(f"t,id_hex,data_hex\n0.0,9,{DATA.hex()}\n1000.0,9,{DATA.hex()}\n")
    link = build("replay", path=str(path))
    absent = build("replay", path=str(tmp_path / "none.npz"))
    yield LinkRig(link, lambda: None, None, absent, "an open file cannot be lost, and its end raises LinkEnded")
    link.close()


@contextlib.contextmanager
def iio_rig(tmp_path: Path) -> Iterator[LinkRig]:
    device = FakeIioDevice(tmp_path, "bmi160", {"in_timestamp": "le:s64/64>>0"}, enabled=True)
    link = iio_link.IioLink(iio_link.Settings(device="bmi160"), tmp_path)
    absent = iio_link.IioLink(iio_link.Settings(device="lsm6dsr_gyro"), tmp_path)
    yield LinkRig(link, lambda: device.write(DATA), device.unplug, absent)
    link.close()
    device.unplug()


@contextlib.contextmanager
def loopback_rig(tmp_path: Path) -> Iterator[LinkRig]:
    link, absent = LoopbackLink(), LoopbackLink()
    absent.absent = True
    yield LinkRig(link, lambda: link.write(DATA), link.drop, absent)


RIGS: dict[str, Callable[[Path], AbstractContextManager[LinkRig]]] = {
    "serial": serial_rig,
    "can": can_virtual_rig,
    "can-slcan": can_slcan_rig,
    "iio": iio_rig,
    "zenoh": zenoh_rig,
    "replay": replay_rig,
    "udp": udp_rig,
    "loopback": loopback_rig,
}


@pytest.fixture(params=RIGS)
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[LinkRig]:
    with RIGS[request.param](tmp_path) as opened:
        yield opened


@pytest.fixture(params=module_lookup.list_modules(links, "_link"))
def module(request: pytest.FixtureRequest) -> ModuleType:
    return module_lookup.import_module(links, request.param, "_link")


def receive_chunks(rig: LinkRig) -> list[Chunk]:
    """Send until chunks arrive, because a zenoh session needs some time to find its router."""
    for _ in range(100):
        rig.send()
        chunks = rig.link.wait_for_chunks_or_timeout(0.05)
        if chunks:
            return chunks
    raise AssertionError("no chunks arrived")


def read_repeatedly(link: Link) -> None:
    for _ in range(100):
        link.wait_for_chunks_or_timeout(0.05)


def test_every_link_has_a_rig() -> None:
    assert {name.split("-")[0] for name in RIGS} - {"loopback"} == set(module_lookup.list_modules(links, "_link"))


def test_module_has_settings_build_and_default_decoder(module: ModuleType) -> None:
    assert issubclass(module.Settings, LinkSettings)
    assert callable(module.build)
    assert isinstance(module.DEFAULT_DECODER, str)


def test_unknown_keys_are_refused(module: ModuleType) -> None:
    with pytest.raises(ConfigError, match="nonesuch: unknown key"):
        read_settings(module.Settings, {"nonesuch": 1, "port": "x", "key": "x", "path": "x"})


def test_sent_data_are_received(rig: LinkRig) -> None:
    begun_ns = time.monotonic_ns()
    rig.link.open()
    chunks = receive_chunks(rig)
    assert DATA in b"".join(c.data for c in chunks)
    if rig.link.epoch == "monotonic":
        # a link that converts Unix time reads two clocks, and the scheduler may interrupt it in between
        assert all(begun_ns - 20e6 <= c.t_ns <= time.monotonic_ns() for c in chunks)


def test_link_can_be_opened_and_closed_twice(rig: LinkRig) -> None:
    for _ in range(2):
        rig.link.open()
        rig.link.open()
        assert receive_chunks(rig)
        rig.link.close()
        rig.link.close()


def test_link_can_be_closed_before_it_is_opened(rig: LinkRig) -> None:
    rig.link.close()
    rig.link.open()
    assert receive_chunks(rig)


def test_read_returns_none_on_timeout(rig: LinkRig) -> None:
    rig.link.open()
    receive_chunks(rig)
    while rig.link.wait_for_chunks_or_timeout(0.05):
        pass
    start = time.monotonic()
    assert rig.link.wait_for_chunks_or_timeout(rig.quiet_s) is None
    assert time.monotonic() - start >= rig.quiet_s * 0.9  # a lower bound holds on any machine


def test_lost_peer_raises_link_lost(rig: LinkRig) -> None:
    if rig.lose is None:
        pytest.skip(rig.why_not_lost)
    rig.link.open()
    receive_chunks(rig)
    rig.lose()
    with pytest.raises(LinkLost) as raised:
        read_repeatedly(rig.link)
    assert "\n" not in str(raised.value)
    rig.link.close()


def test_read_after_close_raises_link_lost(rig: LinkRig) -> None:
    rig.link.open()
    rig.link.close()
    with pytest.raises(LinkLost):
        rig.link.wait_for_chunks_or_timeout(0.1)


def test_closing_ends_a_waiting_read(rig: LinkRig) -> None:
    rig.link.open()
    receive_chunks(rig)
    while rig.link.wait_for_chunks_or_timeout(0.05):
        pass
    began, ended = threading.Event(), threading.Event()

    def wait() -> None:
        began.set()
        with contextlib.suppress(LinkLost):
            rig.link.wait_for_chunks_or_timeout(FOREVER_S)
        ended.set()

    reader = threading.Thread(target=wait)
    reader.start()
    assert began.wait(PATIENCE_S)
    assert not ended.wait(0.1)
    rig.link.close()
    assert ended.wait(PATIENCE_S)
    reader.join(PATIENCE_S)


def test_absent_target_raises_link_unavailable(rig: LinkRig) -> None:
    for _ in range(2):
        with pytest.raises(LinkUnavailable) as raised:
            rig.absent.open()
        assert str(raised.value)
        assert "\n" not in str(raised.value)
    rig.absent.close()
