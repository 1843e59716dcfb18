"""Tests of the CAN link on a virtual bus, on slcan over a pseudo-terminal, and on a bus that raises errors."""

import errno
import itertools
import os
import re
import socket
import sys
import time
import tomllib
import tty
from collections.abc import Iterator
from importlib.metadata import requires
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pytest

from drivers.data_types import ANY_SOURCE, EXTENDED_ID, Chunk, concatenate_blocks
from drivers.decoders import dbc
from drivers.errors import ConfigError, LinkLost, LinkUnavailable
from drivers.host.extras import install_command
from drivers.links import can_link, unix_to_monotonic_arrival
from drivers.links.can_link import CanLink
from tests.support.settings import read_settings

UNIQUE = itertools.count()


def build(**keys: Any) -> CanLink:
    link = can_link.build(read_settings(can_link.Settings, keys))
    assert isinstance(link, CanLink)
    return link


@pytest.fixture
def channel() -> str:
    return f"can-link-{next(UNIQUE)}"


@pytest.fixture
def peer(channel: str) -> Iterator[can.BusABC]:
    with can.Bus(interface="virtual", channel=channel) as bus:
        yield bus


def make_message(identifier: int, extended: bool = False, **keys: Any) -> can.Message:
    return can.Message(arbitration_id=identifier, is_extended_id=extended, data=b"\1\2\3", **keys)


def read_all_chunks(link: CanLink) -> list[Chunk]:
    """Read until no chunk arrives for 0.2 s, because a read on a busy computer may return only a part."""
    chunks: list[Chunk] = []
    while more := link.wait_for_chunks_or_timeout(0.2):
        chunks += more
    return chunks


def test_link_receives_identifiers_and_data(peer: can.BusABC, channel: str) -> None:
    link = build(interface="virtual", channel=channel)
    link.open()
    for i in range(50):
        peer.send(make_message(i, extended=i % 2 == 1))
    chunks = read_all_chunks(link)
    link.close()
    assert [c.address for c in chunks] == [i | (EXTENDED_ID if i % 2 else 0) for i in range(50)]
    assert {c.data for c in chunks} == {b"\1\2\3"}


def test_number_of_frames_per_read_is_limited(peer: can.BusABC, channel: str) -> None:
    link = build(interface="virtual", channel=channel)
    link.open()
    for _ in range(can_link.MAX_FRAMES + 5):
        peer.send(make_message(1))
    sizes = []
    while sum(sizes) < can_link.MAX_FRAMES + 5:
        sizes.append(len(link.wait_for_chunks_or_timeout(0.1) or ()))
    link.close()
    assert max(sizes) <= can_link.MAX_FRAMES
    assert sum(sizes) == can_link.MAX_FRAMES + 5


def test_late_read_keeps_the_arrival_time(channel: str) -> None:
    with can.Bus(interface="virtual", channel=channel, preserve_timestamps=True) as peer:
        link = build(interface="virtual", channel=channel)
        link.open()
        link.empty_ns -= 400 * 10**9  # the reader has been stopped since then
        sent = []
        for age_s in (300.0, 200.0, 100.0):
            before = time.monotonic_ns() - age_s * 1e9
            peer.send(make_message(1, timestamp=time.time() - age_s))
            sent.append((before, time.monotonic_ns() - age_s * 1e9))
        chunks = read_all_chunks(link)
        link.close()
    assert len(chunks) == 3
    for chunk, (before, after) in zip(chunks, sent, strict=True):
        assert before - 20e6 <= chunk.t_ns <= after + 20e6


def test_interruption_between_reading_two_clocks_does_not_change_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    unix_ns, now_ns, interruptions_ns = 1_700_000_000 * 10**9, [10**12], iter([50_000_000, 0, 0])

    def time_ns() -> int:
        now_ns[0] += next(interruptions_ns)
        return unix_ns + now_ns[0]

    link = build(interface="virtual", channel="none")
    link.empty_ns = 10**12
    monkeypatch.setattr(
        unix_to_monotonic_arrival,
        "time",
        SimpleNamespace(monotonic_ns=lambda: now_ns[0], time_ns=time_ns, time=lambda: time_ns() / 1e9),
    )
    chunk = link._to_chunk(make_message(1, timestamp=(unix_ns + 10**12 - 10_000_000) / 1e9))
    assert chunk.t_ns == pytest.approx(10**12 - 10_000_000, abs=1000)


