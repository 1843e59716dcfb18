"""Numerical error of the sliding window after very many samples, compared with a batch computation.

    python -m tests.experiments.benchmarks.long_run [--loss 0.05]
    python -m tests.experiments.benchmarks.long_run --samples 1e9 --window 20000 --taus 8 [--loss 0.05]

By default, the window has an hour at 100 Hz and all averaging times. Every axis is 9.81 plus noise of 1e-4. A thousand
samples in each million are missing, and the share ``--loss`` of all samples at random. In each 10⁷ samples, an axis is
restarted, and in each 10⁸ samples, more samples than the window holds are missing in one piece. After a tenth of the
run, there is a transient of 10⁶ times the noise. At each power of ten and at the end, the program prints the largest
relative difference between the Allan variances of the window and of ``batch.overlapping_avar`` for the same samples.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np

from drivers.data_types import Floats
from monitor.estimation.allan.batch import cluster_sizes, overlapping_avar
from monitor.estimation.allan.window import AllanWindow
from tests.experiments.benchmarks.machine import console, describe_machine

BLOCK = 1_000_000
NOISE = 1e-4
TRANSIENT = 1e6 * NOISE


def simulate_block(index: int, loss: float, outage: int) -> Floats:
    """Return the block [BLOCK, 6] with this index. In one of a hundred blocks, ``outage`` samples are missing."""
    rng = np.random.default_rng(index)
    values = 9.81 + NOISE * rng.standard_normal((BLOCK, 6))
    gap = int(rng.integers(BLOCK - 1000))
    values[gap : gap + 1000] = np.nan
    if loss:
        values[rng.random(BLOCK) < loss] = np.nan
    if index % 100 == 50:
        values[:outage] = np.nan
    return values


def largest_difference(window: AllanWindow, newest: Floats) -> float:
    """Return the largest relative difference to the batch computation."""
    avar, terms = overlapping_avar(newest[-window.length :], window.factors)
    if not np.array_equal(terms, window.variances().terms):
        raise SystemExit("the window counts other terms than the batch computation")
    return float(np.nanmax(np.abs(window.avar() / avar - 1.0)))


def run(window: AllanWindow, blocks: int, loss: float, report: Callable[[str], None]) -> float:
    """Process the blocks and return the largest relative difference."""
    worst, begun = 0.0, time.perf_counter()
    for index in range(blocks):
        values = simulate_block(index, loss, window.length + 1000)
        if index == blocks // 10:
            values[1000:1050] += TRANSIENT
        window.append_samples(values[: BLOCK // 2])
        if index % 10 == 5:
            window.keep_newest(index // 10 % 6, 1000)
        window.append_samples(values[BLOCK // 2 :])
        done = (index + 1) * BLOCK
        if index == blocks // 10 or index + 1 == blocks or str(done).rstrip("0") == "1":
            worst = max(worst, found := largest_difference(window, values))
            report(f"{done:.0e} samples: {found:.1e}, {time.perf_counter() - begun:.0f} s")
    return worst


def main() -> None:
    """Run and print the differences."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--samples", type=float, default=1e8)
    parser.add_argument("--loss", type=float, default=0.0)
    parser.add_argument("--window", type=int, default=360_000)
    parser.add_argument("--taus", type=int)
    arguments = parser.parse_args()
    blocks = max(1, round(arguments.samples / BLOCK))
    console.print(describe_machine())
    window = AllanWindow(arguments.window, cluster_sizes(arguments.window, 100.0)[: arguments.taus])
    console.print(f"largest difference: {run(window, blocks, arguments.loss, console.print):.1e}")


if __name__ == "__main__":
    main()
