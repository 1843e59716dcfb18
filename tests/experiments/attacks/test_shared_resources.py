"""Tests of two daemons that share a folder, a port, a zenoh key or a sensor. The second one reports it in one line."""

import contextlib
import importlib.util
import os
import signal
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh

from drivers.data_types import make_block
from drivers.errors import LinkUnavailable
from drivers.links import serial_link
from drivers.recordings import load_samples, segment_file
from drivers.zenoh.sample_message import encode_samples
from drivers.zenoh.session_config import build_session_config
from monitor.common import topics
from monitor.daemon.operations.prometheus_metrics import MetricsOutput
from monitor.publishing.zenoh.publisher import ZenohPublisher
from monitor.settings.loading import MetricsAddress, ZenohTable
from tests.experiments.benchmarks import faults
from tests.support.ports import free_endpoint, free_port
from tests.support.waiting import PATIENCE_S, wait_for

IMU_MONITOR = [sys.executable, "-m", "imu_monitor"]
RATE = 100
needs_rerun = pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="rerun-sdk is not installed")


# --- one storage folder


class SharedSensor:
    """Simulated sensor that sends numbered samples over zenoh, so that several daemons can receive them."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self.sent = 0
        self._session = zenoh.open(build_session_config({"listen/endpoints": [self.endpoint]}))
        self._publisher = self._session.declare_publisher("lab/imu", congestion_control=zenoh.CongestionControl.BLOCK)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        self._session.close()

    def _run(self) -> None:
        begun_ns = time.time_ns()
        while not self._closing.wait(0.05):
            due = (time.time_ns() - begun_ns) * RATE // 1_000_000_000
            if due <= self.sent:
                continue
            index = np.arange(self.sent, due)
            values = np.zeros((len(index), 6))
            values[:, 0] = index * 1e-6
            self.sent = due
            self._publisher.put(
                encode_samples("imu", due, make_block(begun_ns + index * (1_000_000_000 // RATE), values))
            )


class Daemon:
    """Daemon in a separate process, with its log."""

    def __init__(self, folder: Path, name: str, text: str) -> None:
        config, self._log = folder / f"{name}.toml", folder / f"{name}.log"
        config.write_text(text)
        config.chmod(0o600)
        with self._log.open("wb") as log:
            self.process = subprocess.Popen([*IMU_MONITOR, "run", str(config)], stdout=log, stderr=log)
        self.pid = self.process.pid

    def has_logged(self, *words: str) -> bool:
        return any(all(word in line for word in words) for line in self.log().splitlines())

    def log(self) -> str:
        return self._log.read_text(errors="replace")

    def end(self) -> int:
        self.process.terminate()
        return self.process.wait(60.0)


@contextlib.contextmanager
def kill_at_end() -> Iterator[list[Daemon]]:
    running: list[Daemon] = []
    try:
        yield running
    finally:
        for daemon in running:
            daemon.process.kill()
            daemon.process.wait()


CONFIG = """
[[device]]
name = "imu"
rate = {rate}
window = "1min"
driver = {{ link = "zenoh", key = "lab/imu", mode = "client", connect = ["{endpoint}"], decoder = "samples" }}
[storage]
folder = "{folder}"
segment = "10s"
[zenoh]
mode = "none"
[viewer]
mode = "none"
[log]
format = "json"
"""


def read_sample_numbers(folder: Path) -> list[int]:
    """Return the numbers of all samples in the recording, in the order of the recording."""
    pieces = [piece for path in segment_file.list_segments(folder) for piece in segment_file.read_samples(path)]
    return [round(value * 1e6) for piece in pieces for value in piece.samples.values[:, 0]]


def count_missing_samples(folder: Path) -> int:
    """Return the number of lost samples. Fail if a sample is stored twice or is lost without being counted."""
    due, total = None, 0
    for path in segment_file.list_segments(folder):
        for piece in segment_file.read_samples(path):
            found = [round(value * 1e6) for value in piece.samples.values[:, 0]]
            if due is not None:
                assert found[0] - due == piece.samples.lost, f"{path.name}: {found[0]} after {due - 1}"
                total += piece.samples.lost
            assert found == list(range(found[0], found[0] + len(found)))
            due = found[-1] + 1
    return total


@pytest.mark.timeout(600)
def test_two_daemons_on_one_folder_record_each_sample_once(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    folder, sensor = tmp_path / "store", SharedSensor()
    text = CONFIG.format(rate=RATE, endpoint=sensor.endpoint, folder=folder)
    try:
        with kill_at_end() as running:
            first = Daemon(tmp_path, "first", text)
            running.append(first)
            wait_for(lambda: segment_file.list_segments(folder / "imu"), "the first records")
            second = Daemon(tmp_path, "second", text)
            running.append(second)
            reason = f"{folder}: in use by process {first.pid}; "
            wait_for(lambda: second.has_logged("recording_stopped", reason, "choose another folder"), second.log)
            wait_for(lambda: second.has_logged("history", reason, "choose another folder"), second.log)

            doctor = subprocess.run(
                [*IMU_MONITOR, "doctor", str(tmp_path / "second.toml"), "--json", "-"],
                capture_output=True, text=True, timeout=PATIENCE_S, check=False,
            )  # fmt: skip
            assert f"{folder}: in use by process {first.pid}" in doctor.stdout
            analysis = subprocess.run(
                [*IMU_MONITOR, "analyze", str(folder / "imu"), "--json", "-"],
                capture_output=True, text=True, timeout=PATIENCE_S, check=False,
            )  # fmt: skip
            assert analysis.returncode in (0, 3), analysis.stderr

            count = len(read_sample_numbers(folder / "imu"))
            wait_for(
                lambda: len(read_sample_numbers(folder / "imu")) > count + 3 * RATE, "more records of the first daemon"
            )
            first.process.send_signal(signal.SIGKILL)
            first.process.wait()
            recorded = read_sample_numbers(folder / "imu")
            wait_for(lambda: second.has_logged("recording_back", "recording continues"), second.log)
            wait_for(lambda: len(read_sample_numbers(folder / "imu")) > len(recorded) + 2 * RATE, "the second records")
            assert second.end() == 0
            assert "Traceback" not in first.log() + second.log()
    finally:
        sensor.close()
    assert read_sample_numbers(folder / "imu")[: len(recorded)] == recorded
    assert count_missing_samples(folder / "imu") == 0
    assert not [note for note in load_samples(folder / "imu").notes if "left out" in note]


# --- one endpoint, one key


def open_publisher(settings: ZenohTable) -> ZenohPublisher:
    publisher = ZenohPublisher(settings, ["bench"])
    publisher.start()
    wait_for(lambda: publisher.state.startswith("ok"), "the session")
    return publisher


def test_two_daemons_on_one_zenoh_port(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with contextlib.closing(open_publisher(ZenohTable(listen=(endpoint,)))) as first:
        with contextlib.closing(open_publisher(ZenohTable(listen=(endpoint,)))) as second:
            assert second.state.startswith(f"ok, but {endpoint} is busy: listening on tcp/127.0.0.1:")
        assert first.state == "ok"


def test_two_daemons_with_one_prefix_and_the_same_device_name(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with (
        contextlib.closing(open_publisher(ZenohTable(listen=(endpoint,)))) as first,
        contextlib.closing(open_publisher(ZenohTable(listen=(), connect=(endpoint,)))) as second,
    ):
        message = "another program publishes imu/bench too; change a device's name, or zenoh.prefix"

        def both_report() -> bool:
            first.put(topics.STATUS, "bench", b"{}")
            second.put(topics.STATUS, "bench", b"{}")
            return message in first.state and message in second.state

        wait_for(both_report, "both states")
        assert first.state == f"ok, but {message}"
        with contextlib.closing(open_publisher(ZenohTable(listen=(), connect=(endpoint,), prefix="lab"))) as other:
            for _ in range(20):
                first.put(topics.STATUS, "bench", b"{}")
                other.put(topics.STATUS, "bench", b"{}")
                assert other.state == "ok"
        second.remove_device("bench")
        assert "another program" not in second.state


# --- one port of the metrics, one port of the viewer


def test_two_daemons_on_one_metrics_port() -> None:
    pytest.importorskip("prometheus_client")
    port = free_port()
    with contextlib.closing(MetricsOutput(MetricsAddress("127.0.0.1", port))) as first:
        first.start()
        wait_for(lambda: first.state == "ok", lambda: first.state)
        with contextlib.closing(MetricsOutput(MetricsAddress("127.0.0.1", port))) as second:
            second.start()
            wait_for(lambda: second.state != "starting", lambda: second.state)
            assert second.state == f"127.0.0.1:{port}: {os.strerror(98)}; trying again"
            assert first.state == "ok"


@needs_rerun
@pytest.mark.attack
@pytest.mark.timeout(600)
def test_two_daemons_on_one_viewer_port() -> None:
    from monitor.publishing.rerun.queued_view import RerunView
    from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription, ViewerSettings

    settings = ViewerSettings("web", free_port(), free_port())
    with contextlib.closing(RerunView(settings, [ViewerDeviceDescription("a")])) as first:
        first.start()
        wait_for(lambda: first.state == "ok", lambda: first.state)
        with contextlib.closing(RerunView(settings, [ViewerDeviceDescription("b")])) as second:
            second.start()
            wait_for(lambda: second.state.startswith("ok"), lambda: second.state)
            assert f"ok, but port {settings.port} is busy: " in second.state
            assert f"port {settings.web_port} is busy: " in second.state
            assert first.state == "ok"


# --- one sensor


def test_two_daemons_on_one_serial_port(tmp_path: Path) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    port = os.ttyname(slave)
    try:
        first, second = (serial_link.build(serial_link.Settings(port=port)) for _ in range(2))
        first.open()
        with (
            contextlib.closing(first),
            pytest.raises(LinkUnavailable, match="held by another program; close"),
        ):
            second.open()
        with contextlib.closing(second):
            second.open()
    finally:
        os.close(master)
        os.close(slave)


@pytest.mark.attack
@pytest.mark.timeout(900)
def test_two_daemons_on_one_serial_port_and_one_zenoh_endpoint(tmp_path: Path) -> None:
    outcome = faults.two_daemons(tmp_path, 1)
    assert "held by another program" in outcome.reported
    assert "is busy" in outcome.reported
    assert (outcome.received, outcome.lost, outcome.bad) == (outcome.sent, 0, 0)


@pytest.mark.attack
@pytest.mark.timeout(900)
def test_four_daemons_on_one_folder_record_each_sample_once(tmp_path: Path) -> None:
    """The daemon that records is killed until one daemon is left."""
    pytest.importorskip("pyarrow")
    folder, sensor = tmp_path / "store", SharedSensor()
    text = CONFIG.format(rate=RATE, endpoint=sensor.endpoint, folder=folder)
    try:
        with kill_at_end() as running:
            for i in range(4):
                running.append(Daemon(tmp_path, f"daemon{i}", text))
            alive = list(running)
            while len(alive) > 1:
                count = len(read_sample_numbers(folder / "imu"))
                wait_for(lambda count=count: len(read_sample_numbers(folder / "imu")) > count + 3 * RATE, "new records")
                pid = int((folder / "recording.lock").read_text().split()[0])
                (holder,) = [daemon for daemon in alive if daemon.pid == pid]
                holder.process.kill()
                holder.process.wait()
                alive.remove(holder)
            count = len(read_sample_numbers(folder / "imu"))
            wait_for(lambda: len(read_sample_numbers(folder / "imu")) > count + 3 * RATE, "the last records")
            assert alive[0].end() == 0
    finally:
        sensor.close()
    count_missing_samples(folder / "imu")
