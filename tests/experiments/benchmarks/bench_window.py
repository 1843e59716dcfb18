"""Cost of the sliding window (compared with allantools and a NumPy loop), of a fit and of the first use.

    python -m tests.experiments.benchmarks.bench_window [--rounds 15]
    python -m tests.experiments.benchmarks.bench_window --loss 0.001 0.01 0.05 0.2   # only the cost of missing samples

The window has six axes. ``allantools.realtime.oadev_realtime`` has one axis and removes no samples. Both get the same
20 cluster sizes, in logarithmic steps up to a quarter of the window. They are measured when each sample adds a term to
every τ. The phase list of allantools is filled directly, because its normal way takes minutes. The NumPy loop updates
six axes and all τ of a sliding window with array operations for each sample.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
from allantools.realtime import oadev_realtime

from drivers.data_types import Floats, Ints, make_block
from monitor.estimation.allan.window import AllanWindow
from monitor.estimation.estimator import Estimator
from tests.experiments.benchmarks.machine import Load, console, create_table, describe_machine, time_alternately

LENGTHS: Final = (1_000, 3_600_000)
TAUS: Final = 20
AXES: Final = 6
BLOCK: Final = 100
CHUNK: Final = 10
"""Number of samples in 10 ms at 1 kHz."""
SAMPLES_PER_CALL: Final = {"blocks": BLOCK, "chunks": CHUNK, "singles": 1}
NOISE: Final = 1e-4
FIRST_USE: Final = """
import time
start = time.perf_counter()
import numpy as np
from drivers.data_types import make_block
from monitor.estimation.estimator import Estimator
imported = time.perf_counter()
estimator = Estimator(100.0, 60.0)
values = np.random.default_rng(0).standard_normal((1000, 6))
estimator.add_samples(make_block(np.arange(1000), values, np.full(1000, np.nan), np.arange(1000)))
estimator.get_estimate()
print(imported - start, time.perf_counter() - imported)
"""


def cluster_sizes(length: int) -> Ints:
    """Return TAUS cluster sizes in logarithmic steps."""
    for steps in range(TAUS, 10 * TAUS):
        sizes = np.unique(np.rint(np.geomspace(1, length // 4, steps)).astype(np.int64))
        if sizes.size == TAUS:
            return sizes
    raise SystemExit(f"{length} samples are too few for {TAUS} cluster sizes")


def simulate_noise(n: int, seed: int = 1) -> Floats:
    """Return white noise on all axes and gravity on az."""
    return NOISE * np.random.default_rng(seed).standard_normal((n, AXES)) + [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]


def fill_window(length: int, loss: float = 0.0) -> AllanWindow:
    """Return a full window, which removes a sample for each new sample."""
    window = AllanWindow(length, cluster_sizes(length))
    for _ in range(-(-(length + BLOCK) // 100_000)):
        window.append_samples(remove_at_random(simulate_noise(min(100_000, length + BLOCK)), loss))
    return window


def remove_at_random(values: Floats, share: float) -> Floats:
    """Return samples of which a share is missing on all axes."""
    return np.where(np.random.default_rng(5).random((len(values), 1)) < share, np.nan, values)


def make_append_loop(window: AllanWindow, values: Floats, size: int) -> Callable[[], None]:
    """Return a function that appends all values, with ``size`` samples in each call."""
    blocks = [values[i : i + size] for i in range(0, len(values), size)]

    def work() -> None:
        for block in blocks:
            window.append_samples(block)

    return work


def make_allantools_loop(length: int, values: Floats) -> Callable[[], None]:
    """Return a function that adds one axis of the values to the class of allantools."""
    sizes = cluster_sizes(length)
    rt = oadev_realtime(afs=sizes.tolist(), tau0=1.0)
    rt.x = np.cumsum(np.resize(simulate_noise(100_000)[:, 0], 2 * int(sizes[-1]) + 1)).tolist()
    column = values[:, 0].tolist()

    def work() -> None:
        for y in column:
            rt.add_frequency(y)

    return work


def make_numpy_loop(length: int, values: Floats) -> Callable[[], None]:
    """Return a function that updates the sums of squared second differences of a full window with NumPy."""
    sizes, places = cluster_sizes(length), length + 1
    phase, sums = np.zeros((places, AXES)), np.zeros((TAUS, AXES))
    at = 0

    def work() -> None:
        nonlocal at, sums
        for y in values:
            now = (at + 1) % places
            leaving = phase[now] - 2.0 * phase[(now + sizes) % places] + phase[(now + 2 * sizes) % places]
            phase[now] = phase[at] + y
            added = phase[now] - 2.0 * phase[now - sizes] + phase[now - 2 * sizes]
            sums += added * added - leaving * leaving
            at = now

    return work


def print_window_costs(rounds: int) -> None:
    """Print the cost per sample for both window lengths, and the ratio to allantools."""
    singles, many, few = simulate_noise(2_000, 2), simulate_noise(20_000, 3), simulate_noise(400, 4)
    load = Load()
    works = {}
    for length in LENGTHS:
        window = fill_window(length)
        works[f"{length} blocks"] = make_append_loop(window, many, BLOCK)
        works[f"{length} chunks"] = make_append_loop(window, many, CHUNK)
        works[f"{length} singles"] = make_append_loop(window, singles, 1)
        works[f"{length} peer"] = make_allantools_loop(length, few)
        works[f"{length} numpy"] = make_numpy_loop(length, few)
    took = time_alternately(works, rounds)
    table = create_table(
        f"a window of L samples, six axes, {TAUS} τ; median (best) of {rounds} rounds",
        "samples a call", "L", "a sample", "ns a τ·axis", "allantools over this, a sample·axis", "NumPy loop over this",
    )  # fmt: skip
    medians: dict[tuple[str, int], float] = {}
    for how, count in (("blocks", len(many)), ("chunks", len(many)), ("singles", len(singles))):
        for length in LENGTHS:
            median, best = (t / count for t in took[f"{length} {how}"])
            theirs, numpy = (took[f"{length} {name}"][0] / len(few) for name in ("peer", "numpy"))
            medians[how, length] = median
            table.add_row(
                f"{SAMPLES_PER_CALL[how]}",
                f"{length:,}",
                f"{median * 1e6:.3f} ({best * 1e6:.3f}) µs",
                f"{median * 1e9 / AXES / TAUS:.2f} ({best * 1e9 / AXES / TAUS:.2f})",
                f"{theirs / (median / AXES):,.0f}",
                f"{numpy / median:,.0f}",
            )
    for (name, axes, key), length in product((("allantools, no window", 1, "peer"), ("NumPy", AXES, "numpy")), LENGTHS):
        median, best = (t / len(few) for t in took[f"{length} {key}"])
        text = f"{median * 1e6:.1f} ({best * 1e6:.1f}) µs"
        table.add_row(f"{name}, axes: {axes}", f"{length:,}", text, f"{median * 1e9 / axes / TAUS:.0f}", "", "")
    console.print(table)
    short, long = LENGTHS
    ratios = {how: medians[how, long] / medians[how, short] for how in ("blocks", "chunks", "singles")}
    console.print("long window over short: " + ", ".join(f"{how} {ratio:.2f}" for how, ratio in ratios.items()))
    console.print(load.describe() + "\n")


def print_loss_costs(losses: list[float], rounds: int) -> None:
    """Print the cost per sample with random loss relative to the cost without loss."""
    load, shares = Load(), [0.0, *losses]
    table = create_table("cost with random loss over the cost without loss", "samples a call", "L", *map(str, shares))
    works = {}
    for length, loss in product(LENGTHS, shares):
        window = fill_window(length, loss)
        for how, n in (("blocks", 20_000), ("chunks", 20_000), ("singles", 2_000)):
            values = remove_at_random(simulate_noise(n, 2), loss)
            works[f"{how} {length} {loss}"] = make_append_loop(window, values, SAMPLES_PER_CALL[how])
    took = time_alternately(works, rounds)
    for how, length in product(SAMPLES_PER_CALL, LENGTHS):
        medians = [took[f"{how} {length} {loss}"][0] for loss in shares]
        without = f"{medians[0] / (2_000 if how == 'singles' else 20_000) * 1e6:.3f} µs"
        ratios = [f"{median / medians[0]:.2f}" for median in medians[1:]]
        table.add_row(f"{SAMPLES_PER_CALL[how]}", f"{length:,}", without, *ratios)
    console.print(table)
    console.print(load.describe() + "\n")


def print_fit_cost(rounds: int) -> None:
    """Print the cost of ``Estimator.get_estimate`` for full windows and a growing window."""
    load = Load()
    table = create_table("a refit: curve, fit and intervals of six axes", "window", "τ", "median (best)")
    for seconds, rate_hz in ((10.0, 100.0), (3600.0, 100.0), (3600.0, 1000.0)):
        estimator = fill_estimator(seconds, rate_hz)
        estimator.get_estimate()  # computes the table of covariances, which is stored
        median, best = time_alternately({"get": estimator.get_estimate}, 20 * rounds)["get"]  # type: ignore[dict-item]
        taus = estimator.get_estimate().curve.factors.size
        table.add_row(f"full, {seconds:g} s at {rate_hz:g} Hz", f"{taus}", f"{median * 1e6:.0f} ({best * 1e6:.0f}) µs")
    took = sorted(time_fits_of_growing_window())
    text = f"{took[len(took) // 2] * 1e6:.0f} µs, 99 of 100 within {took[int(0.99 * len(took))] * 1e6:.0f} µs, "
    table.add_row("growing to 60 s, 1000 Hz, each 10 samples", "14", text + f"slowest {took[-1] * 1e3:.1f} ms")
    console.print(table)
    console.print(load.describe() + "\n")


def fill_estimator(seconds: float, rate_hz: float) -> Estimator:
    """Return an estimator with a full window."""
    estimator = Estimator(rate_hz, seconds)
    for start in range(0, round(seconds * rate_hz), 100_000):
        n = min(100_000, round(seconds * rate_hz) - start)
        estimator.add_samples(make_block(np.arange(n), simulate_noise(n), np.full(n, np.nan), np.arange(n)))
    return estimator


def time_fits_of_growing_window() -> list[float]:
    """Return the duration of each fit while a window of 60 s fills, in seconds."""
    estimator, took = Estimator(1000.0, 60.0), []
    values = simulate_noise(60_000)
    for start in range(0, len(values), CHUNK):
        part = values[start : start + CHUNK]
        estimator.add_samples(make_block(np.arange(CHUNK), part, np.full(CHUNK, np.nan), np.arange(CHUNK)))
        begun = time.perf_counter()
        estimator.get_estimate()
        took.append(time.perf_counter() - begun)
    return took[1:]


def print_first_use() -> None:
    """Print the times of import and first fit in a new process, with and without compiled code on disk."""
    load = Load()
    table = create_table("first use, in a process of its own", "compiled code", "imports", "first update and fit")
    with TemporaryDirectory() as folder:
        for state in ("not there yet", "on disk", "on disk, again"):
            run = subprocess.run(
                [sys.executable, "-c", FIRST_USE],
                env=os.environ | {"NUMBA_CACHE_DIR": folder},
                cwd=Path(__file__).parents[3],
                check=True,
                capture_output=True,
                text=True,
            )
            imports, first = map(float, run.stdout.split())
            table.add_row(state, f"{imports:.2f} s", f"{first:.2f} s")
    console.print(table)
    console.print(load.describe() + "\n")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--loss", type=float, nargs="+", default=[], metavar="SHARE")
    arguments = parser.parse_args()
    rounds = arguments.rounds
    console.print(describe_machine())
    if arguments.loss:
        print_loss_costs(arguments.loss, rounds)
        return
    print_window_costs(rounds)
    print_fit_cost(rounds)
    print_first_use()


if __name__ == "__main__":
    main()
