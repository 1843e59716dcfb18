"""Samples that are missing after a daemon was killed (SIGKILL) at random moments, with a sensor at 1 kHz.

    python -m tests.experiments.benchmarks.kill --kills 100 --seed 1

The sensor is a pseudo-terminal in this process that prints lines with a counter. All daemons record into one folder,
with segments of ten seconds, so that files are frequently started, ended and compressed. After each kill, every file is
read. The counter of each row must agree with the previous row and the number of lost samples.
"""

import argparse
import contextlib
import os
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.data_types import Floats, Ints
from drivers.recordings import load_samples, segment_file
from monitor.history.sqlite_store import open_history
from monitor.history.time_ranges import TimeRange
from tests.support.terminal import LineTerminal
from tests.support.waiting import PATIENCE_S, wait_for

RATE = 1000
CONFIG = """
[[device]]
name = "bench"
rate = {rate}
window = "5min"
publish = "every block"
[device.driver]
link = "serial"
port = "{port}"
decoder = "text"
[device.driver.decoder_options]
columns = ["counter", "gx", "gy", "gz", "ax", "ay", "az"]
[zenoh]
mode = "none"
[viewer]
mode = "none"
[storage]
folder = "{folder}"
segment = "10s"
raw = {raw}
"""


class Sensor:
    """Simulated sensor that prints a thousand lines per second with a counter. Unread lines are lost."""

    def __init__(self, folder: Path) -> None:
        self.port = folder / "tty"
        self._terminal = LineTerminal(self.port)
        self.device = os.readlink(self.port)
        self.sent = 0  # number of lines that have been written
        self.send_lock = threading.Lock()  # while it is locked, the sensor sends nothing
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        self._terminal.pull()

    def _run(self) -> None:
        rng = np.random.default_rng(0)
        begun = time.monotonic()
        while not self._closing.wait(0.01):
            asked = time.monotonic()
            with self.send_lock:
                begun += time.monotonic() - asked  # the clock of the sensor stops too
                due = int((time.monotonic() - begun) * RATE)
                values = 1e-3 * rng.standard_normal((due - self.sent, 6))
                lines = [
                    ",".join([str(self.sent + i), *(f"{value:.6f}" for value in row)]) + "\n"
                    for i, row in enumerate(values)
                ]
                self._terminal.write("".join(lines).encode())
                self.sent = due


@dataclass(frozen=True)
class Kill:
    """Result of one kill."""

    lived_s: float
    rows: int  # rows that this daemon recorded
    missing_s: float  # duration of the sent samples that are not in the recording
    batches_s: tuple[float, ...] = ()  # duration of each batch in the newest segment


