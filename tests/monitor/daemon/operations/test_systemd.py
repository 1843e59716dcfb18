"""Tests of the systemd notifications: ready, status, watchdog, reloading and stopping."""

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

UNIT_FILE = CONFIG_FOLDER / "systemd" / "imu-monitor.service"
DEVICE = '[[device]]\nname = "{name}"\nrate = 100.0\ndriver = {{ link = "virtual" }}\n'


class NotificationReceiver:
    """The end of the notification socket that belongs to systemd."""

    def __init__(self, notify_address: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(f"\0{notify_address[1:]}" if notify_address.startswith("@") else notify_address)
        self.socket.setblocking(False)
        self.received: list[str] = []

    def __enter__(self) -> "NotificationReceiver":
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def read_lines(self) -> list[str]:
        """Return all received lines, oldest first."""
        while True:
            try:
                self.received += self.socket.recv(4096).decode().splitlines()
            except BlockingIOError:
                return self.received

    def count_lines(self, line: str) -> int:
        return self.read_lines().count(line)


@pytest.fixture(params=["path", "abstract"])
def notify_address(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(tmp_path / "notify") if request.param == "path" else f"@imu-monitor-test-{os.getpid()}-{time.time_ns()}"


def test_notifications_arrive_at_a_path_and_at_an_abstract_name(notify_address: str) -> None:
    with NotificationReceiver(notify_address) as systemd:
        unit = SystemdNotifier(notify_address, 9.0)
        begun_s = time.monotonic() - 1e-6  # the sent time is truncated to microseconds
        unit.send_status("1 device;\nall well")
        unit.send_status("1 device; all well")
        unit.send_ready()
        unit.send_reloading()
        unit.send_stopping()
        lines = systemd.read_lines()
    assert [line for line in lines if not line.startswith("MONOTONIC_USEC=")] == [
        "STATUS=1 device; all well",
        "READY=1",
        "RELOADING=1",
        "STOPPING=1",
    ]
    (sent_us,) = [int(line.partition("=")[2]) for line in lines if line.startswith("MONOTONIC_USEC=")]
    assert begun_s <= sent_us / 1e6 <= time.monotonic()


def test_watchdog_is_notified_three_times_per_limit_until_a_reader_is_stuck(tmp_path: Path) -> None:
    with NotificationReceiver(str(tmp_path / "notify")) as systemd:
        unit = SystemdNotifier(str(tmp_path / "notify"), 60.0)
        for second in range(100):
            assert unit.send_watchdog({"a": second, "b": second // 10}, float(second)) == []
        assert systemd.count_lines("WATCHDOG=1") == 5
        stuck_at = [second for second in range(100, 200) if unit.send_watchdog({"a": second, "b": 9}, float(second))]
        assert (
            systemd.count_lines("WATCHDOG=1") == 7
        )  # the last notification is at 120 s because b has not advanced since 90 s
        assert stuck_at == list(range(121, 200))
        assert unit.send_watchdog({"a": 200}, 200.0) == []  # b has been removed
        assert systemd.count_lines("WATCHDOG=1") == 8


def test_missing_socket_is_ignored(tmp_path: Path) -> None:
    for address in ("", str(tmp_path / "none"), "vsock:2:9999"):
        unit = SystemdNotifier.from_environment({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "1000000"})
        unit.send_ready()
        assert unit.send_watchdog({"a": 1}, 1.0) == []
    assert SystemdNotifier.from_environment({"WATCHDOG_USEC": "1000000"}).watchdog_s is None
    assert not SystemdNotifier.from_environment(
        {"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"}
    ).watchdog_s


def test_unread_socket_does_not_block(tmp_path: Path) -> None:
    with NotificationReceiver(str(tmp_path / "notify")):
        unit = SystemdNotifier(str(tmp_path / "notify"))
        for i in range(10_000):
            unit.send_status(str(i))


class FreezableLink:
    """A link whose read blocks once ``frozen`` is set, until the link is closed."""

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
def test_frozen_reader_ends_only_the_watchdog_notifications(tmp_path: Path) -> None:
    """The Zenoh router is missing, which must not delay the start."""
    endpoint = free_endpoint()
    (tmp_path / "c.toml").write_text(
        DEVICE.format(name="well")
        + DEVICE.format(name="frozen")
        + f'[zenoh]\nmode = "client"\nconnect = ["{endpoint}"]\n[viewer]\nmode = "none"\n'
    )
    with NotificationReceiver(str(tmp_path / "notify")) as systemd:
        service = Service(
            loading.load_config(tmp_path / "c.toml"),
            unit=SystemdNotifier(str(tmp_path / "notify"), watchdog_s=1.5, stuck_s=3.0),
        )
        link = FreezableLink()
        service.workers[1].driver.link = link
        thread = threading.Thread(target=service.run)
        thread.start()
        try:
            wait_for(lambda: systemd.count_lines("READY=1") == 1)
            wait_for(lambda: systemd.count_lines("WATCHDOG=1") >= 3)
            assert any(line.startswith("STATUS=2 devices, 1 running, 1 waiting; ") for line in systemd.read_lines())
            link.frozen.set()
            wait_for(lambda: any("frozen: the reader is stuck" in line for line in systemd.read_lines()))
            notifications = systemd.count_lines("WATCHDOG=1")
            received = service.workers[0].driver.counts.received
            wait_for(lambda: service.workers[0].driver.counts.received > received + 200)
            assert systemd.count_lines("WATCHDOG=1") == notifications
        finally:
            service.request_stop()
            thread.join(PATIENCE_S)
        assert not thread.is_alive()
        assert systemd.read_lines()[-1].startswith(("STOPPING=1", "STATUS="))
        assert systemd.count_lines("STOPPING=1") == systemd.count_lines("READY=1") == 1


# --- the unit


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not here")
def test_unit_file_is_accepted_by_systemd(tmp_path: Path) -> None:
    """The program path is replaced because it depends on the machine."""
    unit = tmp_path / UNIT_FILE.name
    unit.write_text(UNIT_FILE.read_text("utf-8").replace("/opt/imu-monitor/bin/imu-monitor", "/bin/true"))
    command = ["systemd-analyze", "verify", "--man=no", str(unit)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_unit_file_has_the_settings_the_service_relies_on() -> None:
    settings = dict(
        line.split("=", 1)
        for line in UNIT_FILE.read_text("utf-8").splitlines()
        if "=" in line and not line.startswith("#")
    )
    assert settings["Type"] == "notify"
    assert settings["Restart"] == "always"
    assert settings["ExecReload"] == "/bin/kill -HUP $MAINPID"
    assert float(settings["WatchdogSec"]) >= 3 * 20.0
    assert settings["StateDirectory"] == settings["CacheDirectory"] == "imu-monitor"
    assert settings["SupplementaryGroups"] == "dialout"
    assert (settings["NoNewPrivileges"], settings["ProtectSystem"], settings["ProtectHome"]) == ("yes", "strict", "yes")
    assert "MemoryDenyWriteExecute" not in settings
