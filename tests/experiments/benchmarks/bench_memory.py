"""Resident memory of one device's estimator: an hour at 1 kHz, six axes, and what each step towards it takes.

    python -m tests.experiments.benchmarks.bench_memory [--rate 1000] [--window 3600]

A process of its own imports, builds, fills the window and fits; after each step it reads its resident set. Once
no sample is missing, once a few are on each axis: places of missing samples are only held once there are any. The
least that could hold the window is one float64 a sample and axis; the aim is that and 200 MB.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path
from typing import Final

from tests.experiments.benchmarks.machine import about, console, table

ALLOWED_MB: Final = 200.0
"""Above the samples: interpreter, libraries, kernels, phase in place of rates."""
STEPS: Final = """
import sys
import psutil

process = psutil.Process()

def said(step):
    print(f"{step};{process.memory_info().rss / 1e6}")

rate_hz, window_s, every = float(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])
said("interpreter")
import numpy as np
said("NumPy")
import numba
said("Numba")
from drivers.data_types import make_block
from monitor.daemon.kernels import kernel_compilation, kernel_groups
from monitor.estimation.estimator import Estimator
said("drivers and monitor.estimation")
for _ in kernel_compilation.prepare_kernels(kernel_groups.SERVICE, lambda _: None, processes=0):
    pass
said("compiled kernels")
estimator = Estimator(rate_hz, window_s)
said("an empty window")
rng, rows, n = np.random.default_rng(0), 10_000, round(rate_hz * window_s)
for start in range(0, n + rows, rows):
    values = 1e-4 * rng.standard_normal((rows, 6)) + [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]
    if every:
        values[start // rows % every :: every] = np.nan
    estimator.add_samples(make_block(start + np.arange(rows), values))
said("a full window")
estimator.get_estimate()
said("curve, fit and intervals")
"""


def measured(rate_hz: float, window_s: float, every: int) -> list[tuple[str, float]]:
    """(step, resident MB after it); one sample in ``every`` is missing, 0 = none."""
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
    given = parser.parse_args()
    console.print(about())
    measured(given.rate, 1.0, 0)  # so that the kernels are on disk
    whole, holed = (measured(given.rate, given.window, every) for every in (0, 1000))
    samples_mb = given.rate * given.window * 6 * 8 / 1e6
    shown = table(
        f"resident memory, MB; a window of {given.window:g} s at {given.rate:g} Hz, six axes", "after",
        "nothing missing", "of this", "1 of 1000 missing", "of this",
    )  # fmt: skip
    before = (0.0, 0.0)
    for (step, mb), (_, mb_holed) in zip(whole, holed, strict=True):
        shown.add_row(step, f"{mb:.0f}", f"{mb - before[0]:+.0f}", f"{mb_holed:.0f}", f"{mb_holed - before[1]:+.0f}")
        before = mb, mb_holed
    shown.add_row("samples alone", f"{samples_mb:.0f}", "", f"{samples_mb:.0f}", "")
    shown.add_row("above the samples", *(text for mb in before for text in (f"{mb - samples_mb:.0f}", "")))
    console.print(shown)
    console.print(f"aim: no more than {ALLOWED_MB:.0f} MB above the samples")


if __name__ == "__main__":
    main()
