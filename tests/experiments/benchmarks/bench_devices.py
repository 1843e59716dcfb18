"""Lost samples, processor time, memory and latency of a daemon with many IMUs.

    python -m tests.experiments.benchmarks.bench_devices [--devices 1 4 16 64] [--rate 1000] [--seconds 30]
        [--parts default viewer ...] [--read-timeout 0.01] [--workers auto] [--window 10min] [--burst 1]
        [--share 0.25]

Another process writes VectorNav binary frames to one pseudo-terminal for each device. The daemon reads them with its
serial link and default settings, except for the length of the window. This process subscribes to all messages of the
daemon. The processor time of all processes of the daemon is measured from 5 s after the first sample to the last
sample. The latency is the time from the write of the newest frame of a result until this process receives the
coefficients. Shared memory pages count once (PSS). Every sample must be received, bad or lost.

``--share`` simulates a slower board: the daemon runs on one processor with so many busy processes that it gets about
this share of the processor. The sensors and the subscriber use the other processors.
"""

import argparse
import contextlib
import json
import os
import re
import time
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import zenoh

from tests.experiments.benchmarks.machine import Load, console, create_table, describe_machine, run_busy_processes
from tests.experiments.benchmarks.rig import NO_VIEWER, PATIENCE_S, Daemon, Sensors, open_session
from tests.support.waiting import wait_for

WARM_UP_S: Final = 5.0
POLL_S: Final = 0.1
SAMPLES: Final = re.compile(rb'"samples":(\d+)')
STORAGE: Final = '[storage]\nfolder = "{folder}/store"\n'
PARTS: Final[Mapping[str, tuple[str, str]]] = {
    "default": ("", NO_VIEWER),
    "with recording and history": ("", NO_VIEWER + STORAGE),
    "with viewer": ("", '[viewer]\nmode = "{folder}/view.rrd"\n'),
    "without compensation": ("compensate = false", NO_VIEWER),
    "without thermal models": ('thermal_interval = "off"', NO_VIEWER),
    "without change detection": ("alarms_per_day = 0.0", NO_VIEWER),
    "publish at 1 Hz": ('publish = "1 Hz"\nrefit = "1 Hz"', NO_VIEWER),
}
"""Device keys and configuration tables, grouped by the part of the daemon that they switch on or off."""


class PublishedMessages:
    """Published messages: their number, the newest status of each device, and the times of the coefficients."""

    def __init__(self) -> None:
        self.messages = 0
        self.status: dict[str, dict[str, Any]] = {}
        self.results: list[tuple[int, int]] = []  # number of samples, and time in ns

    def take(self, sample: zenoh.Sample) -> None:
        """Count a message and store its content. zenoh calls this method."""
        self.messages += 1
        key = str(sample.key_expr)
        if key.endswith("/status"):
            payload = json.loads(sample.payload.to_bytes())
            self.status[payload["device"]] = payload
        elif key.endswith("/coefficients") and (found := SAMPLES.search(sample.payload.to_bytes())):
            self.results.append((int(found[1]), time.monotonic_ns()))

    def count_samples(self) -> int:
        """Return the number of samples that were received, bad or lost."""
        return self.total("received") + self.total("bad") + self.total("lost")

    def total(self, what: str) -> int:
        """Return the sum of a count over the devices."""
        return sum(int(status[what]) for status in self.status.values())


