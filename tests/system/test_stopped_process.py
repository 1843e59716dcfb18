"""Test of a daemon that is stopped (SIGSTOP) until the buffers of its ports are full, and then continues (SIGCONT)."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import make_block
from drivers.decoders.binary_frames import vectornav_binary
from drivers.recordings import segment_file
from tests.support.terminal import LineTerminal
from tests.support.waiting import PATIENCE_S, wait_for

pytest.importorskip("pyarrow", reason="recording needs the extra arrow")

RATE_HZ = 150.0
STOPPED_SAMPLES = 3000
"""Number of samples that are sent while the process is stopped; the buffers hold up to 2730 (UDP) and 1700 of them."""
CONFIG = """
[[device]]
name = "clock"
driver = {{ link = "udp", port = {clock}, decoder = "vectornav_binary" }}
[[device]]
name = "udp"
driver = {{ link = "udp", port = {udp}, decoder = "text", decoder_options = {columns} }}
[[device]]
name = "tty"
rate = 150.0
driver = {{ link = "serial", port = "{tty}", decoder = "text", decoder_options = {columns} }}
[zenoh]
mode = "none"
[viewer]
mode = "none"
[storage]
folder = "{folder}"
"""
COLUMNS = '{ columns = ["gx", "gy", "gz", "ax", "ay", "az"], first_line = "keep" }'
VALUE = 1e-3
"""Difference in rad/s of the values of successive samples, so that a value identifies its sample."""


class Sensors:
    """Three sensors that send the same samples at the same times."""

    def __init__(self, folder: Path) -> None:
        self.sent = 0
        self.ports = {"clock": find_udp_port(), "udp": find_udp_port(), "tty": folder / "tty"}
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._terminal = LineTerminal(folder / "tty")
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self._terminal.pull()
        self._socket.close()

    def _run(self) -> None:
        encoder = vectornav_binary.build(vectornav_binary.Settings())
        begun_s = time.monotonic()
        while not self._closing.wait(max(begun_s + self.sent / RATE_HZ - time.monotonic(), 0.0)):
            n = self.sent
            values = np.full((1, 6), VALUE * n)
            line = b",".join([b"%.3f" % (VALUE * n)] * 6) + b"\n"
            (frame,) = encoder.encode(
                make_block(np.zeros(1, np.int64), values, None, np.array([round(n / RATE_HZ * 1e9)]))
            )
            for name, data in (("clock", frame.data), ("udp", line)):
                self._socket.sendto(data, ("127.0.0.1", int(str(self.ports[name]))))
            self._terminal.write(line)
            self.sent += 1


def find_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def read_rows(folder: Path) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the sample numbers [n], Unix times [n] in ns and the number of lost samples of a recording."""
    numbers, t_ns, lost = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], 0
    for path in segment_file.list_segments(folder) if folder.is_dir() else ():
        for piece in segment_file.read_samples(path):
            numbers.append(np.rint(piece.samples.values[:, 0] / VALUE).astype(np.int64))
            t_ns.append(piece.samples.t_ns)
            lost += piece.samples.lost
    return np.concatenate(numbers), np.concatenate(t_ns), lost


def list_open_files(pid: int) -> list[str]:
    try:
        return [os.readlink(f"/proc/{pid}/fd/{fd}") for fd in os.listdir(f"/proc/{pid}/fd")]
    except OSError:  # the process has just closed a file
        return []


def test_stopped_process_neither_bends_times_nor_loses_the_link(tmp_path: Path) -> None:
    store, log = tmp_path / "store", tmp_path / "daemon.log"
    sensors = Sensors(tmp_path)
    (tmp_path / "daemon.toml").write_text(CONFIG.format(**sensors.ports, folder=store, columns=COLUMNS))
    command = [sys.executable, "-m", "imu_monitor", "run", str(tmp_path / "daemon.toml")]
    with log.open("wb") as out:
        daemon = subprocess.Popen(command, stdout=out, stderr=out)
    try:

        def wait_until_recorded(first: int) -> None:
            wait_for(lambda: sensors.sent > first)
            wait_for(lambda: all(last >= first for last in newest()), lambda: f"{newest()}: {log.read_text()}")

        def newest() -> list[int]:
            rows = [read_rows(store / name)[0] for name in ("clock", "udp", "tty")]
            return [int(row[-1]) if row.size else -1 for row in rows]

        device = os.readlink(sensors.ports["tty"])
        wait_for(lambda: device in list_open_files(daemon.pid), log.read_text)
        sensors.start()
        wait_until_recorded(0)
        wait_until_recorded(max(newest()) + 1500)
        daemon.send_signal(signal.SIGSTOP)
        stopped = sensors.sent
        wait_for(lambda: sensors.sent >= stopped + STOPPED_SAMPLES)
        continued = sensors.sent
        daemon.send_signal(signal.SIGCONT)
        wait_until_recorded(continued + 1500)
    finally:
        daemon.send_signal(signal.SIGCONT)
        daemon.terminate()
        daemon.wait(PATIENCE_S)
        sensors.close()
    assert "link_lost" not in log.read_text()
    for name in ("clock", "udp", "tty"):
        number, t_ns, lost = read_rows(store / name)
        missing = int(number[-1] - number[0]) + 1 - len(number)
        assert (np.diff(t_ns) > 0).all(), name
        assert missing > 100, name  # the buffer has overflowed
        assert lost == missing or name != "clock", name
