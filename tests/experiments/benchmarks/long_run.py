"""Does the window stay exact for ever? Feeds it samples without end and compares it with a batch computation.

    python -m tests.experiments.benchmarks.long_run --samples 1e9

9.81 on every axis under noise of 1e-4, in a window of an hour at 100 Hz; a thousand samples in each million are
missing, and once, a tenth of the way in, a transient of 10⁶ times the noise passes through. It prints the largest
relative difference between the Allan variances of the window and of ``batch.overlapping_avar`` over the very samples
that it holds, as often as the run passes a power of ten, and at its end.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np

from drivers.data_types import Floats
from monitor.estimation.allan.batch import cluster_sizes, overlapping_avar
from monitor.estimation.allan.window import AllanWindow
from tests.experiments.benchmarks.machine import console, describe_machine

LENGTH = 360_000
BLOCK = 1_000_000
NOISE = 1e-4
TRANSIENT = 1e6 * NOISE


def block_of(index: int) -> Floats:
    """One block [BLOCK, 6], the same whenever it is asked for."""
    rng = np.random.default_rng(index)
    values = 9.81 + NOISE * rng.standard_normal((BLOCK, 6))
    gap = int(rng.integers(BLOCK - 1000))
    values[gap : gap + 1000] = np.nan
    return values


def difference(window: AllanWindow, newest: Floats) -> float:
    """Largest relative difference to the batch computation."""
    avar, terms = overlapping_avar(newest[-LENGTH:], window.factors)
    if not np.array_equal(terms, window.term_counts()):
        raise SystemExit("the window counts other terms than the batch computation")
    return float(np.nanmax(np.abs(window.avar() / avar - 1.0)))


def run(blocks: int, say: Callable[[str], None]) -> float:
    """Largest relative difference on the way through so many blocks."""
    window = AllanWindow(LENGTH, cluster_sizes(LENGTH, 100.0))
    worst, begun = 0.0, time.perf_counter()
    for index in range(blocks):
        values = block_of(index)
        if index == blocks // 10:
            values[1000:1050] += TRANSIENT
        window.append_samples(values)
        done = (index + 1) * BLOCK
        if index == blocks // 10 or index + 1 == blocks or str(done).rstrip("0") == "1":
            worst = max(worst, found := difference(window, values))
            say(f"{done:.0e} samples: {found:.1e}, {time.perf_counter() - begun:.0f} s")
    return worst


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--samples", type=float, default=1e8)
    blocks = max(1, round(parser.parse_args().samples / BLOCK))
    console.print(describe_machine())
    console.print(f"largest difference: {run(blocks, console.print):.1e}")


if __name__ == "__main__":
    main()