def test_implausible_time_stamps_are_ignored(channel: str) -> None:
    with can.Bus(interface="virtual", channel=channel, preserve_timestamps=True) as peer:
        link = build(interface="virtual", channel=channel)
        link.open()
        begun = time.monotonic_ns()
        peer.send(make_message(1, timestamp=12.5))
        peer.send(make_message(1, timestamp=time.time() + 3600.0))
        chunks = read_all_chunks(link)
        link.close()
    now = time.monotonic_ns()
    assert len(chunks) == 2
    assert all(begun <= c.t_ns <= now for c in chunks)


def test_address_filter_selects_frames(peer: can.BusABC, channel: str) -> None:
    link = build(interface="virtual", channel=channel)
    link.set_address_filter([0x09, 0x0CF02AFE | EXTENDED_ID | ANY_SOURCE, 0x18EF00FE | EXTENDED_ID | ANY_SOURCE])
    link.open()
    kept = [(0x09, False), (0x0CF02A80, True), (0x18F02AE2, True), (0x18EF55AA, True)]
    others = [(0x0A, False), (0x09, True), (0x0CF02BFE, True), (0x0DF02AFE, True), (0x02A, False)]
    for identifier, extended in kept + others:
        peer.send(make_message(identifier, extended))
    chunks = read_all_chunks(link)
    link.close()
    assert [c.address for c in chunks] == [i | (EXTENDED_ID if e else 0) for i, e in kept]


def test_empty_address_filter_accepts_all_frames(peer: can.BusABC, channel: str) -> None:
    link = build(interface="virtual", channel=channel)
    link.set_address_filter([])
    link.open()
    peer.send(make_message(0x55))
    assert link.wait_for_chunks_or_timeout(1.0)
    link.close()


def test_error_and_remote_frames_are_ignored(peer: can.BusABC, channel: str) -> None:
    link = build(interface="virtual", channel=channel)
    link.open()
    peer.send(can.Message(is_error_frame=True, arbitration_id=0x04))
    peer.send(can.Message(is_remote_frame=True, arbitration_id=5, is_extended_id=False))
    peer.send(make_message(7))
    got: list[Chunk] = []
    for _ in range(10):
        got += link.wait_for_chunks_or_timeout(0.05) or []
    link.close()
    assert [c.address for c in got] == [7]
    assert link.error_frames == 1


class ScriptedBus:
    """A bus that returns or raises the given answers in turn."""

    def __init__(self, *answers: can.Message | Exception) -> None:
        self.answers = list(answers)
        self.closed = False

    def recv(self, timeout: float) -> can.Message | None:
        answer = self.answers.pop(0) if self.answers else None
        if isinstance(answer, Exception):
            raise answer
        return answer

    def shutdown(self) -> None:
        self.closed = True
        raise can.CanOperationError("already unplugged")


@pytest.mark.parametrize(
    ("answer", "problem"),
    [
        (can.Message(is_error_frame=True, arbitration_id=0x40), "bus off"),
        (can.CanOperationError("Network is down", 100), "interface down"),
        (OSError(errno.ENODEV, "No such device"), "unplugged"),
    ],
)
def test_lost_bus_raises_link_lost(monkeypatch: pytest.MonkeyPatch, answer: Any, problem: str) -> None:
    bus = ScriptedBus(answer)
    monkeypatch.setattr(can, "Bus", lambda **_: bus)
    link = build(channel="can0")
    link.open()
    with pytest.raises(LinkLost, match=problem):
        link.wait_for_chunks_or_timeout(1.0)
    assert bus.closed
    with pytest.raises(LinkLost, match="closed"):
        link.wait_for_chunks_or_timeout(0.0)