def run(devices: int, part: str, folder: Path, options: argparse.Namespace) -> tuple[list[str], str]:
    """Run a daemon with several devices, and return the cells of a table and a note."""
    rate_hz, seconds = options.rate, options.seconds
    more, tables = (text.replace("{folder}", str(folder)) for text in PARTS[part])
    tables += f"[service]\nworkers = {options.workers if options.workers != 'auto' else chr(34) + 'auto' + chr(34)}\n"
    driver = "" if options.read_timeout is None else f"read_timeout = {options.read_timeout}"
    published, processors = PublishedMessages(), os.sched_getaffinity(0)
    slow = set() if options.share is None else {min(processors)}
    with contextlib.ExitStack() as stack:
        stack.callback(os.sched_setaffinity, 0, processors)
        os.sched_setaffinity(0, processors - slow)
        sensors = Sensors(folder, devices, rate_hz, WARM_UP_S + seconds, burst=options.burst)
        stack.callback(sensors.close)
        if slow:
            stack.enter_context(run_busy_processes(round(1.0 / options.share) - 1, slow))
        daemon = Daemon(folder, devices, rate_hz, options.window, more, driver=driver, tables=tables)
        stack.callback(daemon.close)
        os.sched_setaffinity(0, processors - slow)
        with open_session(daemon.port) as session, session.declare_subscriber("imu/**", published.take):
            wait_for(lambda: len(published.status) == devices, "the first status")
            sensors.start()
            time.sleep(WARM_UP_S)
            load, start_s, cpu_s, before = Load(), time.monotonic(), daemon.cpu_s(), published.messages
            sent = sensors.wait(seconds + PATIENCE_S)
            took_s = time.monotonic() - start_s
            cpu, messages, others = (daemon.cpu_s() - cpu_s) / took_s, published.messages - before, load.describe()
            until_s = time.monotonic() + PATIENCE_S
            while published.count_samples() < devices * sent["each"] and time.monotonic() < until_s:
                time.sleep(POLL_S)
            processes, memory_bytes = daemon.processes(), daemon.memory_bytes()
            threads, descriptors = (sum(map(count, processes)) for count in (_count_threads, _count_descriptors))
        written_ns = sensors.written_ns()
    late_ms = [(at_ns - written_ns[n - 1]) / 1e6 for n, at_ns in published.results if n > WARM_UP_S * rate_hz]
    counts = [published.total(name) for name in ("received", "bad", "lost", "overflowed")]
    balance, all_sent = sum(counts[:3]), devices * sent["each"]
    cells = [f"{count:,}" for count in (all_sent, *counts, sent["full"])]
    cells += [f"{100 * cpu:.0f}", f"{memory_bytes / 1e6:.0f}", f"{messages / took_s:.0f}"]
    cells += [f"{np.quantile(late_ms, q):.0f}" for q in (0.5, 0.99)]
    cells += [f"{len(processes)}", f"{threads}", f"{descriptors}"]
    sign = "=" if balance == all_sent else "≠"
    late = f"sensors at most {1e3 * sent['latest']:.0f} ms late"
    return cells, f"{devices} {part}: received + bad + lost = {balance:,} {sign} {all_sent:,} sent; {others}; {late}"


def _count_threads(process: Any) -> int:
    return int(process.num_threads())


def _count_descriptors(process: Any) -> int:
    return int(process.num_fds())


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--devices", nargs="+", type=int, default=[1, 4, 16, 64])
    parser.add_argument("--parts", nargs="+", default=["default"], choices=PARTS)
    parser.add_argument("--rate", type=int, default=1000, metavar="HZ")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--read-timeout", type=float, metavar="S")
    parser.add_argument("--workers", default="auto")
    parser.add_argument("--window", default="10min")
    parser.add_argument("--share", type=float, help="share of one processor, e.g. 0.25")
    parser.add_argument("--burst", type=int, default=1, metavar="FRAMES")
    options = parser.parse_args()
    console.print(describe_machine())
    table = create_table(
        f"devices at {options.rate} Hz, workers: {options.workers}, {options.seconds:g} s after {WARM_UP_S:g} s",
        "devices", "sent", "received", "bad", "lost", "over-flowed", "port full", "% of a core", "MB", "mes-sages/s",
        "p50 ms", "p99 ms", "pro-cesses", "threads", "descrip-tors",
    )  # fmt: skip
    notes = []
    for devices in options.devices:
        for part in options.parts:
            with TemporaryDirectory() as folder:
                cells, note = run(devices, part, Path(folder), options)
            table.add_row(f"{devices} {part}", *cells)
            notes.append(note)
            print(devices, part, *cells, note, sep=" | ", flush=True)
    console.print(table)
    for note in notes:
        console.print(note)


if __name__ == "__main__":
    main()
