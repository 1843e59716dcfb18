"""Processor time of ``overlapping_avar`` and ``analyze`` for a whole recording, compared with ``allantools.oadev``.

    python -m tests.experiments.benchmarks.bench_batch [--samples 10000000] [--rounds 5]

Both get the same rates in memory and the same τ, an octave grid up to a quarter of the recording. allantools computes
one axis in each call, so six times its time is compared with ``analyze``. ``analyze`` also checks the times of the
samples and fits coefficients. The times are processor times of one thread. For several threads, the table contains the
elapsed time and the processor time of all threads.
"""

import argparse
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import allantools
import numpy as np

from drivers.data_types import AXES, Floats, Ints
from drivers.recordings import Recording, iter_blocks
from monitor.estimation.allan.batch import (
    cluster_sizes,
    overlapping_avar,
    overlapping_avar_axis,
    rate_slope_from_thirds,
)
from monitor.estimation.analysis import analyze
from tests.experiments.benchmarks.machine import Load, console, create_table, describe_machine, time_alternately

RATE_HZ: Final = 100.0
NOISE: Final = 1e-4
THREADS: Final = 2


def simulate_noise(n: int) -> Floats:
    """Return white noise on all axes and gravity on az."""
    values = np.random.default_rng(1).standard_normal((n, len(AXES)))
    values *= NOISE
    values[:, 5] += 9.81
    return values


def allantools_deviation(column: Floats, factors: Ints) -> Floats:
    """Return the overlapping Allan deviation of one axis by allantools."""
    deviation: Floats = allantools.oadev(column, rate=1.0, data_type="freq", taus=factors)[1]
    return deviation


def largest_difference(values: Floats, factors: Ints) -> float:
    """Return the largest relative difference of both Allan deviations."""
    theirs = allantools_deviation(values[:, 5].copy(), factors)
    ours = np.sqrt(overlapping_avar_axis(values[:, 5], factors)[0][: theirs.size])
    return float(np.abs(ours / theirs - 1.0).max())


def measure_elapsed_and_processor_time(work: Callable[[], object], rounds: int) -> tuple[float, float]:
    """Return the median elapsed time and processor time in seconds."""
    took = []
    for _ in range(rounds):
        wall, processor = time.perf_counter(), time.process_time()
        work()
        took.append((time.perf_counter() - wall, time.process_time() - processor))
    median = np.median(took, axis=0)
    return float(median[0]), float(median[1])


def measure_one_thread(values: Floats, rounds: int) -> None:
    """Measure one axis, six axes and ``analyze`` alternately with allantools."""
    load = Load()
    n = len(values)
    recording = Recording(np.arange(n) / RATE_HZ, values, np.full(n, np.nan), None, AXES, ())
    blocks = list(iter_blocks(recording))
    octave, decade = cluster_sizes(n, RATE_HZ), cluster_sizes(n, RATE_HZ, "decade10")
    column = values[:, 5].copy()
    works = {
        "allantools": lambda: allantools_deviation(column, octave),
        "one axis": lambda: overlapping_avar_axis(column, octave),
        "of six": lambda: overlapping_avar_axis(values[:, 5], octave),
        "six": lambda: overlapping_avar(values, octave),
        "slope": lambda: rate_slope_from_thirds(values),
        "analyze": lambda: analyze(blocks, RATE_HZ),
        "allantools, decade10": lambda: allantools_deviation(column, decade),
        "decade10": lambda: overlapping_avar_axis(column, decade),
    }
    took = time_alternately(works, rounds)  # type: ignore[arg-type]
    table = create_table(
        f"{n:,} samples, median (best) of {rounds} rounds, one thread", "", "τ", "processor", "allantools over this"
    )
    theirs, theirs_decade = took["allantools"][0], took["allantools, decade10"][0]
    rows = (
        ("allantools.oadev, one axis", "allantools", octave, theirs),
        ("overlapping_axis, in one piece", "one axis", octave, theirs),
        ("overlapping_axis, a column of six", "of six", octave, theirs),
        ("overlapping, six axes", "six", octave, 6.0 * theirs),
        ("slope, six axes", "slope", octave, None),
        ("analyze, six axes", "analyze", octave, 6.0 * theirs),
        ("allantools.oadev, one axis", "allantools, decade10", decade, theirs_decade),
        ("overlapping_axis, in one piece", "decade10", decade, theirs_decade),
    )
    for title, name, factors, reference in rows:
        median, best = took[name]
        ratio = "" if reference is None else f"{reference / median:.1f}"
        table.add_row(title, f"{factors.size}", f"{median:.3f} ({best:.3f}) s", ratio)
    console.print(table)
    rest = took["analyze"][0] - took["six"][0] - took["slope"][0]
    console.print(f"of analyze: times, grid, covariances and fit {rest:.3f} s")
    console.print(
        f"largest relative difference of deviations, 9.81 on {NOISE:g}: {largest_difference(values, octave):.1e}"
    )
    console.print(load.describe() + "\n")


def measure_threads(values: Floats, rounds: int) -> None:
    """Measure six axes with one thread and with several threads."""
    load = Load()
    factors = cluster_sizes(len(values), RATE_HZ)
    table = create_table(f"overlapping, six axes of {len(values):,} samples", "", "on the wall", "processor")
    with ThreadPoolExecutor(THREADS) as pool:
        works = {
            "one thread": lambda: overlapping_avar(values, factors),
            f"{THREADS} threads": lambda: overlapping_avar(values, factors, map_axes=pool.map),
        }
        for name, work in works.items():
            wall, processor = measure_elapsed_and_processor_time(work, rounds)
            table.add_row(name, f"{wall:.3f} s", f"{processor:.3f} s")
    console.print(table)
    console.print(load.describe() + "\n")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--samples", type=int, default=10_000_000)
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    console.print(describe_machine())
    values = simulate_noise(arguments.samples)
    analyze(list(iter_blocks(Recording(None, values[:10_000], np.full(10_000, np.nan), RATE_HZ, AXES, ()))), RATE_HZ)
    measure_one_thread(values, arguments.rounds)
    measure_threads(values, arguments.rounds)


if __name__ == "__main__":
    main()
