"""Tests of the serial link with pseudo-terminals and URLs of pyserial."""

import contextlib
import errno
import os
import select
import socket
import termios
import threading
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import serial

from drivers.errors import ConfigError, LinkLost, LinkUnavailable
from drivers.links import periodic_request, serial_link
from drivers.links.base import Link
from tests.support.settings import read_settings
from tests.support.waiting import FOREVER_S, PATIENCE_S, wait_for


def build(**keys: Any) -> Link:
    return serial_link.build(read_settings(serial_link.Settings, keys))


@pytest.fixture
def pseudo_terminal() -> Iterator[tuple[int, str]]:
    master, slave = os.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    os.close(slave)
    with contextlib.suppress(OSError):
        os.close(master)


def read_bytes(link: Link, n: int) -> bytes:
    """Read until ``n`` bytes have been received."""
    got = bytearray()

    def read() -> bool:
        got.extend(b"".join(c.data for c in link.wait_for_chunks_or_timeout(0.2) or ()))
        return len(got) >= n

    wait_for(read, lambda: f"{n} bytes, {len(got)} received")
    return bytes(got)


def test_every_byte_is_received_once_and_in_order(pseudo_terminal: tuple[int, str]) -> None:
    master, port = pseudo_terminal
    link = build(port=port, baudrate=921600)
    link.open()
    sent = os.urandom(60_000)

    def write() -> None:
        for at in range(0, len(sent), 500):
            os.write(master, sent[at : at + 500])

    writer = threading.Thread(target=write)
    writer.start()
    got = read_bytes(link, len(sent))
    writer.join()
    link.close()
    assert got == sent


