"""systemd is told what is so: ready, how it goes, alive only while every reader moves, reloading, stopping."""

import os
import shutil
import socket
import subprocess
import threading
import time
from pathlib import Path

import pytest

from drivers.data_types import Chunk
from drivers.errors import LinkLost
from drivers.links.base import Carrier
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.daemon.operations.systemd import SystemdNotifier
from monitor.daemon.service import Service
from monitor.settings import loading
from tests.support.ports import free_endpoint
from tests.support.waiting import PATIENCE_S, wait_for

UNIT = CONFIG_FOLDER / "systemd" / "imu-monitor.service"
DEVICE = '[[device]]\nname = "{name}"\nrate = 100.0\ndriver = {{ link = "virtual" }}\n'


class Listening:
    """systemd's end of the socket."""

    def __init__(self, address: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(f"\0{address[1:]}" if address.startswith("@") else address)
        self.socket.setblocking(False)
        self.heard: list[str] = []

    def __enter__(self) -> "Listening":
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def lines(self) -> list[str]:
        """All lines that came, oldest first."""
        while True:
            try:
                self.heard += self.socket.recv(4096).decode().splitlines()
            except BlockingIOError:
                return self.heard

    def count(self, line: str) -> int:
        return self.lines().count(line)


@pytest.fixture(params=["path", "abstract"])
def address(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(tmp_path / "notify") if request.param == "path" else f"@imu-monitor-test-{os.getpid()}-{time.time_ns()}"


def test_what_is_said_arrives_by_a_path_and_by_an_abstract_name(address: str) -> None:
    with Listening(address) as systemd:
        unit = SystemdNotifier(address, 9.0)
        begun_s = time.monotonic() - 1e-6  # the stamp is cut to microseconds
        unit.send_status("1 device;\nall well")
        unit.send_status("1 device; all well")
        unit.send_ready()
        unit.send_reloading()
        unit.send_stopping()
        said = systemd.lines()
    assert [line for line in said if not line.startswith("MONOTONIC_USEC=")] == [
        "STATUS=1 device; all well",
        "READY=1",
        "RELOADING=1",
        "STOPPING=1",
    ]
    (stamp,) = [int(line.partition("=")[2]) for line in said if line.startswith("MONOTONIC_USEC=")]
    assert begun_s <= stamp / 1e6 <= time.monotonic()


def test_signs_of_life_come_three_in_the_time_allowed_and_end_with_a_stuck_reader(tmp_path: Path) -> None:
    with Listening(str(tmp_path / "notify")) as systemd:
        unit = SystemdNotifier(str(tmp_path / "notify"), 60.0)
        for second in range(100):
            assert unit.send_watchdog({"a": second, "b": second // 10}, float(second)) == []
        assert systemd.count("WATCHDOG=1") == 5
        stuck_at = [second for second in range(100, 200) if unit.send_watchdog({"a": second, "b": 9}, float(second))]
        assert systemd.count("WATCHDOG=1") == 7  # the last at 120 s: b has stood still since 90 s
        assert stuck_at == list(range(121, 200))
        assert unit.send_watchdog({"a": 200}, 200.0) == []  # b was taken out
        assert systemd.count("WATCHDOG=1") == 8


def test_nobody_to_tell_is_no_trouble(tmp_path: Path) -> None:
    for address in ("", str(tmp_path / "none"), "vsock:2:9999"):
        unit = SystemdNotifier.from_environment({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "1000000"})
        unit.send_ready()
        assert unit.send_watchdog({"a": 1}, 1.0) == []
    assert SystemdNotifier.from_environment({"WATCHDOG_USEC": "1000000"}).watchdog_s is None
    assert not SystemdNotifier.from_environment(
        {"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"}
    ).watchdog_s


def test_a_socket_that_nobody_reads_holds_nothing_up(tmp_path: Path) -> None:
    with Listening(str(tmp_path / "notify")):
        unit = SystemdNotifier(str(tmp_path / "notify"))
        for i in range(10_000):
            unit.send_status(str(i))


class Freezing:
    """A link whose driver hangs in a read, once told to; nothing but its closing ends that."""

    carrier: Carrier = "bytes"
    epoch = "monotonic"
    name = "a cable"

    def __init__(self) -> None:
        self.frozen = threading.Event()
        self._closed = threading.Event()

    def open(self) -> None:
        self._closed.clear()

    def wait_for_chunks_or_timeout(self, timeout_s: float) -> list[Chunk] | None:
        if self.frozen.is_set():
            self._closed.wait()
            raise LinkLost("closed")
        self._closed.wait(0.02)
        return None

    def close(self) -> None:
        self._closed.set()


@pytest.mark.long
def test_a_frozen_reader_ends_the_signs_of_life_and_nothing_else(tmp_path: Path) -> None:
    """zenoh's router is not there: that keeps nothing from starting."""
    endpoint = free_endpoint()
    (tmp_path / "c.toml").write_text(
        DEVICE.format(name="well")
        + DEVICE.format(name="frozen")
        + f'[zenoh]\nmode = "client"\nconnect = ["{endpoint}"]\n[viewer]\nmode = "none"\n'
    )
    with Listening(str(tmp_path / "notify")) as systemd:
        service = Service(
            loading.load_config(tmp_path / "c.toml"),
            unit=SystemdNotifier(str(tmp_path / "notify"), watchdog_s=1.5, stuck_s=3.0),
        )
        link = Freezing()
        service.workers[1].driver.link = link
        thread = threading.Thread(target=service.run)
        thread.start()
        try:
            wait_for(lambda: systemd.count("READY=1") == 1)
            wait_for(lambda: systemd.count("WATCHDOG=1") >= 3)
            assert any(line.startswith("STATUS=2 devices, 1 running, 1 waiting; ") for line in systemd.lines())
            link.frozen.set()
            wait_for(lambda: any("frozen: the reader is stuck" in line for line in systemd.lines()))
            signs = systemd.count("WATCHDOG=1")
            received = service.workers[0].driver.counts.received
            wait_for(lambda: service.workers[0].driver.counts.received > received + 200)
            assert systemd.count("WATCHDOG=1") == signs
        finally:
            service.request_stop()
            thread.join(PATIENCE_S)
        assert not thread.is_alive()
        assert systemd.lines()[-1].startswith(("STOPPING=1", "STATUS="))
        assert systemd.count("STOPPING=1") == systemd.count("READY=1") == 1


# --- the unit


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not here")
def test_the_unit_is_one(tmp_path: Path) -> None:
    """Where the program is, is for the reader's machine to say."""
    unit = tmp_path / UNIT.name
    unit.write_text(UNIT.read_text("utf-8").replace("/opt/imu-monitor/bin/imu-monitor", "/bin/true"))
    command = ["systemd-analyze", "verify", "--man=no", str(unit)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_unit_keeps_what_the_service_relies_on() -> None:
    said = dict(
        line.split("=", 1) for line in UNIT.read_text("utf-8").splitlines() if "=" in line and not line.startswith("#")
    )
    assert said["Type"] == "notify"
    assert said["Restart"] == "always"
    assert said["ExecReload"] == "/bin/kill -HUP $MAINPID"
    assert float(said["WatchdogSec"]) >= 3 * 20.0
    assert said["StateDirectory"] == said["CacheDirectory"] == "imu-monitor"
    assert said["SupplementaryGroups"] == "dialout"
    assert (said["NoNewPrivileges"], said["ProtectSystem"], said["ProtectHome"]) == ("yes", "strict", "yes")
    assert "MemoryDenyWriteExecute" not in said
