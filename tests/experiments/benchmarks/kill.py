"""The daemon killed (SIGKILL) at random moments while a sensor sends a thousand samples a second: what is missing?

    python -m tests.experiments.benchmarks.kill --kills 100 --seed 1

The sensor is a pseudo-terminal in this process, whose lines carry a count. Each daemon records into the same folder,
with segments of ten seconds, so that files are begun, ended and packed all the time. After each kill every file is
read, and each row's count must follow from the one before by what it says was lost.
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
    """Lines with a count, a thousand a second; what nobody reads is gone, as on a wire."""

    def __init__(self, folder: Path) -> None:
        self.port = folder / "tty"
        self._terminal = LineTerminal(self.port)
        self.device = os.readlink(self.port)
        self.sent = 0  # counts that have been given to the wire
        self.still = threading.Lock()  # nothing is sent while it is held
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
            with self.still:
                begun += time.monotonic() - asked  # the sensor's clock stands still too
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
    """One of them."""

    lived_s: float
    rows: int  # that this daemon recorded
    missing_s: float  # of what had come by then, not in the recording
    batches_s: tuple[float, ...] = ()  # length of each batch of the newest segment, in s of samples


class Bench:
    """Daemons one after the other on one folder."""

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
        """Start, kill after so long, look at what there is."""
        begun = time.monotonic()
        return self.kill_when(lambda _: time.monotonic() >= begun + after_s)

    def kill_when(self, true: Callable[[int], bool]) -> Kill:
        """Start a daemon, kill it once ``true`` of its process id holds, and compare the recording with the sensor.

        The sensor sends nothing between the moment at which ``true`` holds and the end of the process.
        """
        before = self.ticks()
        process, begun = self._start(), time.monotonic()
        opened = None

        def killed() -> bool:
            nonlocal opened
            if opened is None and self.has_port(process.pid):
                opened = self.sensor.sent
            if not true(process.pid):
                return False
            with self.sensor.still:
                if not true(process.pid):
                    return False
                process.kill()
                process.wait()
                return True

        try:
            wait_for(killed, "the moment of the kill")
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
        """Return a condition: so many seconds have passed since another condition became true."""
        since_s: float | None = None

        def true(pid: int) -> bool:
            nonlocal since_s
            if since_s is None and condition(pid):
                since_s = time.monotonic()
            return since_s is not None and time.monotonic() >= since_s + wait_s

        return true

    def recorded(self, rows: int) -> Callable[[int], bool]:
        """Return a condition: so many more rows are recorded."""
        before = len(self.ticks())
        return lambda _: len(self.ticks()) >= before + rows

    def live(self, until: Callable[[], bool]) -> int:
        """Start, stop in order (SIGTERM) once ``until`` holds; the exit status."""
        process = self._start()
        try:
            wait_for(until, "the daemon to come up")
        finally:
            process.terminate()
        return process.wait(PATIENCE_S)

    def ticks(self) -> Ints:
        """The counts in all segments; AssertionError where a file cannot be read or a count does not follow."""
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
        """Seconds of samples in each batch of the newest segment, which stands as it was written."""
        newest = segment_file.list_segments(self.folder / "bench")[-1]
        return tuple(len(piece.samples) / RATE for piece in segment_file.read_samples(newest))

    def check_files(self) -> None:
        """Every file with the commands' own reader, and the raw ones."""
        if segment_file.list_segments(self.folder / "bench"):
            recording = load_samples(self.folder / "bench")
            left_out = [note for note in recording.notes if "left out" in note]
            assert not left_out, left_out
            assert len(recording) == len(self.ticks())
        for path in segment_file.list_segments(self.folder / "bench" / "raw"):
            assert sum(1 for _ in segment_file.read_chunks(path)), path
        self._check_history()

    def _check_history(self) -> None:
        """The store is whole, and no minute stands in it twice."""
        path = self.folder / "history.sqlite"
        if not path.exists():
            return
        with contextlib.closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as store:
            assert store.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        with open_history(path) as reader:
            starts = [row.start_s for row in reader.read_rows("bench", TimeRange(-np.inf, np.inf))]
        assert starts == sorted(set(starts))

    def _start(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "monitor.cli", "run", str(self._config)]
        return subprocess.Popen(command, stdout=self._log, stderr=self._log)

    def has_port(self, pid: int) -> bool:
        """Return True if the process has opened the sensor's port."""
        try:
            names = [os.readlink(f"/proc/{pid}/fd/{fd}") for fd in os.listdir(f"/proc/{pid}/fd")]
        except OSError:  # between two of them
            return False
        return self.sensor.device in names


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--longest", type=float, default=8.0, help="s that a daemon lives at most")
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
            status = bench.live(lambda: len(bench.ticks()) > rows + RATE)
            _tell(kills, bench, status)
        finally:
            bench.close()


def _tell(kills: list[Kill], bench: Bench, status: int) -> None:
    missing: Floats = np.array([one.missing_s for one in kills])
    files = len(list(bench.folder.rglob(f"*{segment_file.SUFFIX}")))
    print(
        f"{len(kills)} kills, {sum(one.rows > 0 for one in kills)} of them while it recorded, {files} files, all read"
    )
    print(f"missing before a kill: median {np.median(missing):.3f} s, most {missing.max():.3f} s")
    print(f"{len(bench.ticks())} rows, each count follows from the one before; the last daemon ended with {status}")


if __name__ == "__main__":
    main()
