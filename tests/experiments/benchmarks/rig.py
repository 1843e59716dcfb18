"""Sensors in one process, the daemon in another process, and a subscriber in this process, for service benchmarks.

``python -m tests.experiments.benchmarks.rig FOLDER DEVICES RATE SECONDS DECODER BURST SPEED`` is the process of the
sensors. It opens a pseudo-terminal FOLDER/tty<i> for each device, encodes all frames, and waits for a line on standard
input. It then writes a burst of BURST frames to each device every BURST/RATE/SPEED s. A USB adapter sends such bursts
as well. A SPEED above 1 fills long windows quickly. The numbers and times of the frames are stored in FOLDER, with
times in monotonic nanoseconds. If a pseudo-terminal is full, the process waits and counts the event. A real port would
lose bytes.
"""

import contextlib
import json
import os
import re
import select
import subprocess
import sys
import time
import tty
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
import psutil
import zenoh

from drivers.data_types import Ints, make_block
from tests.support.ports import free_port
from tests.support.waiting import wait_for

PATIENCE_S: Final = 60.0
DAEMON: Final = "from monitor.cli import main; main()"
DEVICE: Final = """
[[device]]
name = "imu{i}"
rate = {rate}
window = "{window}"
{more}
[device.driver]
link = "serial"
port = "{folder}/tty{i}"
decoder = "{decoder}"
{driver}
"""
REST: Final = """
[zenoh]
listen = ["tcp/127.0.0.1:{port}"]
[log]
level = "error"
"""
NO_VIEWER: Final = """
[viewer]
mode = "none"
"""


class Sensors:
    """Process of the simulated sensors."""

    def __init__(
        self,
        folder: Path,
        devices: int,
        rate_hz: int,
        seconds: float,
        decoder: str = "vectornav_binary",
        burst: int = 1,
        speed: float = 1.0,
    ) -> None:
        self.folder = folder
        command = [
            sys.executable,
            "-m",
            "tests.experiments.benchmarks.rig",
            str(folder),
            str(devices),
            str(rate_hz),
            str(seconds),
            decoder,
            str(burst),
            str(speed),
        ]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        if self._process.stdout.readline() != "ready\n":
            raise SystemExit("the process of the sensors did not start")

    def start(self) -> None:
        """Start writing."""
        assert self._process.stdin is not None
        self._process.stdin.write("go\n")
        self._process.stdin.flush()

    def wait(self, timeout_s: float) -> dict[str, Any]:
        """Wait for the last frame and return the counts. The pseudo-terminals stay open."""
        wait_for((self.folder / "sent.json").exists, "the last frame", timeout_s)
        sent: dict[str, Any] = json.loads((self.folder / "sent.json").read_text())
        return sent

    def written_ns(self) -> Ints:
        """Return the time of each frame in monotonic nanoseconds."""
        times: Ints = np.load(self.folder / "written.npy")
        return times

    def close(self) -> None:
        """End the process."""
        self._process.communicate("stop\n", timeout=PATIENCE_S)


class Daemon:
    """``imu-monitor run`` in a separate process."""

    def __init__(
        self,
        folder: Path,
        devices: int,
        rate_hz: int,
        window: str,
        more: str = "",
        driver: str = "",
        decoder: str = "vectornav_binary",
        python: str = sys.executable,
        tables: str = NO_VIEWER,
    ) -> None:
        self.port = free_port()
        path = folder / "config.toml"
        values = {"rate": rate_hz, "window": window, "more": more, "driver": driver, "decoder": decoder}
        path.write_text(
            "".join(DEVICE.format(i=i, folder=folder, **values) for i in range(devices))
            + REST.format(port=self.port)
            + tables
        )
        self._process = subprocess.Popen([python, "-P", "-c", DAEMON, "run", str(path)])
        self.process = psutil.Process(self._process.pid)
        wait_for(lambda: self._open_ports() >= devices, "the daemon to open its ports")

    def processes(self) -> list[psutil.Process]:
        """Return the main process and its worker processes."""
        return [self.process, *self.process.children(recursive=True)]

    def cpu_s(self) -> float:
        """Return the processor time of all processes so far in seconds, including processes that have ended."""
        total_s = 0.0
        for process in reversed(self.processes()):  # the time of a child that ends now is added to its parent
            with contextlib.suppress(psutil.NoSuchProcess):
                times = process.cpu_times()
                total_s += times.user + times.system + times.children_user + times.children_system
        return total_s

    def memory_bytes(self) -> int:
        """Return the memory of all processes in bytes, in which shared pages count once."""
        return sum(process.memory_full_info().pss for process in self.processes())

    def context_switches(self) -> int:
        """Return how often a thread has waited so far."""
        tasks = Path(f"/proc/{self.process.pid}/task").glob("*/status")
        return sum(int(re.findall(r"voluntary_ctxt_switches:\s+(\d+)", task.read_text())[0]) for task in tasks)

    def close(self) -> None:
        """Stop the daemon (SIGTERM) and check its exit status."""
        self._process.terminate()
        if self._process.wait(PATIENCE_S) != 0:
            raise SystemExit(f"the daemon ended with status {self._process.returncode}")

    def _open_ports(self) -> int:
        if self._process.poll() is not None:
            raise SystemExit(f"the daemon ended with status {self._process.returncode}")
        found = 0
        for process in self.processes():
            for number in os.listdir(f"/proc/{process.pid}/fd"):
                with contextlib.suppress(FileNotFoundError):
                    found += os.readlink(f"/proc/{process.pid}/fd/{number}").startswith("/dev/pts/")
        return found


