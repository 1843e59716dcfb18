"""Resident memory of the estimator of one device, for an hour of six axes at 1 kHz, after each step.

    python -m tests.experiments.benchmarks.bench_memory [--rate 1000] [--window 3600]

A separate process imports the libraries, builds and fills the window, and fits coefficients. It reads its resident
memory after each step. The first run has no missing samples. The second run has some on each axis, because the window
stores the positions of missing samples only if there are any. A window needs at least one float64 per sample and axis.
The target is this size plus 200 MB.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path
from typing import Final

from tests.experiments.benchmarks.machine import console, create_table, describe_machine

TARGET_MB: Final = 200.0
"""Target of the memory in addition to the samples: interpreter, libraries and kernels."""
STEPS: Final = """
import sys
import psutil

process = psutil.Process()

def print_memory(step):
    print(f"{step};{process.memory_info().rss / 1e6}")

rate_hz, window_s, every = float(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])
print_memory("interpreter")
import numpy as np
print_memory("NumPy")
import numba
print_memory("Numba")
from drivers.data_types import make_block
from monitor.daemon.kernels import kernel_compilation, kernel_groups
from monitor.estimation.estimator import Estimator
print_memory("drivers and monitor.estimation")
for _ in kernel_compilation.prepare_kernels(kernel_groups.SERVICE, lambda _: None, processes=0):
    pass
print_memory("compiled kernels")
estimator = Estimator(rate_hz, window_s)
print_memory("an empty window")
rng, rows, n = np.random.default_rng(0), 10_000, round(rate_hz * window_s)
for start in range(0, n + rows, rows):
    values = 1e-4 * rng.standard_normal((rows, 6)) + [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]
    if every:
        values[start // rows % every :: every] = np.nan
    estimator.add_samples(make_block(start + np.arange(rows), values))
print_memory("a full window")
estimator.get_estimate()
print_memory("curve, fit and intervals")
"""


def measure_steps(rate_hz: float, window_s: float, every: int) -> list[tuple[str, float]]:
    """Return each step and the resident memory after it in MB.

    One sample in ``every`` is missing, or none if ``every`` is 0.
    """
    run = subprocess.run(
        [sys.executable, "-c", STEPS, str(rate_hz), str(window_s), str(every)],
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        cwd=Path(__file__).parents[3],
        check=True,
        capture_output=True,
        text=True,
    )
    lines = [line.split(";") for line in run.stdout.splitlines()]
    return [(step, float(megabytes)) for step, megabytes in lines]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rate", type=float, default=1000.0, metavar="HZ")
    parser.add_argument("--window", type=float, default=3600.0, metavar="S")
    arguments = parser.parse_args()
    console.print(describe_machine())
    measure_steps(arguments.rate, 1.0, 0)  # compiles the kernels
    complete, with_gaps = (measure_steps(arguments.rate, arguments.window, every) for every in (0, 1000))
    samples_mb = arguments.rate * arguments.window * 6 * 8 / 1e6
    table = create_table(
        f"resident memory, MB; a window of {arguments.window:g} s at {arguments.rate:g} Hz, six axes", "after",
        "nothing missing", "of this", "1 of 1000 missing", "of this",
    )  # fmt: skip
    before = (0.0, 0.0)
    for (step, mb), (_, mb_with_gaps) in zip(complete, with_gaps, strict=True):
        table.add_row(
            step, f"{mb:.0f}", f"{mb - before[0]:+.0f}", f"{mb_with_gaps:.0f}", f"{mb_with_gaps - before[1]:+.0f}"
        )
        before = mb, mb_with_gaps
    table.add_row("samples alone", f"{samples_mb:.0f}", "", f"{samples_mb:.0f}", "")
    table.add_row("above the samples", *(text for mb in before for text in (f"{mb - samples_mb:.0f}", "")))
    console.print(table)
    console.print(f"target: at most {TARGET_MB:.0f} MB above the samples")


if __name__ == "__main__":
    main()
