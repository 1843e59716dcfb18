"""Latency from the last byte of a sample to the result in another process.

    python -m tests.experiments.benchmarks.bench_latency [--seconds 20]

One process writes VectorNav binary frames at 1 kHz to a pseudo-terminal and records the times. The daemon publishes
coefficients, and this process receives them over zenoh. The field ``samples`` of a result identifies the newest frame.
``newest`` is the latency from the newest frame to the result. ``every`` is the latency from each frame to the first
result that contains the frame, including the time that received bytes wait for more bytes. This time is 4 ms for "every
block", and 0.1 ms if ``read_timeout`` has its lowest value.
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
from drivers.validation.number_ranges import READ_TIMEOUT_S
from tests.experiments.benchmarks.machine import Load, console, create_table, describe_machine
from tests.experiments.benchmarks.rig import PATIENCE_S, Daemon, Sensors, open_session

RATE_HZ: Final = 1000
WARM_UP_S: Final = 5.0
SETTLE_S: Final = 1.0
EVERY_BLOCK: Final = 'refit = "every sample"\npublish = "every block"'
MODES: Final = {
    "every block": (EVERY_BLOCK, ""),
    "every block, lowest read_timeout": (EVERY_BLOCK, f"read_timeout = {READ_TIMEOUT_S.low}"),
    "10 Hz (default)": ("", ""),
}
"""Keys of the device and of the driver for each row of the table."""


def measure_results(seconds: float, more: str, driver: str, folder: Path) -> tuple[Ints, Ints, Ints, str]:
    """Return the times of the frames, the times and sample counts of the results, and the load of the machine."""
    sensors = Sensors(folder, 1, RATE_HZ, WARM_UP_S + seconds)
    daemon = Daemon(folder, 1, RATE_HZ, "10min", more, driver)
    messages: list[tuple[int, bytes]] = []

    def take(sample: zenoh.Sample) -> None:
        messages.append((time.monotonic_ns(), sample.payload.to_bytes()))

    try:
        with open_session(daemon.port) as session, session.declare_subscriber("imu/imu0/coefficients", take):
            time.sleep(SETTLE_S)
            load = Load()
            sensors.start()
            sent = sensors.wait(seconds + WARM_UP_S + PATIENCE_S)
            load_text = load.describe()
            time.sleep(SETTLE_S)
        written_ns = sensors.written_ns()
    finally:
        daemon.close()
        sensors.close()
    samples = np.array([json.loads(payload)["samples"] for _, payload in messages])
    if samples[-1] != sent["each"]:
        raise SystemExit(f"the last result has {samples[-1]} samples, but {sent['each']} were sent")
    return written_ns, np.array([received_at for received_at, _ in messages]), samples, load_text


def latency_of_newest(written_ns: Ints, received_ns: Ints, samples: Ints) -> Floats:
    """Return the latency from the newest frame of each result after the warm-up, in seconds."""
    after_warm_up = samples > WARM_UP_S * RATE_HZ
    return np.asarray((received_ns[after_warm_up] - written_ns[samples[after_warm_up] - 1]) / 1e9)


def latency_of_every(written_ns: Ints, received_ns: Ints, samples: Ints) -> Floats:
    """Return the latency from each frame to its first result after the warm-up, in seconds."""
    frames = np.arange(int(WARM_UP_S * RATE_HZ), int(samples[-1]))
    first = np.searchsorted(samples, frames + 1)
    return np.asarray((received_ns[first] - written_ns[frames]) / 1e9)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    seconds = parser.parse_args().seconds
    console.print(describe_machine())
    table = create_table(
        f"one device at {RATE_HZ} Hz: ms from writing a frame to its result in another process, {seconds:g} s",
        "published", "of", "count", "p50", "p90", "p99", "p99.9", "largest",
    )  # fmt: skip
    notes = []
    for mode, keys in MODES.items():
        with TemporaryDirectory() as folder:
            written_ns, received_ns, samples, load_text = measure_results(seconds, *keys, Path(folder))
        for name, took in (("newest", latency_of_newest), ("every", latency_of_every)):
            ms = 1e3 * took(written_ns, received_ns, samples)
            figures = [f"{np.quantile(ms, q):.1f}" for q in (0.5, 0.9, 0.99, 0.999, 1.0)]
            table.add_row(mode, f"{name} sample", f"{ms.size:,}", *figures)
        notes.append(f"{mode}: {load_text}")
    console.print(table)
    for note in notes:
        console.print(note)


if __name__ == "__main__":
    main()