@pytest.mark.parametrize(
    ("keys", "error", "problem"),
    [
        ({}, OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol"), "modprobe can_raw"),
        ({}, OSError(errno.ENODEV, "No such device"), "no such network interface"),
        ({}, OSError(errno.ENETDOWN, "Network is down"), "ip link set can0 up"),
        ({}, OSError(errno.EPERM, "Operation not permitted"), "permission"),
        ({"interface": "kvaser"}, NameError("name 'canGetNumberOfChannels' is not defined"), "not installed"),
        ({"interface": "slcan"}, TypeError("unexpected keyword"), "refuses these settings"),
        ({"interface": "pcan"}, can.CanInitializationError("PCAN\nbusy"), "PCAN busy"),
    ],
)
def test_error_text_gives_advice(
    monkeypatch: pytest.MonkeyPatch, keys: dict[str, Any], error: Exception, problem: str
) -> None:
    def refuse(**_: object) -> None:
        raise error

    monkeypatch.setattr(can, "Bus", refuse)
    with pytest.raises(LinkUnavailable, match=problem) as raised:
        build(channel="can0", **keys).open()
    assert raised.value.__cause__ is error
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("interface", can_link.PACKAGES)
def test_error_names_the_missing_package_and_the_command_that_installs_it(
    monkeypatch: pytest.MonkeyPatch, interface: str
) -> None:
    module, package, requirement = can_link.PACKAGES[interface]
    monkeypatch.setitem(sys.modules, module, None)  # as if it were not installed
    with pytest.raises(LinkUnavailable) as raised:
        build(interface=interface, channel="239.74.163.2").open()
    expected = f"CAN interface {interface} needs the package {package}: {install_command(requirement)}"
    assert str(raised.value) == expected


def test_extra_that_a_message_names_contains_the_package() -> None:
    text = (Path(__file__).parents[3] / "pyproject.toml").read_text("utf-8")
    extras = tomllib.loads(text)["project"]["optional-dependencies"]
    ours = {
        requirement.removeprefix("imu-monitor[").removesuffix("]"): package
        for _, package, requirement in can_link.PACKAGES.values()
        if requirement.startswith("imu-monitor[")
    }
    for extra, package in ours.items():
        assert any(re.match(rf"{package}\b", requirement) for requirement in extras[extra])
        assert extra in extras["all"][0]


def test_extras_of_python_can_contain_the_named_packages() -> None:
    requirements = requires("python-can") or []
    for _, package, requirement in can_link.PACKAGES.values():
        if requirement.startswith("python-can["):
            extra = requirement.removeprefix("python-can[").removesuffix("]")
            assert any(re.match(rf'{package}\b.*extra == "{extra}"', required) for required in requirements), package


def test_settings_are_passed_to_python_can(monkeypatch: pytest.MonkeyPatch) -> None:
    passed_keys: dict[str, Any] = {}

    def open_bus(**keys: Any) -> ScriptedBus:
        passed_keys.update(keys)
        return ScriptedBus()

    monkeypatch.setattr(can, "Bus", open_bus)
    build(interface="pcan", channel="PCAN_USBBUS1", bitrate=500_000, fd=True, options={"state": 1}).open()
    expected = {"interface": "pcan", "channel": "PCAN_USBBUS1", "bitrate": 500_000, "fd": True, "state": 1}
    assert expected.items() <= passed_keys.items()


def test_absent_socketcand_raises_link_unavailable() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    link = build(interface="socketcand", channel="can0", options={"host": "127.0.0.1", "port": port})
    with pytest.raises(LinkUnavailable):
        link.open()


def test_link_continues_after_garbled_lines() -> None:
    master, slave = os.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    link = build(interface="slcan", channel=os.ttyname(slave), options={"sleep_after_open": 0.0})
    link.open()
    os.write(master, b"\xff\xfe\r")
    for _ in range(5):
        link.wait_for_chunks_or_timeout(0.05)
    os.write(master, b"t00z2aabb\r")
    for _ in range(5):
        link.wait_for_chunks_or_timeout(0.05)
    os.write(master, b"t0092aabb\r")
    chunks: list[Chunk] = []
    for _ in range(20):
        chunks += link.wait_for_chunks_or_timeout(0.05) or []
    link.close()
    os.close(master)
    os.close(slave)
    assert [(c.address, c.data) for c in chunks] == [(9, b"\xaa\xbb")]
    assert link.garbled == 2


def test_frames_from_the_bus_are_decoded_to_samples(peer: can.BusABC, channel: str) -> None:
    axes = {"gx": "RollRate", "gy": "PitchRate", "gz": "YawRate"}
    signals = {axis: f"AngularRateInformation.{name}" for axis, name in axes.items()}
    decoder = dbc.build(read_settings(dbc.Settings, {"file": "j1939_imu", "signals": signals}))
    assert isinstance(decoder, dbc.DbcDecoder)
    link = build(interface="virtual", channel=channel)
    link.set_address_filter(decoder.accepted_addresses)
    link.open()
    for i in range(20):
        peer.send(make_message(0x18FEF100, True))  # other traffic of a truck
        data = (32000 + 128 * i).to_bytes(2, "little") * 3 + b"\0\5"
        peer.send(can.Message(arbitration_id=0x0CF02A80, is_extended_id=True, data=data))
    chunks = read_all_chunks(link)
    link.close()
    assert len(chunks) == 20
    got = concatenate_blocks(decoder.feed(chunks))
    assert np.rad2deg(got.values[:, :3]) == pytest.approx(np.repeat(np.arange(20.0)[:, None], 3, axis=1))
    assert (np.diff(got.t_ns) >= 0).all()


def test_unknown_interface_is_refused():
    with pytest.raises(ConfigError, match='interface: "socketscan"; possible are socketcan, '):
        can_link.build(can_link.Settings(interface="socketscan"))