@contextlib.contextmanager
def open_session(port: int) -> Iterator[zenoh.Session]:
    """Open a zenoh session with the daemon."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/timeout_ms", "30000")  # the daemon may not listen yet
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
    with zenoh.open(config) as session:
        yield session


def encode_frames(rate_hz: int, seconds: float, name: str) -> list[bytes]:
    """Return frames of a resting sensor with noise. The device time increases by one period in each frame."""
    n = round(rate_hz * seconds)
    values = 1e-3 * np.random.default_rng(1).standard_normal((n, 6)) + [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]
    module: Any = import_module(f"drivers.decoders.binary_frames.{name}")
    decoder = module.build(module.Settings())
    at = np.arange(n, dtype=np.int64) * round(1.0 / rate_hz / decoder.timing.tick_s)
    return [chunk.data for chunk in decoder.encode(make_block(at, values, np.full(n, np.nan), at + 1_000_000))]


def open_terminals(folder: Path, devices: int) -> list[int]:
    """Open pseudo-terminals and return their non-blocking ends for the sensors."""
    masters = []
    for i in range(devices):
        master, slave = os.openpty()
        tty.setraw(master)
        tty.setraw(slave)
        (folder / f"tty{i}").symlink_to(os.ttyname(slave))
        os.set_blocking(master, False)
        masters.append(master)  # the slave stays open, so that the reader can close and open it without a hang-up
    return masters


def write_all(masters: list[int], frames: list[bytes], rate_hz: float, burst: int = 1) -> tuple[Ints, int]:
    """Write bursts of frames to each device. Return the time of each frame and how often a terminal was full."""
    written_ns, full = np.zeros(len(frames), np.int64), 0
    begun_ns = time.monotonic_ns()
    for i in range(0, len(frames), burst):
        data = b"".join(frames[i : i + burst])
        early_ns = begun_ns + round((i + burst - 1) * 1e9 / rate_hz) - time.monotonic_ns()
        if early_ns > 0:
            time.sleep(early_ns / 1e9)
        for master in masters:
            full += _write(master, data)
        written_ns[i : i + burst] = time.monotonic_ns()
    return written_ns, full


def _write(master: int, data: bytes) -> int:
    """Write all data and return 1 if the terminal was full, or else 0."""
    full = 0
    while data:
        try:
            data = data[os.write(master, data) :]
        except BlockingIOError:
            full = 1
            select.select([], [master], [])
    return full


def main() -> None:
    """Run the process of the sensors."""
    folder, devices, rate_hz, seconds = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
    frames = encode_frames(rate_hz, seconds, sys.argv[5])
    burst, speed = int(sys.argv[6]), float(sys.argv[7])
    masters = open_terminals(folder, devices)
    print("ready", flush=True)
    if sys.stdin.readline() != "go\n":
        return
    written_ns, full = write_all(masters, frames, speed * rate_hz, burst)
    np.save(folder / "written.npy", written_ns)
    due_s = np.arange(len(frames)) / (speed * rate_hz)
    late_s = float(np.max((written_ns - written_ns[0]) / 1e9 - due_s))
    result = {"each": len(frames), "full": full, "seconds": (written_ns[-1] - written_ns[0]) / 1e9, "latest": late_s}
    (folder / "sent.part").write_text(json.dumps(result))
    (folder / "sent.part").rename(folder / "sent.json")
    sys.stdin.readline()


if __name__ == "__main__":
    main()
