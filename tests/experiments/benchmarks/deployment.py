"""Memory and processor time of a daemon with recording and history, for 1, 4 and 16 sensors at 100 Hz and 1 kHz.

    python -m tests.experiments.benchmarks.deployment --seconds 30

The sensors are pseudo-terminals of this process with a real wire format at its rate. The daemon is a separate process.
Its processor time is measured after the kernels have been compiled. The window is an hour, and results are published
ten times per second. There is no subscriber and no viewer.
"""

import argparse
import os
import select
import subprocess
import sys
import tempfile
import threading
import time
import tty
from pathlib import Path

import numpy as np
import psutil

from drivers.data_types import make_block
from drivers.decoders.binary_frames import vectornav_binary
from monitor.common import shipped_config_paths
from monitor.noise.model_loading import read_model

WARM_UP_S = 25.0
DEVICE = """
[[device]]
name = "imu-{i}"
rate = {rate}
[device.driver]
link = "serial"
port = "{port}"
baudrate = 921600
read_timeout = {wait_s}
decoder = "vectornav_binary"
"""
REST = """
[zenoh]
listen = ["tcp/127.0.0.1:0"]
[viewer]
mode = "none"
[storage]
folder = "{folder}"
"""


class Sensors:
    """Pseudo-terminals with the same frames on each."""

    def __init__(self, folder: Path, count: int, rate_hz: int, seconds: float) -> None:
        self.ports = [folder / f"tty{i}" for i in range(count)]
        self._masters = [self._plug(port) for port in self.ports]
        n = round(rate_hz * seconds)
        model = read_model(shipped_config_paths.CONFIG_FOLDER / "models" / "consumer-mems.toml")
        values = model.start_stream(float(rate_hz), 1).draw_samples_with_temperature(n).values
        ticks = np.arange(n, dtype=np.int64) * (1_000_000_000 // rate_hz)
        encoder = vectornav_binary.build(vectornav_binary.Settings())
        self._frames = [one.data for one in encoder.encode(make_block(ticks, values, np.full(n, 25.0), ticks))]
        self._rate_hz = rate_hz
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        for master in self._masters:
            os.close(master)

    def _plug(self, port: Path) -> int:
        master, slave = os.openpty()
        tty.setraw(master)
        tty.setraw(slave)
        os.set_blocking(master, False)
        port.symlink_to(os.ttyname(slave))
        os.close(slave)
        return master

    def _run(self) -> None:
        begun, sent = time.monotonic(), 0
        while not self._closing.wait(0.01):
            due = min(int((time.monotonic() - begun) * self._rate_hz), len(self._frames))
            data = b"".join(self._frames[sent:due])
            sent = due
            for master in select.select([], self._masters, [], 0.0)[1]:
                try:
                    os.write(master, data)
                except BlockingIOError:
                    continue


def measure_daemon(count: int, rate_hz: int, seconds: float, wait_s: float = 0.01) -> str:
    """Measure a daemon and return one row of the table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sensors = Sensors(folder, count, rate_hz, WARM_UP_S + seconds + 10.0)
        text = "".join(
            DEVICE.format(i=i, rate=float(rate_hz), port=port, wait_s=wait_s) for i, port in enumerate(sensors.ports)
        )
        (folder / "daemon.toml").write_text(text + REST.format(folder=folder / "store"))
        command = [sys.executable, "-m", "imu_monitor", "run", str(folder / "daemon.toml")]
        with (folder / "log").open("wb") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            time.sleep(WARM_UP_S)
            one = psutil.Process(process.pid)
            before, begun, stored = one.cpu_times(), time.monotonic(), _size(folder / "store")
            time.sleep(seconds)
            after, took = one.cpu_times(), time.monotonic() - begun
            grown = _size(folder / "store") - stored
            memory, threads = one.memory_info().rss / 1e6, one.num_threads()
        finally:
            process.terminate()
            process.wait(30.0)
            sensors.close()
        used = (after.user + after.system - before.user - before.system) / took
        lost = (folder / "log").read_text().count("samples_lost")
        note = f" ({lost} events of lost samples)" if lost else ""
    stored_mb = grown / took / count * 86400 / 1e6
    taken = f"{100 * used:.1f} | {memory:.0f} | {threads} | {stored_mb:.0f}"
    return f"| {count} | {rate_hz} | {wait_s * 1e3:.0f} | {taken} |{note}"


def _size(folder: Path) -> int:
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    arguments = parser.parse_args()
    print(
        "| sensors | Hz | read_timeout, ms | % of a core | memory MB | threads | MB a sensor and day, before packing |"
    )
    print("| --: | --: | --: | --: | --: | --: | --: |")
    for rate_hz in (100, 1000):
        for count in (1, 4, 16):
            print(measure_daemon(count, rate_hz, arguments.seconds), flush=True)
        print(measure_daemon(16, rate_hz, arguments.seconds, 0.1), flush=True)


if __name__ == "__main__":
    main()
