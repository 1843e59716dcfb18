"""Processor time of a daemon with one sensor, for several versions of the program.

    python -m tests.experiments.benchmarks.bench_sensor [--seconds 30] [--runs 3] [--python A/bin/python B/bin/python]

Another process writes frames to a pseudo-terminal, and this process subscribes to all messages. The daemon runs with
default settings and without viewer. Each argument of ``--python`` is the interpreter of an environment in which one
version is installed. The versions run alternately. The processor time is measured after the kernels have been loaded.
"""

import argparse
import sys
import time
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

from tests.experiments.benchmarks.bench_devices import PublishedMessages
from tests.experiments.benchmarks.machine import Load, console, create_table, describe_machine
from tests.experiments.benchmarks.rig import PATIENCE_S, Daemon, Sensors, open_session
from tests.support.waiting import wait_for

RATES_HZ: Final = (100, 1000)
DECODERS: Final = ("vectornav_binary", "xsens_mtdata2")
WARM_UP_S: Final = 8.0
SETTLE_S: Final = 2.0


def measure_share(python: str, decoder: str, rate_hz: int, seconds: float, folder: Path) -> tuple[float, int, str]:
    """Return the processor time as a share of one core, the number of context switches, and the counts of samples."""
    sensors = Sensors(folder, 1, rate_hz, WARM_UP_S + seconds, decoder)
    daemon = Daemon(folder, 1, rate_hz, "10min", decoder=decoder, python=python)
    published = PublishedMessages()
    try:
        with open_session(daemon.port) as session, session.declare_subscriber("imu/**", published.take):
            wait_for(lambda: bool(published.status), "the first status")
            sensors.start()
            time.sleep(WARM_UP_S)
            start_s, cpu_s, switches = time.monotonic(), daemon.cpu_s(), daemon.context_switches()
            sent = sensors.wait(seconds + PATIENCE_S)["each"]
            share = (daemon.cpu_s() - cpu_s) / (time.monotonic() - start_s)
            switches = round((daemon.context_switches() - switches) / (time.monotonic() - start_s))
            time.sleep(SETTLE_S)
            counts = {what: published.total(what) for what in ("received", "lost", "bad")}
        if sum(counts.values()) != sent:
            raise SystemExit(f"{sent} samples were sent, but the status counts {counts}")
        return share, switches, ", ".join(f"{n} {what}" for what, n in counts.items())
    finally:
        daemon.close()
        sensors.close()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--python", nargs="+", default=[sys.executable])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--rates", type=int, nargs="+", default=RATES_HZ)
    parser.add_argument("--decoders", nargs="+", default=DECODERS)
    arguments = parser.parse_args()
    console.print(describe_machine())
    table = create_table("one sensor", "decoder", "Hz", "version", "% of a core, runs", "switches/s", "samples")
    load = Load()
    for decoder, rate_hz in product(arguments.decoders, arguments.rates):
        runs: dict[str, list[tuple[float, int, str]]] = {python: [] for python in arguments.python}
        for _, python in product(range(arguments.runs), arguments.python):
            with TemporaryDirectory() as folder:
                runs[python].append(measure_share(python, decoder, rate_hz, arguments.seconds, Path(folder)))
        for python, found in runs.items():
            shares, switches, counts = zip(*found, strict=True)
            text = " ".join(f"{100 * share:.1f}" for share in sorted(shares))
            table.add_row(decoder, f"{rate_hz}", python, text, f"{np.median(switches):.0f}", counts[0])
    console.print(table)
    console.print(load.describe())


if __name__ == "__main__":
    main()
