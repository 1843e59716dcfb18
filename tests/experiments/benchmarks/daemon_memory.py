"""Resident memory of the whole daemon with full windows of one hour at 100 Hz, for one and for several sensors.

    python -m tests.experiments.benchmarks.daemon_memory [--devices 1 3] [--rate 100] [--parts default ...]

Another process writes the frames of one hour at many times the rate of the sensors, so the daemon withholds the
coefficients, but it fills all windows. The kernel reports the resident pages by their origin (/proc/<pid>/smaps). Each
sample is counted as 64 bytes: time, six axes and temperature.
"""

import argparse
import re
import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from tests.experiments.benchmarks.bench_devices import PARTS, PublishedMessages
from tests.experiments.benchmarks.machine import console, create_table, describe_machine
from tests.experiments.benchmarks.rig import Daemon, Sensors, open_session
from tests.support.waiting import wait_for

WINDOW_S: Final = 3600.0
SAMPLE_BYTES: Final = 64
SPEED: Final = 80.0
SETTLE_S: Final = 3.0
ORIGINS: Final = (
    ("libllvmlite", "LLVM library (numba)"),
    ("libarrow", "Arrow libraries"),
    ("zenoh", "zenoh library"),
    (r"\.so", "other libraries"),
    ("", "heap and arrays"),
)
"""Pattern in the name of a mapped file, and the origin of the memory."""


def measure_origins(pid: int) -> Counter[str]:
    """Return the resident memory of a process in bytes by origin."""
    origin, found = "", Counter[str]()
    for line in Path(f"/proc/{pid}/smaps").read_text().splitlines():
        if mapping := re.match(r"[0-9a-f]+-[0-9a-f]+ \S+ \S+ \S+ \S+\s*(.*)", line):
            origin = next(name for pattern, name in ORIGINS if re.search(pattern, mapping[1]))
        elif line.startswith("Rss:"):
            found[origin] += 1024 * int(line.split()[1])
    return found


def measure(devices: int, part: str, rate_hz: int, folder: Path) -> Counter[str]:
    """Fill the windows of a daemon and return its resident memory in bytes by origin."""
    more, tables = (text.replace("{folder}", str(folder)) for text in PARTS[part])
    sensors = Sensors(folder, devices, rate_hz, WINDOW_S + 100.0, burst=round(SPEED), speed=SPEED)
    daemon = Daemon(folder, devices, rate_hz, "1h", more, tables=tables)
    published = PublishedMessages()
    try:
        with open_session(daemon.port) as session, session.declare_subscriber("imu/*/status", published.take):
            wait_for(lambda: len(published.status) == devices, "the first status")
            sensors.start()
            sent = devices * int(sensors.wait(10.0 * WINDOW_S)["each"])
            wait_for(lambda: published.count_samples() == sent, "the last sample")
            time.sleep(SETTLE_S)
            return measure_origins(daemon.process.pid)
    finally:
        daemon.close()
        sensors.close()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--devices", nargs="+", type=int, default=[1, 3])
    parser.add_argument("--rate", type=int, default=100, metavar="HZ")
    parser.add_argument("--parts", nargs="+", default=["default"], choices=PARTS)
    options = parser.parse_args()
    console.print(describe_machine())
    origins = [name for _, name in ORIGINS]
    table = create_table(
        f"resident memory in MB, windows of 1 h at {options.rate} Hz", "sensors", *origins, "all", "samples"
    )
    for part in options.parts:
        for devices in options.devices:
            with TemporaryDirectory() as folder:
                found = measure(devices, part, options.rate, Path(folder))
            numbers = [found[name] for name in origins]
            samples = devices * options.rate * WINDOW_S * SAMPLE_BYTES
            table.add_row(f"{devices} {part}", *(f"{one / 1e6:.0f}" for one in (*numbers, sum(numbers), samples)))
    console.print(table)


if __name__ == "__main__":
    main()
