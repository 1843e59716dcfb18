"""Test of a daemon with two worker processes, one of which is killed while all sensors continue to send."""

import contextlib
import io
import os
import signal
import threading
from pathlib import Path

import pytest
from rich.console import Console

from drivers.recordings import segment_file
from monitor.common.device_health import Health
from monitor.daemon.workers.supervisor import WorkerSupervisor
from monitor.publishing.terminal.watch import watch
from monitor.settings import loading
from tests.experiments.benchmarks.rig import encode_frames
from tests.support.ports import free_endpoint
from tests.support.waiting import PATIENCE_S, wait_for
from tests.system.rig import PluggableTerminal, RecordingOutput

pytest.importorskip("pyarrow", reason="recording needs the extra arrow")

RATE_HZ = 100
NAMES = ("a", "b", "c", "d")
CONFIG = """
[service]
workers = 2
[zenoh]
listen = ["{endpoint}"]
[viewer]
mode = "none"
[storage]
folder = "store"
"""
DEVICE = """
[[device]]
name = "{name}"
rate = {rate}
window = "10min"
driver = {{ link = "serial", port = "{port}", decoder = "vectornav_binary" }}
"""


class Sensors:
    """Thread that writes the same frames to all terminals. A frame is dropped if the terminal's buffer is full."""

    def __init__(self, terminals: list[PluggableTerminal]) -> None:
        self._masters = [terminal.master for terminal in terminals]
        for master in self._masters:
            os.set_blocking(master, False)
        self._frames = encode_frames(RATE_HZ, 900.0, "vectornav_binary")
        self.sent = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(1.0 / RATE_HZ):
            for master in self._masters:
                with contextlib.suppress(BlockingIOError):
                    os.write(master, self._frames[self.sent])
            self.sent += 1

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(PATIENCE_S)


def read_sample_numbers(folder: Path) -> list[int]:
    """Return the numbers of the recorded samples, counted from 0 at the first frame of the sensor."""
    pieces = [piece for path in segment_file.list_segments(folder) for piece in segment_file.read_samples(path)]
    ticks = [int(tick) for piece in pieces for tick in piece.samples.ticks]
    return [(tick - 1_000_000) // (1_000_000_000 // RATE_HZ) for tick in ticks]


def count_samples(health: Health) -> int:
    """Return the number of samples that were received, lost or bad."""
    return health.received + health.lost + health.bad


@pytest.mark.long
def test_killed_worker_is_restarted_while_the_other_continues(tmp_path: Path) -> None:
    terminals, endpoint, output = [], free_endpoint(), RecordingOutput()
    text = CONFIG.format(endpoint=endpoint)
    for name in NAMES:
        (tmp_path / name).mkdir()
        terminals.append(PluggableTerminal(tmp_path / name))
        text += DEVICE.format(name=name, rate=RATE_HZ, port=terminals[-1].port)
    path = tmp_path / "config.toml"
    path.write_text(text)
    supervisor = WorkerSupervisor(loading.load_config(path), 2, [output])
    daemon = threading.Thread(target=supervisor.run)
    daemon.start()
    sensors = None
    try:
        wait_for(lambda: len(output.healths) == len(NAMES), "the first status")
        killed, kept = (worker.devices for worker in supervisor._workers)
        sensors = Sensors(terminals)
        wait_for(lambda: all(output.healths[name].received > 2 * RATE_HZ for name in NAMES), "samples of all sensors")
        wait_for(lambda: all(read_sample_numbers(tmp_path / "store" / name) for name in NAMES), "recorded samples")
        before = dict(output.healths)
        process = supervisor._workers[0].process
        assert process is not None
        os.kill(process.pid, signal.SIGKILL)
        wait_for(lambda: all(output.healths[name].state == "lost" for name in killed), "the lost devices")
        recorded = {name: read_sample_numbers(tmp_path / "store" / name) for name in NAMES}
        last = {name: max(recorded[name]) for name in killed}
        wait_for(lambda: {name for name, one in output.events if one.kind == "window_rebuilt"} == {*killed}, "windows")
        wait_for(lambda: all(output.healths[name].state == "running" for name in killed), "the restarted devices")
        with io.StringIO() as screen:
            watch(connect=[endpoint], once_s=3.0, console=Console(file=screen, width=150))
            shown = screen.getvalue()
        sensors.stop()
        # Frames that are sent before the port is open are not counted.
        expected = {name: sensors.sent - (last[name] + 1 if name in killed else min(recorded[name])) for name in NAMES}
        wait_for(
            lambda: {name: count_samples(one) for name, one in output.healths.items()} == expected,
            lambda: f"{expected} samples, but the status is {output.healths}",
        )
    finally:
        if sensors is not None:
            sensors.stop()
        supervisor.request_stop()
        daemon.join(PATIENCE_S)
    assert not daemon.is_alive()
    assert f"{len(NAMES)} devices" in shown
    assert f"{len(NAMES)} running" in shown
    for name in kept:
        health = output.healths[name]
        assert health.uptime_s > before[name].uptime_s
        assert len(read_sample_numbers(tmp_path / "store" / name)) == health.received
    for name in killed:
        health, numbers = output.healths[name], read_sample_numbers(tmp_path / "store" / name)
        assert numbers == sorted(set(numbers))
        assert len(numbers) == len(recorded[name]) + health.received
    rebuilt = [event.text for name, event in output.events if event.kind == "window_rebuilt" and name in killed]
    assert all("of the window were rebuilt" in text for text in rebuilt)
    assert [worker.process.returncode for worker in supervisor._workers if worker.process is not None] == [0, 0]