class Bench:
    """Daemons that record one after the other into one folder."""

    def __init__(self, folder: Path, raw: bool = True) -> None:
        self.folder = folder / "store"
        self.sensor = Sensor(folder)
        self._config = folder / "daemon.toml"
        toml = CONFIG.format(rate=RATE, port=self.sensor.port, folder=self.folder, raw=str(raw).lower())
        self._config.write_text(toml)
        self._log = (folder / "daemon.log").open("ab")

    def close(self) -> None:
        self.sensor.close()
        self._log.close()

    def kill(self, after_s: float) -> Kill:
        """Start a daemon, kill it after ``after_s`` seconds, and compare the recording with the sensor."""
        begun = time.monotonic()
        return self.kill_when(lambda _: time.monotonic() >= begun + after_s)

    def kill_when(self, condition: Callable[[int], bool]) -> Kill:
        """Start a daemon, kill it once ``condition`` is true, and compare the recording with the sensor.

        ``condition`` gets the process id. The sensor sends nothing between this moment and the end of the process.
        """
        before = self.ticks()
        process, begun = self._start(), time.monotonic()
        opened = None

        def try_kill() -> bool:
            nonlocal opened
            if opened is None and self.has_port(process.pid):
                opened = self.sensor.sent
            if not condition(process.pid):
                return False
            with self.sensor.send_lock:
                if not condition(process.pid):
                    return False
                process.kill()
                process.wait()
                return True

        try:
            wait_for(try_kill, "the moment of the kill")
            sent, lived_s = self.sensor.sent, time.monotonic() - begun
        finally:
            process.kill()
            process.wait()
        after = self.ticks()
        rows = len(after) - len(before)
        known = int(after[-1]) + 1 if rows else opened
        missing_s = 0.0 if known is None else max(sent - known, 0) / RATE
        return Kill(lived_s, rows, missing_s, self._batches_s() if rows else ())

    def after(self, condition: Callable[[int], bool], wait_s: float) -> Callable[[int], bool]:
        """Return a condition that is true ``wait_s`` seconds after another condition became true."""
        since_s: float | None = None

        def time_has_passed(pid: int) -> bool:
            nonlocal since_s
            if since_s is None and condition(pid):
                since_s = time.monotonic()
            return since_s is not None and time.monotonic() >= since_s + wait_s

        return time_has_passed

    def recorded(self, rows: int) -> Callable[[int], bool]:
        """Return a condition that is true after ``rows`` more rows have been recorded."""
        before = len(self.ticks())
        return lambda _: len(self.ticks()) >= before + rows

    def run_until(self, until: Callable[[], bool]) -> int:
        """Start a daemon, stop it (SIGTERM) once ``until`` is true, and return its exit status."""
        process = self._start()
        try:
            wait_for(until, "the daemon to come up")
        finally:
            process.terminate()
        return process.wait(PATIENCE_S)

    def ticks(self) -> Ints:
        """Return the counters in all segments. Fail if a file is unreadable or a counter is wrong."""
        ticks, lost = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
        for path in segment_file.list_segments(self.folder / "bench"):
            for piece in segment_file.read_samples(path):
                ticks.append(piece.samples.ticks)
                lost.append(np.zeros(len(piece.samples), np.int64))
                lost[-1][0] = piece.samples.lost
        counts, missing = np.concatenate(ticks), np.concatenate(lost)
        wrong = np.flatnonzero(np.diff(counts) != missing[1:] + 1)
        assert not wrong.size, f"{counts[wrong[0]]} is followed by {counts[wrong[0] + 1]}, lost {missing[wrong[0] + 1]}"
        return counts

    def _batches_s(self) -> tuple[float, ...]:
        """Return the duration of each batch in the newest, uncompressed segment, in seconds."""
        newest = segment_file.list_segments(self.folder / "bench")[-1]
        return tuple(len(piece.samples) / RATE for piece in segment_file.read_samples(newest))

    def check_files(self) -> None:
        """Read every file with the reader of the commands, and every raw file."""
        if segment_file.list_segments(self.folder / "bench"):
            recording = load_samples(self.folder / "bench")
            left_out = [note for note in recording.notes if "left out" in note]
            assert not left_out, left_out
            assert len(recording) == len(self.ticks())
        for path in segment_file.list_segments(self.folder / "bench" / "raw"):
            assert sum(1 for _ in segment_file.read_chunks(path)), path
        self._check_history()

    def _check_history(self) -> None:
        """Check that the history is intact and contains no minute twice."""
        path = self.folder / "history.sqlite"
        if not path.exists():
            return
        with contextlib.closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as store:
            assert store.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        with open_history(path) as reader:
            starts = [row.start_s for row in reader.read_rows("bench", TimeRange(-np.inf, np.inf))]
        assert starts == sorted(set(starts))

    def _start(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "imu_monitor", "run", str(self._config)]
        return subprocess.Popen(command, stdout=self._log, stderr=self._log)

    def has_port(self, pid: int) -> bool:
        """Return True if the process has opened the sensor's port."""
        try:
            names = [os.readlink(f"/proc/{pid}/fd/{fd}") for fd in os.listdir(f"/proc/{pid}/fd")]
        except OSError:  # the process ends or closes a file
            return False
        return self.sensor.device in names


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--longest", type=float, default=8.0, help="longest life of a daemon in seconds")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        try:
            kills = []
            for i in range(arguments.kills):
                kills.append(bench.kill(float(rng.uniform(0.2, arguments.longest))))
                bench.check_files()
                one = kills[-1]
                print(f"{i + 1:4d}  lived {one.lived_s:4.1f} s  {one.rows:6d} rows  {one.missing_s:.3f} s missing")
            rows = len(bench.ticks())
            status = bench.run_until(lambda: len(bench.ticks()) > rows + RATE)
            _print_summary(kills, bench, status)
        finally:
            bench.close()


def _print_summary(kills: list[Kill], bench: Bench, status: int) -> None:
    missing: Floats = np.array([one.missing_s for one in kills])
    files = len(list(bench.folder.rglob(f"*{segment_file.SUFFIX}")))
    print(
        f"{len(kills)} kills, {sum(one.rows > 0 for one in kills)} of them while it recorded, {files} files, all read"
    )
    print(f"missing before a kill: median {np.median(missing):.3f} s, most {missing.max():.3f} s")
    print(f"{len(bench.ticks())} rows, each count follows from the one before; the last daemon ended with {status}")


if __name__ == "__main__":
    main()
