"""From the last byte of a sample to the result in another process.

    python -m tests.experiments.benchmarks.bench_latency [--seconds 20]

One process writes VectorNav binary frames at 1 kHz to a pseudo-terminal and notes when; the daemon refits and publishes
every block; this process subscribes to ``coefficients`` over zenoh. Its ``samples`` says which frame was
the newest: ``newest`` is from that frame's writing to the result's coming, ``every`` from each frame's to the first
result that has it, so it counts what the port's read time-out (10 ms by default) lets a frame wait.
"""

import argparse
import json
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
import zenoh

from drivers.data_types import Floats, Ints
from tests.experiments.benchmarks.machine import Load, about, console, table
from tests.experiments.benchmarks.rig import PATIENCE_S, Daemon, Sensors, subscriber

RATE_HZ: Final = 1000
WARM_UP_S: Final = 5.0
SETTLE_S: Final = 1.0
MODES: Final = {
    "every block": 'refit = "every sample"\npublish = "every block"',
    "10 Hz, as by default": "",
}


def results(seconds: float, more: str, folder: Path) -> tuple[Ints, Ints, Ints, str]:
    """When each frame was written; when each result came, and how many samples it rests on; how busy others were."""
    sensors = Sensors(folder, 1, RATE_HZ, WARM_UP_S + seconds)
    daemon = Daemon(folder, 1, RATE_HZ, "10min", more)
    heard: list[tuple[int, bytes]] = []

    def take(sample: zenoh.Sample) -> None:
        heard.append((time.monotonic_ns(), sample.payload.to_bytes()))

    try:
        with subscriber(daemon.port) as session, session.declare_subscriber("imu/imu0/coefficients", take):
            time.sleep(SETTLE_S)
            load = Load()
            sensors.go()
            sent = sensors.wait(seconds + WARM_UP_S + PATIENCE_S)
            said = load.said()
            time.sleep(SETTLE_S)
        written_ns = sensors.written_ns()
    finally:
        daemon.close()
        sensors.close()
    samples = np.array([json.loads(payload)["samples"] for _, payload in heard])
    if samples[-1] != sent["each"]:
        raise SystemExit(f"the last result has {samples[-1]} samples, sent were {sent['each']}: some are missing")
    return written_ns, np.array([came for came, _ in heard]), samples, said


def newest(written_ns: Ints, came_ns: Ints, samples: Ints) -> Floats:
    """Seconds from the newest frame of a result to its coming, after the warm-up."""
    warm = samples > WARM_UP_S * RATE_HZ
    return np.asarray((came_ns[warm] - written_ns[samples[warm] - 1]) / 1e9)


def every(written_ns: Ints, came_ns: Ints, samples: Ints) -> Floats:
    """Seconds from each frame to the first result that has it, after the warm-up."""
    frames = np.arange(int(WARM_UP_S * RATE_HZ), int(samples[-1]))
    first = np.searchsorted(samples, frames + 1)
    return np.asarray((came_ns[first] - written_ns[frames]) / 1e9)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    seconds = parser.parse_args().seconds
    console.print(about())
    shown = table(
        f"one device at {RATE_HZ} Hz: ms from writing a frame to its result in another process, {seconds:g} s",
        "published", "of", "count", "p50", "p90", "p99", "p99.9", "largest",
    )  # fmt: skip
    feet = []
    for mode, more in MODES.items():
        with TemporaryDirectory() as folder:
            written_ns, came_ns, samples, said = results(seconds, more, Path(folder))
        for name, took in (("newest", newest), ("every", every)):
            ms = 1e3 * took(written_ns, came_ns, samples)
            figures = [f"{np.quantile(ms, q):.1f}" for q in (0.5, 0.9, 0.99, 0.999, 1.0)]
            shown.add_row(mode, f"{name} sample", f"{ms.size:,}", *figures)
        feet.append(f"{mode}: {said}")
    console.print(shown)
    for foot in feet:
        console.print(foot)


if __name__ == "__main__":
    main()
