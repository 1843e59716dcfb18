"""Processor time and peak memory of the command ``reconcile``.

    python -m tests.experiments.benchmarks.bench_reconcile [--rows 1000000] [--rounds 1]

Each recording is processed by a separate process, as on the command line. The processor time is user plus system time
of all threads, including the start of the program and the report. The recordings are:

- ``--rows`` rows of six axes at 100 Hz with 20 effects that the model lacks.
- One hour of six axes at 100 Hz that agrees with the model, once with the model and once with fitted terms.
- 10⁶ rows of a real sensor (``adis16405/run1.npz``), if the environment variable ``IMU_MONITOR_DATA`` is set.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

import numpy as np

from drivers.data_types import AXES
from monitor.noise.effect import Effect
from monitor.noise.effects import (
    AngleRandomWalk,
    BandwidthLimit,
    BiasInstability,
    BiasStep,
    ExponentiallyCorrelated,
    Narrowband,
    NoiseStep,
    Outliers,
    RandomSampleHold,
    RateRamp,
    RateRandomWalk,
    Resolution,
    Sinusoidal,
    TurnOnTransient,
)
from monitor.noise.model import NoiseModel
from tests.experiments.benchmarks.machine import Load, console, create_table, describe_machine

RATE_HZ: Final = 100.0
HOUR_ROWS: Final = 360_000
KNOWN: Final[tuple[Effect, ...]] = (AngleRandomWalk(N=1e-4), BiasInstability(B=2e-6), RateRandomWalk(K=1e-7))
REAL: Final = "adis16405/run1.npz"


def hidden_effects(duration_s: float) -> dict[str, tuple[Effect, ...]]:
    """Return 20 effects on six axes that are missing from the model."""
    return {
        "gx": (
            Sinusoidal(amplitude=5e-5, frequency=17.3),
            Narrowband(sigma=3e-4, frequency=31.0, bandwidth=1.0),
            RateRamp(R=1e-3 / duration_s),
            Resolution(step=3e-4),
        ),
        "gy": (
            ExponentiallyCorrelated(sigma=2e-4, correlation_time=2.0),
            Sinusoidal(amplitude=5e-5, frequency=8.1),
            BiasStep(time=0.4 * duration_s, height=3e-4),
        ),
        "gz": (
            BandwidthLimit(cutoff=25.0, order=2),
            Sinusoidal(amplitude=5e-5, frequency=3.7),
            TurnOnTransient(amplitude=1e-3, time_constant=0.02 * duration_s),
        ),
        "ax": (
            Outliers(fraction=2e-4, scale=1e-2),
            NoiseStep(time=0.6 * duration_s, ratio=1.3),
            Sinusoidal(amplitude=5e-5, frequency=21.7),
        ),
        "ay": (
            Narrowband(sigma=3e-4, frequency=12.0, bandwidth=1.0),
            Narrowband(sigma=3e-4, frequency=41.0, bandwidth=1.0),
            Sinusoidal(amplitude=5e-5, frequency=26.3),
            RateRamp(R=1e-3 / duration_s),
        ),
        "az": (
            RandomSampleHold(fraction=0.01),
            ExponentiallyCorrelated(sigma=2e-4, correlation_time=5.0),
            BiasStep(time=0.7 * duration_s, height=3e-4),
        ),
    }


def write_recording(path: Path, model: NoiseModel, rows: int) -> Path:
    """Simulate a recording and write it."""
    drawn = model.simulate(rows, RATE_HZ, 7)
    np.savez(path, fs=np.float64(RATE_HZ), **{axis: drawn[:, at] for at, axis in enumerate(AXES)})  # type: ignore[arg-type]
    return path


def measure(recording: Path, folder: Path, *options: str) -> tuple[float, float, int]:
    """Run the command once.

    Returns
    -------
    processor_s : float
        Processor time of all threads in seconds.
    peak_mb : float
        Peak resident memory in MB.
    findings : int
        Number of added and resized effects.
    """
    report = folder / "result.json"
    command = [sys.executable, "-m", "imu_monitor", "reconcile", str(recording), "--out", str(folder / "report")]
    process = subprocess.Popen([*command, "--json", str(report), *options], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    axes = json.loads(report.read_bytes())["axes"].values()
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0, sum(len(axis["steps"]) for axis in axes)


def main() -> None:
    """Print processor time, peak memory and number of findings of each recording."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--rounds", type=int, default=1)
    arguments = parser.parse_args()
    load = Load()
    table = create_table("reconcile", "recording", "processor time (best)", "peak memory", "findings")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        known = NoiseModel(dict.fromkeys(AXES, KNOWN), RATE_HZ)
        model = folder / "model.toml"
        model.write_text(known.to_toml())
        hidden = hidden_effects(arguments.rows / RATE_HZ)
        full = NoiseModel({axis: (*KNOWN, *hidden[axis]) for axis in AXES}, RATE_HZ)
        hour = write_recording(folder / "hour.npz", known, HOUR_ROWS)
        measure(hour, folder)  # compiles the kernels
        works: dict[str, tuple[Path, tuple[str, ...]]] = {
            "one hour, agrees with the model": (hour, ("--model", str(model))),
            "one hour, agrees with fitted terms": (hour, ()),
            f"{arguments.rows} rows, 20 effects": (
                write_recording(folder / "hidden.npz", full, arguments.rows),
                ("--model", str(model)),
            ),
        }
        if "IMU_MONITOR_DATA" in os.environ:
            works[f"real, {REAL}"] = (Path(os.environ["IMU_MONITOR_DATA"]) / REAL, ())
        for title, (recording, options) in works.items():
            runs = [measure(recording, folder, *options) for _ in range(arguments.rounds)]
            times = [processor_s for processor_s, _, _ in runs]
            cells = (f"{np.median(times):.1f} ({min(times):.1f}) s", f"{max(peak_mb for _, peak_mb, _ in runs):.0f} MB")
            table.add_row(title, *cells, str(runs[0][2]))
    console.print(table)
    console.print(describe_machine(), load.describe(), sep="\n")


if __name__ == "__main__":
    main()