def test_continuous_data_are_read_without_waiting(
    pseudo_terminal: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the first read waits for more bytes. After a full read, the next bytes are already in the buffer."""
    master, port = pseudo_terminal
    link = build(port=port, read_timeout=0.1)
    assert isinstance(link, serial_link.SerialLink)
    link.open()
    waits: list[float] = []
    wait = link._interrupt.wait_and_clear
    monkeypatch.setattr(link._interrupt, "wait_and_clear", lambda timeout_s: waits.append(timeout_s) or wait(timeout_s))
    monkeypatch.setattr(serial_link, "MAX_WAITING_BYTES", serial_link.READ_BYTES // 2)
    sent = os.urandom(20 * serial_link.READ_BYTES)
    parts = [sent[at : at + 500] for at in range(0, len(sent), 500)]
    writer = threading.Thread(target=lambda: [os.write(master, part) for part in parts], daemon=True)
    writer.start()
    got = b""
    for _ in range(5):
        wait_for(lambda: link._port is not None and link._port.in_waiting > serial_link.READ_BYTES // 2 + 1)
        got += b"".join(chunk.data for chunk in link.wait_for_chunks_or_timeout(1.0) or ())
    assert len(waits) == 1
    got += read_bytes(link, len(sent) - len(got))
    assert got == sent
    writer.join()
    link.close()


def test_read_returns_before_its_timeout_when_bytes_arrive(pseudo_terminal: tuple[int, str]) -> None:
    master, port = pseudo_terminal
    link = build(port=port)
    link.open()
    os.write(master, b"x")
    assert link.wait_for_chunks_or_timeout(FOREVER_S)
    link.close()


def test_continuous_data_are_returned_at_the_port_timeout(pseudo_terminal: tuple[int, str]) -> None:
    master, port = pseudo_terminal
    link = build(port=port, read_timeout=0.02)
    link.open()
    stop = threading.Event()

    def write_continuously() -> None:
        while not stop.wait(0.001):
            os.write(master, b"abc")

    writer = threading.Thread(target=write_continuously)
    writer.start()
    for _ in range(10):
        assert link.wait_for_chunks_or_timeout(FOREVER_S)  # returns, although the data never pause
    stop.set()
    writer.join()
    link.close()


def test_loop_and_socket_urls_can_be_opened() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = build(port=f"socket://127.0.0.1:{server.getsockname()[1]}")
        link.open()
        peer, _ = server.accept()
        peer.sendall(b"over the network")
        assert read_bytes(link, 16) == b"over the network"
        peer.close()
        with pytest.raises(LinkLost):
            read_bytes(link, 1)
        link.close()
    link = build(port="loop://")
    link.open()
    assert link.wait_for_chunks_or_timeout(0.05) is None
    link.close()


def test_closed_network_port_raises_link_unavailable() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(LinkUnavailable, match=f"127.0.0.1:{port}"):
        build(port=f"socket://127.0.0.1:{port}").open()


def test_port_in_use_raises_link_unavailable(pseudo_terminal: tuple[int, str]) -> None:
    first, second = build(port=pseudo_terminal[1]), build(port=pseudo_terminal[1])
    first.open()
    with pytest.raises(LinkUnavailable, match="held by another program"):
        second.open()
    first.close()
    second.open()
    second.close()


def test_port_that_is_not_exclusive_can_be_opened_twice(pseudo_terminal: tuple[int, str]) -> None:
    pair = build(port=pseudo_terminal[1], exclusive=False), build(port=pseudo_terminal[1], exclusive=False)
    for link in pair:
        link.open()
    os.write(pseudo_terminal[0], b"abc")
    assert b"c" in b"".join(chunk.data for link in pair for chunk in link.wait_for_chunks_or_timeout(0.3) or ())
    for link in pair:
        link.close()


def test_regular_file_is_no_serial_port(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("x")
    with pytest.raises(LinkUnavailable, match=r"notes\.txt"):
        build(port=str(path)).open()


@pytest.mark.parametrize(
    ("number", "advice"),
    [
        (errno.ENOENT, "no such port"),
        (errno.EACCES, "group dialout"),
        (errno.EBUSY, "held by another"),
        (errno.ENXIO, "no device behind"),
        (errno.ENOTTY, "not a serial port"),
        (errno.EMFILE, "cannot be opened"),
    ],
)
def test_error_text_gives_advice(monkeypatch: pytest.MonkeyPatch, number: int, advice: str) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise serial.SerialException(number, f"could not open port: {os.strerror(number)}")

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    with pytest.raises(LinkUnavailable, match=advice) as raised:
        build(port="/dev/ttyUSB0").open()
    assert isinstance(raised.value.__cause__, serial.SerialException)
    assert "/dev/ttyUSB0" in str(raised.value)


def test_error_lists_the_available_ports(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from serial.tools import list_ports, list_ports_common

    available_ports = [list_ports_common.ListPortInfo("/dev/ttyACM7", skip_link_detection=True)]
    monkeypatch.setattr(list_ports, "comports", lambda: available_ports)
    with pytest.raises(LinkUnavailable, match="/dev/ttyACM7"):
        build(port=str(tmp_path / "ttyNONE")).open()


@pytest.mark.parametrize(
    "keys",
    [
        {"port": ""},
        {"port": "sockets://host:1"},
        {"port": "x", "baudrate": 0},
        {"port": "x", "stopbits": 3.0},
        {"port": "x", "read_timeout": 0.0},
        {"port": "x", "read_timeout": 5.0},
        {"port": "x", "request": "AA 01 0"},
        {"port": "x", "first_request": "0xAA"},
        {"port": "x", "request": "00" * 257},
        {"port": "x", "request": "AA", "request_rate": 0.0},
        {"port": "x", "request": "AA", "request_rate": 1e5},
    ],
)
def test_wrong_settings_are_refused(keys: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as raised:
        build(**keys)
    assert "\n" not in str(raised.value)


def test_unplugging_ends_a_waiting_read(pseudo_terminal: tuple[int, str]) -> None:
    master, port = pseudo_terminal
    link = build(port=port)
    link.open()
    threading.Timer(0.1, os.close, (master,)).start()
    with pytest.raises(LinkLost, match="gone"):
        link.wait_for_chunks_or_timeout(FOREVER_S)
    with pytest.raises(LinkLost):
        link.wait_for_chunks_or_timeout(0.1)


def read_requests(master: int, n: int) -> bytes:
    """Return the first ``n`` bytes that the link has written."""
    got = b""
    while len(got) < n:
        assert select.select([master], [], [], PATIENCE_S)[0], f"{n} bytes, {len(got)} written"
        got += os.read(master, n - len(got))
    return got


def test_link_without_a_request_never_writes(pseudo_terminal: tuple[int, str]) -> None:
    master, port = pseudo_terminal
    link = build(port=port, request_rate=1000.0)
    link.open()
    os.write(master, b"data")
    assert read_bytes(link, 4) == b"data"
    link.close()
    assert select.select([master], [], [], 0.05)[0] == []


def test_request_is_repeated_with_and_without_answers(pseudo_terminal: tuple[int, str]) -> None:
    master, port = pseudo_terminal
    link = build(port=port, request="aa 01", request_rate=500.0)
    for _ in range(2):  # the link can be opened again
        link.open()
        assert read_requests(master, 20) == b"\xaa\x01" * 10
        os.write(master, b"answer")
        assert read_bytes(link, 6) == b"answer"
        assert read_requests(master, 20) == b"\xaa\x01" * 10
        link.close()
        termios.tcflush(master, termios.TCIOFLUSH)
    assert select.select([master], [], [], 0.05)[0] == []


def test_requests_have_the_configured_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    """The time stands still while the thread writes. It advances only by the waiting times."""
    now_s, written_s = [100.0], []
    monkeypatch.setattr(periodic_request.time, "monotonic", lambda: now_s[0])

    class Stopping:
        def wait(self, timeout_s: float) -> bool:
            now_s[0] += timeout_s
            return len(written_s) == 4

    class Port:
        def write(self, data: bytes) -> None:
            written_s.append(now_s[0])
            now_s[0] += 5.0 if len(written_s) == 2 else 0.05

    requests = object.__new__(periodic_request.PeriodicRequest)
    requests._port, requests._request, requests._period_s, requests._stopping = Port(), b"?", 0.25, Stopping()
    requests._write_requests()
    # after a write of 5 s, the missed requests are not made up for
    assert written_s == pytest.approx([100.25, 100.5, 105.5, 105.75])


def test_first_request_is_written_once_per_opening(pseudo_terminal: tuple[int, str]) -> None:
    master, port = pseudo_terminal
    link = build(port=port, first_request="00 FF", request="01", request_rate=500.0)
    for _ in range(2):
        link.open()
        assert read_requests(master, 12) == b"\x00\xff" + b"\x01" * 10
        link.close()
        termios.tcflush(master, termios.TCIOFLUSH)


def test_device_that_reads_no_requests_does_not_block_the_link(pseudo_terminal: tuple[int, str]) -> None:
    """The requests fill the buffer of the pseudo-terminal, so the last write waits until the link is closed."""
    master, port = pseudo_terminal
    link = build(port=port, request="00" * 256, request_rate=10_000.0)
    link.open()
    assert isinstance(link, serial_link.SerialLink)
    wait_for(lambda: link._port is not None and link._port.out_waiting == 0 and not writable(link._port.fileno()))
    thread = link._requests._thread if link._requests else None
    os.write(master, b"data")
    assert read_bytes(link, 4) == b"data"
    link.close()
    assert thread is not None
    assert not thread.is_alive()


def writable(file_number: int) -> bool:
    return bool(select.select([], [file_number], [], 0.0)[1])


def test_unplugging_ends_the_requests(pseudo_terminal: tuple[int, str]) -> None:
    master, port = pseudo_terminal
    link = build(port=port, request="AA", request_rate=1000.0)
    link.open()
    assert isinstance(link, serial_link.SerialLink)
    assert link._requests is not None
    thread = link._requests._thread
    os.close(master)
    with pytest.raises(LinkLost, match="gone"):
        read_bytes(link, 1)
    assert not thread.is_alive()
